"""Constraints in inverse kinematics: two-link arms have two postures for a target, which can be listed; others are
checked by points sampled along the links.

Targets that many starts are tried for: those that a constraint bars by themselves end the search, others do not.

Postures at targets from nominal ones, and without: turns, the middle of the angles, limits far away.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from doe.problem.constraints import constraints_of
from identification import Arm, Calibration, Model
from identification.compensate import TOLERANCE, compensate
from identification.instruments import Tracker
from identification.workspace import KeepOut, WorkspaceBox
from tests.doe.six_axis import CHAIN

CIRCLE = KeepOut((150.0, 120.0), 70.0)
TRUE = np.array([301.0, 198.0])
OFFSETS = np.array([0.01, -0.02])


def clearance(joints: np.ndarray) -> np.ndarray:
    """(k,) distance of polylines (k, points) of the complex plane from the circle, by many points on each link."""
    points = joints[:, :-1, None] + np.linspace(0.0, 1.0, 2001) * np.diff(joints, axis=1)[..., None]
    return np.min(np.abs(points - complex(*CIRCLE.start)), axis=(1, 2)) - CIRCLE.radius


def chain(q: np.ndarray, lengths: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(k, n + 1) base, joints and tip, as complex numbers."""
    links = lengths * np.exp(1j * np.cumsum(q + offsets, axis=1))
    return np.concatenate([np.zeros((len(q), 1)), np.cumsum(links, axis=1)], axis=1)


def test_the_elbow_that_is_free_is_chosen() -> None:
    """A target is reached exactly where one of the two postures of trigonometry keeps out of the circle."""
    two = Arm([300.0, 200.0], constraints=(CIRCLE,), calibration=Calibration.of(TRUE - [300.0, 200.0], OFFSETS))
    targets = np.random.default_rng(4).uniform(0.0, 300.0, (80, 2))
    targets = targets[np.hypot(*targets.T) > 110.0]
    distance, direction = np.hypot(*targets.T), np.arctan2(targets[:, 1], targets[:, 0])
    elbow = np.arccos((distance**2 - TRUE @ TRUE) / (2.0 * np.prod(TRUE)))
    free = []
    for turn in (elbow, -elbow):
        first = direction - np.arctan2(TRUE[1] * np.sin(turn), TRUE[0] + TRUE[1] * np.cos(turn))
        free.append(clearance(chain(np.column_stack([first, turn]), TRUE, np.zeros(2))))
    clear = np.max(free, axis=0)
    sure = np.abs(clear) > 0.1  # sampling along the links
    found = compensate(two, targets, constraints=constraints_of(Model(two)))
    np.testing.assert_array_equal(found.reached[sure], clear[sure] > 0.0)
    assert 10 < np.count_nonzero(found.reached) < len(targets) - 10
    assert np.all(found.errors < TOLERANCE)
    assert np.count_nonzero(found.reached & (np.min(free, axis=0) < 0.0)) > 5
    said = json.loads(json.dumps(found.to_json()))
    for row, reached, command in zip(said["commands"], found.reached, found.commands, strict=True):
        assert row["reachable"] == reached
        assert row["message"].startswith("" if reached else "constraint 1 (keep_out_circle) is missed by ")
        assert row["command"] == (pytest.approx(np.degrees(command).tolist()) if reached else None)
    assert said["unreachable"] == (np.flatnonzero(~found.reached) + 1).tolist()


def test_targets_outside_the_workspace_say_so() -> None:
    box = WorkspaceBox((-200.0, 200.0), (-400.0, 400.0))
    two = Arm([300.0, 200.0], constraints=(box,), calibration=Calibration.of(np.zeros(2), np.zeros(2)))
    found = compensate(two, [[230.0, 100.0], [100.0, 200.0], [1000.0, 0.0]], constraints=constraints_of(Model(two)))
    outside, inside, far = found.messages
    assert (outside, inside) == ("constraint 1 (workspace_box) is missed by 30 mm", "")
    assert far.startswith("out of reach within the joint limits: the nearest posture misses it by 500 mm; constraint 1")
    figures = found.to_json()
    assert (figures["reached"], figures["unreachable"]) == (1, [1, 3])
    assert figures["max_error_mm"] < TOLERANCE
    assert figures["commands_deg"][0] is None
    nothing = compensate(two, [[1000.0, 0.0]]).to_json()
    assert (nothing["max_error_mm"], nothing["reached"]) == (None, 0)


LENGTHS = np.array([200.0, 150.0, 120.0])


def test_a_target_that_a_link_bars_is_searched_for() -> None:
    """A circle on the straight way to every target, which links of most postures cross by different amounts: a target
    is reached if a fine scan of the last link's direction reaches it with a millimetre to spare."""
    circle = KeepOut((170.0, 0.0), 60.0)
    arm = Arm(LENGTHS, constraints=(circle,), calibration=Calibration.of(np.zeros(3), np.zeros(3)))
    generator = np.random.default_rng(2)
    targets = np.column_stack([generator.uniform(250.0, 330.0, 30), generator.uniform(-60.0, 60.0, 30)])
    found = compensate(arm, targets, constraints=constraints_of(Model(arm)))
    free = np.array([scanned(target, circle) for target in targets])
    sure = np.abs(free) > 1.0
    np.testing.assert_array_equal(found.reached[sure], free[sure] > 0.0)
    assert np.count_nonzero(found.reached) > 5


def scanned(target: np.ndarray, circle: KeepOut) -> float:
    """The largest clearance [mm] of all postures that reach the target, from 7,200 directions of the last link."""
    wrist = complex(*target) - LENGTHS[2] * np.exp(1j * np.linspace(-np.pi, np.pi, 7200))
    cosine = (np.abs(wrist) ** 2 - LENGTHS[:2] @ LENGTHS[:2]) / (2.0 * LENGTHS[0] * LENGTHS[1])
    wrist, cosine = wrist[np.abs(cosine) <= 1.0], cosine[np.abs(cosine) <= 1.0]
    best = -np.inf
    for elbow in (np.arccos(cosine), -np.arccos(cosine)):
        first = np.angle(wrist / (LENGTHS[0] + LENGTHS[1] * np.exp(1j * elbow)))
        joint = LENGTHS[0] * np.exp(1j * first)
        points = np.stack([np.zeros_like(joint), joint, wrist, np.full_like(joint, complex(*target))], axis=1)
        start, along = points[:, :-1], np.diff(points, axis=1)
        share = np.clip((np.conj(along) * (complex(*circle.start) - start)).real / np.abs(along) ** 2, 0.0, 1.0)
        best = max(best, float((np.abs(start + share * along - complex(*circle.start)).min(axis=1)).max()))
    return best - circle.radius


def test_poses_that_few_starts_lead_to_are_reached() -> None:
    """Poses of random postures can be reached, whatever 32 starts say: of 2,000 they missed these and others."""
    missed = [282, 498, 854, 979, 1936]
    chain = replace(CHAIN, tools={"1": np.array([0.0, 0.0, 100.0])}, instrument=Tracker(1000.0))
    arm = replace(Arm(chain), calibration=Calibration({"base.x": 0.0}))
    postures = np.random.default_rng(11).uniform(-np.pi, np.pi, (2000, 6))[missed]
    model = Model(arm)
    found = compensate(arm, model.position(postures)[:, :3], orientations=model.orientations(postures))
    assert found.reached.all(), found.messages
    np.testing.assert_allclose(model.position(found.commands)[:, :3], model.position(postures)[:, :3], atol=TOLERANCE)


def test_a_posture_a_turn_beyond_the_limits_is_the_same_posture() -> None:
    limits, exact = np.radians([170.0, 170.0]), Calibration.of(np.zeros(2), np.zeros(2))
    arm = Arm([300.0, 200.0], lower=-limits, upper=limits, calibration=exact)
    wanted, read = np.radians([[137.0, -60.0]]), np.radians([[-223.0, 300.0]])
    assert compensate(arm, Model(arm).position(wanted, np.zeros(4)), read).commands == pytest.approx(wanted, abs=1e-6)


def test_nominal_postures_thousands_of_turns_away() -> None:
    """A redundant arm without constraints, asked for the nearest posture to one that its limits forbid by far."""
    limits, none = np.full(3, 1.7), np.zeros(3)
    arm = Arm([300.0, 240.0, 192.0], lower=-limits, upper=limits, calibration=Calibration.of(none, none))
    nominal = np.random.default_rng(5).uniform(-1e6, 1e6, (6, 3))
    found = compensate(arm, Model(arm).position(np.random.default_rng(6).uniform(-1.7, 1.7, (6, 3))), nominal)
    assert found.reached.all()
    assert np.all(np.abs(found.commands) <= 1.7)
