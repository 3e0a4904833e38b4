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

from doe.report.figures import AFTER, BEFORE, LIMIT, MANY
from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.document import Pictures
from identification.effects import Effect
from identification.error_curve import all_hold
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS
from identification.measurements import POINT
from identification.model import Model

SHORT = 0.3  # of the longest lever: below, a row counts less
STILL = 0.02  # of the reach: a joint with shorter levers says little
POINTS = 721  # of a line
NEARBY = 10  # rows that a point of the line between two models is the mean of, at most an eighth of all
FAR = 0.1  # share of the range without rows over which no line is drawn
OTHERWISE = 0.1  # of what an effect does, RMS, that its function of the angle may leave
READ = "Each dot is one row: the error of this joint that would best explain what is left (measured less computed)."


@dataclass(frozen=True)
class Compared:
    """Residuals (m, d) [mm], measured less computed, of two models at postures (m, n).

    model : the later one;  named : labels of its effects that the earlier one has not; where it has none of these, the
        line is what lies between the two models, in groups of rows
    """

    arm: Arm
    postures: Array
    before: Array
    after: Array
    conditions: Conditions | None = None
    model: Model | None = None
    named: Collection[str] = ()

    def pictures(self, before: str, after: str) -> Pictures:
        """The pictures and how they are read; before, after : the models in words."""
        return Pictures(lambda: [caption(before, after, self.named), *signed_figures(self)])


def joint_errors(levers: Array, residuals: Array) -> Array:
    """(m, n) errors of each joint [rad, mm] that residuals (m, d) [mm] mean, by levers (m, d, n)."""
    squares = np.sum(levers**2, axis=1)
    clear = np.maximum(squares, SHORT**2 * squares.max(axis=0))
    along = np.einsum("mdn,md->mn", levers, residuals)
    return np.divide(along, clear, out=np.zeros_like(along), where=clear > 0.0)


def line_between(q: Array, lever: Array, change: Array) -> tuple[Array, Array]:
    """Angles, and the error of a joint there that the change (m, d) [mm] between two models means: of groups of rows by
    least squares; broken by NaN where no rows are."""
    size = int(np.clip(len(q) // 8, 3, NEARBY))
    groups = np.array_split(np.argsort(q, kind="stable"), max(1, len(q) // size))
    weight, along = np.sum(lever**2, axis=1), np.sum(lever * change, axis=1)
    angles = [float(np.mean(q[g])) for g in groups]
    errors = [float(along[g].sum() / weight[g].sum()) if weight[g].sum() > 0.0 else np.nan for g in groups]
    gaps = 1 + np.flatnonzero(np.diff(angles) > FAR * np.ptp(q))
    return np.insert(angles, gaps, np.nan), np.insert(errors, gaps, np.nan)


def dense(q: Array) -> Array:
    """(POINTS,) angles over the range of (m,) others."""
    return np.linspace(q.min(), q.max(), POINTS)


def joint_error(model: Model, effect: Effect, postures: Array) -> Array:
    """What an effect adds to the angle of its joint, densely over its range in postures (m, n), in the mean of eight of
    them."""
    assert effect.joint is not None
    joint = effect.joint - 1
    angles = dense(postures[:, joint])
    if effect.curve is not None:
        return effect.curve.at(angles)
    chosen = postures[np.linspace(0, len(postures) - 1, min(len(postures), 8)).astype(int)]
    q = np.tile(chosen, (POINTS, 1))
    q[:, joint] = np.repeat(angles, len(chosen))
    lever = model.joint_levers(q)[:, POINT, joint]
    moved = done_by(model, effect, q)[:, : lever.shape[1]]
    along, square = (np.sum(lever * a, axis=1).reshape(POINTS, -1).sum(axis=1) for a in (moved, lever))
    return np.asarray(np.divide(along, square, out=np.zeros(POINTS), where=square > 0.0))


def done_by(model: Model, effect: Effect, postures: Array, conditions: Conditions | None = None) -> Array:
    """(m, d) what an effect with parameters moves [mm]."""
    names = {p.name for p in effect.parameters}
    without = np.where([name in names for name in model.names], 0.0, model.values)
    position = (model.position(postures, values, conditions) for values in (None, without))
    return np.nan_to_num(np.subtract(*position))


def share_of(model: Model, effect: Effect, rows: Compared, lever: Array) -> tuple[Array, Array, bool]:
    """What an effect adds at its joint: (POINTS,) errors densely over the range, NaN where it is off; (m, d) what it
    does to the rows [mm]; whether it is a function of the angle alone, as far as the rows show: a backlash is none.

    A curve acts where all curves hold, and is drawn where there are such rows.
    """
    assert effect.joint is not None
    q, line = rows.postures[:, effect.joint - 1], joint_error(model, effect, rows.postures)
    grid = dense(q)
    if effect.curve is None:
        moved = done_by(model, effect, rows.postures, rows.conditions)[:, : lever.shape[1]]
        left = moved - lever * np.interp(q, grid, line)[:, None]
        return line, moved, bool(np.linalg.norm(left) <= OTHERWISE * np.linalg.norm(moved))
    curves = [(e.joint - 1, e.curve) for e in model.effects if e.curve is not None and e.joint is not None]
    hold = all_hold(curves, rows.postures)
    places = np.concatenate([[-np.inf], np.sort(q[hold > 0.5]), [np.inf]])
    after = np.searchsorted(places, grid)
    near = np.minimum(grid - places[after - 1], places[after] - grid) < FAR * (float(np.ptp(q)) or 1.0)
    return np.where(near, line, np.nan), lever * (hold * effect.curve.at(q))[:, None], True


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
    """Points and line of a joint (from 0), in units of 1 / factor; what stands above them.

    Shown are the named effects that are functions of the joint's angle, as lines, or else those that are not, at rows.
    """
    q, lever = rows.postures[:, joint], levers[:, :, joint]
    model, named = rows.model, set(rows.named)
    effects = [] if model is None else [e for e in model.effects if e.joint == joint + 1 and e.label in named]
    shares = {e.label: share_of(model, e, rows, lever) for e in effects if model}
    smooth = {label: share for label, share in shares.items() if share[2]}
    shares = smooth or shares
    before, after = (values[:, : levers.shape[1]] for values in (rows.before, rows.after))
    moved = sum((share[1] for share in shares.values()), np.zeros_like(after))
    errors = [joint_errors(levers, values)[:, joint] for values in (after + moved if shares else before, after)]
    draw_errors(axes, factor * q, [factor * values for values in errors], ("before", "after"))
    if shares and not smooth:
        axes.plot(factor * q, factor * joint_errors(levers, moved)[:, joint], "k.", ms=3)
    elif shares:
        line = np.sum([share[0] for share in shares.values()], axis=0)
        axes.plot(factor * dense(q), factor * line, color="k", lw=1.3)
    elif not at_joints(rows.named):
        axes.plot(*(factor * values for values in line_between(q, lever, before - after)), color="k", lw=1.3)
    return "\n".join(label + ("" if share[1].any() else " (off here)") for label, share in shares.items())


def at_joints(named: Collection[str]) -> list[str]:
    """Of labels those of effects at a joint: `backlash:2`."""
    return [label for label in named if ":" in label]


def caption(before: str, after: str, named: Collection[str] = ()) -> str:
    """How the pictures are read; before, after : the models in words, a comma may follow."""
    if not at_joints(named):
        return f"{READ} Red: {before}. Blue: {after}. Line: the difference of the two, in groups of rows."
    return (
        f"{READ} Blue: {after}. Red: {before}; but where effects stand above a picture, the blue model without these. "
        "Line, or the smallest dots: what these effects add, as the model has them. A wave in the red dots that the "
        "line follows and the blue dots lack is explained."
    )


def draw_errors(axes: Axes, angles: Array, errors: Sequence[Array], names: Sequence[str]) -> None:
    """Points of two models; the one in a hundred that is farthest does not set the scale."""
    few: dict[str, Any] = {"ms": 4, "alpha": 0.7}
    style = few if len(angles) <= MANY else {"ms": 1.5, "alpha": 0.25, "rasterized": True}
    axes.axhline(0.0, color=LIMIT, lw=0.8)
    for values, color, name in zip(errors, (BEFORE, AFTER), names, strict=True):
        axes.plot(angles, values, ".", color=color, **style)
        axes.plot([], [], ".", color=color, label=name)
    scale = 1.25 * max(float(np.percentile(np.abs(values), 99.0)) for values in errors) or 1.0
    axes.set(ylim=(-scale, scale))
    axes.locator_params(axis="y", nbins=6)
