"""`armcal compensate`: joint commands for the real arm."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, out_option, verb


@verb("armcal compensate calibrated.toml targets.csv --out commands.csv")
@click.argument("calibrated", type=FILE)
@click.argument("targets", type=FILE)
@out_option
@force_option
def command(session: Session, calibrated: Path, targets: Path, out: Path | None, force: bool) -> Answer:
    """Joint commands that reach TARGETS (x_mm,y_mm or nominal q1_deg..) on the CALIBRATED arm."""
    from doe.report.identification_tables import compensation_tables
    from identification.compensate import compensate
    from identification.errors import InputError
    from identification.files.arm import load_arm
    from identification.files.io import check_writable, write_whole
    from identification.files.target import commands_text, load_targets

    arm = load_arm(calibrated)
    if arm.calibration is None and not any(effect.values for effect in arm.effects):
        raise InputError(f"{calibrated}: has no [calibration], allowed: an arm file written by `armcal identify --out`")
    check_writable(out, force)
    wanted = load_targets(targets, arm.links)
    found = compensate(arm, wanted.positions, wanted.postures)
    shown = compensation_tables(found)
    if out is not None:
        write_whole(out, commands_text(found.commands, found.targets, found.errors), force=force)
        shown.append(f"commands written to {out}")
    return Answer(found.to_json(), shown)
