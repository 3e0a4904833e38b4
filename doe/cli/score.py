"""`armcal score`: judge any plan."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, verb


@verb("armcal score arm.toml plan.csv")
@click.argument("arm", type=FILE)
@click.argument("plan", type=FILE)
def command(session: Session, arm: Path, plan: Path) -> Answer:
    """Score a PLAN of your own against the bound: efficiency, Table I residuals, expected standard deviations."""
    from doe.plan_file import load_plan
    from doe.problem import DesignProblem
    from doe.report.tables import design_tables
    from doe.solvers import score_plan
    from identification.arm_file import load_arm
    from identification.model import Model

    loaded = load_arm(arm)
    design = score_plan(DesignProblem.of(Model(loaded)), load_plan(plan, loaded.links))
    return Answer(design.to_json(), design_tables(loaded, design))
