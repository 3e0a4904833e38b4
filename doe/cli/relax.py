"""`armcal relax`: approximate weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import click

from doe.cli.common import verb, with_collisions
from doe.cli.options import Count, Seconds, written
from doe.cli.problems import CriterionOptions, PostureOptions, design_problem
from identification import InputError, Progress, silent
from identification.document import Answer
from identification.workflow import Written

if TYPE_CHECKING:
    from doe.problem.problem import DesignProblem
    from identification import Array


@dataclass(frozen=True)
class RelaxationOptions:
    """The candidate postures and the solver.

    grid : Levels per joint; left out: about 10,000 in all.
    candidates : CSV of allowed postures instead of a grid.
    solver : column_generation (the default), or clarabel, which is independent of it.
    check : Cross-check by independent methods.
    runs : Number of measurements m, for --robust and spatial arms.
    seconds : Time budget [s]; left out: 40.
    """

    grid: Annotated[int, click.IntRange(min=2)] | None = None
    candidates: Path | None = None
    solver: str | None = None
    check: Annotated[bool, "--check/--no-check"] = True
    runs: Count | None = None
    seconds: Seconds | None = None

    def limits(self, solver: str) -> tuple[Callable[[], bool], float]:
        """What ends the weights, at half the time where they are checked, and the end of it all."""
        from doe.bounds.column_generation import LARGEST

        if self.seconds is not None and solver in LARGEST:
            reason, allowed = f"found with --solver {solver}", "column_generation"
            raise InputError(f"--seconds: {reason}, which cannot be stopped, allowed: with {allowed}")
        # of 40 s, a million candidates take a third of the first half
        began, seconds = perf_counter(), 40.0 if self.seconds is None else self.seconds
        weighted = began + seconds * (0.5 if self.check else 1.0)
        return (lambda: perf_counter() > weighted), began + seconds


@verb("armcal relax arm.toml --grid 9 --solver clarabel")
def command(
    arm: Path,
    *,
    chosen: RelaxationOptions,
    criterion: CriterionOptions,
    out: Written | None = None,
    force: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Answer:
    """Optimal weights over candidate postures.

    With a certificate that is recomputed from the weights, and a cross-check.

    out : Write the plan with weights (CSV).
    force : Overwrite an existing file.
    """
    from doe.bounds.column_generation import relax
    from doe.cross_check import cross_check
    from doe.plan.plan import plan_text
    from doe.problem.uncertain import with_choices
    from doe.report.design import cross_check_table, relax_document
    from identification import load_arm

    loaded = load_arm(arm)
    if criterion.robust and chosen.runs is None:
        raise InputError("--robust: no --runs given, allowed: with --runs, the number of measurements")
    held = not loaded.chain.planar and loaded.sigma is not None  # by the prior of the machining
    if chosen.runs is not None and not criterion.robust and not held:
        raise InputError("--runs: found without --robust, allowed: with --robust")
    problem = design_problem(
        loaded, criterion, PostureOptions(candidates=chosen.candidates if criterion.robust else None)
    )
    problem = with_choices(problem) if criterion.robust and chosen.grid is None else problem
    progress(0, 2, "weights")
    solver = chosen.solver or "column_generation"
    new = chosen.runs or (problem.parameters if problem.deviations else None)
    stop, end = chosen.limits(solver)
    relaxation = relax(problem, candidates(problem, chosen), solver, runs=new, stop=stop)
    data, shown = relaxation.to_json(), list[Any]([relax_document(relaxation)])
    if chosen.check:
        progress(1, 2, "cross-check")
        runs = chosen.runs or max(2 * loaded.links, problem.fewest_runs)
        checked = with_choices(problem) if criterion.robust else problem
        compared = cross_check(checked, relaxation, runs, seed=seed, seconds=end - perf_counter())
        data["cross_check"] = compared
        shown.append(cross_check_table(compared))
    text = plan_text(replace(relaxation.plan, fit=problem.fit), loaded.joint_types)
    return with_collisions(Answer(data, [*shown, *written({out: text}, force, "plan with weights")]), loaded)


def candidates(problem: DesignProblem, chosen: RelaxationOptions) -> int | Array:
    """Levels of a grid, or (N, n) postures [rad]."""
    from doe.plan.plan import load_plan

    if chosen.candidates is not None:
        return load_plan(chosen.candidates, problem.model.joint_types).postures
    if problem.choices is not None:
        if chosen.grid is not None:
            raise InputError("--grid: found for contacts, whose postures are those that touch, allowed: without")
        return problem.choices
    # by default levels that give about ten thousand candidates
    return chosen.grid or max(2, min(181, round(10_000 ** (1.0 / max(len(problem.active_joints), 1)))))
