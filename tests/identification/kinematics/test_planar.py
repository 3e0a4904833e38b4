"""The planar arm as a chain: against complex numbers, in numpy and in symbols."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.kinematics.chain import planar_chain
from identification.kinematics.parameters import ParameterSet, chain_parameters, orientation_transform

GENERATOR = np.random.default_rng(4)
LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
POSTURES = GENERATOR.uniform(-np.pi, np.pi, (7, 4))
NO_ERRORS = np.zeros(8)


def by_complex_numbers(lengths: np.ndarray, posture: np.ndarray) -> list[complex]:
    """Base to tip, one joint at a time: every link turned by the joints up to it."""
    points = [0j]
    for j, length in enumerate(lengths):
        points.append(points[-1] + length * np.exp(1j * sum(posture[: j + 1])))
    return points


def test_points_of_a_chain() -> None:
    points = planar_chain(LENGTHS).points(POSTURES, NO_ERRORS)
    assert points.shape == (7, 5, 2)
    expected = np.array([by_complex_numbers(LENGTHS, posture) for posture in POSTURES])
    # 1e-12 mm: a few units in the last place of 660 mm
    np.testing.assert_allclose(points[..., 0] + 1j * points[..., 1], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(planar_chain(LENGTHS).points(POSTURES[None], NO_ERRORS)[0], points)


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_errors_lengthen_links_and_turn_joints_in_symbols_too(n: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    lengths, posture = generator.uniform(10.0, 500.0, n), generator.uniform(-4.0, 4.0, n)
    errors, offsets = generator.normal(0.0, 1.0, n), generator.normal(0.0, 0.1, n)
    chain, q = planar_chain(lengths), ca.SX.sym("q", n)
    symbolic = ca.Function("points", [q], [ca.horzcat(*chain.symbolic_points(q, np.r_[errors, offsets]))])
    points = np.array(symbolic(posture)).T @ [1.0, 1.0j]
    np.testing.assert_allclose(points, by_complex_numbers(lengths + errors, posture + offsets), rtol=0, atol=1e-10)
    np.testing.assert_allclose(chain.points(posture[None], np.r_[errors, offsets])[0] @ [1.0, 1.0j], points, atol=1e-10)


def test_bent_links_displace_and_turn_what_follows() -> None:
    """A link (l, d) with slope s is the complex number l + i d, and turns all links after it by s."""
    posture, deflection, slope = np.array([0.3, -1.1]), np.array([2.0, -1.0]), np.array([0.01, 0.02])
    bent = {"deflections": ca.SX(deflection), "slopes": ca.SX(slope)}
    frames = planar_chain(LENGTHS[:2]).frames(ca.SX(posture), {}, bent)
    elbow = (LENGTHS[0] + 1j * deflection[0]) * np.exp(1j * posture[0])
    tip = elbow + (LENGTHS[1] + 1j * deflection[1]) * np.exp(1j * (posture.sum() + slope[0]))
    turn = np.exp(1j * (posture.sum() + slope.sum()))
    np.testing.assert_allclose(np.array(ca.DM(frames[2].origin)).ravel(), [elbow.real, elbow.imag, 0.0], rtol=1e-14)
    np.testing.assert_allclose(np.array(ca.DM(frames[3].origin)).ravel(), [tip.real, tip.imag, 0.0], rtol=1e-14)
    np.testing.assert_allclose(np.array(ca.DM(frames[3].axes))[:, 0], [turn.real, turn.imag, 0.0], rtol=1e-14)


def test_orientations_sum_the_offsets() -> None:
    """dtheta_j = dq_1 + ... + dq_j; where an offset is known, the others only."""
    parameters = chain_parameters([300.0, 200.0])
    np.testing.assert_array_equal(orientation_transform(parameters), [[0, 0, 1, 0], [0, 0, 1, 1]])
    without = ParameterSet(p for p in parameters if p.name not in ("length_error:2", "joint_offset:1"))
    np.testing.assert_array_equal(orientation_transform(without), [[0, 1]])


def test_offsets_are_scaled_by_the_best_known_lengths() -> None:
    """Also where an error turns a link around; the drawing's length where nothing of the link is left."""
    best = {"length_error:1": 5.0, "length_error:2": -200.0, "length_error:3": -120.0}
    scales = planar_chain(LENGTHS).parameters(best).scales
    np.testing.assert_array_equal(scales, [1.0, 1.0, 1.0, 1.0, 265.0, 20.0, 120.0, 100.0])


def test_a_shift_along_the_axes_of_the_base_turns_with_it() -> None:
    """The offset of joint 1 turns the base of a planar arm."""
    chain, shift = planar_chain(LENGTHS), {"base_offset.x0": 2.0, "joint_offset:1": 0.1}
    turned, back = 2.0 * np.exp(0.3j), 2.0 * np.exp(-0.3j)
    by_instrument = chain.along_base(shift, {"joint_offset:1": 0.3})
    along_own_axes = chain.along_base(shift, {"joint_offset:1": 0.3}, back=True)
    for components, expected in ((by_instrument, turned), (along_own_axes, back)):
        assert {name: float(x) for name, x in components.items()} == {
            "base_offset.x0": pytest.approx(expected.real),
            "base_offset.y0": pytest.approx(expected.imag),
        }
    assert chain.along_base({"joint_offset:1": 0.1}, {"joint_offset:1": 0.3}) == {}
