"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from doe.cli import calibrated
from doe.cli.common import Answer, CommonOptions, read_measurements, verb, warn_beside_json
from doe.cli.options import File, LibraryEffects, Names, OutFile
from identification.errors import InputError

if TYPE_CHECKING:
    from identification.arm import Arm
    from identification.arrays import Array
    from identification.estimation import Identification
    from identification.estimation.prior import Earlier, Prior
    from identification.gap.library.library_prior import LibraryPrior
    from identification.measurements import Measurements
    from identification.model import Model
    from identification.servo import FollowingError


class PriorOrFile(click.Command):
    """A command that reads `--prior FILE` as `--prior-from FILE`, since the flag --prior leaves a word too many."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As in click; if that fails, parse again with --prior-from in the place of --prior."""
        words = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            places = [k for k, word in enumerate(words) if word.partition("=")[0] == "--prior"]
            if len(places) != 1:
                raise
            words[places[0]] = words[places[0]].replace("--prior", "--prior-from", 1)
            ctx.params.clear()
            try:
                return super().parse_args(ctx, words)
            except click.UsageError:
                raise error from None


@verb("armcal identify arm.toml data.csv --out calibrated.toml", PriorOrFile)
def command(
    common: CommonOptions,
    arm: File,
    data: File,
    *,
    method: str | None = None,
    sigma: Literal["given", "estimated"] | None = None,
    prior: LibraryEffects,
    prior_from: File | None = None,
    only: tuple[Names, ...] = (),
    parameters: Literal["minimal", "all"] | None = None,
    without_outliers: bool = False,
    full: bool = False,
    urdf: OutFile | None = None,
    out: OutFile | None = None,
    force: bool = False,
) -> Answer:
    """Estimate the arm's parameters from measurements.

    With 95 % intervals. Where a column session distinguishes sessions, each gets a base of its own; the file has that
    of the first. With --only all other parameters stay at the values of ARM.

    method : linear, gauss_newton or paper_steps; left out: the best for the model.
    sigma : What intervals rely on: sigma_mm, or the residuals. Left out: sigma_mm, unless chi2 rejects it.
    prior_from : An earlier calibration with its covariance as the prior; --prior FILE is the same.
    only : Estimate only these, with commas: lengths, joint_offsets, base, tool, effects, names such as joint_offset:2.
    parameters : Of a spatial arm: all errors of its geometry, held by [machining] (left out: this), or as many as are
        free.
    without_outliers : Leave rows out that nothing of the model explains, and say which.
    full : Print every corrected value of a spatial arm, also those hardly determined.
    urdf : Write the corrected URDF file of a spatial arm.
    out : Write a calibrated arm file (TOML).
    force : Overwrite an existing file.
    """
    from doe.report.verdict import hardly_better
    from identification.estimation import estimate
    from identification.files.arm import load_arm
    from identification.model import Model
    from identification.servo import following_errors
    from identification.sessions import with_sessions
    from identification.validate.judgement import prior_judged
    from identification.validate.reuse import with_place_doubted, words_of
    from identification.validate.set_up import with_mounting_doubted

    loaded, words = load_arm(arm), words_of(only)
    for option, value in (("--parameters", parameters), ("--urdf", urdf)):
        if value is not None and loaded.chain is None:
            raise InputError(f"{option}: found for a planar arm, allowed: for spatial arms")
    old = None if prior_from is None else load_arm(prior_from)
    loaded, measurements = arm_and_rows(loaded, data, old, words)
    prior, asked = as_asked(prior, measurements, method, parameters)
    wanted = Wanted(words, prior, prior_from, method, sigma, parameters == "minimal")
    common.report(0, None, f"fitting {len(measurements)} rows")
    found, library, said = (wanted.without_outliers if without_outliers else wanted.fit)(loaded, measurements)
    fitted = rows_fitted(measurements, said)
    if words:
        found = with_place_doubted(found, with_sessions(loaded, fitted), words, fitted)
    before, found = found, with_mounting_doubted(found, fitted, lambda rows: wanted.fit(loaded, rows)[0])
    mounted_anew = found is not before
    offered = None
    if library is not None and not words and old is None:
        offered = prior_judged(lambda: estimate(Model(with_sessions(loaded, fitted)), fitted), found, fitted)
    extra, shown = fit_shown(found, (arm, loaded), fitted, words, library, full=full or old is not None)
    kept = loaded.calibration if words else None, None if old is None else old.calibration
    answered = calibrated.fit_answer(found, shown, arm, (out, urdf), force, library, *kept)
    answered.data |= extra | said | ({} if asked is None else {"fit": asked})
    answered.shown += [*([] if asked is None else [asked_in_words(asked, data)]), *wanted.sentences(said)]
    if offered is not None:
        answered.data["offered"] = offered.to_json()
        if not offered.better:
            answered.shown.insert(0, hardly_better(answered.data["offered"]))
            warn_beside_json([hardly_better(answered.data["offered"])])
    answered = with_commands(answered, following_errors(measurements, loaded.joint_types))
    better = offered is None or offered.better
    told = {"allowed_for": library is not None, "better": better, "mounted_anew": mounted_anew}
    return with_next(answered, (arm, data), out, loaded, **told)


def as_asked(
    prior: LibraryEffects, measurements: Measurements, method: str | None, parameters: str | None
) -> tuple[LibraryEffects, dict[str, Any] | None]:
    """The prior of the library that the plan of these rows asks for, unless an option says otherwise; and key `fit`,
    None where the plan does not ask."""
    if not measurements.fit:
        return prior, None
    refused = {
        "--no-library-prior": prior.prior is False,
        f"--method {method}": method not in (None, "gauss_newton"),
        "--parameters minimal": parameters == "minimal",
    }
    against = None if prior.prior else next((option for option, given in refused.items() if given), None)
    if prior.prior is None and against is None:
        names = measurements.fit.partition("--missing ")[2]
        prior = LibraryEffects(True, prior.missing or names or None)
    return prior, {"asked": measurements.fit, "followed": against is None, "against": against}


def asked_in_words(asked: dict[str, Any], data: Path) -> str:
    """Whether the fit is the one that the plan is meant for."""
    meant = f"{data} says # fit: {asked['asked']}"
    if asked["followed"]:
        return f"Fitted with the prior of the library, as the plan is meant: {meant} (--no-library-prior fits without)."
    promise = "what the plan promises is of a fit with it"
    return f"Not fitted with the prior of the library, because of {asked['against']}, although {meant}: {promise}."


def arm_and_rows(arm: Arm, path: Path, old: Arm | None, words: Sequence[str]) -> tuple[Arm, Measurements]:
    """The arm, with the servo errors that the data show, and its measurements.

    Where something is held, temperatures count from those that it was found at;  old : that is the prior
    """
    from identification.servo import with_servo_errors
    from identification.validate.reuse import at_reference

    measurements = read_measurements(path, arm)
    arm = with_servo_errors(arm, measurements)
    if old or words or any(effect.values for effect in arm.effects):
        measurements = at_reference(measurements, old or arm)
    return arm, measurements


def rows_fitted(measurements: Measurements, said: dict[str, Any]) -> Measurements:
    """The measurements but for the outliers left out, so that the error before a fit is that of the rows fitted."""
    kept = [k for k in range(len(measurements)) if k + 1 not in said.get("left_out", ())]
    return measurements if len(kept) == len(measurements) else measurements.rows(kept)


def with_next(answered: Answer, files: Sequence[Path], out: Path | None, arm: Arm, **told: bool) -> Answer:
    """The answer with the next steps, if there is a calibration; files, told : see `identification_actions`."""
    from doe.report.verdict import identification_actions, next_steps
    from identification.validate.row_groups import diagnosed

    if answered.exit_code == 0:
        told["diagnosed"] = diagnosed(arm)
        answered.shown += next_steps(identification_actions(str(files[0]), str(files[1]), out, **told))
    return answered


def fit_shown(
    found: Identification,
    arm: tuple[Path, Arm],
    data: Measurements,
    words: Sequence[str],
    library: LibraryPrior | None,
    *,
    full: bool,
) -> tuple[dict[str, Any], list[Any]]:
    """JSON keys beside those of a fit, and its tables;  full : every value, as where [machining] holds none."""
    from doe.report.identification_tables import identification_tables
    from identification.estimation.left_out import left_out_rms
    from identification.measurements import rms_distance

    drawing, left, dh = drawing_left(arm[1], data), left_out_rms(found, data), calibrated.dh_of(found, arm[0])
    rms, known = None if drawing is None else rms_distance(drawing), arm[1].calibration is not None
    nominal = rms if known and words and set(words) <= {"base", "tool"} else None
    before, full = None if known or words else drawing, full or found.machining_factor is None
    shown = identification_tables(found, calibrated.hidden_by(library), nominal, left, drawing=before, full=full, dh=dh)
    extra = {"cross_validated_mm": left, "rms_drawing_mm": rms} | ({} if nominal is None else {"rms_nominal_mm": rms})
    return extra | ({"dh_table": [row.to_json() for row in dh[0]], "dh_places": dh[1]} if dh[0] else {}), shown


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
        from identification.gap.library.library_prior import given_by, library_prior
        from identification.gap.noise import with_repeats_doubted
        from identification.sessions import with_sessions

        wide = with_sessions(arm, data)
        library = library_prior(wide, given_by(data), self.prior.names) if self.prior.held else None
        model = self.model(wide if library is None else library.arm, data, library)
        if library is None and self.prior_from is None:
            model = minimal_model(model, data) if self.minimal else model
            found = estimate(model, data, method=self.method, sigma=self.sigma)
            return with_repeats_doubted(found, data), None, self.said(model)
        check_with_prior(self.minimal, self.method)
        prior = replace(Prior({}) if library is None else library.prior, earlier=self.earlier(model, data))
        found, said = estimate_with_prior(model, data, prior, sigma=self.sigma), self.said(model, prior)
        if prior.earlier is not None:
            said["prior_from"]["contradicted"] = [one.to_json() for one in found.contradictions]
        library = replace(library, together=found.prior.together) if library and found.prior else library
        return with_repeats_doubted(found, data), library, said

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
        from identification.validate.reuse import only

        added = [] if library is None else list(library.prior.deviations)
        return only(arm, [*self.words, *added], data) if self.words else Model(arm)

    def earlier(self, model: Model, data: Measurements) -> Earlier | None:
        """The prior of the model's parameters from the calibration that --prior-from names."""
        from identification.files.arm import load_arm
        from identification.validate.reuse import earlier

        if self.prior_from is None:
            return None
        before = load_arm(self.prior_from)
        try:
            return earlier(before, model, data)
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


def drawing_left(arm: Arm, measurements: Measurements) -> Array | None:
    """(m, d) residuals [mm] of the drawing, where it stands fitted; None with too few rows."""
    from identification.validate import drawing_residuals

    try:
        return drawing_residuals(arm, measurements)
    except InputError:
        return None


def check_with_prior(minimal: bool, method: str | None) -> None:
    """Raise `InputError` for options that a fit with a prior does not have."""
    if minimal:
        raise InputError("--parameters: minimal with --prior, allowed: all")
    if method not in (None, "gauss_newton"):
        raise InputError(f"--method: {method} with --prior, allowed: gauss_newton")


def with_commands(said: Answer, errors: tuple[FollowingError, ...]) -> Answer:
    """The answer with the servo errors (readings less commands) added, if the data have both."""
    from doe.report.identification_tables import servo_table

    if errors:
        said.data["servo_error"] = [error.to_json() for error in errors]
        said.shown.append(servo_table(errors))
    return said


def minimal_model(model: Model, measurements: Measurements) -> Model:
    """The model reduced to parameters that the measurements determine; warns of those that are hardly determined."""
    from identification.kinematics.instrument import SPHERE
    from identification.model.minimal import PRACTICAL, minimal_of

    if model.arm.chain is not None and not model.arm.chain.instrument.shows_size:
        surface = "spheres of unknown radius" if model.arm.chain.instrument.kind == SPHERE else "planes"
        found = f"minimal for contacts with {surface}, which leave the size of the arm open"
        raise InputError(f"--parameters: found {found}, allowed: all, with the prior of [machining]")
    kept = minimal_of(model, measurements, PRACTICAL)
    if hardly := [name for name in minimal_of(model, measurements).names if name not in kept.names]:
        left = f"{', '.join(hardly)} would move no coordinate by {PRACTICAL:g} mm RMS"
        warnings.warn(f"left as drawn, {len(kept.names)} parameters stay: {left}", UserWarning, stacklevel=2)
    return kept
