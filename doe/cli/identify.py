"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import Answer, Session, read_measurements, verb
from doe.cli.options import FILE, Output, output_options


@verb("armcal identify arm.toml data.csv --out calibrated.toml", "Estimate the arm's parameters from measurements.")
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--method", help="linear, gauss_newton or paper_steps; left out: the best for the model.")
@output_options(out="Write a calibrated arm file (TOML).")
def command(session: Session, arm: Path, data: Path, method: str | None, output: Output) -> Answer:
    """Estimate the arm's parameters from measurements, with 95 % intervals."""
    from doe.report.identification_tables import identification_tables
    from identification.estimation import estimate
    from identification.files.arm import load_arm
    from identification.files.arm_text import with_calibration
    from identification.files.io import read_text
    from identification.model import Model

    loaded = load_arm(arm)
    measurements = read_measurements(data, loaded)
    found = estimate(Model(loaded), measurements, method=method)
    shown = identification_tables(found)
    if output.out is not None and found.not_identifiable:
        shown.append(f"{output.out} was not written: not every parameter is estimable from the data")
    elif output.out is not None:
        shown += output.write(with_calibration(read_text(arm), found.calibration()), "calibrated arm")
    return Answer(found.to_json(), shown, exit_code=1 if found.not_identifiable else 0)
