"""Which postures may be chosen: random ones that satisfy the constraints, however few there are, grids and lists.

A grid of a million postures is three short axes, not an array: postures exist only while a chunk is visited.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import prod
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from doe.problem.constraints import Constraint
from doe.problem.problem import DesignProblem
from identification import Array, InputError, readonly

Index = NDArray[np.int64]
CHUNK = 8192  # postures; the Jacobians of a chunk stay in the processor's cache, which is fastest
MOST = 2**27  # candidates of a grid: a number for each fits into memory
OUTSIDE = 1e-9  # [rad] a listed posture may exceed a joint limit by this much, from rounding in a file in degrees
SOME = "constraints that leave some"  # postures


# -- random postures ---------------------------------------------------------------------------------------------------
def random_postures(problem: DesignProblem, count: int, generator: np.random.Generator) -> Array:
    """(count, n) uniform over the feasible set within the joint limits; near its known points where it is tiny.

    Raises `InputError` naming the constraints that exclude everything.
    """

    def anywhere(size: int) -> Array:
        return generator.uniform(problem.lower, problem.upper, (size, problem.joints))

    if not problem.constraints:
        return anywhere(count)
    return fill(problem, count, anywhere, generator)


def fill(problem: DesignProblem, count: int, draw: Callable[[int], Array], generator: np.random.Generator) -> Array:
    """(count, n) feasible postures of those that `draw(size)` makes, or near them where they are too rare."""
    feasible, seen = np.empty((0, problem.joints)), []
    for _ in range(8):  # batches, before feasible postures are searched for
        drawn = draw(max(4096, count))
        seen.append(drawn)
        feasible = np.concatenate([feasible, drawn[problem.feasible(drawn)]])
        if len(feasible) >= count:
            return feasible[:count]
    if not len(feasible):
        feasible = led_inside(problem, np.concatenate(seen), generator)
    near = vary(problem, feasible[generator.integers(len(feasible), size=count)], generator)
    return np.concatenate([feasible, near])[:count]


def led_inside(problem: DesignProblem, postures: Array, generator: np.random.Generator) -> Array:
    """Feasible postures near the least infeasible of many, by random steps that reduce by how much they are so."""

    def shortfall(postures: Array) -> Array:
        """(m,) sum over the constraints of how far a posture is from satisfying them; 0 where it does."""
        return np.sum([np.maximum(-c.margin(postures), 0.0).sum(axis=1) for c in problem.constraints], axis=0)

    best = postures[np.argsort(shortfall(postures))[:64]]
    miss, width = shortfall(best), problem.upper - problem.lower
    for k in range(60):
        trials = problem.clip(best + generator.standard_normal((16, *best.shape)) * 0.2 * 0.85**k * width)
        values = shortfall(trials.reshape(-1, problem.joints)).reshape(len(trials), -1)
        better = values.min(axis=0) < miss
        best[better] = trials[np.argmin(values, axis=0), np.arange(len(best))][better]
        miss[better] = values.min(axis=0)[better]
    feasible = best[problem.feasible(best)]
    if not len(feasible):
        raise infeasible(tuple(problem.constraints), np.concatenate([postures, best]))
    return feasible


def vary(problem: DesignProblem, postures: Array, generator: np.random.Generator) -> Array:
    """Each posture moved at random as far as it stays feasible: steps are shortened until it does."""
    steps = generator.standard_normal(postures.shape) * (problem.upper - problem.lower) * 0.2
    moved, waiting = np.array(postures), np.arange(len(postures))
    for k in range(12):
        trial = problem.clip(postures[waiting] + steps[waiting] * 0.5**k)
        fits = problem.feasible(trial)
        moved[waiting[fits]] = trial[fits]
        waiting = waiting[~fits]
    return moved


def infeasible(constraints: tuple[Constraint, ...], postures: Array) -> InputError:
    """The diagnosis when none of these (many, well spread) postures satisfies all constraints: which exclude all."""
    fits = np.array([np.all(c.margin(postures) >= 0.0, axis=1) for c in constraints])
    names = [f"constraint {k + 1} ({c.kind})" for k, c in enumerate(constraints)]
    alone = [name for name, fit in zip(names, fits, strict=True) if not fit.any()]
    if alone:
        conflict = f"no posture within the joint limits satisfies {' nor '.join(alone)}"
        return InputError(f"constraints: {conflict}, allowed: {SOME}")
    for k in range(len(names)):
        for other in range(k):
            if not np.any(fits[k] & fits[other]):
                conflict = f"no posture satisfies {names[other]} and {names[k]} together"
                return InputError(f"constraints: {conflict}, allowed: {SOME}")
    return InputError(f"constraints: no posture satisfies all of {', '.join(names)} together, allowed: {SOME}")


# -- grids and lists ---------------------------------------------------------------------------------------------------
class Candidates(Protocol):
    """N allowed postures, counted from 0."""

    def __len__(self) -> int: ...

    def take(self, index: Index) -> Array:
        """(k, n) postures [rad] of some candidates."""
        ...


@dataclass(frozen=True)
class PostureList:
    """Candidates that are simply listed.

    postures : (N, n) [rad]
    dropped : how many more there were, outside the limits or the constraints
    """

    postures: Array
    dropped: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "postures", readonly(np.atleast_2d(self.postures)))

    def __len__(self) -> int:
        return len(self.postures)

    def take(self, index: Index) -> Array:
        """(k, n) postures [rad] of some candidates."""
        return self.postures[index]


@dataclass(frozen=True)
class Grid:
    """Every combination of the axes' values, the last axis fastest, or those of them that are `allowed`.

    axes : per joint its values [rad]; one value for a joint that is not gridded
    allowed : (N,) numbers of the combinations that satisfy the constraints, None: all of them
    dropped : how many do not
    """

    axes: tuple[Array, ...]
    allowed: Index | None = None
    dropped: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(readonly(axis, -1) for axis in self.axes))

    @property
    def shape(self) -> tuple[int, ...]:
        """Values per joint."""
        return tuple(axis.size for axis in self.axes)

    def __len__(self) -> int:
        return prod(self.shape) if self.allowed is None else len(self.allowed)

    @property
    def landmarks(self) -> Index:
        """(k,) candidates at a limit or in the middle of every axis."""
        places = np.meshgrid(*(np.unique([0, size // 2, size - 1]) for size in self.shape), indexing="ij")
        cells = np.ravel_multi_index(tuple(place.ravel() for place in places), self.shape)
        if self.allowed is None:
            return cells
        return np.flatnonzero(np.isin(self.allowed, cells))

    def take(self, index: Index) -> Array:
        """(k, n) postures [rad] of some candidates."""
        cell = np.asarray(index) if self.allowed is None else self.allowed[index]
        places = np.unravel_index(cell, self.shape)
        return np.stack([axis[place] for axis, place in zip(self.axes, places, strict=True)], axis=1)


def chunks(candidates: Candidates, size: int = CHUNK) -> Iterator[tuple[Index, Array]]:
    """The candidates in order, as (index, postures) of at most `size` at a time."""
    for start in range(0, len(candidates), size):
        index = np.arange(start, min(start + size, len(candidates)))
        yield index, candidates.take(index)


def well_spread(candidates: Candidates, count: int) -> Array:
    """About `count` of the candidates (k, n), well spread; all of them if there are no more.

    Of a grid, limits and middles of the axes are among them: the optimum is often made of these.
    """
    total = len(candidates)
    if total <= count:
        return candidates.take(np.arange(total))
    generator = np.random.default_rng(0)
    chosen = generator.integers(0, total, count)
    marks = candidates.landmarks if isinstance(candidates, Grid) else np.array([0, total - 1])
    few = marks if len(marks) <= count // 2 else generator.choice(marks, count // 2, replace=False)
    return candidates.take(np.unique(np.concatenate([few, chosen[: count - len(few)]])))


def grid(problem: DesignProblem, levels: int) -> Grid:
    """`levels` values per joint from limit to limit, over the joints that matter, without what constraints forbid.

    A joint that changes neither information nor constraints (q_1 of a free base model) stays in the middle of its
    range. Raises InputError for fewer than two levels and where no candidate is left.
    """
    if levels < 2:
        raise InputError(f"grid: {levels} levels per joint, allowed: at least 2 (the joint limits)")
    gridded = problem.searched_joints
    if levels ** len(gridded) > MOST:
        asked, most = f"{levels} levels for each of {len(gridded)} joints", int(MOST ** (1.0 / len(gridded)) + 1e-9)
        raise InputError(f"grid: {asked}, allowed: 2 to {most}, which are {MOST:,} candidates at most")
    limits = zip(problem.lower, problem.upper, strict=True)
    everything = Grid(
        tuple(
            np.linspace(low, high, levels) if joint in gridded else np.array([0.5 * (low + high)])
            for joint, (low, high) in enumerate(limits)
        )
    )
    if not problem.constraints:
        return everything
    allowed = np.concatenate([index[problem.feasible(postures)] for index, postures in chunks(everything)])
    _require_some(len(allowed), len(everything))
    return Grid(everything.axes, allowed, len(everything) - len(allowed))


def listed_candidates(problem: DesignProblem, postures: ArrayLike) -> PostureList:
    """The (N, n) `postures` [rad] that are within the limits and satisfy the constraints, as a list.

    Raises InputError for another number of joints and where no candidate is left.
    """
    listed = np.atleast_2d(np.asarray(postures, dtype=float))
    if listed.ndim != 2 or listed.shape[1] != problem.joints:
        raise InputError(f"candidates: shape {np.shape(postures)}, allowed: (N, {problem.joints})")
    if len(rows := np.flatnonzero(~np.isfinite(listed).all(axis=1))):
        raise InputError(f"candidates: row {rows[0] + 1} is not finite, allowed: finite joint angles")
    inside = np.all((listed >= problem.lower - OUTSIDE) & (listed <= problem.upper + OUTSIDE), axis=1)
    clipped = problem.clip(listed)
    inside[inside] = problem.feasible(clipped[inside])
    _require_some(int(inside.sum()), len(listed))
    return PostureList(clipped[inside], len(listed) - int(inside.sum()))


def _require_some(left: int, total: int) -> None:
    if left == 0:
        raise InputError(f"candidates: 0 of {total} are within limits and constraints, allowed: at least one")
