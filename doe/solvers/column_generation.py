"""Column generation: optimal weights on few postures, priced against very many, or against all of the joint box.

    repeat:  weights   solve the small problem on the working set           (master.py)
             price     find postures with tr(G F(q)) above tr(G M)          (all candidates; continuous.py; interval.py)
             purge     drop postures that carry no weight

It ends when no posture is worth adding: that is the equivalence theorem, and its gap is the certificate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from doe.approximate import ApproximateDesign, Mixture, assess, sensitivities
from doe.bound import Bound
from doe.candidates import Candidates, PostureList, spread
from doe.continuous import ContinuousSet, distinct
from doe.criteria import Criterion
from doe.interval import maximum
from doe.plan import Plan
from doe.problem import DesignProblem
from doe.solvers.master import Weights, solve_weights, sparsest
from doe.trigonometric import TrigonometricBlocks, trigonometric_blocks
from identification.arm import Array
from identification.errors import JobError
from identification.status import Status

ROUNDS = 200
NEAR = 0.2  # [rad] times the root of the relative gap
DEAD = 1e-9  # weight below which a posture is dropped
PARTS = 256  # of the candidates, of which each may offer one posture per round: keeps new postures apart
SAMPLE = 20_000  # of very many candidates, which are priced first
COARSE = 1e-4  # relative gap at which pricing goes on to the next, larger set
FINE = 1e-6  # the same, before the first thorough search
SEMIDEFINITE = 1e-6  # relative gap that a semidefinite program reaches reliably
RANK = 1e-13  # reciprocal condition number of a matrix that has lost a rank
MOST_BOXES = 8_000  # of branch and bound; about a second

# price(gradient, level, working postures) -> postures worth adding (k, n), largest g over its whole set
Price = Callable[[Array, float, Array], tuple[Array, float]]


@dataclass(frozen=True)
class Stage:
    """One pricing, used until the gap it finds is below `goal` (relative).

    back : stages to go back when it found something: what a dear search found, a cheaper one refines
    """

    price: Price
    goal: float
    back: int = 0


@dataclass(frozen=True)
class WorkingSet:
    """The few postures of the master problem: postures (k, n), blocks (k, d, p), and its solution."""

    postures: Array
    blocks: Array
    solution: Weights

    def level(self, mixture: Mixture) -> float:
        """tr(G M)."""
        information = mixture.information(self.blocks, self.solution.weights)
        return float(np.sum(self.solution.gradient * information))

    @property
    def sparse(self) -> Array:
        """(k,) weights of the same information on as few postures as possible."""
        return sparsest(self.blocks, np.where(self.solution.weights > DEAD, self.solution.weights, 0.0))


def column_generation(
    problem: DesignProblem, candidates: Candidates, *, runs: int | None = None, tolerance: float = 1e-9
) -> ApproximateDesign:
    """Optimal weights over a finite candidate set of any size, in the memory of one chunk of it.

    tolerance : gap max g - tr(G M), relative to tr(G M), at which to stop
    runs : number of new runs, needed where the problem keeps measured postures
    Raises JobError where the candidates do not identify all parameters.
    """
    began = perf_counter()
    mixture = Mixture.of(problem, runs)
    tolerance = _attainable(problem, tolerance)
    stages = [Stage(candidate_price(problem, candidates, mixture), tolerance)]
    if len(candidates) > 4 * SAMPLE:
        sample = PostureList(spread(candidates, SAMPLE))
        stages.insert(0, Stage(candidate_price(problem, sample, mixture), max(COARSE, tolerance)))
    start = spread(candidates, 6 * problem.parameters)
    working, largest = generate(problem, mixture, start, stages)
    return finish(problem, mixture, working, largest, len(candidates), tolerance, began, rigorous=True)


def continuous_design(
    problem: DesignProblem,
    *,
    runs: int | None = None,
    tolerance: float = 1e-10,
    proof: float = 1e-10,
    most_boxes: int = MOST_BOXES,
) -> ApproximateDesign:
    """Optimal weights over ALL postures within limits and constraints: no grid at all.

    Works for any model. Where the sensitivity is a trigonometric polynomial and there are no constraints, the gap is
    proven by branch and bound and `bound.rigorous` is True; else the largest sensitivity is the best of a multistart.
    tolerance : relative gap at which to stop;  proof : relative gap that branch and bound must prove, 0: do not try
    """
    began = perf_counter()
    mixture = Mixture.of(problem, runs)
    tolerance = _attainable(problem, tolerance)
    everything = ContinuousSet(problem, mixture)
    starts = PostureList(everything.starts)
    climb = continuous_price(everything)
    thorough = continuous_price(everything, np.random.default_rng(0))
    stages = [
        Stage(candidate_price(problem, starts, mixture), COARSE),
        Stage(climb, max(FINE, tolerance)),
        Stage(thorough, max(COARSE, tolerance), back=1),
        Stage(climb, tolerance),
        Stage(thorough, tolerance, back=1),
    ]
    start = spread(starts, 6 * problem.parameters)
    working, largest = generate(problem, mixture, start, stages)
    blocks = trigonometric_blocks(problem) if proof > 0.0 and not problem.constraints else None
    rigorous = False
    if blocks is not None:
        working, largest, rigorous = prove(everything, blocks, working, stages, max(tolerance, proof), most_boxes)
    return finish(problem, mixture, working, largest, None, max(tolerance, proof), began, rigorous=rigorous)


def continuous_bound(problem: DesignProblem, *, runs: int | None = None, tolerance: float = 1e-8) -> Bound:
    """No design within limits and constraints is better: a theorem where `rigorous` is True, else numerical.

    Raises JobError where the optimum was not reached.
    """
    design = continuous_design(problem, runs=runs, tolerance=tolerance, proof=tolerance)
    if design.bound is None:
        raise JobError(f"continuous bound: {design.status.name}, gap {design.gap:.2g}; {design.status.value}")
    return design.bound


def _attainable(problem: DesignProblem, tolerance: float) -> float:
    """E-optimal weights come from a semidefinite program, which is less accurate than Newton's method."""
    return max(tolerance, SEMIDEFINITE) if problem.criterion.name == "E" else tolerance


# -- pricing -----------------------------------------------------------------------------------------------------------
def candidate_price(problem: DesignProblem, candidates: Candidates, mixture: Mixture) -> Price:
    """Every candidate is looked at; each part of them offers its best."""
    part = max(16, -(-len(candidates) // PARTS))

    def price(gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        offers, values = [near[:0]], [np.empty(0)]
        for _, postures, g in sensitivities(problem, candidates, gradient, mixture):
            edges = np.arange(0, len(g), part)
            top = np.array([edge + int(np.argmax(g[edge : edge + part])) for edge in edges])
            offers.append(postures[top])
            values.append(g[top])
        return _worth_adding(np.concatenate(offers), np.concatenate(values), level, 3 * problem.parameters)

    return price


def continuous_price(everything: ContinuousSet, generator: np.random.Generator | None = None) -> Price:
    """The local maxima that a multistart ascent finds; a thorough one with fresh starts where a generator is given."""

    def price(gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        postures, values = everything.best(gradient, near, generator)
        # a posture this near to a better one differs in value by a small part of the gap: one of the two is enough
        apart = distinct(postures, NEAR * np.sqrt(max(values[0] / level - 1.0, 0.0)))
        postures, values = postures[apart], values[apart]
        return _worth_adding(postures, values, level, 10 * everything.problem.parameters, 0.0)

    return price


def _worth_adding(postures: Array, values: Array, level: float, count: int, share: float = 0.1) -> tuple[Array, float]:
    largest = float(values.max())
    order = np.argsort(-values)[:count]
    order = order[values[order] > level + share * max(largest - level, 0.0)]
    return postures[order], largest


# -- the loop ----------------------------------------------------------------------------------------------------------
def generate(
    problem: DesignProblem, mixture: Mixture, start: Array, stages: Sequence[Stage]
) -> tuple[WorkingSet, float]:
    """The working set with its solution, and the largest g that the last pricing of the last stage found."""
    working = _solve(problem, mixture, start, problem.blocks(start))
    current, largest = 0, np.inf
    for _ in range(ROUNDS):
        stage, level = stages[current], working.level(mixture)
        offers, largest = stage.price(working.solution.gradient, level, working.postures)
        if len(offers) and largest - level > stage.goal * abs(level):
            working = _extend(problem, mixture, working, offers)
            current -= stage.back
        elif current == len(stages) - 1:
            break
        else:
            current += 1
    return working, largest


def _solve(problem: DesignProblem, mixture: Mixture, postures: Array, blocks: Array) -> WorkingSet:
    information = mixture.information(blocks, np.full(len(blocks), 1.0 / len(blocks)))
    if _diverges(problem.criterion, information):
        raise JobError(
            "approximate design: the information matrix is singular on these postures, the parameters cannot all be "
            "identified; drop an effect or allow more postures"
        )
    return WorkingSet(postures, blocks, solve_weights(blocks, problem.criterion, mixture))


def _diverges(criterion: Criterion, information: Array) -> bool:
    """True where the criterion is -inf, rounding or not: its slope along a missing direction is as 1/distance or more.

    A criterion with a prior, or of some parameters only, may be finite although the matrix is singular.
    """
    values, vectors = np.linalg.eigh(information)
    missing = vectors[:, values <= RANK * values[-1]]
    if not missing.shape[1]:
        return False
    distance = 1e2 * RANK * values[-1]
    gradient = criterion.gradient(information + distance * np.eye(len(values)))
    steepest = np.einsum("ak,ab,bk->k", missing, gradient, missing).max()
    return not np.isfinite(criterion.value(information)) or steepest * distance > 1e-3


def _extend(problem: DesignProblem, mixture: Mixture, working: WorkingSet, offers: Array) -> WorkingSet:
    """Postures that need not carry weight out, new ones in, solved again."""
    alive = np.flatnonzero(working.sparse > 0.0)
    postures = np.concatenate([working.postures[alive], offers])
    blocks = np.concatenate([working.blocks[alive], problem.blocks(offers)])
    once = np.sort(distinct(postures))
    return _solve(problem, mixture, postures[once], blocks[once])


# -- the proof ---------------------------------------------------------------------------------------------------------
def prove(
    everything: ContinuousSet,
    blocks: TrigonometricBlocks,
    working: WorkingSet,
    stages: Sequence[Stage],
    tolerance: float,
    most_boxes: int,
) -> tuple[WorkingSet, float, bool]:
    """Branch and bound on the sensitivity; a posture that the multistart missed goes back into the working set."""
    problem, mixture = everything.problem, everything.mixture
    for _ in range(5):
        gradient, level = working.solution.gradient, working.level(mixture)
        constant = 0.0 if mixture.offset is None else float(np.sum(gradient * mixture.offset))
        polynomial = blocks.sensitivity(gradient, mixture.share, constant)
        found = maximum(
            polynomial,
            problem.lower,
            problem.upper,
            known=working.postures,
            tolerance=tolerance * abs(level),
            most_boxes=most_boxes,
        )
        if not found.proven:
            return working, float(everything.best(gradient, working.postures)[1].max()), False
        if found.value <= level * (1.0 + tolerance):
            return working, found.upper, True
        start = np.concatenate([working.postures, found.posture[None]])
        working, _ = generate(problem, mixture, start, stages[1:])
    return working, found.upper, True


def finish(
    problem: DesignProblem,
    mixture: Mixture,
    working: WorkingSet,
    largest: float,
    candidates: int | None,
    tolerance: float,
    began: float,
    *,
    rigorous: bool,
) -> ApproximateDesign:
    """The design on as few postures as carry its information, judged afresh."""
    weights = working.sparse
    support = np.flatnonzero(weights > 0.0)
    order = support[np.argsort(-weights[support], kind="stable")]
    plan = Plan(working.postures[order], weights[order])
    level = working.level(mixture)
    solved = largest - level <= 10.0 * tolerance * abs(level)
    return assess(
        problem,
        mixture,
        plan,
        largest,
        gradient=working.solution.gradient,
        candidates=candidates,
        rigorous=rigorous,
        status=Status.converged if solved else Status.almost_solved,
        solver="column_generation",
        solver_status="gap reached" if solved else "gap not reached",
        seconds=perf_counter() - began,
    )
