"""Monte Carlo studies: against the paper's formulas, plain loops, and themselves on other workers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from click.testing import CliRunner
from scipy.optimize import least_squares

from doe.cli.study import command
from doe.jobs.rows import frame_of
from doe.jobs.running import processes
from doe.plan.plan import Plan
from doe.report.studies import cell_table
from doe.studies.monte_carlo import Fitted, Study, Truth, dft_postures, load_study, pooled_rows, run_study
from identification.arm import Arm, EffectSpec
from identification.errors import InputError
from identification.estimation import estimate_each
from identification.estimation.levenberg_marquardt import Solution
from identification.measurements import Conditions
from identification.model import Model
from identification.workspace import WorkspaceBox

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
PAPER = Truth("paper", [1.5, -0.6, -0.4, 0.7], np.radians([0.5, -0.5, 0.7, -0.3]).tolist())
ARM = Arm(LENGTHS, sigma=0.1, name="paper-4-link")
ECCENTRIC = EffectSpec("encoder_eccentricity", 2, {"a": 0.0005, "b": -0.0002})
RANDOM_PLAN = Plan(np.random.default_rng(8).uniform(-np.pi, np.pi, (12, 4)))


def positions(postures: np.ndarray, lengths: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Eq. 1 written out."""
    theta = np.cumsum(postures + offsets, axis=-1)
    return np.stack([(lengths * np.cos(theta)).sum(-1), (lengths * np.sin(theta)).sum(-1)], axis=-1)


def test_dft_plan_satisfies_table_1() -> None:
    postures = dft_postures(4, 7)
    for j in range(4):
        for k in range(j + 1, 4):
            assert abs(np.mean(np.exp(1j * postures[:, j + 1 : k + 1].sum(axis=1)))) < 1e-14
    assert np.all((postures > -np.pi) & (postures <= np.pi))


def test_fits_on_plans_of_their_own_equal_a_general_optimiser() -> None:
    generator = np.random.default_rng(4)
    postures = generator.uniform(-np.pi, np.pi, (3, 6, 4))
    offsets = np.array(PAPER.joint_offsets)
    measured = positions(postures, LENGTHS + PAPER.length_errors, offsets) + 0.1 * generator.standard_normal((3, 6, 2))
    fits = estimate_each(Model(ARM), postures, measured)
    found, squares = fits.parameters, fits.rss
    for k in range(3):
        oracle = least_squares(
            lambda x, k=k: (positions(postures[k], LENGTHS + x[:4], x[4:]) - measured[k]).ravel(),
            np.zeros(8),
            x_scale=np.r_[np.ones(4), 1 / LENGTHS],
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        # the optimiser stops where the cost no longer changes: half the digits
        np.testing.assert_allclose(
            found[k] * np.r_[np.ones(4), LENGTHS], oracle.x * np.r_[np.ones(4), LENGTHS], atol=1e-5
        )
        assert squares[k] == pytest.approx(2 * oracle.cost, rel=1e-9)


def test_cells_pool_blocks_as_if_there_were_none() -> None:
    generator = np.random.default_rng(2)
    parts = [generator.normal(3.0, 2.0, size) for size in (5, 1, 40)]
    key = {"arm": "a", "plan": "p", "runs": 3, "sigma_mm": 0.1, "truth": "t", "model": "m", "inputs": "i"}
    rows = [
        {
            **key, "status": "done", "error": None, "parameter": "x", "unit": "mm", "fits": len(e), "failed": 1,
            "mean_error": e.mean(), "squares": ((e - e.mean()) ** 2).sum(), "covered": int((abs(e) < 3).sum()),
            "expected_std": 2.0, "rms_mm": float(len(e)),
        }
        for e in parts
    ]  # fmt: skip
    (found,) = pooled_rows(frame_of(rows)).to_dicts()
    every = np.concatenate(parts)
    assert found["fits"] == 46
    assert found["failed"] == 3
    assert found["mean_error"] == pytest.approx(every.mean(), rel=1e-13)
    assert found["std"] == pytest.approx(every.std(ddof=1), rel=1e-13)
    assert found["rms"] == pytest.approx(np.sqrt(np.mean(every**2)), rel=1e-13)
    assert found["coverage"] == np.mean(abs(every) < 3)
    assert found["rms_mm"] == pytest.approx(np.sqrt((5**3 + 1 + 40**3) / 46))


def test_optimal_plan_has_the_deviations_of_equation_25() -> None:
    m, replications = 20, 20_000
    study = Study([ARM], ["dft"], [m], truths=[PAPER], replications=replications, block=6_000)
    found = run_study(study).cells
    lengths = LENGTHS + PAPER.length_errors
    orientation = np.degrees(0.1 / np.sqrt(m) / lengths)
    joint = np.sqrt(orientation**2 + np.r_[0.0, orientation[:-1] ** 2])  # dq_j = dtheta_j - dtheta_(j-1)
    expected = np.r_[np.full(4, 0.1 / np.sqrt(m)), joint, orientation]
    np.testing.assert_allclose(found["expected_std"].to_numpy(), expected, rtol=1e-9)
    # 12 deviations, 12 means and 12 coverages from one fixed seed: 4.5 standard errors fail by chance in 1 of 4,000
    std_error = expected / np.sqrt(2 * replications)
    assert np.all(np.abs(found["std"].to_numpy() - expected) < 4.5 * std_error)
    # the estimate of a length |u| is high by sigma^2 / (2 m l), 1e-6 mm: nothing here
    assert np.all(np.abs(found["mean_error"].to_numpy()) < 4.5 * expected / np.sqrt(replications))
    assert np.all(np.abs(found["coverage"].to_numpy() - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / replications))
    # residuals have 2m - 2n degrees of freedom, summed over x and y
    assert found["rms_mm"][0] == pytest.approx(0.1 * np.sqrt((2 * m - 8) / m), rel=0.01)
    assert found["fits"].to_list() == [replications] * 12


def test_random_plans_are_new_for_each_replication() -> None:
    study = Study([ARM], ["random"], [6], sigma=[0.2], truths=[PAPER], replications=30, block=30)
    result = run_study(study, seed=3)
    from doe.jobs.running import seed_of

    key = json.loads(result.blocks["key"][0])
    generator = np.random.default_rng(seed_of(key, 3))
    postures = generator.uniform(-np.pi, np.pi, (30, 6, 4))
    measured = positions(postures, LENGTHS + PAPER.length_errors, np.array(PAPER.joint_offsets))
    measured += 0.2 * generator.standard_normal((30, 6, 2))
    errors, variances = [], []
    for q, p in zip(postures, measured, strict=True):
        columns = np.exp(1j * np.cumsum(q, axis=1))
        u = np.linalg.lstsq(columns, p[:, 0] + 1j * p[:, 1], rcond=None)[0]
        errors.append(np.abs(u) - LENGTHS - PAPER.length_errors)
        variances.append(0.04 * np.diag(np.linalg.inv(columns.conj().T @ columns)).real)  # H, doe/README.md
    found = result.cells.filter(pl.col("parameter").str.starts_with("length"))
    np.testing.assert_allclose(found["mean_error"].to_numpy(), np.mean(errors, axis=0), atol=1e-10)
    np.testing.assert_allclose(found["std"].to_numpy(), np.std(errors, axis=0, ddof=1), rtol=1e-8)
    np.testing.assert_allclose(found["expected_std"].to_numpy(), np.sqrt(np.mean(variances, axis=0)), rtol=1e-6)
    covered = np.abs(errors) <= 1.959963984540054 * np.sqrt(variances)
    np.testing.assert_allclose(found["coverage"].to_numpy(), covered.mean(axis=0))


@pytest.mark.parametrize("effects", [(), (EffectSpec("encoder_eccentricity", 2),)])
def test_random_plans_have_the_deviations_and_intervals_that_theory_says(effects: tuple[EffectSpec, ...]) -> None:
    replications = 4_000
    study = Study([ARM], ["random"], [16], truths=[PAPER], models=[Fitted("m", effects)], replications=replications)
    found = run_study(study, seed=2).cells
    # 14 ratios from one fixed seed; plans of 16 runs differ little, so the deviation of a normal error is near enough
    ratio = found["std"].to_numpy() / found["expected_std"].to_numpy()
    assert np.all(np.abs(ratio - 1.0) < 1.5 * 4.5 / np.sqrt(2 * replications))
    assert np.all(np.abs(found["coverage"].to_numpy() - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / replications))
    assert found["std_se"].null_count() == len(found)


def test_missing_effect_biases_and_its_model_repairs() -> None:
    truth = replace(PAPER, name="eccentric", effects=(ECCENTRIC,))
    models = [Fitted("base", ()), Fitted("full", (EffectSpec("encoder_eccentricity", 2),))]
    study = Study([ARM], [("plan.csv", RANDOM_PLAN)], truths=[truth], models=models, replications=400)
    found = run_study(study).cells
    base, full = (found.filter(model=name) for name in ("base", "full"))
    assert len(full) == len(base) + 2
    assert full["runs"].to_list() == [12] * 14
    bias = (full["mean_error"] / full["mean_error_se"]).abs().max()
    assert isinstance(bias, float)
    assert bias < 4.5  # 14 numbers
    worst = (base["mean_error"] / base["mean_error_se"]).abs().max()
    assert isinstance(worst, float)
    assert worst > 20.0  # 0.0005 rad at 180 mm is 0.09 mm against 0.1 / sqrt(12 * 400) = 0.0014 mm
    assert base["rms_mm"][0] > full["rms_mm"][0]


def test_effects_on_random_plans() -> None:
    truth = replace(PAPER, name="slack", effects=(EffectSpec("backlash", 1, {"b": 0.001}),))
    models = [Fitted("full", (EffectSpec("backlash", 1),))]
    study = Study([ARM], ["random"], [12], truths=[truth], models=models, replications=40)
    found = run_study(study).cells
    assert found["fits"][0] == 40
    assert ((found["mean_error"] / found["mean_error_se"]).abs() < 4.5).all()


def test_plans_keep_to_the_constraints(monkeypatch: pytest.MonkeyPatch) -> None:
    boxed = replace(ARM, constraints=(WorkspaceBox((-800.0, 800.0), (0.0, 800.0)),), name="boxed")
    seen = []

    def spy(model: Model, postures: np.ndarray, measured: np.ndarray, conditions: Conditions) -> Solution:
        seen.append(postures)
        return estimate_each(model, postures, measured, conditions)

    monkeypatch.setattr("doe.studies.monte_carlo.study.estimate_each", spy)
    found = run_study(Study([boxed], ["random", "dft"], [8], truths=[PAPER], replications=300)).cells
    heights = positions(np.concatenate(seen), LENGTHS, np.zeros(4))[..., 1]
    assert heights.shape == (300, 8)
    assert heights.min() >= 0.0
    assert found.filter(plan="random")["status"].to_list() == ["done"] * 12
    (reason,) = set(found.filter(plan="dft")["error"])
    assert "plan dft: posture" in reason
    assert "would violate a constraint" in reason


def small_study() -> Study:
    return Study(
        [ARM, Arm(LENGTHS[:2], sigma=0.1, name="two")],
        ["analytic", "random"],
        [4, 5],
        truths=[Truth()],
        replications=500,
        block=200,
    )


def test_rows_do_not_depend_on_the_workers(tmp_path: Path) -> None:
    alone = run_study(small_study(), seed=1)
    many = run_study(small_study(), tmp_path / "out", processes(2), seed=1)
    assert many.blocks.drop("seconds").equals(alone.blocks.drop("seconds"))
    assert many.cells.equals(alone.cells)
    assert many.plans.drop("seconds").equals(alone.plans.drop("seconds"))
    assert {f.name for f in (tmp_path / "out").iterdir()} == {"plans.parquet", "blocks.parquet", "cells.parquet"}
    assert pl.read_parquet(tmp_path / "out/cells.parquet").equals(alone.cells)


def test_extended_study_keeps_what_is_done(tmp_path: Path) -> None:
    first = run_study(replace(small_study(), runs=[4]), tmp_path / "out", seed=1)
    with pytest.raises(InputError, match="--resume"):
        run_study(small_study(), tmp_path / "out", seed=1)
    both = run_study(small_study(), tmp_path / "out", seed=1, resume=True)
    assert both.blocks.filter(runs=4).equals(first.blocks)  # to the very seconds
    assert both.cells.equals(run_study(small_study(), seed=1).cells)


def test_cells_that_cannot_be_done_are_rows() -> None:
    limited = replace(ARM, lower=np.full(4, -1.0), upper=np.full(4, 1.0), name="limited")
    study = Study([ARM, limited], ["dft", "random", "analytic"], [3, 4], truths=[PAPER], replications=10)
    result = run_study(study)
    reason = {(r["arm"], r["plan"], r["runs"]): r["error"] for r in result.cells.filter(status="failed").to_dicts()}
    assert set(reason) == {
        ("paper-4-link", "dft", 3),
        ("paper-4-link", "random", 3),
        ("paper-4-link", "analytic", 3),
        ("limited", "dft", 3),
        ("limited", "random", 3),
        ("limited", "analytic", 3),
        ("limited", "dft", 4),
        ("limited", "analytic", 4),
    }
    assert "3 runs are too few for 4 links" in reason["paper-4-link", "dft", 3]
    assert "joint 1 would leave its limits" in reason["limited", "dft", 4]
    assert "no plan" in reason["limited", "analytic", 4]


# -- the file --
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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm.toml").write_text("name = 'two'\nlinks_mm = [260.0, 180.0]\n[measurement]\nsigma_mm = 0.1\n")
    rows = "\n".join(f"{k + 1},{30 * k},{-70 * k % 360 - 180}" for k in range(7))
    (tmp_path / "plan.csv").write_text(f"run,q1_deg,q2_deg\n{rows}\n")
    (tmp_path / "study.toml").write_text(GOOD)
    return tmp_path


def test_file_is_read(folder: Path) -> None:
    study = load_study(folder / "study.toml")
    assert study.truths[0].joint_offsets == pytest.approx([0.5 * np.pi / 180, 0.25 * np.pi / 180])
    assert study.truths[0].effects is not None
    assert study.truths[0].effects[0].values["a"] == pytest.approx(np.radians(0.03))
    assert study.models[0].effects == ()
    given = study.plans[1]
    assert isinstance(given, tuple)
    name, plan = given
    assert name == "plan.csv"
    assert isinstance(plan, Plan)
    assert len(plan) == 7


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('plans = ["dft"', 'plans = ["dtf"', "did you mean 'dft'"),
        ("replications = 50", "replicatons = 50", "replicatons: unknown key"),
        ("runs = [5]", "", "runs: is missing"),
        ('name = "base"', "", "models[1].name: is missing"),
        ("replications = 50", "replications = 0", "replications: found 0"),
        ("replications = 50", f"replications = 1{23 * '0'}", "<= 1000000000"),
        ("replications = 50", "replications = 1000000\nblock = 1", "block: found 1"),
        ("replications = 50", "sigma_mm = []", "sigma_mm: found 0 values"),
        ("replications = 50", "sigma_mm = [nan]", "sigma_mm[1]: found nan"),
        ("runs = [5]", "runs = [1000000000000]", "runs[1]: found 1000000000000"),
        ("runs = [5]", "runs = [5, 2.5]", "runs[2]: found 2.5"),
        ("length_errors_mm = [1.0,", "length_errors_mm = [1.0, 2.0,", "found 3 values for 2 links"),
        ("joint = 2", "joint = 3", "truths[1].effects: encoder_eccentricity at joint 3"),
        ("encoder_eccentricity", "encoder_excentricity", "did you mean 'encoder_eccentricity'"),
        ('"encoder_eccentricity", joint = 2, a_deg = 0.03, b_deg = -0.01', '"link_bending"', "needs gravity"),
        ("arm.toml", "other.toml", "no such file"),
    ],
)
def test_bad_file_is_one_line(folder: Path, old: str, new: str, found: str) -> None:
    assert old in GOOD
    (folder / "study.toml").write_text(GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_study(folder / "study.toml")
    assert found in str(caught.value)
    assert "study.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"replications": 0},
        {"block": 2.5},
        {"runs": [0]},
        {"runs": [10**7]},
        {"sigma": [float("nan")]},
        {"sigma": [0.0]},
    ],
)
def test_numbers_are_checked_in_python_too(wrong: dict[str, Any]) -> None:
    good = {"arms": [ARM], "plans": ["dft"], "runs": [4]}
    (name,) = wrong
    with pytest.raises(InputError, match=rf"^{name}\w*: found .*, allowed: "):
        Study(**{**good, **wrong})


def test_parts_of_a_block_are_one_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long plans go through memory in parts: the same draws, and sums that do not tell."""
    study = Study([ARM], ["dft"], [6], truths=[PAPER], replications=50)
    whole = run_study(study).cells
    monkeypatch.setattr("doe.studies.monte_carlo.study.MOST_ROWS", 6 * 7)
    parts = run_study(study).cells
    numbers = ["mean_error", "std", "expected_std", "coverage", "rms_mm"]
    np.testing.assert_allclose(parts.select(numbers).to_numpy(), whole.select(numbers).to_numpy(), rtol=1e-9)


def test_names_are_unique() -> None:
    with pytest.raises(InputError, match=r"arms: name '.+' is given twice"):
        Study([ARM, ARM], ["dft"], [4])
    with pytest.raises(InputError, match="truths: name 'arm' is given twice"):
        Study([ARM], ["dft"], [4], truths=[Truth(), Truth()])


# -- the verb --
def test_verb(folder: Path) -> None:
    options = [str(folder / "study.toml"), "--workers", "1"]
    done = CliRunner().invoke(command, [*options, "--json"])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert {cell["runs"] for cell in answer["cells"]} == {5, 7}
    assert answer["failed"] == 0
    assert (folder / "study.results" / "cells.parquet").exists()
    assert CliRunner().invoke(command, options).exit_code == 2
    shown = CliRunner().invoke(command, [*options, "--resume"])
    assert shown.exit_code == 0
    assert "joint_offset:2" in shown.output


def test_a_cell_without_a_fit_has_no_figures() -> None:
    row = dict.fromkeys(("mean_error", "std", "expected_std", "coverage", "rms_mm"))
    row |= {"fits": 0, "failed": 3, "parameter": "length_error:1", "unit": "mm"}
    assert cell_table("arm, plan", [row]).title.endswith("0 fits, 3 failed, RMS - mm")
