"""`armcal compensate`: joint commands for the real arm."""

from __future__ import annotations

from doe.cli.common import Answer, CommonOptions, verb, warn_beside_json
from doe.cli.options import File, OutFile, written


@verb("armcal compensate calibrated.toml targets.csv --out commands.csv")
def command(
    common: CommonOptions, calibrated: File, targets: File, *, out: OutFile | None = None, force: bool = False
) -> Answer:
    """Joint commands that reach targets on the real arm.

    TARGETS are x_mm,y_mm or nominal q1_deg.. on the CALIBRATED arm; in space with z_mm, and rx_deg, ry_deg, rz_deg
    or a quaternion where the tool's orientation matters. Targets are in the frame of the measurements that
    calibrated the arm (of a ball bar or a probe: of the arm's base). Commands keep to the joint limits and the
    [[constraints]] of the arm file; where that cannot be, the row says why and has no angles. A warning counts the
    targets that need joint angles outside those of the identification, where the model extrapolates.

    out : Write the joint commands (CSV).
    force : Overwrite an existing file.
    """
    from doe.problem.constraints import constraints_of
    from identification.compensate import compensate
    from identification.files.arm import load_arm
    from identification.files.target import commands_text, load_targets
    from identification.model import Model
    from identification.validate.row_groups import check_calibrated

    arm = load_arm(calibrated)
    check_calibrated(arm, str(calibrated))
    wanted = load_targets(targets, arm)
    allowed = constraints_of(Model(arm)) if arm.constraints else ()
    commands = compensate(arm, wanted.positions, wanted.postures, orientations=wanted.orientations, constraints=allowed)
    warn_beside_json(commands.warnings)
    columns = (
        commands.targets,
        commands.left,
        arm.joint_types,
        commands.orientations,
        commands.left_angles,
        commands.reached,
    )
    lines = written({out: commands_text(commands.safe_commands, *columns, commands.messages)}, force, "commands")
    return Answer(commands.to_json(), [commands.document().plus(*lines)])
