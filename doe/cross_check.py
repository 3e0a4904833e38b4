"""Independent answers to one design problem side by side: they share the Jacobian and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

from doe.bounds.certificate import ApproximateDesign
from doe.bounds.column_generation import continuous_design
from doe.bounds.planar_theorem import closed_form_bound
from doe.design import Design
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification import JobError, Status

LEAST = 0.01  # [s] of the exact plan, where the weights took all the time: its first start


@dataclass(frozen=True)
class CrossCheck:
    """What each method says is the largest criterion value; bounds and attained values bracket the truth.

    relaxed : over the candidates;  continuous : over all postures, None if it failed
    exact : best plan of whole runs;  closed_form : the theorem's value, None where it does not apply
    """

    relaxed: ApproximateDesign
    continuous: ApproximateDesign | None
    exact: Design
    closed_form: float | None

    @property
    def truncation_note(self) -> str:
        """What to say of an exact plan whose search was cut short."""
        return f", cut at {self.exact.seconds:.0f} s" if self.exact.status is Status.time_limit else ""

    def rows(self) -> list[dict[str, Any]]:
        """Method, space, attained value, upper bound, Table I residual of the (weighted) plan."""
        designs: list[tuple[str, str, ApproximateDesign | Design | None]] = [
            ("relaxation", "candidates", self.relaxed),
            ("column generation", "all postures", self.continuous),
            ("exact plan", f"{len(self.exact.plan)} runs", self.exact),
        ]
        rows: list[dict[str, Any]] = [
            {
                "method": f"{name}, {design.solver}",
                "space": space,
                "value": design.value,
                "bound": None if design.bound is None else design.bound.value,
                "table_1_max_residual": Design(self.exact.problem, design.plan).table_1_max_residual,
            }
            for name, space, design in designs
            if design is not None
        ]
        rows[-1]["method"] += self.truncation_note
        if self.closed_form is not None:
            theorem = {"method": "closed form", "space": "all postures", "value": self.closed_form}
            rows.append(theorem | {"bound": self.closed_form, "table_1_max_residual": None})
        return rows


def cross_check(
    problem: DesignProblem, relaxed: ApproximateDesign, runs: int, *, seed: int = 0, seconds: float = 60.0
) -> CrossCheck:
    """The relaxation's answer beside an exact plan of IPOPT, the continuous optimum and the closed form.

    With a prior over many effects, whose continuous optimum takes hours, beside an exact plan only.

    seconds : for both, the first half for the exact plan, which a bound reached ends sooner
    """
    end = perf_counter() + seconds
    solver = "exchange_ipopt" if problem.choices is None else None
    exact = solve(problem, runs, solver, seed=seed, seconds=max(0.5 * seconds, LEAST))
    theorem = closed_form_bound(problem)
    try:
        continuous = (
            None if problem.deviations else continuous_design(problem, runs=runs, stop=lambda: perf_counter() > end)
        )
    except JobError:
        continuous = None
    return CrossCheck(relaxed, continuous, exact, None if theorem is None else theorem.value)
