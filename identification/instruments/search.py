"""Where a fit starts that knows neither base nor measured point, for an instrument of which nothing else is known.

Least squares of readings from many random bases at once, by damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963):
the start that ends with the least squares wins.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.kinematics.frames import pose

ENOUGH = 1e-6  # relative fall of the sum of squares in a round, below which a least-squares fit goes on from here


class Placement(NamedTuple):
    """base : (4, 4) pose of the base [mm];  tool : (3,) place of the measured point [mm];  rms : what is left [mm]."""

    base: Array
    tool: Array
    rms: float


class Unplaced(NamedTuple):
    """Rows of which base and measured point are to be found.

    frames : (m, 4, 4) nominal poses of the tip in the base;  readings : (m, d) of one target
    reach : [mm] that gives the starts their size;  base, tool : (4, 4) and (3,), known; None: to be found
    hopeless : root mean square residual; where more must be left the search may end early, and say about how much
    """

    frames: Array
    readings: Array
    reach: float
    base: Array | None = None
    tool: Array | None = None
    hopeless: float = np.inf


class Reads(Protocol):
    """What is asked of an instrument here, see `Instrument`."""

    @property
    def neutral(self) -> Array: ...
    def linearized(self, points: Array, values: Array, session: Array) -> tuple[Array, Array, Array]: ...


class _Starts:
    """s starts: rotations (s, 3, 3), shifts (s, 3) of the base, tools (s, 3), own values (s, k) of the instrument."""

    def __init__(self, rotations: Array, shifts: Array, tools: Array, values: Array) -> None:
        self.parts = rotations, shifts, tools, values

    def best(self, squares: Array, count: int) -> _Starts:
        """Those of the smallest sums of squares (s,)."""
        chosen = np.argsort(squares, kind="stable")[:count]
        return _Starts(*(part[chosen] for part in self.parts))

    def moved(self, steps: Array, scales: Array, free: Array) -> _Starts:
        """After steps (s, f) of the free ones of shift, rotation about the axes of the instrument, tool and values."""
        rotations, shifts, tools, values = self.parts
        change = np.zeros((len(shifts), len(scales)))
        change[:, free] = steps
        change = change * scales
        turned = _rotations(change[:, 3:6]) @ rotations
        return _Starts(turned, shifts + change[:, :3], tools + change[:, 6:9], values + change[:, 9:])

    def choose(self, other: _Starts, better: NDArray[np.bool_]) -> _Starts:
        """The other ones where better (s,)."""
        pairs = zip(self.parts, other.parts, strict=True)
        return _Starts(*(np.where(better.reshape(-1, *(1,) * (a.ndim - 1)), b, a) for a, b in pairs))


def starts_of_tool(reach: float) -> Array:
    """(7, 3) places around the tip [mm] from which the measured point is looked for."""
    return np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * 0.1 * reach


def searched(instrument: Reads, rows: Unplaced) -> Placement:
    """Base and measured point that explain readings best."""
    frames, readings, reach, base, tool, hopeless = rows
    # effort: 3,000 random starts
    generator, count = np.random.default_rng(0), 3000 if base is None else len(starts_of_tool(reach))
    if base is None:
        vectors = generator.standard_normal((count, 4))
        angle = 2.0 * np.arctan2(np.linalg.norm(vectors[:, 1:], axis=1), vectors[:, 0])  # of a quaternion of any length
        axes = vectors[:, 1:] / np.linalg.norm(vectors[:, 1:], axis=1, keepdims=True)
        turns = _rotations(angle[:, None] * axes)
        # bases are looked for within three times the reach
        shifts = 3.0 * reach * generator.uniform(-1.0, 1.0, (count, 3))
    else:
        turns, shifts = np.tile(base[:3, :3], (count, 1, 1)), np.tile(base[:3, 3], (count, 1))
    tools = np.resize(starts_of_tool(reach), (count, 3)) if tool is None else np.tile(tool, (count, 1))
    starts = _Starts(turns, shifts, tools, np.tile(instrument.neutral, (count, 1)))
    k = starts.parts[3].shape[1]
    scales = np.r_[np.full(3, reach), np.ones(3), np.full(3, 0.1 * reach), np.ones(k)]
    # effort: rows that tell good starts, three times the nine unknowns and more; 100 of the starts are followed, the
    # best 5 with all rows
    free = np.r_[np.full(6, base is None), np.full(3, tool is None), np.ones(k, dtype=bool)]
    few = np.unique(np.linspace(0, len(frames) - 1, 30).astype(int))
    squares = _linear(instrument, starts, frames[few], readings[few])[0]
    starts = starts.best(squares, 100)
    wanted = len(few) * hopeless**2
    starts, squares = _followed(instrument, starts, frames[few], readings[few], scales, free, wanted)
    starts = starts.best(squares, 5)
    starts, squares = _followed(instrument, starts, frames, readings, scales, free, len(frames) * hopeless**2)
    best = int(np.argmin(squares))
    rotation, shift, place, _ = (part[best] for part in starts.parts)
    rms = float(np.sqrt(squares[best] / len(frames)))
    return Placement(pose(shift, rotation) if base is None else base, place, rms)


def _followed(
    instrument: Reads, starts: _Starts, frames: Array, readings: Array, scales: Array, free: Array, wanted: float
) -> tuple[_Starts, Array]:
    """Where damped Gauss-Newton steps of starts end, and their sums of squares (s,)."""
    squares, gradient, matrix = _linear(instrument, starts, frames, readings, scales, free)
    damping = np.full(len(squares), 1e-3)  # what is added to a normal matrix, of its diagonal
    for done in range(60):  # effort: steps of each start
        diagonal = np.einsum("sii->si", matrix)
        floor = 1e-12 * np.max(diagonal, axis=1, keepdims=True) + np.finfo(float).tiny
        added = np.eye(matrix.shape[-1]) * (damping[:, None] * np.maximum(diagonal, floor))[:, None]
        moved = starts.moved(np.linalg.solve(matrix + added, gradient[..., None])[..., 0], scales, free)
        new = _linear(instrument, moved, frames, readings, scales, free)
        better = new[0] < squares
        gained = bool(np.any(new[0] < squares * (1.0 - ENOUGH)))
        starts = starts.choose(moved, better)
        gradient, matrix = np.where(better[:, None], new[1], gradient), np.where(better[:, None, None], new[2], matrix)
        squares = np.where(better, new[0], squares)
        # so far that a step stands still, and is that of Gauss and Newton
        damping = np.clip(np.where(better, damping / 5.0, damping * 4.0), 1e-12, 1e12)
        # nothing is gained, or 15 steps have shown that it is hopeless
        if (not gained and np.all(damping > 1.0)) or (done >= 15 and np.min(squares) > wanted):
            break
    return starts, squares


def _linear(
    instrument: Reads,
    starts: _Starts,
    frames: Array,
    readings: Array,
    scales: Array | None = None,
    free: Array | None = None,
) -> tuple[Array, ...]:
    """(s,) sums of squares, infinite where there is no reading; with scales the gradient (s, f) and the normal matrix
    (s, f, f), too, of the free unknowns, each divided by its scale."""
    rotations, shifts, tools, values = starts.parts
    local = frames[:, :3, 3] + np.tensordot(tools, frames[:, :3, :3], (1, 2))  # (s, m, 3) in the frame of the base
    arms = local @ np.swapaxes(rotations, 1, 2)
    with np.errstate(all="ignore"):
        read, by_point, by_values = instrument.linearized(arms + shifts[:, None], values[:, None], np.zeros((1, 1, 1)))
        residual = readings - read
        squares = np.nan_to_num(np.sum(residual**2, axis=(1, 2)), nan=np.inf)
        if scales is None:
            return (squares,)
        by_turn = np.cross(arms[:, :, None], by_point)  # a row times d(w x a) / dw
        by_tool = by_point @ rotations[:, None] @ frames[:, :3, :3]
        columns = np.concatenate([by_point, by_turn, by_tool, by_values], axis=-1)[..., free] * scales[free]
        columns = np.where(np.isfinite(squares)[:, None, None, None], columns, 0.0)
        flat = columns.reshape(len(columns), -1, columns.shape[-1])
        left = np.where(np.isfinite(squares)[:, None, None], residual, 0.0).reshape(len(columns), -1, 1)
    across = np.swapaxes(flat, 1, 2)
    return squares, (across @ left)[..., 0], across @ flat


def _rotations(vectors: Array) -> Array:
    """(s, 3, 3) rotations by vectors (s, 3) [rad] (Rodrigues)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    half = np.sinc(angles / (2.0 * np.pi))
    return np.eye(3) + np.sinc(angles / np.pi) * cross + 0.5 * half**2 * cross @ cross
