"""Inverse kinematics of the model: joint positions that reach targets, within joint limits.

Levenberg-Marquardt on exact derivatives, all targets at once; steps are the shortest that close the gap, so a redundant
arm stays near where it started. Where one start does not reach a target, or no arm may stand with what it reaches,
there are many more (`best_of_seeds`): at first a few steps are made from each. Where no start reaches a target the best
go on by Newton's method; where those that reach it miss a constraint, they are led away from what is in the way, unless
that is the target itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import Index, LeastSquares, Linearize, levenberg_marquardt
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import Conditions
from identification.model import Model
from identification.newton_ascent import newton_ascent
from identification.workspace import PostureCondition

TOLERANCE = 1e-6  # [mm] a target is reached if the model comes this close; so near may a constraint be missed
MAX_ITERATIONS = 60
SEEDS = 32  # random postures per target where none is given, or where the nominal one leads nowhere
QUICK = 20  # iterations at first: 99 of 100 seeds that reach a target have reached it, the others creep along limits,
# and for a target out of reach damped least squares often end 1 % too far
MISSED = 1e3  # a rank from which a target is not reached, or constraints are missed
CHUNK = 1_000  # targets at a time, times SEEDS starts
BEND = 1e-7  # [rad] of a joint, for second derivatives
WITNESSES = 6  # postures at a target that must agree before it counts as barred, and seeds that are tried for them
SAME = 0.01  # of what is missed: margins that differ by less are those of the target, whatever the posture

Constraints = Sequence[PostureCondition]


def violations(constraints: Constraints, postures: Array) -> Array:
    """(m, c) by how much postures (m, n) miss each of c constraints [mm]; 0: satisfied."""
    if not constraints or not len(postures):
        return np.zeros((len(postures), len(constraints)))
    missed = np.column_stack([-np.min(each.margin(postures), axis=1) for each in constraints])
    return np.where(missed > TOLERANCE, missed, 0.0)


def inverse_kinematics(
    model: Model, goals: Array, starts: Array, conditions: Conditions, iterations: int = MAX_ITERATIONS
) -> tuple[Array, Array]:
    """Postures (k, n) within the limits and errors (k,) [mm], by Levenberg-Marquardt from starts (k, n).

    Steps are the shortest in joint angles, so that a redundant arm stays near where it started.
    """
    linearize = linearization(model, conditions)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        position, jacobian = linearize(postures, rows)
        return goals[rows] - position, jacobian

    return _least(model, distances, starts, iterations)


def _least(model: Model, linearize: Linearize, starts: Array, iterations: int) -> tuple[Array, Array]:
    """(k, n) postures within the limits that make residuals least, from starts (k, n), and what they leave (k,)."""
    limits, reach, negligible = (
        (model.arm.lower, model.arm.upper),
        metric(model),
        np.full(len(starts), 1e-5 * TOLERANCE),
    )
    problem = LeastSquares(linearize, *limits, reach, negligible, metric=reach, iterations=iterations)
    solution = levenberg_marquardt(problem, starts)
    return solution.parameters, np.sqrt(solution.squares)


def metric(model: Model) -> Array:
    """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
    return np.where(np.array(model.joint_types) == REVOLUTE, model.reach, 1.0)


def linearization(model: Model, conditions: Conditions) -> Linearize:
    """Postures (k, n) and row numbers -> positions (k, d) and derivatives with respect to the posture (k, d, n)."""
    evaluate = model.expressions.posture_jacobian

    def linearize(postures: Array, rows: Index) -> tuple[Array, Array]:
        table = model.condition_table(postures, conditions.rows(rows))
        tips, jacobian = evaluate(postures, table, np.broadcast_to(model.values, (len(postures), len(model.values))))
        return tips[..., 0], jacobian

    return linearize


class Tried(NamedTuple):
    """What searches for k goals found, best first: (k, s, n) postures, what they leave [mm] and their rank (k, s)."""

    postures: Array
    left: Array
    rank: Array

    def at(self, rows: Index | NDArray[np.bool_]) -> Tried:
        """Of some of the goals."""
        return Tried._make(values[rows] for values in self)


def ranked(distance: Array, left: Array, missed: Array) -> Array:
    """Of goals reached the distance; behind them what misses constraints, by how much; then what is left."""
    return np.where(left > TOLERANCE, 1e3 * MISSED + left, np.where(missed > 0.0, MISSED + missed, distance))


def best_of_seeds(
    model: Model, goals: Array, near: Array, conditions: Conditions, constraints: Constraints
) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: of the solutions that reach a goal the nearest to `near`, else the closest.

    At first a few steps are made, of a redundant arm from those seeds alone that promise to end near. What fails waits
    for others: a search of few takes nearly as long as one of many.
    """
    arm, generator = model.arm, np.random.default_rng(0)  # the same postures for the same question
    # effort: random postures of a redundant arm, of which the nearest six are tried at first
    seeds = generator.uniform(arm.lower, arm.upper, (256, arm.links))
    redundant = conditions.orientation is None and arm.links > goals.shape[1]
    promising = _promising(model, seeds) if redundant else None
    search = _Search(model, goals, near, conditions, constraints, seeds[:SEEDS], redundant)
    postures, errors, failed = np.empty_like(near), np.empty(len(goals)), list[tuple[Index, Tried]]()
    for rows in _parts(np.arange(len(goals))):
        tried = search.tried(rows, None if promising is None else promising(goals[rows], near[rows]))
        postures[rows], errors[rows] = tried.postures[:, 0], tried.left[:, 0]
        fails = tried.rank[:, 0] >= MISSED
        failed.append((rows[fails], tried.at(fails)))
    if failed:
        rest = np.concatenate([rows for rows, _ in failed])
        first = Tried._make(np.concatenate(each) for each in zip(*(tried for _, tried in failed), strict=True))
        for part in _parts(np.arange(len(rest))):
            if constraints:
                part = part[~search.barred(rest[part], first.at(part))]
            if len(part):
                postures[rest[part]], errors[rest[part]] = search.led_on(rest[part], first.at(part))
    if not redundant:
        search._replace(seeds=seeds[SEEDS:]).again(postures, errors)
    return postures, errors


def _parts(rows: Index, size: int = CHUNK) -> list[Index]:
    """So many at a time; none of no rows."""
    return [rows[start : start + size] for start in range(0, len(rows), size)]


class _Search(NamedTuple):
    """Goals (k, d) of a model, the postures (k, n) that theirs are to be near, and seeds (s, n)."""

    model: Model
    goals: Array
    near: Array
    conditions: Conditions
    constraints: Constraints
    seeds: Array
    redundant: bool  # the arm has more joints than a goal needs, and any orientation will do

    def tried(self, rows: Index, seeds: Array | None = None, iterations: int = QUICK) -> Tried:
        """Of some goals, from `near` and from seeds (k, s, n) of their own; None: the common ones."""
        seeds = np.broadcast_to(self.seeds, (len(rows), *self.seeds.shape)) if seeds is None else seeds
        starts = np.concatenate([self.near[rows, None], seeds], axis=1)
        every, flat = np.repeat(rows, starts.shape[1]), starts.reshape(-1, starts.shape[2])
        flat, left = inverse_kinematics(self.model, self.goals[every], flat, self.conditions.rows(every), iterations)
        missed = violations(self.constraints, flat).sum(axis=1).reshape(starts.shape[:2])
        reached, left = flat.reshape(starts.shape), left.reshape(starts.shape[:2])
        distance = np.linalg.norm((reached - self.near[rows, None]) * metric(self.model) / self.model.reach, axis=2)
        rank = ranked(distance, left, missed)
        order = np.argsort(rank, axis=1)
        left, rank = (np.take_along_axis(values, order, axis=1) for values in (left, rank))
        return Tried(np.take_along_axis(reached, order[:, :, None], axis=1), left, rank)

    def again(self, postures: Array, errors: Array) -> None:
        """Replaces postures (k, n) and errors (k,) of goals that other seeds missed, those first that were missed
        by least, until there is no progress."""
        missed = np.flatnonzero(errors > TOLERANCE)
        missed = missed[np.argsort(errors[missed], kind="stable")]
        for rows in _parts(missed, 32):  # with the seeds that were only glanced at: effort
            reached, left = self.led_on(rows, self.tried(rows))
            better = left <= TOLERANCE
            if not better.any():
                break
            postures[rows[better]], errors[rows[better]] = reached[better], left[better]

    def barred(self, rows: Index, first: Tried) -> NDArray[np.bool_]:
        """(k,) where the goals themselves miss a constraint, as far as a first try and a few more seeds tell: postures
        that reach a goal are different, and all miss some margin by the same amount."""
        few = np.broadcast_to(self.seeds[:WITNESSES], (len(rows), WITNESSES, self.seeds.shape[1]))
        further = self.tried(rows, few)
        postures, left = (np.concatenate(pair, axis=1) for pair in zip(first[:2], further[:2], strict=True))
        reached = left <= TOLERANCE
        margins = np.column_stack([each.margin(postures.reshape(-1, postures.shape[2])) for each in self.constraints])
        high, low = _ends(margins.reshape(*left.shape, -1), reached)
        # witnesses differ by 0.5 rad or mm of some joint
        spread = np.subtract(*_ends(postures, reached)).max(axis=1)
        same = np.any((high < -TOLERANCE) & (high - low <= SAME * -high), axis=1)
        return same & (np.count_nonzero(reached, axis=1) >= WITNESSES) & (spread > 0.5)

    def led_on(self, rows: Index, first: Tried) -> tuple[Array, Array]:
        """(k, n) postures and (k,) errors: where no seed reaches a goal by Newton's method, where those that reach it
        miss constraints by what is missed as further residuals."""
        again = bool(self.constraints) or self.redundant
        tried = self.tried(rows, iterations=MAX_ITERATIONS if self.constraints else QUICK) if again else first
        postures, errors = tried.postures[:, 0].copy(), tried.left[:, 0].copy()
        beyond = errors > TOLERANCE
        missed = ~beyond & (tried.rank[:, 0] >= MISSED) & bool(self.constraints)
        missed &= postures.shape[1] > self.goals.shape[1]  # a redundant arm has more than the seeds found
        for which, further in ((beyond, _polished), (missed, partial(_turned_away, constraints=self.constraints))):
            if which.any():
                where = self.conditions.rows(rows[which])
                postures[which], errors[which] = further(
                    self.model, self.goals[rows[which]], tried.postures[which], where
                )
        return postures, errors


def _ends(values: Array, counted: NDArray[np.bool_]) -> tuple[Array, Array]:
    """(k, c) largest and smallest of values (k, s, c) over those that count (k, s)."""
    high, low = (np.where(counted[:, :, None], values, end) for end in (-np.inf, np.inf))
    return high.max(axis=1), low.min(axis=1)


def _promising(model: Model, seeds: Array) -> Callable[[Array, Array], Array]:
    """Of goals (k, d) and postures (k, n), the (k, 6, n) of random postures (s, n) of a redundant arm whose
    linear steps to the goals end nearest to the postures."""
    scale = metric(model) / model.reach
    positions, jacobians = linearization(model, Conditions())(seeds, np.arange(len(seeds)))
    shortest = np.linalg.pinv(jacobians / scale) / scale[:, None]  # (s, n, d)

    def promising(goals: Array, near: Array) -> Array:
        steps = np.einsum("snd,ksd->ksn", shortest, goals[:, None] - positions)
        ends = np.clip(seeds + steps, model.arm.lower, model.arm.upper)
        distances = np.linalg.norm((ends - near[:, None]) * scale, axis=2)
        return np.asarray(seeds[np.argsort(distances, axis=1, kind="stable")[:, :6]])

    return promising


def _turned_away(
    model: Model, goals: Array, starts: Array, conditions: Conditions, constraints: Constraints
) -> tuple[Array, Array]:
    """(k, n) postures at goals (k, d) and what is left (k,): of those led from postures that miss constraints, starts
    (k, s, n), best first, to where they hold; the nearest to that where none gets there."""
    starts = starts[:, :4]  # a few seeds are led out of there, more is effort
    every = np.repeat(np.arange(len(goals)), starts.shape[1])
    linearize, units = linearization(model, conditions.rows(every)), model.reach / metric(model)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        """Of the goal and, where a margin is missed, of a place inside."""
        position, jacobian = linearize(postures, rows)
        parts = [_missed(each, postures, BEND * units) for each in constraints]
        missed, slopes = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        gap = goals[every[rows]] - position
        return np.concatenate([gap, missed], axis=1), np.concatenate([jacobian, slopes], axis=1)

    ends, _ = _least(model, distances, starts.reshape(len(every), -1), MAX_ITERATIONS)
    ends, left = inverse_kinematics(model, goals[every], ends, conditions.rows(every))
    rank = ranked(np.zeros(len(every)), left, violations(constraints, ends).sum(axis=1)).reshape(len(goals), -1)
    best = np.ravel_multi_index((np.arange(len(goals)), np.argmin(rank, axis=1)), rank.shape)
    return ends[best], left[best]


def _missed(constraint: PostureCondition, postures: Array, bends: Array) -> tuple[Array, Array]:
    """(k, c) by how much postures (k, n) are not 0.01 mm inside the margins of a constraint, and (k, c, n) derivatives
    of the margins that they miss, by differences of `bends` (n,)."""
    margins = constraint.margin(postures)
    missed = np.maximum(0.01 - margins, 0.0)
    slopes, n = np.zeros((*margins.shape, len(bends))), len(bends)
    rows = np.flatnonzero(missed.any(axis=1))
    bent = constraint.margin((postures[rows, None] + np.diag(bends)).reshape(-1, n))
    bent = bent.reshape(len(rows), n, margins.shape[1])
    slopes[rows] = np.swapaxes(bent - margins[rows, None], 1, 2) / bends
    slopes[missed == 0.0] = 0.0
    return missed, slopes


def _polished(model: Model, goals: Array, starts: Array, conditions: Conditions) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: the closest to goals (k, d) out of reach, within the limits; starts (k, s, n),
    best first."""
    linearize, arm, units = linearization(model, conditions), model.arm, model.reach / metric(model)
    # of starts that are nearly the same the first
    firsts = (np.sort(np.unique(np.round(ordered, 1), axis=0, return_index=True)[1]) for ordered in starts)
    kinds = [ordered[first] for ordered, first in zip(starts, firsts, strict=True)]
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
