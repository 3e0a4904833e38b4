"""Residuals with their sign against each joint, as the error of that joint that they mean, with the fitted curve.

A joint that turns by e too far moves the tip by e times its lever d tip / d q_j. The error that explains most of a
row's residual r is e = r . lever / |lever|^2; where the lever is short a row says little, and e is held small.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from doe.report.pictures import AFTER, BEFORE, LIMIT, MANY, TICKS
from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS
from identification.measurements import POINT
from identification.model import Model

SHORT = 0.3  # of the longest lever: below, a row counts less
STILL = 0.02  # of the reach: a joint with shorter levers says little
POINTS = 721  # of the fitted curve
FINE, SMOOTH = 1.0 / 1000.0, 1.0 / 12.0  # share of the range that it looks at: of an effect, of all that changed
NEARBY = 10  # rows that a point of the curve looks at, at most an eighth of all
SOME = 8  # postures that an effect at a joint is averaged over
SWEEPS = 5  # over the joints that have a curve
RIDGE, FAR = 0.1, 0.1  # in squared widths; share of the range without rows
SHOWN = 99.0  # [%] of the points that set the scale
Curve = tuple[Array, Array, Array]  # angles, error there, error at each row


def joint_errors(levers: Array, residuals: Array) -> Array:
    """(m, n) errors of each joint [rad, mm] that residuals (m, d) [mm] mean, by levers (m, d, n)."""
    squares = np.sum(levers**2, axis=1)
    clear = np.maximum(squares, SHORT**2 * squares.max(axis=0))
    along = np.einsum("mdn,md->mn", levers, residuals)
    return np.divide(along, clear, out=np.zeros_like(along), where=clear > 0.0)


def fitted_curve(q: Array, lever: Array, change: Array, narrowest: float = FINE) -> tuple[Array, Array]:
    """Angles, and the error of a joint there that the change (m, d) [mm] between two models means; NaN far from rows.

    Local linear least squares of the rows nearby, weighted by the squared lever.

    narrowest : share of the range that counts as nearby at least
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


def fitted_curves(
    postures: Array, levers: Array, change: Array, joints: Collection[int], model: Model | None = None
) -> dict[int, Curve]:
    """Joint (from 0) -> its curve, and what that means at each row (m,): of several joints together, each is fitted to
    what the others leave of the change.

    model : whose effects at a joint are drawn as they are, also between the rows; what else changed there is smooth
    """
    found = {j: (np.empty(0), np.empty(0), np.zeros(len(postures))) for j in joints}
    known = {j: np.zeros(POINTS) if model is None else joint_error(model, j, postures) for j in joints}
    for _ in range(SWEEPS if len(found) > 1 else 1):
        for j in found:
            q, lever = postures[:, j], levers[:, :, j]
            named = np.interp(q, dense(q), known[j])
            left = change - by_others(found, levers, j) - lever * named[:, None]
            grid, error = fitted_curve(q, lever, left, FINE if model is None else SMOOTH)
            error = error + known[j]
            found[j] = grid, error, np.interp(q, grid, np.nan_to_num(error))
    return found


def dense(q: Array) -> Array:
    """(POINTS,) angles over the range of (m,) others."""
    return np.linspace(q.min(), q.max(), POINTS)


def joint_error(model: Model, joint: int, postures: Array) -> Array:
    """What the effects at a joint (from 0) add to its angle, densely over its range in postures (m, n), in the mean of
    some of them."""
    own = {p.name for effect in model.effects if effect.joint == joint + 1 for p in effect.parameters}
    without = np.where([name in own for name in model.names], 0.0, model.values)
    some = postures[np.linspace(0, len(postures) - 1, min(len(postures), SOME)).astype(int)]
    angles, q = dense(postures[:, joint]), np.tile(some, (POINTS, 1))
    q[:, joint] = np.repeat(angles, len(some))
    lever = model.joint_levers(q)[:, POINT, joint]
    moved = np.nan_to_num(model.position(q) - model.position(q, without))[:, : lever.shape[1]]
    along, square = (np.sum(lever * a, axis=1).reshape(POINTS, -1).sum(axis=1) for a in (moved, lever))
    tables = [spec.curve.at(angles) for spec in model.arm.effects if spec.curve and spec.joint == joint + 1]
    return np.asarray(np.divide(along, square, out=np.zeros(POINTS), where=square > 0.0) + sum(tables))


def by_others(curves: Mapping[int, Curve], levers: Array, joint: int) -> Array:
    """(m, d) change [mm] due to the curves of all joints but one."""
    return np.sum([levers[:, :, k] * at[:, None] for k, (_, _, at) in curves.items() if k != joint], axis=0)


def kth_distances(q: Array, grid: Array, k: int) -> Array:
    """Distance from each point of a grid to the k-th nearest of q."""
    padded = np.concatenate([np.full(k, -np.inf), np.sort(q), np.full(k, np.inf)])
    first = np.searchsorted(np.sort(q), grid)
    window = padded[first[:, None] + np.arange(2 * k)]
    return np.asarray(np.sort(np.abs(window - grid[:, None]), axis=1)[:, k - 1])


@dataclass(frozen=True)
class Compared:
    """Residuals (m, d) [mm], measured less computed, of two models at postures (m, n), with their names.

    model : the later one, for the curves of its effects; None: these follow from the rows alone
    notes : joint (from 1) -> what was found there, and what the curves of the others explain is taken off before; if
        there are any, the other joints get no curve; if there are none, the curves are smooth
    """

    arm: Arm
    postures: Array
    before: Array
    after: Array
    conditions: Conditions | None = None
    names: tuple[str, str] = ("before", "after")
    notes: Mapping[int, str] = field(default_factory=dict)
    model: Model | None = None


def signed_figures(rows: Compared) -> list[Figure]:
    """A picture for each joint: its error by the residuals of both models, and the curve between the two."""
    model = Model(rows.arm)
    levers = model.joint_levers(rows.postures, conditions=rows.conditions)[:, POINT]
    before, after = (values[:, : levers.shape[1]] for values in (rows.before, rows.after))
    curves = fitted_curves(rows.postures, levers, before - after, [joint - 1 for joint in rows.notes], rows.model)
    figures = []
    for j, kind in enumerate(model.joint_types):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
        q, figure = rows.postures[:, j], Figure(figsize=(3.7, 2.5), layout="constrained")
        axes = figure.subplots()
        own = before - by_others(curves, levers, j)
        errors = [factor * joint_errors(levers, values)[:, j] for values in (own, after)]
        draw_errors(axes, factor * q, errors, rows.names)
        if j in curves or not curves:
            curve = curves[j][:2] if curves else fitted_curve(q, levers[:, :, j], before - after, SMOOTH)
            axes.plot(*(factor * line for line in curve), color="k", lw=1.3)
        axes.set(xlabel=f"joint {j + 1} [{unit}]", ylabel=f"error [{unit}]")
        still = np.linalg.norm(levers[:, :, j], axis=1).max() < STILL * rows.arm.reach
        axes.set_title(
            rows.notes.get(j + 1, "hardly moves the measured point" if still else ""), fontsize=9, parse_math=False
        )
        if j == 0:
            axes.plot([], [], color="k", lw=1.3, label="fitted")
            axes.legend(frameon=False, fontsize=8, ncols=3, handletextpad=0.3, columnspacing=1.0)
        figures.append(figure)
    return figures


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
