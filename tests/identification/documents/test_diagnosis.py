"""What a person reads of a diagnosis: the verdict, what follows from it, and the tables, by its JSON object."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import Arm, Diagnosis, Measurements, diagnose
from identification.document import Sheet
from identification.documents.diagnosis import (
    curve_table,
    diagnosis_actions,
    diagnosis_verdict,
    effects_in_words,
    findings,
    gap_in_words,
    gap_parts,
    in_common,
    refuted,
)
from identification.effects import library
from tests.identification.estimation.cases import tip

GAP = {"rms_before_mm": 0.5, "rms_after_mm": 0.125}
TEST = {"rows": 30, "before_mm": 0.6, "after_mm": 0.25, "predicted_mm": 0.2}
RIPPLE, PLAY = "transmission_ripple:2", "gear play, by direction of approach (backlash:2)"
LEFT_OUT = {"cross_validation": [{"confirmed": False}]}
LENGTHS = np.array([300.0, 200.0])
SCATTERS = {"where": None, "misfit": {"significant": True}}
LIKELIEST = "The 2 likeliest explanations have a probability of 0.80 together, the first 0.40."
HALF = "Most likely, but with a probability below one half"
PLACE = "Something outside the library is missing, at joint 3."


def said(verdict: str, *effects: str, confirmed: bool | None = None, sets: int = 1) -> dict[str, Any]:
    """The JSON object of a diagnosis, as far as verdict and actions need it."""
    candidates = [{"effects": [name], "probability": 0.8 / max(sets, 2)} for name in effects[:sets]]
    found = {"verdict": verdict, "effects": list(effects), "candidates": candidates, "where": "joint:3", "gap": GAP}
    found |= {"shape": None, "curves": [], "predicting": list(effects), "misfit": None, "warnings": []}
    found |= {"confirmed": confirmed, "cross_validation": []}
    return found | {"confirmation": None if confirmed is None else {**TEST, "confirmed": confirmed}}


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        (["backlash:2"], PLAY),
        (["transmission_ripple:2[k=6]"], "gear ripple, k times per turn (transmission_ripple:2[k=6])"),
        (["of_a_plugin:1"], "of_a_plugin:1"),
        ([*"abcde"], "a; b; c; d; and 1 more kind"),
        ([f"backlash:{j}" for j in (3, 1, 2)], "gear play, by direction of approach (backlash of joints 1 to 3)"),
        (
            [f"transmission_ripple:{j}[k={k}]" for j in (1, 2) for k in (6, 7)],
            "gear ripple, k times per turn (transmission_ripple of joints 1 and 2, 4 in all)",
        ),
        ([f"base_step[at={t}]" for t in range(5)], f"{library()['base_step'].summary} (base_step, 5 in all)"),
    ],
)
def test_effects_are_said_in_words_with_their_names(labels: list[str], words: str) -> None:
    assert effects_in_words(labels) == words


@pytest.mark.parametrize(
    ("data", "first", "command"),
    [
        (said("none") | {"misfit": {"significant": True}}, "The model is incomplete or sigma_mm too small; ", ""),
        (said("none"), "Nothing is missing", "identify arm.toml data.csv --no-library-prior --out calibrated.toml"),
        (said("named", "backlash:2", confirmed=True), f"Missing from the model: {PLAY}", "--out extended.toml"),
        (said("named", "backlash:2"), f"Missing from the model: {PLAY}", "--holdout other.csv"),
        (said("named", "backlash:2", confirmed=False), "Not confirmed on held-out rows. Missing", ""),
        (said("named", "backlash:2") | {"warnings": ["implausible: .."]}, "Missing", "armcal check arm.toml data.csv"),
        (said("none") | {"warnings": ["measured points moved between sessions: .."]}, "Nothing", "armcal diagnose"),
        (said("named", "backlash:2") | LEFT_OUT, "Not confirmed on rows left out in cross-validation.", ""),
        (said("ambiguous", "backlash:2", "axes_skew", sets=2), LIKELIEST, "discriminate arm.toml data.csv"),
        (said("ambiguous", "backlash:2"), f"{HALF}: {PLAY}.", "discriminate arm.toml"),
        (said("unknown"), PLACE, ""),
        (said("unknown") | SCATTERS, "The arm scatters by more than sigma_mm", ""),
        (said("unknown", "backlash:2"), f"{PLACE} In addition, each likelier than not: {PLAY}.", ""),
    ],
)
def test_a_verdict_comes_with_what_follows_from_it(data: dict[str, Any], first: str, command: str) -> None:
    verdict, gap = diagnosis_verdict(data), gap_in_words(data)
    assert " ".join(verdict).startswith(first)
    assert len(verdict[0].split()) <= 16
    figures = "0.500 to 0.125 mm" if data["confirmation"] is None else "0.600 to 0.250 mm; 0.200 mm was predicted"
    figures = "leaves an RMS error of 0.125 mm on the data" if data["verdict"] == "none" else figures
    assert figures in gap
    assert command in diagnosis_actions(data)[0].command
    if refuted(data) or data["warnings"]:
        assert not any("compensate" in action.command for action in diagnosis_actions(data))


def test_scatter_that_has_a_reason_is_not_called_unexplained() -> None:
    data = said("none") | {"misfit": {"significant": True, "ratio": 2.0}, "replication": []}
    shared = {"": ", which nothing here explains", "repeats": ": rows of one posture share an error"}
    for names, reason in {**shared, "repeats time_noise": ""}.items():
        lines = findings(data | {"scatter": [{"finding": name} for name in names.split()]})
        assert lines == [f"The residuals scatter by 2 x sigma_mm{reason}."]


@pytest.mark.parametrize(
    ("rms", "word"), [(0.31, "predicts no better"), (0.27, "does not predict significantly better")]
)
def test_a_model_no_better_than_the_geometry_is_not_offered(rms: float, word: str) -> None:
    """It is said before what was named, and the commands of the robot are to come from what predicts better; within
    chance after other postures have confirmed it."""
    offered = {"rms_mm": rms, "max_mm": 3.07, "rms_geometry_mm": 0.275, "max_geometry_mm": 1.81, "better": False}
    offered |= {"refitted": True}
    data = said("named", "backlash:2") | {"offered": offered}
    first = diagnosis_verdict(data)[0]
    assert first.startswith(f"This model {word} than the geometry alone: {rms:g}")
    assert "(largest 3.07) against" in first
    assert first.endswith("on rows left out of the fit, each with the base refitted.")
    commands = [action.command for action in diagnosis_actions(data, written=Path("extended.toml"))]
    first, model = "diagnose arm.toml data.csv --holdout other.csv", "extended.toml"
    if rms > 0.275:
        first, model = "identify arm.toml data.csv --no-library-prior --out calibrated.toml", "calibrated.toml"
    assert commands[0] == f"armcal {first}"
    assert commands[1].startswith(f"armcal compensate {model} ")
    better = offered | {"rms_mm": 0.2, "better": True}
    good = diagnosis_actions(data | {"offered": better}, written=Path("extended.toml"))
    assert good[-1].command.startswith("armcal compensate extended.toml ")


@pytest.mark.parametrize(
    ("where", "words"), [("joint:3", "at joint 3"), ("time", "in time"), (None, "at an unknown place")]
)
def test_where_something_unknown_is(where: str | None, words: str) -> None:
    assert diagnosis_verdict(said("unknown") | {"where": where})[0].endswith(f"is missing, {words}.")


def test_many_explanations_are_counted_and_the_first_spelt_out() -> None:
    joints = [f"backlash:{j}" for j in range(1, 7)]
    count, spelt = diagnosis_verdict(said("ambiguous", *joints, sets=6))
    assert count == "The 6 likeliest explanations have a probability of 0.80 together, the first 0.13."
    assert "(backlash:4); or 2 more." in spelt
    assert "backlash:5" not in spelt
    sets = [{"effects": ["gear_ratio:1", *more], "probability": 0.4} for more in ([], joints[:1], joints[1:2])]
    _, spelt = diagnosis_verdict(said("ambiguous") | {"candidates": sets})
    shared, _, each = spelt.partition(" Besides: ")
    assert (shared[:17], shared.count("gear_ratio:1"), spelt.count("gear_ratio:1")) == ("In all of them: g", 1, 1)
    assert each.startswith("nothing; or gear play")
    assert each.endswith("(backlash:2).")


def test_the_settings_of_an_effect_do_not_hide_that_all_explanations_have_it() -> None:
    """A real Meca 500: ripples of 49 or 50 per turn at joints 4 and 5 in all ten sets, which shared no label."""
    first = ["transmission_ripple:4[k=49]", "transmission_ripple:5[k=49]"]
    second = ["transmission_ripple:4[k=50]", first[1], "backlash:6"]
    assert in_common([first, second]) == (["transmission_ripple:4", first[1]], [[], ["backlash:6"]])
    twice = ["transmission_ripple:4[k=6]", first[0]]
    assert in_common([twice, first[:1]]) == (["transmission_ripple:4"], [twice[1:], []])


@pytest.mark.parametrize("verdict", ["none", "named", "ambiguous", "unknown"])
def test_next_steps_name_every_file_that_was_diagnosed_or_written(verdict: str) -> None:
    """No step asks for what has been done, and the commands name the user's own file."""
    data = said(verdict, "backlash:2", "gear_ratio:2", sets=2)
    commands = [action.command for action in diagnosis_actions(data, "arm.toml", ["monday.csv", "friday.csv"])]
    reading = [command for command in commands if "monday.csv" in command]
    alone = "armcal identify arm.toml all.csv --no-library-prior --out calibrated.toml"  # diagnose writes what it found
    assert reading or commands[0] == alone
    assert all(" arm.toml monday.csv friday.csv " in f"{command} " for command in reading)
    assert not any(command.startswith("armcal identify") for command in reading)  # which takes one file
    kept = [action.command for action in diagnosis_actions(data, written=Path("mine.toml"))]
    assert not any("--out extended.toml" in command for command in kept)
    assert any("armcal compensate mine.toml" in command for command in kept) == (verdict in ("named", "unknown"))


def test_shapes_of_curves_are_said_in_short() -> None:
    waves = [{"order": order, "share": share} for order, share in ((11.0, 0.5), (14.0, 0.25), (2.0, 0.125))]
    curve = {"joint": 2, "angle_deg": [-10.0, 0.0, 10.0], "error_deg": [0.03] * 3, "std_deg": [0.01] * 3}
    told = "waves: 11 per turn, 0.02 deg; 14 per turn, 0.01 deg; 2 per turn, 0.01 deg (88 %) over -10 to 10 deg"
    curves = [curve | {"shape": told, "waves": waves}, curve | {"shape": "smooth curve over 1 to 2 deg", "waves": []}]
    table = curve_table({"curves": curves})
    assert isinstance(table, Sheet)
    assert [row[-1] for row in table.rows] == ["waves 11, 14, 2 (88 %)", "smooth curve"]


# -- of a whole diagnosis ----------------------------------------------------------------------------------------------
@cache
def diagnosed(play: float) -> Diagnosis:
    """Two links by hand; joint 2 has play, by the side from which it comes."""
    generator = np.random.default_rng(3)
    q, sides = generator.uniform(-1.5, 1.5, (40, 2)), np.sign(generator.normal(size=(40, 2)))
    seen = tip(q + play * sides * [0.0, 1.0], LENGTHS)
    measured = Measurements(q, seen + generator.normal(0.0, 0.02, (40, 2)), directions=sides)
    return diagnose(Arm(LENGTHS, sigma=0.02), measured)


HELD_OUT = {"transfer": "another session", "file": "more.csv", "by": "holdout", "groups": 8, "refitted": []} | TEST
WHERE = "more.csv (30 rows in 8 independent groups)"


@pytest.mark.parametrize(
    ("shrinks", "as_predicted", "confirmed", "answer", "sentence"),
    [
        (True, True, True, "yes", f"The model holds for {WHERE}: the gap shrinks."),
        (
            *(True, None, True, "shrinks"),
            "The error shrinks on rows not fitted (more.csv), to 0.2500 mm, where 0.2000 mm was expected; 30 rows in 8 "
            "independent groups are too few to say whether the difference is chance.",
        ),
        (None, None, None, "open", f"These rows do not show whether the model holds for {WHERE}."),
        (True, False, False, "no", f"For {WHERE} the gap shrinks, but by less than predicted."),
        (False, True, False, "no", f"The model does not hold for {WHERE}: the gap does not shrink."),
    ],
)
def test_rows_that_no_fit_has_seen(
    shrinks: bool | None, as_predicted: bool | None, confirmed: bool | None, answer: str, sentence: str
) -> None:
    test = HELD_OUT | {"shrinks": shrinks, "as_predicted": as_predicted, "confirmed": confirmed}
    data = diagnosed(2e-3).to_json() | {"cross_validation": [], "outlier_rows": [3, 17]}
    table, _, told, *others = gap_parts(data | {"confirmation": test})
    assert "Rows left out as outliers: 3, 17." in others
    through = "Rows left out as outliers, counted through the files: 3, 17."
    assert through in gap_parts(data | {"files": ("arm.toml", "one.csv", "other.csv")})
    assert isinstance(table, Sheet)
    # of N numbers a fit of p parameters leaves sqrt(1 - p / N) of the noise, sigma sqrt(2) = 0.0283 mm
    assert [table.rows[0][k] for k in (0, 1, 4)] == ["the data", "38 of 40", "< 0.0283"]
    assert ([row[-1] for row in table.rows], told) == (["", answer], sentence)
    close = gap_parts(data | {"gap": data["gap"] | {"noise_floor_from": "close_repeats"}, "confirmation": test})
    assert ("< 0.0283" in str(close[0]), "0.0283 mm in repeats close in time and more" in str(close)) == (False, True)
    other = test | {"file": None, "by": "cross-validation", "refitted": ["base"]}
    told = str(gap_parts(data | {"confirmation": other})[2])
    assert all(words in told for words in ("another session", "cross-validated", "for both models: base"))
    assert len(gap_parts(data | {"confirmation": None})) < len(gap_parts(data | {"confirmation": test}))
