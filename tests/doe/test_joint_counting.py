"""`[joints]` of arm files: columns, commands and limits stay the controller's, the model has its own angles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import DesignProblem
from identification import Arm, Calibration, Measurements, Model, Plan, estimate, load_arm, load_measurements
from identification.estimation.doubts import outside_limits
from identification.files.measurement import Targets, measurement_text
from identification.kinematics.counting import Counting, JointKinds
from identification.simulate import simulate
from tests.identification.kinematics.test_counting import countings

PLANAR = """\
links_mm = [400.0, 300.0, 200.0]

[joint_limits_deg]
lower = [-170.0, -60.0, -150.0]
upper = [170.0, 80.0, 40.0]

[measurement]
sigma_mm = 0.05

[joints]
sign = [1, 1, -1]
coupled_to = [0, 0, 2]
zero_deg = [0.0, 90.0, 5.0]
"""
COUNTING = Counting((1, 1, -1), (0, 0, 2), (0.0, np.radians(90.0), np.radians(5.0)))


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    (tmp_path / "arm.toml").write_text(PLANAR)
    return load_arm(tmp_path / "arm.toml")


def test_limits_are_the_controllers(arm: Arm) -> None:
    """Column 2 of -60 to 80 is joint 2 of -150 to -10. Column 3 of -150 to 40 is a sum q2 + q3 of -35 to 155, so that
    joint 3 is anywhere in -25 to 305, and which of these angles it may have depends on joint 2."""
    assert arm.counting == COUNTING
    np.testing.assert_allclose(np.degrees([arm.lower, arm.upper]), [[-170.0, -150.0, -25.0], [170.0, -10.0, 305.0]])
    problem = DesignProblem.of(Model(arm))
    generator = np.random.default_rng(3)
    q = generator.uniform(arm.lower, arm.upper, (2000, 3))
    joints = np.degrees(q)
    columns = np.column_stack([joints[:, 0], 90.0 + joints[:, 1], 5.0 - joints[:, 1] - joints[:, 2]])
    within = np.all((columns >= [-170.0, -60.0, -150.0]) & (columns <= [170.0, 80.0, 40.0]), axis=1)
    assert 0.1 < within.mean() < 0.9
    np.testing.assert_array_equal(problem.feasible(q), within)
    said = outside_limits(arm, Measurements(q[~within], np.zeros((np.sum(~within), 2))))
    first = np.flatnonzero((columns[~within][0] < [-170, -60, -150]) | (columns[~within][0] > [170, 80, 40]))[0]
    assert f"row 1: joint {first + 1} at {columns[~within][0][first]:.5g} deg, allowed -150 to 40" in said[0]


@settings(max_examples=25)
@given(countings(), st.randoms(use_true_random=False))
def test_a_plan_comes_back(tmp_path_factory: pytest.TempPathFactory, counting: Counting, random: object) -> None:
    n = len(counting.sign)
    kinds = JointKinds(["revolute"] * n, counting)
    q = np.random.default_rng(random.randint(0, 99)).uniform(-3.0, 3.0, (4, n))  # type: ignore[attr-defined]
    path = tmp_path_factory.mktemp("plans") / "plan.csv"
    for text in (Plan(q).text(kinds), Plan(q, joint_types=kinds).to_frame().write_csv()):
        path.write_text(text)
        np.testing.assert_allclose(Plan.load(path, kinds).postures, q, atol=1e-12)
        np.testing.assert_allclose(
            np.radians(Plan.load(path).postures * 180.0 / np.pi), counting.columns(q), atol=1e-12
        )


def test_measurements_and_targets(tmp_path: Path, arm: Arm) -> None:
    """The columns by hand, and what is read of them: angles, commands, and signs of motions."""
    generator = np.random.default_rng(5)
    q = generator.uniform(-1.0, 1.0, (20, 3))
    data = Measurements(q, q[:, :2], commanded=q + 0.01, directions=np.sign(generator.standard_normal((20, 3))))
    (tmp_path / "data.csv").write_text(measurement_text(data, arm.joint_types))
    plain = load_measurements(tmp_path / "data.csv", 3)
    by_hand = np.column_stack([q[:, 0], q[:, 1] + np.pi / 2.0, np.radians(5.0) - q[:, 1] - q[:, 2]])
    np.testing.assert_allclose(plain.postures, by_hand, atol=1e-12)
    again = load_measurements(tmp_path / "data.csv", arm)
    np.testing.assert_allclose(again.postures, q, atol=1e-12)
    np.testing.assert_allclose(again.commanded, q + 0.01, atol=1e-12)
    known = ~np.isnan(again.directions)
    assert known[:, :2].all()
    assert not known[:, 2].all()  # joint 2 falls, column 3 too: the joint may do either
    np.testing.assert_array_equal(again.directions[known], data.directions[known])
    (tmp_path / "targets.csv").write_text(Plan(q).text(arm.joint_types))
    wanted = Targets.load(tmp_path / "targets.csv", arm).postures
    np.testing.assert_allclose(wanted, q, atol=1e-12)
    (tmp_path / "plan.csv").write_text("run,q1_deg,q2_deg,q3_deg,direction1,direction2,direction3\n1,1,2,3,1,-1,-1\n")
    found = Plan.load(tmp_path / "plan.csv", arm.joint_types).conditions["directions"]
    np.testing.assert_array_equal(found, [[1.0, -1.0, 1.0]])


def test_corrected_zeros_are_the_controllers(arm: Arm) -> None:
    """What is added to column 3, reversed and with joint 2 in it, is -(dq2 + dq3); its deviation by the covariance."""
    q = np.random.default_rng(7).uniform(-1.0, 1.0, (30, 3))
    truth = replace(arm, calibration=Calibration.of([0.5, -0.4, 0.3], [0.0, 0.004, -0.003]))
    fit = estimate(Model(arm), simulate(truth, q, np.random.default_rng(8)))
    row = next(row for row in fit.corrected_values if row.name == "zero of joint 3")
    both = [fit.names.index(f"joint_offset:{j}") for j in (2, 3)]
    assert row.corrected == pytest.approx(-np.degrees(fit.parameters[both].sum()))
    assert row.std == pytest.approx(np.degrees(np.sqrt(fit.covariance[np.ix_(both, both)].sum())))
    # corrected columns are the columns of corrected joints
    offsets = fit.joint_offsets
    corrections = [next(r for r in fit.corrected_values if r.name == f"zero of joint {j}").corrected for j in (1, 2, 3)]
    np.testing.assert_allclose(
        COUNTING.columns(q) + np.radians(np.array(corrections, dtype=float)), COUNTING.columns(q + offsets), atol=1e-12
    )
