"""Parameters of the base that no reading of an instrument shows, and bases of later sessions."""

from __future__ import annotations

import numpy as np
import pytest

from identification.instruments import TRACKER, Distance, Plane
from identification.kinematics.frames import AXES, from_angles, pose


def test_turns_about_a_normal_are_hidden() -> None:
    """The base's axis that is nearest to the normal, which is the last row of the base's pose."""
    level, upright = np.eye(4), pose(rotation=np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    assert Plane().hidden(level) == {"base.x", "base.y", "base.rz"}
    assert Plane().hidden(upright) == {"base.x", "base.y", "base.ry"}


@pytest.mark.parametrize(
    "normal", [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]]
)
def test_bases_of_later_planes(normal: list[float]) -> None:
    """The shift and the rotations lead to a base with the same normal and height, and the two that are left tilt the
    normal in both directions, wherever it points."""
    first = pose([10.0, 20.0, 30.0], from_angles((0.2, -0.1, 0.7)))
    across = np.linalg.svd(np.array([normal]))[2][1:]
    base = pose([1.0, 2.0, 300.0], np.array([across[0], np.cross(normal, across[0]), normal]))
    found, hidden = Plane().between(first, base)
    turn = [found[f"w{axis}"] for axis in AXES]
    there = first[:3, :3] @ from_angles(turn)
    np.testing.assert_allclose(there[2], normal, atol=1e-12)
    assert 30.0 + found["z"] == pytest.approx(300.0)
    assert {"x", "y"} < hidden
    assert len(hidden) == 3
    free = [k for k, axis in enumerate(AXES) if f"w{axis}" not in hidden]
    tilts = [first[2, :3] @ (from_angles(turn + 1e-6 * np.eye(3)[k]) - from_angles(turn)) / 1e-6 for k in free]
    assert np.linalg.svd(tilts, compute_uv=False)[-1] > 0.5


def test_bases_of_later_centers() -> None:
    found, hidden = Distance().between(np.eye(4), pose([1.0, 2.0, 3.0]))
    assert found == {"x": 1.0, "y": 2.0, "z": 3.0, "wx": 0.0, "wy": 0.0, "wz": 0.0}
    assert hidden == {"wx", "wy", "wz"}
    assert TRACKER.between(np.eye(4), np.eye(4))[1] == frozenset()
