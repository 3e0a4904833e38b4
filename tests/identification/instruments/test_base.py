"""What instruments of lengths read: differences, and parameters that no reading shows."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from identification.instruments import TRACKER, Distance, Instrument, Plane, Sphere
from identification.kinematics.frames import AXES, from_angles, pose

LENGTHS = [Distance(), Sphere(20.0), Plane()]
POINTS = np.random.default_rng(0).uniform(-500.0, 500.0, (6, 3))
STEP = 1e-4  # [mm]
NOTHING = np.zeros(0), np.zeros(1)  # of its own, and the first target


@pytest.mark.parametrize("instrument", LENGTHS, ids=lambda one: one.kind)
def test_readings_and_derivatives(instrument: Instrument) -> None:
    above = np.linalg.norm(POINTS, axis=1) - (instrument.radius if isinstance(instrument, Sphere) else 0.0)
    expected = POINTS[:, 2] if instrument.kind == "plane" else above
    read, slopes, _ = instrument.linearized(POINTS, *NOTHING)
    np.testing.assert_allclose(read[:, 0], expected, rtol=1e-15)
    symbol = ca.SX.sym("p", 3)
    function = ca.Function("read", [symbol], [instrument.reading(symbol, ca.SX(0, 1), ca.SX(0))])
    assert [float(function(point)) for point in POINTS] == pytest.approx(expected, rel=1e-15)
    for k, step in enumerate(STEP * np.eye(3)):
        up, down = (instrument.linearized(POINTS + sign * step, *NOTHING)[0][:, 0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(slopes[:, 0, k], (up - down) / (2.0 * STEP), atol=1e-9)


def test_a_sphere_of_unknown_radius_is_read_by_heights_above_it() -> None:
    ball, symbol, values = Sphere(), ca.SX.sym("p", 3), ca.SX.sym("v", 1)
    function = ca.Function("read", [symbol, values], [ball.reading(symbol, values, ca.SX(0))])
    heights = [float(function(point, [25.0])) for point in POINTS]
    assert heights == pytest.approx(np.linalg.norm(POINTS, axis=1) - 25.0)
    assert [not one.size_is_open[0] for one in (*LENGTHS, ball)] == [True, True, False, False]


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
