"""`armcal validate`: how well a calibrated model predicts other measurements."""

from __future__ import annotations

from typing import Literal

from doe.cli.common import Answer, CommonOptions, read_measurements, verb, warn_beside_json
from doe.cli.options import File, Picture, written


@verb("armcal validate calibrated.toml other_session.csv --picture transfer.png")
def command(
    common: CommonOptions,
    model: File,
    data: File,
    *,
    refit: Literal["base", "offsets", "none"] = "base",
    picture: Picture | None = None,
    force: bool = False,
) -> Answer:
    """How well a calibrated model predicts other measurements.

    Compare the calibrated MODEL (an arm file with [calibration]) with other measurements DATA. All that was identified
    stays as it is; the drawing, refitted in the same way, stands beside it. A session column in DATA has the base
    refitted in each session.

    refit : What is fitted to DATA: where the base stands, that and all joint offsets, or nothing.
    picture : Draw residuals against time and over the workspace (PNG, SVG, PDF).
    force : Overwrite an existing file.
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
    written({picture: lambda: validation_figure(found)}, force)
    warn_beside_json(f"{data}: {note}" for note in found.notes)
    return answer
