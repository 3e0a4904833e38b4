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
from scipy.special import fdtrc

from identification.arm import Arm, EffectSpec, Gravity
from identification.arrays import Array
from identification.document import Document, of_joints
from identification.documents.identification import MISFIT
from identification.documents.inspection import inspection_document
from identification.errors import InputError
from identification.estimation import Identification, estimate
from identification.estimation.doubts import (
    FAR_ZERO,
    FEW,
    SPARE,
    TOGETHER,
    UNUSUAL,
    another_frame,
    beyond_limits,
    copied_rows,
    far_rows,
    far_zeros,
    hardly_determined,
    left_out_residuals,
    limited,
    outside_limits,
)
from identification.estimation.uncertainty import LEVEL, gained_squares
from identification.gap.noise import NoiseFloor, noise_floor, with_repeats_doubted
from identification.inspection.data_checks import DRAWN, data_warnings, gap_notes, wrong_units
from identification.inspection.readings import (
    Reading,
    Readings,
    anywhere,
    as_written,
    joints_of_unseen_sign,
    out_of_step,
    read_differently,
    some_of_one_point,
)
from identification.kinematics.chain import BASE
from identification.kinematics.counting import in_columns
from identification.kinematics.frames import pose_table
from identification.kinematics.parameters import JOINT_OFFSET, LENGTH_ERROR, REVOLUTE, Parameter
from identification.measurements import POINT, Measurements, distances, rms_distance
from identification.model import Model
from identification.model.placed import placed_model
from identification.sessions import with_sessions
from identification.status import Status
from identification.validate import drawing_residuals
from identification.workspace import ColumnLimits

NOTHING = 1e-6  # [mm] RMS that is no measurement's: below, nothing is compared
GEOMETRY = {LENGTH_ERROR: "length", JOINT_OFFSET: "zero"}
SOURCES = {"sigma": "for the sigma_mm given", "repeats": "for what repeats scatter by", "residuals": "by the residuals"}
G = 9.81  # [m/s^2]
LEVER = 1e-3  # of the largest torque: an upright first axis has none but rounding
LENGTH_OFFSET = "length_offset"  # the effect


@dataclass(frozen=True)
class JointRange:
    """The positions of one joint [rad or mm], as the controller counts; `outside`: rows beyond its limits;  `limited`:
    False where it may turn all the way round, and readings of several turns do not matter, or nothing says its limits
    (NaN);  still : the joint itself hardly moves, whatever others in its column do."""

    joint: int
    kind: str
    low: float
    high: float
    limit_low: float
    limit_high: float
    outside: int
    limited: bool = True
    still: bool = False

    @property
    def unit(self) -> str:
        """Of files."""
        return "deg" if self.kind == REVOLUTE else "mm"

    def in_file_units(self, value: float) -> float:
        """[deg] or [mm]."""
        return float(np.degrees(value)) if self.kind == REVOLUTE else value

    def to_json(self) -> dict[str, Any]:
        """An entry of `joints` (identification/files/README.md, "JSON keys")."""
        names = ("low", "high", "limit_low", "limit_high")
        values = {name: self.in_file_units(getattr(self, name)) for name in names}
        shown = {name: None if np.isnan(value) else value for name, value in values.items()}
        return {"joint": self.joint, "unit": self.unit, **shown, "rows_outside": self.outside}


@dataclass(frozen=True, eq=False)
class Inspection:
    """What was seen in the measurements of an arm.

    rows, postures : how many rows, and of how many postures;  given : optional columns
    floor : what repeats scatter by;  readings : the columns as they are, and a better way to read them if there is one
    drawing : RMS distance [mm] that the drawing leaves with its place in the instrument's frame fitted, as of
        `validate`;  fit : the geometry fitted, None with too few rows;  enough : what the rows can say of it
    commanded : RMS distance [mm] that a fit to commanded angles leaves, None: there are none beside those read
    other_units : the numbers are of other units, so that neither a fit nor limits would mean anything
    sag : what gravity explains, None: not known
    problems, notes : what should be put right before anything is fitted, what these data cannot say, in sentences
    """

    arm: Arm
    rows: int
    postures: int
    sessions: tuple[str, ...]
    markers: tuple[str, ...]
    given: tuple[str, ...]
    joints: tuple[JointRange, ...]
    floor: NoiseFloor
    readings: Readings
    drawing: float
    fit: Identification | None
    enough: Sufficiency | None
    commanded: float | None
    other_units: bool
    sag: Sag | None
    problems: tuple[str, ...]
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Keys of `check` (identification/files/README.md, "JSON keys")."""
        fit = self.fit
        return {
            "rows": self.rows,
            "postures": self.postures,
            "sessions": self.sessions,
            "markers": self.markers,
            "given": self.given,
            "joints": [joint.to_json() for joint in self.joints],
            **{name: value for name, value in self.floor.to_json().items() if "repeats_mm" in name},
            "rms_drawing_mm": self.drawing,
            "better_reading": self.readings.to_json(),
            "rms_fitted_mm": None if fit is None else rms_distance(fit.residuals_after),
            "rms_commanded_mm": self.commanded,
            **({} if self.enough is None else self.enough.to_json()),
            "not_identifiable": () if fit is None else fit.not_identifiable,
            "gravity": None if self.sag is None else self.sag.to_json(),
            "ok": not self.problems,
            "problems": self.problems,
            "notes": self.notes,
        }

    def document(self, arm: str = "arm.toml", rows: str = "data.csv") -> Document:
        """Problems first, then the facts and the next command;  arm, rows : names of the files"""
        return inspection_document(self, arm, rows)

    def __str__(self) -> str:
        return str(self.document())

    def _repr_html_(self) -> str:
        return self.document()._repr_html_()


def inspect(arm: Arm, measurements: Measurements, masses: Sequence[float] | None = None) -> Inspection:
    """Look at measurements of an arm: nothing is changed, nothing is believed.

    masses : (n,) of the links [kg], of an arm whose file leaves gravity out, None: not known

    Raises `InputError` for another number of joints or coordinates than the arm has.
    """
    if measurements.links != arm.links:
        raise InputError(
            f"measurements: {measurements.links} joints for an arm of {arm.links} links, allowed: {arm.links}"
        )
    other_units = bool(wrong_units(measurements, arm))
    fit = None if other_units else _fit(arm, measurements)
    # without a fit nothing says what small differences of the repeats' angles do
    every = np.ones(len(measurements), dtype=bool)
    floor = NoiseFloor() if fit is None else noise_floor(fit.residuals_after, measurements, every, None)
    asked, commanded = measurements.commanded, None
    if asked is not None and not other_units and not np.array_equal(asked, measurements.postures):
        by_command = _fit(arm, replace(measurements, postures=asked, commanded=None))
        commanded = None if by_command is None else rms_distance(by_command.residuals_after)
    readings = (as_written if other_units else read_differently)(arm, measurements)
    try:
        drawing = rms_distance(drawing_residuals(arm, measurements))
    except InputError:  # too few rows for least squares
        drawing = readings.written.rms
    sags = None if fit is None or fit.status is Status.implausible else sag(arm, measurements, fit, masses)
    joints = _ranges(arm, measurements.postures)
    problems = _problems(arm, measurements, readings, drawing, fit)
    # what the data cannot say
    notes = [] if other_units else turned_frame(arm, readings.written)
    if (still := [str(joint.joint) for joint in joints if joint.still]) and not other_units:
        hardly = "joint {} hardly moves: its" if len(still) == 1 else "joints {} hardly move: their"
        notes = [f"{hardly.format(', '.join(still))} own errors cannot be seen", *notes]
    unseen = [j for j in joints_of_unseen_sign(arm, measurements) if not joints[j - 1].still]
    why = "the measured point is on its axis, or so near that the drawing's errors hide it"
    notes += [f"which way joint {j} turns and where its zero is do not show in these data: {why}" for j in unseen]
    notes += _of_fit(fit, commanded, problems)
    if len(np.unique(measurements.repeat_numbers)) == len(measurements):
        notes.append("no posture is repeated: the arm's repeatability is not known from these data")
    notes += gap_notes(measurements)
    advised = sags is not None and sags.recommended
    notes += [sags.sentence] if sags is not None and advised else []
    untested = {} if "temperature" in measurements.optional_columns else {"temperature": "a column temperature_C"}
    if arm.gravity is None and not advised:
        untested["gravity"] = "[gravity] in the arm file"
    if untested:
        effects, needed = " and ".join(untested), " and ".join(untested.values())
        notes.append(f"effects of {effects} are not tested without {needed}")
    return Inspection(
        arm=arm,
        rows=len(measurements),
        postures=len(np.unique(measurements.posture_numbers)),
        sessions=measurements.sessions,
        markers=measurements.marker_names,
        given=tuple(sorted(measurements.optional_columns)),
        joints=joints,
        floor=floor,
        readings=readings,
        drawing=drawing,
        fit=fit,
        enough=None if fit is None else sufficiency(fit, measurements, floor),
        commanded=commanded,
        other_units=other_units,
        sag=sags,
        problems=tuple(problems),
        notes=tuple(notes),
    )


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
    """What should be put right before anything is fitted, in sentences, of which a later one may follow from an earlier
    one: then it is left out."""
    other_units, zeros = bool(wrong_units(measurements, arm)), list[str]()
    explained = readings.better is None or readings.better.moved_zeros
    if explained and fit is not None and fit.status is not Status.implausible:
        zeros = far_zeros(fit.model, fit.parameters)  # several at once, where another reading has one or two
    sentences = data_warnings(measurements, arm) or ([] if zeros else readings.sentences)
    if not sentences and not other_units:
        sentences = [*another_frame(arm, measurements), *other_base(arm, measurements)]
        sentences += constant_length(arm, measurements, fit)
    sentences = sentences or zeros
    if drawing > DRAWN * arm.reach and not sentences:
        off = f"the drawing is {drawing:.4g} mm off wherever the arm stands: check lengths and columns"
        sentences = out_of_step(arm, measurements) or [off]
    if fit is not None and not sentences:
        rows = np.arange(len(measurements)) + 1
        unexplained = (np.isin(rows, numbers) for numbers in (fit.outlier_rows, fit.unexplained_rows))
        sentences = far_rows(fit.residuals_after, *unexplained)
        # far from the rows of one arm, where noise is not the reason
        noise = 3.0 * (arm.sigma or 0.0) * np.sqrt(arm.dimension)
        # effects that are not in the model leave less than 1 % of the reach, a fit that explains something less than
        # 80 % of what the drawing leaves
        if not sentences and fit.rms_after > max(0.01 * arm.reach, 0.8 * drawing, noise):
            left = f"a fit leaves {fit.rms_after:.4g} mm of the {drawing:.4g} mm that the drawing leaves"
            names = "columns, units or markers" if measurements.marker_names else "columns or units"
            mixed = f"look for {names} that changed, or an instrument that moved"
            sentences = [f"{left}, so that no geometry explains these rows: {mixed}"]
    if fit is None and not other_units:
        sentences = [*sentences, "too few rows for a fit of the geometry"]
    if fit is not None and not sentences and fit.dof <= 0:  # it leaves little whatever the data are
        numbers, unknowns = fit.residuals_after.size, len(fit.names)
        sentences = [f"{FEW}: {numbers} numbers for {unknowns} unknowns. Measure more postures"]
    elif fit is not None and not sentences:
        sentences = [sentence for sentence in hardly_determined(fit) if sentence.startswith((FEW, TOGETHER))]
    outside = [] if other_units else outside_limits(arm, measurements)
    return [*sentences, *copied_rows(measurements), *outside]


# -- what the data cannot say, in sentences ----------------------------------------------------------------------------
def _of_fit(fit: Identification | None, commanded: float | None, problems: Sequence[str]) -> list[str]:
    """What is left of a fit beside noise, and what it leaves open."""
    if fit is None:
        return []
    sentences = []
    if commanded is not None:  # which angles explain the positions better
        read = rms_distance(fit.residuals_after)
        figures = f"a fit to the angles read leaves {read:.3g} mm RMS, to those commanded {commanded:.3g} mm"
        if max(read, commanded) <= 1.05 * min(read, commanded):  # no telling
            verdict = "which of them a fit uses makes no difference"
        elif read < commanded:
            verdict = "the positions are those of the angles read, which every fit uses"
        else:
            verdict = "the positions are those of the angles commanded: give these as q1_deg.. instead"
        sentences = [f"{figures}: {verdict}"]
    if not problems:  # a fit leaves more than noise, by chi2 or by repeats
        looks = fit.misfit and f"{fit.misfit.partition('. ')[0]}; armcal diagnose looks for what is missing"
        sentences += [looks] if looks else [doubt for doubt in fit.doubts if doubt.startswith(MISFIT)]
    if fit.not_identifiable:
        sentences.append(f"not estimable separately: {'; '.join(fit.not_identifiable)}")
    return sentences


def _ranges(arm: Arm, postures: Array) -> tuple[JointRange, ...]:
    beyond = beyond_limits(arm, postures).sum(axis=0)
    tied = {each.joint for each in arm.constraints if isinstance(each, ColumnLimits)}
    shown, (lower, upper) = in_columns(postures, arm.joint_types), arm.column_limits
    has_limits = np.isfinite(lower) & (limited(arm) | [j in tied for j in range(1, arm.links + 1)])
    # of a joint that turns by less than 5 deg its own errors are hardly seen
    still = np.ptp(postures, axis=0) < np.where(np.array(arm.joint_types) == REVOLUTE, np.radians(5.0), 0.0)
    columns = zip(arm.joint_types, shown.T, lower, upper, beyond, has_limits, still, strict=True)
    return tuple(
        JointRange(
            j, kind, float(q.min()), float(q.max()), float(low), float(high), int(outside), bool(has), bool(rests)
        )
        for j, (kind, q, low, high, outside, has, rests) in enumerate(columns, start=1)
    )


# -- how frame and instrument were set up, against the arm file --------------------------------------------------------
def turned_frame(arm: Arm, written: Reading) -> list[str]:
    """How far the positions of a planar arm are turned against its drawing, in a sentence; none for less than a zero
    may be off by, or where the drawing does not explain the positions at any angle.

    written : the columns as they are
    """
    if written.turn is None or abs(written.turn) < FAR_ZERO or written.rms > DRAWN * arm.reach:
        return []
    turn = f"{np.degrees(written.turn):.1f} deg"
    return [
        f"the frame of the positions is turned by {turn} against the arm file, or the zero of joint 1 is, which looks "
        "the same: a fit puts it into the zero of joint 1. Where it is the frame, turn the positions back by "
        f"{turn} or leave that zero out of the controller"
    ]


def other_base(arm: Arm, measurements: Measurements) -> list[str]:
    """Where a spatial arm stands if its `[base]` is wrong, in a sentence; none where the file says nothing, and where
    the drawing explains the positions from no place."""
    chain = arm.chain
    if chain.planar or BASE not in chain.settled or not chain.instrument.reads_positions:
        return []
    rows = some_of_one_point(measurements)
    try:
        placed = placed_model(Model(anywhere(arm)), rows)
    except InputError:  # too few rows to place it
        return []
    left = rows.positions[:, :3] - placed.position(rows.postures, conditions=rows.conditions)[:, :3]
    if rms_distance(left) > DRAWN * arm.reach:
        return []
    base = placed.arm.chain.base
    relative = chain.base[:3, :3].T @ base[:3, :3]
    turn = float(np.arccos(np.clip((np.trace(relative) - 1.0) / 2.0, -1.0, 1.0)))
    shift = float(np.linalg.norm(base[:3, 3] - chain.base[:3, 3]))
    near = shift < 0.02 * arm.reach  # else it stands elsewhere
    if turn < FAR_ZERO and near:
        return []
    stands = ", ".join(f"{name} = {round(x, 1) + 0.0:g}" for name, x in pose_table(base).items())
    axis = chain.joints[0].origin[:3, :3] @ chain.joints[0].axis
    about = float(axis @ relative @ axis) > np.cos(FAR_ZERO)
    zero = ", or the zero of joint 1 is off by that" if about and near else ""
    how = f"turned by {np.degrees(turn):.1f} deg and {shift:.4g} mm away from there{zero}"
    return [
        f"the positions are in another frame than [base] says: {how}. From the drawing {stands}; write that there, or "
        "leave [base] out, and a fit finds it"
    ]


def constant_length(arm: Arm, measurements: Measurements, fit: Identification | None) -> list[str]:
    """The offer of `length_offset` where much less is left with it, in a sentence.

    fit : without it, None: there is none
    """
    settled = fit is None or "distance" not in arm.offers or any(spec.name == LENGTH_OFFSET for spec in arm.effects)
    if settled or fit is None or fit.dof <= SPARE or rms_distance(fit.residuals_after) < NOTHING:
        return []
    wider = replace(arm, calibration=None).with_effects(*arm.effects, EffectSpec(LENGTH_OFFSET))
    wider_fit = estimate(Model(with_sessions(wider, measurements)), measurements)
    before, after = (float(np.sum(one.residuals_after**2)) for one in (fit, wider_fit))
    after = max(after, NOTHING**2 * len(measurements))
    # half of the squares is clearly more than one parameter's share
    if before < 2.0 * after or fdtrc(1, fit.dof - 1, (before - after) * (fit.dof - 1) / after) > LEVEL:
        return []
    value = float(wider_fit.parameters[wider_fit.names.index(f"{LENGTH_OFFSET}.c")])
    what = f"all distances look {abs(value):.3g} mm too {'long' if value > 0.0 else 'short'}"
    fall = f"the RMS falls from {fit.rms_after:.3g} to {wider_fit.rms_after:.3g} mm where that is estimated, too"
    return [
        f'{what}, as by the zero of a wire or the length of a bar: {fall}; add [[effects]] name = "{LENGTH_OFFSET}"'
    ]


# -- whether the rows are enough ---------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sufficiency:
    """What rows can say of a model.

    numbers, parameters : equations and unknowns;  spare : equations that are left to judge the fit
    held : how many of the parameters have a prior of their own, as the geometry of an arm in space
    identifiable : what is determined, in words;  open : combinations that are not
    weak : (name, standard deviation, unit) of parameters that are estimated, but too uncertain to be of use
    tip, tip_measured : expected error of the tip [mm], over the joint limits and at postures like those measured; None:
        not known
    source : of the noise in it, of `SOURCES`; None: not known
    """

    numbers: int
    parameters: int
    spare: int
    held: int
    identifiable: tuple[str, ...]
    open: tuple[str, ...]
    weak: tuple[tuple[str, float, str], ...]
    tip: float | None
    tip_measured: float | None
    source: str | None

    @property
    def few(self) -> bool:
        """Whether fewer numbers are left over than there are parameters: a good fit says little then."""
        return self.spare < self.parameters - self.held

    @property
    def count(self) -> str:
        """`10 numbers for 8 parameters: 2 left to judge the fit`."""
        held = f" ({self.held} held by [machining])" if self.held else ""
        return f"{self.numbers} numbers for {self.parameters} parameters{held}: {self.spare} left to judge the fit"

    @property
    def accuracy(self) -> str:
        """How far the tip may be off, in words."""
        if self.tip is None or self.tip_measured is None or self.source is None:
            why = "something is not determined" if self.open else "needs sigma_mm, repeats of a posture or more rows"
            return f"not known: {why}"
        inside = f"{self.tip_measured:.3g} mm at the tip at postures like those measured"
        return f"{inside}, {self.tip:.3g} mm over the joint limits (RMS), {SOURCES[self.source]}, if the model is right"

    def to_json(self) -> dict[str, Any]:
        """Keys of `check` (identification/files/README.md, "JSON keys")."""
        return {
            "numbers": self.numbers,
            "parameters": self.parameters,
            "spare_numbers": self.spare,
            "identifiable": self.identifiable,
            "weakly_determined": [{"name": name, "std": std, "unit": unit} for name, std, unit in self.weak],
            "expected_tip_mm": self.tip,
            "expected_tip_measured_mm": self.tip_measured,
            "expected_tip_from": self.source,
        }


def sufficiency(fit: Identification, measurements: Measurements, floor: NoiseFloor) -> Sufficiency:
    """What these rows can say of the model that was fitted to them.

    floor : what repeats scatter by
    """
    held = frozenset(fit.prior.names) if fit.prior is not None else frozenset[str]()
    parameters, spare = len(fit.names), max(fit.dof, 0)
    judged: Identification | None = fit
    source = None if fit.expected_tip is None else "sigma" if fit.uncertainty.kind == "given" else "residuals"
    if spare < parameters - len(held):  # few: the noise has to be known without the fit
        judged, source = None, None
        if fit.sigma_known:
            judged, source = estimate(fit.model, measurements, sigma="given"), "sigma"
        elif floor.value:
            sigma = floor.value / float(np.sqrt(fit.residuals_after[:, POINT].shape[1]))
            judged, source = estimate(fit.model, measurements, sigma=sigma), "repeats"
    # parameters without a prior, as where base and reflector are, that stay more uncertain than the frames of the arm
    # by `UNUSUAL` times, though the machining holds these; where nothing is held, such ones are not estimated at all
    weak: tuple[tuple[str, float, str], ...] = ()
    judge = judged or fit
    if judge.prior is not None and judge.model.arm.chain.redundant:
        machining = judge.model.arm.machining
        far = {"mm": UNUSUAL * machining.translation, "rad": UNUSUAL * machining.rotation}
        stds = zip(judge.model.parameters, judge.std.tolist(), strict=True)
        free = [(p, std) for p, std in stds if p.name not in judge.prior.names]
        weak = tuple((p.name, std * p.to_file, p.file_unit) for p, std in free if std > far.get(p.unit, np.inf))
    return Sufficiency(
        numbers=fit.residuals_after.size,
        parameters=parameters,
        spare=spare,
        held=len(held),
        identifiable=_in_words(fit, held, {name for name, *_ in weak}),
        open=fit.not_identifiable,
        weak=weak,
        tip=None if judged is None else judged.expected_tip,
        tip_measured=None if judged is None else judged.expected_tip_measured,
        source=source,
    )


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
@dataclass(frozen=True)
class Sag:
    """What compliance of the joints explains, with gravity along the last axis of the base.

    masses : (n,) of the links [kg];  from_urdf : as the URDF file has them; False: 1 kg each
    rms_before, rms_after, max_before, max_after : distances [mm] of each posture from where a fit of the geometry to
        all others puts it, without and with compliance;  p_value : one-sided, of no gain
    """

    masses: tuple[float, ...]
    from_urdf: bool
    dimension: int
    rms_before: float
    rms_after: float
    max_before: float
    max_after: float
    p_value: float

    @property
    def recommended(self) -> bool:
        """Whether the arm sags beyond doubt, and by enough to matter."""
        # one-sided, one question of each data set; less than 3 % of the RMS distance is not worth another table
        return self.p_value <= 0.01 and self.rms_after <= 0.97 * self.rms_before

    @property
    def lines(self) -> tuple[str, ...]:
        """The TOML to add."""
        down = ", ".join(["0.0"] * (self.dimension - 1) + [f"{-G}"])
        return ("[gravity]", f"acceleration_m_s2 = [{down}]", f"link_masses_kg = {[round(m, 4) for m in self.masses]}")

    @property
    def sentence(self) -> str:
        """The recommendation."""
        figures = f"{self.rms_before:.3g} to {self.rms_after:.3g} mm RMS (largest {self.max_before:.3g} to"
        figures += f" {self.max_after:.3g} mm) in postures not fitted, p = {self.p_value:.1g}"
        up = "xyz"[self.dimension - 1]
        masses = (
            "the masses are those of the URDF file"
            if self.from_urdf
            else "1 kg stands for the mass of each link, and the compliances take up the scale; real masses are better"
        )
        return (
            f"the arm sags: compliant joints under gravity take the error from {figures}. Add the lines below to the "
            f"arm file; {masses}. {up} of the base is taken to point up"
        )

    def to_json(self) -> dict[str, Any]:
        """Key `gravity` of `check` (identification/files/README.md, "JSON keys")."""
        lengths = {f"{name}_mm": getattr(self, name) for name in ("rms_before", "rms_after", "max_before", "max_after")}
        named = {"masses_kg": list(self.masses), "masses_from": "urdf" if self.from_urdf else "unit"}
        return {"recommended": self.recommended, **lengths, "p_value": self.p_value, **named, "lines": list(self.lines)}


def sag(arm: Arm, measurements: Measurements, fit: Identification, masses: Sequence[float] | None = None) -> Sag | None:
    """What compliance of the joints explains beyond the geometry of an arm without gravity.

    fit : of the geometry to these measurements;  masses : (n,) of the links [kg] where they are known

    None where the arm has gravity, no joint bears a weight, or the measurements determine the one fit or the other not.
    """
    if arm.gravity is not None:
        return None
    kilograms = np.ones(arm.links) if masses is None else np.asarray(masses, dtype=float)
    down = np.zeros(arm.dimension)
    down[-1] = -G
    heavy = replace(arm, gravity=Gravity(down, kilograms, np.full(arm.links, 0.5)))
    torques = Model(heavy).on_chain(lambda chain: chain.torques)(measurements.postures, measurements.conditions)
    sizes = np.sqrt(np.mean(torques**2, axis=0))
    modelled = {effect.joint for effect in arm.effects if effect.name == "joint_compliance"}
    joints = [j for j in (np.flatnonzero(sizes > LEVER * sizes.max()) + 1).tolist() if j not in modelled]
    soft = heavy.with_effects(*arm.effects, *(EffectSpec("joint_compliance", j) for j in joints))
    try:
        sagging = estimate(Model(with_sessions(soft, measurements)), measurements)
    except InputError:  # too few rows
        return None
    left = [left_out_residuals(one, measurements) for one in (fit, sagging)]
    distances_left = [distances(residuals) for residuals in left if residuals is not None]
    if len(distances_left) < len(left):
        return None
    before, after = distances_left
    return Sag(
        masses=tuple(kilograms.tolist()),
        from_urdf=masses is not None,
        dimension=arm.dimension,
        rms_before=float(np.sqrt(np.mean(before**2))),
        rms_after=float(np.sqrt(np.mean(after**2))),
        max_before=float(before.max()),
        max_after=float(after.max()),
        p_value=gained_squares(before, after, measurements).p_above(),
    )
