"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from doe.cli.common import Answer, Session, read_measurements, verb
from doe.cli.options import FILE, Output, output_options
from identification.errors import InputError
from identification.status import Status

if TYPE_CHECKING:
    from identification.arm import Arm
    from identification.estimation import Identification
    from identification.measurements import Measurements


@verb("armcal identify arm.toml data.csv --out calibrated.toml", "Estimate the arm's parameters from measurements.")
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--method", help="linear, gauss_newton or paper_steps; left out: the best for the model.")
@click.option(
    "--sigma",
    type=click.Choice(["given", "estimated"]),
    help="What intervals rely on: sigma_mm, or the residuals. Left out: sigma_mm, unless chi2 rejects it.",
)
@click.option("--prior", is_flag=True, help="Fit the library's effects too, each with a prior of its typical size.")
@click.option("--missing", metavar="NAMES", help="Only these effects, for --prior: backlash,gear_ratio")
@output_options(out="Write a calibrated arm file (TOML).")
def command(
    session: Session,
    arm: Path,
    data: Path,
    method: str | None,
    sigma: Literal["given", "estimated"] | None,
    prior: bool,
    missing: str | None,
    output: Output,
) -> Answer:
    """Estimate the arm's parameters from measurements, with 95 % intervals.

    Where a column session tells sessions apart, each gets a base of its own; the file has that of the first.
    """
    from doe.report.identification_tables import identification_tables
    from identification.estimation import estimate
    from identification.files.arm import load_arm
    from identification.files.arm_text import with_calibration, with_effects
    from identification.files.io import read_text
    from identification.model import Model
    from identification.sessions import with_base, with_sessions, without_sessions

    loaded = load_arm(arm)
    measurements = read_measurements(data, loaded)
    if prior:
        if method not in (None, "gauss_newton"):
            raise InputError(f"--method: {method} with --prior, allowed: gauss_newton")
        return with_prior(arm, loaded, measurements, sigma, missing, output)
    if missing is not None:
        raise InputError("--missing: found without --prior, allowed: with --prior")
    found = estimate(Model(with_sessions(loaded, measurements)), measurements, method=method, sigma=sigma)
    for sentence in found.warnings:
        warnings.warn(sentence, UserWarning, stacklevel=2)
    shown, failed = identification_tables(found), bool(found.not_identifiable)
    if output.out is not None and (reason := no_file(found, output.force)) is not None:
        shown.append(f"{output.out} was not written: {reason}")
        failed = True
    elif output.out is not None:
        text = read_text(arm) if found.model.arm is loaded else with_effects(read_text(arm), with_base(loaded).effects)
        shown += output.write(with_calibration(text, without_sessions(found.calibration())), "calibrated arm")
    return Answer(found.to_json(), shown, exit_code=1 if failed else 0)


def with_prior(
    path: Path,
    arm: Arm,
    measurements: Measurements,
    sigma: Literal["given", "estimated"] | None,
    missing: str | None,
    output: Output,
) -> Answer:
    """The fit with the library's effects; the parameters of the arm's own model are shown, all are written."""
    from doe.report.identification_tables import identification_tables
    from identification.estimation import estimate_with_prior
    from identification.files.arm_text import with_calibration, with_effects
    from identification.files.io import read_text
    from identification.gap.library_prior import given_by, library_prior
    from identification.sessions import with_base, with_sessions, without_sessions

    names = None if missing is None else [word.strip() for word in missing.split(",")]
    library = library_prior(with_sessions(arm, measurements), given_by(measurements), names)
    found = estimate_with_prior(library.model, measurements, library.prior, sigma=sigma)
    for sentence in found.warnings:
        warnings.warn(sentence, UserWarning, stacklevel=2)
    hidden = frozenset(library.prior.deviations)
    data = found.to_json() | {"prior": library.to_json()}
    data["parameters"] = [row for row in data["parameters"] if row["name"] not in hidden]
    shown = [*identification_tables(found, hidden), library.sentence]
    if output.out is not None and (reason := no_file(found, output.force)) is not None:
        return Answer(data, [*shown, f"{output.out} was not written: {reason}"], exit_code=1)
    if output.out is not None:
        base = with_base(arm).effects if library.arm.effects[: len(arm.effects)] != arm.effects else arm.effects
        text = with_effects(read_text(path), (*base, *library.added))
        kept = without_sessions(found.calibration().about(set(found.names) - hidden))
        shown += output.write(with_calibration(text, kept), "calibrated arm")
    return Answer(data, shown, exit_code=1 if found.not_identifiable else 0)


def no_file(found: Identification, force: bool) -> str | None:
    """Why a fit is not written into an arm file, None where it is."""
    if found.not_identifiable:
        return "not every parameter is estimable from the data"
    if found.status is not Status.implausible:
        return None
    lengths = (found.model.arm.lengths + found.length_errors).tolist()
    if min(lengths) <= 0.0:
        return f"link {lengths.index(min(lengths)) + 1} would have no positive length"
    return None if force else "the fit is implausible; --force writes it all the same"
