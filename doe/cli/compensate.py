"""`armcal compensate`: joint commands for the real arm."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import Answer, CommonOptions, verb, warn_beside_json
from doe.cli.options import FILE, Output, output_options
from identification.errors import InputError


@verb(
    "armcal compensate calibrated.toml targets.csv --out commands.csv",
    "Joint commands that reach targets on the real arm.",
)
@click.argument("calibrated", type=FILE)
@click.argument("targets", type=FILE)
@output_options(out="Write the joint commands (CSV).")
def command(common: CommonOptions, calibrated: Path, targets: Path, output: Output) -> Answer:
    """Joint commands that reach TARGETS (x_mm,y_mm or nominal q1_deg..) on the CALIBRATED arm.

    In space with z_mm, and rx_deg, ry_deg, rz_deg or a quaternion where the tool's orientation matters. Targets are
    in the frame of the measurements that calibrated the arm (of a ball bar or a probe: of the arm's base). Commands
    keep to the joint limits and the [[constraints]] of the arm file; where that cannot be, the row says why and has no
    angles. A warning counts the targets that need joint angles outside those of the identification, where the model
    extrapolates.
    """
    from doe.problem.constraints import constraints_of
    from doe.report.identification import compensation_document
    from identification.compensate import compensate
    from identification.files.arm import load_arm
    from identification.files.target import commands_text, load_targets
    from identification.model import Model

    arm = load_arm(calibrated)
    if arm.calibration is None and not any(effect.values for effect in arm.effects):
        raise InputError(f"{calibrated}: has no [calibration], allowed: an arm file written by `armcal identify --out`")
    wanted = load_targets(targets, arm)
    allowed = constraints_of(Model(arm)) if arm.constraints else ()
    found = compensate(arm, wanted.positions, wanted.postures, orientations=wanted.orientations, constraints=allowed)
    warn_beside_json(found.warnings)
    columns = found.targets, found.left, arm.joint_types, found.orientations, found.left_angles, found.reached
    written = output.write(commands_text(found.safe_commands, *columns, found.messages), "commands")
    return Answer(found.to_json(), [compensation_document(found).plus(*written)])
