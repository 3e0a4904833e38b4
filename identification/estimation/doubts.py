"""What is doubtful about a fit, in sentences: flipped links, another frame, postures outside the limits, an earlier
calibration as the prior that the measurements contradict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from identification.arm import Arm
from identification.arrays import Array, rows_in_words
from identification.estimation.prior import Earlier
from identification.estimation.uncertainty import LEVEL
from identification.information import RANK_TOLERANCE
from identification.inspection.data_checks import DRAWN
from identification.inspection.readings import read_differently
from identification.kinematics.chain import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.kinematics.closed_form import PlanarClosedForm
from identification.kinematics.counting import in_columns, turned_into
from identification.kinematics.parameters import (
    FILE_UNITS,
    JOINT_OFFSET,
    JOINT_UNITS,
    LENGTH_ERROR,
    REVOLUTE,
    Parameter,
)
from identification.measurements import POINT, Measurements, distances, rms_distance
from identification.model import Model
from identification.workspace import ColumnLimits

if TYPE_CHECKING:
    from identification.estimation.result import Identification

# reasons: identification/README.md, "Doubtful fits"
FAR_ZERO = np.radians(5.0)  # an offset that is no machining error
FAR = 0.05  # of the reach: residuals of another arm, frame or unit
FALL = 2.0  # of the RMS, when the position of the base is added: the data are in another frame
OTHER_FRAME = "the data are in another frame than the arm"
OVERSHOOT = np.radians(0.01)  # what an angle that was read back differs from the one commanded
SPARE = 4  # degrees of freedom
SHOWN = 3  # contradictions in a sentence


def doubts(
    model: Model,
    parameters: Array,
    identifiable: NDArray[np.bool_],
    before: Array,
    residual: Array,
    measurements: Measurements,
) -> tuple[tuple[str, ...], bool]:
    """What is doubtful about a fit, worst first, and whether it is no result to work with.

    parameters, identifiable : (p,);  before, residual : (m, d) [mm], of the arm as it was and as fitted
    """
    arm = getattr(model, "arm", None)  # other models have none
    if arm is None:
        far = far_off(residual, model)
        return tuple(far), bool(far)
    read, implausible = misread(arm, measurements) if rms_distance(before) > DRAWN * arm.reach else ([], False)
    bad = [*(read if implausible else []), *far_off(residual, model), *flipped(model, parameters, identifiable)]
    sentences = [
        *bad,
        *([] if implausible else (read and far_zeros(model, parameters)) or read),
        *another_frame(arm, measurements),
        *outside_limits(arm, measurements),
        *copied_rows(measurements),
        *([] if residual.size <= parameters.size else only_rounding(residual, measurements)),
    ]
    return tuple(sentences), bool(bad)


def far_off(residual: Array, model: Model) -> list[str]:
    """Residuals that no effect of an arm explains, nor the noise that its file gives."""
    left, reach = rms_distance(residual), model.reach
    noise = getattr(getattr(model, "arm", None), "sigma", None) or 0.0
    if left <= max(FAR * reach, 2.0 * noise * np.sqrt(model.dimension)):
        return []
    share = f"{100.0 * left / reach:.0f} % of the reach"
    return [f"implausible: the fit leaves {left:.4g} mm RMS, {share}; another arm, frame, unit or order of joints?"]


def misread(arm: Arm, measurements: Measurements) -> tuple[list[str], bool]:
    """Columns that look swapped, reversed or mirrored, which a fit may hide in errors of the geometry (True), and zeros
    that are elsewhere, which it finds (False)."""
    reading = read_differently(arm, measurements)
    if reading.better is None or reading.better.moved_zeros:
        return [*reading.sentences], False
    return [f"implausible: {sentence}; armcal check tells more" for sentence in reading.sentences], True


def far_zeros(model: Model, parameters: Array) -> list[str]:
    """Joints whose zero is another one than the drawing's; that of a planar arm's first is the frame's rotation."""
    values = {p.joint: x for p, x in zip(model.parameters, parameters, strict=True) if p.kind == JOINT_OFFSET}
    turning = [joint for joint, kind in enumerate(model.arm.joint_types, start=1) if joint > 1 and kind == REVOLUTE]
    counting = model.arm.counting
    shares = np.eye(model.arm.links) if counting is None else counting.matrix
    added = shares @ [values.get(j, 0.0) for j in range(1, model.arm.links + 1)]  # as the controller counts
    offsets = {j: (added[j - 1] + np.pi) % (2.0 * np.pi) - np.pi for j in turning}
    far = [f"{np.degrees(x):.1f} deg at joint {j}" for j, x in offsets.items() if abs(x) > FAR_ZERO]
    return [f"zeros differ from the drawing's: {', '.join(far)}"] if far else []


def far_rows(residual: Array, outlier: NDArray[np.bool_], together: NDArray[np.bool_]) -> list[str]:
    """Which rows nothing explains; residual : (m, d) [mm];  outlier, together : (m,) by themselves, and those that come
    together (`outlying.together`)."""
    off, sentences = distances(residual[:, POINT]), []
    for rows in (outlier, together):
        if rows.any():
            far = f"{rows_in_words(rows)}: up to {off[rows].max():.4g} mm off"
            sentences.append(f"{far}, the others {np.median(off[~(outlier | together)]):.3g} mm in the median: ")
    causes = []
    if outlier.any():
        causes.append(
            "a lost beam, an arm that was still moving, or what the model lacks there. armcal diagnose tells these "
            "apart; identify --without-outliers leaves such rows out"
        )
    if together.any():
        causes.append(
            "not single rows but whole postures or neighbors: what the model lacks there (gravity, play), or postures "
            "where the arm stood elsewhere. They stay in the fit; delete them only if you know why they are wrong"
        )
    return [sentence + cause for sentence, cause in zip(sentences, causes, strict=True)]


def only_rounding(residual: Array, measurements: Measurements) -> list[str]:
    """True for residuals of the size of rounding: data without noise, for which standard deviations mean nothing."""
    left, largest = rms_distance(residual), float(np.max(np.abs(measurements.positions)))
    if left > 1e-13 * largest:  # the sums of a fit to data without noise are rounded by less
        return []
    return [f"the fit leaves {left:.2g} mm RMS, which is rounding: data without noise, deviations mean nothing"]


def flipped(model: Model, parameters: Array, identifiable: NDArray[np.bool_]) -> list[str]:
    """Links whose length changes sign or by the order of the length; in space the correction of a frame that is the
    largest, where no machining is that wrong, but a joint with the wrong sign is."""
    limits, sentences = {ROTATION_ERROR: np.radians(30.0), TRANSLATION_ERROR: 0.1 * model.reach}, list[str]()
    excess = [abs(x) / limits.get(p.kind, np.inf) for p, x in zip(model.parameters, parameters, strict=True)]
    if excess[worst := int(np.argmax(excess))] > 1.0:
        p = model.parameters[worst]
        correction = f"{p.name} comes out as {parameters[worst] * p.to_file:.4g} {p.file_unit}"
        other = "other units, joints in another order or with another sign? armcal check tells"
        sentences.append(f"implausible: {correction}; {other}")
    for p, value, estimable in zip(model.parameters, parameters, identifiable, strict=True):
        if p.kind == LENGTH_ERROR and p.joint is not None and estimable:
            length = float(model.arm.lengths[p.joint - 1])
            if abs(value) > 0.5 * length:
                comparison = f"link {p.joint} of {length:g} mm comes out {length + value:.4g} mm long"
                sentences.append(f"implausible: {comparison}; another arm, frame or unit?")
    return sentences


def another_frame(arm: Arm, measurements: Measurements) -> list[str]:
    """The offer of `base_offset` where the residuals fall by a large factor with it.

    Any rotation of the frame is the offset of joint 1, so that only the position of the base can be missing.
    """
    spare = measurements.positions.size - 2 * (arm.links + 1)
    if not arm.chain.positions_in_plane or spare < SPARE or any(e.name == "base_offset" for e in arm.effects):
        return []
    left = []
    for offset in (False, True):  # sum of squares [mm^2] that the closed form leaves, with or without a base offset
        form = PlanarClosedForm(arm.lengths, offset, np.arange(0), exact=True)
        solve = form.solver(measurements.postures, np.ones(len(measurements)), RANK_TOLERANCE)
        left.append(float(solve(measurements.positions[None])[1][0]))
    if not worth_freeing(left[0], left[1], 2, spare, FALL**2):
        return []
    before, after = (np.sqrt(squares / len(measurements)) for squares in left)
    fall = f"the RMS falls from {before:.4g} to {after:.4g} mm where the position of the base is estimated, too"
    return [f'{OTHER_FRAME}: {fall}; add [[effects]] name = "base_offset" to the arm file']


def worth_freeing(held: float, free: float, freed: int, spare: float, factor: float) -> bool:
    """Whether sums of squares fall, by more than a factor and significantly (F test), where so many further parameters
    are estimated, too;  spare : degrees of freedom that are then left"""
    if freed <= 0 or spare < SPARE or not held > factor * free:
        return False
    return bool(fdtrc(freed, spare, (held - free) / freed / max(free / spare, np.finfo(float).tiny)) <= LEVEL)


def limited(arm: Arm) -> NDArray[np.bool_]:
    """(n,) joints whose limits are given."""
    return np.asarray((np.abs(arm.lower + np.pi) > OVERSHOOT) | (np.abs(arm.upper - np.pi) > OVERSHOOT))


def beyond_limits(arm: Arm, postures: Array) -> NDArray[np.bool_]:
    """(m, n) True where a joint lies outside its limits, one that is counted together with others outside those of the
    controller; limits left out do not count."""
    beyond = limited(arm) & ((postures < arm.lower - OVERSHOOT) | (postures > arm.upper + OVERSHOOT))
    for tied in (each for each in arm.constraints if isinstance(each, ColumnLimits)):
        column = postures @ np.array(tied.coefficients)
        beyond[:, tied.joint - 1] = (column < tied.lower - OVERSHOOT) | (column > tied.upper + OVERSHOOT)
    return beyond


def outside_limits(arm: Arm, measurements: Measurements) -> list[str]:
    """How many postures lie outside the joint limits, the first of them, and joints that are within their limits if
    whole turns are taken off."""
    q = measurements.postures
    outside = beyond_limits(arm, q)
    if not outside.any():
        return []
    row = int(np.argmax(outside.any(axis=1)))
    joint = int(np.argmax(outside[row]))
    _, factor, unit = FILE_UNITS[JOINT_UNITS[arm.joint_types[joint]]]
    low, high, place = (v[joint] * factor for v in (*arm.column_limits, in_columns(q[row], arm.joint_types)))
    count = int(outside.any(axis=1).sum())
    first = f"row {row + 1}: joint {joint + 1} at {place:.5g} {unit[1:]}, allowed {low:g} to {high:g}"
    sentence = f"{count} of {len(q)} postures lie outside the joint limits, the first in {first}"
    within = ~beyond_limits(arm, turned_into(q, arm.lower, arm.upper, arm.joint_types, OVERSHOOT))
    joints = np.flatnonzero(np.any(outside & within, axis=0)) + 1
    if not joints.size:
        return [sentence]
    which = f"joint{'s' if joints.size > 1 else ''} {', '.join(map(str, joints.tolist()))}"
    away = "would be within them whole turns (360 deg) away: count these readings from the drawing's zero"
    return [f"{sentence}; {which} {away}"]


def copied_rows(measurements: Measurements) -> list[str]:
    """Rows that repeat posture and position of another row to the last digit, as hardly any instrument does."""
    rows = np.flatnonzero(measurements.originals != np.arange(len(measurements)))
    if not rows.size:
        return []
    copy, original = int(rows[0]) + 1, int(measurements.originals[rows[0]]) + 1
    number = "1 row is an exact copy" if rows.size == 1 else f"{rows.size} rows are exact copies"
    no = "it is no measurement of its own" if rows.size == 1 else "they are no measurements of their own"
    seen = f"{number} of another (of {len(measurements)} rows): the first row {copy} of row {original}"
    return [f"{seen}: {no}, which identify and diagnose do not count"]


@dataclass(frozen=True)
class Contradiction:
    """A parameter in file units: as the prior has it, and as the measurements do without that prior; both with the
    parameters that are not contradicted as the earlier calibration has them."""

    name: str
    unit: str
    prior: float
    prior_std: float
    value: float
    std: float
    instead: tuple[str, ...] = ()  # parameters that would explain the measurements as well

    @classmethod
    def of(cls, name: str, before: Earlier, fit: Identification, instead: tuple[str, ...]) -> Contradiction:
        """Of a parameter before, and of a fit without that prior."""
        p, deviations = fit.model.parameters[k := fit.names.index(name)], np.sqrt(np.diag(before.covariance))
        k_before = before.names.index(name)
        figures = before.values[k_before], deviations[k_before], fit.parameters[k], fit.std[k]
        prior, prior_std, value, std = (float(x * p.to_file) for x in figures)
        return cls(name, p.file_unit, prior, prior_std, value, std, instead)

    def __str__(self) -> str:
        before, now = f"{self.prior:.4g} +- {self.prior_std:.2g}", f"{self.value:.4g} +- {self.std:.2g}"
        return f"{self.name} is {before} {self.unit} in the earlier calibration, {now} by these measurements" + (
            f" (or instead {', '.join(self.instead)}: they do not tell)" if self.instead else ""
        )

    def to_json(self) -> dict[str, Any]:
        """An entry of `contradicted` (identification/files/README.md, "JSON keys")."""
        return dict(vars(self))


def contradiction_warnings(contradictions: Sequence[Contradiction], without_prior: Sequence[Parameter]) -> list[str]:
    """The warning;  without_prior : parameters without a prior."""
    if not contradictions:
        return []
    rest = f"; and {len(contradictions) - SHOWN} more" if len(contradictions) > SHOWN else ""
    words = [one.name for one in contradictions] + [p.kind if p.kind in (BASE, TOOL) else p.name for p in without_prior]
    sentence = (
        f"the measurements contradict the prior: {'; '.join(map(str, contradictions[:SHOWN]))}{rest} (others as there)"
    )
    do = f"armcal identify with the earlier calibration as ARM and --only {','.join(dict.fromkeys(words))}"
    lacks = "the model lacks what differs between both measurements: armcal diagnose"
    return [
        f"{sentence}. The fit is right for neither. Either they changed and are to be estimated again: {do}; or {lacks}"
    ]
