"""Plans that are (nearly) D-optimal AND can show missing effects.

A D-optimal plan knows nothing of effects that are not in its model: under joint limits its angles sit on two levels,
where cos q_j, cos 2 q_j and q_j are one and the same column. Among plans that lose little of the D-efficiency, the one
with the greatest model-robust criterion (`doe.criteria.robust`) over the effect library is taken. Sources: plans from
theory where they attain the bound (random frequencies and phases, a loss below 0.1 %), and exchanges of the robust
criterion with weaker and weaker priors, each moved off the grid so that no period is hidden between its levels.
The order of measurement matters to backlash and drift only: the best of many shuffles is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from doe.criteria import D
from doe.criteria.robust import Robust
from doe.plan import Plan
from doe.problem import DesignProblem
from doe.result import Design
from doe.solvers import MANY, PATIENCE, Solver, solve
from doe.solvers.analytic import Analytic
from doe.solvers.base import Budget
from doe.solvers.driver import worth
from doe.solvers.exchange import Exchange
from doe.solvers.fedorov import Fedorov
from identification.arm import Arm, Array
from identification.errors import InputError
from identification.gap.hypotheses import hypotheses
from identification.gap.preflight import Preflight, preflight
from identification.information import information_matrix
from identification.measurements import Conditions, directions_from_order, session_time
from identification.model import Model
from identification.progress import Progress, silent
from identification.status import Status

WEAKEST, STRONGEST = 0.01, 300.0  # prior precisions per run; strong: only the base model counts
REFERENCE = 0.1  # prior precision at which plans are compared
TRADE = 10.0  # what one unit of the base model's log det is worth in units of the effects'
TURN = 2.0 * np.pi
BY_ORDER = frozenset({"time", "directions"})
CLEAR_SHARE = 0.5  # least share of every effect that a plan without loss must show to be taken as it is
MOVES, TRIES = np.radians([30.0, 20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0]), 10
THEORY_PLANS, SHUFFLES, STEPS, STARTS, JITTERS = 64, 200, 9, 2, 5


@dataclass(frozen=True)
class DiscriminatingDesign:
    """A plan, what it loses against the best one, and what it can and cannot see.

    arm : with its own effects
    design : judged by the criterion of the problem;  best : the best plan without regard to missing effects
    sees, best_sees : pre-flight of both
    """

    arm: Arm
    design: Design
    best: Design
    sees: Preflight
    best_sees: Preflight

    def with_design(self, design: Design) -> DiscriminatingDesign:
        """Another design, such as the same postures in another order, and what that one sees."""
        return replace(self, design=design, sees=preflight(self.arm, design.plan.postures))

    @property
    def relative_efficiency(self) -> float:
        """D-efficiency relative to the best plan found."""
        criterion, p = self.design.problem.criterion, self.design.problem.parameters
        return criterion.efficiency(self.design.value, self.best.value, p)


def discriminating(
    problem: DesignProblem,
    arm: Arm,
    runs: int,
    *,
    loss: float = 0.05,
    solver: Solver | str | None = None,
    seed: int = 0,
    starts: int | None = None,
    seconds: float | None = None,
    progress: Progress = silent,
) -> DiscriminatingDesign:
    """The plan of `runs` measurements that shows missing effects best, at a D-efficiency within `loss` of the best.

    loss : share 0..1 of the D-efficiency that may be given up
    solver, starts : of the search for the best plan, as in `solve`
    seconds : for both searches together, half of it for the best plan; left out: none up to 100 runs, 60 s for more
    Raises `InputError` for a loss outside 0..1, a criterion other than D, and too few runs (4 spare degrees of freedom
    are needed).
    """
    if not 0.0 <= loss < 1.0:
        raise InputError(f"loss: {loss}, allowed: 0 <= loss < 1")
    if not isinstance(problem.criterion, D):
        raise InputError(f"criterion: {problem.criterion.name} for a discriminating plan, allowed: D")
    began = perf_counter()
    if runs > MANY and starts is None and seconds is None:
        seconds = 2.0 * PATIENCE
    budget = Budget(1, None if seconds is None else began + seconds)
    best = solve(problem, runs, solver, seed=seed, starts=starts, seconds=None if seconds is None else seconds / 2.0)
    best_sees = preflight(arm, best.plan.postures)
    generator = np.random.default_rng(seed)
    wide = wide_problem(problem, arm)
    least = best.value + problem.parameters * float(np.log1p(-loss))
    narrow = problem.choices is None and bool(np.any(~turning(problem)))
    affordable = best.value + problem.parameters * float(np.log1p(-loss / 2.0)) if narrow else least
    judge = replace(wide, criterion=with_precision(wide, problem.parameters, REFERENCE))
    chosen, status = np.array(best.plan.postures), best.status
    score = judge.objective(chosen) + TRADE * best.value
    try:
        for postures in plans_worth_comparing(problem, wide, arm, runs, affordable, generator, budget, progress):
            value = worth(problem, postures)
            if value >= affordable and (offered := judge.objective(postures) + TRADE * value) > score:
                chosen, score = postures, offered
            if budget.out_of_time:
                status = Status.time_limit
                break
    except KeyboardInterrupt:
        status = Status.interrupted
    chosen = off_the_limits(problem, chosen, least, generator) if narrow else chosen
    plan = Plan(best_order(arm, chosen, generator))
    design = replace(best, plan=plan, solver="discriminating", status=status, seconds=perf_counter() - began)
    return DiscriminatingDesign(arm, design, best, preflight(arm, plan.postures), best_sees)


def wide_problem(problem: DesignProblem, arm: Arm) -> DesignProblem:
    """The same design space for the arm with every effect of the library in its model that postures alone can show."""
    found = hypotheses(arm, frozenset()).unscanned
    specs = (h.spec for h in found if not h.effect.needs & BY_ORDER)
    return replace(problem, model=Model(arm.with_effects(*arm.effects, *specs)))


def with_precision(wide: DesignProblem, own: int, precision: float) -> Robust:
    """Robust criterion: each effect's prior is such that it moves the tip alike, whatever its unit.

    own : the first parameters, which the data alone must tell
    """
    generator = np.random.default_rng(0)
    cloud = generator.uniform(wide.lower, wide.upper, (256, wide.joints))
    strength = np.mean(np.sum(wide.blocks(cloud) ** 2, axis=1), axis=0)
    return Robust(np.where(np.arange(wide.parameters) < own, 0.0, precision * np.maximum(strength, 1e-12)))


def clear(sees: Preflight) -> bool:
    """True if every effect shows well and none looks like another."""
    return bool(sees.shares.min(initial=1.0) >= CLEAR_SHARE) and not sees.pairs()


def plans_worth_comparing(
    problem: DesignProblem,
    wide: DesignProblem,
    arm: Arm,
    runs: int,
    least: float,
    generator: np.random.Generator,
    budget: Budget,
    progress: Progress,
) -> Iterator[Array]:
    """Plans without loss; where none of them shows every effect, plans that pay for it."""
    enough, library = False, hypotheses(arm, frozenset())
    for postures in theory_plans(problem, runs, generator):
        enough = enough or clear(preflight(arm, postures, library=library))
        yield postures
    if not enough:
        yield from robust_plans(problem, wide, runs, least, generator, budget, progress)


def theory_plans(problem: DesignProblem, runs: int, generator: np.random.Generator) -> Iterator[Array]:
    """Random plans that attain the bound up to `off_the_grid`; joints that play no part stand at random angles.

    None for a list of postures.
    """
    if problem.choices is not None:
        return
    offers = Analytic().offers(problem, runs, generator, Budget(1))
    free = [joint for joint in range(problem.joints) if joint not in problem.active_joints]
    for offer, _ in zip(offers, range(THEORY_PLANS), strict=False):
        postures = problem.clip(off_the_grid(problem, offer.postures, TURN / runs, generator))
        for joint in free:
            postures[:, joint] = generator.uniform(problem.lower[joint], problem.upper[joint], runs)
        yield postures


def turning(problem: DesignProblem) -> NDArray[np.bool_]:
    """(n,) joints that turn all the way round."""
    return np.asarray(problem.upper - problem.lower >= TURN * (1.0 - 1e-9))


def off_the_limits(problem: DesignProblem, postures: Array, least: float, generator: np.random.Generator) -> Array:
    """The postures with the other joints moved by as much as the value `least` allows, turned back at the limits.

    On the few angles that D-optimality chooses under limits, ripples of many orders are one and the same column, and
    some are that of an eccentric encoder. Half of the loss that is allowed is kept for this.
    """
    narrow = np.flatnonzero(~turning(problem))
    low, high = problem.lower[narrow], problem.upper[narrow]
    for size in MOVES:
        for _ in range(TRIES):
            angle = postures[:, narrow] + generator.uniform(-size, size, (len(postures), len(narrow)))
            moved = np.array(postures)
            moved[:, narrow] = np.clip(high - np.abs(high - (low + np.abs(angle - low))), low, high)
            if worth(problem, moved) >= least:
                return moved
    return postures


def off_the_grid(problem: DesignProblem, postures: Array, step: float, generator: np.random.Generator) -> Array:
    """The postures with joints that turn all the way round moved by up to half a step of the grid they are on.

    On N equal steps of a turn, k and N - k periods are the same: with N = 50 a gear ripple of order 49 would be an
    eccentric encoder. D-optimality asks for sums over all postures (THEORY.md section 3), which hardly change. A list
    of postures is left as it is.
    """
    moved = np.array(postures)
    if problem.choices is not None:
        return moved
    for joint in np.flatnonzero(turning(problem)):
        angle = moved[:, joint] + step * generator.uniform(-0.5, 0.5, len(moved))
        moved[:, joint] = problem.lower[joint] + np.mod(angle - problem.lower[joint], TURN)
    return moved


def robust_plans(
    problem: DesignProblem,
    wide: DesignProblem,
    runs: int,
    least: float,
    generator: np.random.Generator,
    budget: Budget,
    progress: Progress,
) -> Iterator[Array]:
    """Exchanges of the robust criterion; the prior precision is halved in on the one that loses what may be lost."""
    weak, strong = WEAKEST, STRONGEST
    spacing = (wide.upper - wide.lower) / (Exchange().levels - 1)
    turn = TURN / (Exchange().levels - 1)
    jitters = np.linspace(0.0, 0.4, JITTERS) if problem.choices is None else [0.0]
    for step in range(STEPS):
        precision = float(np.sqrt(weak * strong))
        progress(step, STEPS, f"exchange with prior precision {precision:.3g}")
        robust = replace(wide, criterion=with_precision(wide, problem.parameters, precision))
        plans = exchanged(robust, runs, generator, budget)
        for plan in plans:
            for size in jitters:
                offered = plan + size * spacing * generator.uniform(-1.0, 1.0, plan.shape)
                yield problem.clip(off_the_grid(problem, offered, turn, generator))
        affordable = max(problem.objective(plan) for plan in plans) >= least
        weak, strong = (weak, precision) if affordable else (precision, strong)


def exchanged(robust: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget) -> list[Array]:
    """Plans (m, n) that no exchange improves: on the grid of `Exchange`, or out of the list of choices."""
    if robust.choices is not None:
        offers = Fedorov(batch=STARTS).offers(robust, runs, generator, Budget(STARTS, budget.deadline))
        return [offer.postures for offer in islice(offers, STARTS)]
    exchange = Exchange()
    begun = exchange.begin(robust, STARTS, runs, generator)
    return list(exchange.improve(robust, begun, generator, budget)[0])


def best_order(arm: Arm, postures: Array, generator: np.random.Generator) -> Array:
    """The postures in the order, of many shuffles, that shows backlash and drift best beside the arm's own model."""
    found = hypotheses(arm, frozenset()).unscanned
    specs = [h.spec for h in found if h.effect.needs & BY_ORDER]
    model = Model(arm.with_effects(*arm.effects, *specs))
    own = len(Model(arm).names)
    shuffles = [generator.permutation(len(postures)) for _ in range(SHUFFLES)]
    return np.asarray(postures[max(shuffles, key=lambda order: order_score(model, own, postures[order]))])


def order_score(model: Model, own: int, postures: Array) -> float:
    """log det of what the data tell of the order's effects, beyond what the base model explains."""
    conditions = Conditions(
        time=session_time(np.arange(len(postures), dtype=float)), directions=directions_from_order(postures)
    )
    information = information_matrix(model.jacobian(postures, conditions=conditions) / model.scales)
    base, cross, rest = information[:own, :own], information[:own, own:], information[own:, own:]
    sign, value = np.linalg.slogdet(rest - cross.T @ np.linalg.lstsq(base, cross, rcond=None)[0])
    return float(value) if sign > 0 else -np.inf
