"""Models put together from shared parts: the same numbers as one expression of everything, and derivatives of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec, Gravity
from identification.conditions import Conditions
from identification.error_curve import ErrorCurve
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.kinematics.frames import from_own_axes, pose
from identification.kinematics.orientations import turned
from identification.kinematics.parameters import PRISMATIC
from identification.model import Model
from identification.model.compiled_parts import compiled_arm
from identification.vectorize import vectorize

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
    EffectSpec("tool_mass"),
    EffectSpec("measurement_scale"),  # of the measured point, so of everything else
    EffectSpec("payload_place"),
)
ROWS = 9
WARM = Conditions(
    temperature=np.linspace(-3.0, 3.0, ROWS), time=np.linspace(-0.5, 0.5, ROWS), marker=np.arange(ROWS) % 2.0
)


def model_and_arguments(specs: tuple[EffectSpec, ...] = SPECS) -> tuple[Model, tuple[np.ndarray, ...]]:
    model = Model(Arm(CHAIN, gravity=GRAVITY, effects=specs))
    generator = np.random.default_rng(5)
    postures = generator.uniform(-1.0, 1.0, (ROWS, 4)) + np.array([0.0, 0.0, 300.0, 0.0])
    values = np.maximum(1e-2 * generator.standard_normal((3, len(model.names))) / model.scales, model.parameters.lower)
    return model, (postures, model.condition_table(postures, WARM), values[:, None])


def test_the_same_as_one_expression() -> None:
    """Positions, derivatives by the parameters, by what is added anywhere, and the state; for several sets at once."""
    model, arguments = model_and_arguments()
    whole = vectorize(model.jacobian_function)(*arguments)
    for one, other in zip(model.expressions.jacobian(*arguments), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(model.expressions.position(*arguments)[0], whole[0], rtol=1e-13)
    in_one = replace(model.expressions)
    vars(in_one)["composed"] = None
    for one, other in zip(model.expressions.place_levers(*arguments), in_one.place_levers(*arguments), strict=True):
        np.testing.assert_allclose(one, np.broadcast_to(other, one.shape), rtol=1e-12, atol=1e-9)
    (one,), (other,) = (expressions.joint_levers(*arguments) for expressions in (model.expressions, in_one))
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    "specs", [SPECS[:1], SPECS[3:4], SPECS[7:9], SPECS[10:], SPECS[4:6]], ids=lambda specs: specs[0].name
)
def test_few_effects(specs: tuple[EffectSpec, ...]) -> None:
    """Whatever places they act at."""
    model, arguments = model_and_arguments(specs)
    for one, other in zip(
        model.expressions.jacobian(*arguments), vectorize(model.jacobian_function)(*arguments), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)


def test_postures_that_stay_and_others() -> None:
    """What is known of rows that cannot change is that of these rows, whatever came between."""
    model, (postures, conditions, values) = model_and_arguments(SPECS[3:4])
    for q in (postures, postures + 0.1, postures):
        held = q.copy()
        held.setflags(write=False)
        expected = vectorize(model.jacobian_function)(q, conditions, values)[1]
        for again in (held, held, q.copy()):
            np.testing.assert_allclose(model.expressions.jacobian(again, conditions, values)[1], expected, atol=1e-9)


def test_values_that_belong_to_curves() -> None:
    """Off beyond the angles of a curve, be they free or known, of the geometry or of an effect: as one expression."""
    values = 1e-3 * np.sin(np.arange(9.0))
    part = {"base.x": 0.3, "translation_x:2": 0.2, "rotation_x:3": 1e-3, "tool[2].y": -0.1, "base_drift.vx": 0.4}
    curves = [EffectSpec("joint_error_curve", j, curve=ErrorCurve(-0.5, 0.5, values, part)) for j in (2, 4)]
    turned_base = replace(CHAIN, base=pose((500.0, 0.0, 80.0), from_own_axes(0.3, -0.2, 2.0)))
    arm = Arm(turned_base, gravity=GRAVITY, effects=(*SPECS[:6], *curves))
    whole = Model(arm)
    for model in (whole, Model(arm, {name: 0.01 for name in whole.names if name[-2:] in (".x", ":2", "vx", "vy")})):
        _, (postures, _, _) = model_and_arguments()
        values = 1e-2 * np.abs(np.random.default_rng(2).standard_normal(len(model.names))) / model.scales
        arguments = postures, model.condition_table(postures, WARM), values[None]
        assert 0.0 < np.mean(arguments[1][:, -1] > 0.0) < 1.0
        expected = vectorize(model.jacobian_function)(*arguments)
        for one, other in zip(model.expressions.jacobian(*arguments), expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-8)


def test_parts_are_made_once() -> None:
    """For models of equal arms with different effects."""
    models = [model_and_arguments(specs)[0] for specs in (SPECS[:4], SPECS[2:5])]
    first, second = (model.expressions.composed for model in models)
    assert first is not None
    assert second is not None
    assert first.shared is second.shared
    assert first.shared is compiled_arm(CHAIN, GRAVITY, False, ("marker",))
    assert first.shared.of(models[0].effects[3]) is second.shared.of(models[1].effects[1])


def test_poses() -> None:
    """Three coordinates more, which the instrument does not touch, against measured orientations and without."""
    poses = replace(CHAIN, angle_scale=300.0)
    model = Model(Arm(poses, gravity=GRAVITY, effects=SPECS))
    generator = np.random.default_rng(6)
    postures = generator.uniform(-1.0, 1.0, (ROWS, 4)) + np.array([0.0, 0.0, 300.0, 0.0])
    values = np.maximum(1e-2 * generator.standard_normal(len(model.names)) / model.scales, model.parameters.lower)
    seen = replace(WARM, orientation=turned(generator.uniform(-1.0, 1.0, (ROWS, 3))))
    for conditions in (WARM, seen):
        arguments = postures, model.condition_table(postures, conditions), values[None]
        whole = vectorize(model.jacobian_function)(*arguments)
        for one, other in zip(model.expressions.jacobian(*arguments), whole, strict=True):
            assert one.shape[1] == 6
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)
        in_one = replace(model.expressions)
        vars(in_one)["composed"] = None
        levers = (expressions.place_levers(*arguments)[0] for expressions in (model.expressions, in_one))
        np.testing.assert_allclose(*levers, rtol=1e-12, atol=1e-9)
