"""Spatial models: the planar arm as one whose axes are parallel, derivatives against finite differences, gravity
torques against the work of the loads."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from identification.arm import Arm, EffectSpec, Gravity
from identification.conditions import Conditions
from identification.effects import Chain, base, library
from identification.kinematics.chain import DHRow, Joint, KinematicChain, chain_of
from identification.kinematics.frames import pose
from identification.kinematics.parameters import PRISMATIC
from identification.model import Model

LENGTHS = np.array([400.0, 300.0, 150.0])
UP = np.array([0.0, 0.0, 1.0])
ORIGINS = [pose(), pose((400.0, 0.0, 0.0)), pose((300.0, 0.0, 0.0))]
PARALLEL = KinematicChain(
    tuple(Joint(f"j{k}", origin, UP) for k, origin in enumerate(ORIGINS, start=1)), pose((150.0, 0.0, 0.0))
)
SPECS = (EffectSpec("joint_compliance"), EffectSpec("encoder_eccentricity", 2), EffectSpec("thermal_growth"))
POSTURES = np.random.default_rng(2).uniform(-2.0, 2.0, (7, 3))
WARM = Conditions(temperature=np.linspace(-3.0, 3.0, 7), time=np.linspace(-0.5, 0.5, 7))
SIX = chain_of(
    [
        DHRow(0.0, np.pi / 2, 300.0),
        DHRow(-400.0, 0.1, 0.0),
        DHRow(0.0, np.pi / 2, 0.0, type=PRISMATIC, limits=(100.0, 500.0)),
        DHRow(50.0, -np.pi / 2, 80.0),
    ]
)


def test_the_planar_arm_is_one_whose_axes_are_parallel() -> None:
    """Same positions with the same effects; the masses hang in the plane."""
    loads = [12.0, 8.0, 4.0], [0.5, 0.4, 0.6], 3.0
    level = Gravity(np.array([0.0, -9.81]), *map(np.array, loads[:2]), loads[2])
    flat = Model(Arm(LENGTHS, gravity=level, effects=SPECS))
    gravity = Gravity(np.array([0.0, -9.81, 0.0]), *map(np.array, loads[:2]), loads[2])
    space = Model(Arm(PARALLEL, gravity=gravity, effects=SPECS))
    values = np.array([1e-5, 2e-5, 3e-5, 4e-4, -3e-4, 2e-5])
    planar = flat.position(POSTURES, np.r_[np.zeros(6), values], WARM)
    spatial = space.position(POSTURES, np.r_[np.zeros(len(space.geometry_parameters)), values], WARM)
    np.testing.assert_allclose(spatial, np.c_[planar, np.zeros(7)], atol=1e-9)
    np.testing.assert_allclose(space.points(POSTURES)[:, 1:, :2], flat.points(POSTURES), atol=1e-9)


def test_gravity_torques_are_the_work_of_the_loads() -> None:
    """tau_j = -dU/dq_j of the potential energy of all masses [J], by central differences in plain numpy."""
    masses, share, payload = np.array([7.0, 5.0, 3.0, 2.0]), np.array([0.5, 0.3, 0.7, 0.5]), 1.5
    down = np.array([0.3, -1.0, -9.7])
    arm = Arm(SIX, gravity=Gravity(down, masses, share, payload))
    model, q = Model(arm), np.array([0.4, -1.1, 320.0, 0.9])

    def energy(posture: np.ndarray) -> float:
        points, home = (model.points(q[None])[0, 1:] / 1000.0 for q in (posture, posture * [1.0, 1.0, 0.0, 1.0]))
        ends = points[1:].copy()
        ends[1] = home[2]  # link 2 ends where joint 3 begins to slide
        return float(-down @ (masses @ (points[:-1] + share[:, None] * (ends - points[:-1])) + payload * points[-1]))

    torques = model.on_chain(lambda chain: chain.torques)(q[None], Conditions())[0]
    for j, length in enumerate((1.0, 1.0, 1000.0, 1.0)):  # a slide is in millimetres, its force per metre
        step = 1e-5 * length * np.eye(4)[j]
        expected = -(energy(q + step) - energy(q - step)) / 2e-5
        assert torques[j] == pytest.approx(expected, abs=1e-6)


def test_models_share_what_is_compiled_where_their_symbols_are_equal() -> None:
    """Limits, sigma and name are in no formula; lengths, loads, effects, their settings and known values are."""
    ripple = EffectSpec("transmission_ripple", 2, {"k": 5.0})
    arm = Arm(LENGTHS, effects=(ripple,))
    first = Model(arm).expressions
    narrow = replace(arm, lower=np.full(3, -1.0), upper=np.full(3, 1.0), sigma=0.1, name="narrow")
    assert Model(narrow).expressions is first
    others = [
        Model(replace(arm, chain=1.1 * LENGTHS)),
        Model(replace(arm, gravity=Gravity(np.array([0.0, -9.81]), np.ones(3), np.full(3, 0.5), 1.0))),
        Model(arm.with_effects()),
        Model(arm.with_effects(replace(ripple, joint=1))),
        Model(arm.with_effects(replace(ripple, values={"k": 6.0}))),
        Model(arm.with_effects(replace(ripple, values={"k": 5.0, "a": 1e-3}))),
        Model(arm, {"length_error:1": 0.5}),
        Model(Arm(PARALLEL, effects=(ripple,))),
    ]
    assert all(model.expressions is not first for model in others)
    moved = [model.position(POSTURES, 0.01 * np.ones(len(model.names))) for model in (Model(arm), *others[:-1])]
    assert all(np.abs(moved[0] - other).max() > 1e-6 for other in (*moved[1:2], *moved[3:]))


def test_an_effect_that_is_defined_anew_is_not_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, found = Arm(LENGTHS, effects=(EffectSpec("gear_ratio", 2),)), []
    for factor in (1.0, 2.0):

        class Turned(library()["gear_ratio"]):  # type: ignore[misc]
            name = "gear_ratio"
            by = factor

            def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
                return self.at_joint(self.by * values[0], chain)

        monkeypatch.setitem(base._LIBRARY, "gear_ratio", Turned)
        found.append(Model(arm).jacobian(POSTURES)[..., -1])
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-12)
