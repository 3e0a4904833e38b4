"""`armcal identify`: from measurements to parameters."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from doe.cli.common import Answer, CommonOptions, read_measurements, verb, warn_beside_json
from doe.cli.options import File, LibraryEffects, Names, OutFile
from identification.errors import InputError
from identification.status import Status

if TYPE_CHECKING:
    from identification.arm import Arm, Calibration
    from identification.estimation import Identification
    from identification.gap.library.library_prior import LibraryPrior
    from identification.measurements import Measurements
    from identification.model import Model


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
    from identification.documents.identification import hardly_better, identification_actions, identification_document
    from identification.estimation import estimate
    from identification.estimation import without_outliers as without
    from identification.files.arm import load_arm
    from identification.model import Model
    from identification.servo import following_errors, with_servo_errors
    from identification.sessions import with_sessions
    from identification.validate.reuse import at_reference, with_base_doubt, with_mounting_doubt, words_of
    from identification.validate.row_groups import diagnosed
    from identification.validate.validation import prior_judged

    loaded, words = load_arm(arm), words_of(only)
    for option, value in (("--parameters", parameters), ("--urdf", urdf)):
        if value is not None and loaded.chain.planar:
            raise InputError(f"{option}: found for a planar arm, allowed: for spatial arms")
    old = None if prior_from is None else load_arm(prior_from)
    measurements = read_measurements(data, loaded)
    loaded = with_servo_errors(loaded, measurements)
    if old or words or any(effect.values for effect in loaded.effects):
        # where something is held, temperatures count from those that it was found at
        measurements = at_reference(measurements, old or loaded)
    prior, asked = as_asked(prior, measurements, method, parameters)
    wanted = Wanted(words, prior, prior_from, old, method, sigma, parameters == "minimal")
    common.report(0, None, f"fitting {len(measurements)} rows")
    fits, fitted, left_out_keys = [wanted.fit(loaded, measurements)] if not without_outliers else [], measurements, {}
    if without_outliers:

        def fit(rows: Measurements) -> Identification:
            fits.append(wanted.fit(loaded, rows))
            return fits[-1][0]

        _, left_out = without(fit, measurements)
        left_out_keys = {"left_out": list(left_out)}
        fitted = measurements.rows([k for k in range(len(measurements)) if k + 1 not in left_out])
    identified, library, of_fit = fits[-1]
    if words:
        identified = with_base_doubt(identified, with_sessions(loaded, fitted), words, fitted)
    before, identified = identified, with_mounting_doubt(identified, fitted, lambda rows: wanted.fit(loaded, rows)[0])
    mounted_anew = identified is not before
    offered = None
    if library is not None and not words and old is None:
        offered = prior_judged(lambda: estimate(Model(with_sessions(loaded, fitted)), fitted), identified, fitted)
    warn_beside_json(identified.warnings)
    hidden = frozenset(library.prior.deviations if library else ())  # parameters of the library's effects
    answer = Answer(identified.to_json() | fit_data(identified, arm, loaded, fitted, words) | of_fit | left_out_keys)
    if library is not None:
        answer.data |= {"prior": library.to_json()}
        answer.data["parameters"] = [row for row in answer.data["parameters"] if row["name"] not in hidden]
        answer.shown.append(library.sentence)
    kept = loaded.calibration if words else None, None if old is None else old.calibration
    if (reason := no_file(identified, force)) is not None and (out or urdf):
        answer.shown += [f"{name} was not written: {reason}" for name in (out, urdf) if name is not None]
        answer.exit_code = 1
    elif out or urdf:
        answer.shown += write_calibrated(identified, arm, (out, urdf), force, hidden, kept)
    else:
        answer.exit_code = 1 if identified.not_identifiable else 0
    if asked is not None:
        answer.data["fit"] = asked
        answer.shown.append(asked_in_words(asked, data))
    answer.shown += in_words(answer.data)
    better = offered is None or offered.better
    if offered is not None:
        answer.data["offered"] = offered.to_json()
        warn_beside_json([] if better else [hardly_better(answer.data["offered"])])
    if errors := following_errors(measurements, loaded.joint_types):
        answer.data["servo_error"] = [error.to_json() for error in errors]
    every = full or old is not None or identified.machining_factor is None  # as where [machining] holds no value
    document = identification_document(identified, answer.data, hidden, full=every)
    told = {"allowed_for": library is not None, "better": better, "mounted_anew": mounted_anew}
    actions = identification_actions(str(arm), str(data), out, diagnosed=diagnosed(loaded), **told)
    answer.shown = [replace(document.plus(*answer.shown), actions=[] if answer.exit_code else actions)]
    return answer


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
    against = None if prior.prior else next((option for option, refuses in refused.items() if refuses), None)
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


def in_words(data: dict[str, Any]) -> list[str]:
    """What the JSON keys `only`, `left_out` and `prior_from` say."""
    sentences = []
    if words := data.get("only"):
        sentences.append(f"Estimated: {', '.join(words)}; the others stay as in the arm file.")
    if "left_out" in data:
        rows = ", ".join(map(str, data["left_out"]))
        sentences.append(f"Left out as outliers: {f'rows {rows}' if rows else 'no row'}.")
    if (prior := data.get("prior_from")) is not None:
        free = f"; without a prior: {', '.join(prior['anew'])}" if prior["anew"] else ""
        sentences.append(f"Prior: {len(prior['parameters'])} parameters from {prior['file']}{free}.")
    return sentences


def fit_data(fit: Identification, path: Path, arm: Arm, data: Measurements, words: list[str]) -> dict[str, Any]:
    """JSON keys beside those of a fit;  path : of the arm file;  words : of --only."""
    from identification.estimation.corrected_values import Calibrated
    from identification.estimation.expected_tip import left_out_rms
    from identification.measurements import rms_distance
    from identification.validate import drawing_residuals
    from identification.workflow import dh_table

    try:
        drawing = rms_distance(drawing_residuals(arm, data))
    except InputError:  # too few rows
        drawing = None
    extra = {"cross_validated_mm": left_out_rms(fit, data), "rms_drawing_mm": drawing}
    if arm.calibration is not None and words and set(words) <= {"base", "tool"} and drawing is not None:
        extra["rms_nominal_mm"] = drawing
    if fit.geometry is None or fit.not_identifiable:
        return extra
    rows, places = dh_table(Calibrated.of(fit), fit.corrected_values, path)
    return extra | ({"dh_table": [row.to_json() for row in rows], "dh_places": places} if rows else {})


@dataclass(frozen=True)
class Wanted:
    """What to estimate, and with which prior.

    words : of --only, empty: everything;  old : the arm that `prior_from` names
    minimal : a minimal set of a spatial arm's parameters
    """

    words: list[str]
    prior: LibraryEffects
    prior_from: Path | None
    old: Arm | None
    method: str | None
    sigma: Literal["given", "estimated"] | None
    minimal: bool

    def fit(self, arm: Arm, data: Measurements) -> tuple[Identification, LibraryPrior | None, dict[str, Any]]:
        """The fit, the library's effects in it, and the JSON keys `only` and `prior_from`."""
        from identification.estimation import estimate, estimate_with_prior
        from identification.estimation.prior import Prior
        from identification.gap.library.library_prior import given_by, library_prior
        from identification.gap.noise import with_repeats_doubted
        from identification.model import Model
        from identification.sessions import with_sessions
        from identification.validate.reuse import earlier, only

        wide = with_sessions(arm, data)
        library = library_prior(wide, given_by(data), self.prior.names) if self.prior.held else None
        wide = wide if library is None else library.arm
        free = [] if library is None else list(library.prior.deviations)  # the library's effects always are
        model = only(wide, [*self.words, *free], data) if self.words else Model(wide)
        keys: dict[str, Any] = {"only": self.words} if self.words else {}
        if library is None and self.old is None:
            model = minimal_model(model, data) if self.minimal else model
            identified = estimate(model, data, method=self.method, sigma=self.sigma)
            return with_repeats_doubted(identified, data), None, keys
        if self.minimal:
            raise InputError("--parameters: minimal with --prior, allowed: all")
        if self.method not in (None, "gauss_newton"):
            raise InputError(f"--method: {self.method} with --prior, allowed: gauss_newton")
        prior = Prior({}) if library is None else library.prior
        if self.old is not None:
            try:
                prior = replace(prior, earlier=earlier(self.old, model, data))
            except InputError as error:
                raise InputError(f"{self.prior_from}: {error}") from None
        identified = estimate_with_prior(model, data, prior, sigma=self.sigma)
        if prior.earlier is not None:
            keys["prior_from"] = {
                "file": str(self.prior_from),
                "parameters": list(prior.earlier.names),
                "anew": [name for name in model.names if name not in prior.names and name not in model.prior],
                "contradicted": [one.to_json() for one in identified.contradictions],
            }
        return with_repeats_doubted(identified, data), library, keys


def minimal_model(model: Model, measurements: Measurements) -> Model:
    """The model reduced to parameters that the measurements determine; warns of those that are hardly determined."""
    from identification.model.minimal import PRACTICAL, minimal_of

    readings, _ = model.arm.chain.instrument.size_is_open
    if readings:
        reduced = f"minimal for {readings}, which leave the size of the arm open"
        raise InputError(f"--parameters: found {reduced}, allowed: all, with the prior of [machining]")
    kept = minimal_of(model, measurements, PRACTICAL)
    if hardly := [name for name in minimal_of(model, measurements).names if name not in kept.names]:
        left = f"{', '.join(hardly)} would move no coordinate by {PRACTICAL:g} mm RMS"
        warnings.warn(f"left as drawn, {len(kept.names)} parameters stay: {left}", UserWarning, stacklevel=2)
    return kept


# -- files -------------------------------------------------------------------------------------------------------------
def no_file(fit: Identification, force: bool) -> str | None:
    """The reason why a fit is not written into an arm file, or None if it is."""
    if fit.not_identifiable:
        return "not every parameter is estimable from the data"
    if fit.status is not Status.implausible:
        return None
    lengths = [] if fit.geometry else (fit.model.arm.lengths + fit.length_errors).tolist()
    if lengths and min(lengths) <= 0.0:
        return f"link {lengths.index(min(lengths)) + 1} would have no positive length"
    return None if force else "the fit is implausible; --force writes it all the same"


def write_calibrated(
    fit: Identification,
    path: Path,
    names: tuple[Path | None, Path | None],
    force: bool,
    hidden: frozenset[str],
    kept: tuple[Calibration | None, Calibration | None],
) -> list[str]:
    """Write the calibrated arm and the corrected URDF file (`names`), all or none; the lines that report them.

    path : of the arm file, which gets the calibration, and the effects of the fit that it lacks
    hidden : parameters whose covariance is left out
    kept : the calibration before, of which parameters that were not estimated keep covariance and data, and the one
        that was the prior
    """
    from identification.files.arm_chain import corrected_urdf
    from identification.files.arm_text import urdf_beside, with_calibration, with_effects
    from identification.files.io import PathLike, read_text, write_together
    from identification.sessions import SESSIONS, without_sessions
    from identification.validate.reuse import with_data_of, with_held

    out, urdf = names
    files: dict[PathLike, str | bytes] = {}
    if out is not None:
        kinds = fit.model.arm.joint_types
        calibration = with_held(fit.calibration().about(set(fit.names) - hidden), kept[0], kinds)
        calibration = without_sessions(with_data_of(calibration, kept[1], kinds))
        effects = [spec for spec in fit.model.arm.effects if spec.name != SESSIONS]
        files[out] = with_calibration(with_effects(read_text(path), effects, path.parent), calibration, path.parent)
    if fit.geometry is not None:
        files |= urdf_beside(path, out)
        files |= {} if urdf is None else {urdf: corrected_urdf(path, fit.geometry.real)}
    write_together(files, force=force)
    what = {out: "calibrated arm", urdf: "corrected URDF file"}
    lines = [f"{what.get(Path(name), 'nominal URDF file')} written to {name}" for name in files]
    if urdf is not None and fit.model.effects:
        left_out = ", ".join(effect.label for effect in fit.model.effects)
        lines.append(f"a URDF file has no effects: {left_out} left out")
    return lines
