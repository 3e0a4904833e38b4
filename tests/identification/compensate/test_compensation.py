"""What is said of commands: counted and converted by hand, for targets that are reached, missed and forbidden.

Compensation: the commands are checked on the calibrated model and against two-link trigonometry.

A pan-tilt unit: two joints reach a surface, and no measured position lies on it exactly.
"""

import re
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from identification import Array, Conditions, DHRow, InputError, Measurements, Model, chain_of, estimate
from identification.arm import Arm, Calibration, EffectSpec
from identification.compensate import TOLERANCE, Compensation, compensate
from identification.kinematics.counting import Counting
from tests.identification.estimation.cases import GRAVITY, tip
from tests.identification.kinematics.test_spatial import tip_by_exponentials

# of three targets the first is reached, the second 0.25 mm off, and the third's command misses a constraint by 3 mm
FOUND = Compensation(
    Arm(chain_of([DHRow(100.0, 0.0, 0.0), DHRow(0.0, 0.0, 0.0, type="prismatic", limits=(0.0, 100.0))])),
    np.array([[100.0, 0.0], [900.0, 0.0], [50.0, 50.0]]),
    np.array([[np.pi / 6.0, 40.0], [0.0, 80.0], [-np.pi / 2.0, 20.0]]),
    np.array([1e-9, 0.25, 1e-9]),
    barred=("", "", "constraint 1 (table) is missed by 3 mm"),
)


def test_figures() -> None:
    assert FOUND.reached.tolist() == [True, False, False]
    assert FOUND.messages == [
        "",
        "out of reach within the joint limits: the nearest posture misses it by 0.25 mm",
        "constraint 1 (table) is missed by 3 mm",
    ]
    figures = FOUND.to_json()
    assert (figures["targets"], figures["reached"], figures["unreachable"]) == (3, 1, [2, 3])
    assert figures["max_error_mm"] == 1e-9
    np.testing.assert_allclose(figures["commands_deg"][0], [30.0, 40.0])  # the slide in millimetres
    assert figures["commands_deg"][1:] == [None, None]
    assert [row["reachable"] for row in figures["commands"]] == [True, False, False]
    for found, reached in ((FOUND, [0]), (replace(FOUND, barred=("",) * 3), [0, 2])):
        np.testing.assert_array_equal(found.safe_commands[reached], found.commands[reached])
        assert np.isnan(np.delete(found.safe_commands, reached, axis=0)).all()


def test_rows_without_a_command_have_none() -> None:
    """Nothing is left where a constraint bars a target, since nothing is driven there; a frame is doubted where most
    targets are out of reach."""
    rows = FOUND.to_json()["commands"]
    assert [row["command"] for row in rows] == FOUND.to_json()["commands_deg"]
    assert [row["error_mm"] for row in rows] == [1e-9, 0.25, None]
    np.testing.assert_array_equal(FOUND.misses["error_mm"], [1e-9, 0.25, np.nan])
    assert FOUND.warnings == []  # one of three
    (said,) = replace(FOUND, errors=np.array([1e-9, 0.25, 600.0])).warnings
    assert said.startswith("2 of 3 targets are out of reach: are they in mm, and in the frame of the measurements")
    assert replace(FOUND, errors=np.full(3, 1e-9)).to_json()["unreachable"] == [3]


def test_a_pose_is_reached_if_its_angle_is_too() -> None:
    posed = replace(FOUND, angles=np.radians([0.0, 2.0, 0.0]))
    assert [row["error_deg"] for row in posed.to_json()["commands"]] == [0.0, pytest.approx(2.0), None]
    np.testing.assert_allclose(posed.misses["error_deg"], [0.0, 2.0, np.nan])
    posed = replace(FOUND, angles=np.radians([0.0, 0.0, 2.0]), barred=("",) * 3)
    assert posed.reached.tolist() == [True, False, False]
    assert posed.messages[2].endswith("the nearest posture misses it by 1e-09 mm and 2 deg")
    assert posed.to_json()["max_error_deg"] == 0.0


LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
CALIBRATION = Calibration.of(np.array([1.5, -0.6, -0.4, 0.7]), np.radians([0.5, -0.5, 0.7, -0.3]))
LIMITS = np.radians([180.0, 120.0, 100.0, 90.0])


def arm(*effects: EffectSpec, values: dict[str, float] | None = None) -> Arm:
    calibration = replace(CALIBRATION, values={**CALIBRATION.values, **(values or {})})
    return Arm(LENGTHS, -LIMITS, LIMITS, gravity=GRAVITY, effects=effects, calibration=calibration)


def test_shortest_correction_of_a_redundant_arm() -> None:
    """To first order the correction is the minimum-norm solution: no motion along the arm's self-motion."""
    nominal = np.random.default_rng(1).uniform(-0.6, 0.6, (20, 4)) * LIMITS
    for q, command in zip(nominal, compensate(arm(), postures=nominal).commands, strict=True):
        links = np.cumsum((LENGTHS * np.exp(1j * np.cumsum(q)))[::-1])[::-1] * 1j
        jacobian = np.array([links.real, links.imag])
        correction = command - q
        along = correction - np.linalg.pinv(jacobian) @ (jacobian @ correction)
        assert np.linalg.norm(along) < 0.1 * np.linalg.norm(correction)


def test_bad_input() -> None:
    with pytest.raises(InputError, match="calibration: the arm has none"):
        compensate(Arm(LENGTHS), np.zeros((1, 2)))
    with pytest.raises(InputError, match=r"targets: shape \(1, 3\), allowed: \(k, 2\)"):
        compensate(arm(), np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"postures: shape \(1, 2\), allowed: \(k, 4\)"):
        compensate(arm(), postures=np.zeros((1, 2)))
    with pytest.raises(InputError, match="targets: none given"):
        compensate(arm())
    with pytest.raises(InputError, match="orientations: found for a planar arm"):
        compensate(arm(), np.zeros((1, 2)), orientations=np.eye(3))
    with pytest.raises(InputError, match="2 rows for 3 targets"):
        compensate(arm(), np.zeros((3, 2)), np.zeros((2, 4)))


def from_the_hole(goal: np.ndarray, real: Arm) -> float:
    """Distance [mm] of a goal from the nearest point in reach, by brute force: a grid, then a finer one about its best.

    Joint 1 turns all round, so only the distance from the base counts.
    """
    found = real.calibration
    lengths = real.lengths + found.length_errors
    low, high = real.lower[1:], real.upper[1:]
    for levels in (61, 61, 61, 61):
        grids = [np.linspace(a, b, levels) for a, b in zip(low, high, strict=True)]
        theta, z = 0.0, lengths[0] + 0.0j
        for j, grid in enumerate(np.meshgrid(*grids, indexing="ij", sparse=True)):
            theta = theta + grid + found.joint_offsets[j + 1]
            z = z + lengths[j + 1] * np.exp(1j * theta)
        distance = np.abs(np.abs(z) - np.linalg.norm(goal))
        at = np.unravel_index(np.argmin(distance), distance.shape)
        middle, step = np.array([grid[k] for grid, k in zip(grids, at, strict=True)]), (high - low) / (levels - 1)
        low, high = np.maximum(middle - step, real.lower[1:]), np.minimum(middle + step, real.upper[1:])
    return float(distance.min())


def test_out_of_reach_the_command_is_the_nearest() -> None:
    """About the base the paper's arm has a hole that it cannot reach into; folded, joints stand on their limits."""
    generator = np.random.default_rng(21)  # damped least squares alone end up to 4 % off here
    upper = np.radians([180.0, 120.0, 60.0, 90.0])
    for _ in range(2):
        calibration = Calibration.of(generator.normal(0.0, 1.0, 4), np.radians(generator.normal(0.0, 1.0, 4)))
        real = Arm(LENGTHS, -LIMITS, upper, calibration=calibration)
        goals = np.vstack([[0.0, 0.0], generator.uniform(-6.0, 6.0, 2), generator.normal(0.0, 2.0, 2)])
        found = compensate(real, goals)
        nearest = [from_the_hole(goal, real) for goal in goals]
        assert min(nearest) > 0.1
        np.testing.assert_allclose(found.errors, nearest, rtol=1e-5)  # the last grid is 2e-5 rad wide
        np.testing.assert_allclose(found.errors, np.linalg.norm(Model(real).position(found.commands) - goals, axis=1))
        assert np.all((found.commands >= real.lower) & (found.commands <= real.upper))


@dataclass(frozen=True)
class TipAbove:
    """A constraint of the nominal tip: y >= least [mm]."""

    least: float
    kind: str = "tip_above"

    def margin(self, postures: np.ndarray) -> np.ndarray:
        return tip(postures, LENGTHS)[:, 1:] - self.least


def test_nobody_may_drive_to_what_misses_a_constraint() -> None:
    """A target below the line has no command in the file and says why; one above has, as without the constraint."""
    found = compensate(arm(), [[300.0, -200.0], [300.0, 250.0]], constraints=[TipAbove(-100.0)])
    assert found.reached.tolist() == [False, True]
    assert np.isnan(found.safe_commands[0]).all()
    np.testing.assert_array_equal(found.safe_commands[1], found.commands[1])
    heading, missed, kept = found.text().splitlines()
    assert heading.endswith("error_mm,reachable,message")
    assert missed.startswith(",,,,300.0,-200.0,")
    assert "constraint 1 (tip_above) is missed by" in missed
    assert kept.endswith('""')


def test_the_bodies_that_collide_are_named() -> None:
    @dataclass(frozen=True)
    class Pairs(TipAbove):
        kind: str = "clearance"
        pairs = ("link 4", "post"), ("link 4", "table")

        def margin(self, postures: np.ndarray) -> np.ndarray:
            return np.column_stack([np.full(len(postures), 5.0), super().margin(postures)])[:, : 2 * len(self.pairs)]

    found = compensate(arm(), [[300.0, -200.0]], constraints=[Pairs(-100.0)])
    assert re.fullmatch(r"link 4 and table are [\d.]+ mm too close to each other", found.messages[0])
    Pairs.pairs = ()  # of an arm whose meshes are not found
    assert compensate(arm(), [[300.0, -200.0]], constraints=[Pairs(-100.0)]).reached.all()


def test_targets_are_reached_at_the_angles_of_the_identification() -> None:
    """Where any posture will do, one inside the angles measured is taken: here the elbow is bent to one side only."""
    low, high = np.radians([[-100.0, 20.0, 20.0, -60.0], [100.0, 100.0, 80.0, 60.0]])
    inside = np.random.default_rng(3).uniform(low + 0.2, high - 0.2, (20, 4))
    known = replace(arm().calibration, provenance={"joint_range_deg": np.degrees([low, high]).T.tolist()})
    targets = tip(inside + CALIBRATION.joint_offsets, LENGTHS + CALIBRATION.length_errors)
    found = compensate(replace(arm(), calibration=known), targets)
    assert found.reached.all()
    assert np.count_nonzero((found.commands < low) | (found.commands > high)) == 0


def test_out_of_reach_the_command_stays_at_the_angles_of_the_identification() -> None:
    """Two links: the nearest point of the box of angles, by a fine grid; what is given near a posture stays there."""
    low, high = np.radians([[-60.0, 40.0], [60.0, 100.0]])
    known = Calibration.of(np.zeros(2), np.zeros(2), provenance={"joint_range_deg": np.degrees([low, high]).T.tolist()})
    two = Arm([300.0, 200.0], calibration=known)
    targets = np.array([[700.0, 100.0], [300.0, 900.0], [20.0, 10.0]])  # two beyond 500 mm, one within 100 mm
    found = compensate(two, targets)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 901).T, indexing="ij"), axis=-1).reshape(-1, 2)
    tips = tip(grid, [300.0, 200.0])
    inside = [np.linalg.norm(tips - goal, axis=1).min() for goal in targets]
    assert np.all((found.commands >= low) & (found.commands <= high))
    assert np.all(found.errors >= inside - np.array(0.7))  # of the grid: its step times the reach
    room = 500.0 * 0.02 * np.linalg.norm(high - low)  # the room that is left at either end
    assert np.all(found.errors <= inside + room)
    assert not found.reached.any()
    (said,) = found.warnings  # nothing of angles
    assert said.startswith("3 of 3 targets are out of reach")
    assert all("the nearest posture (within the angles identified) misses it" in said for said in found.messages)
    stretched = compensate(two, targets[:1], np.array([[0.1, 0.1]]))
    assert stretched.errors[0] == pytest.approx(np.hypot(700.0, 100.0) - 500.0, abs=1e-3)
    assert stretched.warnings


def test_nominal_postures_are_those_of_the_arm_where_it_stands() -> None:
    """In the frame of a tracker: base and rotation are no errors of the arm, which nominal postures would not know of;
    targets at the angles of the identification are reached there."""
    turn, shift = np.radians(35.0), 1200.0 - 300.0j
    place = {"base_offset.x0": shift.real, "base_offset.y0": shift.imag, "joint_offset:1": turn}
    known = replace(
        CALIBRATION,
        values={**CALIBRATION.values, **place},
        provenance={"joint_range_deg": np.degrees([-0.9 * LIMITS, 0.9 * LIMITS]).T.tolist()},
    )
    real = replace(arm(EffectSpec("base_offset")), calibration=known)

    def seen(q: np.ndarray, lengths: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        z = tip(q + np.r_[turn, offsets[1:]], lengths) @ [1.0, 1.0j] + shift
        return np.column_stack([z.real, z.imag])

    nominal = np.random.default_rng(4).uniform(-0.8, 0.8, (20, 4)) * LIMITS
    by_postures = compensate(real, postures=nominal)
    np.testing.assert_allclose(by_postures.targets, seen(nominal, LENGTHS, np.zeros(4)), atol=1e-9)
    assert by_postures.reached.all()
    assert np.median(np.linalg.norm(by_postures.commands - nominal, axis=1)) < np.radians(2.0)
    by_targets = compensate(real, seen(nominal, LENGTHS + CALIBRATION.length_errors, CALIBRATION.joint_offsets))
    assert by_targets.reached.all()
    assert by_targets.warnings == []


def test_the_side_of_the_approach_is_said() -> None:
    """Gear play b s_j: driven in the order said the tip is there, with joint 2 coming from the other side 2 b lever."""
    played, play = arm(EffectSpec("backlash", 2), values={"backlash:2.b": 2e-3}), np.array([0.0, 2e-3, 0.0, 0.0])
    nominal = np.array([[0.1, 0.2, 0.1, 0.1], [0.2, 0.4, 0.3, 0.2]])  # every joint rising
    found = compensate(played, postures=nominal)
    (said,) = found.warnings
    assert said.startswith("backlash: the error depends on the approach direction. Approach the targets in this order")
    assert found.to_json()["warnings"] == [said]
    counting = Counting((1, -1, 1, 1), (0, 0, 2, -3), (0.0,) * 4)
    assert np.all(counting.joints(np.array([1.0, -1.0, 1.1, 0.1])) > 0.0)  # all rise, as the next line asks for
    (counted,) = replace(found, arm=replace(played, counting=counting)).warnings
    assert counted.endswith("with every joint rising, but 2 falling, 3 by more than 2")
    lengths, offsets = LENGTHS + CALIBRATION.length_errors, CALIBRATION.joint_offsets
    np.testing.assert_allclose(tip(found.commands + offsets + play, lengths), found.targets, rtol=0, atol=TOLERANCE)
    missed = np.linalg.norm(tip(found.commands + offsets - play, lengths) - found.targets, axis=1)
    assert np.all(missed > 1.0)  # 2 x 2e-3 rad on some 390 mm
    wound = arm(EffectSpec("joint_hysteresis", 2, {"width_deg": 40.0}), values={"joint_hysteresis:2.b": 2e-3})
    by_friction = compensate(wound, postures=nominal)  # wound up by the first, which is come to from afar
    np.testing.assert_allclose(tip(by_friction.commands + offsets + play, lengths), found.targets, rtol=0, atol=1e-6)
    # nobody drives to what is out of reach: where it would have joint 2 does not matter to the next
    between = compensate(played, np.insert(found.targets, 1, [0.0, 5000.0], axis=0), np.insert(nominal, 1, 1.0, axis=0))
    assert between.reached.tolist() == [True, False, True]
    np.testing.assert_allclose(between.commands[between.reached], found.commands, rtol=0, atol=1e-9)
    late = arm(EffectSpec("servo_error", 2, {"b": 0.0, "h": 2e-3}))
    assert compensate(late, postures=nominal).warnings == [said.replace("backlash", "servo_error")]
    assert compensate(played, postures=nominal, conditions=Conditions(directions=np.ones((2, 4)))).warnings == []
    assert compensate(arm(), postures=nominal).warnings == []


def test_what_happened_in_the_session_is_over_and_the_temperature_is_its_mean() -> None:
    """A zero that jumped late in the session is off in every command, and the user is told what was taken."""
    step, growth = EffectSpec("joint_step", 2, {"at": 0.3}), EffectSpec("thermal_growth", None, {})
    jumped = arm(step, growth, values={"joint_step:2.b": 2e-3, "thermal_growth.a": 1e-4})
    nominal = np.array([[0.1, 0.2, 0.1, 0.1], [0.2, 0.4, 0.3, 0.2]])
    found = compensate(jumped, postures=nominal)
    lengths, offsets = LENGTHS + CALIBRATION.length_errors, CALIBRATION.joint_offsets
    jump = np.array([0.0, 2e-3, 0.0, 0.0])
    np.testing.assert_allclose(tip(found.commands + offsets + jump, lengths), found.targets, rtol=0, atol=TOLERANCE)
    ended = "joint_step:2: the value at the end of the session of the identification is used"
    assert found.warnings == [ended, "thermal_growth: taken at the mean temperature of the identification"]
    carried = f"joint_compliance:2: taken with the payload of the arm file, {GRAVITY.payload:g} kg"
    read = "measurement_scale: an instrument error, which targets are assumed to have, as readings do"
    scaled = EffectSpec("measurement_scale", None, {"s": 1e-4})
    for spec, said in ((EffectSpec("joint_compliance", 2, {"c": 1e-5}), carried), (scaled, read)):
        assert compensate(arm(spec), postures=nominal).warnings == [said]
    before = compensate(jumped, postures=nominal, conditions=Conditions(time=np.zeros(2), temperature=np.zeros(2)))
    assert before.warnings == []
    np.testing.assert_allclose(tip(before.commands + offsets, lengths), before.targets, rtol=0, atol=TOLERANCE)
    # in the second session, which has a base of its own: the file has that of the first
    later = EffectSpec("base_step", None, {"at": 1.2, "side": 1.0})
    moved = arm(later, values={"base_step.x": 1.0, "base_step.y": 0.0})
    np.testing.assert_allclose(compensate(moved, found.targets).commands, compensate(arm(), found.targets).commands)


NOISE = 0.05  # [mm] of each coordinate
REFLECTOR = np.array([50.0, 20.0, 30.0])
CHAIN = chain_of([DHRow(80.0, np.radians(90.0), 300.0), DHRow(400.0, 0.0, 0.0)])
ERRORS = {"translation_x:2": 0.4, "translation_z:2": -0.3, "rotation_x:2": 6e-4}


def session(rows: int, seed: int, width: float = 1.2) -> tuple[Array, Array]:
    generator = np.random.default_rng(seed)
    q = generator.uniform(-width, width, (rows, 2))
    tips = np.array([tip_by_exponentials(CHAIN, row, ERRORS, REFLECTOR) for row in q])
    return q, tips + NOISE * generator.standard_normal(tips.shape)


@cache
def calibrated() -> tuple[Arm, float]:
    """The arm, and the RMS distance [mm] that its calibration expects of a right position: noise and its own error."""
    arm = Arm(replace(CHAIN, tools={"1": REFLECTOR}, settled=frozenset()), sigma=NOISE)
    found = estimate(Model(arm), Measurements(*session(40, 0)))
    rms = float(np.hypot(found.rms_after, found.expected_tip or np.nan))
    return replace(found.model.arm, calibration=found.calibration()), rms


@pytest.mark.parametrize("near", [False, True])
def test_measured_positions_are_reached(near: bool) -> None:
    """From nothing, and from the posture that was measured: no other branch of the arm is taken because it is nearer by
    some microns."""
    arm, rms = calibrated()
    q, positions = session(30, 1)
    found = compensate(arm, positions, postures=q if near else None)
    assert found.tolerance == pytest.approx(rms * np.sqrt(chi2.isf(1e-3, 3) / 3.0), rel=1e-9)
    assert found.errors.min() > TOLERANCE
    assert found.reached.all()
    # where they were measured: noise across 200 mm of lever, the shortest in these postures, and the calibration's own
    np.testing.assert_allclose(found.commands, q, rtol=0, atol=5.0 * rms / 200.0)
    assert found.to_json()["tolerance_mm"] == found.tolerance
    (said,) = (warning for warning in found.warnings if "missed by" in warning)
    assert said.startswith(f"30 of the reached targets are missed by {found.errors.max():.2g} mm at most")
    assert f"within the {found.tolerance:.2g} mm that 999 of 1,000 measured positions are off by" in said
    several = replace(arm, chain=replace(arm.chain, tools={"1": REFLECTOR, "B": np.zeros(3)}))
    assert "targets are for measured point 1, not for B" in compensate(several, positions, q).warnings


def test_targets_off_the_surface_are_not() -> None:
    """Moved along the arm by ten times the tolerance, those in between are told apart by the distance alone."""
    arm, _ = calibrated()
    _, positions = session(6, 2)
    axis = positions - positions.mean(axis=0)
    tolerance = compensate(arm, positions).tolerance
    far = compensate(arm, positions + 10.0 * tolerance * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    assert not far.reached[far.errors > tolerance].any()
    assert far.reached[far.errors <= tolerance].all()
    assert (far.errors > tolerance).any()
