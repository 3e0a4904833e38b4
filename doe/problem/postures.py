"""Which postures may be chosen: random ones that satisfy the constraints, however few there are, grids and lists."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from doe.problem.problem import DesignProblem
from identification import Array, InputError, require

INSIDE = 1e-6  # [rad] by which constraints are kept: rounding


# -- random postures ---------------------------------------------------------------------------------------------------
def random_postures(problem: DesignProblem, count: int, generator: Generator) -> Array:
    """(count, n) uniform over the feasible set within the joint limits; near its known points where it is tiny.

    Raises `InputError` naming the constraints that exclude everything.
    """
    limits = problem.lower, problem.upper
    if not problem.constraints:
        return generator.uniform(*limits, (count, problem.joints))
    feasible, seen = np.empty((0, problem.joints)), []
    for _ in range(8):  # batches, before feasible postures are searched for
        drawn = generator.uniform(*limits, (max(4096, count), problem.joints))
        seen.append(drawn)
        for part in np.array_split(drawn, max(1, len(drawn) // max(256, count))):  # of geometry no more than is needed
            feasible = np.concatenate([feasible, part[problem.feasible(part)]])
            if len(feasible) >= count:
                return feasible[:count]
    if not len(feasible):  # those near the least infeasible of many
        every = np.concatenate(seen)
        lacking = np.maximum(0.0, -problem.walls.values(every) / problem.steepness).sum(axis=1)
        best = put_inside(problem, every[np.argsort(lacking)[:64]])
        feasible, every = best[problem.feasible(best)], np.concatenate([every, best])
    if not len(feasible):
        fits = np.array([np.all(c.margin(every) >= 0.0, axis=1) for c in problem.constraints])
        names = []
        for k, c in enumerate(problem.constraints, start=1):
            most = zip(getattr(c, "pairs", ()), c.margin(every).max(axis=0), strict=False)
            never = ", ".join(" and ".join(pair) for pair, margin in most if margin < 0.0)
            names.append(f"constraint {k} ({c.kind}{' of ' * bool(never)}{never})")
        alone = [name for name, fit in zip(names, fits, strict=True) if not fit.any()]
        pairs = [(a, b) for b in range(len(names)) for a in range(b) if not np.any(fits[a] & fits[b])]
        conflict = f"no posture satisfies all of {', '.join(names)} together"
        if alone:
            conflict = f"no posture within the joint limits satisfies {' nor '.join(alone)}"
        elif pairs:
            conflict = f"no posture satisfies {names[pairs[0][0]]} and {names[pairs[0][1]]} together"
        raise InputError(f"constraints: {conflict}, allowed: constraints that leave some")
    near = feasible[generator.integers(len(feasible), size=count)]
    steps = generator.standard_normal(near.shape) * 0.2 * (problem.upper - problem.lower)
    moved = put_inside(problem, problem.clip(near + steps))
    return np.concatenate([feasible, np.where(problem.feasible(moved)[:, None], moved, near)])[:count]


def half_at_limits(problem: DesignProblem, count: int, generator: Generator) -> Array:
    """(k, n) so many random postures, and as many of which each joint is at its nearer limit with probability one half,
    as far as constraints allow that."""
    anywhere, others = (random_postures(problem, count, generator) for _ in range(2))
    nearer = np.where(others < 0.5 * (problem.lower + problem.upper), problem.lower, problem.upper)
    at_limits = np.where(generator.random(others.shape) < 0.5, nearer, others)
    return np.concatenate([anywhere, at_limits[problem.feasible(at_limits)]])


def connected(problem: DesignProblem, postures: Array | None = None) -> Array:
    """Where 1,000 random allowed postures leave a gap of half a radian in the angles of a joint, no move crosses it:
    those of postures (k, n), or of the 1,000, on the side that has most. Where the tracker does not see, moves pass."""
    passes = not problem.constraints or any(each.kind == "line_of_sight" for each in problem.constraints)
    drawn = postures if passes and postures is not None else random_postures(problem, 1000, np.random.default_rng(0))
    if passes:
        return drawn
    postures = drawn if postures is None else postures
    inside = np.ones(len(postures), dtype=bool)
    for angles, row in zip(problem.comparable(postures).T, np.sort(problem.comparable(drawn).T), strict=True):
        side = max(np.split(row, np.flatnonzero(np.diff(row) > 0.5) + 1), key=len)
        inside &= (angles > side[0] - 0.25) & (angles < side[-1] + 0.25)
    return postures[inside] if inside.any() else postures


def put_inside(problem: DesignProblem, postures: Array) -> Array:
    """(m, n) postures moved until they satisfy all constraints, most of them: by short steps, each back over the wall
    that is missed most (T. S. Motzkin, I. J. Schoenberg, "The relaxation method for linear inequalities", 1954)."""
    inside = np.array(postures)
    for _ in range(20):  # effort: steps
        values, slopes = problem.walls.first(inside)
        lacking = 2.0 * INSIDE - values / problem.steepness
        most = lacking.max(axis=1, initial=-np.inf)
        if not len(outside := np.flatnonzero(most > INSIDE)):
            break
        slope = (slopes / problem.steepness)[outside, :, lacking[outside].argmax(axis=1)]
        steps = slope * (most[outside] / np.maximum(np.sum(slope**2, axis=1), 1e-300))[:, None]
        # the largest change of a joint in one step
        steps *= np.minimum(1.0, 0.3 / np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1e-300))
        inside[outside] = problem.clip(inside[outside] + steps)
    return inside


# -- grids and lists ---------------------------------------------------------------------------------------------------
def grid(problem: DesignProblem, levels: int) -> Array:
    """(N, n) `levels` values per joint from limit to limit, over the joints that matter, without what constraints
    forbid; the last joint fastest.

    A joint that changes neither information nor constraints (q_1 of a free base model) stays in the middle of its
    range. Raises InputError for fewer than two levels and where no candidate is left.
    """
    require(levels >= 2, f"grid: {levels} levels per joint, allowed: at least 2 (the joint limits)")
    gridded, count = problem.searched_joints, 2**24  # candidates at most: a gigabyte
    if levels ** len(gridded) > count:
        asked, most = f"{levels} levels for each of {len(gridded)} joints", int(count ** (1.0 / len(gridded)) + 1e-9)
        raise InputError(f"grid: {asked}, allowed: 2 to {most}, which are {count:,} candidates at most")
    axes = [
        np.linspace(low, high, levels) if joint in gridded else np.array([0.5 * (low + high)])
        for joint, (low, high) in enumerate(zip(problem.lower, problem.upper, strict=True))
    ]
    postures = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    return _allowed(problem, postures, np.ones(len(postures), dtype=bool))


def listed_candidates(problem: DesignProblem, postures: ArrayLike) -> Array:
    """(N, n) those of the `postures` [rad] that are within the limits and satisfy the constraints.

    Raises InputError for another number of joints and where no candidate is left.
    """
    listed = np.atleast_2d(np.asarray(postures, dtype=float))
    if listed.ndim != 2 or listed.shape[1] != problem.joints:
        raise InputError(f"candidates: shape {np.shape(postures)}, allowed: (N, {problem.joints})")
    if len(rows := np.flatnonzero(~np.isfinite(listed).all(axis=1))):
        raise InputError(f"candidates: row {rows[0] + 1} is not finite, allowed: finite joint angles")
    rounding = 1e-9  # [rad] from a file in degrees
    inside = np.all((listed >= problem.lower - rounding) & (listed <= problem.upper + rounding), axis=1)
    return _allowed(problem, problem.clip(listed), inside)


def _allowed(problem: DesignProblem, postures: Array, inside: Array) -> Array:
    """Those inside that satisfy the constraints."""
    inside[inside] = problem.feasible(postures[inside])
    require(inside.any(), f"candidates: 0 of {len(inside)} are within limits and constraints, allowed: at least one")
    return postures[inside]


def some_of(candidates: Array, count: int) -> Array:
    """(count, n) of the candidates (k, n), at random; all of them if there are no more."""
    chosen = np.random.default_rng(0).choice(len(candidates), min(count, len(candidates)), replace=False)
    return candidates[np.sort(chosen)]
