"""Is a design optimal? The equivalence theorem and the bounds that follow from it, independent of every solver.

A design w is optimal over a set Q of postures if and only if max_(q in Q) tr(G F(q)) = tr(G M(w)), with G the gradient
of the criterion at M(w), B the scaled Jacobian (d, p) of a posture, whose d coordinates are indivisible, and F = B^T B,
or the matrix F of `PriorInformation` where something is known already (doe/README.md, "Equivalence theorem"). For D,
G = M^-1 and the right side is p. From any design, optimal or not, the maximum gives an upper bound for every other
one, exact plans of any number of runs included.

An upper bound on a criterion value, and where it comes from.

Approximate designs: weights on postures, with their certificate.

Everything here is recomputed from the stored problem; no number of a solver is passed on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from doe.criteria import D
from doe.plan.plan import Plan
from doe.problem.postures import CHUNK, Candidates, chunks
from doe.problem.problem import DesignProblem, PriorInformation, Stop, never
from identification import PRISMATIC, Array, Status

CERTIFIED = 1.0 - 1e-6  # efficiency from which a plan is called optimal
REACHED = 1.0 - 1e-9  # efficiency from which searching on cannot matter
REMEMBERED = 4_000_000  # entries of candidates' Jacobians that are remembered between passes: 32 MB
LAST = 2.0  # [s] that a pass over the candidates may take after the time has ended, however short the search was


@dataclass(frozen=True)
class Certificate:
    """What a design proves about all others of its design space.

    value : criterion value of the design;  gap : max tr(G F) - tr(G M), which is zero exactly at an optimum
    bound : no design has a greater criterion value
    efficiency : fraction 0..1 of an optimum that the design reaches at least
    """

    value: float
    gap: float
    bound: float
    efficiency: float


def certify(problem: DesignProblem, information: Array, largest: float, gradient: Array | None = None) -> Certificate:
    """The certificate of a design with information M, given `largest` >= max tr(G F) over the design space.

    largest : inf proves nothing, and neither does a singular M; the certificate says so
    gradient : (p, p) G, default the criterion's at M; E-optimality needs the one of its dual problem
    """
    criterion = problem.criterion
    value = float(criterion.value(information))
    if np.isinf(largest) or np.isinf(value):  # not all of the design space was visited; a singular M has no tangent
        return Certificate(value, np.inf, np.inf, 0.0)
    slope = criterion.gradient(information) if gradient is None else gradient
    bound = criterion.upper_bound(information, largest)
    efficiency = criterion.efficiency(value, bound, problem.parameters)
    return Certificate(value, largest - float(np.sum(slope * information)), bound, efficiency)


def sensitivity(problem: DesignProblem, information: Array, postures: ArrayLike) -> Array:
    """(m,) tr(G B^T B) of postures (m, n), with G the criterion's gradient at the design's information matrix."""
    gradient = problem.criterion.gradient(information)
    return PriorInformation().sensitivities(problem.scaled_jacobians(postures), gradient)


@dataclass(frozen=True)
class CandidateJacobians:
    """Candidates chunk by chunk with their scaled Jacobians, which are remembered between passes where they are few."""

    problem: DesignProblem
    candidates: Candidates
    _remembered: list[tuple[Array, Array]] = field(default_factory=list, repr=False)

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        """Postures (k, n) and scaled Jacobians (k, d, p) of chunk after chunk."""
        if self._remembered:
            yield from self._remembered
            return
        each = self.problem.model.dimension * self.problem.parameters
        # entries of a chunk's Jacobians that stay in the processor's cache
        parts = chunks(self.candidates, int(np.clip(250_000 // each, 1024, CHUNK)))
        made = ((postures, self.problem.scaled_jacobians(postures)) for _, postures in parts)
        if len(self.candidates) * each > REMEMBERED:
            yield from made
            return
        self._remembered.extend(made)
        yield from self._remembered

    def sensitivities(self, gradient: Array, prior: PriorInformation) -> Iterator[tuple[Array, Array]]:
        """Per chunk: postures (k, n) and g (k,) = tr(G F). Never more than one chunk of values in memory."""
        positive = np.linalg.eigvalsh(gradient)[0] > 1e-14 * np.trace(gradient)
        root = np.linalg.cholesky(gradient) if positive else None
        for postures, jacobians in self:
            across = jacobians.transpose(1, 2, 0)  # (d, p, k) as `vectorize` has it
            half = (gradient if root is None else root.T) @ across  # tr(L L^T B^T B) = |L^T B^T|^2
            half *= across if root is None else half
            yield postures, prior.mixed(half.sum(axis=(0, 1)), gradient)


def last_pass(stop: Stop, began: float) -> Stop:
    """When to give a pass over the candidates up that begins now: the time has ended, and the pass takes longer than
    the search before it, which `began` at that `perf_counter`, and than `LAST` seconds."""
    now = perf_counter()
    end = now + max(LAST, now - began)
    return lambda: perf_counter() > end and stop()


def largest_sensitivity(
    problem: DesignProblem, candidates: Candidates, gradient: Array, prior: PriorInformation, give_up: Stop = never
) -> float:
    """max over the candidates of g = tr(G F), all of them visited, their Jacobians computed afresh.

    prior : per new run;  give_up : asked after every chunk; inf, which is no less than the largest, where it said so
    """
    largest = -np.inf
    for _, g in CandidateJacobians(problem, candidates).sensitivities(gradient, prior):
        largest = max(largest, float(g.max()))
        if give_up():
            return np.inf
    return largest


# -- bounds ------------------------------------------------------------------------------------------------------------
SCOPES = {"closed_form": "all postures", "continuous": "all postures", "grid": "list"}
PROVEN, NUMERICAL = "proven", "numerical"


@dataclass(frozen=True)
class Bound:
    """No design of the design space named by `source` has a criterion value above `value`.

    source : `closed_form` (doe/README.md, "Planar theorem"), `continuous` (every feasible posture) or `grid`
        (the candidates only)
    rigorous : True if it is a theorem (closed form, interval arithmetic, all candidates visited); False if it rests on
        a numerical search for the largest sensitivity, which could have missed a posture
    cut : True if the time ended before the search for a lower bound did: it holds, and may be far from the best plan
    candidates : how many postures the list has, None: all postures within limits and constraints
    """

    value: float
    source: str
    rigorous: bool = False
    cut: bool = False
    candidates: int | None = None

    @property
    def scope(self) -> str:
        """Of which designs it holds: of `all postures` within limits and constraints, or of those of a `list`."""
        return SCOPES[self.source]

    @property
    def proof(self) -> str:
        """`proven`, or `numerical`: as good as a search for the largest sensitivity."""
        return PROVEN if self.rigorous else NUMERICAL

    def as_dict(self) -> dict[str, Any]:
        """The key `bound` (identification/files/README.md, "JSON keys")."""
        data: dict[str, Any] = {"value": self.value, "source": self.source, "scope": self.scope, "proof": self.proof}
        data |= {"rigorous": self.rigorous} | ({} if self.candidates is None else {"candidates": self.candidates})
        return data | {"cut": True} if self.cut else data

    def __str__(self) -> str:
        return f"{round(self.value, 12) + 0.0:.10g} ({bound_in_words(self.as_dict())})"


def bound_in_words(bound: Mapping[str, Any]) -> str:
    """Of what a bound, as in JSON, holds, and how surely: `closed form, all postures, proven`.

    Files of earlier versions do not say which postures.
    """
    source = {"closed_form": "closed form, "}.get(bound["source"], "")
    proof = PROVEN if bound.get("rigorous", False) else NUMERICAL
    cut = ", its search was cut by the time limit" if bound.get("cut") else ""
    return f"{source}{postures_in_words(bound)}, {proof}{cut}"


def postures_in_words(bound: Mapping[str, Any]) -> str:
    """`all postures`, `the list of 2,000 postures`."""
    if SCOPES.get(bound["source"]) == "list":
        count = bound.get("candidates")
        return "the postures of the list" if count is None else f"the list of {count:,} postures"
    return "all postures"


# -- approximate designs -----------------------------------------------------------------------------------------------
ROUNDED = 1e-8  # gap below zero that says more of rounding than of the weights; a bound to 1e-6 is still one


@dataclass(frozen=True)
class ApproximateDesign:
    """Weights on postures: the plan, what a search over a design space says of it, and what that proves.

    prior : per new run;  plan : the support and its weights
    dual : (p, p) gradient from a dual problem, None: the criterion's own at the plan. E-optimality needs one: any
        gradient of unit trace gives a bound there, and that of the dual problem the lowest
    largest : no less than max tr(G F) over the design space, inf: not all of it was visited
    candidates : how many postures the design space has, None: all within limits and constraints
    rigorous : whether `largest` is a theorem
    status : how the solver ended;  solver_status : as the solver names it
    """

    problem: DesignProblem
    prior: PriorInformation
    plan: Plan
    dual: Array | None = None
    largest: float = np.inf
    candidates: int | None = None
    rigorous: bool = False
    status: Status = Status.almost_solved
    solver_status: str = ""
    solver: str = ""
    seconds: float = 0.0

    @classmethod
    def heaviest_first(
        cls,
        problem: DesignProblem,
        prior: PriorInformation,
        postures: Array,
        weights: Array,
        dual: Array | None = None,
    ) -> ApproximateDesign:
        """The plan of postures (k, n) with weights (k,), made to sum to one, without those that carry none."""
        order = np.argsort(-weights, kind="stable")[: np.count_nonzero(weights)]
        plan = Plan(postures[order], weights[order] / weights[order].sum(), problem.model.joint_types)
        return cls(problem, prior, plan, dual)

    def certified(self, largest: float, goal: float, *, cut: bool, **changes: Any) -> ApproximateDesign:
        """The same with a certificate: `largest` >= max tr(G F) over the design space.

        goal : relative gap that counts as solved;  cut : whether time ended the search
        """
        design = replace(self, largest=largest, **changes)
        if largest - design.level <= goal * abs(design.level):
            return replace(design, status=Status.converged, solver_status="gap reached")
        in_words = "gap not reached" if np.isfinite(largest) else "no bound: no time to visit every candidate"
        return replace(design, status=Status.time_limit if cut else Status.almost_solved, solver_status=in_words)

    def __post_init__(self) -> None:
        # a mean is no larger than the largest: a gap below zero is rounding in a matrix that is nearly singular
        if self.status is Status.converged and self.gap < -ROUNDED:
            object.__setattr__(self, "status", Status.almost_solved)

    @cached_property
    def information(self) -> Array:
        """(p, p) M of the plan."""
        return self.prior.information(self.problem.weighted_information(self.plan.postures, self.plan.shares))

    @cached_property
    def gradient(self) -> Array:
        """(p, p) G."""
        return self.problem.criterion.gradient(self.information) if self.dual is None else self.dual

    @cached_property
    def level(self) -> float:
        """tr(G M), what the largest sensitivity is compared with."""
        return float(np.sum(self.gradient * self.information))

    @cached_property
    def certificate(self) -> Certificate:
        """What the plan proves of all others, whatever its weights."""
        return certify(self.problem, self.information, self.largest, self.gradient)

    @property
    def value(self) -> float:
        """Criterion value of the plan."""
        return self.certificate.value

    @property
    def gap(self) -> float:
        """max tr(G F) - tr(G M) over the design space; for D that is max d - p. Zero exactly at the optimum."""
        return self.certificate.gap

    @property
    def efficiency_lower_bound(self) -> float:
        """Fraction 0..1 of an optimum that the weights reach at least, recomputed from them alone."""
        return self.certificate.efficiency

    @property
    def bound(self) -> Bound | None:
        """No design of the space is better. None where the optimum was not reached; but where time alone was short, the
        bound that the weights so far prove, unless even a pass over the candidates took too long."""
        cut = self.status is Status.time_limit and -ROUNDED <= self.gap < np.inf
        if not cut and self.status is not Status.converged:
            return None
        source = "continuous" if self.candidates is None else "grid"
        return Bound(self.certificate.bound, source, self.rigorous, cut, self.candidates)

    @property
    def criterion(self) -> str:
        """Its name."""
        return self.problem.criterion.name

    @property
    def log_det(self) -> float:
        """log det M', whatever the criterion."""
        return float(D().value(self.information))

    def to_json(self) -> dict[str, Any]:
        """Keys of `relax` (identification/files/README.md, "JSON keys"); angles in degrees.

        Where a joint is prismatic, `posture` and `joint_units` stand for `posture_deg`.
        """
        prismatic = PRISMATIC in self.plan.joint_types
        key = "posture" if prismatic else "posture_deg"
        carried = zip(self.plan.displayed.tolist(), self.plan.shares.tolist(), strict=True)
        numbers = {name: getattr(self, name) for name in ("value", "log_det", "gap", "efficiency_lower_bound")}
        return {
            "candidates": self.candidates,
            "criterion": self.criterion,
            **{name: number if np.isfinite(number) else None for name, number in numbers.items()},
            "bound": None if self.bound is None else self.bound.as_dict(),
            "support": [{key: posture, "weight": weight} for posture, weight in carried],
            **({"joint_units": list(self.plan.units)} if prismatic else {}),
            "solver": self.solver,
            "status": self.status.name,
            "solver_status": self.solver_status,
            "seconds": self.seconds,
        }

    def __str__(self) -> str:
        where = "the continuous set" if self.candidates is None else f"{self.candidates} candidates"
        return (
            f"{self.criterion}-optimal weights on {len(self.plan)} postures of {where} ({self.solver}, "
            f"{self.seconds:.3g} s)\n  value {self.value:.10g}, bound {self.bound or 'none'}, gap {self.gap:.2g}, "
            f"efficiency >= {self.efficiency_lower_bound:.10g}\n  {self.status.name}: {self.status.value}"
        )

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return self.plan.to_html(self)
