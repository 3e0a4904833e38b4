"""A six-axis arm as a product of exponentials: an independent simulator without frames of joints or corrections."""

from __future__ import annotations

import numpy as np

from identification import Array
from identification.kinematics.chain import DHRow, KinematicChain, chain_of

HALF = np.pi / 2.0
TABLE = (  # a [mm], alpha [rad], d [mm] of the drawing
    *((0.0, HALF, 300.0), (-420.0, 0.0, 0.0), (-390.0, 0.0, 0.0)),
    *((0.0, HALF, 130.0), (0.0, -HALF, 100.0), (0.0, 0.0, 80.0)),
)


SEVEN = (  # the same with an elbow that swings out
    *((0.0, HALF, 340.0), (0.0, -HALF, 0.0), (0.0, HALF, 400.0), (0.0, -HALF, 0.0), (0.0, HALF, 400.0)),
    *((0.0, -HALF, 0.0), (0.0, 0.0, 126.0)),
)


def drawing(table: tuple[tuple[float, float, float], ...] = TABLE) -> KinematicChain:
    return chain_of([DHRow(*row) for row in table])


def twist(axis: Array, point: Array) -> Array:
    """(4, 4) generator of a rotation about a line."""
    x, y, z = axis
    found = np.zeros((4, 4))
    found[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    found[:3, 3] = -np.cross(axis, point)
    return found


def rotations(line: Array, angles: Array) -> Array:
    """(m, 4, 4) exp(angle line): the generator T of a rotation has T^3 = -T, which sums the series."""
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(4) + sine * line + (1.0 - cosine) * line @ line)


class Exponentials:
    """An arm of lines in space, all a little off those drawn, that a frame at its end is measured of.

    table : of the drawing, of six joints
    tool : (4, 4) pose of that frame in the last one of the drawing [mm], None: some pose
    """

    def __init__(
        self,
        generator: np.random.Generator,
        tool: Array | None = None,
        table: tuple[tuple[float, float, float], ...] = TABLE,
    ) -> None:
        home, lines = np.eye(4), []
        for a, alpha, d in table:
            axis = home[:3, 2] + 2e-3 * generator.standard_normal(3)
            lines.append(twist(axis / np.linalg.norm(axis), home[:3, 3] + 0.5 * generator.standard_normal(3)))
            along, across = np.eye(4), np.eye(4)
            along[2, 3], across[0, 3] = d, a
            across[1:3, 1:3] = [[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]]
            home = home @ along @ across
        if tool is None:
            tool = rotations(twist(np.array([0.48, 0.6, 0.64]), np.array([60.0, -40.0, 70.0])), np.ones(1))[0]
        self.base = rotations(twist(np.array([0.6, 0.64, 0.48]), np.array([900.0, 0.0, 500.0])), np.full(1, 2.0))[0]
        self.lines, self.home = lines, home @ tool

    def poses(self, postures: Array) -> Array:
        """(m, 4, 4) poses of the measured frame [mm]."""
        place = self.home
        for line, angles in zip(self.lines[::-1], postures.T[::-1], strict=True):
            place = rotations(line, angles) @ place
        return np.asarray(self.base @ place)
