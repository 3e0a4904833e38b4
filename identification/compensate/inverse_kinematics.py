"""Inverse kinematics of the model: joint positions that reach targets, within joint limits and constraints.

Levenberg-Marquardt on exact derivatives, all targets at once; steps are the shortest that close the gap, so a redundant
arm stays near where it started. Where that ends short, or where no arm may stand, many other starts are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import Index, LeastSquares, Linearize, levenberg_marquardt
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.turns import turned_into
from identification.measurements import Conditions
from identification.model import Model
from identification.newton_ascent import newton_ascent
from identification.workspace import PostureCondition

TOLERANCE = 1e-6  # [mm] a target is reached if the model comes this close; so near may a constraint be missed
SEEDS = 32  # random postures per target where none is given, or where the nominal one leads nowhere
MAX_ITERATIONS = 60
QUICK = 20  # iterations at first: 99 of 100 seeds that reach a target have reached it, the others creep along limits,
# and for a target out of reach damped least squares often end 1 % too far
GLANCED, PROMISING = 256, 6  # random postures of a redundant arm, and how many of them are tried at first
MISSED = 1e3  # a rank from which a target is not reached, or constraints are missed
CHUNK = 1_000  # targets at a time, times SEEDS starts
STILL = 1e-9  # [rad] a joint that did not move has so much room
BEND = 1e-7  # [rad] of a joint, for second derivatives
TURNED_AWAY = 4  # of the seeds that reach a target where the arm may not stand, led out of there
INSIDE = 0.01  # [mm] how far inside its constraints such a posture is aimed at

Constraints = Sequence[PostureCondition]


def violations(constraints: Constraints, postures: Array) -> Array:
    """(m, c) by how much postures (m, n) miss each of c constraints [mm]; 0: satisfied."""
    if not constraints or not len(postures):
        return np.zeros((len(postures), len(constraints)))
    missed = np.column_stack([-np.min(each.margin(postures), axis=1) for each in constraints])
    return np.where(missed > TOLERANCE, missed, 0.0)


def reaching(model: Model, goals: Array, nominal: Array, conditions: Conditions, constraints: Constraints) -> Array:
    """(k, n) postures from nominal ones (k, n); from many seeds where that ends short of the target, or where the arm
    may not stand. Goals (k, d) [mm], of poses three more."""
    nominal = turned_into(nominal, model.arm.lower, model.arm.upper, model.joint_types)
    commands, errors = inverse_kinematics(model, goals, nominal, conditions)
    missed = violations(constraints, commands).sum(axis=1)
    short = np.flatnonzero((errors > TOLERANCE) | (missed > 0.0))
    if short.size:
        again, left = best_of_seeds(model, goals[short], nominal[short], conditions.rows(short), constraints)
        now = _rank(np.zeros(len(short)), left, violations(constraints, again).sum(axis=1))
        better = now < _rank(np.zeros(len(short)), errors[short], missed[short])
        commands[short[better]] = again[better]
    return commands


def _rank(distance: Array, left: Array, missed: Array) -> Array:
    """Of goals reached the distance; behind them what misses constraints, by how much; then what is left."""
    return np.where(left > TOLERANCE, 1e3 * MISSED + left, np.where(missed > 0.0, MISSED + missed, distance))


def best_of_seeds(
    model: Model, goals: Array, near: Array, conditions: Conditions, constraints: Constraints
) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: of the solutions that reach a goal the nearest to `near`, else the closest.

    At first a few steps are made, of a redundant arm from those seeds alone that promise to end near. Where no seed
    reaches the goal, the best of them go on by Newton's method; where those that reach it miss a constraint, they are
    led away with what is missed as further residuals.
    """
    arm, generator = model.arm, np.random.default_rng(0)  # the same postures for the same question
    seeds = generator.uniform(arm.lower, arm.upper, (GLANCED, arm.links))
    promising = _Promising(model, seeds) if conditions.orientation is None and arm.links > goals.shape[1] else None
    postures, errors = np.empty_like(near), np.empty(len(goals))
    for start in range(0, len(goals), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(goals)))
        every = np.broadcast_to(seeds[:SEEDS], (len(rows), SEEDS, arm.links))
        tried = every if promising is None else promising.near(goals[rows], near[rows])
        found, left, rank = _tried(model, goals, near, conditions, constraints, rows, tried, QUICK)
        postures[rows], errors[rows] = found[:, 0], left[:, 0]
        again = rank[:, 0] >= MISSED
        if not again.any():
            continue
        rows, found, left, rank = rows[again], found[again], left[again], rank[again]
        if constraints or promising is not None:
            most = MAX_ITERATIONS if constraints else QUICK
            found, left, rank = _tried(model, goals, near, conditions, constraints, rows, every[again], most)
        postures[rows], errors[rows] = found[:, 0], left[:, 0]
        beyond = left[:, 0] > TOLERANCE
        if (far := rows[beyond]).size:
            postures[far], errors[far] = _polished(model, goals[far], found[beyond], conditions.rows(far))
        missed = ~beyond & (rank[:, 0] >= MISSED)
        if constraints and missed.any() and arm.links > goals.shape[1]:  # a redundant arm has more than the seeds found
            there = rows[missed]
            away = _turned_away(model, goals[there], found[missed], conditions.rows(there), constraints)
            postures[there], errors[there] = away
    return postures, errors


def within_or_near(
    model: Model, familiar: tuple[Array, Array], goals: Array, conditions: Conditions, constraints: Constraints
) -> Array:
    """(k, n) postures for goals (k, d) nearest to the middle of familiar angles, and where possible within them; the
    best found where no posture gets there."""
    lower, upper = familiar
    near = np.tile((lower + upper) / 2.0, (len(goals), 1))
    found = best_of_seeds(model, goals, near, conditions, constraints)[0]
    out = np.flatnonzero(np.any((found < lower) | (found > upper), axis=1))
    if not out.size or np.any(lower >= upper):
        return found
    inside = Model(replace(model.arm, lower=lower, upper=upper))
    for starts in (np.clip(found, lower, upper), near):
        if not out.size:
            break
        postures, left = inverse_kinematics(inside, goals[out], starts[out], conditions.rows(out))
        better = (left <= TOLERANCE) & ~violations(constraints, postures).any(axis=1)
        found[out[better]] = postures[better]
        out = out[~better]
    return found


def near_or_within(
    model: Model, familiar: tuple[Array, Array], goals: Array, found: Array, where: Conditions, constraints: Constraints
) -> Array:
    """(k, n) postures that were found for goals (k, d); for those out of reach, where they are outside familiar angles,
    the nearest within them."""
    lower, upper = familiar
    left = np.linalg.norm(goals - model.position(found, conditions=where), axis=1)
    out = np.flatnonzero((left > TOLERANCE) & np.any((found < lower) | (found > upper), axis=1))
    if out.size:
        inside = Model(replace(model.arm, lower=lower, upper=np.maximum(upper, lower + STILL)))
        starts = np.clip(found[out], lower, upper)
        found[out] = best_of_seeds(inside, goals[out], starts, where.rows(out), constraints)[0]
    return found


def _tried(
    model: Model,
    goals: Array,
    near: Array,
    conditions: Conditions,
    constraints: Constraints,
    rows: Index,
    seeds: Array,
    iterations: int,
) -> tuple[Array, Array, Array]:
    """Best first, (k, s + 1, n) where some goals are reached from `near` and from seeds (k, s, n), what is left and
    the rank (k, s + 1);  rows : (k,) numbers of the goals"""
    starts = np.concatenate([near[rows, None], seeds], axis=1)
    every = np.repeat(rows, starts.shape[1])
    flat = starts.reshape(-1, starts.shape[2])
    flat, left = inverse_kinematics(model, goals[every], flat, conditions.rows(every), iterations)
    missed = violations(constraints, flat).sum(axis=1).reshape(starts.shape[:2])
    found, left = flat.reshape(starts.shape), left.reshape(starts.shape[:2])
    distance = np.linalg.norm((found - near[rows, None]) * _metric(model) / model.reach, axis=2)
    rank = _rank(distance, left, missed)
    order = np.argsort(rank, axis=1)
    left, rank = (np.take_along_axis(values, order, axis=1) for values in (left, rank))
    return np.take_along_axis(found, order[:, :, None], axis=1), left, rank


class _Promising:
    """Random postures of a redundant arm, and which of them lead near by a linear step, at once for many goals."""

    def __init__(self, model: Model, seeds: Array):
        """seeds : (s, n)"""
        self.model, self.seeds, self.scale = model, seeds, _metric(model) / model.reach
        self.positions, jacobians = _linearization(model, Conditions())(seeds, np.arange(len(seeds)))
        self.steps = np.linalg.pinv(jacobians / self.scale) / self.scale[:, None]  # (s, n, d) the shortest

    def near(self, goals: Array, near: Array) -> Array:
        """(k, `PROMISING`, n) of the seeds, whose linear steps to goals (k, d) end nearest to postures (k, n)."""
        steps = np.einsum("snd,ksd->ksn", self.steps, goals[:, None] - self.positions)
        ends = np.clip(self.seeds + steps, self.model.arm.lower, self.model.arm.upper)
        distances = np.linalg.norm((ends - near[:, None]) * self.scale, axis=2)
        return np.asarray(self.seeds[np.argsort(distances, axis=1, kind="stable")[:, :PROMISING]])


def _turned_away(
    model: Model, goals: Array, starts: Array, conditions: Conditions, constraints: Constraints
) -> tuple[Array, Array]:
    """(k, n) postures at goals (k, d) and what is left (k,): of those led from postures that miss constraints, starts
    (k, s, n), best first, to where they hold; the nearest to that where none gets there."""
    starts = starts[:, :TURNED_AWAY]
    every = np.repeat(np.arange(len(goals)), starts.shape[1])
    linearize, units = _linearization(model, conditions.rows(every)), model.reach / _metric(model)
    bends = np.concatenate([np.zeros((1, len(units))), np.diag(BEND * units)])

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        """Of the goal and, where a margin is missed, of a place inside; derivatives of margins by differences."""
        position, jacobian = linearize(postures, rows)
        bent = (postures[:, None] + bends).reshape(-1, len(units))
        margins = np.column_stack([each.margin(bent) for each in constraints]).reshape(len(postures), len(bends), -1)
        missed = np.maximum(INSIDE - margins[:, 0], 0.0)
        slopes = np.swapaxes(margins[:, 1:] - margins[:, :1], 1, 2) / (BEND * units)
        slopes[missed == 0.0] = 0.0
        gap = goals[every[rows]] - position
        return np.concatenate([gap, missed], axis=1), np.concatenate([jacobian, slopes], axis=1)

    limits, reach = (model.arm.lower, model.arm.upper), _metric(model)
    negligible = np.full(len(every), 1e-5 * TOLERANCE)
    problem = LeastSquares(distances, *limits, reach, negligible, metric=reach, iterations=MAX_ITERATIONS)
    ends = levenberg_marquardt(problem, starts.reshape(len(every), -1)).parameters
    ends, left = inverse_kinematics(model, goals[every], ends, conditions.rows(every))
    rank = _rank(np.zeros(len(every)), left, violations(constraints, ends).sum(axis=1)).reshape(len(goals), -1)
    best = np.ravel_multi_index((np.arange(len(goals)), np.argmin(rank, axis=1)), rank.shape)
    return ends[best], left[best]


def _polished(model: Model, goals: Array, starts: Array, conditions: Conditions) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: the closest to goals (k, d) out of reach, within the limits; starts (k, s, n),
    best first."""
    linearize, arm, units = _linearization(model, conditions), model.arm, model.reach / _metric(model)
    kinds = [_one_of_each_kind(ordered) for ordered in starts]
    goal = np.repeat(np.arange(len(kinds)), [len(kind) for kind in kinds])
    bends = np.concatenate([np.zeros((1, arm.links)), np.diag(BEND * units)])

    def height(q: Array, rows: Index) -> Array:
        gap = linearize(q, goal[rows])[0] - goals[goal[rows]]
        return -0.5 * np.sum(gap**2, axis=1)

    def slopes(q: Array, rows: Index) -> tuple[Array, Array]:
        bent = (q[:, None] + bends).reshape(-1, arm.links)
        position, jacobian = linearize(bent, np.repeat(goal[rows], len(bends)))
        gap = goals[goal[rows]] - position.reshape(len(q), len(bends), -1)[:, 0]
        jacobian = jacobian.reshape(len(q), len(bends), *jacobian.shape[1:])
        along = np.einsum("kd,kidn->kin", gap, jacobian)
        bend = (along[:, 1:] - along[:, :1]) / (BEND * units[:, None])
        return along[:, 0], 0.5 * (bend + np.swapaxes(bend, 1, 2)) - np.swapaxes(jacobian[:, 0], 1, 2) @ jacobian[:, 0]

    ends = newton_ascent(np.concatenate(kinds), height, slopes, (arm.lower, arm.upper), units)
    order = np.lexsort((-height(ends, np.arange(len(ends))), goal))
    best = order[np.unique(goal[order], return_index=True)[1]]
    return inverse_kinematics(model, goals, ends[best], conditions)  # where two postures meet Newton's method is slow


def _one_of_each_kind(ordered: Array) -> Array:
    """(k, n) of the postures (s, n), the first of those that are nearly the same."""
    return ordered[np.sort(np.unique(np.round(ordered, 1), axis=0, return_index=True)[1])]


def inverse_kinematics(
    model: Model, goals: Array, starts: Array, conditions: Conditions, iterations: int = MAX_ITERATIONS
) -> tuple[Array, Array]:
    """Postures (k, n) within the limits and errors (k,) [mm], by Levenberg-Marquardt from starts (k, n).

    Steps are the shortest in joint angles, so that a redundant arm stays near where it started.
    """
    linearize = _linearization(model, conditions)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        position, jacobian = linearize(postures, rows)
        return goals[rows] - position, jacobian

    reach = _metric(model)
    negligible = np.full(len(goals), 1e-5 * TOLERANCE)
    limits = model.arm.lower, model.arm.upper
    problem = LeastSquares(distances, *limits, reach, negligible, metric=reach, iterations=iterations)
    found = levenberg_marquardt(problem, starts)
    return found.parameters, np.sqrt(found.squares)


def _metric(model: Model) -> Array:
    """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
    return np.where(np.array(model.joint_types) == REVOLUTE, model.reach, 1.0)


def _linearization(model: Model, conditions: Conditions) -> Linearize:
    """Postures (k, n) and row numbers -> positions (k, d) and derivatives with respect to the posture (k, d, n)."""
    evaluate = model.expressions.posture_jacobian

    def linearize(postures: Array, rows: Index) -> tuple[Array, Array]:
        table = model.condition_table(postures, conditions.rows(rows))
        found, jacobian = evaluate(postures, table, np.broadcast_to(model.values, (len(postures), len(model.values))))
        return found[..., 0], jacobian

    return linearize
