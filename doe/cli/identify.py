"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, out_option, read_measurements, verb


@verb("armcal identify arm.toml data.csv --out calibrated.toml")
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--method", help="linear, gauss_newton or paper_steps; left out: the best for the model.")
@out_option
@force_option
def command(session: Session, arm: Path, data: Path, method: str | None, out: Path | None, force: bool) -> Answer:
    """Estimate the arm's parameters from measurements, with 95 % intervals."""
    from doe.report.identification_tables import identification_tables
    from identification.estimation import estimate
    from identification.files.arm import load_arm, with_calibration
    from identification.files.io import check_writable, read_text, write_whole
    from identification.model import Model

    loaded = load_arm(arm)
    check_writable(out, force)
    measurements = read_measurements(data, loaded)
    found = estimate(Model(loaded), measurements, method=method)
    shown = identification_tables(found)
    if out is not None and found.not_identifiable:
        shown.append(f"{out} was not written: numbers that the data do not tell are no calibration")
    elif out is not None:
        write_whole(out, with_calibration(read_text(arm), found.calibration()), force=force)
        shown.append(f"calibrated arm written to {out}")
    return Answer(found.to_json(), shown, exit_code=1 if found.not_identifiable else 0)
