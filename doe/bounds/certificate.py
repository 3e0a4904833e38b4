"""Is a design optimal? Bounds, and what weights on postures prove of all others, independent of every solver.

Of a design w with M(w) and the gradient G of the criterion there, max_(q in Q) tr(G F(q)) bounds every other one over
Q, exact or approximate (doe/README.md, "Equivalence theorem"); F = B^T B, or the matrix F of `PriorInformation`.
Everything here is recomputed from the stored problem; no number of a solver is passed on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from doe.criteria import D
from doe.problem.model import offers
from doe.problem.problem import DesignProblem, PriorInformation
from identification import Array, Plan, Status
from identification.document import Document, Documented, Sheet, number

CERTIFIED = 1.0 - 1e-6  # efficiency from which a plan is called optimal
SCOPES = {"closed_form": "all postures", "continuous": "all postures", "grid": "list"}
PROVEN, NUMERICAL = "proven", "numerical"


def sensitivity(problem: DesignProblem, information: Array, postures: ArrayLike, runs: int | None = None) -> Array:
    """(m,) tr(G F) of postures (m, n), with G the criterion's gradient at the design's information matrix.

    runs : number of new runs, needed where the problem keeps measured postures
    """
    gradient = problem.criterion.gradient(information)
    return problem.prior.per_new_run(runs).sensitivities(problem.scaled_jacobians(postures), gradient)


@dataclass(frozen=True)
class Bound:
    """No design of the design space named by `source` has a criterion value above `value`.

    source : `closed_form` (doe/README.md, "Planar theorem"), `continuous` (every feasible posture) or `grid`
        (the candidates only)
    rigorous : True if it is a theorem (closed form, interval arithmetic, all candidates visited); False if it rests on
        a numerical search for the largest sensitivity, which could have missed a posture
    cut : True if the time ended before the search for a lower bound did: it holds, and may be far from the best plan
    candidates : how many postures the list has, None: all postures within limits and constraints
    unconstrained : True if it is over all postures within the limits, as if there were no constraints: so it holds for
        plans that keep them, too
    """

    value: float
    source: str
    rigorous: bool = False
    cut: bool = False
    candidates: int | None = None
    unconstrained: bool = False

    def as_dict(self) -> dict[str, Any]:
        """The key `bound` (identification/files/README.md, "JSON keys"): `scope`, of which designs it holds, and
        `proof`, `proven` or `numerical`, as good as a search for the largest sensitivity."""
        data: dict[str, Any] = {"value": self.value, "source": self.source, "scope": SCOPES[self.source]}
        data |= {"proof": PROVEN if self.rigorous else NUMERICAL, "rigorous": self.rigorous}
        data |= {} if self.candidates is None else {"candidates": self.candidates}
        data |= {"unconstrained": True} if self.unconstrained else {}
        return data | {"cut": True} if self.cut else data

    @property
    def postures(self) -> str:
        """Of which it holds: `all postures`, `the list of 2,000 postures`."""
        if self.candidates is not None:
            return f"the list of {self.candidates:,} postures"
        return "all postures, with or without constraints" if self.unconstrained else "all postures"

    @property
    def words(self) -> str:
        """Of what it holds, and how surely: `closed form, all postures, proven`."""
        source = "closed form, " if self.source == "closed_form" else ""
        cut = ", its search was cut short" if self.cut else ""
        return f"{source}{self.postures}, {PROVEN if self.rigorous else NUMERICAL}{cut}"

    def __str__(self) -> str:
        return f"{round(self.value, 12) + 0.0:.10g} ({self.words})"


@dataclass(frozen=True, repr=False)
class PlanOfProblem(Documented):
    """A plan for a problem, and what its information, recomputed from these, is worth."""

    problem: DesignProblem
    plan: Plan

    @cached_property
    def information(self) -> Array:
        """(p, p) M' of the plan."""
        return self.problem.information(self.plan.postures, self.plan.weights)

    @cached_property
    def value(self) -> float:
        """Criterion value, -inf if the plan cannot identify all parameters."""
        return float(self.problem.criterion.value(self.information))

    @cached_property
    def log_det(self) -> float:
        """log det M' (doe/README.md, "Information matrix"), whatever the criterion."""
        return float(D().value(self.information))

    @property
    def columns_beside(self) -> dict[str, Sequence[str]]:
        """What the model says of the postures besides, name -> (m,): the cup that each touches, say."""
        model: Any = self.problem.model
        return dict(model.plan_columns(self.plan.postures)) if offers(model, "plan_columns") else {}


@dataclass(frozen=True, repr=False)
class ApproximateDesign(PlanOfProblem):
    """Weights on postures, what a search over a design space says of this plan, and what that proves.

    prior : per new run
    dual : (p, p) gradient from a dual problem, None: the criterion's own at the plan. E-optimality needs one: any
        gradient of unit trace gives a bound there, and that of the dual problem the lowest
    largest : no less than max tr(G F) over the design space, inf: not all of it was visited
    candidates : how many postures the design space has, None: all within limits and constraints
    unconstrained : as of `Bound`
    rigorous : whether `largest` is a theorem
    status : how the search ended, by the gap that is left;  solver_status : as Clarabel or SCS names it
    """

    prior: PriorInformation
    dual: Array | None = None
    largest: float = np.inf
    candidates: int | None = None
    rigorous: bool = False
    status: Status = Status.almost_solved
    solver_status: str | None = None
    solver: str = "column_generation"
    seconds: float = 0.0
    unconstrained: bool = False

    @classmethod
    def heaviest_first(
        cls, problem: DesignProblem, prior: PriorInformation, postures: Array, weights: Array, dual: Array | None = None
    ) -> ApproximateDesign:
        """The plan of postures (k, n) with weights (k,), made to sum to one, without those that carry none."""
        order = np.argsort(-weights, kind="stable")[: np.count_nonzero(weights)]
        plan = Plan(postures[order], weights[order] / weights[order].sum(), problem.model.joint_types)
        return cls(problem, plan, prior, dual)

    def certified(self, largest: float, goal: float, *, cut: bool, **changes: Any) -> ApproximateDesign:
        """The same with a certificate: `largest` >= max tr(G F) over the design space.

        goal : relative gap that counts as solved;  cut : whether time ended the search
        """
        # a mean is no larger than the largest: a gap below zero is rounding in a matrix that is nearly singular
        solved = -1e-8 <= largest - self.level <= goal * abs(self.level)
        status = Status.converged if solved else Status.time_limit if cut else Status.almost_solved
        return replace(self, largest=largest, status=status, **changes)

    @cached_property
    def information(self) -> Array:
        """(p, p) M of the plan."""
        return self.prior.mixture(self.problem.scaled_jacobians(self.plan.postures), self.plan.shares)

    @cached_property
    def gradient(self) -> Array:
        """(p, p) G."""
        return self.problem.criterion.gradient(self.information) if self.dual is None else self.dual

    @cached_property
    def level(self) -> float:
        """tr(G M), what the largest sensitivity is compared with."""
        return float(np.sum(self.gradient * self.information))

    @cached_property
    def upper(self) -> float:
        """No design of the space has a greater value, whatever these weights; inf where not all of it was visited, and
        for a singular M that has no tangent, as blocks of one may have (D*)."""
        if not np.isfinite(self.largest) or (self.problem.criterion.power and not np.isfinite(self.value)):
            return np.inf
        upper = self.problem.criterion.upper_bound(self.information, self.largest)
        return upper if np.isfinite(upper) else np.inf

    @property
    def gap(self) -> float:
        """max tr(G F) - tr(G M) over the design space; for D that is max d - p. Zero exactly at the optimum."""
        return self.largest - self.level if np.isfinite(self.upper) else np.inf

    def upper_at(self, runs: int) -> float:
        """The same for another number of new runs (doe/README.md, "Exact plans")."""
        prior, fixed = self.problem.prior.per_new_run(runs), float(np.sum(self.gradient * self.prior.total))
        alone = (self.level + max(self.gap, 0.0)) * (1.0 + self.prior.runs) - fixed  # max tr(G B^T B)
        return self.problem.criterion.upper_bound(self.information, float(prior.mixed(alone, self.gradient)))

    @property
    def efficiency_lower_bound(self) -> float:
        """Fraction 0..1 of an optimum that the weights reach at least, recomputed from them alone."""
        return min(self.problem.criterion.efficiency(self.value, self.upper, self.problem.parameters), 1.0)

    @property
    def bound(self) -> Bound | None:
        """No design of the space is better. None where the optimum was not reached; but where time alone was short, the
        bound that the weights so far prove, unless even a pass over the candidates took too long."""
        cut = self.status is Status.time_limit and -1e-8 <= self.gap < np.inf
        if not cut and self.status is not Status.converged:
            return None
        source = "continuous" if self.candidates is None else "grid"
        return Bound(self.upper, source, self.rigorous, cut, self.candidates, self.unconstrained)

    def to_json(self) -> dict[str, Any]:
        """Keys of `relax` (identification/files/README.md, "JSON keys"); angles in degrees.

        Where a joint is prismatic, `posture` and `joint_units` stand for `posture_deg`.
        """
        prismatic = "mm" in self.plan.units
        key = "posture" if prismatic else "posture_deg"
        carried = zip(self.plan.displayed.tolist(), self.plan.shares.tolist(), strict=True)
        numbers = {name: getattr(self, name) for name in ("value", "log_det", "gap", "efficiency_lower_bound")}
        return {
            "candidates": self.candidates,
            "criterion": self.problem.criterion.name,
            **{name: number if np.isfinite(number) else None for name, number in numbers.items()},
            "bound": None if self.bound is None else self.bound.as_dict(),
            "support": [{key: posture, "weight": weight} for posture, weight in carried],
            **({"joint_units": list(self.plan.units)} if prismatic else {}),
            "solver": self.solver,
            "status": self.status.name,
            "solver_status": self.solver_status,
            "seconds": self.seconds,
        }

    def document(self, compared: Sequence[Mapping[str, Any]] = (), runs: int | None = None) -> Document:
        """Value, bound and efficiency, then the support, heaviest first, and independent answers side by side.

        compared : rows of `cross_check`;  runs : m, where the value depends on it, as that of a prior per run does
        """
        where = "all postures" if self.candidates is None else f"{self.candidates} candidates"
        kind = self.problem.criterion.name
        weighted = zip(self.plan.shares, self.plan.displayed, strict=True)
        of_runs = "" if runs is None else f", {runs} runs"
        rows = [[f"{weight:.5g}", *(f"{angle:.2f}" for angle in q)] for weight, q in weighted]  # none is printed as 0
        facts: dict[str, str | None] = {
            "criterion": f"{kind} over {where}{of_runs}, {len(self.plan)} with positive weight",
            "value": number(self.value, 9),
            "upper bound": "-" if self.bound is None else str(self.bound),
            f"gap ({'max d - p' if kind == 'D' else 'max tr(G F) - tr(G M)'})": f"{max(self.gap, 0.0):.2g}",
            "efficiency at least": number(self.efficiency_lower_bound, 9),
            "solver": ", ".join(filter(None, [self.solver, self.solver_status, f"{self.seconds:.2f} s"])),
            "status": self.status.value,
        }
        support = Sheet(["weight", *self.plan.headings], rows, "Support", 24)
        digits = {"value": 7, "bound": 7, "table_1_max_residual": 4}
        answers = [[row["method"], row["space"], *(number(row[k], n) for k, n in digits.items())] for row in compared]
        title = "Cross-check: independent answers (Table I: deviation from orthogonality)"
        check = Sheet(("method", "over", "value", "upper bound", "Table I"), answers, title)
        return Document("Weights", [], [Sheet.facts(facts), support, check])
