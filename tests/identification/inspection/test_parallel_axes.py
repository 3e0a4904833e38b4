"""Runs of parallel axes, counted by hand."""

from __future__ import annotations

import numpy as np

from identification.arm import Arm
from identification.inspection.parallel_axes import parallel_joints
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from tests.identification.exponentials import drawing


def test_of_an_elbow_arm_joints_two_to_four() -> None:
    assert parallel_joints(Arm.of_chain(drawing())) == [(1, (1, 1, 1))]


def test_in_the_plane_all_and_of_a_single_link_none() -> None:
    assert parallel_joints(Arm(np.array([300.0, 200.0, 100.0]))) == [(0, (1, 1, 1))]
    assert parallel_joints(Arm(np.array([300.0]))) == []


def test_an_axis_that_points_the_other_way() -> None:
    """Half a turn about x between joints 1 and 2; a quarter to joint 3, and to joint 4 none."""
    rows = [DHRow(300.0, np.pi, 0.0), DHRow(200.0, np.pi / 2.0, 0.0), DHRow(100.0, 0.0, 0.0), DHRow(100.0, 0.0, 0.0)]
    assert parallel_joints(Arm.of_chain(chain_of(rows))) == [(0, (1, -1)), (2, (1, 1))]


def test_a_sliding_joint_ends_a_run() -> None:
    slide = DHRow(0.0, 0.0, 0.0, type="prismatic", limits=(0.0, 300.0))
    rows = [DHRow(300.0, 0.0, 0.0), DHRow(200.0, 0.0, 0.0), slide, DHRow(100.0, 0.0, 0.0)]
    assert parallel_joints(Arm.of_chain(chain_of(rows))) == [(0, (1, 1))]
