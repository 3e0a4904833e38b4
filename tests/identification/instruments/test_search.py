"""Base, center, plane and measured point from nothing: readings without noise give them back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.instruments import TRACKER, Distance, Instrument, Plane, Sphere
from identification.instruments.search import Unplaced, registered
from identification.kinematics.frames import pose
from tests.identification.exponentials import Exponentials

TOOL, REACH = np.array([60.0, -40.0, 120.0]), 1500.0  # [mm]
BASE = pose([500.0, -300.0, 800.0], Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix())  # above the plane
GENERATOR = np.random.default_rng(0)
FRAMES = Exponentials(GENERATOR, np.eye(4)).poses(GENERATOR.uniform(-2.0, 2.0, (80, 6)))


def read(instrument: Instrument, frames: np.ndarray, base: np.ndarray, tool: np.ndarray) -> np.ndarray:
    points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
    return instrument.readings(points @ base[:3, :3].T + base[:3, 3], np.zeros(0))


@pytest.mark.parametrize("tool", [None, TOOL], ids=["", "the point is known"])
@pytest.mark.parametrize("base", [None, BASE], ids=["", "the base is known"])
@pytest.mark.parametrize("instrument", [TRACKER, Distance(), Plane()], ids=lambda instrument: type(instrument).__name__)
def test_base_and_point_come_back(instrument: Instrument, base: np.ndarray | None, tool: np.ndarray | None) -> None:
    """And of other postures the same is read."""
    readings = read(instrument, FRAMES[:40], BASE, TOOL)
    placed = instrument.place(Unplaced(FRAMES[:40], readings, REACH, base, tool))
    np.testing.assert_allclose(placed.tool, TOOL, atol=1e-6)
    np.testing.assert_allclose(placed.base[:3, :3] @ placed.base[:3, :3].T, np.eye(3), atol=1e-12)
    others = (read(instrument, FRAMES[40:], *each) for each in ((BASE, TOOL), placed[:2]))
    np.testing.assert_allclose(*others, atol=1e-5)
    assert placed.rms < 1e-7
    if instrument == Plane():  # the arm stands above it
        np.testing.assert_allclose(placed.base[2], BASE[2], atol=1e-6)


@pytest.mark.parametrize("radius", [3.0, 40.0, 300.0])
def test_a_ball(radius: float) -> None:
    center, generator = BASE[:3, 3], np.random.default_rng(2)
    frames = np.tile(np.eye(4), (40, 1, 1))
    frames[:, :3, :3] = Rotation.random(40, random_state=3).as_matrix()
    normals = generator.standard_normal((40, 3))
    places = center + radius * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    frames[:, :3, 3] = places - frames[:, :3, :3] @ TOOL
    placed = Sphere(radius).place(Unplaced(frames, np.zeros((40, 1)), REACH))
    np.testing.assert_allclose(placed.base[:3, 3], -center, atol=1e-6)
    np.testing.assert_allclose(placed.tool, TOOL, atol=1e-6)
    assert placed.rms < 1e-7
    by_base = Sphere(radius).place(Unplaced(frames, np.zeros((40, 1)), REACH, base=placed.base))
    np.testing.assert_allclose(by_base.tool, TOOL, atol=1e-6)


def test_a_ball_touched_from_one_side() -> None:
    """A dozen times within 20 degrees: the surface is reached, not some other minimum."""
    for seed in range(30):
        generator = np.random.default_rng(seed)
        frames, normals = np.tile(np.eye(4), (12, 1, 1)), generator.standard_normal((12, 3))
        frames[:, :3, :3] = Rotation.from_rotvec(0.2 * generator.standard_normal((12, 3))).as_matrix()
        places = BASE[:3, 3] + 15.0 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
        frames[:, :3, 3] = places - frames[:, :3, :3] @ TOOL
        assert Sphere(15.0).place(Unplaced(frames, np.zeros((12, 1)), REACH)).rms < 1e-6


def test_registration_is_no_mirror() -> None:
    """Points in a plane fit a mirrored base as well: a rotation must come out."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 1.0, 0.0]])
    np.testing.assert_allclose(registered(points, points @ BASE[:3, :3].T + BASE[:3, 3]), BASE, atol=1e-12)
