"""How a controller counts: the formula as a recursion, its reverse, what no controller has; whole turns, ranges."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification import PRISMATIC, REVOLUTE, InputError, turned_into
from identification.kinematics.counting import (
    Counting,
    JointKinds,
    check_kinds,
    counting_in,
    in_columns,
    in_joints,
    joint_range,
    range_of,
)
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
    zeros = draw(st.lists(st.floats(-7.0, 7.0), min_size=n, max_size=n))
    return Counting(tuple(signs), tuple(coupled), tuple(zeros))


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
    kinds = JointKinds(["revolute"] * n, counting)
    np.testing.assert_array_equal(in_columns(q, kinds), columns)
    np.testing.assert_array_equal(in_joints(q, kinds), counting.joints(q))
    assert counting_in(pickle.loads(pickle.dumps(kinds))) == counting
    assert in_columns(q, ("revolute",) * n) is q


@given(countings(), st.randoms(use_true_random=False))
def test_limits_hold_all_that_columns_allow(counting: Counting, random: object) -> None:
    """Columns anywhere within their limits leave the joints within theirs, and every limit is reached at a corner."""
    n = len(counting.sign)
    generator = np.random.default_rng(random.randint(0, 99))  # type: ignore[attr-defined]
    lower, upper = np.sort(generator.uniform(-3.0, 3.0, (2, n)), axis=0)
    low, high = counting.joint_limits(lower, upper)
    corners = np.where(np.array(list(np.ndindex(*[2] * n))) == 1, upper, lower)
    joints = counting.joints(corners)
    np.testing.assert_allclose(joints.min(axis=0), low, atol=1e-12)
    np.testing.assert_allclose(joints.max(axis=0), high, atol=1e-12)


def test_joint_3_from_the_horizontal() -> None:
    """Joint 2 at 30 and joint 3 at 20 degrees from it: the column of joint 3, reversed and with a zero of 5, is -45."""
    counting = Counting((1, 1, -1), (0, 0, 2), (0.0, 0.0, np.radians(5.0)))
    q = np.radians([10.0, 30.0, 20.0])
    np.testing.assert_allclose(np.degrees(counting.columns(q)), [10.0, 30.0, -45.0])
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
    check_kinds(Counting((1, -1, 1), (0, 0, 1), (1.0, 0.0, 0.0)), kinds)
    with pytest.raises(InputError, match="coupled_to: found 1 for joint 2, which is prismatic, allowed: a joint of"):
        check_kinds(Counting((1, 1, 1), (0, 1, 0), (0.0, 0.0, 0.0)), kinds)
    with pytest.raises(InputError, match=r"zero_deg: found 57\.2958 for joint 2, which is prismatic, allowed: 0"):
        check_kinds(Counting((1, 1, 1), (0, 0, 0), (0.0, 1.0, 0.0)), kinds)
    with pytest.raises(InputError, match="sign: found 1 values, allowed: 3"):
        check_kinds(Counting((1,), (0,), (0.0,)), kinds)


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
