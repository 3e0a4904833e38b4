"""Exchange search for discriminating plans at a given D-efficiency.

Runs are exchanged for postures of a pool: random ones of the design space and neighbors of the plan's own. The first
derivative of the criterion says which swaps to try, the criterion itself which is best; near the least
D-efficiency the derivative is mixed with that of the base model's log det. The pool is drawn again as long as that
helps. Every plan that is taken keeps the constraints and the least value, recomputed from the base problem.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from doe.discrimination.misidentification import EffectLibrary, MisidentificationBound
from doe.plan.replicate_spacing import ROUNDING, allowed_value, neighbor_counts
from doe.problem.postures import listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.solver import Budget
from identification.arrays import Array
from identification.information import information_matrix
from identification.progress import Progress, silent

# reasons: doe/README.md, "Misidentification"
CLOUD, POOL, NEARBY = 512, 1500, 0.15  # postures; neighbors differ by this fraction of a joint's range
OUTS, INS, MORE_OUTS = 4, 8, 50  # runs and postures that are tried per derivative; runs where those bring nothing
MULTIPLIERS = (2.0, 10.0)  # of the derivative of log det where little of it is left to lose
TIGHT = 0.1  # log det above the least that counts as little
LEAST_GAIN, ROUNDS = 1e-3, 5  # of the criterion: smaller ones end the swaps, and less than ten of it the pools
RANDOM_PLANS = 25  # whose median bound is shown beside a plan's
RANDOM_RUNS = 100_000  # of all these plans: those of thousands of runs are much alike


@dataclass(frozen=True)
class ExtendedProblem:
    """A design space with every effect in the model that postures alone can show.

    base : for the model that is to be identified;  problem : with the effects, whose parameters come last
    """

    base: DesignProblem
    problem: DesignProblem
    misidentification: MisidentificationBound

    def wrong(self, postures: Array) -> float:
        """Bound on the mean probability of a wrong name that a plan leaves, see `MisidentificationBound.wrong`."""
        return float(self.misidentification.wrong(self.problem.information(postures)))

    def at_random(self, runs: int) -> float:
        """The bound that as many random postures leave, the median of many plans."""
        generator, many = np.random.default_rng(0), max(1, min(RANDOM_PLANS, RANDOM_RUNS // runs))
        cloud = pool_of(self.problem, many * runs, generator)
        plans = [generator.permutation(cloud)[:runs] for _ in range(many)]
        return float(np.median([self.wrong(plan) for plan in plans]))


def extended_problem(problem: DesignProblem, library: EffectLibrary) -> ExtendedProblem:
    """The same design space for the model with the effects that postures show, as tests see it: in space with a minimal
    set of parameters, which has no prior."""
    shown = set(library.shown_by_postures.parameters.names) if library.base == problem.parameters else ()
    deviations = {name: size for name, size in problem.deviations.items() if name in shown}
    extended = replace(problem, model=library.shown_by_postures, deviations=deviations)
    cloud = pool_of(problem, CLOUD, np.random.default_rng(0))
    reference = information_matrix(extended.scaled_jacobians(cloud)) / len(cloud)
    bound = MisidentificationBound(library.base, library.bases, library.weights, reference)
    return ExtendedProblem(problem, extended, bound)


def pool_of(problem: DesignProblem, count: int, generator: np.random.Generator) -> Array:
    """(count, n) random postures of the design space; all of a list that is shorter."""
    if problem.choices is None:
        return random_postures(problem, count, generator)
    listed_ones = listed_candidates(problem, problem.choices).postures
    return generator.permutation(listed_ones)[:count]


def has_repeats(problem: DesignProblem, plan: Array, run: int | slice = slice(None)) -> bool:
    """True if a run, or any of a plan (m, n), is within the minimum distance of another, or of one of those kept.

    Unlike `allowed_value`, which leaves it to joints that play no part in the base model to set such postures apart:
    here these joints are chosen too. Out of a list only one and the same posture of the plan is a repeat.
    """
    if problem.minimum_distance == 0.0:
        return False
    if problem.choices is not None:
        _, place, counts = np.unique(plan, axis=0, return_inverse=True, return_counts=True)
        return bool(np.any(counts[place.ravel()][run] > 1))
    points = problem.comparable(np.vstack([plan, problem.kept]))
    return bool(np.any(neighbor_counts(points, problem.minimum_distance / ROUNDING)[: len(plan)][run]))


def improving_swaps(
    extended: ExtendedProblem,
    postures: Array,
    least: float,
    generator: np.random.Generator,
    budget: Budget,
    progress: Progress = silent,
) -> Iterator[Array]:
    """(m, n) the plan after every swap, better and better; none where no swap helps.

    least : of the base problem's criterion
    """
    state = Swaps(extended, np.array(postures), least)
    for number in range(ROUNDS):
        before = state.value
        state.draw(generator)
        while not budget.out_of_time and state.swap():
            yield state.postures
            progress(number, ROUNDS, f"wrong names at most {float(np.exp(-state.value)):.3f}")
        if budget.out_of_time or state.value < before + 10.0 * LEAST_GAIN:
            break


@dataclass
class Swaps:
    """A plan, its information and the pool.

    postures : (m, n);  jacobians : (m, d, P), scaled, of the extended problem;  pool, offered : the same of the pool
    """

    extended: ExtendedProblem
    postures: Array
    least: float

    def __post_init__(self) -> None:
        self.problem = self.extended.base
        self.misidentification = self.extended.misidentification
        self.jacobians = self.extended.problem.scaled_jacobians(self.postures)
        self.total = len(self.postures) + self.problem.prior.runs
        self.information = self.extended.problem.information(self.postures)
        self.value = float(self.misidentification.value(self.information))
        self.slack = allowed_value(self.problem, self.postures) - self.least

    def draw(self, generator: np.random.Generator) -> None:
        """Draw a new pool of postures."""
        self.pool = pool_of(self.problem, POOL, generator)
        if self.problem.choices is None:
            near = self.postures[generator.integers(len(self.postures), size=POOL)]
            width = NEARBY * (self.problem.upper - self.problem.lower)
            near = self.problem.clip(near + width * generator.uniform(-1.0, 1.0, near.shape))
            self.pool = np.concatenate([self.pool, near[self.problem.feasible(near)]])
        self.offered = self.extended.problem.scaled_jacobians(self.pool)
        self.open = np.ones(len(self.pool), dtype=bool)
        if self.problem.choices is not None and self.problem.minimum_distance > 0.0:  # no place for what is in the plan
            self.open = ~np.any(np.all(self.pool[:, None] == self.postures, axis=-1), axis=1)

    def swap(self) -> bool:
        """The best of the most promising swaps, else of more of them; False if none gains enough."""
        gradients = [self.misidentification.gradient(self.information)]
        if self.slack < TIGHT:
            p = self.misidentification.base
            for multiplier in MULTIPLIERS:
                mixed = np.array(gradients[0])
                mixed[:p, :p] += multiplier * np.linalg.inv(self.information[:p, :p])
                gradients.append(mixed)
        return self._best(gradients, OUTS) or self._best(gradients, MORE_OUTS)

    def _best(self, gradients: list[Array], outs: int) -> bool:
        """Makes the best swap of the `outs` runs and `INS` postures that look best by any of the gradients."""
        pairs = np.unique(np.concatenate([self._promising(gradient, outs) for gradient in gradients]), axis=0)
        gains = np.concatenate([self._gains(part) for part in np.array_split(pairs, len(pairs) // CLOUD + 1)])
        for k in np.argsort(-gains, kind="stable"):
            if not gains[k] > LEAST_GAIN:
                return False
            if self._make(*pairs[k]):
                return True
        return False

    def _promising(self, gradient: Array, outs: int) -> NDArray[np.intp]:
        """(c, 2) runs and postures of the pool."""
        losses = np.sum((self.jacobians @ gradient) * self.jacobians, axis=(1, 2))
        gains = np.where(self.open, np.sum((self.offered @ gradient) * self.offered, axis=(1, 2)), -np.inf)
        ins = min(INS, int(self.open.sum()))
        runs, places = np.argsort(losses, kind="stable")[:outs], np.argsort(-gains, kind="stable")[:ins]
        return np.stack(np.meshgrid(runs, places, indexing="ij"), axis=-1).reshape(-1, 2)

    def _gains(self, pairs: NDArray[np.intp]) -> Array:
        """(c,) what each swap adds to the criterion; -inf below the least value."""
        old, new = self.jacobians[pairs[:, 0]], self.offered[pairs[:, 1]]
        change = np.swapaxes(new, -1, -2) @ new - np.swapaxes(old, -1, -2) @ old
        informations = self.information + change / self.total
        p = self.misidentification.base
        change_of_log_det = (
            np.linalg.slogdet(informations[:, :p, :p])[1] - np.linalg.slogdet(self.information[:p, :p])[1]
        )
        gains = np.full(len(pairs), -np.inf)
        fits = change_of_log_det + self.slack >= 0.0
        if fits.any():
            gains[fits] = self.misidentification.value(informations[fits]) - self.value
        return gains

    def _make(self, run: int, place: int) -> bool:
        """Makes a swap, if the plan keeps its least value and its distances; else the posture is not offered again."""
        self.open[place] = False
        trial = np.array(self.postures)
        trial[run] = self.pool[place]
        if has_repeats(self.problem, trial, run) or (value := allowed_value(self.problem, trial)) < self.least:
            return False
        self.postures, self.slack = trial, value - self.least
        self.jacobians[run] = self.offered[place]
        self.information = self.extended.problem.information(self.postures)
        self.value = float(self.misidentification.value(self.information))
        return True
