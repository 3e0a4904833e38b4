"""Spatial arms written as files of their own: the same arm comes back, wherever its drawing came from."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, Calibration, EffectSpec, Machining
from identification.errors import InputError
from identification.files.arm import arm_from_tables, dump_arm
from identification.kinematics.chain import BASE, TOOL, DHRow, Joint, chain_of
from identification.kinematics.frames import from_roll_pitch_yaw, pose
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.measurements import Conditions
from identification.model import Model
from identification.model.minimal import minimal

ROWS = [DHRow(0.0, np.pi / 2.0, 180.0), DHRow(-600.0, 0.0, 0.0, 0.3), DHRow(20.0, -1.5, 130.0, limits=(-1.0, 2.0))]
CHAIN = chain_of(ROWS)
PLACE = pose((1200.0, -30.0, 5.5), from_roll_pitch_yaw(0.2, -1.0, 2.0))
TILTED = Joint("it's <tilted>", PLACE, np.array([0.3, 0.4, -0.5]), REVOLUTE, -0.5, 1.5)
SLIDE = Joint("slide", pose((0.0, 0.0, 20.0)), np.array([1.0, 0.0, 0.0]), PRISMATIC, -100.0, 250.0)
TOOLS = {"top": np.array([10.0, 20.0, 30.0]), "side": np.array([-5.0, 0.0, 60.0])}
MIXED = replace(CHAIN, joints=(SLIDE, *CHAIN.joints, TILTED), end=PLACE)
VALUES = {"translation_x:2": 0.7, "rotation_y:3": 0.01, "joint_offset:3": -0.02, "base.rx": 0.003}
ARMS = {
    "with everything": Arm(
        replace(MIXED, base=PLACE, tools=TOOLS, settled=frozenset({BASE, TOOL})),
        name='six "axes"',
        sigma=0.05,
        gear_ratios=np.array([0.0, 100.0, 50.0, 0.0, 3.0]),
        effects=(EffectSpec("encoder_eccentricity", 2, {"a": 1e-3, "b": 2e-3}), EffectSpec("gear_ratio", 3)),
        machining=Machining(0.2, 0.001),
    ),
    "placed": Arm(replace(MIXED, base=PLACE, tools=TOOLS)),
    "of poses": Arm(
        replace(MIXED, base=PLACE, tools=TOOLS, tool_axes={"top": PLACE[:3, :3]}, angle_scale=250.0), sigma=0.05
    ),
    "calibrated": Arm(
        replace(CHAIN, base=PLACE, tools={"1": TOOLS["top"]}), sigma=0.1, calibration=Calibration(VALUES)
    ),
}


@pytest.mark.parametrize("name", ARMS)
def test_the_same_arm_comes_back(name: str) -> None:
    arm = ARMS[name]
    found = arm_from_tables(tomllib.loads(dump_arm(arm)))
    own, read = Model(arm), Model(found)
    postures = np.random.default_rng(4).uniform(arm.lower, arm.upper, (20, arm.links))
    assert own.names == read.names
    assert own.joint_types == read.joint_types
    assert arm.chain is not None
    for marker in range(len(arm.chain.tools)):
        conditions = Conditions(marker=np.full(20, float(marker)))
        expected = own.position(postures, own.values, conditions)
        np.testing.assert_allclose(read.position(postures, read.values, conditions), expected, atol=1e-9)
    for key in ("lower", "upper"):
        np.testing.assert_allclose(getattr(found, key), getattr(arm, key), rtol=1e-14)
    assert (found.name, found.sigma) == (arm.name, arm.sigma)
    np.testing.assert_array_equal(found.gear_ratios, arm.gear_ratios)  # type: ignore[arg-type]
    assert [spec.key for spec in found.effects] == [spec.key for spec in arm.effects]
    assert found.chain is not None
    assert arm.chain.angle_scale is None or found.chain.angle_scale == pytest.approx(arm.chain.angle_scale, rel=1e-14)
    assert found.machining.translation == arm.machining.translation
    assert found.machining.rotation == pytest.approx(arm.machining.rotation, rel=1e-14)
    assert [joint.name for joint in found.chain.joints] == [joint.name for joint in arm.chain.joints]


def test_a_chosen_set_of_parameters_is_refused() -> None:
    with pytest.raises(InputError, match="has a chosen set of parameters"):
        dump_arm(minimal(Model(ARMS["placed"])).arm)
