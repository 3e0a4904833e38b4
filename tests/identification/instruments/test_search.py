"""Base, center, plane and measured point from nothing: readings without noise give them back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.instruments import Distance, Plane, Sphere
from identification.instruments.search import Unplaced, registered
from identification.kinematics.frames import pose
from tests.identification.exponentials import Exponentials

TOOL = np.array([60.0, -40.0, 120.0])
CENTER, NORMAL, HEIGHT = np.array([500.0, -300.0, 200.0]), np.array([0.6, 0.0, 0.8]), -350.0
REACH = 1500.0  # [mm] of these arms


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    generator = np.random.default_rng(0)
    return Exponentials(generator, np.eye(4)).poses(generator.uniform(-2.0, 2.0, (40, 6)))


def points(frames: np.ndarray) -> np.ndarray:
    return np.asarray(frames[:, :3, 3] + frames[:, :3, :3] @ TOOL)


def test_a_center(frames: np.ndarray) -> None:
    lengths = np.linalg.norm(points(frames) - CENTER, axis=1)
    found = Distance().place(Unplaced(frames, lengths[:, None], REACH))
    np.testing.assert_allclose(found.base[:3, 3], -CENTER, atol=1e-6)
    np.testing.assert_array_equal(found.base[:3, :3], np.eye(3))
    np.testing.assert_allclose(found.tool, TOOL, atol=1e-6)
    assert found.rms < 1e-7


@pytest.mark.parametrize("radius", [3.0, 40.0, 300.0])
def test_a_ball(radius: float) -> None:
    generator = np.random.default_rng(2)
    frames = np.tile(np.eye(4), (40, 1, 1))
    frames[:, :3, :3] = Rotation.random(40, random_state=3).as_matrix()
    normals = generator.standard_normal((40, 3))
    places = CENTER + radius * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    frames[:, :3, 3] = places - frames[:, :3, :3] @ TOOL
    found = Sphere(radius).place(Unplaced(frames, np.zeros((40, 1)), REACH))
    np.testing.assert_allclose(found.base[:3, 3], -CENTER, atol=1e-6)
    np.testing.assert_allclose(found.tool, TOOL, atol=1e-6)
    assert found.rms < 1e-7
    by_base = Sphere(radius).place(Unplaced(frames, np.zeros((40, 1)), REACH, base=found.base))
    np.testing.assert_allclose(by_base.tool, TOOL, atol=1e-6)


def test_a_plane_stands_below_the_arm(frames: np.ndarray) -> None:
    heights = points(frames) @ NORMAL - HEIGHT  # of an indicator that reads them
    found = Plane().place(Unplaced(frames, heights[:, None], REACH))
    np.testing.assert_allclose(found.base[2], [*NORMAL, -HEIGHT], atol=1e-6)
    np.testing.assert_allclose(found.base[:3, :3] @ found.base[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.tool, TOOL, atol=1e-6)


def test_registration_is_no_mirror() -> None:
    """Points in a plane fit a mirrored base as well: a rotation must come out."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 1.0, 0.0]])
    turn = Rotation.from_euler("xyz", [1.0, 2.0, 3.0]).as_matrix()
    found = registered(points, points @ turn.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found, pose((1.0, 2.0, 3.0), turn), atol=1e-12)
