"""Contradictions within a measurement file: units, conventions of orientations, swapped markers, lost beams.

In space base and measured points are found by the closed form, so that what is left of the nominal arm is its errors,
some millimetres; another unit or another point is off by far more. So it is for a planar arm, its base found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array, rows_in_words
from identification.errors import InputError
from identification.kinematics.orientations import from_angles, to_angles
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.planar import joint_points
from identification.measurements import POINT, Measurements, distances
from identification.model import Model
from identification.model.placed import placed_model

PLACED = 6  # numbers of a center, or a plane with three turns, and a measured point
STANDS = 6  # numbers of where an arm stands, of each session
SMALL_ANGLE = np.radians(7.0)  # below which numbers may be radians
LARGE_ANGLE = 7.0  # [rad], more than a turn, above which numbers may be degrees
ANGLES = {  # factors to radians as read, and what the numbers then were
    "small": {180.0 / np.pi: "radians: name the columns q1_rad.. instead of q1_deg.."},
    "large": {np.pi / 180.0: "degrees: name the columns q1_deg.. instead of q1_rad.."},
}
UNITS = {1000.0: "metres", 25.4: "inches"}  # factor to millimetres
# distances from their middle as shares of the reach: numbers that may be of a larger unit (two reaches, in inches), and
# farther than any arm moves
NEAR, BEYOND = 2.0 / 25.4, 2.5
DRAWN = 0.02  # of the reach: what may well be the drawing's errors
CLEARLY = 3.0  # times better: another unit is suspected
CERTAINLY = 10.0  # times better, and no worse than a drawing: there is no doubt
FAR = 10.0  # times the median distance: 15 standard deviations of normal errors in three coordinates
ROUNDS = 5  # of finding rows that are far off, and placing the arm without them


def data_warnings(measurements: Measurements, arm: Arm) -> list[str]:
    """Sentences about units that the numbers contradict, swapped markers and rows far from all others.

    Raises `InputError` if the numbers of joints differ.
    """
    if measurements.links != arm.links:
        raise InputError(f"measurements: found {measurements.links} joints, allowed: {arm.links}, as the arm has")
    bare = replace(arm, effects=(), calibration=None)
    said = wrong_units(measurements, bare)
    if said or arm.chain is None or _few(measurements, bare):
        return said
    return [*_orientations(measurements, bare), *_far_rows(measurements, bare)]


def _few(measurements: Measurements, arm: Arm) -> bool:
    """Whether base and measured points alone might explain the data in any unit."""
    points = 1 if measurements.marker is None else len(measurements.marker_names)
    fitted = PLACED if measurements.dimension == 1 else STANDS + arm.dimension * points
    return arm.chain is not None and measurements.positions.size < 4 * fitted * len(measurements.session_rows)


def gap_notes(measurements: Measurements) -> list[str]:
    """Rows of which nothing says from which side their joints came, in a sentence; none where directions are given."""
    if measurements.gaps is None or measurements.directions is not None:
        return []
    found = f"before {int(measurements.gaps.sum())} of {len(measurements)} rows numbers of order are left out"
    how = "keep order 1, 2, 3 .. without steps, or give columns direction1, direction2 .."
    return [f"{found}: from which side the joints came is not known there (play in gears needs it; {how})"]


def certainly_wrong_units(measurements: Measurements, arm: Arm) -> str | None:
    """`wrong_units` of which there is no doubt, in a clause; None: there are none.

    In the other units the rows are those of the drawing, but for what one may be off by; as read they are far from it
    for how far apart they are.
    """
    found = _units(measurements, arm)
    if not found.sentences or found.misfit > DRAWN or CERTAINLY * found.relative >= found.relative_as_read:
        return None
    near = f"read that way, half of the rows agree with the drawing to {100.0 * found.misfit:.2g} % of the reach"
    return f"{'; '.join(found.sentences)} ({near})"


def wrong_units(measurements: Measurements, arm: Arm) -> list[str]:
    """Radians in `_deg` columns, degrees in `_rad` columns, other units of length in `_mm` columns or in the arm file,
    where that fits the arm clearly better.

    Suspected only where all angles are below 7 deg, or one is above 7 rad, or the positions lie within a twelfth of the
    reach, or some of them farther apart than the arm could reach.
    """
    return _units(measurements, arm).sentences


class _Units(NamedTuple):
    """What to do about other units, in sentences; in them the median distance from the drawing in reaches, and as a
    share of how far positions are from their middle; the latter as read."""

    sentences: list[str]
    misfit: float = 0.0
    relative: float = 0.0
    relative_as_read: float = 0.0


def _length_units(arm: Arm, size: float) -> dict[float, str]:
    """Units to try for positions that are so many reaches from their middle: factor to mm -> what to do about it."""
    if arm.chain is not None and arm.chain.instrument.contact:  # contacts read nothing that has a unit
        return {}
    inverse = {1.0 / factor: words for factor, words in UNITS.items()}
    return UNITS if size < NEAR else inverse if size > BEYOND else {}


def _units(measurements: Measurements, arm: Arm) -> _Units:
    arm = replace(arm, effects=(), calibration=None)
    if _few(measurements, arm):
        return _Units([])
    turning = np.array([kind == REVOLUTE for kind in arm.joint_types])
    largest = float(np.abs(measurements.postures[:, turning]).max(initial=0.0))
    angle = ANGLES["small"] if 0.0 < largest < SMALL_ANGLE else ANGLES["large"] if largest > LARGE_ANGLE else {}
    size = float(distances(measurements.positions - measurements.positions.mean(axis=0)).max()) / arm.reach
    units = _length_units(arm, size)
    if not angle and not units:
        return _Units([])
    readings = [(q, f) for q in (1.0, *angle) for f in (1.0, *units)]
    misfits = [_misfit(measurements, arm, np.where(turning, turned, 1.0), factor) for turned, factor in readings]
    best = int(np.argmin(misfits))
    if CLEARLY * misfits[best] >= misfits[0]:
        return _Units([])
    turned, factor = readings[best]
    said = [] if turned == 1.0 else [f"the joint angles look like {angle[turned]}"]
    axes = ("distance",) if measurements.dimension == 1 else "xyz"[: arm.dimension]
    said += [] if factor == 1.0 else [_length_unit(factor, units[factor], axes)]
    misfit, spread = misfits[best] / arm.reach, max(size, np.finfo(float).tiny)
    return _Units(said, misfit, misfit / (spread * factor), misfits[0] / arm.reach / spread)


def _length_unit(factor: float, unit: str, axes: Sequence[str]) -> str:
    """What to do about positions that a factor makes millimetres, or about the arm's lengths."""
    if factor < 1.0:
        return f"the positions are {1.0 / factor:g} times as large as the arm: the arm file's lengths look like {unit}"
    names, in_metres = (", ".join(f"{axis}_{end}" for axis in axes) for end in ("mm", "m"))
    what = f"name the columns {in_metres} instead of {names}" if unit == "metres" else f"multiply {names} by {factor:g}"
    return f"the positions look like {unit}: {what}"


def _orientations(measurements: Measurements, arm: Arm) -> Iterator[str]:
    """Another convention of the orientations, where those that are measured are far from the nominal arm's."""
    if measurements.orientations is None:
        return
    limit = FAR * arm.machining.rotation
    if (missed := _median_angle(measurements, arm, measurements.orientations)) <= limit:
        return
    fixed_axes = np.swapaxes(from_angles(-to_angles(measurements.orientations)), -1, -2)
    readings = {
        "angles about fixed axes": fixed_axes,
        "the instrument in the frame of the tool": np.swapaxes(measurements.orientations, -1, -2),
        "the instrument in the frame of the tool, by angles about fixed axes": np.swapaxes(fixed_axes, -1, -2),
    }
    others = {name: _median_angle(measurements, arm, read) for name, read in readings.items()}
    best = min(others, key=others.__getitem__)
    looks = f"; they look like {best}" if CLEARLY * others[best] < missed else ""
    yield (
        f"the orientations are {np.degrees(missed):.3g} deg from the nominal arm's in the median{looks}; rx_deg, "
        "ry_deg and rz_deg turn the tool about its own x, then y, then z axis, from the frame of the instrument"
    )


def _median_angle(measurements: Measurements, arm: Arm, orientations: Array) -> float:
    """[rad] between the nominal arm's orientations and these, base and measured frames found by the closed form."""
    read = replace(measurements, orientations=orientations).rows(measurements.session_rows[0])
    computed = placed_model(Model(arm), read).position(read.postures, conditions=read.conditions)
    chain = arm.chain
    assert chain is not None
    return float(np.median(np.linalg.norm(computed[:, POINT.stop :], axis=1))) / (chain.angle_scale or 1.0)


def _misfit(measurements: Measurements, arm: Arm, turned: Array, unit: float) -> float:
    """Median distance [mm] from the nominal arm, with joints times factors (n,), positions times a `unit`."""
    postures = measurements.postures * turned
    read = replace(measurements, postures=postures, positions=measurements.positions * unit)
    if arm.chain is None:
        drawn = joint_points(arm.lengths, postures)[:, -1]
        tip, seen = ((a - a.mean(axis=0)) @ np.array([1.0, 1.0j]) for a in (drawn, read.positions))
        return float(np.median(np.abs(seen - tip * np.exp(1j * np.angle(np.vdot(tip, seen))))))
    return float(np.median(_distances(arm, read, np.ones(len(read), dtype=bool))))


def _far_rows(measurements: Measurements, arm: Arm) -> Iterator[str]:
    """Rows that another marker explains, and rows that nothing does."""
    kept = np.ones(len(measurements), dtype=bool)
    for _ in range(ROUNDS):
        distances = _distances(arm, measurements, kept)
        before, kept = kept, distances <= FAR * np.median(distances)
        if np.array_equal(before, kept):
            break
    far = ~kept
    if not far.any() or 2 * far.sum() > len(far):
        return
    usual, swapped = float(np.median(distances[kept])), np.zeros(len(far), dtype=bool)
    for name in measurements.marker_names:
        markers = np.array(measurements.marker, dtype=np.str_)
        markers[far] = name
        other = replace(measurements, marker=markers)
        swapped |= far & (_distances(arm, other, kept) <= FAR * usual)
    typical = f"others are {usual:.3g} mm from the nominal arm in the median"
    if swapped.any():
        yield f"markers look swapped in {rows_in_words(swapped)}: the position is that of another marker; {typical}"
    if (lost := far & ~swapped).any():
        worst = float(distances[lost].max())
        yield f"a lost beam or another posture in {rows_in_words(lost)}: up to {worst:.4g} mm off; {typical}"


def _distances(arm: Arm, measurements: Measurements, kept: NDArray[np.bool_]) -> Array:
    """(m,) from the nominal arm [mm], base and measured points found from the rows kept, in each session anew."""
    found = np.empty(len(kept))
    for rows in measurements.session_rows:
        here = measurements.rows(rows)
        placed = placed_model(Model(arm), here.rows(kept[rows]) if kept[rows].any() else here)
        found[rows] = distances(here.positions - placed.position(here.postures, conditions=here.conditions))
    return found
