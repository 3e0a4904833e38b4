"""The commands of identification: files in, files out, and an `Answer` of what there is to say.

Each function is a verb of `armcal`, which its signature, its docstring and its example declare (doe/cli/verb.py), and
may be called from Python as well: `identify_files("arm.toml", "data.csv", out="calibrated.toml")`. Verbs take units of
files; those of one name without `_files` are the same of objects, in millimetres and radians. What they load is loaded
when they are called, so that `armcal --help` answers at once.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NewType, ParamSpec

from identification.document import Answer, Document, Files, in_a_sentence
from identification.errors import InputError, require
from identification.files.io import read_bytes, read_text, read_toml, write_together
from identification.running import Progress, Status

if TYPE_CHECKING:
    from identification.arm import Arm, Calibration, EffectSpec
    from identification.estimation import Identification
    from identification.gap.library_prior import LibraryPrior
    from identification.measurements import Measurements

P = ParamSpec("P")


class Declared(dict[str, tuple[Callable[..., Answer], str]]):
    """Name of a verb -> what it does, and an example of it."""

    def declare(self, example: str) -> Callable[[Callable[P, Answer]], Callable[P, Answer]]:
        """The function below is the verb of its example, `armcal NAME ...`; its files are written last, all or none."""

        def declared(function: Callable[P, Answer]) -> Callable[P, Answer]:
            @wraps(function)
            def verb(*arguments: P.args, **options: P.kwargs) -> Answer:
                answer = function(*arguments, **options)
                files = {path: file for path, file in answer.files.items() if path is not None}
                write_together({path: content for path, (_, content) in files.items()}, bool(options.get("force")))
                lines = [f"{what} written to {path}" for path, (what, _) in files.items()]
                answer.document = answer.document.plus(*lines)
                return answer

            self[example.split()[1]] = verb, example
            return verb

        return declared


VERBS = Declared()


def words(text: str) -> list[str]:
    """`a, b` as ["a", "b"]."""
    return [word.strip() for word in text.split(",")]


Written = NewType("Written", Path)  # a file that a verb writes
Folder = NewType("Folder", Path)  # that a verb writes files into
Names = Annotated[list[str], words, "NAMES"]
# of a model, postures and moves along others, where there are any: constraints, and what is known of collisions
Allowed = Callable[..., tuple[Sequence[Any], dict[str, Any], list[str]]]


# -- reading -----------------------------------------------------------------------------------------------------------
def load_sessions(paths: Sequence[Path], arm: Arm) -> Measurements:
    """The measurements of an arm from files, each a session of its file's name; warns of units that look wrong. Raises
    `InputError` where they certainly are, and for a file given twice."""
    import numpy as np

    from identification.files.measurement import load_measurements
    from identification.inspection.readings import data_warnings, read_differently
    from identification.measurements import pooled_sessions

    real = [os.path.realpath(path) for path in paths]
    for path, target in zip(paths, real, strict=True):
        require(real.count(target) <= 1, f"{path}: is given {real.count(target)} times, allowed: each session once")
    read = []
    for path in paths:
        read.append(load_measurements(path, arm))
        if (readings := read_differently(arm, read[-1], search=False)).certain:
            raise InputError(f"{path}: {readings.sentences[0]}")
        for sentence in data_warnings(read[-1], arm):
            warnings.warn(f"{path}: {sentence}", UserWarning, stacklevel=2)
    stems = [Path(path).stem for path in paths]
    names = [stem if stems.count(stem) == 1 else str(path) for path, stem in zip(paths, stems, strict=True)]
    if len(read) == 1:
        return read[0]
    if any(one.payload is not None for one in read):  # of the others it is that of the arm
        usual = (one.payload if one.payload is not None else np.full(len(one), arm.payload) for one in read)
        read = [replace(one, payload=payload) for one, payload in zip(read, usual, strict=True)]
    return pooled_sessions(dict(zip(names, read, strict=True)))


def arm_files(path: Path, effects: Sequence[EffectSpec], calibration: Calibration, out: Path, name: str) -> Files:
    """The arm file of `path` with these effects and this calibration, as `out`, and the files that it names, URDF with
    its meshes, SRDF and meshes of the cell, if not there yet."""
    from identification.files.arm import with_effects
    from identification.files.first_files import mesh_files

    folder, beside, table = Path(path).parent, Path(out).parent, read_toml(path)
    cell, urdf = table.get("cell", {}), table.get("urdf")
    named = [urdf, cell.get("srdf"), *(body.get("file") for body in cell.get("bodies", ()))]
    sources = {each: folder / each for each in named if each}
    if urdf and cell.get("bodies_of_urdf", True) and not beside.samefile(folder):
        sources |= {str(Path(urdf).parent / each): mesh for each, mesh in mesh_files(folder / urdf)[0].items()}
    files: Files = {out: (name, with_effects(read_text(path), effects, folder, calibration))}
    for each, source in sources.items():
        copy, content = beside / each, read_bytes(source)
        if not copy.exists() or copy.read_bytes() != content:
            copy.parent.mkdir(parents=True, exist_ok=True)
            files[copy] = "nominal URDF file" if each == urdf else "file of the cell", content
    return files


# -- the first files ---------------------------------------------------------------------------------------------------
@VERBS.declare("armcal init --urdf robot.urdf --out calibration")
def init_files(
    *,
    links: Annotated[str, "N|LENGTHS"] | None = None,
    robot: Annotated[Path, "--urdf"] | None = None,
    dh: Annotated[int, range(1, 13), "N"] | None = None,
    base_link: str | None = None,
    tip_link: str | None = None,
    package_dir: tuple[Path, ...] = (),
    instrument: Annotated[str, "KIND"] | None = None,
    out: Folder = Folder(Path(".")),  # noqa: B008
    force: bool = False,
) -> Answer:
    """Write the first files: arm, measurements, what to do.

    An arm file with comments, the columns of a measurement file, and the steps of a calibration. One of --links, --urdf
    and --dh says which arm; without any of them it is a planar one of three links.

    links : A planar arm: how many links (a whole number, 1 to 12), or their lengths [mm]: 612,572.3 or, of one, 612.0
    robot : A spatial arm from a URDF file.
    dh : A spatial arm from N Denavit-Hartenberg rows.
    base_link : First link of the chain in the URDF file; left out: its root.
    tip_link : Last link of the chain; left out: tool0, tcp .. or the end with the most joints.
    instrument : For a spatial arm without a tracker: distance (ball bar), sphere or plane (touch probe), socket (cups).
    out : Folder; created if missing.
    """
    from identification.files.first_files import ARM, GUIDES, STEPS, dh_files, mesh_files, planar_files, urdf_files

    sources = [name for name, value in (("--links", links), ("--urdf", robot), ("--dh", dh)) if value is not None]
    if len(sources) > 1:
        raise InputError(f"{sources[1]}: found with {sources[0]}, allowed: one of them")
    for name, value in (("--base-link", base_link), ("--tip-link", tip_link), ("--package-dir", package_dir)):
        require(not value or robot is not None, f"{name}: found without --urdf, allowed: with --urdf")
    if instrument is not None and robot is None and dh is None:
        raise InputError("--instrument: found for a planar arm, allowed: with --dh or --urdf")
    if instrument is not None and instrument not in GUIDES:
        raise InputError.unknown("--instrument: found", instrument, GUIDES)
    copied, missing = dict[str, Path](), list[str]()
    if robot is not None:
        files = urdf_files(robot, base_link, tip_link, instrument or "")
        copied, missing = mesh_files(robot, package_dir)
    else:
        files = planar_files(links or "3") if dh is None else dh_files(dh, instrument or "")
    new: dict[Path, str | bytes] = {out / name: text for name, text in files.items()}
    new |= {out / name: read_bytes(source) for name, source in copied.items()}
    for name, source in ({} if robot is None else {robot.name: robot} | copied).items():
        if (copy := out / name).exists() and copy.samefile(source):  # it stands there already
            del new[copy]
    try:
        for folder in {path.parent for path in (out / ARM, *new)}:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: {out} cannot be made ({error.strerror}), allowed: a folder") from None
    write_together(new, force)
    written = list(map(str, new))
    first = ("armcal design", "armcal check")  # of touches there is no plan
    step = next(line for word in first for line in files[STEPS].splitlines() if line.startswith(word))
    steps = [f"{out / STEPS} says what to do, step by step"]
    if "EXAMPLE" in files[ARM]:
        steps.append(f"replace what is marked EXAMPLE in {out / ARM}")
    if "\n[gravity]" in files[ARM]:
        upright = "the masses of the URDF file, with an upright base; if it is not upright, change [gravity]"
        steps.append(f"gravity: {upright}")
    if missing:
        looked = "plans will not check these links for collisions; armcal init --package-dir finds and copies meshes"
        steps.append(f"{len(missing)} meshes are not found as .stl or .obj, the first of them {missing[0]}: {looked}")
    steps.append(f"in {out}: {step.partition('  #')[0].rstrip()}")
    document = Document(parts=[f"written: {', '.join(written)}", *steps])
    return Answer({"directory": out, "files": written, "next": steps}, document)


# -- check, simulate ---------------------------------------------------------------------------------------------------
@VERBS.declare("armcal check arm.toml measurements.csv")
def check_files(
    arm: Path,
    data: Path,
    *,
    package_dir: tuple[Path, ...] = (),
    allowed: Allowed = lambda *_: ((), {}, []),
    progress: Progress = Progress(),
) -> Answer:
    """Are the measurements what they should be?

    Look at the measurements DATA of ARM, or at the postures of a plan, before anything is fitted in earnest.

    Rows, ranges against limits, units, repeats, the error of the drawing as placed best, joints that turn
    the other way, swapped columns, other zeros, mirrored frames, and what these data can and cannot determine.

    The exit code is 0 even if something must be corrected first: scripts read the key `ok` of --json.
    """
    import numpy as np

    from identification.files.arm import load_arm
    from identification.files.csv import read_table
    from identification.files.measurement import Plan, is_plan, load_measurements
    from identification.inspection.inspection import inspect
    from identification.model import Model

    loaded = load_arm(arm, package_dir)
    if is_plan(read_table(data), loaded):
        plan = Plan.load(data, loaded.joint_types, vias=True)
        q, moves = plan.measured, plan.postures if plan.weights is None else None
        kept, near, lines = allowed(Model(loaded), q, moves)
        walls = [each for each in kept if each.kind != "clearance"]
        missed = plan.missed(np.maximum(loaded.lower - q, q - loaded.upper), walls, 1e-3)
        summary = f"{data}: a plan of {len(q)} runs, {len(missed)} of them outside joint limits or constraints"
        summary += f": {', '.join(map(str, missed))}" if missed else ""
        lines = [*(f"  run {run}: {what}" for run, what in [*missed.items()][:10]), *lines]
        answers: dict[str, Any] = {"outside_limits": [*missed], "collisions": [], "moves": {"not_free": []}, **near}
        fine = not (missed or answers["collisions"] or answers["moves"]["not_free"])
        return Answer({"ok": fine, **answers}, Document(parts=[summary, *lines]))
    measurements = load_measurements(data, loaded)
    progress(0, None, f"trying readings of {len(measurements)} rows, and a fit of the geometry")
    inspection = inspect(loaded, measurements)
    first, of_row = np.unique(measurements.posture_numbers, return_index=True, return_inverse=True)[1:]
    _, near, lines = allowed(Model(loaded), measurements.postures[first[of_row]])  # repeats read back differ a little
    inspection.data.update(near)
    if "collisions" in near and inspection.data["better_reading"]:
        lines = ["Collisions: not checked, since the rows seem to be misread."]
    return Answer(inspection.to_json(), inspection.document(str(arm), str(data)).plus(*lines), inspection)


@VERBS.declare("armcal simulate arm.toml plan.csv --truth truth.toml --out data.csv")
def simulate_files(arm: Path, plan: Path, *, truth: Path, out: Written, force: bool = False, seed: int = 0) -> Answer:
    """Simulate the measurements of a plan.

    Measure the TRUTH at the postures of a PLAN, with the noise (sigma_mm) of TRUTH or, where that has none, of ARM. The
    plan may give payload_kg, temperature_C and direction1.. of every row.

    truth : Arm file with [calibration] and [[effects]] values.
    out : Measurements CSV to write.
    """
    import numpy as np

    from identification.effects import build_all
    from identification.files.arm import load_arm
    from identification.files.measurement import Plan, measurement_text
    from identification.kinematics.chain import TOOL
    from identification.model import Model
    from identification.simulate import simulate

    loaded, true_arm = load_arm(arm), load_arm(truth)
    require(true_arm.links == loaded.links, f"{truth}: {true_arm.links} links, allowed: {loaded.links} as in {arm}")
    if true_arm.dimension < loaded.dimension or true_arm.joint_types != loaded.joint_types:
        kinds = [f"{a.chain.kind}, {', '.join(a.joint_types)}" for a in (true_arm, loaded)]
        raise InputError(f"{truth}: found an arm that is {kinds[0]}, allowed: {kinds[1]} as in {arm}")
    wanted = Plan.load(plan, loaded.joint_types)
    require(wanted.weights is None, f"{plan}: found weights, allowed: an exact plan, each row a measurement")
    sigma = true_arm.sigma if true_arm.sigma is not None else loaded.sigma
    if sigma is None:
        raise InputError(f"{arm}: measurement.sigma_mm is missing, allowed: a number > 0 [mm], here or in {truth}")
    calibrated = {} if true_arm.calibration is None else true_arm.calibration.effects
    for effect, spec in zip(build_all(true_arm.effects, true_arm.chain), true_arm.effects, strict=True):
        if not effect.scatter and not any(p.short in spec.values or p.name in calibrated for p in effect.parameters):
            keys = ", ".join(p.toml_key for p in effect.parameters)
            warnings.warn(f"{truth}: {effect.key} has no value and does nothing; it has {keys}", stacklevel=2)
    chain, known = true_arm.chain, Model(true_arm).best_known
    lost = [name for name, at in chain.tools.items() if not at[:3, 3].any() and not known.get(f"{TOOL}[{name}].x")]
    if chain.point_column and lost and TOOL not in chain.settled:
        place = "0, 0, 0 mm in the frame of the tip, where armcal design assumes it 100 mm beside the last axis"
        warnings.warn(f"{truth}: no [tool]: what is measured is at {place}; give [tool] in both files", stacklevel=2)
    with InputError.at(truth):
        data = simulate(true_arm, wanted.postures, np.random.default_rng(seed), sigma=sigma, **wanted.conditions)
    text = measurement_text(replace(data, fit=wanted.fit), loaded.joint_types, loaded.chain.instrument)
    summary = {"rows": len(data), "links": data.links, "sigma_mm": sigma, "out": out}
    return Answer(summary, result=data, files={out: (f"{len(data)} measurements, sigma {sigma:g} mm,", text)})


# -- identify ----------------------------------------------------------------------------------------------------------
@VERBS.declare("armcal identify arm.toml data.csv --out calibrated.toml")
def identify_files(
    arm: Path,
    data: Path,
    *,
    prior: Annotated[bool | None, "--library-prior/--no-library-prior"] = None,
    missing: Names | None = None,
    prior_from: Path | None = None,
    only: tuple[Names, ...] = (),
    without_outliers: bool = False,
    urdf: Written | None = None,
    out: Written | None = None,
    force: bool = False,
    progress: Progress = Progress(),
) -> Answer:
    """Estimate the arm's parameters from measurements.

    With 95 % intervals. If a column session distinguishes sessions, each gets its own base; the file has that of the
    first. With --only all other parameters stay at the values of ARM.

    prior : Fit the library's effects too, each held by a prior of its typical size, or not; left out: as the plan asks.
    missing : Only these effects, for --library-prior: backlash,gear_ratio
    prior_from : An earlier calibration with its covariance as the prior.
    only : Estimate only these, with commas: lengths, joint_offsets, base, tool, effects, names such as joint_offset:2.
    without_outliers : Leave out rows that the model does not explain, and say which.
    urdf : Write the corrected URDF file of a spatial arm.
    out : Write a calibrated arm file (TOML).
    """
    from identification import estimation, reuse
    from identification.arm import SESSIONS
    from identification.documents import identification as shown
    from identification.estimation.doubts import left_out_residuals
    from identification.estimation.problem import Prior
    from identification.estimation.repeats import with_repeats_doubted
    from identification.estimation.result import corrected_geometry
    from identification.files.arm import corrected_urdf, load_arm
    from identification.gap.library_prior import library_prior
    from identification.measurements import rms_distance
    from identification.model import Model
    from identification.model.placed import with_all_markers, with_sessions, without_prior_effects, without_sessions
    from identification.simulate import with_servo_errors
    from identification.validate import drawing_residuals, prior_judged

    # the arm and its rows
    loaded, chosen, keys, lines = load_arm(arm), [word for each in only for word in each], dict[str, Any](), list[str]()
    if urdf is not None:  # before the fit, as it would be written of the drawing
        corrected_urdf(arm, corrected_geometry(loaded.chain, {}))
        for each in filter(None, (arm, out)):
            if os.path.realpath(Path(each).parent / str(read_toml(arm).get("urdf"))) == os.path.realpath(urdf):
                state = f"{urdf} is the drawing that {each} names, which would be corrected twice"
                raise InputError(f"--urdf: {state}, allowed: another name")
    old = None if prior_from is None else load_arm(prior_from)
    measurements = load_sessions([data], loaded)
    loaded, servo_errors = with_servo_errors(loaded, measurements)
    keys |= {"servo_error": servo_errors} if servo_errors else {}
    reference = (old or loaded).provenance.get("mean_temperature_C")
    if reference is not None and (old or chosen or any(effect.values for effect in loaded.effects)):
        # where something is held, temperatures count from those that it was found at
        measurements = replace(measurements, reference=float(reference))
    loaded = with_all_markers(loaded, measurements) if chosen else loaded

    # with the library's prior, as the options, the plan or an earlier fit say
    meant, how = f"{data} says # fit: {measurements.fit}", "with the prior of the library, as the plan was designed"
    asked, bare = measurements.fit, loaded if chosen else without_prior_effects(loaded)
    if not asked and bare is not loaded:
        asked, meant, how = "library-prior", f"{arm} comes from such a fit", "with the prior of the library again"
    if asked:
        refused = "--no-library-prior" if prior is False else "--only" if chosen and not prior else None
        keys["fit"] = {"asked": asked, "followed": refused is None, "against": refused}
        if refused is None:
            prior, listed = True, asked.partition("--missing ")[2]
            missing = missing or (words(listed) if listed else None)
            lines.append(f"Fitted {how}: {meant} (--no-library-prior fits without).")
        else:
            why = f"because of {refused}, although {meant}: the expected error of the plan is for a fit with it"
            lines.append(f"Not fitted with the prior of the library, {why}.")
    require(missing is None or prior, "--missing: found without --library-prior, allowed: with --library-prior")

    @cache  # asked for again, for what is said of it
    def library(rows: Measurements) -> LibraryPrior | None:
        return library_prior(with_sessions(bare, rows), rows, missing) if prior else None

    def fit(rows: Measurements) -> Identification:
        effects = library(rows)
        wide, held = (with_sessions(bare, rows), Prior()) if effects is None else (effects.arm, effects.prior)
        model = reuse.only(wide, [*chosen, *held.deviations], rows) if chosen else Model(wide)
        if old is not None:
            with InputError.at(prior_from):
                held = replace(held, earlier=reuse.earlier(old, model, rows))
        return with_repeats_doubted(estimation.estimate(model, rows, prior=held), rows)

    # the fit
    progress(0, None, f"fitting {len(measurements)} rows")
    if without_outliers:
        fitted, left_out = estimation.without_outliers(fit, measurements)
        keys["left_out"] = list(left_out)
        rows = measurements.rows([k for k in range(len(measurements)) if k + 1 not in left_out])
        numbers = ", ".join(map(str, left_out))
        lines.append(f"Left out as outliers: {f'rows {numbers}' if numbers else 'no row'}.")
    else:
        fitted, rows = fit(measurements), measurements
    if old is not None:
        free = [name for name in fitted.names if name not in {*fitted.prior.names, *fitted.model.prior}]
        contradicted = [] if fitted.contradiction is None else [fitted.contradiction._asdict()]
        keys["prior_from"] = {"file": str(prior_from), "parameters": list(fitted.prior.earlier.parameter_names)}
        keys["prior_from"] |= {"anew": free, "contradicted": contradicted}
        without = f"; without a prior: {', '.join(free)}" if free else ""
        lines.append(f"Prior: {len(fitted.prior.earlier.parameter_names)} parameters from {prior_from}{without}.")
    if chosen:
        keys["only"] = chosen
        fitted = reuse.with_base_doubt(fitted, with_sessions(bare, rows), chosen, rows)
        fitted = reuse.with_held(fitted, bare.calibration, rows)
        exact = "taken as exact: their errors are in no interval and no expected error"
        off = "and their uncertainty there is in intervals and expected error" if fitted.held else exact
        lines.append(f"Estimated: {', '.join(chosen)}; the others stay as in the arm file, {off}.")

    # beside the drawing, and beside the geometry alone
    doubts, hidden = [*fitted.warnings], frozenset[str]()  # parameters of the library's effects
    predicted, firsts = left_out_residuals(fitted, rows), sorted({*rows.originals.tolist()})  # copies do not count
    if (effects := library(rows)) is not None:
        typical, hidden = effects.prior.deviations, frozenset(effects.prior.deviations)
        share = next((size / typical[name] for name, size in fitted.prior.deviations.items() if name in typical), 1.0)
        keys["prior"] = effects.to_json() | {"share": share}
        lines.append(effects.sentence + (f"; {share:g} times these sizes are likeliest" if share != 1.0 else ""))
        if not chosen and old is None:
            geometry = Model(with_sessions(bare, rows))
            keys["offered"] = prior_judged(lambda: estimation.estimate(geometry, rows), predicted, rows)
            doubts += shown.hardly_better(keys)
    crossed = None if predicted is None else rms_distance(predicted[firsts])
    result = fitted.to_json() | {"cross_validated_mm": crossed, "rms_drawing_mm": None}
    with suppress(InputError):  # too few rows
        result["rms_drawing_mm"] = rms_distance(drawing_residuals(bare, rows))
    result |= shown.unit_key(fitted.arm) | {key: value for key, value in keys.items() if value is not None}
    result["parameters"] = [row for row in result["parameters"] if row["name"] not in hidden]

    # the files, all or none
    asked_for, files, refusal = [path for path in (out, urdf) if path is not None], Files(), ""
    if fitted.not_identifiable:
        refusal = "not every parameter is estimable from the data"
    elif fitted.status is Status.implausible and not force:
        refusal = "the fit is implausible; --force writes it anyway"
    if fitted.not_identifiable or (refusal and asked_for):
        lines += [f"{path} was not written: {refusal}" for path in asked_for]
        return Answer(result, fitted.document(result, hidden).plus(*lines), fitted, 1, doubts)
    if out is not None:
        calibration = without_sessions(fitted.calibration().about(set(fitted.names) - hidden))
        for before in (bare.calibration if fitted.held else None, None if old is None else old.calibration):
            calibration = reuse.with_data_of(calibration, before, bare.joint_types)
        if chosen and loaded.calibration is not None:  # of several points the first is that of commands
            order, tools = (*loaded.calibration.tools, *calibration.tools), calibration.tools
            calibration = replace(calibration, tools={name: tools[name] for name in order if name in tools})
        specs = [spec for spec in fitted.model.arm.effects if spec.name != SESSIONS]
        files |= arm_files(arm, specs, calibration, out, "calibrated arm")
    if urdf is not None:
        files[urdf] = "corrected URDF file", corrected_urdf(arm, fitted.geometry)
        labels = ", ".join(effect.label for effect in fitted.model.effects)
        lines += [f"a URDF file has no effects: {labels} left out"] if labels else []
    document = fitted.document(result, hidden).plus(*lines)
    actions = shown.identification_actions(result, str(arm), str(data), out, diagnosed=Model(bare).complete)
    return Answer(result, replace(document, actions=actions), fitted, warnings=doubts, files=files)


# -- diagnose ----------------------------------------------------------------------------------------------------------
@VERBS.declare("armcal diagnose arm.toml data.csv --holdout more.csv --report gap.html")
def diagnose_files(
    arm: Path,
    data: tuple[Path, ...],
    *,
    holdout: Path | None = None,
    report: Written | None = None,
    named_only: bool = False,
    out: Written | None = None,
    force: bool = False,
    seed: int = 0,
    progress: Progress = Progress(),
    page: Callable[[Document, Sequence[Path]], str] = lambda document, _: document._repr_html_(),
) -> Answer:
    """Find and name the effect that the model lacks.

    Find where model and measurements disagree, name the missing effect, and show the gap shrink. Several files DATA
    are sessions of one arm, as are rows that a column session distinguishes: each session gets its own base, and
    each named effect is compared between them.

    holdout : Measurements used only for the confirmation.
    report : Write an HTML page with pictures.
    named_only : Write only what is named, without less likely effects and error curves.
    out : Write the arm file of the model that predicts best; with --force even if it is not confirmed.
    """
    from identification.documents.diagnosis import holds_in_words, implausible, refuted, tests_of
    from identification.files.arm import load_arm
    from identification.gap.diagnose import diagnose
    from identification.measurements import rms_distance
    from identification.simulate import with_servo_errors
    from identification.validate import drawing_residuals, judged

    loaded = load_arm(arm)
    if models := [path for path in data if Path(path).suffix.lower() == ".toml"]:
        raise InputError(f"{models[0]}: found an arm file among the data, allowed: files of measurements")
    measurements = load_sessions(data, loaded)
    held_out = None if holdout is None else load_sessions([holdout], loaded)
    loaded, _ = with_servo_errors(loaded, measurements)
    diagnosis = judged(diagnose(loaded, measurements, held_out, seed, progress), loaded, measurements, held_out)
    result, names, files, lines = diagnosis.to_json(), [*map(str, (arm, *data))], Files(), list[str]()
    against = [f"not confirmed: {holds_in_words(test)[1]}" for test in tests_of(result) if test["confirmed"] is False]
    refusal = "the fit is implausible" if implausible(result) else "not confirmed" if refuted(result) else ""
    if out is not None and refusal and not force:
        warnings.warn(f"{out} was not written: {refusal}; --force writes it anyway", stacklevel=2)
    elif out is not None:
        model = diagnosis.extended_arm(diagnosis.named if named_only else None)
        assert model.calibration is not None  # a diagnosis has one
        files |= arm_files(arm, model.effects, model.calibration, out, "extended arm")
        if named_only:
            left = f"it leaves {in_a_sentence(diagnosis.named.rms)} mm RMS of the data"
            lines.append(f"{out} has what is named alone: {left}; other figures are of the model that predicts best")
    if report is not None:
        nominal = rms_distance(drawing_residuals(diagnosis.arm, measurements))
        read = [arm, *data, *([] if holdout is None else [holdout])]
        files[report] = "page", page(diagnosis.document(names, out, nominal), read)
    document, doubts = diagnosis.document(names, out).plus(*lines), [*diagnosis.warnings, *against[:1], *lines]
    failed = out is not None and not force and implausible(result)
    return Answer(result | {"files": names}, document, diagnosis, int(failed), doubts, files)


# -- a calibration in use ----------------------------------------------------------------------------------------------
@VERBS.declare("armcal validate calibrated.toml other_session.csv")
def validate_files(model: Path, data: Path, *, refit: Literal["base", "offsets", "none"] = "base") -> Answer:
    """How well a calibrated model predicts other measurements.

    Compare the calibrated MODEL (an arm file with [calibration]) with other measurements DATA. What was identified
    stays as it is; the drawing, refitted in the same way, is shown for comparison. With a column session in DATA the
    base is refitted in each session.

    refit : What is fitted to DATA: base pose and measured points, these and all joint offsets, or nothing.
    """
    from identification.documents.identification import validation_actions
    from identification.files.arm import load_arm
    from identification.validate import validate

    arm = load_arm(model)
    arm.require_calibrated(str(model))
    validation = validate(arm, load_sessions([data], arm), refit)
    result = validation.to_json()
    actions = validation_actions(result, str(model), str(data))
    notes = [f"{data}: {note}" for note in validation.notes]
    return Answer(result, replace(validation.document(), actions=actions), validation, warnings=notes)


@VERBS.declare("armcal compensate calibrated.toml targets.csv --out commands.csv")
def compensate_files(
    calibrated: Path,
    targets: Path,
    *,
    out: Written | None = None,
    force: bool = False,
    package_dir: tuple[Path, ...] = (),
    allowed: Allowed = lambda *_: ((), {}, []),
) -> Answer:
    """Joint commands that reach targets on the real arm.

    TARGETS are x_mm,y_mm or nominal q1_deg.. on the CALIBRATED arm; in space with z_mm, and rx_deg, ry_deg, rz_deg
    or a quaternion where the tool's orientation matters. Targets are in the frame of the measurements that
    calibrated the arm (of a ball bar or a probe: of the arm's base). Commands keep to the joint limits and the
    [[constraints]] of the arm file; where that is impossible, the row says why and has no angles. A warning counts the
    targets that need joint angles outside those of the identification, where the model extrapolates.

    out : Write the joint commands (CSV).
    """
    from identification.compensate import compensate
    from identification.files.arm import load_arm
    from identification.files.measurement import load_targets
    from identification.model import Model

    arm = load_arm(calibrated, package_dir)
    arm.require_calibrated(str(calibrated))
    kept, near, lines = allowed(Model(arm))
    commands = compensate(arm, **load_targets(targets, arm), constraints=kept)
    files: Files = {out: ("commands", commands.text())}
    document = commands.document().plus(*lines)
    return Answer(commands.to_json() | near, document, commands, warnings=commands.warnings, files=files)


# -- the library -------------------------------------------------------------------------------------------------------
@VERBS.declare("armcal effects joint_compliance")
def effects(name: str | None = None) -> Answer:
    """The physical effects that armcal knows, and the data that each needs.

    A list of the library, or everything about the effect NAME: formula, parameters with units and typical sizes,
    which data or tables it needs and how to give them, and how to write it in an arm file. Effects of installed
    packages (entry points armcal.effects) are in the list.
    """
    from identification.documents.identification import entry_document, library_document
    from identification.effects import entry, library

    if name is not None:
        effect = entry(name.partition(":")[0])
        return Answer(effect, entry_document(effect))
    listed = [entry(each) for each in library()]
    return Answer({"effects": listed}, library_document(listed))
