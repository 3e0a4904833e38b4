"""`armcal design`: choose the postures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from doe.cli.common import stated, verb, with_collisions
from doe.cli.options import Count, Seconds, plan_drawing, written
from doe.cli.problems import CriterionOptions, PostureOptions, design_problem
from identification import InputError, Progress, silent
from identification.document import Answer
from identification.workflow import Picture, Written

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class SearchOptions:
    """Settings of the search, and the order of measurement.

    runs : Number of (new) measurements m.
    solver : Method; left out: the best for the problem.
    starts : Number of starts.
    seconds : Time budget [s]; left out: none up to 100 runs, 30 for more.
    discriminating : Also make missing effects distinguishable (costs some D-efficiency).
    loss : Largest loss of D-efficiency that --discriminating accepts.
    order : given, travel (least joint travel) or random.
    """

    runs: Annotated[int, click.IntRange(1, 100_000)]
    solver: str | None = None
    starts: Count | None = None
    seconds: Seconds | None = None
    discriminating: bool = False
    loss: float = 0.05
    order: str | None = None

    @property
    def effort(self) -> dict[str, Any]:
        """Arguments of `solve`."""
        return {"solver": self.solver, "starts": self.starts, "seconds": self.seconds}


@verb("armcal design arm.toml --runs 20 --out plan.csv")
def command(
    arm: Path,
    *,
    search: SearchOptions,
    criterion: CriterionOptions,
    postures: PostureOptions,
    picture: Picture | None = None,
    out: Written | None = None,
    force: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Answer:
    """Choose the postures to measure, with a certificate.

    The RUNS postures that calibrate the arm best, and how good they are.

    picture : Draw the postures (.png, .svg, .pdf).
    out : Write the plan (CSV).
    force : Overwrite an existing file.
    """
    from doe.plan.accuracy import tip_beside_random
    from doe.plan.plan import check_order, ordered, plan_text, travel
    from doe.problem.model import offers
    from doe.problem.uncertain import with_choices
    from doe.report.design import design_document, discriminating_parts, missing_lines
    from doe.solvers import solve
    from identification import load_arm

    for option, needed in (("loss", search.discriminating), ("draws", postures.uncertain)):
        if stated(option) and not needed:
            other = {"loss": "discriminating", "draws": "uncertain"}[option]
            raise InputError(f"--{option}: found without --{other}, allowed: with --{other}")
    loaded = load_arm(arm)
    check_order(search.order)
    if criterion.robust and search.discriminating:
        raise InputError("--discriminating: found with --robust, allowed: one of them")
    problem = design_problem(loaded, criterion, postures, seed)
    if criterion.robust and search.solver in (None, "fedorov"):
        problem = with_choices(problem)
    effort = search.effort | {"seed": seed}
    if search.discriminating:
        from doe.discrimination.design import discrimination_design

        chosen = discrimination_design(problem, loaded, search.runs, loss=search.loss, progress=progress, **effort)
        design, data, extra = chosen.design, chosen.to_json(), discriminating_parts(chosen)
    else:
        design, data = solve(problem, search.runs, progress=progress, **effort), dict[str, Any]()
        extra = [*missing_lines(design)]
    expected = tip_beside_random(design.problem, design.plan.postures, seed)
    data["expected_tip"] = None if expected is None else expected.to_json()
    extra += [] if expected is None else [str(expected)]
    if search.order is not None:
        before = math.degrees(travel(design.plan.postures))
        design = replace(design, plan=ordered(design.plan, search.order, seed=seed))
        after = math.degrees(travel(design.plan.postures))
        saved = 1.0 - after / before if before > 0.0 else 0.0
        data["travel_deg"] = {"order": search.order, "before": before, "after": after, "saved": saved}
        extra.append(f"order {search.order}: joint travel {before:.0f} -> {after:.0f} deg ({saved:.0%} saved)")
    model: Any = design.problem.model
    columns = model.plan_columns(design.plan.postures) if offers(model, "plan_columns") else {}
    text = plan_text(design.plan, loaded.joint_types, columns)
    extra += written({out: text, picture: lambda: plan_drawing(loaded, design.plan.postures)}, force, "plan")
    first = "--out plan.csv writes this plan; " if out is None else ""
    then = f"; then armcal identify {arm} DATA --{problem.fit} --out calibrated.toml" if problem.fit else ""
    extra.append(f"Next: {first}measure the tip at these postures, then armcal check {arm} DATA{then}")
    return with_collisions(Answer(design.to_json() | data, [design_document(design).plus(*extra)]), loaded)
