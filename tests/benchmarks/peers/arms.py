"""The arms that tools are compared on, and what their answers are worth: plain numpy, nothing of armcal or a peer."""

from dataclasses import dataclass

import numpy as np

# a [mm], alpha [deg], d [mm] of a UR10: the maker's table
TABLE = (
    *((0.0, 90.0, 127.3), (-612.0, 0.0, 0.0), (-572.3, 0.0, 0.0)),
    *((0.0, 90.0, 163.941), (0.0, -90.0, 115.7), (0.0, 0.0, 92.2)),
)
LEVER = 600.0  # [mm/rad] that makes angles comparable to lengths; a constant in every log det
BATCH = 20_000  # postures at once


class Designed:
    """An arm with joint limits [rad] whose plans are judged; `rows` is the (m, d, p) Jacobian of the measured
    coordinates with respect to `parameters` scaled parameters."""

    lower: np.ndarray
    upper: np.ndarray
    parameters: int

    def rows(self, q: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def information(self, q: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(p, p) of weighted postures."""
        total = np.zeros((self.parameters, self.parameters))
        for part in np.array_split(np.arange(len(q)), 1 + len(q) // BATCH):
            flat = (self.rows(q[part]) * np.sqrt(weights[part])[:, None, None]).reshape(-1, self.parameters)
            total += flat.T @ flat
        return total

    def log_det(self, q: np.ndarray, weights: np.ndarray | None = None) -> float:
        """Of the information per run, the postures moved into the limits; -inf where it is singular."""
        shares = np.full(len(q), 1.0 / len(q)) if weights is None else weights / weights.sum()
        sign, value = np.linalg.slogdet(self.information(np.clip(q, self.lower, self.upper), shares))
        return float(value) if sign > 0 else -np.inf

    def gap(self, q: np.ndarray, weights: np.ndarray) -> float:
        """max d - p over these candidates: log det is at most that much below the best (equivalence theorem)."""
        inverse = np.linalg.inv(self.information(q, weights / weights.sum()))
        parts = (self.rows(part) for part in np.array_split(q, 1 + len(q) // BATCH))
        return max(float(np.max(np.sum((rows @ inverse) * rows, axis=(1, 2)))) for rows in parts) - self.parameters

    def random(self, runs: int, generator: np.random.Generator) -> np.ndarray:
        """(runs, n) postures within the limits."""
        return generator.uniform(self.lower, self.upper, (runs, len(self.lower)))


@dataclass(frozen=True)
class Planar(Designed):
    """Links in a plane: length errors and orientation offsets, the latter scaled by the length."""

    lengths: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def parameters(self) -> int:  # type: ignore[override]
        return 2 * len(self.lengths)

    def rows(self, q: np.ndarray) -> np.ndarray:
        theta = np.cumsum(q, axis=1)
        cosine, sine = np.cos(theta), np.sin(theta)
        return np.stack([np.hstack([cosine, -sine]), np.hstack([sine, cosine])], axis=1)

    @property
    def bound(self) -> float:
        """Largest log det of any design within the limits (doe/README.md, "Planar theorem")."""
        half = np.minimum((self.upper - self.lower)[1:] / 2.0, np.pi / 2.0)
        return 4.0 * float(np.log(np.sin(half)).sum())

    def grid(self, levels: int) -> np.ndarray:
        """(levels^(n - 1), n) postures from limit to limit, joint 1 at zero: it cancels."""
        axes = [np.linspace(low, high, levels) for low, high in zip(self.lower[1:], self.upper[1:], strict=True)]
        return np.stack(np.meshgrid([0.0], *axes, indexing="ij"), axis=-1).reshape(-1, len(self.lengths))


@dataclass(frozen=True)
class Screws(Designed):
    """A chain of revolute joints as lines in space at q = 0: products of exponentials.

    axes, points : (n, 3) direction and a point [mm] of each joint's axis;  tip : (3,) the measured point [mm]
    """

    axes: np.ndarray
    points: np.ndarray
    tip: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def parameters(self) -> int:  # type: ignore[override]
        return 4 * len(self.axes) + 3

    def stages(self, q: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Rotations (m, 3, 3) of each joint, and the tip (m, 3) before each joint moved it and after the first."""
        turned = [rotations(axis, q[:, j]) for j, axis in enumerate(self.axes)]
        tips = [np.broadcast_to(self.tip, (len(q), 3))]
        for rotation, point in zip(reversed(turned), self.points[::-1], strict=True):
            tips.append(point + np.einsum("mab,mb->ma", rotation, tips[-1] - point))
        return turned, tips[::-1]

    def positions(self, q: np.ndarray) -> np.ndarray:
        """(m, 3) [mm]."""
        return self.stages(q)[1][0]

    def rows(self, q: np.ndarray) -> np.ndarray:
        """By two shifts and two turns of each axis across itself, and three shifts of the tip."""
        turned, tips = self.stages(q)
        before, columns = np.broadcast_to(np.eye(3), (len(q), 3, 3)), []
        for j, (rotation, axis, point) in enumerate(zip(turned, self.axes, self.points, strict=True)):
            across = np.linalg.svd(axis[None])[2][1:]
            shifts = [direction - rotation @ direction for direction in across]
            for direction in across:
                after = np.einsum("mab,mb->ma", rotation, np.cross(direction, tips[j + 1] - point))
                shifts.append((np.cross(direction, tips[j] - point) - after) / LEVER)
            columns += [np.einsum("mab,mb->ma", before, shift) for shift in shifts]
            before = before @ rotation
        return np.concatenate([np.stack(columns, axis=2), before], axis=2)


def rotations(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(m, 3, 3) about a unit vector by angles (m,) [rad] (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, rest = np.sin(angles)[:, None, None], 1.0 - np.cos(angles)[:, None, None]
    return np.eye(3) + sine * cross + rest * (cross @ cross)


def dh_matrix(a: float, alpha: float, d: float) -> np.ndarray:
    """(4, 4) of a standard Denavit-Hartenberg row at q = 0, alpha [deg]."""
    cosine, sine = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
    return np.array([[1.0, 0.0, 0.0, a], [0.0, cosine, -sine, 0.0], [0.0, sine, cosine, d], [0.0, 0.0, 0.0, 1.0]])


def ur10(tool: np.ndarray, base: np.ndarray | None = None) -> Screws:
    """The maker's UR10 with a reflector (3,) in the flange's frame and its base (4, 4) in the tracker's."""
    frames = [np.eye(4) if base is None else base]
    for row in TABLE:
        frames.append(frames[-1] @ dh_matrix(*row))
    joints, tip = np.array(frames[:-1]), frames[-1][:3, :3] @ tool + frames[-1][:3, 3]
    return Screws(joints[:, :3, 2], joints[:, :3, 3], tip, np.full(6, -np.pi), np.full(6, np.pi))


LENGTHS = np.array([260.0, 180.0, 120.0, 100.0, 90.0, 80.0])
FOUR = Planar(LENGTHS[:4], np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90]))
SIX = Planar(LENGTHS, np.radians([-180, -60, -130, -20, -90, -150]), np.radians([180, 95, -10, 110, 60, 5]))
AXES = ur10(np.array([60.0, 40.0, 100.0]))
ARMS: dict[str, Planar | Screws] = {"4 links": FOUR, "6 links": SIX, "6 axes": AXES}
