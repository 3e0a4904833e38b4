"""What a person reads of a diagnosis: the verdict, what follows from it, and the tables, by its JSON object."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from identification.arm import Arm, Calibration, EffectSpec
from identification.document import Sheet, of_joints
from identification.documents.diagnosis import (
    curve_sections,
    diagnosis_actions,
    diagnosis_verdict,
    effects_in_words,
    estimate_rows,
    excluded_by_kind,
    gap_rows,
    gap_section,
    headline,
    holds_in_words,
    likely,
)
from identification.gap.diagnose import diagnose
from identification.gap.result import Candidate, Diagnosis, Estimate
from identification.measurements import Measurements

GAP = {"rms_before_mm": 0.5, "rms_after_mm": 0.125}
TEST = {"rows": 30, "before_mm": 0.6, "after_mm": 0.25, "predicted_mm": 0.2}
HELD_OUT = {"transfer": "another session", "file": "more.csv", "by": "holdout", "rows": 25, "groups": 8}
NOTHING = Calibration.of(np.zeros(2), np.zeros(2), MappingProxyType({}), (), np.zeros((0, 0)), MappingProxyType({}))
RIPPLE = "transmission_ripple:2"
LENGTHS = np.array([300.0, 200.0])


def said(verdict: str, *effects: str, confirmed: bool | None = None, sets: int = 1) -> dict[str, Any]:
    candidates = [{"effects": [name]} for name in effects[:sets]]
    found = {"verdict": verdict, "effects": list(effects), "candidates": candidates, "where": "joint:3", "gap": GAP}
    found |= {"shape": None, "curves": []}
    return found | {"confirmed": confirmed, "confirmation": None if confirmed is None else TEST}


def test_effects_are_said_in_words_with_their_names() -> None:
    assert effects_in_words(["backlash:2"]) == "gear play, by direction of approach (backlash:2)"
    assert (
        effects_in_words(["transmission_ripple:2[k=6]"]) == "gear ripple, k times per turn (transmission_ripple:2[k=6])"
    )
    assert effects_in_words(["of_a_plugin:1"]) == "of_a_plugin:1"
    three = [f"backlash:{j}" for j in (3, 1, 2)]
    assert effects_in_words(three) == "gear play, by direction of approach (backlash of joints 1 to 3)"


@pytest.mark.parametrize(
    ("data", "first", "command"),
    [
        (said("none"), "Nothing is missing", "identify arm.toml data.csv --out calibrated.toml"),
        (said("named", "backlash:2", confirmed=True), "Missing from the model: gear play", "--out extended.toml"),
        (said("named", "backlash:2"), "Missing from the model: gear play", "--holdout other.csv"),
        (said("named", "backlash:2", confirmed=False), "Not confirmed on rows that no fit has seen. Missing", ""),
        (said("ambiguous", "backlash:2", "axes_skew", sets=2), "2 explanations fit", "discriminate arm.toml data.csv"),
        (said("unknown"), "Something that the library does not have is missing, at joint 3.", ""),
        (said("unknown", "backlash:2"), "Something that the library does not have is missing, at joint 3. Beside", ""),
    ],
)
def test_a_verdict_comes_with_what_follows_from_it(data: dict[str, Any], first: str, command: str) -> None:
    *verdict, gap = diagnosis_verdict(data)
    assert " ".join(verdict).startswith(first)
    assert len(verdict[0].split()) <= 15
    figures = "0.500 to 0.125 mm" if data["confirmation"] is None else "0.600 to 0.250 mm; 0.200 mm were predicted"
    figures = "leaves 0.125 mm RMS of the data" if data["verdict"] == "none" else figures
    assert figures in gap
    assert command in diagnosis_actions(data)[0].command
    if data["confirmed"] is False:
        assert not any("compensate" in action.command for action in diagnosis_actions(data))


def test_many_effects_are_counted() -> None:
    kinds = ("axes_skew", "base_drift", "base_step", "gear_ratio:1", "gear_ratio:2", "joint_step:1", "link_step:1")
    (verdict, which, _) = diagnosis_verdict(said("named", *kinds))
    assert verdict == "Missing from the model: 7 effects."
    assert "gear ratio in the controller is wrong (gear_ratio:1, gear_ratio:2); and 2 more." in which


def test_what_curves_describe_has_a_size_and_no_cause() -> None:
    curves = [{"joint": j, "shape": f"smooth curve {j}"} for j in (3, 1)]
    data = said("unknown") | {"curves": curves[:1], "shape": "smooth curve 3"}
    assert diagnosis_verdict(data)[1] == "An error curve of joint 3 describes it; its cause is open."
    two = said("unknown", "backlash:2") | {"curves": curves, "shape": "smooth curve 3"}
    assert diagnosis_verdict(two)[1:3] == [
        "Error curves of joints 1 and 3 describe it; its cause is open.",
        "Beside it: gear play, by direction of approach (backlash:2).",
    ]
    meanwhile = "Look for a cause at joint 3; the error curves, within the angles measured, may be used meanwhile."
    assert diagnosis_actions(data)[0].text == meanwhile
    elsewhere = two | {"curves": curves[1:]}
    assert diagnosis_actions(elsewhere)[0].text.endswith("; the named part may be used meanwhile.")
    assert diagnosis_actions(said("unknown"))[0].text == "Look for a cause at joint 3."
    nowhere = said("unknown") | {"where": None}
    assert diagnosis_verdict(nowhere)[0].endswith("is missing, at a place that is not known.")
    assert diagnosis_verdict(elsewhere)[1].startswith("Beside it: ")


def test_a_gain_smaller_than_predicted_is_not_called_wrong() -> None:
    data = said("named", "backlash:2", confirmed=False) | {"confirmation": TEST | {"shrinks": True}}
    assert diagnosis_verdict(data)[0].startswith("Not confirmed as predicted: rows that no fit has seen gain less.")
    assert diagnosis_actions(data)[0].text.endswith("gain less than predicted.")


@pytest.mark.parametrize(("rms", "word"), [(0.31, "no better than"), (0.27, "no better beyond chance than")])
def test_a_model_no_better_than_the_geometry_is_not_offered(rms: float, word: str) -> None:
    """It is said before what was named, and the commands of the robot are to come from the geometry."""
    offered = {"rms_mm": rms, "max_mm": 3.07, "rms_geometry_mm": 0.275, "max_geometry_mm": 1.81, "better": False}
    data = said("named", "backlash:2") | {"offered": offered}
    first = diagnosis_verdict(data)[0]
    assert first.startswith(f"This model predicts {word} the geometry alone: {rms:g}")
    assert "(largest 3.07) against" in first
    commands = [action.command for action in diagnosis_actions(data, written=Path("extended.toml"))]
    assert commands[0] == "armcal identify arm.toml data.csv --out calibrated.toml"
    assert commands[1].startswith("armcal compensate calibrated.toml ")
    assert not any("extended.toml" in command for command in commands)
    good = diagnosis_actions(data | {"offered": offered | {"better": True}}, written=Path("extended.toml"))
    assert good[-1].command.startswith("armcal compensate extended.toml ")


def test_a_file_that_was_written_is_named_in_what_follows() -> None:
    """No step asks for what has been done, and the commands name the user's own file."""
    data = said("named", confirmed=True)
    kept = [action.command for action in diagnosis_actions(data, "arm.toml", ["data.csv"], Path("mine.toml"))]
    assert not any("--out extended.toml" in command for command in kept)
    assert any("armcal compensate mine.toml" in command for command in kept)
    assert any("--out extended.toml" in action.command for action in diagnosis_actions(data))


@pytest.mark.parametrize("verdict", ["none", "named", "ambiguous", "unknown"])
def test_next_steps_name_every_file_that_was_diagnosed(verdict: str) -> None:
    data = said(verdict, "backlash:2", "gear_ratio:2", sets=2)
    commands = [action.command for action in diagnosis_actions(data, "arm.toml", ["monday.csv", "friday.csv"])]
    reading = [command for command in commands if "monday.csv" in command]
    assert reading
    assert all(" arm.toml monday.csv friday.csv " in f"{command} " for command in reading)
    assert not any(command.startswith("armcal identify") for command in reading)  # which takes one file


@pytest.mark.parametrize(
    ("shrinks", "as_predicted", "confirmed", "sentence"),
    [
        (True, True, True, "The model holds for more.csv (25 rows in 8 independent groups): the gap shrinks."),
        (
            True,
            None,
            True,
            "The error shrinks on rows not fitted (more.csv); 25 rows in 8 independent groups are too few to say "
            "whether by as much as expected.",
        ),
        (
            None,
            None,
            None,
            "The rows are too few to say whether the model holds for more.csv (25 rows in 8 independent groups).",
        ),
        (
            True,
            False,
            False,
            "For more.csv (25 rows in 8 independent groups) the gap shrinks, but by less than predicted.",
        ),
    ],
)
def test_rows_that_no_fit_has_seen(
    shrinks: bool | None, as_predicted: bool | None, confirmed: bool, sentence: str
) -> None:
    test = HELD_OUT | {"shrinks": shrinks, "as_predicted": as_predicted, "confirmed": confirmed}
    assert holds_in_words(test) == sentence
    other = holds_in_words(test | {"file": None, "by": "cross-validation"})
    assert "another session" in other
    assert "cross-validated" in other


def candidate(named: dict[str, EffectSpec], *parameters: str) -> Candidate:
    estimates = tuple(Estimate(name, "deg", 0.03, 0.01, 0.01, 0.05) for name in parameters)
    return Candidate(tuple(named), (), tuple(named.values()), NOTHING, estimates)


def test_the_number_of_periods_is_part_of_the_name_of_the_effect() -> None:
    six, seven = (EffectSpec("transmission_ripple", 2, MappingProxyType({"k": k})) for k in (6.0, 7.0))
    play, figures = {"backlash:1": EffectSpec("backlash", 1)}, ["0.0300", "0.0100", "0.0500", "deg"]

    one = candidate({f"{RIPPLE}[k=6]": six}, f"{RIPPLE}.a")
    assert (one.title, one.keys) == (f"{RIPPLE}[k=6]", (RIPPLE,))
    assert one.to_json()["settings"] == {f"{RIPPLE}.k": 6.0}
    assert estimate_rows(one.to_json())[1] == [[f"{RIPPLE}[k=6].a", *figures]]

    beside = candidate(play | {f"{RIPPLE}[k=6]": six}, "backlash:1.b", f"{RIPPLE}.a")
    assert beside.title == f"backlash:1 + {RIPPLE}[k=6]"
    assert estimate_rows(beside.to_json())[1] == [["backlash:1.b", *figures], [f"{RIPPLE}[k=6].a", *figures]]

    # two at one joint: parameters and settings carry the label, too
    two = candidate({f"{RIPPLE}[k=6]": six, f"{RIPPLE}[k=7]": seven}, f"{RIPPLE}[k=6].a", f"{RIPPLE}[k=7].a")
    assert two.to_json()["settings"] == {f"{RIPPLE}[k=6].k": 6.0, f"{RIPPLE}[k=7].k": 7.0}
    assert estimate_rows(two.to_json())[1] == [[f"{RIPPLE}[k=6].a", *figures], [f"{RIPPLE}[k=7].a", *figures]]


def test_sizes_that_are_excluded_are_grouped_by_kind_the_largest_at_the_tip_first() -> None:
    sizes = {
        "backlash:1": (0.02, "deg", 0.05),
        "backlash:2": (0.003, "deg", 0.02),
        "backlash:4": (0.04, "deg", 0.04),
        "base_drift": (0.2, "mm/session", 0.06),
        "gear_ratio:1": (None, "1", None),
        "gear_ratio:2": (1e-4, "1", 0.01),
        "transmission_ripple:1[any k]": (0.11, "mm", 0.11),
        "transmission_ripple:1": (0.01, "deg", 0.03),
    }
    keys = ("value", "unit", "tip_mm")
    excluded = {name: dict(zip(keys, size, strict=True)) for name, size in sizes.items()}
    assert excluded_by_kind({"excluded": excluded}) == [
        ["gear_ratio", "1 and 2", "0.0001 to invisible", "any"],
        ["transmission_ripple[any k]", "1", "0.11 mm", "0.110"],
        ["base_drift", "–", "0.2 mm/session", "0.060"],
        ["backlash", "1, 2 and 4", "0.003 to 0.04 deg", "0.050"],
        ["transmission_ripple", "1", "0.01 deg", "0.030"],
    ]


def test_shapes_of_curves_are_said_in_short() -> None:
    waves = [{"order": order, "share": share} for order, share in ((11.0, 0.5), (14.0, 0.25), (2.0, 0.125))]
    curve = {"joint": 2, "angle_deg": [-10.0, 0.0, 10.0], "error_deg": [0.03] * 3, "std_deg": [0.01] * 3}
    said = "waves: 11 per turn, 0.02 deg; 14 per turn, 0.01 deg; 2 per turn, 0.01 deg (88 %) over -10 to 10 deg"
    curves = [curve | {"shape": said, "waves": waves}, curve | {"shape": "smooth curve over 1 to 2 deg", "waves": []}]
    (section,) = curve_sections({"curves": curves})
    table = section.parts[0]
    assert isinstance(table, Sheet)
    assert [row[-1] for row in table.rows] == ["waves 11, 14, 2 (88 %)", "smooth curve"]


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


def test_what_is_named_stands_in_the_tables_of_a_notebook() -> None:
    found = diagnosed(2e-3)
    assert found.effects == ("backlash:2",)
    page, data = found._repr_html_(), found.to_json()
    assert "<pre" not in page
    assert "<img" not in page
    sets, estimates, gap = tables(page)[:3]
    assert gap[1][:4] == ["the data", "40", *(f"{data['gap'][f'rms_{k}_mm']:.4f}" for k in ("before", "after"))]
    assert [row[0] for row in gap[2:]] == [f"cross-validated: {test['transfer']}" for test in data["cross_validation"]]
    assert sets[1] == ["backlash:2", f"{found.named.probability:.2f}", "0.0", f"{found.named.f:.1f}"]
    (name, value, low, high, unit) = estimates[1]
    assert (name, unit) == ("backlash:2.b", "deg")
    assert float(low) < float(value) < float(high)
    (estimate,) = data["named"]["parameters"]
    assert abs(float(value) - np.degrees(2e-3)) < 5.0 * estimate["std"]
    assert page.index("<details>") > page.index("</table>")


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
    fold = page[page.index("What these postures can and cannot show, effect by effect") :]
    assert [row[0] for row in tables(fold)[0][1:]] == list(found.excluded)


def test_rows_that_are_too_few_get_a_sentence() -> None:
    """The table says `too few rows`: below it stands what that means, whatever else is said of the row."""
    data = diagnosed(2e-3).to_json()
    test = data["cross_validation"][0] | {"confirmed": None, "shrinks": None, "refitted": []}
    text = str(gap_section(data | {"cross_validation": [test]}).parts)
    assert "The rows are too few to say whether the model holds for other postures" in text


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
        ((1, 2, 3), (), "no effect in the library fits; error curves of joints 1 to 3 describe the errors"),
        ((1,), ("backlash:2",), "error curves of joint 1 + backlash:2 describe the errors"),
    ],
)
def test_curves_describe_what_has_no_name(joints: tuple[int, ...], others: tuple[str, ...], words: str) -> None:
    curves = [SimpleNamespace(joint=j, shape=f"waves of joint {j}") for j in joints]
    given = {"verdict": "unknown", "where": "joint:1", "shape": "waves of joint 1", "candidates": ()}
    found = cast(Diagnosis, SimpleNamespace(effects=others, curves=curves, confirmed=False, offered=None, **given))
    assert headline(found) == f"not confirmed: cause unknown (joint 1 first): {words}"


def test_a_probability_says_what_it_is_among() -> None:
    def said(effects: tuple[str, ...], shapes: tuple[str, ...], *confirmed: bool | None) -> str:
        tests, known = [SimpleNamespace(confirmed=one) for one in confirmed], {"none": 0.2, "ripple": 0.8}
        given = {"candidates": (), "probability": known, "other_sets": {}}
        found = SimpleNamespace(effects=effects, shapes=shapes, tests=tests, **given)
        return likely(cast(Diagnosis, found)).removesuffix(": none 0.20, ripple 0.80")

    assert said(("ripple",), (), True) == said(("ripple",), (), None, True) == said((), (), None) == "probability"
    assert said(("ripple",), ("k",), True) == "probability (among the library's shapes, whatever makes them)"
    assert said(("ripple",), (), None, None) == "probability (too few rows to confirm it on others)"
