"""Studies of spatial arms: intervals hold, errors that cannot be told apart count as what they amount to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doe.plan.plan import Plan
from doe.studies.monte_carlo import Fitted, Study, Truth, load_study, run_study
from doe.studies.monte_carlo.study import in_api_units, in_file_units, true_values
from identification.arm import Arm, Calibration, EffectSpec
from identification.errors import InputError
from identification.files.arm import dump_arm
from identification.for_design import without_prior
from identification.kinematics.chain import DHRow, chain_of
from identification.measurements import Conditions
from identification.model import Model

ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0)]
CHAIN = replace(chain_of(ROWS), tools={"1": np.array([40.0, 30.0, 20.0])})
ARM = Arm(CHAIN, sigma=0.05, name="elbow")
MACHINED = Truth(
    "machined", values={"translation_x:2": 0.4, "translation_y:3": -0.3, "rotation_y:3": 2e-3, "base.x": 2.0}
)
ECCENTRIC = EffectSpec("encoder_eccentricity", 2, {"a": 4e-4, "b": -3e-4})
PLAN = Plan(np.random.default_rng(2).uniform(-2.5, 2.5, (15, 3)))
SETS = 400
FILE = """\
arms = ["elbow.toml"]
plans = ["random"]
runs = [9]
replications = 5

[[truths]]
name = "machined"
values = {"rotation_y:3" = 0.1}
"""


def test_true_values_put_the_point_where_the_truth_does() -> None:
    """Without noise the fitted set, which is smaller than that of the errors, ends at the positions of all of them."""
    model, truth = Model(without_prior(ARM)), Model(MACHINED.of(ARM))
    assert len(model.names) < len(truth.names)
    postures = np.random.default_rng(5).uniform(-3.0, 3.0, (30, 3))
    found = model.position(postures, true_values(model, truth))
    np.testing.assert_allclose(found, truth.position(postures), atol=1e-5)


def test_intervals_hold_and_a_missing_effect_is_a_bias() -> None:
    truths = [MACHINED, replace(MACHINED, name="eccentric", effects=(ECCENTRIC,))]
    study = Study([ARM], [("plan", PLAN), "dft"], [15], (), truths, [Fitted("geometry", ())], SETS, SETS)
    cells = run_study(study, seed=3).cells
    rows = cells.filter(cells["plan"] == "plan", cells["truth"] == "machined")
    assert rows["failed"].to_list() == [0] * len(Model(without_prior(ARM)).names)
    spread = 5.0 / np.sqrt(2.0 * SETS)  # five standard errors of a standard deviation
    np.testing.assert_allclose(rows["std"] / rows["expected_std"], 1.0, atol=spread)
    assert (rows["mean_error"].abs() < 5.0 * rows["mean_error_se"]).all()
    assert ((rows["coverage"] - 0.95).abs() < 5.0 * np.sqrt(0.95 * 0.05 / SETS)).all()
    other = cells.filter(cells["plan"] == "plan", cells["truth"] == "eccentric")
    assert other["rms_mm"][0] > 1.5 * rows["rms_mm"][0]
    assert (other["mean_error"] / other["mean_error_se"]).abs().to_numpy().max() > 20.0
    assert "is spatial, allowed: planar arms" in cells.filter(cells["plan"] == "dft")["error"][0]


def test_a_study_file_with_values(tmp_path: Path) -> None:
    (tmp_path / "elbow.toml").write_text(dump_arm(ARM))
    (tmp_path / "planar.toml").write_text("links_mm = [300.0, 200.0, 100.0]\n[measurement]\nsigma_mm = 0.1\n")
    path = tmp_path / "study.toml"
    path.write_text(FILE)
    study = load_study(path)
    assert study.truths[0].values == {"rotation_y:3": pytest.approx(np.radians(0.1))}
    assert run_study(study).cells["fits"].to_list() == [5] * len(Model(without_prior(ARM)).names)
    for old, new, sentence in (
        ("rotation_y:3", "rotation_w:3", "truths[1].values: unknown parameter 'rotation_w:3', did you mean"),
        ("elbow.toml", "planar.toml", "truths[1].values: arm arm is planar, allowed: spatial arms"),
        ('values = {"rotation_y:3" = 0.1}', "length_errors_mm = [1.0]", "length_errors_mm: found for a spatial arm"),
    ):
        path.write_text(FILE.replace(old, new))
        with pytest.raises(InputError) as error:
            load_study(path)
        assert sentence in str(error.value)


SEVERAL = {"tools": {"a": np.array([40.0, 30.0, 20.0]), "b": np.array([-50.0, 10.0, 60.0])}}
POSES = {"angle_scale": 100.0}


@pytest.mark.parametrize("measured", [SEVERAL, SEVERAL | POSES])
def test_every_point_and_frame_is_measured_at_every_posture(measured: dict[str, Any]) -> None:
    """Expected deviations from (sum of J^T J)^-1 with J by central differences of the model's own positions and turned
    axes; the fits scatter by as much, and the intervals hold."""
    chain = replace(CHAIN, **measured)
    arm = Arm(chain, sigma=0.05, name="elbow")
    study = Study([arm], [("plan", Plan(PLAN.postures[:8])), "random"], [9], (), [MACHINED], replications=100)
    cells = run_study(study, seed=4).cells
    model, count = Model(without_prior(arm)), len(chain.tools)
    values = true_values(model, Model(MACHINED.of(study.arms[0])))
    q, marker = np.repeat(PLAN.postures[:8], count, axis=0), Conditions(marker=np.arange(8 * count) % count)
    if chain.angle_scale is not None:
        known = Calibration(dict(zip(model.names, values.tolist(), strict=True)))
        real = Model(replace(model.arm, calibration=known))
        marker = replace(marker, orientation=real.orientations(q, marker))
    steps = 1e-4 * np.diag(1.0 / model.scales)
    moved = [model.position(q, values + step, marker) - model.position(q, values - step, marker) for step in steps]
    at = np.array(moved).reshape(len(values), -1) / 2e-4 * model.scales[:, None]
    expected = 0.05 * np.sqrt(np.diag(np.linalg.inv(at @ at.T)))
    rows = cells.filter(cells["plan"] == "plan")
    factors = [p.to_file for p in model.parameters]
    np.testing.assert_allclose(rows["expected_std"], expected * factors, rtol=1e-4)
    for plan in ("plan", "random"):
        rows = cells.filter(cells["plan"] == plan)
        assert rows["failed"].to_list() == [0] * len(model.names)
        spread = 5.0 / np.sqrt(2.0 * 100)  # five standard errors of a standard deviation
        if plan == "plan":
            np.testing.assert_allclose(rows["std"], rows["expected_std"], rtol=spread)
            assert np.abs(rows["mean_error"] / rows["expected_std"]).max() < 5.0 / np.sqrt(100)
        assert rows["coverage"].mean() == pytest.approx(0.95, abs=0.03)
        assert rows["rms_mm"].is_null().all() == (chain.angle_scale is not None)


def test_several_points_make_up_for_few_postures() -> None:
    with pytest.raises(InputError, match="runs: found 2, allowed: at least"):
        Study([Arm(replace(CHAIN, **SEVERAL), sigma=0.1)], ["random"], [2])


def test_units_of_sliding_joints() -> None:
    types = ("revolute", "prismatic")
    postures = np.array([[np.pi, 250.0]])
    np.testing.assert_array_equal(in_file_units(postures, types), [[180.0, 250.0]])
    np.testing.assert_array_equal(in_api_units(in_file_units(postures, types), types), postures)
