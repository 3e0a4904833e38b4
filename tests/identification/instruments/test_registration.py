"""Base and tool found again from points that a known base and tool make."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.instruments.search import Unplaced, placed, registered
from identification.kinematics.frames import pose


@pytest.mark.parametrize("seed", range(4))
def test_found_again_from_nothing(seed: int) -> None:
    generator = np.random.default_rng(seed)
    frames = np.tile(np.eye(4), (40, 1, 1))
    frames[:, :3, :3] = Rotation.random(40, rng=generator).as_matrix()
    frames[:, :3, 3] = generator.uniform(-800.0, 800.0, (40, 3))
    base = pose(generator.uniform(-3000.0, 3000.0, 3), Rotation.random(rng=generator).as_matrix())
    tool = generator.uniform(-250.0, 250.0, 3)
    sigma = 0.05
    measured = (frames[:, :3, :3] @ tool + frames[:, :3, 3]) @ base[:3, :3].T + base[:3, 3]
    measured += sigma * generator.standard_normal(measured.shape)
    found = placed(Unplaced(frames, measured, 1000.0))
    # 40 points of three coordinates, 9 unknowns: of a mean each deviation is sigma times a few over sqrt(40)
    np.testing.assert_allclose(found.tool, tool, atol=10.0 * sigma / np.sqrt(40.0) * 2.0)
    np.testing.assert_allclose(found.base[:3, 3], base[:3, 3], atol=10.0 * sigma / np.sqrt(40.0) * 2.0)
    assert 0.5 * sigma < found.rms / np.sqrt(3.0) < 1.3 * sigma


def test_registration_is_no_mirror() -> None:
    """Points in a plane fit a mirrored base as well: a rotation must come out."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 1.0, 0.0]])
    turn = Rotation.from_euler("xyz", [1.0, 2.0, 3.0]).as_matrix()
    found = registered(points, points @ turn.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found, pose((1.0, 2.0, 3.0), turn), atol=1e-12)
