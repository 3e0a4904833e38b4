"""Where the arm stands and where its tool is, from nothing: the start of a fit that needs no guess.

    y_i = B (p_i + R_i t) + b,    B, b: pose of the base for the instrument;  t: measured point in the tip's frame

Positions are a closed form (`placed`): for a given t the best base is a rigid registration of two clouds of points
(Kabsch 1976, Arun 1987), for a given base the best t a mean; taken in turns the sum of squares falls to a minimum.

Any other reading is searched (`searched`): least squares from many starts at once, by damped Gauss-Newton steps
(Levenberg 1944, Marquardt 1963); the start that ends with the least squares wins. Starts are random bases, or what the
instrument makes of each t: those of t lie around the tip.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.kinematics.frames import pose, turned

if TYPE_CHECKING:
    from identification.instruments.base import Instrument

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

    @property
    def tools(self) -> Array:
        """(s, 3) places [mm] from which the measured point is looked for: that known, or 7 around the tip."""
        if self.tool is not None:
            return self.tool[None]
        return np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * 0.1 * self.reach

    def points(self, tools: Array) -> Array:
        """(s, m, 3) measured points in the base for tools (s, 3)."""
        return self.frames[:, :3, 3] + np.tensordot(tools, self.frames[:, :3, :3], (1, 2))


class Starts(NamedTuple):
    """s starts: rotations (s, 3, 3), shifts (s, 3) of the base, tools (s, 3), own values (s, k) of the instrument."""

    rotations: Array
    shifts: Array
    tools: Array
    values: Array

    @classmethod
    def of(cls, rotations: Array, shifts: Array, tools: Array, values: Array) -> Starts:
        """Each for all starts, or one for each of s tools (s, 3)."""
        s = len(tools)
        widths = (rotations, (s, 3, 3)), (shifts, (s, 3)), (tools, (s, 3)), (values, (s, np.shape(values)[-1]))
        return cls(*(np.array(np.broadcast_to(part, shape)) for part, shape in widths))

    def best(self, squares: Array, count: int) -> Starts:
        """Those of the smallest sums of squares (s,)."""
        chosen = np.argsort(squares, kind="stable")[:count]
        return Starts(*(part[chosen] for part in self))

    def moved(self, change: Array) -> Starts:
        """After steps (s, 9 + k) of shift, rotation about the axes of the instrument, tool and values."""
        rotations = turned(change[:, 3:6]) @ self.rotations
        return Starts(rotations, self.shifts + change[:, :3], self.tools + change[:, 6:9], self.values + change[:, 9:])

    def choose(self, other: Starts, better: NDArray[np.bool_]) -> Starts:
        """The other ones where better (s,)."""
        pairs = zip(self, other, strict=True)
        return Starts(*(np.where(better.reshape(-1, *(1,) * (a.ndim - 1)), b, a) for a, b in pairs))


def random_starts(instrument: Instrument, rows: Unplaced) -> Starts:
    """Random bases, those of the tools in turns; of a base that is known one for each tool."""
    neutral = np.array([parameter.neutral for parameter in instrument.parameters])
    if rows.base is not None:
        return Starts.of(rows.base[:3, :3], rows.base[:3, 3], rows.tools, neutral)
    generator, count = np.random.default_rng(0), 3000  # effort
    vectors = generator.standard_normal((count, 4))
    angle = 2.0 * np.arctan2(np.linalg.norm(vectors[:, 1:], axis=1), vectors[:, 0])  # of a quaternion of any length
    axes = vectors[:, 1:] / np.linalg.norm(vectors[:, 1:], axis=1, keepdims=True)
    # bases are looked for within three times the reach
    shifts = 3.0 * rows.reach * generator.uniform(-1.0, 1.0, (count, 3))
    return Starts.of(turned(angle[:, None] * axes), shifts, np.resize(rows.tools, (count, 3)), neutral)


def searched(
    instrument: Instrument, rows: Unplaced, starts: Starts, of_base: slice = slice(0, 6), patience: int = 15
) -> Placement:
    """Base and measured point that explain readings best; arguments as of `followed`."""
    # effort: of many starts 100 are followed with rows that tell good ones, three times the nine unknowns and more; the
    # best 5 with all rows
    if len(starts.tools) > 100:
        spread = np.unique(np.linspace(0, len(rows.frames) - 1, 30).astype(int))
        few = rows._replace(frames=rows.frames[spread], readings=rows.readings[spread])
        starts = starts.best(_linear(instrument, starts, few.frames, few.readings)[0], 100)
        starts = Starts.best(*followed(instrument, few, starts, of_base, patience), 5)
    starts, squares = followed(instrument, rows, starts, of_base, patience)
    best = int(np.argmin(squares))
    base = pose(starts.shifts[best], starts.rotations[best]) if rows.base is None else rows.base
    return Placement(base, starts.tools[best], float(np.sqrt(squares[best] / len(rows.frames))))


def followed(
    instrument: Instrument,
    rows: Unplaced,
    starts: Starts,
    of_base: slice,
    patience: int,
    rounds: int = 60,
    hold: bool = False,
) -> tuple[Starts, Array]:
    """Where damped Gauss-Newton steps of starts end, and their sums of squares (s,).

    of_base : which of shift and rotation of the base are looked for, where it is not known
    patience : steps after which what is `Unplaced.hopeless` is given up;  rounds : steps of each start at most
    hold : whether own values of the instrument stay as they are
    """
    frames, readings, reach, base, tool, hopeless = rows
    k, wanted = starts.values.shape[1], len(frames) * hopeless**2
    scales = np.r_[np.full(3, reach), np.ones(3), np.full(3, 0.1 * reach), np.ones(k)]
    free = np.r_[np.zeros(6, dtype=bool), np.full(3, tool is None), np.full(k, not hold)]
    free[of_base] = base is None
    squares, gradient, matrix = _linear(instrument, starts, frames, readings, scales, free)
    damping = np.full(len(squares), 1e-3)  # what is added to a normal matrix, of its diagonal
    for done in range(rounds):
        diagonal = np.einsum("sii->si", matrix)
        floor = 1e-12 * np.max(diagonal, axis=1, keepdims=True, initial=0.0) + np.finfo(float).tiny
        added = np.eye(matrix.shape[-1]) * (damping[:, None] * np.maximum(diagonal, floor))[:, None]
        step, change = (
            np.linalg.solve(matrix + added, gradient[..., None])[..., 0],
            np.zeros((len(squares), len(scales))),
        )
        change[:, free] = step
        promised = np.einsum("sf,sf->s", gradient, step)  # fall of the sum of squares, half of it or more
        # of lengths 1e-12 reaches are rounding
        settled = np.all(promised <= ENOUGH * squares + len(frames) * (1e-12 * scales[0]) ** 2)
        moved = starts.moved(change * scales)
        new = _linear(instrument, moved, frames, readings, scales, free)
        better = new[0] < squares
        starts = starts.choose(moved, better)
        gradient, matrix = np.where(better[:, None], new[1], gradient), np.where(better[:, None, None], new[2], matrix)
        squares = np.where(better, new[0], squares)
        # so far that a step stands still, and is that of Gauss and Newton
        damping = np.clip(np.where(better, damping / 5.0, damping * 4.0), 1e-12, 1e12)
        # nothing is to be gained, or some steps have shown that it is hopeless
        if settled or (done >= patience and np.min(squares) > wanted):
            break
    return starts, squares


def _linear(
    instrument: Instrument,
    starts: Starts,
    frames: Array,
    readings: Array,
    scales: Array | None = None,
    free: Array | None = None,
) -> tuple[Array, ...]:
    """(s,) sums of squares, infinite where there is no reading; with scales the gradient (s, f) and the normal matrix
    (s, f, f), too, of the free unknowns, each divided by its scale."""
    rotations, shifts, tools, values = starts
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


# -- positions ---------------------------------------------------------------------------------------------------------
def registered(points: Array, measured: Array) -> Array:
    """(4, 4) pose that brings points (m, 3) closest to the measured ones (m, d) in least squares; in the plane, d = 2,
    it is a turn about z."""
    d = measured.shape[1]
    center, target = points[:, :d].mean(axis=0), measured.mean(axis=0)
    left, _, right = np.linalg.svd((measured - target).T @ (points[:, :d] - center))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))  # no mirror
    frame = np.eye(4)
    frame[:d, :d] = left @ right
    frame[:d, 3] = target - frame[:d, :d] @ center
    return frame


def placed(rows: Unplaced) -> Placement:
    """Base and tool that explain measured points best, whatever is `hopeless`."""
    frames, measured, _, base, tool, _ = rows
    if base is not None and tool is None:  # that explains the measured points best, each in the frame of its tip
        local = (measured - base[:3, 3]) @ base[:3, :3]  # in the base's frame
        tool = np.einsum("mji,mj->i", frames[:, :3, :3], local - frames[:, :3, 3]) / len(frames)
    tool = _tool(rows) if tool is None else tool
    points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
    base = registered(points, measured) if base is None else base
    left = measured - (points @ base[:3, :3].T + base[:3, 3])[:, : measured.shape[1]]
    return Placement(base, tool, float(np.sqrt(np.mean(np.sum(left**2, axis=1)))))


def _tool(rows: Unplaced) -> Array:
    """(3,) by turns from each start.

    All that a turn needs of the rows are means, of positions p and rotations R of the tip and measured points y, each
    less its mean: so a turn costs the same for any number of them.
    """
    p, turn, y = (a - a.mean(axis=0) for a in (rows.frames[:, :3, 3], rows.frames[:, :3, :3], rows.readings))
    m, tools = len(p), rows.tools
    points, turns = y.T @ p / m, np.einsum("mk,mij->kij", y, turn) / m  # of y p^T (3, 3), of y_k R (3, 3, 3)
    along, gram = np.einsum("mji,mj->i", turn, p) / m, np.einsum("mji,mjk->ik", turn, turn) / m  # of R^T p, of R^T R
    values, axes = np.linalg.eigh(gram)
    # what moves a point 1 mm from the flange's center by less than 0.01 mm (RMS) is lost in a drawing's errors
    inverse = (axes * np.divide(1.0, values, out=np.zeros(3), where=values > 0.01**2)) @ axes.T
    squared, before = float(np.sum(p**2 + y**2)) / m, np.full(len(tools), np.inf)
    for _ in range(200):  # effort: turns of each start
        left, _, right = np.linalg.svd(points + np.einsum("kij,sj->ski", turns, tools))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]  # no mirror
        rotations = left @ right  # (s, 3, 3) best ones of the base for the tools (Kabsch)
        crossed = np.einsum("ski,kij->sj", rotations, turns)
        tools = (crossed - along) @ inverse
        # (s,) mean squared distances left [mm^2]
        squares = 2.0 * tools @ along + np.einsum("si,ij,sj->s", tools, gram, tools)
        squares += squared - 2.0 * (np.einsum("ski,ki->s", rotations, points) + np.sum(crossed * tools, axis=1))
        if np.all(squares > before * (1.0 - ENOUGH)):
            break
        before = squares
    return np.asarray(tools[np.argmin(squares)])
