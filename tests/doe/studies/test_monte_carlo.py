"""Monte Carlo studies: against the paper's formulas, plain loops, and themselves on other workers."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from click.testing import CliRunner

from doe import jobs
from doe.cli import main
from doe.jobs import frame_of, seed_of
from doe.problem.problem import random_postures
from doe.studies.monte_carlo import Study, monte_carlo_parts, pooled_rows, run_study
from identification import Arm, Calibration, Conditions, InputError, Model, Plan, without_prior
from identification.instruments import Tracker
from identification.replications import TruthTable, true_values
from identification.workspace import WorkspaceBox
from tests.identification.estimation.cases import tip
from tests.identification.test_sessions import DRAWN, ELBOW, SIZES, TABLE_ROWS
from tests.refusals import refused

LENGTHS, ERRORS = np.array([260.0, 180.0, 120.0, 100.0]), np.array([1.5, -0.6, -0.4, 0.7])
OFFSETS = np.radians([0.5, -0.5, 0.7, -0.3])
PAPER = {"name": "paper", "length_errors_mm": ERRORS.tolist(), "joint_offsets_deg": [0.5, -0.5, 0.7, -0.3]}
ARM = Arm(LENGTHS, sigma=0.1, name="paper-4-link")
HIDDEN = {"name": "encoder_eccentricity", "joint": 2, "a_deg": 0.03, "b_deg": -0.012}
WAVE = {"name": HIDDEN["name"], "joint": 2}

MACHINED: dict[str, Any] = {"name": "machined", "values": SIZES}
ELBOW_FILE = 'name = "elbow"\nkind = "spatial"\n' + "".join(
    f"[[dh]]\na_mm = {r.a}\nalpha_deg = {np.degrees(r.alpha)}\nd_mm = {r.d}\n" for r in TABLE_ROWS
)
ELBOW_FILE += (
    "[measurement]\nsigma_mm = 0.05\n[calibration.values]\n[calibration.tools.1]\nx_mm = 40\ny_mm = 30\nz_mm = 20\n"
)
PLAN = Plan(np.random.default_rng(2).uniform(-2.5, 2.5, (15, 3)))


def paper(plans: Any = ("dft",), truth: Any = PAPER, **others: Any) -> dict[str, pl.DataFrame]:
    """A study of the paper's arm."""
    seed = others.pop("seed", 0)
    return run_study(Study.of([ARM], plans, truths=[truth], **others), seed=seed)


def test_cells_pool_blocks_as_if_there_were_none() -> None:
    generator = np.random.default_rng(2)
    parts = [generator.normal(3.0, 2.0, size) for size in (5, 1, 40)]
    key = {"arm": "a", "plan": "p", "runs": 3, "sigma_mm": 0.1, "truth": "t", "model": "m", "inputs": "i"}
    key |= {"status": "done", "error": None, "parameter": "x", "unit": "mm", "failed": 1, "expected_std": 2.0}
    rows = [
        key | {"fits": len(e), "mean_error": e.mean(), "squares": ((e - e.mean()) ** 2).sum()}
        | {"covered": int((abs(e) < 3).sum()), "rms_mm": float(len(e))}
        for e in parts
    ]  # fmt: skip
    (found,) = pooled_rows(frame_of(rows)).to_dicts()
    every = np.concatenate(parts)
    expected = {"fits": 46, "failed": 3, "mean_error": every.mean(), "std": every.std(ddof=1)}
    expected["coverage"] = np.mean(abs(every) < 3)
    expected["rms_mm"] = np.sqrt((5**3 + 1 + 40**3) / 46)
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-13)
    lost = frame_of([rows[0] | {"fits": 0, "mean_error": None, "squares": None, "rms_mm": None, "expected_std": None}])
    [_, sheet] = monte_carlo_parts({"cells": pooled_rows(lost), "blocks": lost.with_columns(key=pl.lit(""))})
    assert sheet.title.endswith("0 fits, 1 failed, RMS - mm")
    none = pooled_rows(lost.with_columns(status=pl.lit("failed"), error=pl.lit("no arm")))
    said = monte_carlo_parts({"cells": none, "blocks": lost.with_columns(key=pl.lit(""), status=pl.lit("failed"))})
    assert said == ["1 cells, 0 fits", "a: 1 of 1 cells failed: no arm"]


def test_random_plans_are_new_for_each_hundred_replications() -> None:
    """Two plans: each cell's fits against separate complex solutions of the same draws."""
    result = paper(["random"], runs=[6], sigma_mm=[0.2], replications=130, seed=3)
    errors, variances = [], []
    for key, count in zip(result["blocks"]["key"].unique(maintain_order=True), (100, 30), strict=True):
        generator = np.random.default_rng(seed_of(json.loads(key), 3))
        postures = generator.uniform(-np.pi, np.pi, (6, 4))
        measured = tip(postures + OFFSETS, LENGTHS + ERRORS) + 0.2 * generator.standard_normal((count, 6, 2))
        columns = np.exp(1j * np.cumsum(postures, axis=1))
        for p in measured:
            u = np.linalg.lstsq(columns, p[:, 0] + 1j * p[:, 1], rcond=None)[0]
            errors.append(np.abs(u) - LENGTHS - ERRORS)
            variances.append(0.04 * np.diag(np.linalg.inv(columns.conj().T @ columns)).real)  # H, doe/README.md
    found = result["cells"].filter(pl.col("parameter").str.starts_with("length"))
    np.testing.assert_allclose(found["mean_error"].to_numpy(), np.mean(errors, axis=0), atol=1e-10)
    np.testing.assert_allclose(found["std"].to_numpy(), np.std(errors, axis=0, ddof=1), rtol=1e-8)
    np.testing.assert_allclose(found["expected_std"].to_numpy(), np.sqrt(np.mean(variances, axis=0)), rtol=1e-6)
    covered = np.abs(errors) <= 1.959963984540054 * np.sqrt(variances)
    np.testing.assert_allclose(found["coverage"].to_numpy(), covered.mean(axis=0))


def test_plans_keep_to_the_constraints(monkeypatch: pytest.MonkeyPatch) -> None:
    boxed, seen = replace(ARM, constraints=(WorkspaceBox((-800.0, 800.0), (0.0, 800.0)),), name="boxed"), []

    def spy(*arguments: Any) -> Any:
        seen.append(random_postures(*arguments))
        return seen[-1]

    monkeypatch.setattr("doe.studies.monte_carlo.random_postures", spy)
    found = run_study(Study.of([boxed], ["random", "dft"], runs=[8], truths=[PAPER], replications=300))["cells"]
    heights = tip(np.array(seen), LENGTHS)[..., 1]
    assert heights.shape == (3, 8)
    assert heights.min() >= 0.0
    assert found.filter(plan="random")["status"].to_list() == ["done"] * 12
    assert found.filter(plan="dft")["error"].str.contains(r"plan dft: posture \d+ is outside").all()


def test_a_task_of_long_plans_has_fewer_replications(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("doe.studies.monte_carlo.MOST_ROWS", 6 * 20)
    result = paper(runs=[6], replications=50)
    assert result["blocks"].filter(parameter="length_error:1")["replications"].to_list() == [20, 20, 10]
    assert set(result["cells"]["fits"]) == {50}


def test_rows_depend_on_no_workers_and_an_extended_study_keeps_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process is one, whatever was asked: to start it takes longer than to work."""
    monkeypatch.setattr("doe.jobs._pool", lambda _, pool=jobs._pool: pool(1))

    def small(*runs: int) -> Study:
        arms = [ARM, Arm(LENGTHS[:2], sigma=0.1, name="two")]
        return Study.of(arms, ["analytic", "random"], runs=[*runs], replications=150)

    folder, alone = tmp_path / "out", run_study(small(4, 5), seed=1)
    first = run_study(small(4), folder, workers=2, seed=1)
    with pytest.raises(InputError, match="--resume"):
        run_study(small(4, 5), folder, seed=1)
    both = run_study(small(4, 5), folder, seed=1, resume=True)
    assert both["blocks"].filter(runs=4).equals(first["blocks"])  # to the very seconds
    for one, other in ((both[name], alone[name]) for name in ("blocks", "plans")):
        assert one.drop("seconds").equals(other.drop("seconds"))
    assert both["cells"].equals(alone["cells"])
    assert {f.name for f in folder.iterdir()} == {"plans.parquet", "blocks.parquet", "cells.parquet"}
    assert pl.read_parquet(folder / "cells.parquet").equals(alone["cells"])


def test_cells_that_cannot_be_done_are_rows() -> None:
    limited = replace(ARM, lower=np.full(4, -1.0), upper=np.full(4, 1.0), name="limited")
    plans = ["dft", "random", "analytic"]
    result = run_study(Study.of([ARM, limited], plans, runs=[3, 4], truths=[PAPER], replications=10))
    reason = {(r["arm"], r["plan"], r["runs"]): r["error"] for r in result["cells"].filter(status="failed").to_dicts()}
    few = {(arm, plan, 3) for arm in ("paper-4-link", "limited") for plan in plans}
    assert set(reason) == few | {("limited", "dft", 4), ("limited", "analytic", 4)}
    assert "3 runs are too few for 4 links" in reason["paper-4-link", "dft", 3]
    assert "is outside the limits" in reason["limited", "dft", 4]
    assert "no plan" in reason["limited", "analytic", 4]


# -- in space ----------------------------------------------------------------------------------------------------------
def test_intervals_hold_and_a_missing_effect_is_a_bias() -> None:
    truths, sets = [MACHINED, MACHINED | {"name": "eccentric", "effects": [HIDDEN]}], 400
    models = [{"name": "geometry", "effects": []}, {"name": "full", "effects": [WAVE]}]
    plans = {"plan": PLAN, "dft": None}
    study = Study.of([ELBOW], plans, runs=[15], truths=truths, models=models, replications=sets)
    cells = run_study(study, seed=3)["cells"]
    rows, other, full = (
        cells.filter(plan="plan", truth=truth, model=model)
        for truth, model in (("machined", "geometry"), ("eccentric", "geometry"), ("eccentric", "full"))
    )
    assert rows["failed"].to_list() == [0] * len(Model(without_prior(ELBOW)).names)
    spread = 5.0 / np.sqrt(2.0 * sets)  # five standard errors of a standard deviation
    np.testing.assert_allclose(rows["std"] / rows["expected_std"], 1.0, atol=spread)
    assert (rows["mean_error"].abs() < 5.0 * rows["std"] / np.sqrt(sets)).all()
    assert ((rows["coverage"] - 0.95).abs() < 5.0 * np.sqrt(0.95 * 0.05 / sets)).all()
    assert other["rms_mm"][0] > 1.5 * rows["rms_mm"][0]
    assert (other["mean_error"] / other["std"]).abs().to_numpy().max() > 20.0 / np.sqrt(sets)
    assert ((full["mean_error"] / full["std"]).abs() < 4.5 / np.sqrt(sets)).all()  # its model repairs it
    assert "is not that of Table I, allowed: planar arms" in cells.filter(plan="dft")["error"][0]


SEVERAL = {"tools": {"a": np.array([40.0, 30.0, 20.0]), "b": np.array([-50.0, 10.0, 60.0])}}


@pytest.mark.parametrize("measured", [SEVERAL, SEVERAL | {"instrument": Tracker(100.0)}])
def test_every_point_and_frame_is_measured_at_every_posture(measured: dict[str, Any]) -> None:
    """Expected deviations from (sum of J^T J)^-1 with J by central differences of the model's own positions and turned
    axes; the fits scatter by as much, and the intervals hold."""
    chain = replace(DRAWN, **measured)
    arm, plans = Arm(chain, sigma=0.05, name="elbow"), {"plan": Plan(PLAN.postures[:8]), "random": None}
    study = Study.of([arm], plans, runs=[9], truths=[MACHINED], replications=100)
    cells = run_study(study, seed=5)["cells"]
    model, count = Model(without_prior(arm)), len(chain.tools)
    values = true_values(model, Model(TruthTable(**MACHINED).of(study.arms[0])))
    q, marker = np.repeat(PLAN.postures[:8], count, axis=0), Conditions(marker=np.arange(8 * count) % count)
    if chain.angle_scale is not None:
        known = Calibration(dict(zip(model.names, values.tolist(), strict=True)))
        real = Model(replace(model.arm, calibration=known))
        marker = replace(marker, orientation=real.orientations(q, marker))
    steps = 1e-4 * np.diag(1.0 / model.scales)
    moved = [model.position(q, values + step, marker) - model.position(q, values - step, marker) for step in steps]
    at = np.array(moved).reshape(len(values), -1) / 2e-4 * model.scales[:, None]
    expected = 0.05 * np.sqrt(np.diag(np.linalg.inv(at @ at.T)))
    factors = [p.to_file for p in model.parameters]
    rows, at_random = (cells.filter(plan=plan) for plan in ("plan", "random"))
    np.testing.assert_allclose(rows["expected_std"], expected * factors, rtol=1e-4)
    # five standard errors of a standard deviation, and of a mean
    np.testing.assert_allclose(rows["std"], rows["expected_std"], rtol=5.0 / np.sqrt(2.0 * 100))
    assert np.abs(rows["mean_error"] / rows["expected_std"]).max() < 5.0 / np.sqrt(100)
    for each in (rows, at_random):
        assert each["failed"].to_list() == [0] * len(model.names)
        assert each["coverage"].mean() == pytest.approx(0.95, abs=0.03)
        assert each["rms_mm"].is_null().all() == (chain.angle_scale is not None)


# -- the file ----------------------------------------------------------------------------------------------------------
GOOD = """
arms = ["arm.toml"]
plans = ["dft", "plan.csv"]
runs = [5]
replications = 50
[[truths]]
name = "eccentric"
length_errors_mm = [1.0, -1.0]
joint_offsets_deg = [0.5, 0.25]
effects = [{name = "encoder_eccentricity", joint = 2, a_deg = 0.03, b_deg = -0.01}]
[[models]]
name = "base"
effects = []
"""
SPATIAL = """
arms = ["elbow.toml"]
plans = ["random"]
runs = [9]
replications = 5
[[truths]]
name = "machined"
values = {"rotation_y:3" = 0.1}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm.toml").write_text("name = 'two'\nlinks_mm = [260.0, 180.0]\n[measurement]\nsigma_mm = 0.1\n")
    (tmp_path / "elbow.toml").write_text(ELBOW_FILE)
    rows = "\n".join(f"{k + 1},{30 * k},{-70 * k % 360 - 180}" for k in range(7))
    (tmp_path / "plan.csv").write_text(f"run,q1_deg,q2_deg\n{rows}\n")
    (tmp_path / "study.toml").write_text(GOOD)
    return tmp_path


def test_file_is_read(folder: Path) -> None:
    study = Study.load(folder / "study.toml", 40)
    true = study.asked.truths[0].of(study.arms[0])
    assert true.effects[0].values == pytest.approx({"a": np.radians(0.03), "b": np.radians(-0.01)})
    assert true.calibration is not None
    np.testing.assert_allclose(true.calibration.joint_offsets, np.radians([0.5, 0.25]))
    assert study.asked.models[0].of(true) == replace(study.arms[0], effects=())
    assert (study.plans["dft"], len(study.plans["plan.csv"] or ()), study.asked.replications) == (None, 7, 40)
    (folder / "study.toml").write_text(SPATIAL)
    cells = run_study(Study.load(folder / "study.toml"))["cells"]
    assert cells["fits"].to_list() == [5] * len(Model(without_prior(ELBOW)).names)


@pytest.mark.parametrize(
    ("text", "old", "new", "found"),
    [
        *(
            (GOOD, *change)
            for change in (
                ('plans = ["dft"', 'plans = ["dftt"', "did you mean 'dft'"),
                ("runs = [5]", "", "runs: is missing"),
                ('name = "base"', "", "models[1].name: is missing"),
                ("replications = 50", f"replications = 1{23 * '0'}", "<= 10000000"),
                ("replications = 50", "sigma_mm = []", "sigma_mm: found 0 values"),
                ("runs = [5]", "runs = [1000000000000]", "runs[1]: found 1000000000000"),
                ("length_errors_mm = [1.0,", "length_errors_mm = [1.0, 2.0,", "length_errors_mm: found 3 values for 2"),
                ("joint = 2", "joint = 3", "truths: eccentric with arm two: effects: encoder_eccentricity at joint 3"),
                ("encoder_eccentricity", "encoder_excentricity", "did you mean 'encoder_eccentricity'"),
                ('"encoder_eccentricity", joint = 2, a_deg = 0.03, b_deg = -0.01', '"link_bending"', "needs gravity"),
                ('"base"', '"base"\neffects = []\n[[models]]\nname = "base"', "models: name 'base' is given twice"),
                ('["arm.toml"]', '["arm.toml", "arm.toml"]', "arms: name 'arm.toml' is given twice"),
                ('["arm.toml"]', '["arm.toml", "elbow.toml"]', "plans: found files for arms of different joints"),
                ("arm.toml", "other.toml", "no such file"),
            )
        ),
        (SPATIAL, "rotation_y:3", "rotation_w:3", "rotation_w:3"),
        (SPATIAL, "elbow.toml", "arm.toml", "two: calibration.values: "),
        (SPATIAL, 'values = {"rotation_y:3" = 0.1}', "length_errors_mm = [1, 2, 3]", "length_error"),
    ],
)
def test_bad_file_is_one_line(folder: Path, text: str, old: str, new: str, found: str) -> None:
    assert old in text
    (folder / "study.toml").write_text(text.replace(old, new))
    refused(Study.load, folder / "study.toml", names=[found, "study.toml"])


def test_verb(folder: Path) -> None:
    options = [str(folder / "study.toml"), "--workers", "1"]
    done = CliRunner().invoke(main.commands["study"], [*options, "--json"])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert {cell["runs"] for cell in answer["cells"]} == {5, 7}
    assert answer["failed"] == 0
    assert (folder / "study.results" / "cells.parquet").exists()
    assert CliRunner().invoke(main.commands["study"], options).exit_code == 2
    shown = CliRunner().invoke(main.commands["study"], [*options, "--resume"])
    assert shown.exit_code == 0
    assert "joint_offset:2" in shown.output
