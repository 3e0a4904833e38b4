"""Residuals with their sign against each joint, as the error of that joint that they mean, with the curve of the model.

A joint that turns by e too far moves the tip by e times its lever d tip / d q_j. The error that explains most of a
row's residual r is e = r . lever / |lever|^2; where the lever is short a row says little, and e is held small.

Where effects of the model turn a joint by a function of its angle, this function is the line, and the points before are
the residuals of the same model without these effects: partial residuals (W. A. Larsen, S. J. McCleary, "The use of
partial residual plots in regression analysis", Technometrics 1972), which scatter about the line as the points after
scatter about zero. A model fitted without the effects would bend lengths and zeros to make up for them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from doe.report.pictures import AFTER, BEFORE, LIMIT, MANY, TICKS
from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.effects import Effect
from identification.error_curve import all_hold
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS
from identification.measurements import POINT
from identification.model import Model

SHORT = 0.3  # of the longest lever: below, a row counts less
STILL = 0.02  # of the reach: a joint with shorter levers says little
POINTS = 721  # of a line
SMOOTH = 1.0 / 12.0  # share of the range that a point of a fitted line looks at, at least
NEARBY = 10  # rows that it looks at, at most an eighth of all
SOME = 8  # postures that an effect at a joint is averaged over
RIDGE, FAR = 0.1, 0.1  # in squared widths; share of the range without rows
SHOWN = 99.0  # [%] of the points that set the scale
OTHERWISE = 0.1  # of what an effect does, RMS, that its function of the angle may leave
READ = "Each dot is one row: the error of this joint that would best explain what is left (measured less computed)."


def joint_errors(levers: Array, residuals: Array) -> Array:
    """(m, n) errors of each joint [rad, mm] that residuals (m, d) [mm] mean, by levers (m, d, n)."""
    squares = np.sum(levers**2, axis=1)
    clear = np.maximum(squares, SHORT**2 * squares.max(axis=0))
    along = np.einsum("mdn,md->mn", levers, residuals)
    return np.divide(along, clear, out=np.zeros_like(along), where=clear > 0.0)


def fitted_curve(q: Array, lever: Array, change: Array, narrowest: float = SMOOTH) -> tuple[Array, Array]:
    """Angles, and the error of a joint there that the change (m, d) [mm] between two models means; NaN far from rows.

    Local linear least squares of the rows nearby, weighted by the squared lever.

    narrowest : share of the range that counts as nearby, at least
    """
    span, grid = float(np.ptp(q)) or 1.0, dense(q)
    distance = kth_distances(q, grid, int(np.clip(len(q) // 8, 3, NEARBY)))
    count, angle, weight, along = (
        np.bincount(np.searchsorted(grid, q), values, POINTS)  # rows between two points are taken together
        for values in (np.ones_like(q), q, np.sum(lever**2, axis=1), np.sum(lever * change, axis=1))
    )
    rows = count > 0.0
    away = (angle[rows] / count[rows] - grid[:, None]) / np.maximum(distance, narrowest * span)[:, None]
    near = np.exp(-0.5 * away**2)
    heavy, moved = near * weight[rows], near * along[rows]
    total, slope, square = (np.sum(heavy * away**k, axis=1) for k in range(3))
    square = square + RIDGE * total  # rows of one angle tell no slope
    value = square * moved.sum(axis=1) - slope * np.sum(moved * away, axis=1)
    scale = total * square - slope**2
    known = (kth_distances(q, grid, 1) < FAR * span) & (scale > 0.0)
    return grid, np.divide(value, scale, out=np.full(POINTS, np.nan), where=known)


def dense(q: Array) -> Array:
    """(POINTS,) angles over the range of (m,) others."""
    return np.linspace(q.min(), q.max(), POINTS)


def kth_distances(q: Array, grid: Array, k: int) -> Array:
    """Distance from each point of a grid to the k-th nearest of q."""
    padded = np.concatenate([np.full(k, -np.inf), np.sort(q), np.full(k, np.inf)])
    first = np.searchsorted(np.sort(q), grid)
    window = padded[first[:, None] + np.arange(2 * k)]
    return np.asarray(np.sort(np.abs(window - grid[:, None]), axis=1)[:, k - 1])


@dataclass(frozen=True)
class Compared:
    """Residuals (m, d) [mm], measured less computed, of two models at postures (m, n).

    model : the later one;  named : labels of its effects that the earlier one has not; where it has none of these, the
        line is what lies between the two models, smoothed
    """

    arm: Arm
    postures: Array
    before: Array
    after: Array
    conditions: Conditions | None = None
    model: Model | None = None
    named: Collection[str] = ()


@dataclass(frozen=True)
class Share:
    """What an effect adds at a joint: (POINTS,) errors densely over its range, NaN where it is off, and (m, d) what it
    does to the rows [mm]."""

    effect: Effect
    line: Array
    moved: Array

    def of_angle(self, q: Array, lever: Array) -> bool:
        """Whether it is a function of the angle alone, as far as the rows show: a backlash is none."""
        left = self.moved - lever * np.interp(q, dense(q), np.nan_to_num(self.line))[:, None]
        return bool(np.linalg.norm(left) <= OTHERWISE * np.linalg.norm(self.moved))


def joint_error(model: Model, effect: Effect, postures: Array) -> Array:
    """What an effect adds to the angle of its joint, densely over its range in postures (m, n), in the mean of some of
    them."""
    assert effect.joint is not None
    joint = effect.joint - 1
    angles = dense(postures[:, joint])
    if effect.curve is not None:
        return effect.curve.at(angles)
    some = postures[np.linspace(0, len(postures) - 1, min(len(postures), SOME)).astype(int)]
    q = np.tile(some, (POINTS, 1))
    q[:, joint] = np.repeat(angles, len(some))
    lever = model.joint_levers(q)[:, POINT, joint]
    moved = done_by(model, effect, q)[:, : lever.shape[1]]
    along, square = (np.sum(lever * a, axis=1).reshape(POINTS, -1).sum(axis=1) for a in (moved, lever))
    return np.asarray(np.divide(along, square, out=np.zeros(POINTS), where=square > 0.0))


def done_by(model: Model, effect: Effect, postures: Array, conditions: Conditions | None = None) -> Array:
    """(m, d) what an effect with parameters moves [mm]."""
    own = {p.name for p in effect.parameters}
    without = np.where([name in own for name in model.names], 0.0, model.values)
    position = (model.position(postures, values, conditions) for values in (None, without))
    return np.nan_to_num(np.subtract(*position))


def share_of(model: Model, effect: Effect, rows: Compared, lever: Array) -> Share:
    """A curve acts where all curves hold, and is drawn where there are such rows."""
    assert effect.joint is not None
    q, line = rows.postures[:, effect.joint - 1], joint_error(model, effect, rows.postures)
    if effect.curve is None:
        return Share(effect, line, done_by(model, effect, rows.postures, rows.conditions)[:, : lever.shape[1]])
    curves = [(e.joint - 1, e.curve) for e in model.effects if e.curve is not None and e.joint is not None]
    hold = all_hold(curves, rows.postures)
    grid = dense(q)
    near = kth_distances(q[hold > 0.5], grid, 1) < FAR * (float(np.ptp(q)) or 1.0)
    return Share(effect, np.where(near, line, np.nan), lever * (hold * effect.curve.at(q))[:, None])


def shown_shares(rows: Compared, joint: int, lever: Array) -> tuple[list[Share], bool]:
    """The named effects at a joint (from 0) that are functions of its angle, or else those that are not, and which of
    the two they are."""
    if rows.model is None:
        return [], True
    here = [effect for effect in rows.model.effects if effect.joint == joint + 1 and effect.label in rows.named]
    shares = [share_of(rows.model, effect, rows, lever) for effect in here]
    smooth = [s for s in shares if s.effect.curve is not None or s.of_angle(rows.postures[:, joint], lever)]
    return (smooth, True) if smooth else (shares, False)


def signed_figures(rows: Compared) -> list[Figure]:
    """A picture for each joint: its error by the residuals of both models, and the model's line between the two."""
    model = Model(rows.arm)
    levers = model.joint_levers(rows.postures, conditions=rows.conditions)[:, POINT]
    figures = []
    for j, kind in enumerate(model.joint_types):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes = figure.subplots()
        title = draw_joint(axes, rows, j, levers, factor)
        axes.set(xlabel=f"joint {j + 1} [{unit}]", ylabel=f"error [{unit}]")
        still = np.linalg.norm(levers[:, :, j], axis=1).max() < STILL * rows.arm.reach
        axes.set_title("hardly moves the measured point" if still else title, fontsize=9, parse_math=False)
        if j == 0:
            axes.plot([], [], color="k", lw=1.3, label="effects" if at_joints(rows.named) else "change")
            axes.legend(frameon=False, fontsize=8, ncols=3, handletextpad=0.3, columnspacing=1.0)
        figures.append(figure)
    return figures


def draw_joint(axes: Axes, rows: Compared, joint: int, levers: Array, factor: float) -> str:
    """Points and line of a joint (from 0), in units of 1 / factor; what stands above them."""
    q, lever = rows.postures[:, joint], levers[:, :, joint]
    shares, smooth = shown_shares(rows, joint, lever)
    before, after = (values[:, : levers.shape[1]] for values in (rows.before, rows.after))
    moved = sum((share.moved for share in shares), np.zeros_like(after))
    errors = [joint_errors(levers, values)[:, joint] for values in (after + moved if shares else before, after)]
    draw_errors(axes, factor * q, [factor * values for values in errors], ("before", "after"))
    if shares and not smooth:
        axes.plot(factor * q, factor * joint_errors(levers, moved)[:, joint], "k.", ms=3)
    elif shares or not at_joints(rows.named):
        line = np.sum([share.line for share in shares], axis=0) if shares else fitted_curve(q, lever, before - after)[1]
        axes.plot(factor * dense(q), factor * line, color="k", lw=1.3)
    off = [s.effect.label for s in shares if not s.moved.any()]
    return "\n".join(s.effect.label + (" (off here)" if s.effect.label in off else "") for s in shares)


def at_joints(named: Collection[str]) -> list[str]:
    """Of labels those of effects at a joint: `backlash:2`."""
    return [label for label in named if ":" in label]


def caption(before: str, after: str, named: Collection[str] = ()) -> str:
    """How the pictures are read; before, after : the models in words, a comma may follow."""
    if not at_joints(named):
        return f"{READ} Red: {before}. Blue: {after}. Line: the difference of the two, smoothed."
    return (
        f"{READ} Blue: {after}. Red: {before}; but where effects stand above a picture, the blue model without these. "
        "Line, or the smallest dots: what these effects add, as the model has them. A wave in the red dots that the "
        "line follows and the blue dots lack is explained."
    )


def draw_errors(axes: Axes, angles: Array, errors: Sequence[Array], names: Sequence[str]) -> None:
    """Points of two models; a few far ones do not set the scale."""
    few: dict[str, Any] = {"ms": 4, "alpha": 0.7}
    style = few if len(angles) <= MANY else {"ms": 1.5, "alpha": 0.25, "rasterized": True}
    axes.axhline(0.0, color=LIMIT, lw=0.8)
    for values, color, name in zip(errors, (BEFORE, AFTER), names, strict=True):
        axes.plot(angles, values, ".", color=color, **style)
        axes.plot([], [], ".", color=color, label=name)
    scale = 1.25 * max(float(np.percentile(np.abs(values), SHOWN)) for values in errors) or 1.0
    axes.set(ylim=(-scale, scale))
    axes.locator_params(axis="y", nbins=TICKS)
