"""The model against complex arithmetic; effects by a simulator: tests/doe/studies/blind/test_simulator.py."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from doe.criteria import information_matrix
from identification import Arm, Calibration, Conditions, EffectSpec, InputError, Model

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
POSTURES = np.random.default_rng(3).uniform(-np.pi, np.pi, (6, 4))


def test_what_other_parameters_do_as_well() -> None:
    """The base turned, the tool elsewhere, the instrument's unit: in complex numbers."""
    plain, last = Model(Arm(LENGTHS)).position(POSTURES) @ [1.0, 1.0j], np.exp(1j * POSTURES.sum(axis=1))
    for name, values, expected in (
        ("base_rotation", {"angle": 0.3}, plain * np.exp(0.3j)),
        ("tool_offset", {"x": 5.0, "y": -2.0}, plain + (5.0 - 2.0j) * last),
        ("measurement_scale", {"s": 1e-3}, plain * 1.001),
    ):
        found = Model(Arm(LENGTHS, effects=(EffectSpec(name, None, values),))).position(POSTURES)
        np.testing.assert_allclose(found @ [1.0, 1.0j], expected, rtol=1e-13)


@pytest.mark.parametrize("n", [1, 12])
def test_information_in_orientations_is_eq_18_19_corrected(n: int) -> None:
    generator = np.random.default_rng(n)
    arm = Arm(generator.uniform(50, 300, n))
    postures = generator.uniform(-np.pi, np.pi, (9, n))
    jacobian = Model(arm).jacobian(postures)
    # dtheta = T dq, so the columns by dtheta are those by dq times T^-1
    to_offsets = np.linalg.inv(np.tril(np.ones((n, n))))
    by_orientation = np.concatenate([jacobian[..., n:] @ to_offsets, jacobian[..., :n]], axis=-1)
    theta = np.cumsum(postures, axis=1)
    difference = theta[:, :, None] - theta[:, None, :]
    c, s, lengths = np.cos(difference).sum(0), np.sin(difference).sum(0), np.diag(arm.lengths)
    expected = np.block([[lengths @ c @ lengths, -lengths @ s], [(-lengths @ s).T, c]])
    np.testing.assert_allclose(information_matrix(by_orientation), expected, rtol=0, atol=1e-12 * expected.max())


def test_parameter_sets_broadcast_like_single_calls() -> None:
    generator = np.random.default_rng(3)
    effects = EffectSpec("encoder_eccentricity", 2), EffectSpec("base_drift")
    model, conditions = Model(Arm(LENGTHS, effects=effects)), Conditions(time=np.linspace(-0.5, 0.5, 6))
    sets = generator.uniform(0, 1, (5, len(model.names))) / model.scales
    position, jacobian = model.linearize(POSTURES, sets, conditions)
    assert position.shape == (5, 6, 2)
    assert jacobian.shape == (5, 6, 2, len(model.names))
    for k in range(5):
        np.testing.assert_array_equal(position[k], model.position(POSTURES, sets[k], conditions))
        np.testing.assert_array_equal(jacobian[k], model.jacobian(POSTURES, sets[k], conditions))


def test_known_parameters_are_left_out_and_used() -> None:
    effect = EffectSpec("encoder_eccentricity", 2, {"a": 0.01})
    model = Model(Arm([200.0, 100.0], effects=(effect,)), held={"length_error:1": 2.0})
    assert model.names == ("length_error:2", "joint_offset:1", "joint_offset:2", "encoder_eccentricity:2.b")
    assert model.closed_form is None or not model.closed_form.exact
    q = np.array([[0.3, -0.8]])
    angle = 0.3 - 0.8 + 0.01 * np.cos(-0.8)
    expected = [202 * np.cos(0.3) + 100 * np.cos(angle), 202 * np.sin(0.3) + 100 * np.sin(angle)]
    np.testing.assert_allclose(model.position(q)[0], expected, rtol=0, atol=1e-12)


def test_wrong_shapes_and_names_are_input_errors() -> None:
    model = Model(Arm([200.0, 100.0]))
    with pytest.raises(InputError, match=r"postures: shape \(3, 3\), allowed: \(m, 2\)"):
        model.position(np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"parameters: shape \(5,\), allowed: \(..., 4\)"):
        model.position(np.zeros((3, 2)), np.zeros(5))
    with pytest.raises(InputError, match="did you mean 'length_error:1'"):
        Model(Arm([200.0, 100.0]), held={"length_eror:1": 0.0})


def test_points_are_the_best_known_chain_in_the_frame_of_the_base() -> None:
    errors, offsets = np.array([1.0, -2.0, 0.5]), np.array([0.01, -0.02, 0.03])
    arm = Arm([300.0, 200.0, 150.0], effects=(EffectSpec("axes_skew"),), calibration=Calibration.of(errors, offsets))
    model, q, lengths = Model(arm), np.random.default_rng(7).uniform(-np.pi, np.pi, (4, 3)), arm.lengths + errors
    links = lengths * np.exp(1j * np.cumsum(q + offsets, axis=1))
    points = model.points(q)
    assert points.shape == (4, 4, 2)
    np.testing.assert_array_equal(points[:, 0], 0.0)
    np.testing.assert_allclose(points[:, 1:] @ [1.0, 1.0j], np.cumsum(links, axis=1), rtol=1e-13)
    posture = ca.SX.sym("q", 3)
    symbolic = ca.Function("points", [posture], [ca.horzcat(*model.symbolic_points(posture))])
    np.testing.assert_allclose(np.array(symbolic(q[0])).T, points[0], rtol=1e-13, atol=1e-12)
    assert (model.joints, model.dimension) == (3, 2)
