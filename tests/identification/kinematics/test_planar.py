"""The planar chain against complex numbers, and its symbolic form against numpy."""

import casadi as ca
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from identification.kinematics.parameters import ParameterSet, chain_parameters
from identification.kinematics.planar import (
    PlanarGeometry,
    joint_points,
    orientation_transform,
    rotate,
    symbolic_chain,
    symbolic_points,
)

GENERATOR = np.random.default_rng(4)
LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
POSTURES = GENERATOR.uniform(-np.pi, np.pi, (7, 4))


def by_complex_numbers(lengths: np.ndarray, posture: np.ndarray) -> list[complex]:
    """Base to tip, one joint at a time: every link turned by the joints up to it."""
    points = [0j]
    for j, length in enumerate(lengths):
        points.append(points[-1] + length * np.exp(1j * sum(posture[: j + 1])))
    return points


def test_points_of_a_chain() -> None:
    points = joint_points(LENGTHS, POSTURES)
    assert points.shape == (7, 5, 2)
    expected = np.array([by_complex_numbers(LENGTHS, posture) for posture in POSTURES])
    # 1e-12 mm: a few units in the last place of 660 mm
    np.testing.assert_allclose(points[..., 0] + 1j * points[..., 1], expected, rtol=0, atol=1e-12)


def test_stacks_of_plans() -> None:
    plans = POSTURES[:6].reshape(2, 3, 4)
    np.testing.assert_array_equal(joint_points(LENGTHS, plans), joint_points(LENGTHS, POSTURES[:6]).reshape(2, 3, 5, 2))


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_symbolic_points_are_the_same_points(n: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    lengths, posture = generator.uniform(10.0, 500.0, n), generator.uniform(-4.0, 4.0, n)
    q = ca.SX.sym("q", n)
    function = ca.Function("points", [q], [ca.horzcat(*symbolic_points(lengths, q))])
    np.testing.assert_allclose(
        np.array(function(posture)).T, joint_points(lengths, posture[None])[0], rtol=0, atol=1e-10
    )


def test_bent_links_displace_and_turn_what_follows() -> None:
    """A link (l, d) with slope s is the complex number l + i d, and turns all links after it by s."""
    posture, deflection, slope = np.array([0.3, -1.1]), np.array([2.0, -1.0]), np.array([0.01, 0.02])
    points, theta = symbolic_chain(ca.SX(LENGTHS[:2]), ca.SX(posture), ca.SX(deflection), ca.SX(slope))
    elbow = (LENGTHS[0] + 1j * deflection[0]) * np.exp(1j * posture[0])
    tip = elbow + (LENGTHS[1] + 1j * deflection[1]) * np.exp(1j * (posture.sum() + slope[0]))
    np.testing.assert_allclose(np.array(ca.DM(points[1])).ravel(), [elbow.real, elbow.imag], rtol=1e-14)
    np.testing.assert_allclose(np.array(ca.DM(points[2])).ravel(), [tip.real, tip.imag], rtol=1e-14)
    np.testing.assert_allclose(float(ca.DM(theta)), posture.sum() + slope.sum(), rtol=1e-14)


def test_a_quarter_turn() -> None:
    turned = np.array(ca.DM(rotate(np.pi / 2.0, ca.SX([3.0, 4.0])))).ravel()
    np.testing.assert_allclose(turned, [-4.0, 3.0], atol=1e-15)


def test_orientations_sum_the_offsets() -> None:
    """dtheta_j = dq_1 + ... + dq_j; where an offset is known, the others only."""
    parameters = chain_parameters([300.0, 200.0])
    np.testing.assert_array_equal(orientation_transform(parameters), [[0, 0, 1, 0], [0, 0, 1, 1]])
    without = ParameterSet.of(p for p in parameters if p.name not in ("length_error:2", "joint_offset:1"))
    np.testing.assert_array_equal(orientation_transform(without), [[0, 1]])


def test_offsets_are_scaled_by_the_best_known_lengths() -> None:
    """Also where an error turns a link around; the drawing's length where nothing of the link is left."""
    best = {"length_error:1": 5.0, "length_error:2": -200.0, "length_error:3": -120.0}
    scales = PlanarGeometry(LENGTHS).parameters(best).scales
    np.testing.assert_array_equal(scales, [1.0, 1.0, 1.0, 1.0, 265.0, 20.0, 120.0, 100.0])
