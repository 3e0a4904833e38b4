"""What is said of commands: counted and converted by hand, for targets that are reached, missed and forbidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, Calibration
from identification.compensate import compensate
from identification.compensate.compensation import Compensation
from identification.kinematics.joint_range import joint_range

# of three targets the first is reached, the second 0.25 mm off, and the third's command misses a constraint by 3 mm
FOUND = Compensation(
    np.array([[100.0, 0.0], [900.0, 0.0], [50.0, 50.0]]),
    np.zeros((3, 2)),
    np.array([[np.pi / 6.0, 40.0], [0.0, 80.0], [-np.pi / 2.0, 20.0]]),
    np.array([1e-9, 0.25, 1e-9]),
    joint_types=("revolute", "prismatic"),
    constraints=("table",),
    violations=np.array([[0.0], [0.0], [3.0]]),
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
    assert (figures["max_error_mm"], figures["max_unreached_mm"]) == (1e-9, 0.25)
    np.testing.assert_allclose(figures["commands_deg"][0], [30.0, 40.0])  # the slide in millimetres
    assert figures["commands_deg"][1:] == [None, None]
    assert [row["reachable"] for row in figures["commands"]] == [True, False, False]


def test_a_frame_is_doubted_where_most_targets_are_out_of_reach() -> None:
    assert FOUND.warnings == []  # one of three
    (said,) = replace(FOUND, errors=np.array([1e-9, 0.25, 600.0])).warnings
    assert said.startswith("2 of 3 targets are out of reach: are they in mm, and in the frame of the measurements")


def test_what_misses_a_constraint_is_no_command() -> None:
    for found, reached in ((FOUND, [0]), (replace(FOUND, violations=None), [0, 2])):
        np.testing.assert_array_equal(found.safe_commands[reached], found.commands[reached])
        assert np.isnan(np.delete(found.safe_commands, reached, axis=0)).all()


def test_rows_without_a_command_have_none_and_what_is_nearest_beside_it() -> None:
    """Nothing is left where a constraint bars a target, since nothing is driven there."""
    rows = FOUND.to_json()["commands"]
    assert [row["command"] for row in rows] == FOUND.to_json()["commands_deg"]
    assert rows[0]["nearest"] is None
    assert [row["nearest"] for row in rows[1:]] == [[0.0, 80.0], pytest.approx([-90.0, 20.0])]
    assert [row["error_mm"] for row in rows] == [1e-9, 0.25, None]
    np.testing.assert_array_equal(FOUND.left, [1e-9, 0.25, np.nan])
    posed = replace(FOUND, angles=np.radians([0.0, 2.0, 0.0]))
    assert [row["error_deg"] for row in posed.to_json()["commands"]] == [0.0, pytest.approx(2.0), None]
    np.testing.assert_array_equal(posed.left_angles, [0.0, np.radians(2.0), np.nan])
    barred = replace(FOUND, errors=np.full(3, 1e-9)).to_json()
    assert (barred["unreachable"], barred["max_unreached_mm"]) == ([3], None)


def test_a_pose_is_reached_if_its_angle_is_too() -> None:
    posed = replace(FOUND, angles=np.radians([0.0, 0.0, 2.0]), constraints=(), violations=None)
    assert posed.reached.tolist() == [True, False, False]
    assert (
        posed.messages[2] == "out of reach within the joint limits: the nearest posture misses it by 1e-09 mm and 2 deg"
    )
    assert posed.to_json()["max_error_deg"] == 0.0


def test_frame() -> None:
    frame = FOUND.to_frame()
    assert frame.columns == ["q1", "q2", "x_mm", "y_mm", "error_mm", "reachable", "message"]
    assert frame["q1"].to_list() == pytest.approx([30.0, 0.0, -90.0])


def test_joints_beyond_the_angles_of_the_identification_are_counted() -> None:
    """Two links whose commands have a closed form: the angles needed follow from the law of cosines."""
    lengths = np.array([300.0, 200.0])
    measured = joint_range(np.array([[-1.0, 0.3], [1.0, 1.2]]), ("revolute", "revolute"))
    found = Calibration.of(np.zeros(2), np.zeros(2), {}, provenance=measured)
    arm = Arm(lengths, calibration=found)
    bends = np.array([0.5, 1.1, 1.6, 2.0])  # of joint 2; the last two were never measured
    reach = np.sqrt(300.0**2 + 200.0**2 + 2.0 * 300.0 * 200.0 * np.cos(bends))
    first = np.array([0.2, -1.5, 0.4, -1.4])  # of joint 1; the second and the last
    toward = first + np.arctan2(200.0 * np.sin(bends), 300.0 + 200.0 * np.cos(bends))
    targets = reach[:, None] * np.column_stack([np.cos(toward), np.sin(toward)])
    done = compensate(arm, targets, np.column_stack([first, bends]))
    np.testing.assert_allclose(done.commands, np.column_stack([first, bends]), atol=1e-9)
    data = done.to_json()
    joints = [{"joint": 1, "targets": 2}, {"joint": 2, "targets": 2}]
    assert data["outside_identified"] == {"targets": [2, 3, 4], "joints": joints}
    (said,) = data["warnings"]
    assert said.startswith(
        "3 of 4 targets are outside the angles that the model was identified on (joint 1 in 2, joint 2"
    )
    whole = compensate(replace(arm, calibration=replace(found, provenance={})), targets)
    assert whole.to_json()["outside_identified"] is None
    assert whole.warnings == []
    near = compensate(arm, targets[:1], np.column_stack([first, bends])[:1])
    assert near.warnings == []
