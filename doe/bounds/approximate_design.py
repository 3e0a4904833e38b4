"""Approximate designs: weights on postures, with their certificate.

Everything here is recomputed from the stored problem; no number of a solver is passed on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from doe.bounds.bound import Bound
from doe.bounds.equivalence import Certificate, certify
from doe.criteria import D
from doe.plan.plan import Plan
from doe.problem.problem import DesignProblem, PriorInformation
from identification.arrays import Array
from identification.kinematics.parameters import PRISMATIC
from identification.status import Status

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
        return self.plan.to_html(self, "weight", (f"{weight:.4f}" for weight in self.plan.shares))
