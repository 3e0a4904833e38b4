"""A diagnosis in words: what is short, and what does not contradict the tables; and in a notebook: tables with the
figures of its JSON object, nothing unescaped, the rest behind a fold."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from identification.arm import Arm
from identification.gap.diagnose import diagnose
from identification.gap.result import Diagnosis
from identification.gap.words import gap_rows, headline, likely, of_joints
from identification.measurements import Measurements

LENGTHS = np.array([300.0, 200.0])


@cache
def diagnosed(play: float) -> Diagnosis:
    """Two links by hand; joint 2 has play, by the side from which it comes."""
    generator = np.random.default_rng(3)
    q, sides = generator.uniform(-1.5, 1.5, (40, 2)), np.sign(generator.normal(size=(40, 2)))
    angles = np.cumsum(q + play * sides * [0.0, 1.0], axis=1)
    tips = np.stack([np.cos(angles) @ LENGTHS, np.sin(angles) @ LENGTHS], axis=1)
    measured = Measurements(q, tips + generator.normal(0.0, 0.02, (40, 2)), directions=sides)
    return diagnose(Arm(LENGTHS, sigma=0.02), measured)


def tables(page: str) -> list[list[list[str]]]:
    """The cells of each table, row by row."""
    rows = [re.findall(r"<tr>(.*?)</tr>", part, re.S) for part in page.split("</table>")[:-1]]
    return [[re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.S) for row in part] for part in rows]


def test_what_is_named_stands_in_tables() -> None:
    found = diagnosed(2e-3)
    assert found.effects == ("backlash:2",)
    page, data = found._repr_html_(), found.to_json()
    assert "<pre" not in page
    gap, sets, estimates = tables(page)[:3]
    assert gap[1][:4] == ["the data", "40", *(f"{data['gap'][f'rms_{k}_mm']:.4f}" for k in ("before", "after"))]
    assert [row[0] for row in gap[2:]] == [f"cross-validated: {test['transfer']}" for test in data["cross_validation"]]
    assert sets[1][:3] == ["backlash:2", f"{found.named.probability:.2f}", f"{found.named.f:.1f}"]
    (name, value, low, high, unit) = estimates[1]
    assert (name, unit) == ("backlash:2.b", "deg")
    assert float(low) < float(value) < float(high)
    (estimate,) = data["named"]["parameters"]
    assert abs(float(value) - np.degrees(2e-3)) < 5.0 * estimate["std"]
    assert page.index("<details>") > page.index("</table>")
    assert len(page) < 6000


@pytest.mark.parametrize(
    ("confirmed", "as_predicted", "answer"),
    [(True, True, "yes"), (True, None, "shrinks"), (False, False, "no"), (None, None, "too few rows")],
)
def test_a_smaller_gap_whose_size_stays_open_is_no_yes(
    confirmed: bool | None, as_predicted: bool | None, answer: str
) -> None:
    """0.365 -> 0.229 mm where 0.152 were expected: it shrinks, and that is all that eight groups say."""
    data = diagnosed(2e-3).to_json()
    test = data["cross_validation"][0] | {"confirmed": confirmed, "as_predicted": as_predicted}
    rows = gap_rows(data | {"confirmation": test, "cross_validation": []})[1]
    assert [row[-1] for row in rows] == ["", answer]


def test_rows_that_are_left_out_are_counted() -> None:
    data = diagnosed(2e-3).to_json()
    assert data["outlier_rows"] == []
    assert gap_rows(data | {"outlier_rows": [3, 17]})[1][0][:2] == ["the data", "38 of 40"]


def test_where_nothing_is_named_the_sizes_that_are_excluded_are_behind_a_fold() -> None:
    found = diagnosed(0.0)
    assert found.effects == ()
    page = found._repr_html_()
    fold = page[page.index("<summary>Sizes that are excluded") :]
    assert [row[0] for row in tables(fold)[0][1:]] == list(found.excluded)


def test_nothing_is_read_as_markup() -> None:
    assert "<b>&" in replace(diagnosed(0.0), warnings=("<img>",))._repr_html_()
    assert "<img>" not in replace(diagnosed(0.0), warnings=("<img>",), notes=("<img>",))._repr_html_()


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ([2], "joint 2"),
        ([1, 2], "joints 1 and 2"),
        ([1, 3], "joints 1 and 3"),
        ([1, 2, 3], "joints 1 to 3"),
        ([1, 2, 4], "joints 1, 2 and 4"),
    ],
)
def test_joints(joints: list[int], words: str) -> None:
    assert of_joints(joints) == words


@pytest.mark.parametrize(
    ("joints", "others", "words"),
    [
        ((1, 2, 3), (), "error curves of joints 1 to 3 describe the errors"),
        ((1,), ("backlash:2",), "error curves of joint 1 + backlash:2 describe the errors"),
    ],
)
def test_curves_describe_what_has_no_name(joints: tuple[int, ...], others: tuple[str, ...], words: str) -> None:
    curves = [SimpleNamespace(joint=j, shape=f"waves of joint {j}") for j in joints]
    given = {"verdict": "unknown", "where": "joint:1", "shape": "waves of joint 1", "candidates": ()}
    found = cast(Diagnosis, SimpleNamespace(effects=others, curves=curves, confirmed=False, offered=None, **given))
    assert headline(found) == f"not confirmed: cause unknown (joint 1 first): no effect in the library fits; {words}"


def test_a_probability_says_what_it_is_among() -> None:
    def said(effects: tuple[str, ...], shapes: tuple[str, ...], *confirmed: bool | None) -> str:
        tests, known = [SimpleNamespace(confirmed=one) for one in confirmed], {"none": 0.2, "ripple": 0.8}
        given = {"candidates": (), "probability": known, "other_sets": {}}
        found = SimpleNamespace(effects=effects, shapes=shapes, tests=tests, **given)
        return likely(cast(Diagnosis, found)).removesuffix(": none 0.20, ripple 0.80")

    assert said(("ripple",), (), True) == said(("ripple",), (), None, True) == said((), (), None) == "probability"
    assert said(("ripple",), ("k",), True) == "probability (among the library's shapes, whatever makes them)"
    assert said(("ripple",), (), None, None) == "probability (too few rows to confirm it on others)"
