"""How a controller counts: the formula as a recursion, its reverse, what no controller has; whole turns, ranges."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import DesignProblem
from identification import (
    PRISMATIC,
    REVOLUTE,
    Arm,
    Calibration,
    InputError,
    Measurements,
    Model,
    Plan,
    estimate,
    load_arm,
    load_measurements,
    turned_into,
)
from identification.estimation.doubts import outside_limits
from identification.files.measurement import load_targets, measurement_text
from identification.kinematics.counting import Counting, JointKinds, joint_range, range_of
from identification.simulate import simulate
from tests.refusals import refused


@st.composite
def countings(draw: st.DrawFn, joints: int | None = None) -> Counting:
    """Any: joints are coupled to ones that come before in some order, so that there is no circle."""
    n = joints or draw(st.integers(1, 6))
    order = draw(st.permutations(range(1, n + 1)))
    coupled = [0] * n
    for place, joint in enumerate(order):
        coupled[joint - 1] = draw(st.sampled_from([0, *order[:place]])) * draw(st.sampled_from([1, -1]))
    signs = draw(st.lists(st.sampled_from([1, -1]), min_size=n, max_size=n))
    return Counting(tuple(signs), tuple(coupled), tuple(draw(st.lists(st.floats(-7.0, 7.0), min_size=n, max_size=n))))


def shown(counting: Counting, joints: np.ndarray) -> list[float]:
    """c_j = s_j a_j + z_j, a_j = q_j +- a_k, one joint after the other."""

    def angle(j: int) -> float:
        other = counting.coupled_to[j - 1]
        return joints[j - 1] + (0.0 if other == 0 else np.sign(other) * angle(abs(other)))

    return [s * angle(j) + z for j, (s, z) in enumerate(zip(counting.sign, counting.zero, strict=True), start=1)]


@given(countings(), st.randoms(use_true_random=False))
def test_columns_and_joints(counting: Counting, random: object) -> None:
    n = len(counting.sign)
    q = np.random.default_rng(random.randint(0, 99)).uniform(-3.0, 3.0, (4, n))  # type: ignore[attr-defined]
    columns = counting.columns(q)
    np.testing.assert_allclose(columns, [shown(counting, row) for row in q], atol=1e-12)
    np.testing.assert_allclose(counting.joints(columns), q, atol=1e-12)
    again = Counting.of_matrix(counting.matrix, counting.zero)
    assert again is not None  # perhaps said in another way
    np.testing.assert_array_equal(again.matrix, counting.matrix)
    assert JointKinds(pickle.loads(pickle.dumps(JointKinds(["revolute"] * n, counting)))).counting == counting
    np.testing.assert_array_equal(JointKinds(("revolute",) * n).counting.columns(q), q)


@given(countings(), st.randoms(use_true_random=False))
def test_limits_hold_all_that_columns_allow(counting: Counting, random: object) -> None:
    """Columns anywhere within their limits leave the joints within theirs, and every limit is reached at a corner."""
    n = len(counting.sign)
    generator = np.random.default_rng(random.randint(0, 99))  # type: ignore[attr-defined]
    lower, upper = np.sort(generator.uniform(-3.0, 3.0, (2, n)), axis=0)
    low, high = counting.joint_limits(lower, upper)
    joints = counting.joints(np.where(np.array(list(np.ndindex(*[2] * n))) == 1, upper, lower))
    np.testing.assert_allclose(joints.min(axis=0), low, atol=1e-12)
    np.testing.assert_allclose(joints.max(axis=0), high, atol=1e-12)


def test_joint_3_from_the_horizontal() -> None:
    """Joint 2 at 30 and joint 3 at 20 degrees from it: the column of joint 3, reversed and with a zero of 5, is -45."""
    counting = Counting((1, 1, -1), (0, 0, 2), (0.0, 0.0, np.radians(5.0)))
    np.testing.assert_allclose(np.degrees(counting.columns(np.radians([10.0, 30.0, 20.0]))), [10.0, 30.0, -45.0])
    assert counting.toml == "[joints]\nsign = [1, 1, -1]\ncoupled_to = [0, 0, 2]\nzero_deg = [0.0, 0.0, 5.0]"
    # joints 2 and 3 both rising: column 3 falls; joint 2 rising, joint 3 falling: nobody knows
    directions = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [np.nan, -1.0, -1.0]])
    nobody = np.nan
    np.testing.assert_array_equal(counting.signs_of_columns(directions), [[1, 1, -1], [1, 1, nobody], [nobody, -1, 1]])
    # column 3 falling: the sum rises; joint 2 falling, joint 3 rises
    columns = np.array([[1.0, -1.0, -1.0], [1.0, 1.0, -1.0]])
    np.testing.assert_array_equal(counting.signs_of_columns(columns, back=True), [[1, -1, 1], [1, 1, nobody]])


def test_sums_of_several_joints_are_not_said() -> None:
    """Column 3 = q1 + q2 + q3 where column 2 is q2 alone."""
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    assert Counting.of_matrix(matrix, [0.0] * 3) is None
    matrix[1, 0] = 1.0
    found = Counting.of_matrix(matrix, [0.0] * 3)
    assert found is not None
    assert found.coupled_to == (0, 1, 2)


@pytest.mark.parametrize(
    ("sign", "coupled", "zero", "said"),
    [
        ((1, 2), (0, 0), (0.0, 0.0), "joints.sign: found 2 for joint 2, allowed: 1 or -1"),
        ((1, 1), (0, 0), (0.0,), "joints.zero_deg: found 1 values, allowed: 2"),
        ((1, 1), (0, 3), (0.0, 0.0), "joints.coupled_to: found 3 for joint 2, allowed: another joint, 1 to 2, or 0"),
        ((1, 1), (2, -1), (0.0, 0.0), "joints.coupled_to: found a circle through joint 1, allowed: joints that lead"),
    ],
)
def test_what_no_controller_has(sign: tuple, coupled: tuple, zero: tuple, said: str) -> None:
    refused(Counting, sign, coupled, zero, names=[said])


def test_sliding_joints() -> None:
    kinds = ("revolute", "prismatic", "revolute")
    Counting((1, -1, 1), (0, 0, 1), (1.0, 0.0, 0.0)).check(kinds)
    with pytest.raises(InputError, match="coupled_to: found 1 for joint 2, which is prismatic, allowed: a joint of"):
        Counting((1, 1, 1), (0, 1, 0), (0.0, 0.0, 0.0)).check(kinds)
    with pytest.raises(InputError, match=r"zero_deg: found 57\.2958 for joint 2, which is prismatic, allowed: 0"):
        Counting((1, 1, 1), (0, 0, 0), (0.0, 1.0, 0.0)).check(kinds)
    with pytest.raises(InputError, match="sign: found 1 values, allowed: 3"):
        Counting((1,), (0,), (0.0,)).check(kinds)


TYPES = ("revolute", "prismatic", "revolute")
POSTURES = np.array([[np.pi / 6.0, 12.5, -1.0], [-np.pi / 3.0, 200.0, -0.5]])


def test_what_was_written_is_read() -> None:
    for joints in ([0, 1, 2], [0], [1], [2, 1]):
        types = [TYPES[j] for j in joints]
        found = range_of(joint_range(POSTURES[:, joints], types), types)
        assert found is not None
        np.testing.assert_allclose(found, [POSTURES[:, joints].min(axis=0), POSTURES[:, joints].max(axis=0)], rtol=1e-8)


@given(st.floats(-20.0, 20.0), st.floats(-4.0, 4.0), st.floats(0.1, 8.0))
def test_whole_turns_into_limits(angle: float, lower: float, width: float) -> None:
    """A revolute joint is moved by whole turns to within its limits where a turn brings it there; one inside stays, and
    so does one that slides."""
    limits, slack = (np.array([lower] * 2), np.array([lower + width] * 2)), 1e-6
    turned, slid = turned_into(np.array([[angle, angle]]), *limits, [REVOLUTE, PRISMATIC], slack)[0]
    turns = (turned - angle) / (2.0 * np.pi)
    inside = lower - slack <= angle <= lower + width + slack
    possible = (lower - slack - angle) / (2.0 * np.pi), (lower + width + slack - angle) / (2.0 * np.pi)
    assert slid == angle
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert turned == angle if inside else True
    if np.floor(possible[1] - 1e-9) >= np.ceil(possible[0] + 1e-9):
        assert lower - 2.0 * slack <= turned <= lower + width + 2.0 * slack
    else:
        assert turned == angle or abs(turned - lower) < 1e-5 or abs(turned - lower - width) < 1e-5


# -- arm files with [joints] -------------------------------------------------------------------------------------------
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
    q = np.random.default_rng(3).uniform(arm.lower, arm.upper, (2000, 3))
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
    path.write_text(Plan(q, joint_types=kinds).text())
    np.testing.assert_allclose(Plan.load(path, kinds).postures, q, atol=1e-12)
    np.testing.assert_allclose(np.radians(Plan.load(path).postures * 180.0 / np.pi), counting.columns(q), atol=1e-12)


def test_measurements_and_targets(tmp_path: Path, arm: Arm) -> None:
    """The columns by hand, and what is read of them: angles, commands, and signs of motions."""
    generator = np.random.default_rng(5)
    q = generator.uniform(-1.0, 1.0, (20, 3))
    data = Measurements(q, q[:, :2], commanded=q + 0.01, directions=np.sign(generator.standard_normal((20, 3))))
    (tmp_path / "data.csv").write_text(measurement_text(data, arm.joint_types))
    by_hand = np.column_stack([q[:, 0], q[:, 1] + np.pi / 2.0, np.radians(5.0) - q[:, 1] - q[:, 2]])
    np.testing.assert_allclose(load_measurements(tmp_path / "data.csv", 3).postures, by_hand, atol=1e-12)
    again = load_measurements(tmp_path / "data.csv", arm)
    np.testing.assert_allclose(again.postures, q, atol=1e-12)
    np.testing.assert_allclose(again.commanded, q + 0.01, atol=1e-12)
    known = ~np.isnan(again.directions)
    assert known[:, :2].all()
    assert not known[:, 2].all()  # joint 2 falls, column 3 too: the joint may do either
    np.testing.assert_array_equal(again.directions[known], data.directions[known])
    (tmp_path / "targets.csv").write_text(Plan(q, joint_types=arm.joint_types).text())
    np.testing.assert_allclose(load_targets(tmp_path / "targets.csv", arm)["postures"], q, atol=1e-12)
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
