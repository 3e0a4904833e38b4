"""What measurements are like before any fit: ranges, frames, signs, whether they are enough, whether the arm sags.

With few rows the residuals hardly say what the noise is. The accuracy is then that of the sigma that is given, or of
what repeats scatter by; where neither is known, neither is the accuracy.

The torques of gravity follow from masses and postures; how far a joint gives way to them is one number for each joint,
which takes up the scale of the masses. So masses that are merely in proportion do, and equal ones of 1 kg nearly.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from identification.arm import Arm, EffectSpec, Gravity
from identification.arrays import Array
from identification.document import Document, Documented, Sheet, number, of_joints
from identification.documents.identification import DRAWN as DRAWING_IN_WORDS
from identification.documents.identification import MISFIT
from identification.effects import build_all
from identification.errors import InputError
from identification.estimation import Identification, doubts, estimate
from identification.estimation.uncertainty import gained_squares
from identification.gap.noise import NoiseFloor, noise_floor, with_repeats_doubted
from identification.inspection.readings import (
    DRAWN,
    Reading,
    Readings,
    data_warnings,
    gap_notes,
    read_differently,
)
from identification.kinematics.chain import BASE
from identification.kinematics.counting import in_columns
from identification.kinematics.frames import pose_table
from identification.kinematics.parameters import JOINT_OFFSET, LENGTH_ERROR, REVOLUTE, Parameter
from identification.measurements import POINT, Measurements, distances, rms_distance
from identification.model import Model
from identification.running import Status
from identification.sessions import with_sessions
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

    @property
    def problems(self) -> tuple[str, ...]:
        """What should be put right before anything is fitted, in sentences."""
        return tuple(self.data["problems"])

    @property
    def notes(self) -> tuple[str, ...]:
        """What these data cannot say, in sentences."""
        return tuple(self.data["notes"])

    def to_json(self) -> dict[str, Any]:
        """`data`."""
        return self.data

    def document(self, arm: str = "arm.toml", rows: str = "data.csv") -> Document:
        """Problems first, then the facts, the range of each joint, what the data cannot say, and the next command.

        arm, rows : names of the files
        """
        parts: list[Any] = [*(f"  - {sentence}" for sentence in self.problems), *self.parts]
        if self.problems:
            return Document("Inspection", ["Fix these first:"], parts)
        verdict = f"No problems found in these data{', but they are few for a fit' if self.few else ''}."
        then = f"armcal identify {arm} {rows} --out calibrated.toml, then armcal diagnose {arm} {rows}"
        return Document("Inspection", [verdict], [*parts, f"Next: {then}"])


def inspect(arm: Arm, measurements: Measurements, masses: Sequence[float] | None = None) -> Inspection:
    """Look at measurements of an arm: nothing is changed, nothing is believed.

    Effects of which the arm's calibration has values and no deviations, as those of the library that a prior held, are
    left out: without the prior no rows determine them.

    masses : (n,) of the links [kg], of an arm whose file leaves gravity out, None: not known

    Raises `InputError` for another number of joints or coordinates than the arm has.
    """
    calibration, held = arm.calibration, set[str]()
    if calibration is not None and calibration.covariance is not None:
        held = {*calibration.effects} - {*calibration.parameter_names}
        built = zip(arm.effects, build_all(arm.effects, arm.chain), strict=True)
        free = [spec for spec, effect in built if not held & {p.name for p in effect.parameters}]
        arm = replace(arm, effects=tuple(free))
    readings = read_differently(arm, measurements)
    units = data_warnings(measurements, arm) if readings.other_units else []
    fit = None if units else _fit(arm, measurements)
    # without a fit nothing says what small differences of the repeats' angles do
    every = np.ones(len(measurements), dtype=bool)
    floor = NoiseFloor() if fit is None else noise_floor(fit.residuals_after, measurements, every, None)
    asked, commanded = measurements.commanded, None
    if asked is not None and not units and not np.array_equal(asked, measurements.postures):
        by_command = _fit(arm, replace(measurements, postures=asked, commanded=None))
        commanded = None if by_command is None else rms_distance(by_command.residuals_after)
    try:
        drawing = rms_distance(drawing_residuals(arm, measurements))
    except InputError:  # too few rows for least squares
        drawing = readings.written.rms
    gravity, sags = None, ""
    if fit is not None and fit.status is not Status.implausible:
        gravity, sags = sag(arm, measurements, fit, masses)
    joints, ranges, still = _ranges(arm, measurements.postures)
    problems = units or _problems(arm, measurements, readings, drawing, fit)
    problems += doubts.copied_rows(measurements) + ([] if units else doubts.outside_limits(arm, measurements))
    # what the data cannot say
    notes = other_frame(arm, readings.written) if arm.chain.planar and not units else []
    if still and not units:
        hardly = "joint {} hardly moves: its" if len(still) == 1 else "joints {} hardly move: their"
        notes = [f"{hardly.format(', '.join(map(str, still)))} own errors cannot be seen", *notes]
    if fit is not None and commanded is not None:  # which angles explain the positions better
        read = rms_distance(fit.residuals_after)
        figures = f"a fit to the angles read leaves {read:.3g} mm RMS, to those commanded {commanded:.3g} mm"
        verdict = "the positions are those of the angles commanded: give these as q1_deg.. instead"
        if max(read, commanded) <= 1.05 * min(read, commanded):  # no telling
            verdict = "which of them a fit uses makes no difference"
        elif read < commanded:
            verdict = "the positions are those of the angles read, which every fit uses"
        notes.append(f"{figures}: {verdict}")
    if fit is not None and not problems:  # a fit leaves more than noise, by chi2 or by repeats
        looks = fit.misfit and f"{fit.misfit.partition('. ')[0]}; armcal diagnose looks for what is missing"
        notes += [looks] if looks else [doubt for doubt in fit.doubts if doubt.startswith(MISFIT)]
    if fit is not None and fit.not_identifiable:
        notes.append(f"not estimable separately: {'; '.join(fit.not_identifiable)}")
    if len(np.unique(measurements.repeat_numbers)) == len(measurements):
        notes.append("no posture is repeated: the arm's repeatability is not known from these data")
    if held:
        left_out = f"{len(held)} values of effects, which a prior held where they were identified, are left out"
        notes.append(f"{left_out}: for a fit to these rows take the arm file from before")
    notes += gap_notes(measurements) + ([sags] if sags else [])
    untested = {} if measurements.temperature is not None else {"temperature": "a column temperature_C"}
    untested |= {} if arm.gravity is not None or sags else {"gravity": "[gravity] in the arm file"}
    if untested:
        notes.append(f"effects of {' and '.join(untested)} are not tested without {' and '.join(untested.values())}")
    enough, words, few = ({}, [], False) if fit is None else sufficiency(fit, measurements, floor)
    # what a row touches is a session or a measured point of its own here; its column has a name of its own
    instrument, touched = arm.chain.instrument, "marker" if arm.chain.instrument.own_targets else "session"
    column = instrument.target or ("session" if instrument.own_targets else touched)
    given = tuple(sorted(column if name == touched else name for name in measurements.optional_columns))
    fitted = None if fit is None else rms_distance(fit.residuals_after)
    data = {
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
        "rms_commanded_mm": commanded,
        **enough,
        "not_identifiable": () if fit is None else fit.not_identifiable,
        "gravity": gravity,
        "ok": not problems,
        "problems": tuple(problems),
        "notes": tuple(notes),
    }
    facts = [
        ("rows", f"{data['rows']} rows, {data['postures']} postures"),
        ("columns besides", ", ".join(given) or "none"),
        ("sessions" if touched == "marker" else f"{column}s", ", ".join(measurements.sessions)),
        (f"{column}s" if touched == "marker" else "measured points", ", ".join(measurements.marker_names)),
        ("repeats scatter by", None if floor.value is None else f"{floor.value:.4g} mm"),
    ]
    if not units:
        facts.append(("drawing", f"{number(drawing)} mm RMS, {DRAWING_IN_WORDS['base']}"))
        facts.append(("a fit leaves", f"{number(fitted)} mm RMS"))
        facts += words[:1] if problems else words  # data that are to be put right are not judged
    parts = list[Any]()
    if readings.counting is not None and set(readings.sentences) & set(problems):
        parts.append("If the controller counts that way, the arm file may say so, and data and commands stay its:")
        parts += [f"    {line}" for line in readings.counting.toml.splitlines()]
    parts.append(Sheet.facts(facts))
    if not units:
        headings = ("joint", "from", "to", "lower limit", "upper limit", "unit", "rows outside")
        parts += [Sheet(headings, ranges, "Joints"), *(f"note: {note}" for note in notes)]
    if gravity is not None and gravity["recommended"]:
        parts.append("\n".join(["", *gravity["lines"], ""]))
    return Inspection(data, fit, few, parts)


def _fit(arm: Arm, measurements: Measurements) -> Identification | None:
    """The geometry of the arm fitted, None if the rows are too few for it."""
    try:
        fit = estimate(Model(with_sessions(arm, measurements)), measurements)
    except InputError:
        return None
    return with_repeats_doubted(fit, measurements)


def _problems(
    arm: Arm, measurements: Measurements, readings: Readings, drawing: float, fit: Identification | None
) -> list[str]:
    """What should be put right before anything is fitted, in sentences: the first kind of mistake that there is, since
    later ones may follow from it."""
    zeros, alone = list[str](), readings.better is None or readings.better.moved_zeros
    if alone and fit is not None and fit.status is not Status.implausible:
        zeros = doubts.far_zeros(fit.model, fit.parameters)  # several at once, where another reading has one or two
    sentences = data_warnings(measurements, arm) or ([] if zeros else readings.sentences)
    if not sentences:
        placed = [] if arm.chain.planar else other_frame(arm, readings.written)
        sentences = [*doubts.another_frame(arm, measurements), *placed] or zeros
    if not sentences and drawing > DRAWN * arm.reach:
        sentences = [f"the drawing is {drawing:.4g} mm off wherever the arm stands: check lengths and columns"]
    if fit is None:
        return [*sentences, "too few rows for a fit of the geometry"]
    if sentences:
        return sentences
    rows = np.arange(len(measurements)) + 1
    unexplained = (np.isin(rows, numbers) for numbers in (fit.outlier_rows, fit.unexplained_rows))
    if sentences := doubts.far_rows(fit.residuals_after, *unexplained):
        return sentences
    # far from the rows of one arm, where noise is not the reason: effects that are not in the model leave less than 1 %
    # of the reach, a fit that explains something less than 80 % of what the drawing leaves
    noise = 3.0 * (arm.sigma or 0.0) * np.sqrt(arm.dimension)
    if fit.rms_after > max(0.01 * arm.reach, 0.8 * drawing, noise):
        left = f"a fit leaves {fit.rms_after:.4g} mm of the {drawing:.4g} mm that the drawing leaves"
        names = "columns, units or markers" if measurements.marker_names else "columns or units"
        mixed = f"look for {names} that changed, or an instrument that moved"
        return [f"{left}, so that no geometry explains these rows: {mixed}"]
    if fit.dof <= 0:  # it leaves little whatever the data are
        numbers, unknowns = fit.residuals_after.size, len(fit.names)
        return [f"{doubts.FEW}: {numbers} numbers for {unknowns} unknowns. Measure more postures"]
    return [
        sentence for sentence in doubts.hardly_determined(fit) if sentence.startswith((doubts.FEW, doubts.TOGETHER))
    ]


def _ranges(arm: Arm, postures: Array) -> tuple[list[dict[str, Any]], list[list[str]], list[int]]:
    """Of each joint the entry of `joints` (as the controller counts), its row of the table, and which hardly move."""
    outside = doubts.beyond_limits(arm, postures).sum(axis=0).tolist()
    tied = {each.joint for each in arm.constraints if isinstance(each, ColumnLimits)}
    shown, limits = in_columns(postures, arm.joint_types), np.stack(arm.column_limits)
    entries, rows, still = [], [], []
    for j, kind in enumerate(arm.joint_types, start=1):
        unit, factor = ("deg", 180.0 / np.pi) if kind == REVOLUTE else ("mm", 1.0)
        low, high = float(shown[:, j - 1].min()) * factor, float(shown[:, j - 1].max()) * factor
        lower, upper = (limits[:, j - 1] * factor).tolist()
        ends = {"low": low, "high": high, "limit_low": lower, "limit_high": upper}
        given = {name: None if np.isnan(x) else x for name, x in ends.items()}
        entries.append({"joint": j, "unit": unit, **given, "rows_outside": outside[j - 1]})
        # none where it may turn all the way round, and readings of several turns do not matter
        has_limits = np.isfinite(lower) and (doubts.limited(arm)[j - 1] or j in tied)
        shown_limits = (f"{x:.2f}" if has_limits else "none" for x in (lower, upper))
        rows.append([str(j), f"{low:.2f}", f"{high:.2f}", *shown_limits, unit, str(outside[j - 1])])
        # of a joint that turns by less than 5 deg its own errors are hardly seen, whatever others in its column do
        if np.ptp(postures[:, j - 1]) < (np.radians(5.0) if kind == REVOLUTE else 0.0):
            still.append(j)
    return entries, rows, still


# -- where the arm stands, against the arm file ------------------------------------------------------------------------
def other_frame(arm: Arm, written: Reading) -> list[str]:
    """How far the frame of the positions is from where the arm file has it, in a sentence; none for less than a zero
    may be off by, and where the drawing does not explain the positions from any place. A fit of a planar arm takes it
    up, one of an arm in space whose `[base]` is wrong does not.

    written : the columns as they are
    """
    chain, base = arm.chain, written.base
    placed = chain.instrument.reads_positions and (chain.planar or BASE in chain.settled)
    if base is None or not placed or written.rms > DRAWN * arm.reach:
        return []
    relative = chain.base[:3, :3].T @ base[:3, :3]
    turn = float(np.arccos(np.clip((np.trace(relative) - 1.0) / 2.0, -1.0, 1.0)))
    shift = float(np.linalg.norm(base[:3, 3] - chain.base[:3, 3]))
    near = shift < 0.02 * arm.reach  # else it stands elsewhere
    if turn < doubts.FAR_ZERO and (chain.planar or near):
        return []
    if chain.planar:
        words = f"{np.degrees(np.arctan2(relative[1, 0], relative[0, 0])):.1f} deg"
        return [
            f"the frame of the positions is turned by {words} against the arm file, or the zero of joint 1 is, which "
            "looks the same: a fit puts it into the zero of joint 1. Where it is the frame, turn the positions back by "
            f"{words} or leave that zero out of the controller"
        ]
    stands = ", ".join(f"{name} = {round(x, 1) + 0.0:g}" for name, x in pose_table(base).items())
    axis = chain.joints[0].origin[:3, :3] @ chain.joints[0].axis
    about = float(axis @ relative @ axis) > np.cos(doubts.FAR_ZERO)
    zero = ", or the zero of joint 1 is off by that" if about and near else ""
    how = f"turned by {np.degrees(turn):.1f} deg and {shift:.4g} mm away from there{zero}"
    return [
        f"the positions are in another frame than [base] says: {how}. From the drawing {stands}; write that there, or "
        "leave [base] out, and a fit finds it"
    ]


# -- whether the rows are enough ---------------------------------------------------------------------------------------
def sufficiency(
    fit: Identification, measurements: Measurements, floor: NoiseFloor
) -> tuple[dict[str, Any], list[tuple[str, str | None]], bool]:
    """What these rows can say of the model that was fitted to them: keys of `check`, the same in words, and whether
    fewer numbers are left over than there are parameters without a prior: a good fit says little then.

    floor : what repeats scatter by
    """
    held = frozenset(fit.prior.names) if fit.prior is not None else frozenset[str]()
    parameters, spare = len(fit.names), max(fit.dof, 0)
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
    weak: list[tuple[str, float, str]] = []
    if judged.prior is not None and judged.model.arm.chain.redundant:
        machining = judged.model.arm.machining
        far = {"mm": doubts.UNUSUAL * machining.translation, "rad": doubts.UNUSUAL * machining.rotation}
        stds = zip(judged.model.parameters, judged.std.tolist(), strict=True)
        free = [(p, std) for p, std in stds if p.name not in judged.prior.names]
        weak = [(p.name, std * p.to_file, p.file_unit) for p, std in free if std > far.get(p.unit, np.inf)]
    determined = _in_words(fit, held, {name for name, *_ in weak})
    keys = {
        "numbers": fit.residuals_after.size,
        "parameters": parameters,
        "spare_numbers": spare,
        "identifiable": determined,
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
    by_machining = f" ({len(held)} held by [machining])" if held else ""
    weakly = (f"{name} (std {std:{'.3g' if std < 1000.0 else '.0f'}} {unit})" for name, std, unit in weak)
    count = f"{keys['numbers']} numbers for {parameters} parameters{by_machining}: {spare} left to judge the fit"
    words: list[tuple[str, str | None]] = [("such a fit", count)]
    words.append(("determines", "; ".join(determined) or "nothing by itself"))
    words += [("only weakly", "; ".join(weakly)), ("does not", "; ".join(fit.not_identifiable)), ("accuracy", accuracy)]
    return keys, words, few


def _in_words(fit: Identification, held: Set[str], weak: Set[str]) -> tuple[str, ...]:
    """`length of links 1 to 3`, `zero of joints 1 to 3`, `base_offset`: what is determined, by kind; of one that is
    partly weak, what is not: `base (x, y, rx, ry, rz)`."""
    kinds: dict[str, list[Parameter]] = {}
    for parameter, determined in zip(fit.model.parameters, fit.identifiable, strict=True):
        if determined:
            kind = parameter.name.partition(".")[0].partition(":")[0]
            kind = GEOMETRY.get(kind, "frame, held by [machining]," if parameter.name in held else kind)
            kinds.setdefault(kind, []).append(parameter)
    words = []
    for kind, parameters in kinds.items():
        sure = [p.short for p in parameters if p.name not in weak]
        if joints := sorted({p.joint for p in parameters if p.joint is not None}):
            which = of_joints(joints)
            name = f"{kind} of {which.replace('joint', 'link') if kind == GEOMETRY[LENGTH_ERROR] else which}"
        else:
            name = kind if len(sure) == len(parameters) else f"{kind} ({', '.join(sure)})"
        words += [name] if sure else []
    return tuple(words)


# -- whether the arm sags ----------------------------------------------------------------------------------------------
def sag(
    arm: Arm, measurements: Measurements, fit: Identification, masses: Sequence[float] | None = None
) -> tuple[dict[str, Any] | None, str]:
    """What compliance of the joints explains beyond the geometry of an arm without gravity, that along the last axis of
    the base: key `gravity` of `check`, distances [mm] of each posture from where a fit to all others puts it, without
    and with compliance; and the recommendation, empty where the arm does not sag beyond doubt, or by little.

    fit : of the geometry to these measurements;  masses : (n,) of the links [kg] where they are known

    None where the arm has gravity, no joint bears a weight, or the measurements determine the one fit or the other not.
    """
    if arm.gravity is not None:
        return None, ""
    kilograms, down = np.ones(arm.links) if masses is None else np.asarray(masses, dtype=float), np.zeros(arm.dimension)
    down[-1] = -9.81  # [m/s^2]
    heavy = replace(arm, gravity=Gravity(down, kilograms, np.full(arm.links, 0.5)))
    torques = Model(heavy).torques(measurements.postures, measurements.conditions)
    sizes = np.sqrt(np.mean(torques**2, axis=0))
    modelled = {effect.joint for effect in arm.effects if effect.name == "joint_compliance"}
    # an upright first axis has no torque but rounding
    joints = [j for j in (np.flatnonzero(sizes > 1e-3 * sizes.max()) + 1).tolist() if j not in modelled]
    soft = heavy.with_effects(*arm.effects, *(EffectSpec("joint_compliance", j) for j in joints))
    try:
        sagging = estimate(Model(with_sessions(soft, measurements)), measurements)
    except InputError:  # too few rows
        return None, ""
    left = [doubts.left_out_residuals(one, measurements) for one in (fit, sagging)]
    before, after = (None if residuals is None else distances(residuals) for residuals in left)
    if before is None or after is None:
        return None, ""
    p_value = gained_squares(before, after, measurements).p_above()
    figures = {
        "rms_before_mm": float(np.sqrt(np.mean(before**2))),
        "rms_after_mm": float(np.sqrt(np.mean(after**2))),
        "max_before_mm": float(before.max()),
        "max_after_mm": float(after.max()),
    }
    # one-sided, one question of each data set; less than 3 % of the RMS distance is not worth another table
    recommended = p_value <= 0.01 and figures["rms_after_mm"] <= 0.97 * figures["rms_before_mm"]
    lines = ["[gravity]", f"acceleration_m_s2 = {down.tolist()}"]
    lines += [f"link_masses_kg = {[round(mass, 4) for mass in kilograms.tolist()]}"]
    named = {"masses_kg": kilograms.tolist(), "masses_from": "unit" if masses is None else "urdf"}
    keys = {"recommended": recommended, **figures, "p_value": p_value, **named, "lines": lines}
    if not recommended:
        return keys, ""
    falls = "{rms_before_mm:.3g} to {rms_after_mm:.3g} mm RMS (largest {max_before_mm:.3g} to {max_after_mm:.3g} mm)"
    source = "1 kg stands for the mass of each link, and the compliances take up the scale; real masses are better"
    if masses is not None:
        source = "the masses are those of the URDF file"
    return keys, (
        f"the arm sags: compliant joints under gravity take the error from {falls.format(**figures)} in postures not "
        f"fitted, p = {p_value:.1g}. Add the lines below to the arm file; {source}. {'xyz'[arm.dimension - 1]} of the "
        "base is taken to point up"
    )
