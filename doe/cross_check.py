"""Independent answers to one design problem side by side: they share the Jacobian and nothing else."""

from __future__ import annotations

from time import perf_counter
from typing import Any

from doe.bounds.certificate import ApproximateDesign
from doe.bounds.column_generation import continuous_design
from doe.bounds.planar_theorem import closed_form_bound
from doe.design import Design
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification import JobError, Status


def cross_check(
    problem: DesignProblem, relaxed: ApproximateDesign, runs: int, *, seed: int = 0, seconds: float = 60.0
) -> list[dict[str, Any]]:
    """Rows `method`, `space`, attained `value`, upper `bound` and `table_1_max_residual` of the (weighted) plan: of the
    relaxation, the optimum over all postures, an exact plan, and the closed form where it applies; bounds and attained
    values bracket the truth.

    With a prior over many effects, whose continuous optimum takes hours, without that.
    seconds : for both, the first half for the exact plan, which a bound reached ends sooner
    """
    end = perf_counter() + seconds
    # where the weights took all the time the exact plan has that of its first start
    exact = solve(problem, runs, "exchange", seed=seed, seconds=max(0.5 * seconds, 0.01))
    designs: list[tuple[str, str, ApproximateDesign | Design]] = [("relaxation", "candidates", relaxed)]
    if not problem.deviations:
        try:
            everywhere = continuous_design(problem, runs=runs, stop=lambda: perf_counter() > end)
            designs.append(("column generation", "all postures", everywhere))
        except JobError:
            pass
    designs.append(("exact plan", f"{len(exact.plan)} runs", exact))
    rows: list[dict[str, Any]] = [
        {
            "method": f"{name}, {design.solver}"
            + (f", cut at {design.seconds:.0f} s" if design.status is Status.time_limit else "")
            + (", bound cut" if design.bound is not None and design.bound.cut else ""),
            "space": space,
            "value": design.value,
            "bound": None if design.bound is None else design.bound.value,
            "table_1_max_residual": Design(problem, design.plan).table_1_max_residual,
        }
        for name, space, design in designs
    ]
    if (theorem := closed_form_bound(problem)) is not None:
        closed = {"method": "closed form", "space": "all postures", "value": theorem.value, "bound": theorem.value}
        rows.append(closed | {"table_1_max_residual": None})
    return rows
