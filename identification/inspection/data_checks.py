"""Contradictions within a measurement file: units, conventions of orientations, swapped markers, lost beams.

Base and measured points are found by the closed form, so that what is left of the nominal arm is its errors, some
millimetres; another unit or another point is off by far more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from identification.arm import Arm
from identification.arrays import Array, rows_in_words
from identification.errors import InputError
from identification.kinematics.chain import BASE
from identification.kinematics.frames import from_angles, to_angles
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import POINT, Measurements, distances
from identification.model import Model
from identification.model.placed import one_unnamed, placed_model

ANGLES = {  # factors to radians as read, and what the numbers then were
    "small": {180.0 / np.pi: "radians: name the columns q1_rad.. instead of q1_deg.."},
    "large": {np.pi / 180.0: "degrees: name the columns q1_deg.. instead of q1_rad.."},
}
UNITS = {10.0: "centimetres", 100.0: "decimetres", 1000.0: "metres", 25.4: "inches", 304.8: "feet"}  # to millimetres
DRAWN = 0.02  # of the reach: what may well be the drawing's errors
CLEARLY = 3.0  # times better: another unit is suspected
FAR = 10.0  # times the median distance: 15 standard deviations of normal errors in three coordinates


def data_warnings(measurements: Measurements, arm: Arm) -> list[str]:
    """Sentences about units that the numbers contradict, swapped markers and rows far from all others.

    Raises `InputError` if the numbers of joints differ.
    """
    if measurements.links != arm.links:
        raise InputError(f"measurements: found {measurements.links} joints, allowed: {arm.links}, as the arm has")
    bare, units = _bare(arm, measurements), wrong_units(measurements, arm)
    if units or arm.chain.planar or _few(measurements, bare):
        return units
    return [*_orientations(measurements, bare), *_far_rows(measurements, bare)]


def _bare(arm: Arm, measurements: Measurements) -> Arm:
    """The arm as it is drawn, a planar one anywhere; with one measured point where it has several and the rows name
    none."""
    chain = one_unnamed(arm.chain, measurements)
    if chain.positions_in_plane:
        chain = replace(chain, settled=chain.settled - {BASE})
    return replace(arm, chain=chain, effects=(), calibration=None)


def _few(measurements: Measurements, arm: Arm) -> bool:
    """Whether base and measured points alone might explain the data in any unit."""
    points, chain = 1 if measurements.marker is None else len(measurements.marker_names), arm.chain
    stands = chain.dimension + len(chain.turning) - len(chain.instrument.hidden(np.eye(4)))  # of each session
    fitted = stands + (0 if chain.planar else chain.dimension * points)
    return measurements.positions.size < 4 * fitted * len(measurements.session_rows)


def gap_notes(measurements: Measurements) -> list[str]:
    """Rows of which nothing says from which side their joints came, in a sentence; none where directions are given."""
    if measurements.gaps is None or measurements.directions is not None:
        return []
    left_out = f"before {int(measurements.gaps.sum())} of {len(measurements)} rows numbers of order are left out"
    how = "keep order 1, 2, 3 .. without steps, or give columns direction1, direction2 .."
    return [f"{left_out}: from which side the joints came is not known there (play in gears needs it; {how})"]


def certainly_wrong_units(measurements: Measurements, arm: Arm) -> str | None:
    """`wrong_units` of which there is no doubt, in a clause; None: there are none.

    In the other units the rows are those of the drawing, but for what one may be off by; as read they are far from it
    for how far apart they are.
    """
    units = _units(measurements, arm)
    # of what is ten times better, and no worse than a drawing, there is no doubt
    if units.misfit > DRAWN or 10.0 * units.relative >= units.relative_as_read:
        return None
    near = f"read that way, half of the rows agree with the drawing to {100.0 * units.misfit:.2g} % of the reach"
    return f"{'; '.join(units.sentences)} ({near})"


def wrong_units(measurements: Measurements, arm: Arm) -> list[str]:
    """Radians in `_deg` columns, degrees in `_rad` columns, and lengths that are some times those of the other file,
    where that fits the arm clearly better; and an arm that reaches farther than any does.

    Angles are suspected only where all are below 7 deg, or one is above 7 rad. How many times the lengths of one file
    are those of the other is measured, and a unit is named where that is a unit's factor, to 2 %.
    """
    return list(_units(measurements, arm).sentences)


class _Units(NamedTuple):
    """What to do about other units, in sentences; in them the median distance from the drawing in reaches, and as a
    share of how far apart the drawn positions are; the latter as read."""

    sentences: list[str]
    misfit: float = 0.0
    relative: float = 0.0
    relative_as_read: float = 0.0


@lru_cache(maxsize=2)  # asked for before a fit, and again for its warnings
def _units(measurements: Measurements, arm: Arm) -> _Units:
    arm = _bare(arm, measurements)
    huge = []
    if arm.reach > 20000.0:  # [mm] farther than any arm reaches
        how = "lengths that were written in millimetres there come out 1000 times too large"
        huge = [f"the arm of the file reaches {arm.reach / 1000.0:.4g} m: a URDF has metres, and {how}"]
    if _few(measurements, arm):
        return _Units(huge)
    turning = np.array([kind == REVOLUTE for kind in arm.joint_types])
    largest = float(np.abs(measurements.postures[:, turning]).max(initial=0.0))
    # below 7 deg numbers may be radians, above 7 rad, more than a turn, degrees
    angle = ANGLES["small"] if 0.0 < largest < np.radians(7.0) else ANGLES["large"] if largest > 7.0 else {}
    tips = {t: arm.chain.tip_frames(measurements.postures * np.where(turning, t, 1.0)) for t in (1.0, *angle)}
    drawn = {t: _spread(frames[:, : arm.dimension, 3]) for t, frames in tips.items()}
    # one posture: what its repeats scatter by has no ratio to the drawing
    if max(drawn.values()) < 1e-3 * arm.reach:
        return _Units(huge)
    spread = 0.0  # contacts read nothing that has a unit
    if not arm.chain.instrument.contact:
        spread = _spread(measurements.positions[:, POINT])
    # no drawing is wrong by half or twice the size
    alike = drawn[1.0] < 2.0 * spread < 4.0 * drawn[1.0]
    if not angle and (alike or not spread):
        return _Units(huge)
    misfits = {}  # (factor of the angles, of the lengths) -> median distance, as a share of the drawn positions' spread
    for turned, size in drawn.items():

        def misfit(factor: float, turned: float = turned, size: float = size) -> float:
            postures = measurements.postures * np.where(turning, turned, 1.0)
            read = replace(measurements, postures=postures, positions=measurements.positions * factor)
            off = float(np.median(_distances(arm, read, np.ones(len(read), dtype=bool))))
            return off / max(size, np.finfo(float).tiny)

        misfits[turned, 1.0] = misfit(1.0)
        factor = 1.0  # what positions are to be multiplied by to lie nearest to the drawing
        if spread and size:  # a point far from the tip adds to the spreads
            near = min(size / spread * 2.0 ** np.arange(-3, 4), key=misfit)
            bounds = np.log([near / 2.0, near * 2.0])
            nearest = minimize_scalar(lambda k, of=misfit: of(float(np.exp(k))), bounds=bounds, options={"xatol": 1e-4})
            factor = float(np.exp(nearest.x))
        if max(factor, 1.0 / factor) > 2.0 and CLEARLY * (left := misfit(factor)) < misfits[turned, 1.0]:
            misfits[turned, factor] = left
    best = min(misfits, key=misfits.__getitem__)
    if CLEARLY * misfits[best] >= misfits[1.0, 1.0]:
        return _Units(huge)
    turned, factor = best
    axes = [coordinate.name for coordinate in arm.chain.instrument.coordinates][: measurements.dimension]
    sentences = [] if turned == 1.0 else [f"the joint angles look like {angle[turned]}"]
    sentences += huge
    if factor != 1.0:
        sentences += [_other_lengths(factor, axes, huge=bool(huge))]
    return _Units(sentences, misfits[best] * drawn[turned] / arm.reach, misfits[best], misfits[1.0, 1.0])


def _spread(points: Array) -> float:
    """Root mean square distance of points (m, d) from their mean, of distances (m, 1) that of the points they are of,
    if these lie on all sides."""
    square = float(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))
    return float(np.sqrt(square * (3.0 if points.shape[1] == 1 else 1.0)))


def _other_lengths(factor: float, axes: Sequence[str], *, huge: bool) -> str:
    """How many times the lengths of one file are those of the other, and what would make them agree.

    factor : that makes positions what the arm's lengths are;  huge : another sentence says that these are too large
    """
    small, large = ("measurements", "arm file") if factor > 1.0 else ("arm file", "measurements")
    times = max(factor, 1.0 / factor)
    lengths = f"the lengths of the {large} are {times:.4g} times those of the {small}"
    if huge and factor > 1.0:
        return lengths
    unit = next((unit for unit in UNITS if abs(times / unit - 1.0) <= 0.02), None)
    if unit is None:
        return f"{lengths}, which is the factor of no unit: another arm, or a length that is mistyped?"
    if small == "arm file":
        return f"{lengths}: they agree if the arm file's lengths are in {UNITS[unit]} (multiply them by {unit:g})"
    names, in_metres = (", ".join(f"{axis}_{end}" for axis in axes) for end in ("mm", "m"))
    how = f"name the columns {in_metres} instead of {names}" if unit == 1000.0 else f"multiply {names} by {unit:g}"
    return f"{lengths}: they agree if the positions are in {UNITS[unit]} ({how})"


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
    return float(np.median(np.linalg.norm(computed[:, POINT.stop :], axis=1))) / (chain.angle_scale or 1.0)


def _far_rows(measurements: Measurements, arm: Arm) -> Iterator[str]:
    """Rows that another marker explains, and rows that nothing does."""
    kept = np.ones(len(measurements), dtype=bool)
    for _ in range(5):
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
    """(m,) from the nominal arm [mm], base and measured points found from the rows kept, in each session separately."""
    off = np.empty(len(kept))
    for rows in measurements.session_rows:
        here = measurements.rows(rows)
        placed = placed_model(Model(arm), here.rows(kept[rows]) if kept[rows].any() else here)
        off[rows] = distances(here.positions - placed.position(here.postures, conditions=here.conditions))
    return off
