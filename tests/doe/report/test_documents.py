"""The document of every result: whole in a terminal of 80 columns, in a notebook and on a page."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doe import DesignProblem, score
from doe.advise import advise
from doe.bounds.column_generation import relax
from doe.discrimination.design import discrimination_design
from doe.discrimination.t_optimal import NextPostures
from doe.report.page import origin, page
from identification import Arm, Calibration, EffectSpec, Measurements, Model, Plan, detectability, diagnose, estimate
from identification.compensate import compensate
from identification.document import Document, Documented, Part, Section, Sheet
from identification.documents.identification import entry_document, library_document
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


def results() -> Iterator[Documented]:
    """One of every kind."""
    problem, data, fresh = DesignProblem.of(Model(ARM)), measured(40, 1), measured(20, 2)
    diagnosis = diagnose(ARM, data, fresh)
    calibrated = diagnosis.extended_arm()
    yield from (score(problem, data.postures[:30]), relax(problem, 5), detectability(ARM, data.postures))
    yield advise(problem, [4, 5, 6], target=0.1, seconds=1.0)
    yield discrimination_design(problem, ARM, 8, starts=1, seconds=0.1)
    yield from (inspect(ARM, data), estimate(Model(ARM), data), diagnosis)
    yield NextPostures(Plan(data.postures[:2]), 0.5, {}, diagnosis)
    yield from (validate(calibrated, fresh), compensate(calibrated, fresh.positions))


def kinds(cls: type) -> list[type]:
    """Those below it that nothing is below."""
    return [one for each in cls.__subclasses__() for one in kinds(each)] or [cls]


@pytest.fixture(scope="module")
def every() -> dict[str, Document]:
    library = library_document([entry("backlash"), entry("outliers")])
    effect = entry_document(entry("joint_compliance"))
    return {type(one).__name__: one.document() for one in results()} | {"library": library, "effect": effect}


NAMES = (*sorted(kind.__name__ for kind in kinds(Documented)), "library", "effect")


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
    assert len(document.verdict) > 0 or name in ("ApproximateDesign", "Detectability", "library")
    for rendered, folded in ((terminal, False), (words(notebook), True), (words(text), True)):
        shown = flat(rendered)
        for sentence in (*document.warnings, *document.verdict, *(action.command for action in document.actions)):
            assert flat(sentence) in shown
        for sheet in sheets(list(document.parts), folded):
            for cell in {cell for row in sheet.rows[: sheet.most] for cell in row}:
                assert all(flat(word) in shown for word in cell.split()), cell
    assert "armcal test" in text
    assert "<links>" not in text
