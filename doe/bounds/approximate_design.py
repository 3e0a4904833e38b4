"""Approximate designs: weights on postures, with their certificate.

Everything here is recomputed from the stored problem; no number of a solver is passed on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from doe.bounds.bound import Bound
from doe.bounds.equivalence import certify
from doe.criteria import D
from doe.plan.plan import Plan
from doe.problem.prior import PriorInformation
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.kinematics.parameters import PRISMATIC
from identification.status import Status

ROUNDED = 1e-8  # gap below zero that says more of rounding than of the weights; a bound to 1e-6 is still one


@dataclass(frozen=True)
class ApproximateDesign:
    """Weights on postures, with a certificate over the design space that was searched.

    plan : the support and its weights;  criterion : name
    value : criterion value of the plan;  log_det : log det M'
    gap : max over the design space of tr(G F) - tr(G M); for D that is max d - p. Zero exactly at the optimum
    bound : no design of the space is better; None where the solver's status is not `converged`
    efficiency_lower_bound : fraction 0..1 of an optimum that the weights reach at least, recomputed from them alone
    status : how the solver ended;  solver_status : as the solver names it;  candidates : how many, None: continuous
    dual : (p, p) the gradient that the certificate rests on, None: the criterion's own, see `SparseDesign`
    """

    plan: Plan
    criterion: str
    value: float
    log_det: float
    gap: float
    bound: Bound | None
    efficiency_lower_bound: float
    status: Status
    solver_status: str
    solver: str
    candidates: int | None
    seconds: float
    dual: Array | None = None

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

    def _repr_html_(self) -> str:
        return self.plan.to_html(self, "weight", (f"{weight:.4f}" for weight in self.plan.shares))


@dataclass(frozen=True)
class SparseDesign:
    """Weights on few postures, as a solver found them: what is proven is proven of this plan.

    prior : per new run
    dual : (p, p) gradient from a dual problem, None: the criterion's own at the plan. E-optimality needs one: any
        gradient of unit trace gives a bound there, and that of the dual problem the lowest
    """

    problem: DesignProblem
    prior: PriorInformation
    plan: Plan
    dual: Array | None = None

    @classmethod
    def heaviest_first(
        cls,
        problem: DesignProblem,
        prior: PriorInformation,
        postures: Array,
        weights: Array,
        dual: Array | None = None,
    ) -> SparseDesign:
        """The plan of postures (k, n) with weights (k,), made to sum to one, without those that carry none."""
        order = np.argsort(-weights, kind="stable")[: np.count_nonzero(weights)]
        plan = Plan(postures[order], weights[order] / weights[order].sum(), problem.model.joint_types)
        return cls(problem, prior, plan, dual)

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


def how_it_ended(largest: float, *, solved: bool, cut: bool) -> tuple[Status, str]:
    """Status, and in words of the search, of weights whose gap reached its goal (`solved`), or whose time ended."""
    if solved:
        return Status.converged, "gap reached"
    in_words = "gap not reached" if np.isfinite(largest) else "no bound: no time to visit every candidate"
    return Status.time_limit if cut else Status.almost_solved, in_words


def certified_design(
    design: SparseDesign,
    largest: float,
    *,
    candidates: int | None,
    rigorous: bool,
    status: Status,
    solver: str,
    solver_status: str,
    seconds: float,
) -> ApproximateDesign:
    """A weighted plan with its certificate, given `largest` >= max tr(G F) over the design space.

    A status other than `converged` gives no bound: the optimum was not reached, and the gap says by how much; but where
    time alone was short, the bound that the weights so far prove, unless even a pass over the candidates took too long
    (`largest` is inf). The gap and the efficiency hold for any weights.
    Since a mean is no larger than the largest, a gap below zero is rounding in a matrix that is nearly singular, and
    proves nothing either.
    """
    proven = certify(design.problem, design.information, largest, design.gradient)
    status = status if status is not Status.converged or proven.gap >= -ROUNDED else Status.almost_solved
    cut = status is Status.time_limit and -ROUNDED <= proven.gap < np.inf
    source = "continuous" if candidates is None else "grid"
    return ApproximateDesign(
        design.plan,
        design.problem.criterion.name,
        proven.value,
        float(D().value(design.information)),
        proven.gap,
        Bound(proven.bound, source, rigorous, cut, candidates) if cut or status is Status.converged else None,
        proven.efficiency,
        status,
        solver_status,
        solver,
        candidates,
        seconds,
        design.dual,
    )
