"""Comparison of solvers: rows evaluated by the problem, summaries counted by hand."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest
from click.testing import CliRunner

from doe import DesignProblem, score
from doe.bounds.certificate import Bound
from doe.cli import main
from doe.jobs import frame_of
from doe.studies.comparison import compare, comparison_parts, evaluated, summary
from identification import Arm, InputError, Model, Plan
from tests.doe.bounds.test_planar_theorem import complex_log_det

LIMITS = np.radians([180.0, 120.0, 100.0])
ARM = Arm(np.array([260.0, 180.0, 120.0]), -LIMITS, LIMITS, sigma=0.1, name="three")
PROBLEM = DesignProblem.of(Model(ARM))


def row(solver: str, repeat: int, value: float | None, seconds: float, **more: object) -> dict[str, object]:
    key = {"arm": "a", "arm_hash": "h", "criterion": "D", "runs": 4, "solver": solver, "starts": 1, "repeat": repeat}
    found = {"status": "done", "error": None, "value": value, "correct": True, "parameters": 8, "seconds": seconds}
    return {**key, **found, "efficiency": None if value is None else np.exp(value / 8), **more}


# a: hits in 1 s and 4 s;  b: one hit in 2 s, one worse plan;  c: a hang and a plan that claims too much
ROWS = frame_of(
    [
        row("a", 0, -0.1, 1.0),
        row("a", 1, -0.1 - 1e-7, 4.0),
        row("b", 0, -0.1, 2.0),
        row("b", 1, -0.3, 1.0),
        row("c", 0, None, 9.0, status="failed", error="JobError: killed after 9 s", correct=None, parameters=None),
        row("c", 1, 0.7, 1.0, correct=False),
    ]
)


def test_summary_counts_hits_and_time_to_a_hit() -> None:
    found = {r["solver"]: r for r in summary(ROWS).iter_rows(named=True)}
    assert list(found) == ["b", "a", "c"]  # equal values: the faster one first; no value: last
    assert [found[s]["hit_rate"] for s in "abc"] == [1.0, 0.5, 0.0]
    assert [found[s]["seconds_to_hit"] for s in "abc"] == [2.5, 3.0, None]
    assert [found[s]["not_correct"] for s in "abc"] == [0, 0, 2]
    assert [found[s]["best"] for s in "abc"] == [-0.1, -0.1, None]  # the false 0.7 is nobody's best
    assert found["b"]["median"] == pytest.approx(-0.2)


@pytest.mark.parametrize(("loss", "rate"), [(5e-7, 1.0), (2e-6, 0.5)])  # of efficiency
@pytest.mark.parametrize("name", ["D", "Dstar", "A", "E"])
def test_hits_need_no_bound(name: str, loss: float, rate: float) -> None:
    of_traces = {"A": (-2.0, -2.0 / (1.0 - loss)), "E": (2.0, 2.0 * (1.0 - loss))}
    best, worse = of_traces.get(name, (0.0, 8 * np.log(1.0 - loss)))
    values = enumerate([best, worse])
    rows = frame_of([row("a", k, value, 1.0, criterion=name) | {"efficiency": None} for k, value in values])
    assert summary(rows)["hit_rate"].to_list() == [rate]


def test_rows_without_any_success_have_tables() -> None:
    failed = ROWS.filter(solver="c", repeat=0)
    assert summary(failed)["best"].to_list() == [None]
    for rows in (failed, ROWS):
        assert len(comparison_parts(rows)) == 2  # the problem, and the sentence about the hang
        for cut in (True, False):  # by time: the bound holds, and says so
            sheet = comparison_parts(rows.with_columns(bound=pl.lit(-0.1), bound_cut=cut))[0]
            assert ("cut by the time limit" in sheet.title) == cut


def test_judged_by_the_problem() -> None:
    """Not correct are a plan outside the limits, one without a run, and one that is better than the bound."""
    postures = np.random.default_rng(3).uniform(-LIMITS, LIMITS, (5, 3))
    honest = evaluated(5, score(PROBLEM, Plan(postures)))
    assert honest["value"] == pytest.approx(complex_log_det(postures), abs=1e-10)
    assert honest["correct"]
    assert not evaluated(6, score(PROBLEM, Plan(postures)))["correct"]
    assert not evaluated(5, score(PROBLEM, Plan(postures), Bound(honest["value"] - 1e-8, "continuous")))["correct"]
    postures[2, 1] = LIMITS[1] + 2e-6
    assert not evaluated(5, score(PROBLEM, Plan(postures)))["correct"]


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spares the start of a process per run where the test is not about that."""

    def call(function: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
        return function(*arguments)

    monkeypatch.setattr("doe.studies.comparison.call", call)


def test_solvers_run_in_their_own_processes(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    run = partial(compare, [ARM], [4], ["random"], starts=[2], repeats=2, seconds=20.0)
    path = tmp_path / "rows.parquet"
    rows = run(path=path)
    assert rows["status"].to_list() == ["done"] * 2
    assert rows["correct"].all()
    assert len(set(rows["value"])) == 2
    assert run(path=path, resume=True).equals(rows)
    request.getfixturevalue("in_this_process")
    with pytest.raises(InputError, match="runs"):
        compare([ARM], [2], ["random"])  # two runs cannot tell six parameters
    assert run()["value"].to_list() == rows["value"].to_list()  # the same seeds: the same plans


@pytest.mark.usefixtures("in_this_process")
def test_verb(tmp_path: Path) -> None:
    arm = tmp_path / "arm.toml"
    arm.write_text("links_mm = [260.0, 180.0]\n")
    options = [str(arm), "--runs", "2,3", "--solvers", "analytic", "--repeats", "1", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main.commands["compare"], [*options, "--json"])
    assert done.exit_code == 0, done.output
    assert [r["best"] for r in json.loads(done.stdout)["summary"]] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert {f.name for f in (tmp_path / "out").iterdir()} == {"rows.parquet", "summary.parquet"}
    assert pl.read_parquet(tmp_path / "out" / "rows.parquet")["runs"].to_list() == [2, 3]
    refused = CliRunner().invoke(main.commands["compare"], options)
    assert refused.exit_code == 2
    assert "--resume" in refused.output
    assert CliRunner().invoke(main.commands["compare"], [*options, "--resume"]).exit_code == 0
    nowhere = CliRunner().invoke(main.commands["compare"], [str(arm), "--runs", "4", "--resume"])
    assert (nowhere.exit_code, "needs --out" in nowhere.output) == (2, True)
    box = '[[constraints]]\nkind = "workspace_box"\nx_mm = [900.0, 910.0]\ny_mm = [0.0, 10.0]\n'  # out of reach
    arm.write_text(f"links_mm = [260.0, 180.0]\n{box}")
    failed = CliRunner().invoke(main.commands["compare"], [*options[:-1], str(tmp_path / "new")])
    assert (failed.exit_code, "no posture within the joint limits" in failed.output) == (0, True), failed.output


@pytest.mark.usefixtures("in_this_process")
def test_ctrl_c_after_the_last_row_says_that_rows_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("doe.studies.comparison.comparison_parts", Mock(side_effect=KeyboardInterrupt))
    arm, out = tmp_path / "arm.toml", tmp_path / "out"
    arm.write_text("links_mm = [260.0, 180.0]\n")
    options = [str(arm), "--runs", "3", "--solvers", "analytic", "--repeats", "1", "--out", str(out)]
    done = CliRunner().invoke(main.commands["compare"], options)
    assert (done.exit_code, f"finished rows are kept in {out}" in done.stderr) == (1, True)
    assert [file.name for file in out.iterdir()] == ["rows.parquet"]
    monkeypatch.setattr("doe.studies.comparison.compare", Mock(side_effect=KeyboardInterrupt))
    early = CliRunner().invoke(main.commands["compare"], [*options[:-1], str(tmp_path / "none")])
    assert early.stderr.endswith("; no row was finished\n")
