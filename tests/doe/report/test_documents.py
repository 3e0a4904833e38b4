"""The document of every result: whole in a terminal of 80 columns, in a notebook and on a page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doe import DesignProblem, score
from doe.advise import advise
from doe.bounds.column_generation import relax
from doe.report.page import origin, page
from identification import Arm, Calibration, EffectSpec, Measurements, Model, diagnose, estimate
from identification.compensate import compensate
from identification.document import Document, Part, Section, Sheet
from identification.documents.identification import entry_document, identification_document, library_document
from identification.effects import entry
from identification.inspection.inspection import inspect
from identification.validate import validate
from tests.identification.test_document import Texts

ARM = Arm([300.0, 200.0], sigma=0.05, name="two <links>")
REAL = Arm(
    [300.0, 200.0],
    effects=(EffectSpec("encoder_eccentricity", 2),),
    calibration=Calibration({"encoder_eccentricity:2.a": 2e-3, "encoder_eccentricity:2.b": 1e-3}),
)


def measured(rows: int, seed: int) -> Measurements:
    generator = np.random.default_rng(seed)
    q = generator.uniform(-2.0, 2.0, (rows, 2))
    return Measurements(q, Model(REAL).position(q) + generator.normal(0.0, 0.05, (rows, 2)))


def documents() -> Iterator[tuple[str, Document]]:
    """Of every kind of result one."""
    problem, data, fresh = DesignProblem.of(Model(ARM)), measured(40, 1), measured(20, 2)
    fit = estimate(Model(ARM), data)
    diagnosis = diagnose(ARM, data, fresh)
    calibrated = diagnosis.extended_arm()
    yield "design", score(problem, data.postures[:30]).document()
    yield "advice", advise(problem, [4, 5, 6], target=0.1, seconds=1.0).document()
    yield "weights", relax(problem, 5).document()
    yield "inspection", inspect(ARM, data).document()
    yield "identification", identification_document(fit, fit.to_json())
    yield "diagnosis", diagnosis.document()
    yield "validation", validate(calibrated, fresh).document()
    yield "commands", compensate(calibrated, fresh.positions).document()
    yield "library", library_document([entry("backlash"), entry("outliers")])
    yield "effect", entry_document(entry("joint_compliance"))


@pytest.fixture(scope="module")
def every() -> dict[str, Document]:
    return dict(documents())


NAMES = (
    *("design", "advice", "weights", "inspection", "identification", "diagnosis", "validation"),
    *("commands", "library", "effect"),
)


def words(text: str) -> str:
    """What a reader sees of a page or a notebook."""
    parser = Texts()
    parser.feed(text)
    assert parser.open == []
    return " ".join(parser.texts)


def flat(text: str) -> str:
    """Letters and digits alone, however they are broken and whatever symbols stand for others."""
    return re.sub(r"[\W_]|chi2|sigma|χ²|σ", "", text)


def sheets(parts: list[Part] | tuple[Part, ...], folded: bool) -> Iterator[Sheet]:
    """The tables, with or without those that are folded away."""
    for part in parts:
        if isinstance(part, Sheet):
            yield part
        elif isinstance(part, Section) and (folded or not part.folded):
            yield from sheets(list(part.parts), folded)


@pytest.mark.parametrize("name", NAMES)
def test_a_result_is_whole_in_every_rendering(every: dict[str, Document], name: str, tmp_path: Path) -> None:
    document = every[name]
    terminal, notebook = document.text(80), document._repr_html_()
    assert max(map(len, terminal.splitlines())) <= 80
    (tmp_path / "data.csv").write_text("q1_deg\n")
    parts = [Section("All", document.parts), origin("armcal test", 3, [tmp_path / "data.csv"])]
    text = page(replace(document, parts=parts))
    assert len(document.verdict) > 0 or name in ("weights", "library")
    for rendered, folded in ((terminal, False), (words(notebook), True), (words(text), True)):
        shown = flat(rendered)
        for sentence in (*document.warnings, *document.verdict, *(action.command for action in document.actions)):
            assert flat(sentence) in shown
        for sheet in sheets(list(document.parts), folded):
            for cell in {cell for row in sheet.rows[: sheet.most] for cell in row}:
                assert all(flat(word) in shown for word in cell.split()), cell
    assert "armcal test" in text
    assert "<links>" not in text
