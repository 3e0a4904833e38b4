"""Inspection of measurements before any fit: ranges, repeats, frames, signs, and what can be identified from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.document import Document
from identification.documents.identification import MISFIT
from identification.documents.inspection import inspection_document
from identification.errors import InputError
from identification.estimation import Identification, estimate
from identification.estimation.doubts import (
    another_frame,
    beyond_limits,
    copied_rows,
    far_rows,
    far_zeros,
    limited,
    outside_limits,
)
from identification.estimation.expected_tip import FEW, TOGETHER, hardly_determined
from identification.gap.noise import NoiseFloor, noise_floor, with_repeats_doubted
from identification.inspection.data_checks import data_warnings, gap_notes, wrong_units
from identification.inspection.enough import Sufficiency, sufficiency
from identification.inspection.readings import (
    Readings,
    as_written,
    joints_of_unseen_sign,
    out_of_step,
    read_differently,
)
from identification.inspection.sag import Sag, sag
from identification.inspection.set_up import constant_length, other_base, turned_frame
from identification.kinematics.counting import in_columns
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.sessions import with_sessions
from identification.status import Status
from identification.validate import drawing_residuals
from identification.workspace import ColumnLimits

STILL = np.radians(5.0)  # [rad] of a joint's range, below which its own errors are hardly seen
ROUGH = 0.02  # of the reach: more than a drawing is off by
MUCH = 0.01  # of the reach: more than the effects of an arm leave where they are not in the model
ALIKE = 1.05  # times as much is left: no telling which angles are the better ones
HARDLY_LESS = 0.8  # of what the drawing leaves: a fit that explains nothing


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

    rows, postures : how many rows, and of how many postures
    repeated : whether a posture was measured again in the same session, by the same marker
    given : optional columns;  floor : what repeats scatter by
    readings : the columns as they are, and a better way to read them if there is one
    drawing : RMS distance [mm] that the drawing leaves with its place in the instrument's frame fitted, as of
        `validate`;  fit : the geometry fitted, None with too few rows;  enough : what the rows can say of it
    commanded : RMS distance [mm] that a fit to commanded angles leaves, None: there are none beside those read
    other_units : the numbers are of other units, so that neither a fit nor limits would mean anything
    units : sentences about units, swapped markers and rows that are far off;  frame : about a base elsewhere, or
        distances off by a constant;  turned : about a frame at another angle
    step : about positions beside another posture
    unseen : joints (from 1) whose sign and zero do not show;  sag : what gravity explains, None: not known
    rest : about copied rows and postures outside the limits;  gaps : about rows that are missing between others
    """

    arm: Arm
    rows: int
    postures: int
    repeated: bool
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
    units: tuple[str, ...]
    frame: tuple[str, ...]
    turned: tuple[str, ...]
    step: tuple[str, ...]
    unseen: tuple[int, ...]
    rest: tuple[str, ...]
    gaps: tuple[str, ...]
    sag: Sag | None = None

    @property
    def problems(self) -> tuple[str, ...]:
        """What should be put right before anything is fitted, in sentences."""
        # a later one may follow from an earlier one
        fit, better, zeros = self.fit, self.readings.better, list[str]()
        if fit is not None and fit.status is not Status.implausible and (better is None or better.moved_zeros):
            zeros = far_zeros(fit.model, fit.parameters)  # several at once, where another reading has one or two
        sentences = [*self.units] or ([] if zeros else self.readings.sentences) or [*self.frame] or zeros
        if self.drawing > ROUGH * self.arm.reach and not sentences:
            off = f"the drawing is {self.drawing:.4g} mm off wherever the arm stands: check lengths and columns"
            sentences += self.step or [off]
        if fit is not None and not sentences:
            rows = np.arange(self.rows) + 1
            unexplained = (np.isin(rows, numbers) for numbers in (fit.outlier_rows, fit.unexplained_rows))
            sentences += far_rows(fit.residuals_after, *unexplained) or self._unexplained(fit)
        if fit is None and not self.other_units:
            sentences.append("too few rows for a fit of the geometry")
        if fit is not None and not sentences and fit.dof <= 0:  # it leaves little whatever the data are
            numbers, unknowns = fit.residuals_after.size, len(fit.names)
            sentences = [f"{FEW}: {numbers} numbers for {unknowns} unknowns. Measure more postures"]
        elif fit is not None and not sentences:
            sentences = [sentence for sentence in hardly_determined(fit) if sentence.startswith((FEW, TOGETHER))]
        return (*sentences, *self.rest)

    def _unexplained(self, fit: Identification) -> list[str]:
        """That no geometry makes the rows those of one arm, where they are far from it and noise is not the reason."""
        noise = 3.0 * (self.arm.sigma or 0.0) * np.sqrt(self.arm.dimension)
        if fit.rms_after <= max(MUCH * self.arm.reach, HARDLY_LESS * self.drawing, noise):
            return []
        left = f"a fit leaves {fit.rms_after:.4g} mm of the {self.drawing:.4g} mm that the drawing leaves"
        mixed = "columns, units or markers that changed" if self.markers else "columns or units that changed"
        return [f"{left}, so that no geometry explains these rows: look for {mixed}, or an instrument that moved"]

    @property
    def notes(self) -> tuple[str, ...]:
        """What these data cannot say, in sentences."""
        fit, still, sentences = self.fit, [str(j.joint) for j in self.joints if j.still], list[str]()
        if still and not self.other_units:
            hardly = "joint {} hardly moves: its" if len(still) == 1 else "joints {} hardly move: their"
            sentences.append(f"{hardly.format(', '.join(still))} own errors cannot be seen")
        sentences += self.turned
        why = "the measured point is on its axis, or so near that the drawing's errors hide it"
        for j in (j for j in self.unseen if str(j) not in still):
            sentences.append(f"which way joint {j} turns and where its zero is do not show in these data: {why}")
        if fit is not None and self.commanded is not None:
            sentences.append(_better_angles(rms_distance(fit.residuals_after), self.commanded))
        if fit is not None and not self.problems:  # a fit leaves more than noise, by chi2 or by repeats
            looks = fit.misfit and f"{fit.misfit.partition('. ')[0]}; armcal diagnose looks for what is missing"
            sentences += [looks] if looks else [doubt for doubt in fit.doubts if doubt.startswith(MISFIT)]
        if fit is not None and fit.not_identifiable:
            sentences.append(f"not estimable separately: {'; '.join(fit.not_identifiable)}")
        if not self.repeated:
            sentences.append("no posture is repeated: the arm's repeatability is not known from these data")
        sentences += self.gaps
        advised = self.sag is not None and self.sag.recommended
        if self.sag is not None and advised:
            sentences.append(self.sag.sentence)
        untested = {} if "temperature" in self.given else {"temperature": "a column temperature_C"}
        if self.arm.gravity is None and not advised:
            untested["gravity"] = "[gravity] in the arm file"
        if untested:
            effects, needed = " and ".join(untested), " and ".join(untested.values())
            sentences.append(f"effects of {effects} are not tested without {needed}")
        return tuple(sentences)

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


def _better_angles(read: float, commanded: float) -> str:
    """Which angles explain the positions better, by what a fit leaves of them [mm]."""
    figures = f"a fit to the angles read leaves {read:.3g} mm RMS, to those commanded {commanded:.3g} mm"
    if max(read, commanded) <= ALIKE * min(read, commanded):
        return f"{figures}: which of them a fit uses makes no difference"
    if read < commanded:
        return f"{figures}: the positions are those of the angles read, which every fit uses"
    return f"{figures}: the positions are those of the angles commanded: give these as q1_deg.. instead"


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
    asked, by_command = measurements.commanded, None
    if asked is not None and not other_units and not np.array_equal(asked, measurements.postures):
        by_command = _fit(arm, replace(measurements, postures=asked, commanded=None))
    units = data_warnings(measurements, arm)
    readings = (as_written if other_units else read_differently)(arm, measurements)
    try:
        drawing = rms_distance(drawing_residuals(arm, measurements))
    except InputError:  # too few rows for least squares
        drawing = readings.written.rms
    frame = [*another_frame(arm, measurements), *other_base(arm, measurements)] if not other_units else []
    return Inspection(
        arm=arm,
        rows=len(measurements),
        postures=len(np.unique(measurements.posture_numbers)),
        repeated=len(np.unique(measurements.repeat_numbers)) < len(measurements),
        sessions=measurements.sessions,
        markers=measurements.marker_names,
        given=tuple(sorted(measurements.optional_columns)),
        joints=_ranges(arm, measurements.postures),
        floor=floor,
        readings=readings,
        drawing=drawing,
        fit=fit,
        enough=None if fit is None else sufficiency(fit, measurements, floor),
        commanded=None if by_command is None else rms_distance(by_command.residuals_after),
        other_units=other_units,
        units=tuple(units),
        frame=(*frame, *([] if other_units else constant_length(arm, measurements, fit))),
        turned=() if other_units else tuple(turned_frame(arm, measurements)),
        unseen=joints_of_unseen_sign(arm, measurements),
        step=tuple(out_of_step(arm, measurements)),
        rest=(*copied_rows(measurements), *([] if other_units else outside_limits(arm, measurements))),
        gaps=tuple(gap_notes(measurements)),
        sag=None if fit is None or fit.status is Status.implausible else sag(arm, measurements, fit, masses),
    )


def _fit(arm: Arm, measurements: Measurements) -> Identification | None:
    """The geometry of the arm fitted, None if the rows are too few for it."""
    try:
        fit = estimate(Model(with_sessions(arm, measurements)), measurements)
    except InputError:
        return None
    return with_repeats_doubted(fit, measurements)


def _ranges(arm: Arm, postures: Array) -> tuple[JointRange, ...]:
    beyond = beyond_limits(arm, postures).sum(axis=0)
    tied = {each.joint for each in arm.constraints if isinstance(each, ColumnLimits)}
    shown, (lower, upper) = in_columns(postures, arm.joint_types), arm.column_limits
    has_limits = np.isfinite(lower) & (limited(arm) | [j in tied for j in range(1, arm.links + 1)])
    still = np.ptp(postures, axis=0) < np.where(np.array(arm.joint_types) == REVOLUTE, STILL, 0.0)
    columns = zip(arm.joint_types, shown.T, lower, upper, beyond, has_limits, still, strict=True)
    return tuple(
        JointRange(
            j, kind, float(q.min()), float(q.max()), float(low), float(high), int(outside), bool(has), bool(rests)
        )
        for j, (kind, q, low, high, outside, has, rests) in enumerate(columns, start=1)
    )
