"""Models in space with many effects: derivatives, torques, the planar arm as one whose axes are parallel, sharing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from identification import PRISMATIC, Arm, Conditions, EffectSpec, Gravity, Measurements, Model
from identification.effects import Chain, base, library
from identification.effects.chain import position_and_state, widths
from identification.error_curve import ErrorCurve
from identification.instruments import Distance
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
        Arm(replace(CHAIN, angle_scale=300.0), gravity=GRAVITY, effects=SPECS),
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
    """tau_j = -dU/dq_j of the potential energy of all masses [J], by central differences in plain numpy."""
    masses, share, payload = np.array([7.0, 5.0, 3.0, 2.0]), np.array([0.5, 0.3, 0.7, 0.5]), 1.5
    down = np.array([0.3, -1.0, -9.7])
    arm = Arm(replace(CHAIN, tools={"1": np.zeros(3)}), gravity=Gravity(down, masses, share, payload))
    model, q = Model(arm), np.array([0.4, -1.1, 320.0, 0.9])

    def energy(posture: np.ndarray) -> float:
        points, home = (model.points(q[None])[0, 1:] / 1000.0 for q in (posture, posture * [1.0, 1.0, 0.0, 1.0]))
        ends = points[1:].copy()
        ends[1] = home[2]  # link 2 ends where joint 3 begins to slide
        return float(-down @ (masses @ (points[:-1] + share[:, None] * (ends - points[:-1])) + payload * points[-1]))

    torques = model.torques(q[None])[0]
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

            def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
                return self.by * values[0]

        monkeypatch.setitem(base._LIBRARY, "gear_ratio", Turned)
        found.append(Model(arm).jacobian(TURNED)[..., -1])
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-12)
