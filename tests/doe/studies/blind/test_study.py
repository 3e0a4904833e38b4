"""The blind study: scoring by hand, the tasks' bookkeeping, and a reduced form of the study itself.

A cell of COUNT data sets has a standard error of sqrt(p (1 - p) / COUNT); the fail threshold lies about four of them
beyond what the full study measured, so that chance alone fails less than once in ten thousand runs; the seeds are
fixed anyway. The full study: armcal study blind.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import polars
import pytest

from doe.jobs.row_table import frame_of
from doe.report.blind import blind_tables, matrix
from doe.studies.blind import cells
from doe.studies.blind import study as blind
from doe.studies.blind.rivals import gaussian_process, has_processes
from doe.studies.blind.score import Bar, BlindStudy, score
from doe.studies.blind.study import blind_study
from identification.errors import InputError

COUNT = 20


def check(what: str, value: float, alert: float, fail: float) -> None:
    """Fail below `fail`, warn below `alert` (a warning is not an error here: it is for people)."""
    assert value >= fail, f"{what}: {value:.3f}, at least {fail} asked"
    if value < alert:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn(f"{what}: {value:.3f} is below {alert}", stacklevel=2)


def run(cell: str, count: int = COUNT) -> BlindStudy:
    return blind_study([cell], count, draws=399)


# -- the study in reduced form -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("cell", ["none m=50", "none, joint noise", "none, reach noise"])
def test_false_alarms_are_rare(cell: str) -> None:
    check(cell, 1.0 - run(cell).value(cell, "alarm"), alert=0.84, fail=0.70)


def test_single_effects_are_named_and_close_the_gap_better_than_the_rivals() -> None:
    cell = "one, lambda 8, m=50"
    found = run(cell, 30)
    check("exact", found.value(cell, "exact"), alert=0.84, fail=0.68)
    check("class", found.value(cell, "class"), alert=0.90, fail=0.80)
    check("in the set", found.value(cell, "in the set"), alert=0.90, fail=0.78)
    assert found.value(cell, "gap / true") <= 1.05
    assert found.value(cell, "gap / library") < 1.0
    if has_processes():
        assert found.value(cell, "gap / process") < 1.0


def test_two_effects_are_named() -> None:
    cell = "two, lambda 8, no family"
    found = run(cell)
    check("exact", found.value(cell, "exact"), alert=0.75, fail=0.50)
    check("class", found.value(cell, "class"), alert=0.84, fail=0.65)


def test_effects_outside_the_library_are_flagged_and_located() -> None:
    cell = "outside, lambda 7"
    check("located", run(cell).value(cell, "located"), alert=0.89, fail=0.75)


def test_outliers_do_not_fool_the_naming_and_are_listed() -> None:
    cell = "three outliers, lambda 8"
    found = run(cell)
    check("class", found.value(cell, "class"), alert=0.89, fail=0.75)
    check("listed", found.value(cell, "outliers listed"), alert=0.95, fail=0.80)


def test_further_postures_settle_ambiguous_sets() -> None:
    cell = blind.AMBIGUOUS
    found = run(cell)
    assert 0.0 < found.value(cell, "next_8 class") <= 1.0
    assert found.value(cell, "next_8 predicted") > found.value(cell, "next_2 predicted")


# -- bookkeeping -------------------------------------------------------------------------------------------------------
def tables(hidden: dict, said: dict) -> BlindStudy:
    """The score of one data set."""
    place = {"cell": "two, lambda 8", "set": 0, "status": "done"}
    truth = {"hidden": [], "place": None, "wrong_rows": [], "gap_true_mm": None}
    found = {"verdict": "none", "named": [], "candidates": [], "where": None, "outlier_rows": [], "gap_named_mm": None}
    return score(frame_of([{**place, **truth, **hidden}]), frame_of([{**place, **found, **said}]))


def figures(found: BlindStudy) -> dict[str, float]:
    return {row["measure"]: row["value"] for row in found.cells.iter_rows(named=True)}


def test_the_right_name_in_an_ambiguous_set() -> None:
    hidden = {"hidden": ["backlash:2", "joint_compliance:1"], "gap_true_mm": 0.2}
    said = {
        "verdict": "ambiguous",
        "named": ["joint_compliance:1", "backlash:2"],
        "candidates": ["backlash:2 + joint_compliance:1", "backlash:2 + link_bending"],
        "gap_named_mm": 0.3,
    }
    assert figures(tables(hidden, said)) == {
        "alarm": 1.0,
        "exact": 1.0,
        "class": 1.0,
        "in the set": 1.0,
        "size of the set": 2.0,
        "gap / true": pytest.approx(1.5),
    }


def test_a_look_alike_is_of_the_right_class_only() -> None:
    hidden = {"hidden": ["link_bending"]}
    said = {"verdict": "named", "named": ["gravity_backlash:3"], "candidates": ["gravity_backlash:3"]}
    found = figures(tables(hidden, said))
    assert (found["exact"], found["class"], found["in the set"]) == (0.0, 1.0, 0.0)


def test_a_name_beside_an_unknown_is_wrong() -> None:
    said = {"verdict": "unknown", "named": ["backlash:1"], "where": "joint:2"}
    found = tables({"hidden": ["backlash:1"]}, said)
    assert figures(found)["exact"] == figures(found)["class"] == 0.0
    assert found.confusion.row(0) == ("backlash", "backlash + unknown", 1)


@pytest.mark.parametrize(("where", "right"), [("joint:2", 1.0), ("joint:1", 0.0)])
def test_an_effect_outside_the_library_must_be_located(where: str, right: float) -> None:
    found = tables({"place": "joint:2"}, {"verdict": "unknown", "where": where})
    assert figures(found) == {"alarm": 1.0, "located": right}


@pytest.mark.parametrize(("listed", "right"), [([3, 7, 9, 11], 1.0), ([3, 7], 0.0)])
def test_every_outlier_must_be_listed(listed: list[int], right: float) -> None:
    found = tables({"wrong_rows": [3, 7, 9]}, {"outlier_rows": listed})
    assert figures(found)["outliers listed"] == right


def test_errors_of_shares_and_means() -> None:
    cell = {"cell": "one, lambda 8, m=50", "status": "done"}
    truth = [{**cell, "set": k, "hidden": ["backlash:1"], "place": None, "wrong_rows": []} for k in range(4)]
    names = ["backlash:1", "backlash:1", "backlash:1", "gear_ratio:1"]
    found = [
        {**cell, "set": k, "verdict": "named", "named": [name], "candidates": [name], "gap_named_mm": None}
        for k, name in enumerate(names)
    ]
    study = score(frame_of(truth), frame_of(found))
    row = study.cells.filter(polars.col("measure") == "exact").row(0, named=True)
    assert row["value"] == 0.75
    assert row["standard_error"] == pytest.approx(np.sqrt(0.75 * 0.25 / 4))
    alarm = study.cells.filter(polars.col("measure") == "alarm").row(0, named=True)
    assert alarm["standard_error"] == pytest.approx(np.sqrt(0.25 / 4 / 4))  # not zero, although all alike


def test_a_bar_is_missed_only_beyond_its_error() -> None:
    bar = Bar("x", "exact", 0.9)
    assert [bar.outcome(v, 0.01) for v in (0.9, 0.885, 0.87)] == ["met", "within its error", "missed"]
    most = Bar("x", "alarm", 0.05, at_most=True)
    assert [most.outcome(v, 0.01) for v in (0.05, 0.065, 0.08)] == ["met", "within its error", "missed"]


def test_the_confusion_matrix_counts_every_set_once() -> None:
    pairs = [("backlash", "backlash", 7), ("backlash", "gravity + backlash", 2), ("backlash", "gravity + unknown", 1)]
    pairs += [("nothing", "nothing", 5), ("backlash + gravity", "gravity", 9)]
    frame = frame_of([{"hidden": a, "named": b, "count": n} for a, b, n in pairs])
    hidden, named, shares, totals = matrix(frame)
    assert (hidden, totals) == (["backlash", "nothing"], [10, 5])
    assert dict(zip(named, shares[0], strict=True)) == {"backlash": 0.7, "nothing": 0.0, "several": 0.2, "unknown": 0.1}


# -- tasks -------------------------------------------------------------------------------------------------------------
def test_the_diagnoses_table_knows_nothing_of_the_truth(tmp_path: Path) -> None:
    blind_study(["outside, lambda 7"], 2, tmp_path / "study", draws=399)
    said = polars.read_parquet(tmp_path / "study" / blind.DIAGNOSES)
    assert {"hidden", "place", "wrong_rows", "gap_true_mm"}.isdisjoint(said.columns)
    truth = polars.read_parquet(tmp_path / "study" / blind.TRUTH)
    assert truth["place"].null_count() == 0


def test_an_interrupted_study_goes_on_where_it_stopped(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    first = blind_study(["none m=20"], 10, folder, draws=399)
    before = polars.read_parquet(folder / blind.DIAGNOSES)
    more = blind_study(["none m=20"], 20, folder, draws=399, resume=True)
    after = polars.read_parquet(folder / blind.DIAGNOSES)
    assert (len(first.sets), len(more.sets)) == (10, 20)
    assert after.head(10)["seconds"].to_list() == before["seconds"].to_list()  # not done again


def test_the_seed_moves_the_data_and_nothing_else_does() -> None:
    key = {"cell": "two, lambda 8", "first": 3, "sets": 1, "seed": 0}
    one, other = blind.hide(key, np.random.SeedSequence(1)), blind.hide(key, np.random.SeedSequence(2))
    assert json.dumps(one) == json.dumps(other)
    assert blind.hide({**key, "seed": 1}, np.random.SeedSequence(1)) != one


def test_designed_plans_are_shared_by_neighbouring_sets() -> None:
    cell = "one, lambda 6, discriminating plan"
    arm, runs = cells.to_be_planned(cell, 0)
    postures = np.random.default_rng(1).uniform(arm.lower, arm.upper, (runs, arm.links))
    one, two = (cells.data_set(cell, seed, postures) for seed in (0, 1))
    np.testing.assert_array_equal(one.arm.lengths, arm.lengths)
    np.testing.assert_array_equal(one.measurements.postures, two.measurements.postures)
    assert one.effects != two.effects or not np.allclose(one.measurements.positions, two.measurements.positions)


def test_an_unknown_cell_is_named() -> None:
    with pytest.raises(InputError, match="none m=50"):
        blind_study(["none m=5"], 1)


def test_tables_and_picture_can_be_made(tmp_path: Path) -> None:
    from doe.report.blind import write_pictures

    found = run("one, lambda 8, m=20", 4)
    assert len(blind_tables(found)) >= 3
    write_pictures(tmp_path, found)
    assert (tmp_path / "confusion.png").stat().st_size > 1000


# -- rivals ------------------------------------------------------------------------------------------------------------
def test_gaussian_process_finds_a_smooth_function_and_ignores_noise() -> None:
    pytest.importorskip("sklearn", reason="the Gaussian process needs scikit-learn: pip install 'armcal[studies]'")
    generator = np.random.default_rng(5)
    q, fresh = generator.uniform(-np.pi, np.pi, (80, 2)), generator.uniform(-np.pi, np.pi, (200, 2))

    def smooth(x: np.ndarray) -> np.ndarray:
        return np.column_stack([np.cos(x[:, 0]), np.sin(x[:, 1])])

    guess = gaussian_process(q, smooth(q) + 0.1 * generator.standard_normal((80, 2)), fresh)
    assert np.sqrt(np.mean((guess - smooth(fresh)) ** 2)) < 0.1
    nothing = gaussian_process(q, generator.standard_normal((80, 2)), fresh)
    assert np.sqrt(np.mean(nothing**2)) < 0.5
