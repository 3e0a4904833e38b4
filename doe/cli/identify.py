"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from doe.cli.common import Answer, Session, read_measurements, verb
from doe.cli.options import FILE, LibraryEffects, Output, output_options, prior_options
from identification.errors import InputError
from identification.status import Status

if TYPE_CHECKING:
    from identification.estimation import Identification
    from identification.gap.library_prior import LibraryPrior


@verb("armcal identify arm.toml data.csv --out calibrated.toml", "Estimate the arm's parameters from measurements.")
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--method", help="linear, gauss_newton or paper_steps; left out: the best for the model.")
@click.option(
    "--sigma",
    type=click.Choice(["given", "estimated"]),
    help="What intervals rely on: sigma_mm, or the residuals. Left out: sigma_mm, unless chi2 rejects it.",
)
@prior_options
@output_options(out="Write a calibrated arm file (TOML).")
def command(
    session: Session,
    arm: Path,
    data: Path,
    method: str | None,
    sigma: Literal["given", "estimated"] | None,
    prior: LibraryEffects,
    output: Output,
) -> Answer:
    """Estimate the arm's parameters from measurements, with 95 % intervals.

    Where a column session tells sessions apart, each gets a base of its own; the file has that of the first.
    """
    from identification.estimation import estimate, estimate_with_prior
    from identification.files.arm import load_arm
    from identification.gap.library_prior import given_by, library_prior
    from identification.model import Model
    from identification.sessions import with_sessions

    loaded = load_arm(arm)
    measurements = read_measurements(data, loaded)
    wide = with_sessions(loaded, measurements)
    if not prior.held:
        found = estimate(Model(wide), measurements, method=method, sigma=sigma)
        return answer(found, arm, output)
    if method not in (None, "gauss_newton"):
        raise InputError(f"--method: {method} with --prior, allowed: gauss_newton")
    library = library_prior(wide, given_by(measurements), prior.names)
    found = estimate_with_prior(library.model, measurements, library.prior, sigma=sigma)
    return answer(found, arm, output, library)


def answer(found: Identification, path: Path, output: Output, library: LibraryPrior | None = None) -> Answer:
    """What is said of a fit, and the file with it where it is asked for and the fit is worth it."""
    from doe.report.identification_tables import identification_tables

    for sentence in found.warnings:
        warnings.warn(sentence, UserWarning, stacklevel=2)
    hidden, data = frozenset(library.prior.deviations if library else ()), found.to_json()
    shown = identification_tables(found, hidden)
    if library is not None:
        data |= {"prior": library.to_json()}
        data["parameters"] = [row for row in data["parameters"] if row["name"] not in hidden]
        shown.append(library.sentence)
    if output.out is None:
        return Answer(data, shown, exit_code=1 if found.not_identifiable else 0)
    if (reason := no_file(found, output.force)) is not None:
        return Answer(data, [*shown, f"{output.out} was not written: {reason}"], exit_code=1)
    return Answer(data, shown + output.write(arm_file(found, path, hidden), "calibrated arm"))


def arm_file(found: Identification, path: Path, hidden: frozenset[str]) -> str:
    """The text of the arm file with the calibration, and with the effects that the fit has beyond the file's.

    hidden : parameters whose covariance is left out
    """
    from identification.files.arm_text import with_calibration, with_effects
    from identification.files.io import read_text
    from identification.sessions import SESSIONS, without_sessions

    effects = [spec for spec in found.model.arm.effects if spec.name != SESSIONS]
    kept = found.calibration().about(set(found.names) - hidden)
    return with_calibration(with_effects(read_text(path), effects), without_sessions(kept))


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
