"""Verdicts in words, and what to do next, from the JSON objects of the commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from doe.report.verdict import (
    design_verdict,
    diagnosis_actions,
    diagnosis_verdict,
    effects_in_words,
    identification_actions,
    identification_verdict,
    next_steps,
    validation_actions,
    validation_verdict,
)

GAP = {"rms_before_mm": 0.5, "rms_after_mm": 0.125}
TEST = {"rows": 30, "before_mm": 0.6, "after_mm": 0.25, "predicted_mm": 0.2}


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


def test_the_other_commands_in_a_sentence_each() -> None:
    design = {"runs": 20, "criterion": "D", "efficiency": 0.98765, "certified_optimal": False}
    assert design_verdict(design) == "The plan of 20 runs has the efficiency 0.9877 (D)."
    assert "no known bound" in design_verdict(design | {"efficiency": None})
    error = {"criterion": "I", "efficiency": 0.329, "expected_error_mm": {"plan": 0.158, "bound": 0.0808}}
    runs = "The plan of 20 runs (criterion I) lets expect an error of 0.158 mm at the tip, RMS over the workspace"
    bound = "bound allows fractions of a run. Judge by the mm."
    error["bound"] = {"value": -9.0, "source": "grid", "rigorous": True, "candidates": 2000}
    least = f"{runs}; no plan from the list of 2,000 postures is below 0.0808 mm. Efficiency"
    assert design_verdict(design | error) == f"{least} 0.3290. Do not expect it near 1: the {bound}"
    assert design_verdict(design | error | {"efficiency": 0.95}) == f"{least} 0.9500. The {bound}"
    assert design_verdict(design | error | {"efficiency": None}) == f"{runs}."
    everywhere = error | {"bound": {"value": -9.0, "source": "continuous", "rigorous": False}}
    assert "; no plan from all postures is below 0.0808 mm (a numerical bound). " in design_verdict(design | everywhere)
    sure = design | {"certified_optimal": True, "optimality": "numerical", "bound": {"source": "continuous"}}
    assert design_verdict(sure).endswith("(D, optimal up to a numerical bound).")
    assert design_verdict(sure | {"optimality": "proven"}).endswith("(D, proven optimal).")
    assert "3.00 to 0.250 mm" in identification_verdict({"rms_before_mm": 3.0, "rms_after_mm": 0.25})
    figures = {"rows": 7, "rms_mm": 0.1, "p95_mm": 0.2, "rms_nominal_mm": 1.0, "refit": "base"}
    assert validation_verdict(figures, "c.toml", "d.csv", seen=True).startswith(
        "On 7 rows of d.csv, which it was fitted to, c.toml takes the RMS error from 1.00 mm (drawing, after "
        "fitting where the arm stands) to 0.100 mm"
    )
    said = identification_verdict({"rms_before_mm": 3.0, "rms_after_mm": 0.25, "rms_drawing_mm": 1.0})
    assert "from 1.00 mm (drawing, after fitting where the arm stands) to 0.250 mm" in said


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


def test_commands_of_next_steps_stand_on_lines_of_their_own() -> None:
    good, poor, refitted = (
        validation_actions(*case, "m.toml", "d.csv") for case in ((True, "base"), (False, "base"), (False, "offsets"))
    )
    assert next_steps(good) == [
        "next: Correct the robot's commands with it:\n      armcal compensate m.toml targets.csv --out commands.csv"
    ]
    assert [action.command for action in poor] == [
        "armcal validate m.toml d.csv --refit offsets",
        "armcal identify m.toml d.csv --only joint_offsets,base",
    ]
    assert refitted == poor[1:]
    for case, others in (((True, "base"), good), ((False, "base"), poor), ((False, "offsets"), refitted)):
        first, *rest = validation_actions(*case, "m.toml", "d.csv", beyond=True)
        assert "--library-prior" in first.command
        assert rest == others


@pytest.mark.parametrize("verdict", ["none", "named", "ambiguous", "unknown"])
def test_next_steps_name_every_file_that_was_diagnosed(verdict: str) -> None:
    data = said(verdict, "backlash:2", "gear_ratio:2", sets=2)
    commands = [action.command for action in diagnosis_actions(data, "arm.toml", ["monday.csv", "friday.csv"])]
    reading = [command for command in commands if "monday.csv" in command]
    assert reading
    assert all(" arm.toml monday.csv friday.csv " in f"{command} " for command in reading)
    assert not any(command.startswith("armcal identify") for command in reading)  # which takes one file


def test_after_an_identification() -> None:
    first = identification_actions("a.toml", "d.csv", None, diagnosed=False)
    assert first[0].text.endswith("add --out calibrated.toml to this command.")
    assert first[1].command.startswith("armcal diagnose a.toml d.csv")
    kept = identification_actions("a.toml", "d.csv", Path("mine.toml"), diagnosed=True)
    assert [action.command.split()[:3] for action in kept] == [
        ["armcal", "validate", "mine.toml"],
        ["armcal", "compensate", "mine.toml"],
    ]
