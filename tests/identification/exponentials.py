"""A six-axis arm as a product of exponentials: an independent simulator without frames of joints or corrections; and
postures at which it touches a surface or a cup: Newton steps on differences, all postures at once."""

from collections.abc import Callable

import numpy as np

from identification import Array
from identification.kinematics.chain import DHRow, KinematicChain, chain_of
from tests.identification.kinematics.test_spatial import twist

HALF = np.pi / 2.0
STEP = 1e-6  # [rad] of central differences
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


def about(axis: Array, point: Array) -> Array:
    """(4, 4) generator of a rotation about a line."""
    return twist(np.r_[-np.cross(axis, point), axis])


def rotations(line: Array, angles: Array) -> Array:
    """(m, 4, 4) exp(angle line): the generator T of a rotation has T^3 = -T, which sums the series."""
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(4) + sine * line + (1.0 - cosine) * (line @ line))


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
            lines.append(about(axis / np.linalg.norm(axis), home[:3, 3] + 0.5 * generator.standard_normal(3)))
            along, across = np.eye(4), np.eye(4)
            along[2, 3], across[0, 3] = d, a
            across[1:3, 1:3] = [[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]]
            home = home @ along @ across
        if tool is None:
            tool = rotations(about(np.array([0.48, 0.6, 0.64]), np.array([60.0, -40.0, 70.0])), np.ones(1))[0]
        self.base = rotations(about(np.array([0.6, 0.64, 0.48]), np.array([900.0, 0.0, 500.0])), np.full(1, 2.0))[0]
        self.lines, self.home = lines, home @ tool

    def poses(self, postures: Array) -> Array:
        """(m, 4, 4) poses of the measured frame [mm]."""
        place = self.home
        for line, angles in zip(self.lines[::-1], postures.T[::-1], strict=True):
            place = rotations(line, angles) @ place
        return np.asarray(self.base @ place)

    def points(self, postures: Array) -> Array:
        """(..., 3) origins of the measured frame in the frame of the base [mm]."""
        place = self.home[:, 3]
        for line, angles in zip(self.lines[::-1], np.moveaxis(postures, -1, 0)[::-1], strict=True):
            moved = place @ line.T  # as `rotations`, of one point
            place = place + np.sin(angles)[..., None] * moved + (1.0 - np.cos(angles))[..., None] * (moved @ line.T)
        return np.asarray(place[..., :3])


def led(q: Array, left: Callable[[Array], Array], steps: int, longest: float) -> Array:
    """(m, n) where damped Newton steps from postures lead; left : of (..., m, n), (..., m, k) that is to vanish [mm]"""
    moved = STEP * np.eye(q.shape[1])[:, None]
    for _ in range(steps):
        here, up, down = np.split(left(q + np.concatenate([0.0 * moved[:1], moved, -moved])), [1, 1 + q.shape[1]])
        slopes = np.moveaxis(up - down, 0, 2) / (2.0 * STEP)
        across = slopes @ np.swapaxes(slopes, 1, 2) + 1e-6 * np.eye(slopes.shape[1])
        moves = -np.einsum("mjn,mj->mn", slopes, np.linalg.solve(across, here[0][..., None])[..., 0])
        q = q + moves * np.minimum(1.0, longest / np.maximum(np.linalg.norm(moves, axis=1), 1e-12))[:, None]
    return q


def touching(truth: Exponentials, gap: Callable[[Array], Array], count: int, generator: np.random.Generator) -> Array:
    """(count, 6) postures whose points are on a surface: of random ones those that end within 150 degrees.

    gap : of points (..., 3) in the frame of the base [mm], zero on the surface
    """

    def left(q: Array) -> Array:
        return gap(truth.points(q))[..., None]

    q = led(generator.uniform(-2.0, 2.0, (3 * count, 6)), left, 50, 0.3)
    good = (np.abs(left(q)[:, 0]) < 1e-8) & (np.abs(q).max(axis=1) < 2.6)
    assert good.sum() >= count
    return q[good][:count]


def sphere(center: Array, radius: float) -> Callable[[Array], Array]:
    """How far points (..., 3) are outside of a sphere [mm]."""
    return lambda points: np.linalg.norm(points - center, axis=-1) - radius


def plane(normal: Array, height: float) -> Callable[[Array], Array]:
    """How high points (..., 3) are above a plane [mm]."""
    unit = normal / np.linalg.norm(normal)
    return lambda points: points @ unit - height


def seated(truth: Exponentials, centers: Array, noise: float, generator: np.random.Generator) -> Array:
    """(m, n) postures that bring the measured point to centers (m, 3) in the frame of the base [mm], but for the noise:
    of random ones the first that end within 160 degrees."""
    goals, n = centers + noise * generator.standard_normal(centers.shape), len(truth.lines)
    postures, todo = np.zeros((len(goals), n)), np.arange(len(goals))
    while len(todo):
        goal = goals[todo]
        q = led(generator.uniform(-2.2, 2.2, (len(todo), n)), lambda q, goal=goal: truth.points(q) - goal, 40, 0.4)  # type: ignore[misc]
        good = (np.linalg.norm(truth.points(q) - goal, axis=1) < 1e-7) & (np.abs(q).max(axis=1) < 2.8)
        postures[todo[good]], todo = q[good], todo[~good]
    return postures
