"""Compensation in space, against plain products of matrices: six axes and a slide, a target out of reach, limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Array, Calibration, EffectSpec, Model, estimate
from identification.compensate import TOLERANCE, compensate
from identification.files.measurement import load_targets
from identification.kinematics.chain import DHRow, KinematicChain, chain_of
from identification.kinematics.frames import from_angles, pose
from identification.measurements import Measurements
from identification.simulate import simulate, with_servo_errors
from tests.identification.kinematics.test_spatial import tip_by_exponentials

QUARTER = np.pi / 2.0
SIX = [(0.0, QUARTER, 350.0), (-400.0, 0.0, 0.0), (-350.0, 0.0, 0.0), (0.0, QUARTER, 110.0), (0.0, -QUARTER, 90.0)]
SLIDE = DHRow(0.0, QUARTER, 0.0, type="prismatic", limits=(-300.0, 300.0))
BASE, TOOL = pose((1500.0, -700.0, 300.0), from_angles((0.1, -0.4, 2.0))), np.array([30.0, 20.0, 60.0])
TURN = from_angles((0.4, -0.2, 1.1))
NAMES = ("translation_x:3", "rotation_y:4", "joint_offset:2", "joint_offset:5")
VALUES = dict(zip(NAMES, (0.8, 0.002, 0.004, -0.003), strict=True))


def arm(slide: bool) -> Arm:
    """With errors of a millimetre and of some milliradians, its base and point as found by an identification."""
    rows = [DHRow(a, alpha, d, limits=(-2.5, 2.5)) for a, alpha, d in [*SIX, (0.0, 0.0, 80.0)]]
    chain = chain_of([SLIDE, *rows] if slide else rows)
    calibration = Calibration(VALUES, base=BASE, tools={"1": TOOL})
    return Arm(replace(chain, base=BASE, tools={"1": TOOL}), calibration=calibration)


def tip(chain: KinematicChain, q: Array, values: dict[str, float]) -> Array:
    """(3,) the measured point."""
    return tip_by_exponentials(chain, q, values, TOOL)


def axes(chain: KinematicChain, q: Array, values: dict[str, float]) -> Array:
    """(3, 3) axes of the measured frame, which is turned by `TURN` in the tip's."""
    ends = [tip(replace(chain, end=chain.end @ pose(TURN @ axis)), q, values) for axis in np.eye(3)]
    return np.column_stack(ends) - tip(chain, q, values)[:, None]


def test_commands_reach_where_the_nominal_arm_would_be() -> None:
    for slide in (False, True):
        given = arm(slide)
        chain = given.chain
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


def test_poses() -> None:
    """Point and orientation, from nominal postures: the branch stays."""
    for slide in (False, True):
        given = arm(slide)
        chain = given.chain
        given = replace(given, chain=replace(chain, tools={"1": pose(TOOL, TURN)}))
        nominal = np.random.default_rng(5).uniform(0.9 * given.lower, 0.9 * given.upper, (8, given.links))
        nominal[:, -4] = np.linspace(0.6, 2.0, 8)  # the elbow: stretched, the arm's own errors decide what it reaches
        points = np.array([tip(chain, q, {}) for q in nominal])
        turned = np.array([axes(chain, q, {}) for q in nominal])
        found = compensate(given, points, nominal, orientations=turned)
        assert found.reached.all()
        assert found.angles is not None
        assert found.to_json()["max_error_deg"] < 1e-6
        for q, point, wanted in zip(found.commands, points, turned, strict=True):
            assert np.linalg.norm(tip(chain, q, VALUES) - point) < 2.0 * TOLERANCE
            np.testing.assert_allclose(axes(chain, q, VALUES), wanted, atol=1e-8)
        assert np.all((given.lower <= found.commands) & (found.commands <= given.upper))
        turning = np.array(given.joint_types) == "revolute"
        assert np.median(np.abs(found.commands - nominal)[:, turning].max(axis=1)) < np.radians(1.0)


def test_target_files(tmp_path: Path) -> None:
    given = arm(slide=False)
    (tmp_path / "targets.csv").write_text("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n1500,-200,900,10,20,30\n")
    wanted = load_targets(tmp_path / "targets.csv", given)
    np.testing.assert_allclose(wanted["orientations"][0], from_angles(np.radians([10.0, 20.0, 30.0])), atol=1e-14)
    found = compensate(given, **wanted)
    text = found.text()
    assert text.splitlines()[0].endswith("q6_deg,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg,error_mm,error_deg,reachable")
    assert "orientations are reached to < 1e-6 deg, by the same model" in found.document().verdict[0]


# -- commands beside readings ------------------------------------------------------------------------------------------
ARM = Arm([300.0, 250.0], sigma=0.05)
SLACK = {1: (2e-4, 5e-5), 2: (-3e-4, 8e-5)}
SPECS = tuple(EffectSpec("servo_error", j, {"b": b, "h": h}) for j, (b, h) in SLACK.items())
TRUTH = replace(ARM, effects=SPECS, calibration=Calibration.of([0.4, -0.3], [0.002, -0.001]))


def data(rows: int = 40) -> Measurements:
    return simulate(TRUTH, np.random.default_rng(1).uniform(-2.0, 2.0, (rows, 2)), np.random.default_rng(2))


def test_what_a_controller_leaves() -> None:
    """The two numbers of each joint come back; positions are those of the joints as read."""
    found = data()
    known, entries = with_servo_errors(ARM, found)
    assert [spec.joint for spec in known.effects] == [1, 2]
    for spec, entry in zip(known.effects, entries, strict=True):
        b, h = SLACK[entry["joint"]]
        assert (spec.values["b"], spec.values["h"]) == pytest.approx((b, h), abs=1e-12)
        assert (entry["offset"], entry["reversal"]) == pytest.approx(np.degrees([b, h]), abs=1e-10)
        assert entry["rest"] < 1e-10
        assert entry["largest"] == pytest.approx(np.degrees(abs(b) + h))
        left = (found.postures - found.commanded)[:, entry["joint"] - 1]
        assert entry["rms"] == pytest.approx(np.degrees(np.sqrt(np.mean(left**2))))
    exact = Model(replace(TRUTH, effects=())).position(found.postures)
    assert np.std(found.positions - exact) == pytest.approx(0.05, rel=0.2)


def test_fits_do_not_care() -> None:
    """A model of what is read is the same with servo errors in the arm and without."""
    found = data()
    with_them = estimate(Model(with_servo_errors(ARM, found)[0]), found)
    np.testing.assert_array_equal(with_them.parameters, estimate(Model(ARM), found).parameters)


def test_commands_are_asked_for_so_that_the_joints_are_read_right() -> None:
    """The true arm, asked for them, is at the targets; else up to 3.5e-4 rad x 250 mm beside them."""
    nominal = np.random.default_rng(3).uniform(-1.5, 1.5, (30, 2))
    targets = Model(ARM).position(nominal)
    for arm, off in ((TRUTH, 0.0), (replace(TRUTH, effects=()), 0.07)):
        there = simulate(TRUTH, compensate(arm, targets, nominal).commands, np.random.default_rng(4), sigma=0.0)
        missed = np.linalg.norm(there.positions - targets, axis=1)
        assert missed.max() < 2e-6 if off == 0.0 else missed.max() > off
