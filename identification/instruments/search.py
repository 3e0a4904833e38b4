"""Where the arm stands and where its tool is, from nothing: the start of a fit that needs no guess.

    y_i = B (p_i + R_i t) + b,    B, b: pose of the base for the instrument;  t: measured point in the tip's frame

Positions are a closed form (`placed`): for a given t the best base is a rigid registration of two clouds of points
(Kabsch 1976, Arun 1987), for a given base the best t a mean; taken in turns the sum of squares falls to a minimum.

Any other reading is searched (`searched`): least squares from many starts at once; the start that ends with the least
squares wins. Starts are random bases, or what the instrument makes of each t: those of t lie around the tip.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.kinematics.frames import Frame, from_angles, nearest_rotation, pose
from identification.kinematics.parameters import error_names
from identification.levenberg_marquardt import Index, levenberg_marquardt
from identification.vectorized import Evaluate, vectorize

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
        """(s, 3) places [mm] from which the measured point is looked for: that known, or 27 in a cube."""
        if self.tool is not None:
            return self.tool[None]
        return np.array(sorted(product((1.0, 0.0, -1.0), repeat=3), key=np.count_nonzero)) * 0.1 * self.reach

    @property
    def points(self) -> Array:
        """(s, m, 3) measured points in the base for these tools."""
        return self.frames[:, :3, 3] + np.tensordot(self.tools, self.frames[:, :3, :3], (1, 2))


def searched(instrument: Instrument, rows: Unplaced, bases: Array) -> Placement:
    """Base and measured point that explain readings best, of the base what they depend on.

    bases : (s, 4, 4) to start from, with the tools of the rows in turns; of a base that is known none is needed
    """
    if rows.base is not None:
        bases = np.broadcast_to(rows.base, (len(rows.tools), 4, 4))
    tools = np.resize(rows.tools, (len(bases), 3))
    starts = np.concatenate([bases[:, :3].reshape(-1, 12), tools], axis=1)
    hidden = instrument.hidden(np.eye(4)) if rows.base is None else error_names("base")
    free = np.array([name not in hidden for name in error_names("base")] + [rows.tool is None] * 3)
    unknown, moves = np.eye(9)[free], np.array([1.0, rows.reach, 1.0]).repeat(3)[free]
    evaluate, changes = reading_of(instrument), np.zeros((len(starts), len(unknown)))

    def followed(chosen: Index, part: slice, steps: int) -> Array:
        """(k,) root mean squares that part of the rows leave after at most so many steps from the starts of these
        numbers, of which `changes` keeps where they led."""
        frames, readings = rows.frames[part, :3].reshape(-1, 12), rows.readings[part]

        def linearize(change: Array, index: Index) -> tuple[Array, Array]:
            with np.errstate(all="ignore"):  # of places that no instrument reads
                read, slopes = evaluate(starts[chosen[index], None], frames, (change @ unknown)[:, None])
            residuals = (readings - read[..., 0]).reshape(len(index), -1)
            return residuals, (slopes @ unknown.T).reshape(*residuals.shape, -1)

        rounding = np.full(len(chosen), 1e-12 * rows.reach * np.sqrt(len(frames)))  # of lengths 1e-12 reaches
        solution = levenberg_marquardt(linearize, changes[chosen], scales=moves, rounding=rounding, iterations=steps)
        changes[chosen] = solution.parameters
        return np.sqrt(np.nan_to_num(solution.rss, nan=np.inf) / len(frames))

    # effort: of many starts 100 are followed with some 30 rows, which tell good ones: three times the nine unknowns and
    # more. Of starts that the readings were fitted with, the best of 99 of 100 wrong readings leaves after 2 steps at
    # most 1.3 times what its end leaves
    whole, sample = slice(None), slice(None, None, max(len(rows.frames) // 30, 1))
    stages = [(sample, 0, 100), (sample, 15, 5)] if len(starts) > 100 else []
    chosen = np.arange(len(starts))
    # of few rows, which mislead, every start is followed to its end
    for part, steps, count in (*stages, (whole, 2, max(5, 1000 // len(rows.frames))), (whole, 60, 1)):
        left = followed(chosen, part, steps)
        chosen = chosen[np.argsort(left, kind="stable")[:count]]
        if part is whole and np.min(left) > rows.hopeless:
            break
    start, change = starts[chosen[0]], changes[chosen[0]] @ unknown
    base = pose(start[3:12:4] + change[:3], from_angles(change[3:6]) @ start[:12].reshape(3, 4)[:, :3])
    return Placement(base, start[12:] + change[6:], float(np.min(left)))


@lru_cache(maxsize=32)
def reading_of(instrument: Instrument) -> Evaluate:
    """Of arrays (start, frame, change): the reading (d) and its derivative (d, 9) by the change.

    start : (15) base, by rows, and tool;  frame : (12) of the tip, by rows
    change : (9) of these: shift, angles about the axes of the instrument, and shift of the tool
    """
    start, tip, change = (ca.SX.sym(name, size) for name, size in (("start", 15), ("tip", 12), ("change", 9)))
    base, frame = (ca.reshape(each[:12], 4, 3).T for each in (start, tip))
    arm = ca.mtimes(base[:, :3], ca.mtimes(frame[:, :3], start[12:] + change[6:]) + frame[:, 3])
    turned = Frame.world().shifted(base[:, 3] + change[:3]).turned_about(range(3), change[3:6])
    point = turned.point(arm)[: len(instrument.axes)]
    values = ca.DM([parameter.neutral for parameter in instrument.parameters])
    reading = ca.densify(ca.SX(instrument.reading(point, ca.SX(values), ca.SX(0))))
    outputs = [reading, ca.densify(ca.jacobian(reading, change))]
    return vectorize(ca.Function("reading", [start, tip, change], ca.cse(outputs)))


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
        m, tools = len(p), rows.tools[:7]
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
