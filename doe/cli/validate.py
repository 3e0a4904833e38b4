"""`armcal validate`: how well a calibrated model predicts other measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from doe.cli.common import Answer, CommonOptions, read_measurements, verb, warn_beside_json
from doe.cli.options import File, Picture, written

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from identification.validate import Validation


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
    from identification.documents.use import is_better, validation_actions
    from identification.files.arm import load_arm
    from identification.validate import validate
    from identification.validate.row_groups import check_calibrated, mostly_outside

    arm = load_arm(model)
    check_calibrated(arm, str(model))
    validation = validate(arm, read_measurements(data, arm), refit)
    beyond = not arm.chain.planar and mostly_outside(arm, validation.measurements.postures)
    data_of = validation.to_json()
    actions = validation_actions(is_better(data_of), refit, str(model), str(data), beyond=beyond)
    answer = Answer(data_of, [replace(validation.document(), actions=actions)])
    written({picture: lambda: validation_drawing(validation)}, force)
    warn_beside_json(f"{data}: {note}" for note in validation.notes)
    return answer


def validation_drawing(validation: Validation) -> Figure:
    """Residuals against time and over the workspace."""
    from identification.documents.pictures import (
        validation_figure,  # deferred: matplotlib takes longer to load than a validation
    )

    return validation_figure(validation)
