"""Plans that are (nearly) D-optimal AND can distinguish missing effects.

A D-optimal plan knows nothing of effects that are not in its model: under joint limits its angles sit on two levels,
where cos q_j, cos 2 q_j and q_j are one and the same column, and on any plan the sag of a link looks much like that of
a joint. Starting from the best plan (or one from theory that is as good), moved off the limits, runs are swapped for
postures that lower the probability of a wrong name (`doe.discrimination.misidentification`), at the cost of as much
D-efficiency as is allowed. The order of measurement matters to backlash and drift only: the best of
many shuffles is kept.

Exchange search for discriminating plans at a given D-efficiency.

Runs are exchanged for postures of a pool: random ones of the design space and neighbors of the plan's own. The first
derivative of the criterion says which swaps to try, the criterion itself which is best; near the least
D-efficiency the derivative is mixed with that of the base model's log det. The pool is drawn again as long as that
helps. Every plan that is taken keeps the constraints and the least value, recomputed from the base problem.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice, takewhile
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from doe.criteria import D
from doe.criteria.criterion import log_determinants
from doe.discrimination.misidentification import EffectLibrary, MisidentificationBound
from doe.plan.spacing import ROUNDING, allowed_value, neighbor_counts, spread_free_joints
from doe.problem.postures import listed_candidates, random_postures
from doe.solvers import Solver, solve
from doe.solvers.planar_theory import optimal_plans
from doe.solvers.solver import LONG_PLAN, LONG_PLAN_SECONDS, Budget
from identification import REVOLUTE, Array, InputError, Progress, Status, information_matrix, silent, spectrum

if TYPE_CHECKING:
    from doe.design import Design
    from doe.problem.problem import DesignProblem
    from identification import Arm, Detectability

TURN = 2.0 * np.pi  # [rad]
MOST_SEEN = 10_000  # postures; memory: of more, the columns of all effects take gigabytes


@dataclass(frozen=True)
class DiscriminationDesign:
    """A plan, what it loses against the best one, and what it can and cannot see.

    design : judged by the criterion of the problem;  best : the best plan without regard to missing effects
    sees, best_sees : pre-flight of both, with the postures measured already; None where the library has none, and
        of more than `MOST_SEEN` postures
    wrong, best_wrong, random_wrong : the mean probability of a wrong name is at most this, with the plan, the best plan
        and as many random postures (the median of many such plans), for effects that postures show and that are
        `LAMBDA` long on random ones; see `doe.discrimination.misidentification`
    """

    design: Design
    best: Design
    sees: Detectability | None
    best_sees: Detectability | None
    wrong: float
    best_wrong: float
    random_wrong: float

    @property
    def relative_efficiency(self) -> float:
        """D-efficiency relative to the best plan found."""
        criterion, p = self.design.problem.criterion, self.design.problem.parameters
        return criterion.efficiency(self.design.value, self.best.value, p)

    def to_json(self) -> dict[str, Any]:
        """The keys that `--discriminating` adds to those of a design.

        `not_visible`: effects of which less than a hundredth of a column's norm is left for the tests to see.
        """
        invisible = [
            [] if sees is None else [n for n, left in zip(sees.names, sees.norm_fractions, strict=True) if left < 0.01]
            for sees in (self.sees, self.best_sees)
        ]
        wrong = {"plan": self.wrong, "best_plan": self.best_wrong, "random_postures": self.random_wrong}
        return {
            "relative_efficiency": self.relative_efficiency,
            "wrong_name_at_most": wrong,
            "preflight": None if self.sees is None else self.sees.to_json(),
            "not_visible": invisible[0],
            "not_visible_in_best_plan": invisible[1],
        }


def discrimination_design(
    problem: DesignProblem,
    effects: Arm | EffectLibrary,
    runs: int,
    *,
    loss: float = 0.05,
    solver: Solver | str | None = None,
    seed: int = 0,
    starts: int | None = None,
    seconds: float | None = None,
    progress: Progress = silent,
) -> DiscriminationDesign:
    """The plan of `runs` measurements that shows missing effects best, at a D-efficiency within `loss` of the best.

    effects : which may be missing: those of the library that this arm can have, or others
    loss : fraction 0..1 of the D-efficiency that may be given up
    solver, starts : of the search for the best plan, as in `solve`
    seconds : for both searches together, half of it for the best plan; left out: none up to 100 runs, 60 s for more
    Raises `InputError` for a loss outside 0..1, a criterion other than D, and too few runs (4 residual degrees of
    freedom are needed). Ctrl-C returns the plan so far, status `interrupted`.
    """
    if not 0.0 <= loss < 1.0:
        raise InputError(f"loss: {loss}, allowed: 0 <= loss < 1")
    if not isinstance(problem.criterion, D):
        raise InputError(f"criterion: {problem.criterion.name} for a discriminating plan, allowed: D")
    began = perf_counter()
    library = effects if isinstance(effects, EffectLibrary) else EffectLibrary.of(effects)
    if runs > LONG_PLAN and starts is None and seconds is None:
        seconds = 2.0 * LONG_PLAN_SECONDS
    budget = Budget(1, None if seconds is None else began + seconds)
    half = None if seconds is None else seconds / 2.0
    best = solve(problem, runs, solver, seed=seed, starts=starts, seconds=half, progress=progress)
    best_sees = seen(problem, library, best.plan.postures)
    generator = np.random.default_rng(seed)
    extended = ExtendedProblem.of(problem, library)
    chosen, status = search(extended, best, loss, generator, budget, progress)
    # effort: the order has a second in any case
    ordering = replace(budget, deadline=budget.deadline and max(budget.deadline, perf_counter() + 1.0))
    plan = replace(best.plan, postures=best_order(library, chosen, generator, ordering))
    design = replace(best, plan=plan, solver="discriminating", status=status, seconds=perf_counter() - began)
    bounds = extended.wrong(chosen), extended.wrong(best.plan.postures), extended.at_random(runs)
    sees = seen(problem, library, plan.postures)
    return DiscriminationDesign(design, best, sees, best_sees, *(min(1.0, bound) for bound in bounds))


def search(
    extended: ExtendedProblem,
    best: Design,
    loss: float,
    generator: np.random.Generator,
    budget: Budget,
    progress: Progress,
) -> tuple[Array, Status]:
    """(m, n) the plan that distinguishes effects, and how the search ended; the best plan if that was interrupted."""
    chosen, status = np.array(best.plan.postures), best.status
    if status is Status.interrupted:
        return chosen, status
    allowed = extended.base.parameters * float(-np.log1p(-loss))
    status, bound = Status.local_optimum, np.inf
    try:
        for postures, stop in initial_plans(extended, best, allowed, generator, budget):
            swaps = improving_swaps(extended, postures, best.value - allowed, generator, stop, progress)
            for plan in chain([postures], swaps):
                if (wrong := extended.wrong(plan)) < bound:
                    chosen, bound = plan, wrong
            status = Status.time_limit if stop.out_of_time else status
    except KeyboardInterrupt:
        status = Status.interrupted
    return chosen, status


def seen(problem: DesignProblem, library: EffectLibrary, postures: Array) -> Detectability | None:
    """Detectability of missing effects by these postures and those measured already; None of more than `MOST_SEEN`."""
    every = np.vstack([problem.kept, postures])
    return None if library.preflight is None or len(every) > MOST_SEEN else library.preflight(every)


def initial_plans(
    extended: ExtendedProblem, best: Design, allowed: float, generator: np.random.Generator, budget: Budget
) -> Iterator[tuple[Array, Budget]]:
    """Plans from which swaps start, each with its part of the time.

    Under joint limits a D-optimal plan stands in the corners, far from plans that distinguish effects: there is a
    second beginning with as many random postures as three quarters of the loss allow.
    """
    problem = extended.base
    if not narrow(problem):
        yield start(extended, best, best.value - allowed / 2.0, generator, budget), budget
        return
    first = budget.part(0.5)
    yield start(extended, best, best.value - allowed / 2.0, generator, budget), first
    if not budget.out_of_time:
        plan = start(extended, best, best.value - allowed / 8.0, generator, budget)
        rows = generator.permutation(len(plan))
        for row, drawn in zip(rows, pool_of(problem, len(plan), generator), strict=True):
            trial = np.array(plan)
            trial[row] = drawn
            plan = trial if allowed_value(problem, trial) >= best.value - 0.75 * allowed else plan
        yield plan, budget


def start(
    extended: ExtendedProblem, best: Design, least: float, generator: np.random.Generator, budget: Budget
) -> Array:
    """(m, n) the best plan or one from theory, whichever distinguishes effects best, off the limits down to `least`;
    as many from theory as there is time for, off the grid, with joints that play no part at random angles.

    Joints that turn all the way round are moved by up to half a step of the grid they are on: on N equal steps of a
    turn, k and N - k periods are the same, and with N = 50 a gear ripple of order 49 would be an eccentric encoder.
    D-optimality asks for sums over all postures (doe/README.md, "Information matrix"), which hardly change.
    """
    problem, runs = extended.base, len(best.plan.postures)
    free = [joint for joint in range(problem.joints) if joint not in problem.active_joints]
    round_joints, plans = np.flatnonzero(turning(problem)), [np.array(best.plan.postures)]
    origin, step = problem.lower[round_joints], TURN / runs
    theory = optimal_plans(problem, runs, generator) if problem.choices is None else iter(())
    for plan in takewhile(lambda _: not budget.out_of_time, islice(theory, 64)):  # effort: plans to choose from
        moved = np.array(plan)
        angles = moved[:, round_joints] + step * generator.uniform(-0.5, 0.5, (runs, len(round_joints)))
        moved[:, round_joints] = origin + np.mod(angles - origin, TURN)
        postures = problem.clip(moved)
        postures[:, free] = generator.uniform(problem.lower[free], problem.upper[free], (runs, len(free)))
        if allowed_value(problem, postures) >= least:
            plans.append(postures)
    chosen = min(plans, key=extended.wrong)
    moved = off_the_limits(problem, chosen, least, generator) if narrow(problem) else chosen
    return spread_free_joints(problem, moved, generator) if has_repeats(problem, moved) else moved


def turning(problem: DesignProblem) -> NDArray[np.bool_]:
    """(n,) joints that turn all the way round."""
    revolute = np.array(problem.model.joint_types) == REVOLUTE
    return revolute & (problem.upper - problem.lower >= TURN * (1.0 - 1e-9))


def narrow(problem: DesignProblem) -> bool:
    """True if a joint has limits within which the postures may be chosen freely."""
    return problem.choices is None and not np.all(turning(problem))


def off_the_limits(problem: DesignProblem, postures: Array, least: float, generator: np.random.Generator) -> Array:
    """The postures with the other joints moved by as much as the value `least` allows, turned back at the limits.

    On the few angles that D-optimality chooses under limits, ripples of many orders are one and the same column, and
    some are that of an eccentric encoder. Part of the loss that is allowed is kept for this.
    """
    joints = np.flatnonzero(~turning(problem))
    low, high = problem.lower[joints], problem.upper[joints]
    # effort: steps by which joints move off their limits, ten tries of each
    for size in np.repeat(np.radians([30.0, 20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0]), 10):
        step = size * problem.joint_units[joints]
        angle = postures[:, joints] + generator.uniform(-step, step, (len(postures), len(joints)))
        moved = np.array(postures)
        moved[:, joints] = np.clip(high - np.abs(high - (low + np.abs(angle - low))), low, high)
        if allowed_value(problem, moved) >= least:
            return moved
    return postures


def best_order(library: EffectLibrary, postures: Array, generator: np.random.Generator, budget: Budget) -> Array:
    """The postures in the order, of many shuffles, that shows backlash and drift best beside the model's parameters: by
    log det of what the data tell of the order's effects, beyond what the others explain."""
    shuffles = [generator.permutation(len(postures)) for _ in range(200)]  # effort: orders to choose from
    if library.jacobian_by_order is None:
        return np.asarray(postures[shuffles[0]])
    scores, base = [], library.base
    for order in chain(shuffles[:1], takewhile(lambda _: not budget.out_of_time, shuffles[1:])):
        jacobian = library.jacobian_by_order(postures[order])
        information = information_matrix(jacobian)
        cross = information[:base, base:]
        explained = cross.T @ spectrum(jacobian[..., :base], np.ones(base)).covariance @ cross
        scores.append(float(log_determinants(information[base:, base:] - explained)))
    return np.asarray(postures[shuffles[int(np.argmax(scores))]])


# -- swaps -------------------------------------------------------------------------------------------------------------
CLOUD, POOL = 512, 1500  # effort: postures
# effort: gain of the criterion below which the swaps end, ten of it for the pools; rounds of pools
LEAST_GAIN, ROUNDS = 1e-3, 5


@dataclass(frozen=True)
class ExtendedProblem:
    """A design space with every effect in the model that postures alone can show.

    base : for the model that is to be identified;  problem : with the effects, whose parameters come last
    """

    base: DesignProblem
    problem: DesignProblem
    misidentification: MisidentificationBound

    @classmethod
    def of(cls, problem: DesignProblem, library: EffectLibrary) -> ExtendedProblem:
        """The same design space for the model with the effects that postures show, as tests see it: in space with a
        minimal set of parameters, which has no prior."""
        shown = set(library.shown_by_postures.parameters.names) if library.base == problem.parameters else ()
        deviations = {name: size for name, size in problem.deviations.items() if name in shown}
        extended = replace(problem, model=library.shown_by_postures, deviations=deviations)
        cloud = pool_of(problem, CLOUD, np.random.default_rng(0))
        reference = information_matrix(extended.scaled_jacobians(cloud)) / len(cloud)
        bound = MisidentificationBound(library.base, library.bases, library.weights, reference)
        return cls(problem, extended, bound)

    def wrong(self, postures: Array) -> float:
        """Bound on the mean probability of a wrong name that a plan leaves, see `MisidentificationBound.wrong`."""
        return float(self.misidentification.wrong(self.problem.information(postures)))

    def at_random(self, runs: int) -> float:
        """The bound that as many random postures leave, the median of many plans."""
        # effort: fewer plans of thousands of runs, which are much alike
        generator, many = np.random.default_rng(0), max(1, min(25, 100_000 // runs))
        cloud = pool_of(self.problem, many * runs, generator)
        plans = [generator.permutation(cloud)[:runs] for _ in range(many)]
        return float(np.median([self.wrong(plan) for plan in plans]))


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
            width = 0.15 * (self.problem.upper - self.problem.lower)  # effort: neighbors by this part of a range
            near = self.problem.clip(near + width * generator.uniform(-1.0, 1.0, near.shape))
            self.pool = np.concatenate([self.pool, near[self.problem.feasible(near)]])
        self.offered = self.extended.problem.scaled_jacobians(self.pool)
        self.open = np.ones(len(self.pool), dtype=bool)
        if self.problem.choices is not None and self.problem.minimum_distance > 0.0:  # no place for what is in the plan
            self.open = ~np.any(np.all(self.pool[:, None] == self.postures, axis=-1), axis=1)

    def swap(self) -> bool:
        """The best of the most promising swaps, else of more of them; False if none gains enough."""
        gradients = [self.misidentification.gradient(self.information)]
        if self.slack < 0.1:  # effort: little of log det is left to lose, so its derivative counts too
            p = self.misidentification.base
            for multiplier in (2.0, 10.0):  # effort: of the derivative of log det
                mixed = np.array(gradients[0])
                mixed[:p, :p] += multiplier * np.linalg.inv(self.information[:p, :p])
                gradients.append(mixed)
        return self._best(gradients, 4) or self._best(gradients, 50)  # effort: runs that are tried per derivative

    def _best(self, gradients: list[Array], outs: int) -> bool:
        """Makes the best swap of the `outs` runs and 8 postures that look best by any of the gradients."""
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
        ins = min(8, int(self.open.sum()))  # effort
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
