"""`armcal validate`: how well a calibrated model predicts other measurements."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import Answer, CommonOptions, read_measurements, verb, warn_beside_json
from doe.cli.options import FILE, Output, output_options

REFITS = ("base", "offsets", "none")


@verb(
    "armcal validate calibrated.toml other_session.csv --picture transfer.png",
    "How well a calibrated model predicts other measurements.",
)
@click.argument("model", type=FILE)
@click.argument("data", type=FILE)
@click.option(
    "--refit",
    type=click.Choice(REFITS),
    default="base",
    show_default=True,
    help="What is fitted to DATA: where the base stands, that and all joint offsets, or nothing.",
)
@output_options(picture="Draw residuals against time and over the workspace (PNG, SVG, PDF).")
def command(common: CommonOptions, model: Path, data: Path, refit: str, output: Output) -> Answer:
    """Compare the calibrated MODEL (an arm file with [calibration]) with other measurements DATA.

    All that was identified stays as it is; the drawing, refitted in the same way, stands beside it. A session column
    in DATA has the base refitted in each session.
    """
    from doe.report.validation import better, validation_figure, validation_tables
    from doe.report.verdict import next_steps, validation_actions
    from identification.files.arm import load_arm
    from identification.validate import validate
    from identification.validate.row_groups import mostly_outside

    arm = load_arm(model)
    found = validate(arm, read_measurements(data, arm), refit)
    beyond = arm.chain is not None and mostly_outside(arm, found.measurements.postures)
    actions = validation_actions(better(found), refit, str(model), str(data), beyond=beyond)
    answer = Answer(found.to_json(), [*validation_tables(found), *next_steps(actions)])
    output.draw(lambda: validation_figure(found))
    warn_beside_json(f"{data}: {note}" for note in found.notes)
    return answer
