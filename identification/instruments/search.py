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

from identification.arrays import Array
from identification.kinematics.frames import from_quaternions, nearest_rotation, pose, turned
from identification.kinematics.parameters import error_names

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
        parts = (rotations, (3, 3)), (shifts, (3,)), (tools, (3,)), (values, np.shape(values)[-1:])
        return cls(*(np.array(np.broadcast_to(part, (len(tools), *shape))) for part, shape in parts))

    def best(self, squares: Array, count: int) -> Starts:
        """Those of the smallest sums of squares (s,)."""
        chosen = np.argsort(squares, kind="stable")[:count]
        return Starts(*(part[chosen] for part in self))

    def moved(self, change: Array) -> Starts:
        """After steps (s, 9 + k) of shift, rotation about the axes of the instrument, tool and values."""
        rotations = turned(change[:, 3:6]) @ self.rotations
        return Starts(rotations, self.shifts + change[:, :3], self.tools + change[:, 6:9], self.values + change[:, 9:])


def random_starts(instrument: Instrument, rows: Unplaced) -> Starts:
    """Random bases, those of the tools in turns; of a base that is known one for each tool."""
    neutral = np.array([parameter.neutral for parameter in instrument.parameters])
    if rows.base is not None:
        return Starts.of(rows.base[:3, :3], rows.base[:3, 3], rows.tools, neutral)
    generator, count = np.random.default_rng(0), 3000  # effort
    rotations = from_quaternions(generator.standard_normal((count, 4)))
    # bases are looked for within three times the reach
    shifts = 3.0 * rows.reach * generator.uniform(-1.0, 1.0, (count, 3))
    return Starts.of(rotations, shifts, np.resize(rows.tools, (count, 3)), neutral)


def searched(instrument: Instrument, rows: Unplaced, starts: Starts) -> Placement:
    """Base and measured point that explain readings best, of the base what they depend on."""
    # effort: of starts that the readings were fitted with, the best of 99 of 100 wrong readings leaves after 3 steps at
    # most 1.5 times what its end leaves; of random ones later
    patience = 3 if len(starts.tools) <= 100 else 15
    # effort: of many starts 100 are followed with rows that tell good ones, three times the nine unknowns and more; the
    # best 5 with all rows
    if len(starts.tools) > 100:
        spread = np.unique(np.linspace(0, len(rows.frames) - 1, 30).astype(int))
        few = rows._replace(frames=rows.frames[spread], readings=rows.readings[spread])
        starts = starts.best(_linear(instrument, starts, few)[0], 100)
        starts = Starts.best(*followed(instrument, few, starts, patience), 5)
    starts, squares = followed(instrument, rows, starts, patience)
    best = int(np.argmin(squares))
    base = pose(starts.shifts[best], starts.rotations[best]) if rows.base is None else rows.base
    return Placement(base, starts.tools[best], float(np.sqrt(squares[best] / len(rows.frames))))


def followed(instrument: Instrument, rows: Unplaced, starts: Starts, patience: int) -> tuple[Starts, Array]:
    """Where damped Gauss-Newton steps of starts end, and their sums of squares (s,).

    patience : steps after which what is `Unplaced.hopeless` is given up
    """
    k, m = starts.values.shape[1], len(rows.frames)
    scales = np.r_[np.full(3, rows.reach), np.ones(3), np.full(3, 0.1 * rows.reach), np.ones(k)]
    shown = [name not in instrument.hidden(np.eye(4)) for name in error_names("base")]
    free = np.r_[np.array(shown) & (rows.base is None), np.full(3, rows.tool is None), np.ones(k, dtype=bool)]
    columns = np.diag(scales)[free]  # of the free unknowns, each divided by its scale
    squares, gradient, matrix = _linear(instrument, starts, rows, columns)
    damping = np.full(len(squares), 1e-3)  # what is added to a normal matrix, of its diagonal
    for done in range(60):  # effort
        diagonal = np.einsum("sii->si", matrix)
        floor = 1e-12 * np.max(diagonal, axis=1, keepdims=True, initial=0.0) + np.finfo(float).tiny
        added = np.eye(matrix.shape[-1]) * (damping[:, None] * np.maximum(diagonal, floor))[:, None]
        step = np.linalg.solve(matrix + added, gradient[..., None])[..., 0]
        promised = np.einsum("sf,sf->s", gradient, step)  # fall of the sum of squares, half of it or more
        # of lengths 1e-12 reaches are rounding
        settled = np.all(promised <= ENOUGH * squares + m * (1e-12 * rows.reach) ** 2)
        moved = starts.moved(step @ columns)
        new = _linear(instrument, moved, rows, columns)
        better = new[0] < squares
        old = *starts, squares, gradient, matrix
        chosen = (
            np.where(better.reshape(-1, *(1,) * (a.ndim - 1)), b, a) for a, b in zip(old, (*moved, *new), strict=True)
        )
        *parts, squares, gradient, matrix = chosen
        starts = Starts(*parts)
        # so far that a step stands still, and is that of Gauss and Newton
        damping = np.clip(np.where(better, damping / 5.0, damping * 4.0), 1e-12, 1e12)
        # nothing is to be gained, or some steps have shown that it is hopeless
        if settled or (done >= patience and np.min(squares) > m * rows.hopeless**2):
            break
    return starts, squares


def _linear(instrument: Instrument, starts: Starts, rows: Unplaced, columns: Array | None = None) -> tuple[Array, ...]:
    """(s,) sums of squares, infinite where there is no reading; with columns (f, 9 + k), directions in the unknowns,
    the gradient (s, f) and the normal matrix (s, f, f) in these, too."""
    rotations, shifts, tools, values = starts
    arms = rows.points(tools) @ np.swapaxes(rotations, 1, 2)  # (s, m, 3) in the frame of the base
    with np.errstate(all="ignore"):
        read, by_point, by_values = instrument.linearized(arms + shifts[:, None], values[:, None], np.zeros((1, 1, 1)))
        left = rows.readings - read
        squares = np.nan_to_num(np.sum(left**2, axis=(1, 2)), nan=np.inf)
        if columns is None:
            return (squares,)
        by_turn = np.cross(arms[:, :, None], by_point)  # a row times d(w x a) / dw
        by_tool = by_point @ rotations[:, None] @ rows.frames[:, :3, :3]
        slopes = np.concatenate([by_point, by_turn, by_tool, by_values], axis=-1)
        seen = np.isfinite(squares)[:, None, None]
        slopes = np.where(seen, slopes.reshape(len(left), -1, slopes.shape[-1]) @ columns.T, 0.0)
        left = np.where(seen, left.reshape(len(left), -1, 1), 0.0)
    across = np.swapaxes(slopes, 1, 2)
    return squares, (across @ left)[..., 0], across @ slopes


# -- positions ---------------------------------------------------------------------------------------------------------
def registered(points: Array, measured: Array) -> Array:
    """(4, 4) pose that brings points (m, 3) closest to the measured ones (m, d) in least squares; in the plane, d = 2,
    it is a turn about z."""
    d = measured.shape[1]
    center, target = points[:, :d].mean(axis=0), measured.mean(axis=0)
    frame = np.eye(4)
    frame[:d, :d] = nearest_rotation((measured - target).T @ (points[:, :d] - center))
    frame[:d, 3] = target - frame[:d, :d] @ center
    return frame


def placed(rows: Unplaced) -> Placement:
    """Base and tool that explain measured points best, whatever is `hopeless`; both by turns from each start.

    All that a turn needs of the rows are means, of positions p and rotations R of the tip and measured points y, each
    less its mean: so a turn costs the same for any number of them.
    """
    frames, measured, _, base, tool, _ = rows
    if tool is None and base is not None:  # that explains the measured points best, each in the frame of its tip
        local = (measured - base[:3, 3]) @ base[:3, :3]  # in the base's frame
        tool = np.einsum("mji,mj->i", frames[:, :3, :3], local - frames[:, :3, 3]) / len(frames)
    elif tool is None:
        p, turn, y = (a - a.mean(axis=0) for a in (frames[:, :3, 3], frames[:, :3, :3], measured))
        m, tools = len(p), rows.tools
        points, turns = y.T @ p / m, np.einsum("mk,mij->kij", y, turn) / m  # of y p^T (3, 3), of y_k R (3, 3, 3)
        # of R^T p, of R^T R
        along, gram = np.einsum("mji,mj->i", turn, p) / m, np.einsum("mji,mjk->ik", turn, turn) / m
        values, axes = np.linalg.eigh(gram)
        # what moves a point 1 mm from the flange's center by less than 0.01 mm (RMS) is lost in a drawing's errors
        inverse = (axes * np.divide(1.0, values, out=np.zeros(3), where=values > 0.01**2)) @ axes.T
        squared, before = float(np.sum(p**2 + y**2)) / m, np.full(len(tools), np.inf)
        for _ in range(200):  # effort: turns of each start
            rotations = nearest_rotation(points + np.einsum("kij,sj->ski", turns, tools))  # (s, 3, 3) of the base
            crossed = np.einsum("ski,kij->sj", rotations, turns)
            tools = (crossed - along) @ inverse
            # (s,) mean squared distances left [mm^2]
            squares = 2.0 * tools @ along + np.einsum("si,ij,sj->s", tools, gram, tools)
            squares += squared - 2.0 * (np.einsum("ski,ki->s", rotations, points) + np.sum(crossed * tools, axis=1))
            if np.all(squares > before * (1.0 - ENOUGH)):
                break
            before = squares
        tool = tools[np.argmin(squares)]
    points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
    base = registered(points, measured) if base is None else base
    left = measured - (points @ base[:3, :3].T + base[:3, 3])[:, : measured.shape[1]]
    return Placement(base, tool, float(np.sqrt(np.mean(np.sum(left**2, axis=1)))))
