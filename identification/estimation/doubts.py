"""What is doubtful about a fit, in sentences, and how far its tip may be from where it is computed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from identification.arm import OVERSHOOT, Arm
from identification.arrays import Array, rows_in_words
from identification.documents.identification import MOVED, reading_unit
from identification.estimation.problem import Problem
from identification.estimation.uncertainty import LEVEL, WhiteRows, decomposed_groups
from identification.information import ALONE, spectrum
from identification.inspection.readings import DRAWN, read_differently
from identification.kinematics.chain import ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.kinematics.counting import turned_into
from identification.kinematics.parameters import FILE_UNITS, JOINT_OFFSET, JOINT_UNITS, LENGTH_ERROR, REVOLUTE
from identification.measurements import POINT, Measurements, distances, rms_distance
from identification.model import Model
from identification.model.placed import FEWEST, placing, tip_jacobian
from identification.running import single_thread

if TYPE_CHECKING:
    from identification.estimation.result import Identification

# reasons: identification/README.md, "Doubtful fits"
FAR_ZERO = np.radians(5.0)  # an offset that is no machining error
FAR = 0.05  # of the reach, or a radian: residuals of another arm, frame or unit
FALL = 2.0  # of the RMS, when the position of the base is added: the data are in another frame
OTHER_FRAME = "the data are not in the frame of the arm"
# derived: degrees of freedom below which nothing is tested, and no standard deviation reported, since it would be
# uncertain by more than 35 %. At the level 0.005 an effect of one parameter needs lambda = 11 with 4, 22 with 3
SPARE = 4
UNUSUAL = 8.0  # times the machining's sizes, from which a mistake is likelier than such an arm
TELLS = " armcal check can tell"  # the end of sentences that ask
OTHERS = f"other units, joints in another order or with another sign?{TELLS}"
FEW = "too few measurements"  # the beginning of that sentence


def doubts_of_fit(
    model: Model, x: Array, identifiable: NDArray[np.bool_], before: Array, residual: Array, measurements: Measurements
) -> tuple[tuple[str, ...], bool]:
    """What is doubtful about a fit, worst first, and whether it is no result to work with;  x, identifiable : (p,)
    before, residual : (m, d) [mm], of the arm as it was and as fitted"""
    bad, arm = far_off(residual, model), getattr(model, "arm", None)  # other models have none
    if arm is None:
        return tuple(bad), bool(bad)
    read, hidden = misread(arm, measurements) if rms_distance(before) > DRAWN * arm.reach else ([], False)
    bad = [*(read if hidden else []), *bad, *flipped(model, x, identifiable)]
    others = [] if hidden else (read and far_zeros(model, x)) or read
    others += [*another_frame(model, measurements), *moved_points(model, x, residual, measurements)]
    others += [*outside_limits(arm, measurements), *copied_rows(measurements), *payload_of_several(model, measurements)]
    others += only_rounding(residual, model, measurements) if residual.size > x.size else []
    return (*bad, *others), bool(bad)


def far_off(residual: Array, model: Model) -> list[str]:
    """Residuals that no effect of an arm explains, nor the noise that its file gives."""
    left, reach, arm = rms_distance(residual), model.reach, getattr(model, "arm", None)
    noise, scale = getattr(arm, "sigma", None) or 0.0, arm.chain.angle_scale if arm else None
    if scale and (turned := rms_distance(residual[:, POINT.stop :]) / scale) > max(FAR, 2.0 * noise * 3**0.5 / scale):
        leaves = f"the fit leaves orientations {np.degrees(turned):.3g} deg off, RMS"
        return [f"implausible: {leaves}; other axes or units, or another order of the angles?{TELLS}"]
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
    return [f"implausible: {sentence}; armcal check says more" for sentence in reading.sentences], True


def far_zeros(model: Model, parameters: Array, std: Array | None = None) -> list[str]:
    """Joints whose zero is another one than the drawing's, by more than two standard deviations where these are known;
    that of a planar arm's first is the frame's rotation; as the controller counts."""
    arm, both = model.arm, (parameters, np.zeros_like(parameters) if std is None else std)
    names = [f"{JOINT_OFFSET}:{j}" for j in range(1, model.arm.links + 1)]
    offsets, deviations = (np.array([model.parameters.mapping(x).get(name, 0.0) for name in names]) for x in both)
    off = (arm.counting.matrix @ offsets + np.pi) % (2.0 * np.pi) - np.pi
    least = np.maximum(FAR_ZERO, 2.0 * np.linalg.norm(arm.counting.matrix * deviations, axis=1))
    turned = (np.abs(off) > least) & [kind == REVOLUTE for kind in arm.joint_types]
    far = ", ".join(f"{np.degrees(off[j]):.1f} deg at joint {j + 1}" for j in np.flatnonzero(turned) if j)
    return [f"zeros differ from the drawing's: {far}"] if far else []


def far_from_drawing(arm: Arm, width: float, of_zeros: float) -> list[str]:
    """Sizes of the machining that the prior was taken with: so many times those of the arm file, and of zeros of joints
    so many times more."""
    rotation, translation = f"{np.degrees(arm.machining.rotation):g} deg", f"{arm.machining.translation:g} mm"
    ask = f"; are units, order and signs of joints and coordinates right?{TELLS}"
    sizes = f"than [machining] says ({translation} and {rotation}); the fit uses {width:g} times that"
    zeros = f"than [machining] says ({rotation}); the fit uses {width * of_zeros:g} times that"
    why = "as after a change of motor, or if the drawing counts from elsewhere"
    sentences = [f"the arm is farther from its drawing {sizes}{ask if width >= UNUSUAL else ''}"] * (width != 1.0)
    return sentences + [f"zeros of joints are farther from the drawing {zeros}, {why}"] * (of_zeros != 1.0)


def far_rows(
    residual: Array, data: Measurements, arm: Arm | None, outlier: NDArray[np.bool_], together: NDArray[np.bool_]
) -> list[str]:
    """Which rows nothing explains: by themselves, and those that come together (`uncertainty.together`)."""
    scale, sizes = arm.chain.angle_scale if arm else None, {reading_unit(arm): distances(residual)}
    sizes |= {"deg": np.degrees(distances(residual[:, POINT.stop :]) / scale)} if scale else {}
    # of all coordinates, and beside what each row is known to scatter by
    times = np.linalg.norm(residual, axis=1) / (1.0 if data.sigma is None else data.sigma)
    times /= max(float(np.median(times[~(outlier | together)])), np.finfo(float).tiny)
    by = "" if data.sigma is None else " (relative to the sigma_mm of each row)"
    causes = (
        "a lost beam or contact, an arm that was still moving, or an effect that the model lacks. armcal diagnose "
        "tells which; identify --without-outliers leaves such rows out",
        "not single rows but whole postures or neighbors: an effect that the model lacks (gravity, play), or postures "
        "where the arm stood elsewhere. They stay in the fit; delete them only if you know why they are wrong",
    )
    return [
        f"{rows_in_words(rows)}: up to {' and '.join(f'{x[rows].max():.4g} {unit}' for unit, x in sizes.items())} off, "
        f"{times[rows].max():.3g} times the median of the others{by}: {cause}"
        for rows, cause in zip((outlier, together), causes, strict=True)
        if rows.any()
    ]


def rounding(model: Model, measurements: Measurements) -> float:
    """RMS distance [mm] that the sums of a fit to data without noise are rounded by, at most."""
    return 1e-13 * max(model.reach, float(np.max(np.abs(measurements.positions))))


def only_rounding(residual: Array, model: Model, measurements: Measurements) -> list[str]:
    """Residuals of the size of rounding, as of data without noise, for which standard deviations mean nothing."""
    if (left := rms_distance(residual)) > rounding(model, measurements):
        return []
    reason = "data without noise, or contacts that do not depend on the joints; standard deviations mean nothing"
    return [f"the fit leaves {left:.2g} mm RMS, which is rounding: {reason}"]


def flipped(model: Model, parameters: Array, identifiable: NDArray[np.bool_]) -> list[str]:
    """The correction that is the largest beside what machining can do: a link whose length changes sign or by the order
    of the length; in space a frame, where a joint with the wrong sign is likelier, or all of them together, which share
    what is one length of the arm."""
    # many small errors are none: the root of the sum of their squares
    shifts = np.where([p.kind == TRANSLATION_ERROR for p in model.parameters], parameters, 0.0)
    if (moved := np.linalg.norm(shifts)) > 0.1 * model.reach:
        worst = int(np.argmax(np.abs(shifts)))
        farthest = f"most in {model.names[worst]}: {shifts[worst]:.4g} mm"
        return [f"implausible: frames of joints come out {moved:.4g} mm from the drawing, {farthest}; {OTHERS}"]
    lengths = np.array([model.arm.lengths[(p.joint or 1) - 1] for p in model.parameters])
    of_links = np.array([p.kind == LENGTH_ERROR for p in model.parameters])
    others = [np.radians(30.0) if p.kind == ROTATION_ERROR else np.inf for p in model.parameters]
    excess = np.abs(parameters) / np.where(of_links & identifiable, 0.5 * lengths, others)
    worst = int(np.argmax(excess))
    p, value, length = model.parameters[worst], float(parameters[worst]), lengths[worst]
    if excess[worst] <= 1.0:
        return []
    if of_links[worst]:
        comparison = f"link {p.joint} of {length:g} mm comes out {length + value:.4g} mm long"
        return [f"implausible: {comparison}; another arm, frame or unit?"]
    return [f"implausible: {p.name} comes out as {value * p.to_file:.4g} {p.file_unit}; {OTHERS}"]


def another_frame(model: Model, measurements: Measurements) -> list[str]:
    """The offer of `base_offset` where the residuals fall by a large factor with it.

    Any rotation of the frame is the offset of joint 1, so that only the position of the base can be missing. What the
    arm's effects do, by the values in its file, is no part of it.
    """
    arm, q, m = model.arm, measurements.postures, len(measurements)
    spare = measurements.positions.size - 2 * (arm.links + 1)
    if spare < SPARE or not {*arm.chain.standing_effects}.difference(effect.name for effect in arm.effects):
        return []
    # eq. 1 is linear in the links, and in the base: the triangle of their columns and what the arm as it is leaves
    residual = (measurements.positions - model.position(q, conditions=measurements.conditions)) @ [1.0, 1j]
    columns = np.column_stack([np.exp(1j * np.cumsum(q, axis=1)), np.ones(m), residual])
    (_, beside_links), (_, left) = np.asarray(np.linalg.qr(columns, mode="r"))[-2:, -2:]
    free = abs(left) ** 2  # sum of squares [mm^2] that is left, and that of a base which is held
    held = free + abs(beside_links) ** 2
    before, after = np.sqrt(held / m), np.sqrt(free / m)
    if before <= rounding(model, measurements) or not worth_freeing(held, free, 2, spare, FALL**2):
        return []
    fall = f"the RMS falls from {before:.4g} to {after:.4g} mm if the position of the base is estimated, too"
    return [f'{OTHER_FRAME}: {fall}; add [[effects]] name = "base_offset" to the arm file']


def moved_points(model: Model, x: Array, residual: Array, measurements: Measurements) -> list[str]:
    """That measured points were mounted again between sessions under the same names, where the residuals (m, d) of a
    fit fall by a large factor if each session has its own."""
    session, column = measurements.numbers("session"), model.arm.chain.point_column
    points = [k for k, p in enumerate(model.parameters) if p.kind == TOOL]
    if not np.ptp(session) or not points or not column:
        return []
    jacobian = model.jacobian(measurements.postures, x, measurements.conditions)
    own = [jacobian[:, :, points] * (session == number)[:, None, None] for number in np.unique(session)[1:]]
    scales = np.concatenate([model.scales, *[model.scales[points]] * len(own)])
    tables = (columns.reshape(residual.size, -1) for columns in (jacobian, np.concatenate([jacobian, *own], axis=2)))
    bases = [table @ spectrum(table, scales[: table.shape[1]]).root for table in tables]
    held, free = (float(np.sum(np.square(residual.ravel() - q @ (q.T @ residual.ravel())))) for q in bases)
    fewer, more = (q.shape[1] for q in bases)
    if not worth_freeing(held, free, more - fewer, residual.size - more, FALL**2):
        return []
    # by a linear estimate: that it falls much is certain, how far is not
    fall = f"the RMS, {np.sqrt(held / len(residual)):.4g} mm, falls by more than half if each session has its own"
    return [f"{MOVED}: {fall}; give them another name (column {column}) in each session"]


def lacking(model: Model, measurements: Measurements) -> list[str]:
    """What a model needs of rows that it is to predict, and what is taken where they do not have it; not of what
    happened once in another session, which is over there."""
    said = list[str]()
    for need, column, missing, instead in (
        ("temperature", "temperature_C", measurements.temperature is None, "the mean temperature"),
        ("time", "order or time_s", measurements.order is None, "the order of the rows"),
    ):
        if missing and (keys := [e.key for e in model.effects if need in e.needs and not e.once]):
            needs = f"{', '.join(keys)} need{'s' * (len(keys) == 1)}"
            said.append(f"{needs} the column {column}, which the measurements lack: {instead} is used")
    return said


def worth_freeing(held: float, free: float, freed: int, spare: float, factor: float) -> bool:
    """Whether sums of squares fall, by more than a factor and significantly (F test), where so many further parameters
    are estimated, too;  spare : degrees of freedom that are then left"""
    if freed <= 0 or spare < SPARE or not held > factor * free:
        return False
    return bool(fdtrc(freed, spare, (held - free) / freed / max(free / spare, np.finfo(float).tiny)) <= LEVEL)


def outside_limits(arm: Arm, measurements: Measurements) -> list[str]:
    """How many postures lie outside the joint limits, the first of them, and joints that are within their limits if
    whole turns are taken off."""
    q = measurements.postures
    outside = arm.beyond_limits(q)
    if not outside.any():
        return []
    row = int(np.argmax(outside.any(axis=1)))
    joint = int(np.argmax(outside[row]))
    _, factor, unit = FILE_UNITS[JOINT_UNITS[arm.joint_types[joint]]]
    low, high, place = (v[joint] * factor for v in (*arm.column_limits, arm.counting.columns(q[row])))
    first = f"row {row + 1}: joint {joint + 1} at {place:.5g} {unit[1:]}, allowed {low:g} to {high:g}"
    count = int(outside.any(axis=1).sum())
    sentence = f"{count} of {len(q)} postures lie outside the joint limits, the first in {first}"
    within = ~arm.beyond_limits(turned_into(q, arm.lower, arm.upper, arm.joint_types, OVERSHOOT))
    joints = np.flatnonzero(np.any(outside & within, axis=0)) + 1
    if not joints.size:
        return [sentence]
    which = f"joint{'s' if joints.size > 1 else ''} {', '.join(map(str, joints.tolist()))}"
    away = "would be within them after whole turns (360 deg): count these readings from the drawing's zero"
    return [f"{sentence}; {which} {away}"]


def copied_rows(measurements: Measurements) -> list[str]:
    """Rows that repeat posture and position of another row to the last digit, as hardly any instrument does."""
    rows = np.flatnonzero(measurements.originals != np.arange(len(measurements)))
    if not rows.size:
        return []
    copies = "is an exact copy of another (" if rows.size == 1 else "are exact copies of others (the first: "
    first = f"row {rows[0] + 1} of row {measurements.originals[rows[0]] + 1}"
    return [f"{rows.size} of {len(measurements)} rows {copies}{first}); identify and diagnose count no row twice"]


def payload_of_several(model: Model, measurements: Measurements) -> list[str]:
    """At which of several measured points a payload is taken to hang: which one is first may be chance."""
    arm, (first, *others) = model.arm, model.arm.chain.tools
    is_there = measurements.payload is not None or arm.payload > 0.0
    acts = is_there and others and any("gravity" in effect.needs for effect in model.effects)
    if not acts or arm.gravity is None or arm.gravity.payload_at is not None:
        return []
    where = f"{first}, the first that was measured, as {', '.join(others)} might be"
    return [f"the payload is taken to hang at measured point {where}: give payload_at_mm in [gravity]"]


# -- the covariance of the parameters, at the tip ----------------------------------------------------------------------
@single_thread()  # the same bits, whatever the number of threads
def expected_tip(model: Model, parameters: Array, covariance: Array, postures: Array) -> float:
    """Root mean square over postures (m, n) [rad] of the expected distance [mm], root of the mean of trace(J C J^T),
    C the covariance (p, p) of the parameters (p,).

    The tip is the first measured point, in the frame of the measurements (of lengths: best registered again), under
    neutral conditions. What the model lacks is not in it.
    """
    jacobian = tip_jacobian(model, postures, parameters)
    total = float(np.einsum("mdp,pq,mdq->", jacobian, covariance, jacobian, optimize=True))
    return float(np.sqrt(max(total, 0.0) / len(postures)))  # below zero by rounding, where data have no noise


def tips_of(fit: Identification) -> tuple[float, float] | None:
    """`expected_tip` of a fit [mm] over the joint limits, whatever they are, and over further postures like those
    measured; None where something is not identifiable, without deviations, and of other models than an arm's.

    Real postures fill no box of joint angles. What the fit is uncertain by at its own postures is less than at others
    drawn as they were, by `inside`; and hardly less than in the box of their angles, whatever few rows say: the range
    that k random angles are drawn from exceeds theirs by 1 / (k - 1) of it on either side, in the mean.
    """
    arm, postures, covariance = fit.arm, fit.postures, fit.covariance
    if arm is None or fit.not_identifiable or not np.all(np.isfinite(covariance)):
        return None
    if not arm.chain.instrument.places and len(postures) < FEWEST:
        return None
    low, high = postures.min(axis=0), postures.max(axis=0)
    beyond = (high - low) / max(len(np.unique(postures, axis=0)) - 1, 1)
    box = np.maximum(low - beyond, np.minimum(low, arm.lower)), np.minimum(high + beyond, np.maximum(high, arm.upper))
    boxes = (arm.lower, arm.upper), box
    drawn = (np.random.default_rng(0).uniform(low, high, (1000, arm.links)) for low, high in boxes)
    anywhere, in_box = (expected_tip(fit.model, fit.parameters, covariance, some) for some in drawn)
    at_measured = expected_tip(fit.model, fit.parameters, covariance, postures[:: max(len(postures) // 1000, 1)])
    return anywhere, min(in_box, at_measured / float(np.sqrt(fit.inside)))


def hardly_determined(fit: Identification) -> list[str]:
    """What is doubtful about a fit that leaves the tip uncertain, beyond the noise of one measurement: by over half of
    what the arm was off before, at postures like those measured; or by more than all of it, over the joint limits. Of
    readings that are no lengths nothing is said: both are millimetres."""
    if fit.tips is None or reading_unit(fit.arm) != "mm":
        return []
    anywhere, inside = fit.tips  # without the posture's own error, which no further rows help against
    arm, equations, places = fit.model.arm, fit.residuals_before.size, placing(fit.model.parameters)
    spare = equations - len(places)
    more = len(places) < len(fit.names) - len(fit.held)  # than its place, which says nothing of the arm
    before = (fit.rms_before if more else fit.rms_after) * float(np.sqrt(equations / spare)) if spare > 0 else 0.0
    noise = max(fit.scatter or 0.0, fit.sigma or 0.0) * float(np.sqrt(arm.dimension))
    few, far_off = inside > max(0.5 * before, noise), anywhere > max(before, noise)
    if not (few or far_off):
        return []
    # what more postures do not help against: readings that an arm twice as large would give as well
    readings, remedy = arm.chain.size_is_open
    however_many = f"; but however many there are, {readings} fit an arm of any size: {remedy}"
    open_size = however_many if readings else f", or {remedy}" if remedy else ""
    far = f"{fit.rms_before:{'.3g' if fit.rms_before < 1000.0 else '.0f'}} mm"
    was = f"; before the fit the arm was {far} off where it was measured" if spare > 0 and more else ""
    tools = [k for k, p in enumerate(fit.model.parameters) if p.kind == TOOL]
    # a point that is less sure than machining leaves it, along every axis, moves together with the base
    apart = bool(tools) and float(np.min(fit.std[tools])) > arm.machining.translation
    turns = ", which turn the flange about all its axes to tell base and tool apart" if apart else ""
    if few:
        doubt = f"at other postures like those measured the tip may be {inside:.3g} mm (RMS) from where it is computed"
        return [f"{FEW}: {doubt}{was}. Measure more postures{turns}{open_size}"]
    doubt = f"the tip may be {anywhere:.3g} mm (RMS over the joint limits) from where it is computed{was}"
    return [f"away from the postures measured {doubt}. Stay near these postures, or measure others{turns}{open_size}"]


# -- postures left out -------------------------------------------------------------------------------------------------
@single_thread()
def left_out_residuals(fit: Identification, measurements: Measurements) -> Array | None:
    """(m, d) each posture's positions less where a fit to all other postures puts them [mm].

    With the leverages H_g = Q_g Q_g^T of the rows of a posture the residuals without them are (I - H_g)^-1 r_g =
    r_g + Q_g (I - Q_g^T Q_g)^-1 Q_g^T r_g: exact for a model that is linear in its parameters, and to first order for
    any other (R. D. Cook, S. Weisberg, "Residuals and Influence in Regression", 1982, section 2.2). The noise of one
    measurement is in it. Copies do not count, and get what is left of the row they copy.

    None where something is not identifiable, or a posture alone determines it.
    """
    if fit.not_identifiable or len(measurements) != len(fit.residuals_after):
        return None
    free, held = [name not in fit.held for name in fit.names], {name: fit.values[name] for name in fit.held}
    model = replace(fit.model, held={**(fit.model.held or {}), **held}) if held else fit.model
    problem = Problem.of(model, measurements, prior=fit.prior)
    problem = replace(problem, noise=(fit.scatter or 0.0) / (problem.sigma or 1.0))
    rows = WhiteRows.of(problem, measurements, fit.parameters[free])
    pull = np.empty((int(rows.postures.max()) + 1, rows.columns.shape[2]))
    for alike, leverages, vectors, scores in decomposed_groups(rows.columns, rows.residual, rows.postures):
        if leverages.max() > 1.0 - ALONE:
            return None
        pull[alike] = ((scores / (1.0 - leverages))[:, None, :] @ vectors)[:, 0]
    without = rows.residual + np.einsum("mdr,mr->md", rows.columns, pull[rows.postures])
    kept = problem.weights > 0.0
    return np.asarray((without / problem.root_weights[kept])[np.cumsum(kept)[measurements.originals] - 1])
