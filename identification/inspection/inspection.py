"""What measurements are like before any fit: ranges, frames, signs, whether they are enough.

With few rows the residuals hardly say what the noise is. The accuracy is then that of the sigma that is given, or of
what repeats scatter by; where neither is known, neither is the accuracy.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.document import Document, Documented, Sheet, count_of, number, of_joints
from identification.documents.identification import DRAWN as DRAWING_IN_WORDS
from identification.documents.identification import MISFIT
from identification.errors import InputError
from identification.estimation import Identification, doubts, estimate
from identification.estimation.repeats import NoiseFloor, noise_floor, with_repeats_doubted
from identification.inspection.readings import (
    CLEARLY,
    DRAWN,
    Reading,
    Readings,
    data_warnings,
    gap_notes,
    read_differently,
)
from identification.kinematics.chain import BASE, MODIFIED, STANDARD, chain_of
from identification.kinematics.frames import pose_table
from identification.kinematics.parameters import JOINT_OFFSET, LENGTH_ERROR, REVOLUTE, Parameter
from identification.measurements import POINT, Measurements, rms_distance
from identification.model import Model
from identification.model.placed import with_sessions, without_prior_effects
from identification.running import Status
from identification.validate import drawing_residuals
from identification.workspace import ColumnLimits

GEOMETRY = {LENGTH_ERROR: "length", JOINT_OFFSET: "zero"}
SOURCES = {"sigma": "for the sigma_mm given", "repeats": "for what repeats scatter by", "residuals": "by the residuals"}


@dataclass(frozen=True, eq=False)
class Inspection(Documented):
    """What was seen in the measurements of an arm.

    data : keys of `check` (identification/files/README.md, "JSON keys")
    fit : of the geometry, None with too few rows;  few : these rows are few for one
    parts : what is said of the data besides problems, for a document
    """

    data: dict[str, Any]
    fit: Identification | None
    few: bool
    parts: Sequence[Any]

    problems = property(lambda self: tuple(self.data["problems"]))  # to be put right before anything is fitted
    notes = property(lambda self: tuple(self.data["notes"]))  # what these data cannot say

    def to_json(self) -> dict[str, Any]:
        """`data`."""
        return self.data

    def document(self, arm: str = "arm.toml", rows: str = "data.csv") -> Document:
        """Problems first, then the facts, the range of each joint, what the data cannot say, and the next command;
        arm, rows : names of the files"""
        parts: list[Any] = [*(f"  - {sentence}" for sentence in self.problems), *self.parts]
        if self.problems:
            return Document("Inspection", ["Fix these first:"], parts)
        near = " besides the collisions below" * bool(self.data.get("collisions"))
        verdict = f"No problems found in these data{near}{', but they are few for a fit' * self.few}."
        then = f"armcal identify {arm} {rows} --out calibrated.toml, then armcal diagnose {arm} {rows}"
        return Document("Inspection", [verdict], [*parts, f"Next: {then}"])


def inspect(arm: Arm, measurements: Measurements) -> Inspection:
    """Look at measurements of an arm: nothing is changed, nothing is believed. Effects of which the arm's calibration
    has values and no deviations, as those of the library that a prior held, are left out: without the prior no rows
    determine them. Raises `InputError` for another number of joints or coordinates than the arm has."""
    whole, arm = arm, without_prior_effects(arm)
    held = len(Model(whole).names) - len(Model(arm).names)
    readings = read_differently(arm, measurements)
    misread = readings.better is not None and readings.better.other_units
    units, fit = data_warnings(measurements, arm) if misread else [], None
    if not units:
        with suppress(InputError):  # too few rows
            fit = with_repeats_doubted(estimate(Model(with_sessions(arm, measurements)), measurements), measurements)
    # without a fit nothing says what small differences of the repeats' angles do
    own = measurements.originals == np.arange(len(measurements))  # copies of rows scatter by nothing
    floor = NoiseFloor() if fit is None else noise_floor(fit.residuals_after, measurements, own, None)
    (joints, ranges, notes), drawing = _ranges(arm, measurements.postures), readings.written.rms
    with suppress(InputError):  # too few rows for least squares
        drawing = rms_distance(drawing_residuals(arm, measurements))
    # what leaves no more than noise leaves nothing to doubt
    no_better = fit is not None and (fit.p_value is None or fit.misfit) and CLEARLY * fit.rms_after > drawing
    near = readings.written.rms < CLEARLY * DRAWN * arm.reach  # farther off, the first search was this one
    if fit is not None and readings.better is None and near and (no_better or _asked(fit)):
        closer = read_differently(arm, measurements, doubted=True)
        readings = closer if closer.explained else readings
    problems = units or _problems(arm, measurements, readings, drawing, fit)
    problems += doubts.copied_rows(measurements) + ([] if units else doubts.outside_limits(arm, measurements))
    notes = [] if units else notes  # what the data cannot say
    if fit is not None and not problems:  # a fit leaves more than noise, by chi2 or by repeats
        looks = fit.misfit and f"{fit.misfit.partition('. ')[0]}; armcal diagnose looks for what is missing"
        notes += [looks] if looks else [doubt for doubt in fit.doubts if doubt.startswith(MISFIT)]
    if fit is not None and fit.not_identifiable:
        notes.append(f"not estimable separately: {'; '.join(fit.not_identifiable)}")
    if len(np.unique(measurements.repeat_numbers)) == len(measurements):
        notes.append("no posture is repeated, so these data do not show the arm's repeatability")
    if held:
        left_out = f"{held} values of effects, which a prior held where they were identified, are left out"
        notes.append(f"{left_out}: to fit these rows, use the arm file from before that")
    notes += gap_notes(measurements)
    untested = {} if measurements.temperature is not None else {"temperature": "a column temperature_C"}
    untested |= {} if arm.gravity is not None else {"gravity": "[gravity] in the arm file"}
    if untested:
        notes.append(f"effects of {' and '.join(untested)} are not tested without {' and '.join(untested.values())}")
    enough, words, few = ({}, [], False) if fit is None else sufficiency(fit, measurements, floor)
    # what a row touches is a session or a measured point of its own here; its column has a name of its own
    instrument, touched = arm.chain.instrument, "marker" if arm.chain.instrument.own_targets else "session"
    column = instrument.target or touched
    given = tuple(sorted({column if name == touched else name for name in measurements.optional_columns - {"gaps"}}))
    fitted = None if fit is None else rms_distance(fit.residuals_after)
    data: dict[str, Any] = {
        "rows": len(measurements),
        "postures": len(np.unique(measurements.posture_numbers)),
        "sessions": measurements.sessions,
        "markers": measurements.marker_names,
        "given": given,
        "joints": joints,
        "repeats_mm": floor.repeats,
        "close_repeats_mm": floor.close_repeats,
        "rms_drawing_mm": drawing,
        "better_reading": readings.to_json(),
        "rms_fitted_mm": fitted,
        **enough,
        "not_identifiable": () if fit is None else fit.not_identifiable,
        "ok": not problems,
        "problems": tuple(problems),
        "notes": tuple(notes),
    }
    facts = {
        "rows": f"{count_of(data['rows'], 'row')}, {count_of(data['postures'], 'posture')}",
        "other columns": ", ".join(given) or "none",
        "sessions" if touched == "marker" else f"{column}s": ", ".join(measurements.sessions),
        f"{column}s" if touched == "marker" else "measured points": ", ".join(measurements.marker_names),
        "repeats scatter by": None if floor.value is None else f"{floor.value:.4g} mm",
    }
    if not units:
        facts |= {"drawing": f"{number(drawing)} mm RMS, {DRAWING_IN_WORDS['base']}"}
        facts |= {"a fit leaves": f"{number(fitted)} mm RMS"}
        facts |= dict(words[:1] if problems else words)  # data that are to be put right are not judged
    parts = list[Any]()
    if readings.counting is not None and set(readings.sentences) & set(problems):
        parts.append("If the controller counts that way, the arm file can say so, and the data stay as they are:")
        parts += [f"    {line}" for line in readings.counting.toml.splitlines()]
    parts.append(Sheet.facts(facts))
    if not units:
        headings = ("joint", "from", "to", "lower limit", "upper limit", "unit", "rows outside")
        parts += [Sheet(headings, ranges, "Joints"), *(f"note: {note}" for note in notes)]
    return Inspection(data, fit, few, parts)


def _problems(
    arm: Arm, measurements: Measurements, readings: Readings, drawing: float, fit: Identification | None
) -> list[str]:
    """What should be put right before anything is fitted, in sentences: the first kind of mistake that there is, since
    later ones may follow from it."""
    zeros, alone = list[str](), readings.better is None or readings.better.moved_zeros
    apart = [] if fit is None else other_distances(arm, measurements, fit, drawing)
    if alone and fit is not None and fit.status is not Status.implausible and not fit.outlier_rows:
        # several at once, where another reading has one or two; they may make up for a distance
        zeros = apart or doubts.far_zeros(fit.model, fit.parameters, fit.std)
    read = readings.better is not None and readings.explained
    # of joints that are read otherwise the orientations are far off, too
    sentences = [*readings.sentences] if read and not zeros else other_convention(arm, measurements, drawing)
    sentences = sentences or data_warnings(measurements, arm) or ([] if zeros else [*readings.sentences])
    if not sentences:
        sentences = [*doubts.another_frame(Model(arm), measurements), *other_frame(arm, readings.written)] or zeros
    rows, own = np.arange(len(measurements)) + 1, arm.chain.instrument.own_targets
    moved = f"a {own} that was moved without a new name" if own else "an instrument that moved"
    noise = 3.0 * (arm.sigma or 0.0) * np.sqrt(arm.dimension)
    if fit is not None and not sentences:
        unexplained = (np.isin(rows, numbers) for numbers in (fit.outlier_rows, fit.unexplained_rows))
        sentences = doubts.moved_points(fit.model, fit.parameters, fit.residuals_after, measurements)
        sentences = sentences or doubts.far_rows(fit.residuals_after, measurements, arm, *unexplained)
        sentences = sentences or apart
        # far from the rows of one arm, where noise is not the reason: effects that are not in the model leave less than
        # 1 % of the reach, a fit that explains something less than 80 % of what the drawing leaves
        if not sentences and fit.rms_after > max(0.01 * arm.reach, 0.8 * drawing, noise):
            left = f"a fit leaves {fit.rms_after:.4g} mm of the {drawing:.4g} mm that the drawing leaves"
            thing, column = ("cup", "cup") if own == "cup" else ("reflector", "marker")
            mixed = f"columns, units, rows or {column}s" if measurements.marker_names else "columns, units or rows"
            unnamed = arm.dimension == 3 and not measurements.marker_names
            several = f", several {thing}s without a column {column}" if unnamed else ""
            looked = f"look for {mixed} that are mixed up{several}, or {moved}"
            sentences = [f"{left}, so no geometry explains these rows: {looked}"]
    if not sentences and drawing > max(DRAWN * arm.reach, noise):
        off = f"the drawing is {drawing:.4g} mm off, placed as well as it can be: check lengths and columns"
        sentences = [f"{off}{own and f', and look for {moved}'}"]
    if fit is None:
        return [*sentences, "too few rows for a fit of the geometry"]
    if sentences:
        return sentences
    if asked := _asked(fit):
        return asked
    if fit.dof <= 0:  # it leaves little whatever the data are
        numbers, unknowns = fit.residuals_after.size, len(fit.names)
        return [f"{doubts.FEW}: {numbers} equations for {unknowns} unknowns. Measure more postures"]
    return [sentence for sentence in doubts.hardly_determined(fit) if sentence.startswith(doubts.FEW)]


def _asked(fit: Identification) -> list[str]:
    """What a fit has to ask of the data."""
    return [doubt.removesuffix(doubts.TELLS) for doubt in fit.doubts if doubt.endswith(doubts.TELLS)]


def _ranges(arm: Arm, postures: Array) -> tuple[list[dict[str, Any]], list[list[str]], list[str]]:
    """Of each joint its entry of `joints` (as the controller counts) and its row; a note of those that hardly move."""
    beyond, entries, rows, still = arm.beyond_limits(postures), [], [], list[int]()
    tied = {each.joint for each in arm.constraints if isinstance(each, ColumnLimits)}
    columns, limits = arm.counting.columns(postures), np.stack(arm.column_limits)
    for j, (kind, column, outside) in enumerate(zip(arm.joint_types, columns.T, beyond.T, strict=True), start=1):
        unit, factor = ("deg", 180.0 / np.pi) if kind == REVOLUTE else ("mm", 1.0)
        low, high, lower, upper = (np.r_[column.min(), column.max(), limits[:, j - 1]] * factor).tolist()
        ends, count = {"low": low, "high": high, "limit_low": lower, "limit_high": upper}, int(outside.sum())
        given = {name: None if np.isnan(x) else x for name, x in ends.items()}
        entries.append({"joint": j, "unit": unit, **given, "rows_outside": count})
        # none where it may turn all the way round, and readings of several turns do not matter
        has_limits = np.isfinite(lower) and (arm.limited[j - 1] or j in tied)
        shown_limits = (f"{x:.2f}" if has_limits else "none" for x in (lower, upper))
        rows.append([str(j), f"{low:.2f}", f"{high:.2f}", *shown_limits, unit, str(count)])
        # of a joint that turns by less than 5 deg, or slides by less than 1 % of its way, its own errors are hardly
        # seen, whatever others in its column do
        if np.ptp(postures[:, j - 1]) < (np.radians(5.0) if kind == REVOLUTE else 0.01 * (upper - lower)):
            still.append(j)
    hardly = "joint {} hardly moves: its" if len(still) == 1 else "joints {} hardly move: their"
    return entries, rows, [f"{hardly.format(', '.join(map(str, still)))} own errors cannot be seen"] * bool(still)


def other_convention(arm: Arm, measurements: Measurements, drawing: float) -> list[str]:
    """That the drawing's Denavit-Hartenberg table explains the positions if it is of the other convention, in a
    sentence; none where it does so as it is, or in neither;  drawing : what it leaves [mm]"""
    if not arm.chain.rows or drawing <= DRAWN * arm.reach:
        return []
    named, left = MODIFIED if arm.chain.convention == STANDARD else STANDARD, np.inf
    chain = chain_of(arm.chain.rows, named)
    chain = replace(arm.chain, joints=chain.joints, end=chain.end, convention=named)
    with suppress(InputError):  # too few rows
        left = rms_distance(drawing_residuals(replace(arm, chain=chain), measurements))
    if left > DRAWN * arm.reach or CLEARLY * left > drawing:
        return []
    gain = f"the drawing then leaves {left:.3g} mm instead of {drawing:.4g}"
    return [f'it looks as if the [[dh]] table is of the {named} convention: {gain}; write convention = "{named}"']


def other_distances(arm: Arm, measurements: Measurements, fit: Identification, drawing: float) -> list[str]:
    """Which of the distances given to the instrument the rows contradict, in a sentence. None: a fit with them is near
    the drawing and leaves hardly more than one without, or is far from it and leaves far less: then the arm differs.
    One of next to no arm leaves what it likes: one without then has to leave far less than the drawing [mm]."""
    instrument = fit.model.arm.chain.instrument
    released, known = instrument.released()
    if not known:
        names = ", ".join(measurements.marker_names) or "none is named"
        return [f"distances_mm name other cups than the data ({names})"] * (released != instrument)
    free = replace(arm, chain=replace(arm.chain, instrument=released.without_targets()))
    found = estimate(Model(with_sessions(free, measurements)), measurements)
    held, less = (float(np.sum(np.square(each.residuals_after))) for each in (fit, found))
    most = drawing / CLEARLY if fit.status is Status.implausible else CLEARLY * fit.rms_after
    far = _asked(fit) and found.rms_after < most
    if not (far or doubts.worth_freeing(held, less, len(known), found.dof, doubts.FALL**2)):
        return []
    by_rows = {row.name: (row.corrected or 0.0, row.std or 0.0) for row in found.corrected_values}
    # four standard deviations, as there may be many distances
    other = {name: x for name, (x, std) in by_rows.items() if abs(x - known.get(name, x)) > 4.0 * std}
    said = ", ".join(f"{name} {x:.4g} mm (arm file: {known[name]:g})" for name, x in other.items())
    return [f"these rows contradict distances_mm: {said}; was a cup moved without a new name?"] if said else []


# -- where the arm stands, against the arm file ------------------------------------------------------------------------
def other_frame(arm: Arm, written: Reading) -> list[str]:
    """How far the frame of the positions is from where the `[base]` of an arm in space has it, in a sentence; none for
    less than a zero may be off by, and where the drawing does not explain the positions from any place;  written : the
    columns as they are"""
    chain, base = arm.chain, written.base
    if base is None or not chain.instrument.reads_positions or BASE not in chain.settled - chain.drawn:
        return []
    relative = chain.base[:3, :3].T @ base[:3, :3]
    turn = float(np.arccos(np.clip((np.trace(relative) - 1.0) / 2.0, -1.0, 1.0)))
    shift = float(np.linalg.norm(base[:3, 3] - chain.base[:3, 3]))
    near = shift < 0.02 * arm.reach  # else it stands elsewhere
    if written.rms > DRAWN * arm.reach or (turn < doubts.FAR_ZERO and near):
        return []
    stands = ", ".join(f"{name} = {round(x, 1) + 0.0:g}" for name, x in pose_table(base).items())
    axis = chain.joints[0].origin[:3, :3] @ chain.joints[0].axis
    about = float(axis @ relative @ axis) > np.cos(doubts.FAR_ZERO)
    zero = ", or the zero of joint 1 is off by that" if about and near else ""
    how = f"turned by {np.degrees(turn):.1f} deg and {shift:.4g} mm away from there{zero}"
    return [
        f"the positions are not in the frame that [base] says: {how}. The drawing gives {stands}; write that there, or "
        "leave [base] out, and a fit will find it"
    ]


# -- whether the rows are enough ---------------------------------------------------------------------------------------
def sufficiency(
    fit: Identification, measurements: Measurements, floor: NoiseFloor
) -> tuple[dict[str, Any], list[tuple[str, str | None]], bool]:
    """What these rows can say of the model that was fitted to them: keys of `check`, the same in words, and whether
    fewer numbers are left over than there are parameters without a prior: a good fit says little then;  floor : what
    repeats scatter by"""
    held, parameters, spare = fit.prior.names, len(fit.names), max(fit.dof, 0)
    few, judged = spare < parameters - len(held), fit
    source = None if fit.expected_tip is None else "sigma" if fit.uncertainty.kind == "given" else "residuals"
    if few:  # the noise has to be known without the fit
        source = "sigma" if fit.sigma_known else "repeats" if floor.value else None
        if source == "sigma":
            judged = estimate(fit.model, measurements, sigma="given")
        elif floor.value:
            sigma = floor.value / float(np.sqrt(fit.residuals_after[:, POINT].shape[1]))
            judged = estimate(fit.model, measurements, sigma=sigma)
    tip, measured = (judged.expected_tip, judged.expected_tip_measured) if source else (None, None)
    # parameters without a prior, as where base and reflector are, that stay more uncertain than the frames of the arm
    # by `UNUSUAL` times, though the machining holds these; where nothing is held, such ones are not estimated at all
    machining, weak = judged.model.arm.machining, list[tuple[str, float, str]]()
    far = {"mm": doubts.UNUSUAL * machining.translation, "rad": doubts.UNUSUAL * machining.rotation}
    for p, std in zip(judged.model.parameters, judged.std.tolist(), strict=True):
        if judged.model.arm.chain.redundant and p.name not in judged.prior.names and std > far.get(p.unit, np.inf):
            weak.append((p.name, std * p.to_file, p.file_unit))
    # by kind, `length of links 1 to 3`; of one that is partly weak, what is not: `base (x, y, rx, ry, rz)`
    kinds, determined = dict[str, list[Parameter]](), list[str]()
    for parameter in (p for p, sure in zip(fit.model.parameters, fit.identifiable, strict=True) if sure):
        kind = parameter.name.partition(".")[0].partition(":")[0]
        kind = GEOMETRY.get(kind, "frame, held by [machining]," if parameter.name in held else kind)
        kinds.setdefault(kind, []).append(parameter)
    for kind, alike in kinds.items():
        sure = [p.short for p in alike if p.name not in {name for name, *_ in weak}]
        if joints := sorted({p.joint for p in alike if p.joint is not None}):
            which = of_joints(joints)
            name = f"{kind} of {which.replace('joint', 'link') if kind == GEOMETRY[LENGTH_ERROR] else which}"
        else:
            name = kind if len(sure) == len(alike) else f"{kind} ({', '.join(sure)})"
        determined += [name] if sure else []
    keys = {
        "numbers": len(np.unique(measurements.originals)) * fit.residuals_after.shape[1],
        "parameters": parameters,
        "spare_numbers": spare,
        "identifiable": tuple(determined),
        "weakly_determined": [{"name": name, "std": std, "unit": unit} for name, std, unit in weak],
        "expected_tip_mm": tip,
        "expected_tip_measured_mm": measured,
        "expected_tip_from": source,
    }
    why = "something is not determined" if fit.not_identifiable else "needs sigma_mm, repeats of a posture or more rows"
    accuracy = f"not known: {why}"
    if tip is not None and measured is not None and source is not None:
        accuracy = f"{measured:.3g} mm at the tip at postures like those measured, {tip:.3g} mm over the joint limits"
        accuracy += f" (RMS), {SOURCES[source]}, if the model is right"
    determining = keys["numbers"] - spare  # what a prior alone decides costs no equation
    by_machining = f" ({determining} determined by them, the rest by [machining])" if held else ""
    weakly = (f"{name} (std {std:{'.3g' if std < 1000.0 else '.0f'}} {unit})" for name, std, unit in weak)
    count = f"{keys['numbers']} for {parameters} parameters{by_machining}: {spare} left to judge the fit"
    words: list[tuple[str, str | None]] = [("equations", count)]
    words.append(("determines", "; ".join(determined) or "nothing by itself"))
    words += [("only weakly", "; ".join(weakly)), ("does not", "; ".join(fit.not_identifiable)), ("accuracy", accuracy)]
    return keys, words, few
