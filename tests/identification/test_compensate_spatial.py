"""Compensation in space, against plain products of matrices: six axes and a slide, a target out of reach, limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.compensate import TOLERANCE, compensate
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.kinematics.frames import from_own_axes, pose, rotation_about
from identification.kinematics.spatial import SpatialChain

QUARTER = np.pi / 2.0
SIX = [(0.0, QUARTER, 350.0), (-400.0, 0.0, 0.0), (-350.0, 0.0, 0.0), (0.0, QUARTER, 110.0), (0.0, -QUARTER, 90.0)]
SLIDE = DHRow(0.0, QUARTER, 0.0, type="prismatic", limits=(-300.0, 300.0))
BASE, TOOL = pose((1500.0, -700.0, 300.0), from_own_axes(0.1, -0.4, 2.0)), np.array([30.0, 20.0, 60.0])
NAMES = ("translation_x:3", "rotation_y:4", "joint_offset:2", "joint_offset:5")
VALUES = dict(zip(NAMES, (0.8, 0.002, 0.004, -0.003), strict=True))


def arm(slide: bool) -> Arm:
    """With errors of a millimetre and of some milliradians, its base and point as found by an identification."""
    rows = [DHRow(a, alpha, d, limits=(-2.5, 2.5)) for a, alpha, d in [*SIX, (0.0, 0.0, 80.0)]]
    chain = chain_of([SLIDE, *rows] if slide else rows)
    calibration = Calibration(VALUES, base=BASE, tools={"1": TOOL})
    return Arm.of_chain(replace(chain, base=BASE, tools={"1": TOOL}), calibration=calibration)


def tip(chain: SpatialChain, q: Array, values: dict[str, float]) -> Array:
    """(3,) the measured point, the four errors set in by hand."""
    found = np.asarray(BASE)
    for j, (joint, x) in enumerate(zip(chain.joints, q, strict=True), start=1):
        found = found @ joint.origin @ pose((values.get(f"translation_x:{j}", 0.0), 0.0, 0.0))
        found = found @ pose(rotation=rotation_about(np.eye(3)[1], values.get(f"rotation_y:{j}", 0.0)))
        turn = x + values.get(f"joint_offset:{j}", 0.0)
        revolute = joint.type == "revolute"
        found = found @ (pose(rotation=rotation_about(joint.axis, turn)) if revolute else pose(joint.axis * turn))
    return np.asarray((found @ chain.end @ np.r_[TOOL, 1.0])[:3])


def test_commands_reach_where_the_nominal_arm_would_be() -> None:
    for slide in (False, True):
        given = arm(slide)
        chain = given.chain
        assert chain is not None
        nominal = np.random.default_rng(4).uniform(0.9 * given.lower, 0.9 * given.upper, (30, given.links))
        found = compensate(given, postures=nominal)
        assert found.reached.all()
        for command, posture, target in zip(found.commands, nominal, found.targets, strict=True):
            np.testing.assert_allclose(target, tip(chain, posture, {}), atol=1e-9)
            assert np.linalg.norm(tip(chain, command, VALUES) - target) < 2.0 * TOLERANCE
        assert np.all((given.lower <= found.commands) & (found.commands <= given.upper))
        # the branch is kept: errors of 5 mm at 100 mm from the axes are 3 degrees at most
        turning = np.array(given.joint_types) == "revolute"
        assert np.abs(found.commands - nominal)[:, turning].max() < np.radians(3.0)


def test_positions_alone_and_what_is_out_of_reach() -> None:
    given = arm(slide=False)
    chain = given.chain
    assert chain is not None
    near = tip(chain, np.array([0.3, -1.0, 0.8, 0.2, 1.0, 0.0]), {})
    far = np.asarray(BASE)[:3, 3] + np.array([5000.0, 0.0, 0.0])
    found = compensate(given, np.array([near, far]))
    assert found.reached.tolist() == [True, False]
    assert np.linalg.norm(tip(chain, found.commands[0], VALUES) - near) < 2.0 * TOLERANCE
    data = found.to_json()
    assert data["unreachable"] == [2]
    assert data["commands_deg"][1] is None
    np.testing.assert_allclose(data["commands_deg"][0], np.degrees(found.commands[0]))
    assert found.errors[1] > 3000.0
