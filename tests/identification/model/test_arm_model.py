"""The model against the mathematics: complex arithmetic, plain numpy effects, beam theory, energies, differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from doe.criteria import information_matrix
from identification import Arm, Calibration, Conditions, EffectSpec, Gravity, InputError, Model

GRAVITY_ACCELERATION = np.array([1.5, -9.6])  # not along an axis, so that both components are tested


# -- an independent implementation of the formulas: one posture, complex numbers ---------------------------------------
def mass_points(arm: Arm, q: np.ndarray, payload: float) -> list[tuple[float, int, complex]]:
    """(mass [kg], link, place [m]) of every load at the nominal pose."""
    links = arm.lengths / 1000.0 * np.exp(1j * np.cumsum(q))
    joints = np.concatenate([[0.0], np.cumsum(links)])
    fractions = arm.gravity.center_of_mass
    points = [(arm.gravity.link_masses[k], k, joints[k] + fractions[k] * links[k]) for k in range(arm.links)]
    return [*points, (payload, arm.links, joints[-1])]  # the payload is beyond the last link's tip


def torques(arm: Arm, q: np.ndarray, payload: float) -> np.ndarray:
    """tau_j = -dV/dq_j of the potential energy, by central differences."""
    g = complex(*arm.gravity.acceleration)

    def energy(angles: np.ndarray) -> float:
        return -sum(m * (np.conj(g) * z).real for m, _, z in mass_points(arm, angles, payload))

    h = 1e-4
    return np.array([-(energy(q + h * e) - energy(q - h * e)) / (2 * h) for e in np.eye(arm.links)])


def beam(arm: Arm, q: np.ndarray, payload: float, flexibility: float) -> tuple[np.ndarray, np.ndarray]:
    """Tip deflection [mm] and slope of each clamped link: v'' = M(x)/EI integrated by Gauss-Legendre quadrature."""
    g = complex(*arm.gravity.acceleration)
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    orientation = np.exp(1j * np.cumsum(q))
    start, deflection, slope = 0j, np.zeros(arm.links), np.zeros(arm.links)
    for j in range(arm.links):
        length = arm.lengths[j] / 1000.0
        for node, weight in zip(nodes, node_weights, strict=True):
            x = length * (node + 1.0) / 2.0
            at = start + x * orientation[j]
            loads = mass_points(arm, q, payload)
            moment = sum(m * (np.conj(z - at) * g).imag for m, k, z in loads if k > j)
            slope[j] += weight * length / 2.0 * moment * flexibility
            deflection[j] += weight * length / 2.0 * moment * flexibility * (length - x) * 1000.0
        start += length * orientation[j]
    return deflection, slope


def reference(arm: Arm, q: np.ndarray, row: np.ndarray, value: dict[str, float]) -> np.ndarray:
    """(2,) tip [mm] of one posture; row is payload, temperature, time, directions."""
    n = arm.links
    payload, temperature, time, directions = row[0], row[1], row[2], row[4:]
    angles = q + [value[f"joint_offset:{j + 1}"] for j in range(n)]
    lengths = arm.lengths + [value[f"length_error:{j + 1}"] for j in range(n)]
    deflection, slope, tool, turn, shift, skew, scale = np.zeros(n), np.zeros(n), 0j, 0.0, 0j, 0j, 0.0
    tau = torques(arm, q, payload)
    for spec in arm.effects:
        v = {name.rpartition(".")[2]: x for name, x in value.items() if name.rpartition(".")[0] == spec.key}
        j = (spec.joint or 1) - 1
        match spec.name:
            case "joint_compliance" if spec.joint is None:
                angles = angles + tau * [v[f"c{k + 1}"] for k in range(n)]
            case "joint_compliance":
                angles[j] += v["c"] * tau[j]
            case "encoder_eccentricity":
                angles[j] += v["a"] * np.cos(q[j]) + v["b"] * np.sin(q[j])
            case "encoder_second_harmonic":
                angles[j] += v["a"] * np.cos(2 * q[j]) + v["b"] * np.sin(2 * q[j])
            case "transmission_ripple":
                k = spec.values["k"]
                angles[j] += v["a"] * np.cos(k * q[j]) + v["b"] * np.sin(k * q[j])
            case "gear_ratio":
                angles[j] += v["e"] * q[j]
            case "joint_coupling":
                angles[j] += v["c"] * q[j - 1]
            case "backlash":
                angles[j] += v["b"] * directions[j]
            case "gravity_backlash":
                angles[j] += v["b"] * np.sign(tau[j])
            case "link_bending":
                deflection, slope = beam(arm, q, payload, v["flexibility"])
            case "thermal_growth":
                lengths = lengths * (1.0 + v["a"] * temperature)
            case "base_offset":
                shift += complex(v["x0"], v["y0"])
            case "base_drift":
                shift += complex(v["vx"], v["vy"]) * time
            case "base_rotation_drift":
                turn += v["w"] * time
            case "base_rotation":
                turn += v["angle"]
            case "tool_offset":
                tool += complex(v["x"], v["y"])
            case "axes_skew":
                skew += complex(v["a"], v["b"])
            case "measurement_scale":
                scale += v["s"]
            case _:
                pytest.fail(f"no reference for {spec.name}")
    direction, tip = 1 + 0j, 0j
    for j in range(n):
        direction *= np.exp(1j * angles[j])
        tip += direction * complex(lengths[j], deflection[j])
        direction *= np.exp(1j * slope[j]) if j < n - 1 else 1.0  # a tool is another length and offset of the last link
    tip = (tip + direction * tool) * np.exp(1j * turn) + shift
    tip = tip * (1.0 + scale) + skew * np.conj(tip)
    return np.array([tip.real, tip.imag])


WHOLE = ["link_bending", "thermal_growth", "base_offset", "base_drift", "base_rotation_drift", "axes_skew"]
WHOLE += ["measurement_scale", "tool_offset", "base_rotation", "joint_compliance"]
OF_JOINT = ["joint_compliance", "encoder_eccentricity", "encoder_second_harmonic", "transmission_ripple", "gear_ratio"]
OF_JOINT += ["backlash", "gravity_backlash", "joint_coupling"]


def spec(name: str, joint: int | None) -> EffectSpec:
    return EffectSpec(name, joint, {"k": 5.0} if name == "transmission_ripple" else {})


def random_arm(generator: np.random.Generator, n: int, specs: list[EffectSpec]) -> Arm:
    gravity = Gravity(
        GRAVITY_ACCELERATION, generator.uniform(1, 10, n), generator.uniform(0.2, 0.8, n), generator.uniform(0, 10)
    )
    return Arm(generator.uniform(50, 300, n), gravity=gravity, effects=tuple(specs))


def random_case(generator: np.random.Generator, arm: Arm, m: int) -> tuple[Model, np.ndarray, Conditions, np.ndarray]:
    """Model, postures, conditions and parameters that each move the tip by some millimetres."""
    model, n = Model(arm), arm.links
    conditions = Conditions(
        generator.uniform(0, 10, m),
        generator.uniform(-5, 5, m),
        generator.uniform(-0.5, 0.5, m),
        generator.choice([-1.0, 1.0], (m, n)),
    )
    postures = generator.uniform(-np.pi, np.pi, (m, n))
    size = np.max(np.abs(model.jacobian(postures, np.zeros(len(model.names)), conditions)), axis=(0, 1))
    values = generator.uniform(-3, 3, len(size)) / np.maximum(size, 1e-3)
    positive = np.array([p.lower == 0.0 for p in model.parameters])
    return model, postures, conditions, np.where(positive, np.abs(values), values)


@pytest.mark.parametrize("n", [1, 12])
def test_all_effects_together_are_the_plain_formula(n: int) -> None:
    generator = np.random.default_rng(n)
    few = OF_JOINT if n > 1 else OF_JOINT[:-1]
    arm = random_arm(generator, n, [*(spec(name, None) for name in WHOLE), *(spec(name, n) for name in few)])
    model, postures, conditions, values = random_case(generator, arm, 4)
    named = dict(zip(model.names, values, strict=True))
    table = model.condition_table(postures, conditions)
    expected = [reference(arm, q, row, named) for q, row in zip(postures, table, strict=True)]
    # differences of energies lose 1e-9 of a torque; its effect is some mm
    np.testing.assert_allclose(model.position(postures, values, conditions), expected, rtol=0, atol=1e-6)


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
    arm = random_arm(generator, 4, [spec("encoder_eccentricity", 2), spec("base_drift", None)])
    model, postures, conditions, values = random_case(generator, arm, 6)
    sets = values * generator.uniform(0, 1, (5, len(values)))
    position, jacobian = model.linearize(postures, sets, conditions)
    assert position.shape == (5, 6, 2)
    assert jacobian.shape == (5, 6, 2, len(values))
    for k in range(5):
        np.testing.assert_array_equal(position[k], model.position(postures, sets[k], conditions))
        np.testing.assert_array_equal(jacobian[k], model.jacobian(postures, sets[k], conditions))


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
