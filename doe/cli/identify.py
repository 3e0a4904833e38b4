"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from doe.cli.common import Answer, Session, read_measurements, verb, warn_beside_json
from doe.cli.options import FILE, LibraryEffects, Output, PriorOrFile, only_option, output_options, prior_options
from identification.errors import InputError
from identification.status import Status

if TYPE_CHECKING:
    from identification.arm import Arm, Calibration
    from identification.estimation import Identification
    from identification.estimation.prior import Earlier, Prior
    from identification.gap.library_prior import LibraryPrior
    from identification.measurements import Measurements
    from identification.model import Model
    from identification.servo import ServoError


@verb(
    "armcal identify arm.toml data.csv --out calibrated.toml",
    "Estimate the arm's parameters from measurements.",
    PriorOrFile,
)
@click.argument("arm", type=FILE)
@click.argument("data", type=FILE)
@click.option("--method", help="linear, gauss_newton or paper_steps; left out: the best for the model.")
@click.option(
    "--sigma",
    type=click.Choice(["given", "estimated"]),
    help="What intervals rely on: sigma_mm, or the residuals. Left out: sigma_mm, unless chi2 rejects it.",
)
@prior_options
@click.option(
    "--prior-from",
    type=FILE,
    metavar="FILE",
    help="An earlier calibration with its covariance as the prior; --prior FILE is the same.",
)
@only_option
@click.option(
    "--parameters",
    type=click.Choice(["minimal", "all"]),
    help="Of a spatial arm: all errors of its geometry, held by [machining] (left out: this), or as many as are free.",
)
@click.option(
    "--without-outliers", is_flag=True, help="Leave rows out that nothing of the model explains, and say which."
)
@click.option("--urdf", type=FILE, metavar="FILE", help="Write the corrected URDF file of a spatial arm.")
@output_options(out="Write a calibrated arm file (TOML).")
def command(
    session: Session,
    arm: Path,
    data: Path,
    method: str | None,
    sigma: Literal["given", "estimated"] | None,
    prior: LibraryEffects,
    prior_from: Path | None,
    only: tuple[str, ...],
    parameters: str | None,
    without_outliers: bool,
    urdf: Path | None,
    output: Output,
) -> Answer:
    """Estimate the arm's parameters from measurements, with 95 % intervals.

    Where a column session distinguishes sessions, each gets a base of its own; the file has that of the first. With
    --only all other parameters stay at the values of ARM.
    """
    from identification.files.arm import load_arm
    from identification.reuse import words_of
    from identification.servo import servo_errors, with_servo_errors

    loaded, words = load_arm(arm), words_of(only)
    for option, value in (("--parameters", parameters), ("--urdf", urdf)):
        if value is not None and loaded.chain is None:
            raise InputError(f"{option}: found for a planar arm, allowed: for spatial arms")
    measurements = read_measurements(data, loaded)
    loaded, errors = with_servo_errors(loaded, measurements), servo_errors(measurements, loaded.joint_types)
    wanted = Wanted(words, prior, prior_from, method, sigma, parameters == "minimal")
    session.report(0, None, f"fitting {len(measurements)} rows")
    found, library, said = (wanted.without_outliers if without_outliers else wanted.fit)(loaded, measurements)
    before = loaded.calibration if words else None
    answered = answer(found, arm, output, urdf, library, before)
    answered.data |= said
    answered.shown += wanted.sentences(said)
    return with_commands(answered, errors)


@dataclass(frozen=True)
class Wanted:
    """What to estimate, and with which prior.

    words : of --only, empty: everything;  minimal : a minimal set of a spatial arm's parameters
    """

    words: list[str]
    prior: LibraryEffects
    prior_from: Path | None
    method: str | None
    sigma: Literal["given", "estimated"] | None
    minimal: bool

    def fit(self, arm: Arm, data: Measurements) -> tuple[Identification, LibraryPrior | None, dict[str, Any]]:
        """The fit, the library's effects in it, and what more is said in JSON."""
        from identification.estimation import estimate, estimate_with_prior
        from identification.estimation.prior import Prior
        from identification.gap.library_prior import given_by, library_prior
        from identification.sessions import with_sessions

        wide = with_sessions(arm, data)
        library = library_prior(wide, given_by(data), self.prior.names) if self.prior.held else None
        model = self.model(wide if library is None else library.arm, data, library)
        if library is None and self.prior_from is None:
            model = minimal_model(model, data) if self.minimal else model
            return estimate(model, data, method=self.method, sigma=self.sigma), None, self.said(model)
        check_with_prior(self.minimal, self.method)
        prior = Prior({} if library is None else library.prior.deviations, self.earlier(model))
        found, said = estimate_with_prior(model, data, prior, sigma=self.sigma), self.said(model, prior)
        if prior.earlier is not None:
            said["prior_from"]["contradicted"] = [one.to_json() for one in found.contradictions]
        return found, library, said

    def without_outliers(
        self, arm: Arm, data: Measurements
    ) -> tuple[Identification, LibraryPrior | None, dict[str, Any]]:
        """The fit to the rows that are no outliers of it; key `left_out`: the others, from 1."""
        from identification.estimation import without_outliers

        fits = []

        def fit(rows: Measurements) -> Identification:
            fits.append(self.fit(arm, rows))
            return fits[-1][0]

        found, left_out = without_outliers(fit, data)
        return found, fits[-1][1], {**fits[-1][2], "left_out": list(left_out)}

    def model(self, arm: Arm, data: Measurements, library: LibraryPrior | None) -> Model:
        """The model of all parameters, or of those that --only names; the library's effects are always estimated."""
        from identification.model import Model
        from identification.reuse import only

        added = [] if library is None else list(library.prior.deviations)
        return only(arm, [*self.words, *added], data) if self.words else Model(arm)

    def earlier(self, model: Model) -> Earlier | None:
        """The prior of the model's parameters from the calibration that --prior-from names."""
        from identification.files.arm import load_arm
        from identification.reuse import earlier

        if self.prior_from is None:
            return None
        calibrated = load_arm(self.prior_from)
        try:
            return earlier(calibrated, model)
        except InputError as error:
            raise InputError(f"{self.prior_from}: {error}") from None

    def said(self, model: Model, prior: Prior | None = None) -> dict[str, Any]:
        """The JSON keys `only` and `prior_from`, if these options were given."""
        found: dict[str, Any] = {"only": self.words} if self.words else {}
        if prior is not None and prior.earlier is not None:
            names = list(prior.earlier.names)
            anew = [name for name in model.names if name not in prior.names and name not in model.prior]
            found["prior_from"] = {"file": str(self.prior_from), "parameters": names, "anew": anew}
        return found

    def sentences(self, said: dict[str, Any]) -> list[str]:
        """The same for people."""
        found = [f"Estimated: {', '.join(self.words)}; the others stay as in the arm file."] if self.words else []
        if "left_out" in said:
            rows = ", ".join(map(str, said["left_out"]))
            found.append(f"Left out as outliers: {f'rows {rows}' if rows else 'no row'}.")
        if (prior := said.get("prior_from")) is not None:
            anew = f"; without a prior: {', '.join(prior['anew'])}" if prior["anew"] else ""
            found.append(f"Prior: {len(prior['parameters'])} parameters from {prior['file']}{anew}.")
        return found


def check_with_prior(minimal: bool, method: str | None) -> None:
    """Raise `InputError` for options that a fit with a prior does not have."""
    if minimal:
        raise InputError("--parameters: minimal with --prior, allowed: all")
    if method not in (None, "gauss_newton"):
        raise InputError(f"--method: {method} with --prior, allowed: gauss_newton")


def with_commands(said: Answer, errors: tuple[ServoError, ...]) -> Answer:
    """The answer with the servo errors (readings less commands) added, if the data have both."""
    from doe.report.identification_tables import servo_table

    if errors:
        said.data["servo_error"] = [error.to_json() for error in errors]
        said.shown.append(servo_table(errors))
    return said


def minimal_model(model: Model, measurements: Measurements) -> Model:
    """The model reduced to parameters that the measurements determine; warns of those that are hardly determined."""
    from identification.minimal import PRACTICAL, minimal
    from identification.placed import placed_model

    placed = placed_model(model, measurements)
    found = minimal(placed, PRACTICAL)
    if hardly := [name for name in minimal(placed).names if name not in found.names]:
        left = f"{', '.join(hardly)} would move no coordinate by {PRACTICAL:g} mm RMS"
        warnings.warn(f"left as drawn, {len(found.names)} parameters stay: {left}", UserWarning, stacklevel=2)
    return found


def answer(
    found: Identification,
    path: Path,
    output: Output,
    urdf: Path | None,
    library: LibraryPrior | None = None,
    before: Calibration | None = None,
) -> Answer:
    """The answer for a fit; writes the requested files unless the fit is not good enough (`no_file`).

    before : the earlier calibration; parameters that were not estimated keep its covariance and its data
    """
    from doe.report.identification_tables import identification_tables

    warn_beside_json(found.warnings)
    hidden, data = frozenset(library.prior.deviations if library else ()), found.to_json()
    shown = identification_tables(found, hidden)
    if library is not None:
        data |= {"prior": library.to_json()}
        data["parameters"] = [row for row in data["parameters"] if row["name"] not in hidden]
        shown.append(library.sentence)
    wanted = [name for name in (output.out, urdf) if name is not None]
    if not wanted:
        return Answer(data, shown, exit_code=1 if found.not_identifiable else 0)
    if (reason := no_file(found, output.force)) is not None:
        return Answer(data, [*shown, *(f"{name} was not written: {reason}" for name in wanted)], exit_code=1)
    return Answer(data, shown + write(found, path, output, urdf, hidden, before))


def write(
    found: Identification,
    path: Path,
    output: Output,
    urdf: Path | None,
    hidden: frozenset[str],
    before: Calibration | None = None,
) -> list[str]:
    """Write the calibrated arm and the corrected URDF file, all or none, and return the lines that report them."""
    from identification.files.arm_text import urdf_beside
    from identification.files.io import PathLike, write_together

    files: dict[PathLike, str | bytes] = {}
    if output.out is not None:
        files[output.out] = arm_file(found, path, hidden, before)
    if found.geometry is not None:
        from identification.files.arm_spatial import corrected_urdf

        files |= urdf_beside(path, output.out)
        files |= {} if urdf is None else {urdf: corrected_urdf(path, found.geometry.real)}
    write_together(files, force=output.force)
    what = {output.out: "calibrated arm", urdf: "corrected URDF file"}
    lines = [f"{what.get(Path(name), 'nominal URDF file')} written to {name}" for name in files]
    if urdf is not None and found.model.effects:
        lines.append(
            f"a URDF file has no effects: {', '.join(effect.label for effect in found.model.effects)} left out"
        )
    return lines


def arm_file(found: Identification, path: Path, hidden: frozenset[str], before: Calibration | None = None) -> str:
    """Text of the arm file with the calibration added, and with effects of the fit that the file lacks.

    hidden : parameters whose covariance is left out;  before : see `answer`
    """
    from identification.files.arm_text import with_calibration, with_effects
    from identification.files.io import read_text
    from identification.reuse import with_held
    from identification.sessions import SESSIONS, without_sessions

    effects = [spec for spec in found.model.arm.effects if spec.name != SESSIONS]
    own = found.calibration().about(set(found.names) - hidden)
    kept = with_held(own, before, found.model.arm.joint_types)
    text = with_effects(read_text(path), effects, path.parent)
    return with_calibration(text, without_sessions(kept), path.parent)


def no_file(found: Identification, force: bool) -> str | None:
    """The reason why a fit is not written into an arm file, or None if it is."""
    if found.not_identifiable:
        return "not every parameter is estimable from the data"
    if found.status is not Status.implausible:
        return None
    lengths = [] if found.geometry else (found.model.arm.lengths + found.length_errors).tolist()
    if lengths and min(lengths) <= 0.0:
        return f"link {lengths.index(min(lengths)) + 1} would have no positive length"
    return None if force else "the fit is implausible; --force writes it all the same"
