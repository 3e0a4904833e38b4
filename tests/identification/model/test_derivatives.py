"""Models in space with many effects: derivatives, torques, the planar arm as one whose axes are parallel, sharing."""

from collections.abc import Iterable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from doe.criteria import information_matrix
from identification import PRISMATIC, Arm, Calibration, Conditions, EffectSpec, Gravity, InputError, Measurements, Model
from identification.arm import ErrorCurve
from identification.effects import ArmState, base, library
from identification.effects.base import position_and_state, widths
from identification.for_design import design_model
from identification.instruments import Distance, Tracker
from identification.kinematics.chain import DHRow, chain_of
from identification.kinematics.frames import from_angles, pose, turned

CHAIN = chain_of(
    [
        DHRow(0.0, np.pi / 2, 300.0),
        DHRow(-400.0, 0.1, 0.0),
        DHRow(0.0, np.pi / 2, 0.0, type=PRISMATIC, limits=(100.0, 500.0)),
        DHRow(50.0, -np.pi / 2, 80.0),
    ]
)
CHAIN = replace(CHAIN, tools={"1": np.array([20.0, 30.0, 40.0]), "2": np.array([-20.0, 10.0, 60.0])})
GRAVITY = Gravity(np.array([0.3, 0.2, -9.7]), np.array([8.0, 6.0, 4.0, 2.0]), np.full(4, 0.4), 3.0)
SPECS = (
    EffectSpec("joint_compliance"),
    EffectSpec("payload_error"),  # changes what compliance does
    EffectSpec("gravity_tilt", values={"x": 0.01}),  # half of it is known
    EffectSpec("transmission_ripple", 2, {"k": 5.0}),
    EffectSpec("thermal_growth"),
    EffectSpec("base_drift"),
    EffectSpec("base_rotation_drift"),
    EffectSpec("bearing_compliance", 2),
    EffectSpec("axis_runout", 4),
    EffectSpec("measurement_scale"),  # of the measured point, so of everything else
    EffectSpec("payload_place"),
)
ROWS = 9
WARM = Conditions(
    temperature=np.linspace(-3.0, 3.0, ROWS), time=np.linspace(-0.5, 0.5, ROWS), marker=np.arange(ROWS) % 2.0
)
GENERATOR = np.random.default_rng(5)
POSTURES = GENERATOR.uniform(-1.0, 1.0, (ROWS, 4)) + np.array([0.0, 0.0, 300.0, 0.0])
STEP = 1e-2  # [mm] of a displacement: curvatures of some 1e-3 / mm leave 1e-7, rounding of 1e3 mm leaves 1e-11
AGREE = {"rtol": 1e-6, "atol": 1e-6}


def arms() -> list[Arm]:
    """Points, poses, and curves that have a part of the geometry in them, beyond whose angles it is off."""
    values = 1e-3 * np.sin(np.arange(9.0))
    part = {"base.x": 0.3, "translation_x:2": 0.2, "rotation_x:3": 1e-3, "tool[2].y": -0.1, "base_drift.vx": 0.4}
    curves = [EffectSpec("joint_error_curve", j, curve=ErrorCurve(-0.5, 0.5, values, part)) for j in (2, 4)]
    turned_base = replace(CHAIN, base=pose((500.0, 0.0, 80.0), from_angles((0.3, -0.2, 2.0))))
    return [
        Arm(CHAIN, gravity=GRAVITY, effects=SPECS),
        Arm(replace(CHAIN, instrument=Tracker(300.0)), gravity=GRAVITY, effects=SPECS),
        Arm(turned_base, gravity=GRAVITY, effects=(*SPECS[:6], *curves)),
    ]


@pytest.mark.parametrize("arm", arms(), ids=["points", "poses", "curves"])
def test_by_the_parameters(arm: Arm) -> None:
    model, conditions = Model(arm), WARM
    if arm.chain.angle_scale is not None:
        conditions = replace(WARM, orientation=turned(GENERATOR.uniform(-1.0, 1.0, (ROWS, 3))))
    values = np.maximum(1e-2 * GENERATOR.standard_normal(len(model.names)) / model.scales, model.parameters.lower)
    assert model.jacobian(POSTURES, values, conditions).shape == (ROWS, model.dimension, len(model.names))
    agree(model, values, conditions, range(len(values)))


def agree(model: Model, values: np.ndarray, conditions: Conditions, chosen: Iterable[int]) -> None:
    """Derivatives by these parameters, of which each is to move something, are differences of positions."""
    scaled, steps = model.jacobian(POSTURES, values, conditions) / model.scales, np.diag(STEP / model.scales)
    for k in chosen:
        ends = (model.position(POSTURES, values + sign * steps[k], conditions) for sign in (1.0, -1.0))
        np.testing.assert_allclose(scaled[..., k], np.subtract(*ends) / (2.0 * STEP), **AGREE)
        assert np.any(scaled[..., k])


@pytest.mark.parametrize("arm", arms(), ids=["points", "poses", "curves"])
def test_by_what_is_added_at_each_place(arm: Arm) -> None:
    """And the state, on which effects depend, is that of the expression that the levers come from."""
    model, sizes = Model(arm), widths(arm.chain)
    table = model.condition_table(POSTURES, WARM)
    q, c, p = model.symbols[:3]
    added = ca.SX.sym("added", sum(sizes.values()))
    outputs = position_and_state(model.chain_at(q, c), model.effects, model.values_at(c, p), added)
    at = ca.Function("at", [q, c, p, added], list(outputs))
    levers, state = model.place_levers(POSTURES, model.values, WARM)
    turning = {"gravity_turn", "joint_angles", "joint_turns", "base_rotation"}
    units = [1e-5 if place in turning else STEP for place, size in sizes.items() for _ in range(size)]
    for row in range(ROWS):
        here = POSTURES[row], table[row], model.values
        np.testing.assert_allclose(state[row], np.array(at(*here, np.zeros(len(units)))[1]).ravel(), rtol=1e-12)
        for k, step in enumerate(np.diag(units)):
            ends = (np.array(at(*here, sign * step)[0]).ravel() for sign in (1.0, -1.0))
            difference = np.subtract(*ends) / (2.0 * units[k])
            np.testing.assert_allclose(levers[row, :, k] * units[k], difference * units[k], rtol=1e-5, atol=1e-8)


OF_MODELS = {name: cls for name, cls in library().items() if not (cls.scatter or cls.of_commands or cls.tabulated)}
PLANAR = Arm([400.0, 300.0, 150.0, 90.0], gravity=replace(GRAVITY, acceleration=np.array([0.3, -9.7])))
BAR = Arm(replace(CHAIN, tools={"1": CHAIN.tools["1"]}, instrument=Distance()), gravity=GRAVITY)


@pytest.mark.parametrize("name", OF_MODELS)
def test_every_effect_by_its_parameters(name: str) -> None:
    """In the plane and in space, beside the compliance that some act through; at settings that some rows see."""
    cls, generator = OF_MODELS[name], np.random.default_rng(3)
    settings = {"k": 5.0, "at": 0.13, "side": 1.0, "tau": 0.4, "width_deg": 20.0, "sessions": 2.0, "other": 1.0}
    effect = EffectSpec(name, None if cls.per_joint == "none" else 2, {key: settings[key] for key in cls.settings})
    in_space = BAR if "distance" in cls.needs else arms()[0]
    for arm in (arm for arm in (PLANAR, in_space) if arm.dimension in cls.dimensions):
        model = Model(arm.with_effects(EffectSpec("joint_compliance"), effect))
        rows = Measurements(POSTURES, np.zeros((ROWS, model.dimension)), session=["a", "b"] * 4 + ["b"])
        conditions = replace(rows.conditions, temperature=WARM.temperature)
        values = np.maximum(1e-2 * generator.standard_normal(len(model.names)) / model.scales, model.parameters.lower)
        agree(model, values, conditions, [k for k, p in enumerate(model.parameters) if p.name.startswith(name)])


LENGTHS = np.array([400.0, 300.0, 150.0])
TURNED = np.random.default_rng(2).uniform(-2.0, 2.0, (7, 3))


def test_gravity_torques_are_the_work_of_the_loads() -> None:
    """tau_j = -dU/dq_j of the potential energy of all masses [J], by central differences in plain numpy; also of masses
    beside the links."""
    masses, share, payload = np.array([7.0, 5.0, 3.0, 2.0]), np.array([0.5, 0.3, 0.7, 0.5]), 1.5
    down = np.array([0.3, -1.0, -9.7])
    arm = Arm(replace(CHAIN, tools={"1": np.zeros(3)}))
    model, q = Model(arm), np.array([0.4, -1.1, 320.0, 0.9])

    def energy(posture: np.ndarray) -> float:
        points, home = (model.points(q[None])[0, 1:] / 1000.0 for q in (posture, posture * [1.0, 1.0, 0.0, 1.0]))
        ends = points[1:].copy()
        ends[1] = home[2]  # link 2 ends where joint 3 begins to slide
        along = share[:, None] * (ends - points[:-1])
        along += beside * design_model(arm).joint_frames(posture[None])[0, 1:-1, :3, 0]  # along x of each joint
        return float(-down @ (masses @ (points[:-1] + along) + payload * points[-1]))

    on_links = share[:, None] * np.array([pose[:3, 3] for pose in CHAIN.link_poses[1:]])
    for beside in (0.0, 0.2):  # [m]
        at = share if not beside else on_links + np.array([1000.0 * beside, 0.0, 0.0])
        torques = Model(replace(arm, gravity=Gravity(down, masses, at, payload))).torques(q[None])[0]
        for j, length in enumerate((1.0, 1.0, 1000.0, 1.0)):  # a slide is in millimetres, its force per metre
            step = 1e-5 * length * np.eye(4)[j]
            expected = -(energy(q + step) - energy(q - step)) / 2e-5
            assert torques[j] == pytest.approx(expected, abs=1e-6)


def test_an_effect_that_is_defined_anew_is_not_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, found = Arm(LENGTHS, effects=(EffectSpec("gear_ratio", 2),)), []
    for factor in (1.0, 2.0):

        class Turned(library()["gear_ratio"]):  # type: ignore[misc]
            name = "gear_ratio"
            by = factor

            def joint_angles(self, chain: ArmState, values: ca.SX) -> ca.SX:
                return self.by * values[0]

        monkeypatch.setitem(base._LIBRARY, "gear_ratio", Turned)
        found.append(Model(arm).jacobian(TURNED)[..., -1])
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-12)


# -- arms in a plane ---------------------------------------------------------------------------------------------------
FOUR_LINKS = np.array([260.0, 180.0, 120.0, 100.0])
PLANE = np.random.default_rng(3).uniform(-np.pi, np.pi, (6, 4))


def test_what_other_parameters_do_as_well() -> None:
    """The base turned, the tool elsewhere, the instrument's unit: in complex numbers."""
    plain, last = Model(Arm(FOUR_LINKS)).position(PLANE) @ [1.0, 1.0j], np.exp(1j * PLANE.sum(axis=1))
    for name, values, expected in (
        ("base_rotation", {"angle": 0.3}, plain * np.exp(0.3j)),
        ("tool_offset", {"x": 5.0, "y": -2.0}, plain + (5.0 - 2.0j) * last),
        ("measurement_scale", {"s": 1e-3}, plain * 1.001),
    ):
        found = Model(Arm(FOUR_LINKS, effects=(EffectSpec(name, None, values),))).position(PLANE)
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
    effects = EffectSpec("encoder_eccentricity", 2), EffectSpec("base_drift")
    model, conditions = Model(Arm(FOUR_LINKS, effects=effects)), Conditions(time=np.linspace(-0.5, 0.5, 6))
    sets = np.random.default_rng(3).uniform(0, 1, (5, len(model.names))) / model.scales
    position, jacobian = model.linearize(PLANE, sets, conditions)
    assert (position.shape, jacobian.shape) == ((5, 6, 2), (5, 6, 2, len(model.names)))
    for k in range(5):
        expected = model.position(PLANE, sets[k], conditions), model.jacobian(PLANE, sets[k], conditions)
        np.testing.assert_allclose(position[k], expected[0], rtol=0, atol=1e-10)  # [mm] of some 1e3
        np.testing.assert_allclose(jacobian[k], expected[1], rtol=0, atol=1e-10)


def test_known_parameters_are_left_out_and_used() -> None:
    effect = EffectSpec("encoder_eccentricity", 2, {"a": 0.01})
    model = Model(Arm([200.0, 100.0], effects=(effect,)), held={"length_error:1": 2.0})
    assert model.names == ("length_error:2", "joint_offset:1", "joint_offset:2", "encoder_eccentricity:2.b")
    assert model.closed_form is None or not model.closed_form.exact
    angle = 0.3 - 0.8 + 0.01 * np.cos(-0.8)
    expected = [202 * np.cos(0.3) + 100 * np.cos(angle), 202 * np.sin(0.3) + 100 * np.sin(angle)]
    np.testing.assert_allclose(model.position(np.array([[0.3, -0.8]]))[0], expected, rtol=0, atol=1e-12)


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
    joints, tips, _ = design_model(model).symbolic_points(posture)
    symbolic = ca.Function("points", [posture], [ca.horzcat(*joints, *tips)])
    np.testing.assert_allclose(np.array(symbolic(q[0])).T, points[0], rtol=1e-13, atol=1e-12)
    assert (model.joints, model.dimension) == (3, 2)
