"""The blind study: scoring by hand, the tasks' bookkeeping, and a reduced form of the study itself.

The bars are the targets of the study, where a Bayes classifier (tests/benchmarks/test_ceiling.py) misses them its
figures less 0.03: a share p of the sets or more is right. Of n sets a rule as good as its bar has a binomial number
right; fewer than the limits below happen once in 10,000 cases. By default three sets of each of three cells, judged
together; a hundred of each of some by `pytest -m slow tests/doe/studies/blind`; the full study is `armcal study blind`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
from click.testing import CliRunner
from scipy.stats import binom

from doe.cli.study import command
from doe.jobs import frame_of
from doe.report.studies import blind_parts, blind_pictures, confusion_matrix
from doe.studies.blind import cells
from doe.studies.blind import study as blind
from doe.studies.blind.cells import TABLE
from doe.studies.blind.study import (
    KEEPS,
    BlindStudy,
    blind_study,
    calibration,
    contradictions,
    gap,
    outcome_of,
    reliability,
    scored_table,
    share_inside_tip,
)
from identification.arm import Calibration
from identification.gap.fit import fitted_arm
from identification.model import Model

FAIL = 1e-4
MEASURES = ("alarm", "exact", "class", "in the set", "located", "outliers listed", "next_2 right", "next_8 right")
BARS = {
    (cell, measure): float(value)
    for cell, bars in TABLE["bars"].items()
    for measure, _, value in (bar.rsplit(maxsplit=2) for bar in bars)
    if measure in MEASURES
}
SLOW = ("none, joint noise", "none, reach noise", "one, lambda 8, m=50", "two, lambda 8", "outside, lambda 7")
SLOW += (
    "none m=50",
    "three outliers, lambda 8",
    "space, none, m=60",
    "space, lambda 8, m=60",
    "space, lambda 8, m=200",
)
IN_EVERY_RUN = ("none m=50", "one, lambda 8, m=50", "outside, lambda 7")
SETS = 3  # of each of them


def fewest(counts: Sequence[int], bars: Sequence[float], chance: float = FAIL) -> int:
    """The smallest number right that a rule with a share `bars` of each `counts` right misses with at most this chance.

    The number right is a sum of independent binomial numbers: its distribution is the convolution of theirs.
    """
    parts = [binom.pmf(np.arange(count + 1), count, bar) for count, bar in zip(counts, bars, strict=True)]
    return int(np.searchsorted(np.cumsum(reduce(np.convolve, parts)), chance))


def check(found: BlindStudy, *places: tuple[str, str]) -> None:
    """Fails where fewer sets are right than a rule as good as the bars would get (alarms: wrong)."""
    rights, counts, bars = [], [], []
    for cell, measure in places:
        (row,) = found.tables["cells"].filter(cell=cell, measure=measure).iter_rows(named=True)
        share, bar = row["value"], BARS[cell, measure]
        share, bar = (1.0 - share, 1.0 - bar) if measure == "alarm" else (share, bar)
        rights.append(round(share * row["count"]))
        counts.append(row["count"])
        bars.append(bar)
    assert sum(rights) >= fewest(counts, bars), f"{places}: {rights} of {counts} right, bars {bars}"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[BlindStudy, Path]:
    """A study of few sets, and its folder."""
    folder = tmp_path_factory.mktemp("blind") / "study"
    return blind_study(IN_EVERY_RUN, SETS, folder), folder


def test_limits_are_those_of_the_binomial_distribution() -> None:
    """Of 10 sets with bar 0.95: P(5 or fewer) = 6.4e-5 fails, P(6) = 1e-3 does not; P(7 or fewer) = 0.0115."""
    assert (fewest([10], [0.95]), fewest([10], [0.95], 0.02)) == (6, 8)
    assert (fewest([4, 6], [0.95, 0.95]), fewest([10], [1.0])) == (6, 10)


# -- the study in reduced form -----------------------------------------------------------------------------------------
def test_the_bars_of_few_sets(small: tuple[BlindStudy, Path]) -> None:
    found, _ = small
    none, one, outside = IN_EVERY_RUN
    check(found, (none, "alarm"), (one, "exact"), (outside, "located"))
    check(found, (one, "class"))
    check(found, (one, "in the set"))
    row = found.tables["cells"].filter(cell=one, measure="gap / true").row(0, named=True)
    assert row["value"] <= 1.05 + 4.0 * row["standard_error"]


@pytest.mark.slow
@pytest.mark.parametrize("cell", [*SLOW, blind.AMBIGUOUS])
def test_the_bars_of_a_cell(cell: str) -> None:
    """About a third of the ambiguous sets of a hundred are measured further."""
    found = blind_study([cell], 100)
    for place in BARS:
        if place[0] == cell:
            check(found, place)
    if cell == blind.AMBIGUOUS:
        assert found.value(cell, "next_8 predicted") > found.value(cell, "next_2 predicted")


def test_named_cells_by_the_command_line(tmp_path: Path) -> None:
    """A set of a cell that the full study leaves out."""
    cell = "outside, warm_offset"
    options = ["blind", "--cell", cell, "--replications", "1", "--workers", "1", "--out", str(tmp_path / "few")]
    done = CliRunner().invoke(command, options)
    assert done.exit_code == 0, done.output
    found = polars.read_parquet(tmp_path / "few" / "cells.parquet")
    assert {"error / geometry", "inside tip intervals"} <= set(found.filter(cell=cell)["measure"])


def test_the_study_in_space_of_few_sets(tmp_path: Path) -> None:
    """Two sets with a hidden effect and one without: all wrong once in 100 cases; judged as those in the plane."""
    cells = ("space, none, m=60", "space, lambda 8, m=60")
    found = [blind_study([cell], count, tmp_path / str(count)) for count, cell in enumerate(cells, 1)]
    for one, (cell, measure) in zip(found, zip(cells, ("alarm", "exact"), strict=True), strict=True):
        check(one, (cell, measure))
    assert found[1].sets["hidden"].n_unique() == 2
    assert found[1].value(cells[1], "gap / true") < 1.3  # of 28 parameters from 180 equations, 200 rows
    assert len(blind_parts(found[1])) >= 2


def test_an_ambiguous_set_is_measured_further(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of them, here the first to be tried. More postures tell its candidates apart better."""
    monkeypatch.setattr(blind, "FURTHER_RUNS", (2, 8))
    key = {"cell": blind.AMBIGUOUS, "sets": 1, "seed": 0}
    rows = (blind.examine({**key, "first": number}, np.random.SeedSequence(0))[0] for number in (32, *range(200)))
    row = next(row for row in rows if row["verdict"] == "ambiguous")
    assert {f"next_{runs}_{name}" for runs in (2, 8) for name in ("verdict", "named")} <= row.keys()
    assert 0.0 <= row["next_2_chance"] <= row["next_8_chance"] <= 1.0


# -- bookkeeping -------------------------------------------------------------------------------------------------------
PLACE = {"cell": "two, lambda 8", "set": 0, "status": "done"}
NOT_HIDDEN = PLACE | {"hidden": [], "place": None, "wrong_rows": [], "gap_true_mm": None}
NOT_SAID = PLACE | {"verdict": "none", "named": [], "candidates": [], "where": None, "outlier_rows": []}
NOT_SAID["gap_named_mm"] = None


def scored(hidden: dict, said: dict) -> tuple[BlindStudy, dict[str, float]]:
    """The score of one data set, and its figures."""
    found = scored_table(frame_of([NOT_HIDDEN | hidden]), frame_of([NOT_SAID | said]))
    return found, {row["measure"]: row["value"] for row in found.tables["cells"].iter_rows(named=True)}


TWO = ["backlash:2", "joint_compliance:1"]


@pytest.mark.parametrize(
    ("hidden", "said", "expected"),
    [
        (  # the right name in an ambiguous set
            {"hidden": TWO, "gap_true_mm": 0.2},
            {"verdict": "ambiguous", "named": TWO[::-1], "gap_named_mm": 0.3}
            | {"candidates": [" + ".join(TWO), "backlash:2 + link_bending"]},
            {"alarm": 1.0, "exact": 1.0, "class": 1.0, "in the set": 1.0, "size of the set": 2.0, "gap / true": 1.5},
        ),
        (  # a look-alike is of the right class only
            {"hidden": ["link_bending"]},
            {"verdict": "named", "named": ["gravity_backlash:3"], "candidates": ["gravity_backlash:3"]},
            {"exact": 0.0, "class": 1.0, "in the set": 0.0},
        ),
        (  # a name beside an unknown is wrong
            {"hidden": ["backlash:1"]},
            {"verdict": "unknown", "named": ["backlash:1"], "where": "joint:2"},
            {"exact": 0.0, "class": 0.0},
        ),
        *(  # an effect outside the library must be located
            (
                {"outside": "cross_talk", "place": "joint:2 or joint:3"},
                {"verdict": "unknown", "where": where},
                {"alarm": 1.0, "located": right, "wrong place": 1.0 - right, "no effect": 0.0, "named at 0.9": 0.0},
            )
            for where, right in (("joint:2", 1.0), ("joint:3", 1.0), ("joint:1", 0.0))
        ),
        *(  # every outlier must be listed
            ({"wrong_rows": [3, 7, 9]}, {"outlier_rows": listed}, {"outliers listed": right})
            for listed, right in (([3, 7, 9, 11], 1.0), ([3, 7], 0.0))
        ),
        (  # many are counted one by one: two of three named, one that is not there; two of four intervals hold
            {"hidden": ["backlash:2", "base_offset", "gear_ratio:1"], "error_true_mm": 0.02, "gap_true_mm": 0.1}
            | {"parameters": ["length_error:1", "joint_offset:1", "backlash:2.b", "base_offset.x0", "gear_ratio:1.e"]}
            | {"values": [1.0, 0.1, 3e-4, 2.0, 1e-4]},
            {"verdict": "unknown", "named": ["backlash:2", "base_offset", "backlash:1"], "where": "time"}
            | {"error_named_mm": 0.04, "gap_named_mm": 0.12, "low_95": [0.9, 0.2, 2e-4, 2.1, 0.0]}
            | {"interval_of": ["length_error:1", "joint_offset:1", "backlash:2.b", "base_offset.x0", "backlash:1.b"]}
            | {"high_95": [1.1, 0.3, 4e-4, 2.2, 1.0]},
            {"error / true": 2.0, "effects named": 2 / 3, "false names": 1.0, "intervals, all": 0.5}
            | {"false unknown": 1.0, "intervals, base": 0.5},
        ),
        (  # those of effects count where the name is right
            {"hidden": ["a"], "parameters": ["length_error:1", "joint_offset:1", "a.b"], "values": [1.0, 0.0, 3.0]},
            {"verdict": "named", "named": ["a"], "interval_of": ["length_error:1", "joint_offset:1", "a.b", "c.x"]}
            | {"low_95": [0.5, 0.5, 2.0, 0.0], "high_95": [1.5, 1.5, 4.0, 1.0]},
            {"intervals, base": 0.5, "intervals, effects": 1.0},
        ),
    ],
)
def test_what_counts_as_right(hidden: dict, said: dict, expected: dict[str, float]) -> None:
    found, figures = scored(hidden, said)
    assert {name: figures[name] for name in expected} == pytest.approx(expected)
    if said.get("where") == "joint:2" and not hidden.get("outside"):
        assert found.tables["confusion"].row(0) == ("backlash", "backlash + unknown", 1)


@pytest.mark.parametrize(
    ("place", "named", "wrong"),
    [
        ("joint:2", ["gear_ratio:2"], 0.0),
        ("joint:2", ["gear_ratio:2", "base_drift"], 1.0),
        ("time", ["joint_step:1"], 0.0),
        ("time", ["base_drift"], 0.0),
        ("time", ["thermal_growth"], 1.0),
        ("temperature or time", ["thermal_growth"], 0.0),
        ("workspace", ["axes_skew"], 0.0),
        ("workspace", ["joint_compliance"], 1.0),
        (None, ["gear_ratio:2"], None),
    ],
)
def test_a_name_outside_the_library_is_at_a_place(place: str | None, named: list[str], wrong: float | None) -> None:
    """Where no place is right none is asked for, but a name with .9 is counted, and `none` is."""
    said = {"verdict": "named", "named": named, "candidates": named, "probability": 0.95}
    _, found = scored({"outside": "refraction", "place": place}, said)
    assert found.get("wrong place") == wrong
    assert (found["no effect"], found["named at 0.9"]) == (0.0, 1.0)
    _, nothing = scored({"outside": "refraction", "place": place}, {})
    assert (nothing["no effect"], nothing["named at 0.9"], nothing.get("located")) == (1.0, 0.0, place and 0.0)


@pytest.mark.parametrize(
    ("hidden", "said", "right"),
    [
        ({}, {"verdict": "none"}, True),
        ({}, {"verdict": "named", "named": ["backlash:1"]}, False),
        ({"hidden": ["b", "a"]}, {"verdict": "ambiguous", "named": ["a", "b"]}, True),
        ({"hidden": ["b", "a"]}, {"verdict": "named", "named": ["a"]}, False),
        ({"hidden": ["a"]}, {"verdict": "none"}, False),
        ({"hidden": ["a"]}, {"verdict": "unknown", "named": ["a"]}, False),
        ({"outside": "bump"}, {"verdict": "unknown", "named": []}, True),
        ({"outside": "bump"}, {"verdict": "named", "named": ["a"]}, False),
    ],
)
def test_what_is_said_with_a_probability(hidden: dict, said: dict, right: bool) -> None:
    _, found = scored(hidden, said | {"probability": 0.8, "credible_set": ["a", "a + b"]})
    assert (found["said"], found["right"]) == (0.8, right)
    if "hidden" in hidden:
        assert (found["in the 90 % set"], found["size of the 90 % set"]) == (True, 2)


def test_calibration_error_by_hand() -> None:
    """Of four sets said with 0.8 three are right, one said with 0.98 is: 4/5 |0.8 - 0.75| + 1/5 |0.98 - 1|."""
    sets: list[dict[str, Any]] = [{"said": 0.8, "right": k > 0} for k in range(4)] + [{"said": 0.98, "right": True}]
    found = {row["measure"]: row for row in calibration(sets)}
    assert found["calibration error"]["value"] == pytest.approx(0.8 * 0.05 + 0.2 * 0.02)
    middle = found["said less right, 0.7 to 0.95"]
    assert (middle["value"], middle["count"]) == (pytest.approx(0.05), 4)
    assert middle["standard_error"] == pytest.approx(np.sqrt(0.75 * 0.25 / 4))
    assert [row["count"] for row in reliability(sets)] == [4, 1]
    assert reliability([{"said": 1.0, "right": True}])[0]["count"] == 1
    assert list(calibration([{"alarm": True}])) == []


def test_the_written_model_is_compared_with_others() -> None:
    """Errors of four sets by hand: the ratio to geometry's as a median, the others as means; one of the two that are
    confirmed keeps more than three times what can be reached."""
    errors, confirmed = [0.01, 0.02, 0.04, 0.9], [True, False, True, None]
    truth = NOT_HIDDEN | {"outside": "cross_talk", "place": "joint:1", "error_geometry_mm": 0.1}
    truth["error_reachable_mm"] = 0.01
    said = NOT_SAID | {"verdict": "unknown", "gap_named_mm": 0.2, "gap_promised_mm": 0.18, "contradictions": []}
    rows = [
        said | {"set": k, "error_named_mm": e, "confirmed": sure, "inside_tip": 0.25 * k}
        for k, (e, sure) in enumerate(zip(errors, confirmed, strict=True))
    ]
    cells_of = scored_table(frame_of([truth | {"set": k} for k in range(4)]), frame_of(rows)).tables["cells"]
    expected = {"error / geometry": 0.3, "error / reachable": 97.0 / 4.0, "inside tip intervals": 0.375}
    expected |= {"promised / reached": 0.9, KEEPS: 0.5, "contradiction": 0.0, "located": 0.0, "wrong place": 0.0}
    found = {row["measure"]: row for row in cells_of.iter_rows(named=True)}
    assert {name: found[name]["value"] for name in expected} == pytest.approx(expected)
    # ranks 1 and 3 of 4, halfway between two
    assert found["error / geometry"]["standard_error"] == pytest.approx(0.5 * (4.7 - 0.15))


def test_errors_of_shares_and_outcomes_of_bars() -> None:
    truth = [NOT_HIDDEN | {"set": k, "hidden": ["backlash:1"]} for k in range(4)]
    said = [
        NOT_SAID | {"set": k, "verdict": "named", "named": [name], "candidates": [name]}
        for k, name in enumerate(["backlash:1", "backlash:1", "backlash:1", "gear_ratio:1"])
    ]
    study = scored_table(frame_of(truth), frame_of(said))
    found = {row["measure"]: row for row in study.tables["cells"].iter_rows(named=True)}
    assert found["exact"]["value"] == 0.75
    assert found["exact"]["standard_error"] == pytest.approx(np.sqrt(0.75 * 0.25 / 4))
    assert found["alarm"]["standard_error"] == pytest.approx(np.sqrt(0.25 / 4 / 4))  # not zero, although all alike
    bars = {row["measure"]: (row["asked"], row["outcome"]) for row in study.tables["bars"].iter_rows(named=True)}
    assert bars["exact"] == (">= 0.857", "within its error")
    outcomes = ["met", "within its error", "missed"]
    assert [outcome_of(value, 0.01, ">=", 0.9) for value in (0.9, 0.885, 0.87)] == outcomes
    assert [outcome_of(value, 0.01, "<=", 0.05) for value in (0.05, 0.065, 0.08)] == outcomes
    assert "error / true <= 1.5" in TABLE["bars"]["many effects"]


def test_an_arm_with_the_true_values_has_no_error_and_its_intervals_hold() -> None:
    """What the simulator hides, put into the model: positions agree without noise; the fitted true model is near. Where
    the first length alone is uncertain, by s, its interval at every tip is 1.96 s |cos|, and the tip off by d |cos|:
    all coordinates are inside where d < 1.96 s, none where it is more; with three degrees of freedom 3.18 s."""
    data, s = cells.data_set("many effects", 3), 0.01
    arm = data.arm.with_effects(*data.arm.effects, *data.specs)
    known = replace(arm, calibration=Calibration(data.values))
    assert gap(known, data, data.exact) == pytest.approx(0.0, abs=1e-9)
    fitted = gap(fitted_arm(data.arm, data.measurements, data.specs), data, data.exact)
    assert fitted is not None
    assert 0.0 < fitted < data.arm.sigma
    assert cells.data_set("two, lambda 8", 3).exact is None
    for d, freedom, inside in ((1.9, None, 1.0), (2.0, None, 0.0), (3.1, 3.0, 1.0), (3.3, 3.0, 0.0)):
        values = {**data.values, "length_error:1": data.values["length_error:1"] + d * s}
        origin = {} if freedom is None else {"interval_dof": freedom}
        found = Calibration(values, ("length_error:1",), np.array([[s**2]]), origin)
        assert share_inside_tip(replace(arm, calibration=found), data) == inside
    assert share_inside_tip(known, data) is None  # no covariance


def test_true_values_have_the_names_of_the_librarys_parameters() -> None:
    """Of every effect that the study hides."""
    seen = set()
    for number in range(60):
        data = cells.data_set("one, lambda 20, m=50", number)
        model, rows = Model(data.arm.with_effects(*data.specs)), data.measurements
        assert data.values.keys() == set(model.names)
        seen.add(data.effects[0].partition(":")[0])
        position = model.position(rows.postures, model.parameters.vector(data.values), rows.conditions)
        assert np.std(rows.positions - position) < 1.3 * data.arm.sigma
    assert len(seen) >= 12


@pytest.mark.parametrize(
    ("verdict", "effects", "chances", "doubt"),
    [  # probabilities of nothing, the effect a, the effect b, what is unknown, other sets
        ("none", "", (0.9, 0, 0, 0.1, 0), None),
        ("none", "", (0.4, 0, 0, 0.6, 0), "none less likely than something"),
        ("none", "a", (0.9, 0.1, 0, 0, 0), "none with effects"),
        ("named", "a", (0.1, 0.8, 0, 0.1, 0), None),
        ("named", "a", (0.1, 0.8, 0, 0.2, 0), "probabilities without sum 1"),
        ("named", "a", (0, 0.1, 0, 0.9, 0), "names less likely than none"),
        ("named", "a", (0.6, 0.4, 0, 0, 0), "names less likely than none"),
        ("named", "", (0.3, 0, 0, 0.7, 0), "named nothing"),
        ("named", "a", (0, 0.2, 0.7, 0.1, 0), "named less likely than others"),
        ("named", "a", (0, 0.4, 0.35, 0.25, 0), "named at less than a half"),
        ("ambiguous", "a", (0, 0.5, 0.4, 0.1, 0), None),
        ("ambiguous", "a", (0, 0.9, 0, 0.1, 0), "ambiguous alone"),
        ("unknown", "", (0.2, 0, 0, 0.8, 0), None),
        ("unknown", "", (0.7, 0, 0, 0.3, 0), "unknown less likely than names or none"),
        ("unknown", "a", (0, 0, 0, 0.4, 0.6), "unknown less likely than names or none"),
        ("named", "a", (0.1, 0.8, 0, 0, 0.1), "listed beyond the rest"),
    ],
)
def test_contradictions_between_verdict_and_probabilities(
    verdict: str, effects: str, chances: tuple[float, ...], doubt: str | None
) -> None:
    """Those of the sentence `unknown 1.00 (of that joint_compliance:4 1.00)` and its like, each by one example."""
    names = ("none", "a", "b", "unknown", "other sets")
    stated = {name: p for name, p in zip(names, chances, strict=True) if p or name in ("none", "unknown")}
    listed = [{"effects": ["c"], "probability": 0.3}] if doubt == "listed beyond the rest" else []
    said = {"verdict": verdict, "effects": [*effects], "probabilities": stated, "other_sets": listed}
    found = contradictions(said)
    assert found == [] if doubt is None else doubt in found


def test_the_confusion_matrix_counts_every_set_once() -> None:
    pairs = [("backlash", "backlash", 7), ("backlash", "gravity + backlash", 2), ("backlash", "gravity + unknown", 1)]
    pairs += [("nothing", "nothing", 5), ("backlash + gravity", "gravity", 9)]
    frame = frame_of([{"hidden": a, "named": b, "count": n} for a, b, n in pairs])
    hidden, named, shares, totals = confusion_matrix(frame)
    assert (hidden, totals) == (["backlash", "nothing"], [10, 5])
    assert dict(zip(named, shares[0], strict=True)) == {"backlash": 0.7, "nothing": 0.0, "several": 0.2, "unknown": 0.1}


# -- tasks -------------------------------------------------------------------------------------------------------------
def test_the_diagnoses_table_knows_nothing_of_the_truth(small: tuple[BlindStudy, Path]) -> None:
    _, folder = small
    said = polars.read_parquet(folder / blind.DIAGNOSES)
    assert {"hidden", "outside", "place", "wrong_rows", "gap_true_mm"}.isdisjoint(said.columns)
    truth = polars.read_parquet(folder / blind.TRUTH).filter(cell="outside, lambda 7")
    for row in truth.iter_rows(named=True):  # some of these shapes have become effects of the library
        assert (row["place"] is None) == bool(row["hidden"]) == (row["outside"] is None)


def test_an_interrupted_study_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blind, "BATCH", 1)
    folder = tmp_path / "study"
    first = blind_study(["none m=20"], 1, folder)
    before = polars.read_parquet(folder / blind.DIAGNOSES)
    more = blind_study(["none m=20"], 2, folder, resume=True)
    after = polars.read_parquet(folder / blind.DIAGNOSES)
    assert (len(first.sets), len(more.sets)) == (1, 2)
    assert after.head(1)["seconds"].to_list() == before["seconds"].to_list()  # not done again


def test_the_seed_moves_the_data_and_nothing_else_does() -> None:
    key = {"cell": "two, lambda 8", "first": 3, "sets": 1, "seed": 0}
    one, other = blind.hide(key, np.random.SeedSequence(1)), blind.hide(key, np.random.SeedSequence(2))
    assert json.dumps(one) == json.dumps(other)
    assert blind.hide({**key, "seed": 1}, np.random.SeedSequence(1)) != one


def test_designed_plans_are_shared_by_neighboring_sets() -> None:
    cell = "one, lambda 6, discriminating plan"
    arm, runs = cells.to_be_planned(cell, 0)
    postures = np.random.default_rng(1).uniform(arm.lower, arm.upper, (runs, arm.links))
    one, two = (cells.data_set(cell, seed, postures) for seed in (0, 1))
    np.testing.assert_array_equal(one.arm.lengths, arm.lengths)
    np.testing.assert_array_equal(one.measurements.postures, two.measurements.postures)
    assert one.effects != two.effects or not np.allclose(one.measurements.positions, two.measurements.positions)


def test_tables_and_picture_can_be_made(small: tuple[BlindStudy, Path], tmp_path: Path) -> None:
    found, _ = small
    assert len(blind_parts(found)) >= 3
    blind_pictures(tmp_path, found)
    assert (tmp_path / "confusion.png").stat().st_size > 1000
    assert (tmp_path / "reliability.png").stat().st_size > 1000
