"""The blind study: scoring by hand, the tasks' bookkeeping, and a study of two sets of each of three cells, whose bars
no more than two standard errors may miss; the full study is `armcal study blind`."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import polars
import pytest
from click.testing import CliRunner

from doe.cli import main
from doe.jobs import frame_of
from doe.studies.blind import cells
from doe.studies.blind import study as blind
from doe.studies.blind.cells import TABLE
from doe.studies.blind.study import (
    KEEPS,
    blind_parts,
    blind_study,
    calibration,
    contradictions,
    gap,
    inside_tip,
    reliability,
    scored,
)
from identification import Calibration, fitted_arm

NONE, ONE, BEYOND = "none m=20", "one, lambda 8, m=50", "outside, lambda 7"


# -- the study in reduced form -----------------------------------------------------------------------------------------
@pytest.fixture(scope="module", autouse=True)
def one_set_in_a_task() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blind, "BATCH", 1)
        yield


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of few sets."""
    folder = tmp_path_factory.mktemp("blind") / "study"
    named = [word for cell in (NONE, ONE, BEYOND) for word in ("--cell", cell)]
    options = ["blind", *named, "--replications", "1", "--workers", "1", "--out", str(folder)]
    done = CliRunner().invoke(main.commands["study"], options)
    assert done.exit_code == 0, done.output
    assert "3 blind data sets" in done.output
    return folder


def test_the_bars_of_few_sets(small: Path) -> None:
    bars = polars.read_parquet(small / "bars.parquet").filter(polars.col("cell") != "all sets")
    assert {*bars["measure"]} >= {"alarm", "exact", "class", "in the set", "gap / true", "located"}
    assert bars.filter(outcome="missed").is_empty()
    rows = polars.read_parquet(small / "sets.parquet").filter(cell=BEYOND)
    for row in rows.iter_rows(named=True):  # some of these shapes have become effects of the library
        assert (row["place"] is None) == bool(row["hidden"]) == (row["outside"] is None)
    assert (small / "reliability.png").stat().st_size > 1000


def test_an_extended_study_keeps_what_is_done(small: Path, tmp_path: Path) -> None:
    shutil.copytree(small, tmp_path / "study")
    before, more = polars.read_parquet(small / "sets.parquet"), blind_study([NONE], 2, tmp_path / "study", resume=True)
    after = polars.read_parquet(tmp_path / "study" / "sets.parquet")
    assert (len(before), len(after), len(more["sets"])) == (3, 4, 2)
    assert after["seconds"][0] == before["seconds"][0]  # not done again


def test_a_set_in_space() -> None:
    """With a hidden effect; its figures are those of a set in the plane."""
    cell = "space, lambda 8, m=60"
    found = blind_study([cell], 1)
    assert found["bars"].filter(outcome="missed").is_empty()
    (gap_over_true,) = found["cells"].filter(cell=cell, measure="gap / true")["value"]
    assert gap_over_true < 1.3  # of 28 parameters from 180 equations, 200 rows
    assert len(blind_parts(found)) >= 2


def test_an_ambiguous_set_is_measured_further(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the next postures, from the sides that they are chosen for."""
    choose, falling = blind.discriminate, -np.ones((2, 2))
    monkeypatch.setattr(blind, "FURTHER_RUNS", (2,))
    monkeypatch.setattr(blind, "discriminate", lambda *them, **how: replace(choose(*them, **how), directions=falling))
    monkeypatch.setattr(blind, "diagnose", diagnosed := Mock(wraps=blind.diagnose))
    row = blind.examine({"cell": blind.AMBIGUOUS, "sets": 1, "seed": 0, "first": 32}, np.random.SeedSequence(0))[0]
    assert row["verdict"] == "ambiguous"
    assert row["next_2_verdict"] in ("named", "ambiguous", "unknown")
    assert isinstance(row["next_2_named"], list)
    np.testing.assert_array_equal(diagnosed.call_args.args[1].directions[-2:], -1.0)


# -- bookkeeping -------------------------------------------------------------------------------------------------------
ROW: dict[str, Any] = {"cell": "two, lambda 8", "set": 0, "status": "done", "verdict": "none", "contradictions": []}
ROW |= {key: [] for key in ("hidden", "named", "candidates", "credible_set", "wrong_rows", "outlier_rows")}
ROW |= dict.fromkeys(("outside", "place", "where", "probability", "confirmed", "inside_tip"))
ROW |= dict.fromkeys(("parameters", "values", "interval_of", "low_95", "high_95"))
ROW |= dict.fromkeys(f"{name}_mm" for name in ("gap_true", "gap_named", "gap_promised", "error_named"))
ROW |= dict.fromkeys(f"error_{name}_mm" for name in ("true", "geometry", "reachable"))


def figures_of(*rows: dict[str, Any]) -> tuple[dict[str, polars.DataFrame], dict[str, float]]:
    """The score of data sets, and their figures in the cell."""
    found = scored(frame_of([ROW | {"set": k} | row for k, row in enumerate(rows)]))
    cells = found["cells"].filter(cell=ROW["cell"])
    return found, {row["measure"]: row["value"] for row in cells.iter_rows(named=True)}


TWO = ["backlash:2", "joint_compliance:1"]


@pytest.mark.parametrize(
    ("hidden", "said", "expected"),
    [
        (  # the right name in an ambiguous set
            {"hidden": TWO, "gap_true_mm": 0.2},
            {"verdict": "ambiguous", "named": TWO, "gap_named_mm": 0.3}
            | {"candidates": [" + ".join(TWO), "backlash:2 + link_bending"]},
            {"alarm": 1.0, "exact": 1.0, "class": 1.0, "in the set": 1.0, "gap / true": 1.5},
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
                {"alarm": 1.0, "located": right, "wrong place": 1.0 - right, "no effect": 0.0},
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
            {"verdict": "unknown", "named": ["backlash:1", "backlash:2", "base_offset"], "where": "time"}
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
    found, figures = figures_of(hidden | said)
    assert {name: figures[name] for name in expected} == pytest.approx(expected)
    if said.get("where") == "joint:2" and not hidden.get("outside"):
        assert found["confusion"].row(0) == ("backlash", "backlash + unknown", 1)


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
    """Where no place is right none is asked for, but `none` is counted."""
    hidden = {"outside": "refraction", "place": place}
    _, found = figures_of(hidden | {"verdict": "named", "named": named, "candidates": named})
    assert (found.get("wrong place"), found["no effect"]) == (wrong, 0.0)
    _, nothing = figures_of(hidden)
    assert (nothing["no effect"], nothing.get("located")) == (1.0, place and 0.0)


@pytest.mark.parametrize(
    ("hidden", "said", "right"),
    [
        ({}, {"verdict": "none"}, True),
        ({}, {"verdict": "named", "named": ["backlash:1"]}, False),
        ({"hidden": ["a", "b"]}, {"verdict": "ambiguous", "named": ["a", "b"]}, True),
        ({"hidden": ["a", "b"]}, {"verdict": "named", "named": ["a"]}, False),
        ({"hidden": ["a"]}, {"verdict": "none"}, False),
        ({"hidden": ["a"]}, {"verdict": "unknown", "named": ["a"]}, False),
        ({"outside": "bump"}, {"verdict": "unknown", "named": []}, True),
        ({"outside": "bump"}, {"verdict": "named", "named": ["a"]}, False),
    ],
)
def test_what_is_said_with_a_probability(hidden: dict, said: dict, right: bool) -> None:
    _, found = figures_of(hidden | said | {"probability": 0.8, "credible_set": ["a", "a + b"]})
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
    keeps, confirmed = [0.01, 0.02, 0.04, 0.9], [True, False, True, None]
    row = {"outside": "cross_talk", "place": "joint:1", "error_geometry_mm": 0.1, "error_reachable_mm": 0.01}
    row |= {"verdict": "unknown", "gap_named_mm": 0.2, "gap_promised_mm": 0.18}
    pairs = enumerate(zip(keeps, confirmed, strict=True))
    rows = [row | {"error_named_mm": e, "confirmed": sure, "inside_tip": 0.25 * k} for k, (e, sure) in pairs]
    study, found = figures_of(*rows)
    expected = {"error / geometry": 0.3, "inside tip intervals": 0.375, "promised / reached": 0.9, KEEPS: 0.5}
    expected |= {"contradiction": 0.0, "located": 0.0, "wrong place": 0.0}
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    # ranks 1 and 3 of 4, halfway between two
    assert study["cells"].filter(measure="error / geometry")["standard_error"][0] == pytest.approx(0.5 * (4.7 - 0.15))


@pytest.mark.parametrize(("right", "outcome"), [(4, "met"), (3, "within its error"), (1, "missed")])
def test_errors_of_shares_and_outcomes_of_bars(right: int, outcome: str) -> None:
    names = ["backlash:1"] * right + ["gear_ratio:1"] * (4 - right)
    rows = ({"hidden": ["backlash:1"], "verdict": "named", "named": [name], "candidates": [name]} for name in names)
    study, _ = figures_of(*rows)
    figures = {row["measure"]: row for row in study["cells"].iter_rows(named=True)}
    share = right / 4
    assert figures["exact"]["value"] == share
    assert figures["exact"]["standard_error"] == pytest.approx(np.sqrt(max(share * (1.0 - share), 0.25 / 4) / 4))
    assert figures["alarm"]["standard_error"] == pytest.approx(np.sqrt(0.25 / 4 / 4))  # not zero, although all alike
    bars = {row["measure"]: (row["asked"], row["outcome"]) for row in study["bars"].iter_rows(named=True)}
    assert bars["exact"] == (">= 0.857", outcome)


@pytest.mark.parametrize(("mean", "outcome"), [(1.59, "met"), (1.75, "within its error"), (1.85, "missed")])
def test_a_bar_of_a_mean(mean: float, outcome: str) -> None:
    """Of two sets, error 0.1."""
    cell = "many small effects, m=50"
    assert "error / true <= 1.6" in TABLE["bars"][cell]
    sizes = ({"cell": cell, "error_named_mm": mean + off, "error_true_mm": 1.0} for off in (-0.1, 0.1))
    (bar,) = figures_of(*sizes)[0]["bars"].filter(measure="error / true")["outcome"]
    assert bar == outcome


def test_an_arm_with_the_true_values_has_no_error_and_its_intervals_hold() -> None:
    """What the simulator hides, put into the model: positions agree without noise; the fitted true model is near. Where
    the first length alone is uncertain, by s, its interval at every tip is 1.96 s |cos|, and the tip off by d |cos|:
    all coordinates are inside where d < 1.96 s, none where it is more; with three degrees of freedom 3.18 s."""
    data, s = cells.data_set("six to nine effects, m=100", 3), 0.01
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
        assert inside_tip(replace(arm, calibration=found), data) == inside
    assert inside_tip(known, data) is None  # no covariance


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
    found = contradictions({"verdict": verdict, "effects": [*effects], "probabilities": stated, "other_sets": listed})
    assert found == [] if doubt is None else doubt in found


# -- tasks -------------------------------------------------------------------------------------------------------------
def test_the_seed_moves_the_data() -> None:
    key = {"cell": NONE, "first": 3, "sets": 1, "seed": 1}
    assert blind.examine(key, np.random.SeedSequence(1))[0]["values"] == [
        *cells.data_set(NONE, 1_000_003).values.values()
    ]


def test_designed_plans_are_shared_by_neighboring_sets() -> None:
    cell = "one, lambda 6, discriminating plan"
    arm, runs = cells.to_be_planned(cell, 0)
    postures = np.random.default_rng(1).uniform(arm.lower, arm.upper, (runs, arm.links))
    one, two = (cells.data_set(cell, seed, postures) for seed in (0, 1))
    np.testing.assert_array_equal(one.arm.lengths, arm.lengths)
    np.testing.assert_array_equal(one.measurements.postures, two.measurements.postures)
    assert one.effects != two.effects or not np.allclose(one.measurements.positions, two.measurements.positions)
