"""Other readings of a measurement file than its columns say: other units, reversed joints, swapped columns, other
zeros, mirrored axes, other conventions of orientations, markers and rows that are not what they say, in words.

A wrong unit or sign leaves decimetres where a real arm leaves millimetres, so the drawing is enough to see it: for each
way to read the columns the base (and in space the measured point) is fitted to the drawing in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from identification.arm import Arm, Calibration
from identification.arrays import Array, rows_in_words
from identification.errors import InputError
from identification.instruments import Placement, Unplaced
from identification.kinematics.chain import TOOL
from identification.kinematics.counting import Counting
from identification.kinematics.frames import from_angles, to_angles
from identification.kinematics.parameters import JOINT_OFFSET, PRISMATIC, REVOLUTE
from identification.measurements import POINT, Measurements, distances, rms_distance
from identification.model import Model
from identification.model.placed import one_unnamed, placed_model, spread_rows

UNITS = {10.0: "centimetres", 100.0: "decimetres", 1000.0: "metres", 25.4: "inches", 304.8: "feet"}  # to millimetres
DRAWN = 0.02  # of the reach: what may well be the drawing's errors
CLEARLY = 3.0  # times better: another unit or reading is suspected
FAR = 10.0  # times the median distance: 15 standard deviations of normal errors in three coordinates
ALIKE = 1.2  # times as much is left: no better, and the simpler reading counts


# -- what the drawing leaves -------------------------------------------------------------------------------------------
def anywhere(arm: Arm) -> Arm:
    """The arm as drawn, where it stands left open, and in space what is measured on it."""
    chain = arm.chain
    tip = chain.settled.difference(chain.frame_kinds) & {TOOL}
    return replace(arm, chain=type(chain)(chain.joints, chain.end, settled=tip, instrument=chain.instrument.unplaced))


def some_of_one_point(measurements: Measurements) -> Measurements:
    """Rows of the point and session that is measured most, spread over the file."""
    rows = np.arange(len(measurements))
    for names in (measurements.marker_numbers, measurements.session):  # between sessions the base may have moved
        if names is not None:
            each, counts = np.unique(names[rows], return_counts=True)
            rows = rows[names[rows] == each[counts.argmax()]]
    # 200 of them: a wrong sign shows in far fewer
    return measurements.rows(rows[np.unique(np.linspace(0, len(rows) - 1, 200).astype(int))])


def _few(arm: Arm, rows: Measurements) -> bool:
    """Whether another reading would fit by chance: of a pose, of a point where it is open, and of one number more."""
    point = 0 if TOOL in arm.chain.settled else arm.dimension
    # below three equations for each fitted number anything may fit
    return rows.positions[:, : arm.chain.coordinates].size < 3 * (arm.dimension + len(arm.chain.turning) + point + 1)


def _place(arm: Arm, hopeless: float = np.inf) -> Callable[[Array, Array], Placement]:
    """Where the drawing stands by postures (m, n) and positions (m, d), with the root mean square distance [mm] that it
    leaves; of lengths roughly, where that is `hopeless`."""
    chain = arm.chain
    tool = np.zeros(3) if TOOL in chain.settled else None
    read = partial(Unplaced, reach=chain.reach, tool=tool, hopeless=hopeless)
    coordinates = slice(chain.coordinates)
    return lambda q, x: chain.instrument.place(read(chain.tip_frames(q), x[:, coordinates]))


# -- units -------------------------------------------------------------------------------------------------------------
def _without_far_rows(arm: Arm, q: Array, x: Array) -> tuple[float, NDArray[np.bool_]]:
    """What the drawing leaves of postures (m, n) and positions (m, d), RMS [mm], without rows far from all others, and
    which these are not: least squares of the nearest three quarters, by concentration steps (P. J. Rousseeuw, K. Van
    Driessen, "Computing LTS regression for large data sets", 2006)."""
    place, instrument, near = _place(arm), arm.chain.instrument, np.ones(len(q), dtype=bool)
    if instrument.parameters:  # no placement says what these are
        return place(q, x).rms, near
    frames = arm.chain.tip_frames(q)
    for _ in range(10):  # effort: mostly 3
        base, tool, _ = place(q[near], x[near])
        points = (frames[:, :3, :3] @ tool + frames[:, :3, 3]) @ base[:3, :3].T + base[:3, 3]
        points = points[:, : len(instrument.axes)]
        read = instrument.linearized(points, np.zeros(0), np.zeros((1, 1)))[0]
        far = np.linalg.norm(x - read[:, : x.shape[1]], axis=1)
        before, near = near, far <= np.quantile(far, 0.75)
        if np.array_equal(before, near):
            break
    near = far <= FAR * np.median(far)
    return place(q[near], x[near]).rms, near


@lru_cache(maxsize=2)  # asked for before a fit, and again for its warnings
def wrong_units(measurements: Measurements, arm: Arm) -> tuple[tuple[str, ...], str | None]:
    """Radians in `_deg` columns, degrees in `_rad` columns, and lengths that are some times those of the other file,
    where that fits the arm clearly better, in sentences; and an arm that reaches farther than any does. The same in a
    clause where there is no doubt: in the other units the rows are those of the drawing, but for what one may be off
    by, and as read they are far from it for how far apart they are. Rows far from all others do not count.

    Angles are suspected only where all are below 7 deg, or one is above 7 rad. How many times the lengths of one file
    are those of the other is measured, and a unit is named where that is a unit's factor, to 2 %. Raises `InputError`
    if the numbers of joints differ.
    """
    if measurements.links != arm.links:
        raise InputError(f"measurements: found {measurements.links} joints, allowed: {arm.links}, as the arm has")
    rows, arm = some_of_one_point(measurements), anywhere(arm)
    huge = arm.reach > 20000.0  # [mm] farther than any arm reaches
    how = "lengths that were written in millimetres there come out 1000 times too large"
    sentences = [f"the arm of the file reaches {arm.reach / 1000.0:.4g} m: a URDF has metres, and {how}"] * huge
    turning = np.array([kind == REVOLUTE for kind in arm.joint_types])
    largest, angle = float(np.abs(rows.postures[:, turning]).max(initial=0.0)), {1.0: ""}
    if 0.0 < largest < np.radians(7.0):  # below 7 deg numbers may be radians
        angle[180.0 / np.pi] = "radians: name the columns q1_rad.. instead of q1_deg.."
    elif largest > 7.0:  # [rad], more than a turn
        angle[np.pi / 180.0] = "degrees: name the columns q1_deg.. instead of q1_rad.."
    postures = {t: rows.postures * np.where(turning, t, 1.0) for t in angle}
    drawn = {t: _spread(arm.chain.tip_frames(q)[:, : arm.dimension, 3]) for t, q in postures.items()}
    spread = 0.0 if arm.chain.instrument.contact else _spread(rows.positions[:, POINT])  # of contacts nothing is read
    # no drawing is wrong by half or twice the size; what repeats of one posture scatter by has no ratio to it
    alike = not spread or drawn[1.0] < 2.0 * spread < 4.0 * drawn[1.0]
    if _few(arm, rows) or max(drawn.values()) < 1e-3 * arm.reach or (len(angle) == 1 and alike):
        return tuple(sentences), None
    positions, place, left = rows.positions[:, : arm.chain.coordinates], _place(arm), dict[tuple[float, float], float]()
    for turned, q in postures.items():  # (factors) -> RMS, as a share of the spread
        size = max(drawn[turned], np.finfo(float).tiny)
        left[turned, 1.0] = _without_far_rows(arm, q, positions)[0] / size
        if spread and drawn[turned]:  # what positions are to be multiplied by; a point far from the tip adds to spreads
            factors = drawn[turned] / spread * 2.0 ** np.arange(-3, 4)
            ends = [_without_far_rows(arm, q, positions * factor) for factor in factors]
            start, near = min(zip(factors, ends, strict=True), key=lambda pair: pair[1][0])
            q, x = q[near[1]], positions[near[1]]
            bounds, options = np.log([start / 2.0, start * 2.0]), {"xatol": 1e-4}
            best = minimize_scalar(lambda k, q=q, x=x: place(q, x * np.exp(k)).rms, bounds=bounds, options=options)
            factor, rest = float(np.exp(best.x)), float(best.fun) / size
            if max(factor, 1.0 / factor) > 2.0 and CLEARLY * rest < left[turned, 1.0]:
                left[turned, factor] = rest
    turned, factor = least = min(left, key=left.__getitem__)
    if CLEARLY * left[least] >= left[1.0, 1.0]:
        return tuple(sentences), None
    sentences = [f"the joint angles look like {angle[turned]}"] * (turned != 1.0) + sentences
    small, large = ("measurements", "arm file") if factor > 1.0 else ("arm file", "measurements")
    times = max(factor, 1.0 / factor)
    lengths = f"the lengths of the {large} are {times:.4g} times those of the {small}"
    unit = next((unit for unit in UNITS if abs(times / unit - 1.0) <= 0.02), None)
    axes = [coordinate.name for coordinate in arm.chain.instrument.coordinates][: rows.dimension]
    names, in_metres = (", ".join(f"{axis}_{end}" for axis in axes) for end in ("mm", "m"))
    if factor == 1.0 or (huge and factor > 1.0):
        sentences += [lengths] * (factor != 1.0)
    elif unit is None:
        sentences += [f"{lengths}, which is the factor of no unit: another arm, or a length that is mistyped?"]
    elif small == "arm file":
        agree = f"they agree if the arm file's lengths are in {UNITS[unit]} (multiply them by {unit:g})"
        sentences += [f"{lengths}: {agree}"]
    else:
        how = f"name the columns {in_metres} instead of {names}" if unit == 1000.0 else f"multiply {names} by {unit:g}"
        sentences += [f"{lengths}: they agree if the positions are in {UNITS[unit]} ({how})"]
    share, certain = left[least] * drawn[turned] / arm.reach, None
    if share <= DRAWN and left[1.0, 1.0] > 10.0 * left[least]:  # ten times better, and no worse than a drawing
        certain = f"{'; '.join(sentences)} (read that way, the drawing leaves {100.0 * share:.2g} % of the reach)"
    return tuple(sentences), certain


def _spread(points: Array) -> float:
    """Median distance of points (m, d) from their median, of distances (m, 1) that of the points they are of, if these
    lie on all sides: of normal ones 1.54 and 0.67 standard deviations of a coordinate."""
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.median(off) * (1.54 / 0.67 if points.shape[1] == 1 else 1.0))


# -- orientations, markers, rows far from all others -------------------------------------------------------------------
def data_warnings(measurements: Measurements, arm: Arm) -> list[str]:
    """Sentences about units that the numbers contradict, swapped markers and rows far from all others.

    Raises `InputError` if the numbers of joints differ.
    """
    units = list(wrong_units(measurements, arm)[0])
    if units or not arm.chain.frame_kinds or _few(anywhere(arm), some_of_one_point(measurements)):
        return units
    # as it is drawn; with one measured point where it has several and the rows name none
    bare = replace(arm, chain=one_unnamed(arm.chain, measurements), effects=(), calibration=None)
    return [*_orientations(measurements, bare), *_far_rows(measurements, bare)]


def gap_notes(measurements: Measurements) -> list[str]:
    """Rows of which nothing says from which side their joints came, in a sentence; none where directions are given."""
    if measurements.gaps is None or measurements.directions is not None:
        return []
    left_out = f"before {int(measurements.gaps.sum())} of {len(measurements)} rows numbers of order are left out"
    how = "keep order 1, 2, 3 .. without steps, or give columns direction1, direction2 .."
    return [f"{left_out}: from which side the joints came is not known there (play in gears needs it; {how})"]


def _left(arm: Arm, measurements: Measurements, kept: NDArray[np.bool_]) -> Array:
    """(m, d) from the nominal arm [mm], base and measured points found from the rows kept, in each session."""
    left = np.empty(measurements.positions.shape)
    for rows in measurements.session_rows:
        here = measurements.rows(rows)
        placed = placed_model(Model(arm), here.rows(kept[rows]) if kept[rows].any() else here)
        left[rows] = here.positions - placed.position(here.postures, conditions=here.conditions)
    return left


def _orientations(measurements: Measurements, arm: Arm) -> Iterator[str]:
    """Another convention of the orientations, where those that are measured are far from the nominal arm's."""
    if (measured := measurements.orientations) is None:
        return
    first, fixed_axes = measurements.session_rows[0], np.swapaxes(from_angles(-to_angles(measured)), -1, -2)
    missed = {}
    for name, read in {
        "": measured,
        "angles about fixed axes": fixed_axes,
        "the instrument in the frame of the tool": np.swapaxes(measured, -1, -2),
        "the instrument in the frame of the tool, by angles about fixed axes": np.swapaxes(fixed_axes, -1, -2),
    }.items():
        left = _left(arm, replace(measurements, orientations=read).rows(first), np.ones(len(first), dtype=bool))
        turned = np.linalg.norm(left[:, POINT.stop :], axis=1)
        missed[name] = float(np.median(turned)) / (arm.chain.angle_scale or 1.0)
        if not name and missed[name] <= FAR * arm.machining.rotation:
            return
    best = min(missed, key=missed.__getitem__)
    looks = f"; they look like {best}" if CLEARLY * missed[best] < missed[""] else ""
    yield (
        f"the orientations are {np.degrees(missed['']):.3g} deg from the nominal arm's in the median{looks}; rx_deg, "
        "ry_deg and rz_deg turn the tool about its own x, then y, then z axis, from the frame of the instrument"
    )


def _far_rows(measurements: Measurements, arm: Arm) -> Iterator[str]:
    """Rows that another marker explains, and rows that nothing does."""
    kept = np.ones(len(measurements), dtype=bool)
    for _ in range(5):
        far = distances(_left(arm, measurements, kept))
        before, kept = kept, far <= FAR * np.median(far)
        if np.array_equal(before, kept):
            break
    if kept.all() or 2 * kept.sum() < len(kept):
        return
    usual, swapped = float(np.median(far[kept])), np.zeros(len(kept), dtype=bool)
    for name in measurements.marker_names:
        other = replace(measurements, marker=np.where(kept, np.array(measurements.marker), name))
        swapped |= ~kept & (distances(_left(arm, other, kept)) <= FAR * usual)
    typical = f"others are {usual:.3g} mm from the nominal arm in the median"
    if swapped.any():
        yield f"markers look swapped in {rows_in_words(swapped)}: the position is that of another marker; {typical}"
    if (lost := ~kept & ~swapped).any():
        worst = float(far[lost].max())
        yield f"a lost beam or another posture in {rows_in_words(lost)}: up to {worst:.4g} mm off; {typical}"


# -- a reading ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Reading:
    """One way to read the columns.

    order : joint j is in column order[j];  signs : +1 or -1 of each joint
    quarters : quarter turns to add to each joint, whole ones or a zero of any angle
    mirrored : the positions are those of a mirror image: their last axis is read the other way
    sums : (n, n) how often column j has the angle of joint i in it: 1 on the diagonal, and 1 or -1 of joints before j
        where j is counted from farther back than from the link before; empty: no joint is
    base : (4, 4) [mm] where the drawing then explains the positions best;  rms : distance [mm] that it leaves
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    quarters: tuple[float, ...]
    mirrored: bool = False
    sums: tuple[tuple[int, ...], ...] = ()
    base: Array | None = field(default=None, compare=False)
    rms: float = field(default=np.inf, compare=False)

    @classmethod
    def as_written(cls, joints: int) -> Reading:
        """As the columns say."""
        return cls(tuple(range(joints)), (1,) * joints, (0,) * joints)

    @property
    def matrix(self) -> NDArray[np.int64]:
        """(n, n) `sums`."""
        return np.array(self.sums or np.eye(len(self.order)), dtype=np.int64)

    @property
    def changes(self) -> int:
        """How many things are read differently."""
        swapped = sum(a != b for a, b in enumerate(self.order)) // 2
        zeros = sum(k != 0 for k in self.quarters)
        return swapped + sum(s < 0 for s in self.signs) + zeros + self.mirrored + bool(self.sums)

    @property
    def moved_zeros(self) -> bool:
        """Nothing but zeros of joints that are off by no whole quarter turns: a fit takes them for what they are."""
        others = self.changes - sum(k != 0 for k in self.quarters)
        return not others and any(k % 1.0 for k in self.quarters)

    @property
    def zeros(self) -> tuple[float, ...]:
        """(n) what to add to each joint [rad], by the shorter way."""
        return tuple(float(np.radians(180.0 - (180.0 - 90.0 * k) % 360.0)) for k in self.quarters)

    def flipped(self, joints: Collection[int]) -> Reading:
        """With these joints, from 0, turning the other way than before."""
        return replace(self, signs=tuple(-sign if j in joints else sign for j, sign in enumerate(self.signs)))

    def with_quarters(self, joint: int, k: float) -> Reading:
        """With so many quarter turns added to a joint, from 0."""
        return replace(self, quarters=(*self.quarters[:joint], k, *self.quarters[joint + 1 :]))

    def postures(self, columns: Array) -> Array:
        """(m, n) what the arm's joints are, of columns (m, n)."""
        read = columns[:, list(self.order)] * np.array(self.signs) + 0.5 * np.pi * np.array(self.quarters)
        return np.linalg.solve(self.matrix, read.T).T if self.sums else read

    def placed(self, rows: Measurements, place: Callable[[Array, Array], Placement]) -> Placement:
        """Where the drawing stands by it."""
        positions = np.array(rows.positions[:, POINT])
        positions[:, -1] *= -1.0 if self.mirrored else 1.0
        return place(self.postures(rows.postures), positions)

    def counting(self, before: Counting | None) -> Counting | None:
        """How the controller counts, where this is what its columns say to an arm whose file says `before`; None where
        columns are swapped, or a joint is coupled to several."""
        n = len(self.order)
        if self.order != tuple(range(n)):
            return None
        plain = before or Counting((1,) * n, (0,) * n, (0.0,) * n)
        # signs (sums q - zeros) are the joints as read so far, from which follow the columns
        through = plain.matrix * np.array(self.signs)
        zero = (plain.zero - through @ self.zeros + np.pi) % (2.0 * np.pi) - np.pi
        return Counting.of_matrix(through @ self.matrix, np.where(np.isclose(zero, -np.pi), np.pi, zero))

    @property
    def words(self) -> tuple[str, ...]:
        """What is different, each in a sentence; joints and columns from 1."""
        swaps = sorted({tuple(sorted((a, b))) for a, b in enumerate(self.order) if a != b})
        sentences = [f"columns of joints {a + 1} and {b + 1} are swapped" for a, b in swaps]
        sentences += [f"joint {j} turns the other way" for j, sign in enumerate(self.signs, start=1) if sign < 0]
        zeros = ((j, np.degrees(x)) for j, x in enumerate(self.zeros, start=1) if x)
        sentences += [f"joint {j} has another zero than the drawing: add {x:.3g} deg to it" for j, x in zeros]
        for j, row in enumerate(self.sums, start=1):
            if before := [i for i in range(j - 1) if row[i]]:
                link = f"link {before[0]}" if before[0] else "the base"
                angle = " ".join(f"{'-' if row[i] > 0 else '+'} q{i + 1}" for i in before)
                how = f"counted from {link}, not from link {j - 1} (its angle: column {angle})"
                sentences.append(f"joint {j} is {how}")
        if self.mirrored:
            sentences.append("two coordinates of the positions are swapped, or an axis points the other way")
        return tuple(sentences)


@dataclass(frozen=True)
class Readings:
    """The result of a search.

    written : as the columns say;  better : one that explains the positions clearly better, or None
    alike : others as simple that explain them as well: at a wrist whose axes meet, joint 5 reversed and joint 4 half
        a turn away are the same
    explained : the better one leaves no more than a drawing may be off by
    counting : as the better one says, where the arm file can say it; None: it cannot, or it explains nothing
    """

    written: Reading
    better: Reading | None
    alike: tuple[Reading, ...] = ()
    explained: bool = True
    counting: Counting | None = None

    @property
    def sentences(self) -> list[str]:
        """What looks wrong, in a sentence; none where nothing does."""
        if self.better is None:
            return []
        ways = ", or, equally well, ".join(", and ".join(reading.words) for reading in (self.better, *self.alike))
        gain = f"{self.better.rms:.3g} mm instead of {self.written.rms:.4g}"
        if self.explained:
            return [f"it looks as if {ways}: the drawing then leaves {gain}"]
        nothing = "no reading with a few other signs, zeros, columns or mirrored axes explains the positions"
        return [f"{nothing}: several faults at once, or another arm? Closest: {ways}, which leaves {gain}"]

    def to_json(self) -> dict[str, Any] | None:
        """`better_reading` of `check` (identification/files/README.md, "JSON keys")."""
        if self.better is None:
            return None
        return {
            "changes": self.better.words,
            "arm_file": self.counting and self.counting.toml,
            "rms_mm": self.better.rms,
            "explains": self.explained,
            "equally_good": [reading.words for reading in self.alike],
        }


# -- the search --------------------------------------------------------------------------------------------------------
def read_differently(arm: Arm, measurements: Measurements, *, search: bool = True) -> Readings:
    """Look for another way to read the columns that explains the positions clearly better (`CLEARLY`).

    Tried are zeros of joints at any angle, then one change after another of the readings that leave least: signs, pairs
    of swapped columns, zeros off by quarter turns, joints that are counted from farther back than the link before, a
    mirrored frame. With few rows nothing is tried. Where a spatial arm stands and what is measured on it are fitted.

    search : False: only what the columns say
    """
    return _read_differently(anywhere(arm), some_of_one_point(measurements), search)


@lru_cache(maxsize=2)  # a fit asks before it begins, and again when it has placed the arm
def _read_differently(arm: Arm, rows: Measurements, search: bool) -> Readings:
    def placed(reading: Reading) -> Reading:
        base, _, rms = reading.placed(rows, _place(arm))
        return replace(reading, rms=rms, base=base)

    written = placed(Reading.as_written(arm.links))
    if not search or _few(arm, rows):
        return Readings(written, None)
    place = _place(arm, 2.0 * max(DRAWN * arm.reach, written.rms / CLEARLY))  # twice what may be left: no hope
    tried = {written: written.rms}
    kinds = arm.joint_types
    turning = [j for j, kind in enumerate(kinds) if kind != PRISMATIC]

    def left(reading: Reading) -> float:
        return reading.placed(rows, place).rms

    def moved_zero(best: Reading) -> Iterator[Reading]:
        """The zero of one turning joint where it explains the positions best; near whole quarter turns these."""
        for j in turning:

            def left_with(k: float, j: int = j) -> float:
                return left(best.with_quarters(j, k))

            near, step = min(np.arange(0.0, 4.0, 0.25), key=left_with), 0.25  # one start is near enough to the best
            k = float(minimize_scalar(left_with, bounds=(near - step, near + step), options={"xatol": 1e-3}).x)
            yield best.with_quarters(j, round(k) % 4 if abs(k - round(k)) < 0.02 else k)  # whole within 2 deg

    def mirrored(best: Reading) -> list[Reading]:  # lengths are the same in a mirrored frame
        return [replace(best, mirrored=not best.mirrored)] if arm.chain.instrument.reads_positions else []

    def changed(best: Reading) -> Iterator[Reading]:
        """One more thing read differently: a mirrored frame, a sign, a zero off by quarter turns, two columns of like
        joints swapped, and one joint, or all from one on, counted from a link farther back than the one before, or from
        the base: of joints that turn about parallel axes one after the other."""
        yield from mirrored(best)
        yield from (best.flipped([j]) for j in range(arm.links))
        yield from (best.with_quarters(j, k) for j in turning for k in (1, 2, 3))
        for a, b in (each for each in combinations(range(arm.links), 2) if kinds[each[0]] == kinds[each[1]]):
            order = list(best.order)
            order[a], order[b] = order[b], order[a]
            yield replace(best, order=tuple(order))
        for first, senses in parallel_joints(arm):
            last = first + len(senses)
            for start in range(first, last - 1):
                every = best.matrix
                for j in range(start + 1, last):
                    one = best.matrix
                    one[j, start:j] = every[j, start:j] = (
                        np.array(senses[start - first : j - first]) * senses[j - first]
                    )
                    yield replace(best, sums=tuple(map(tuple, one.tolist())))
                yield replace(best, sums=tuple(map(tuple, every.tolist())))

    def changed_twice(best: Reading) -> Iterator[Reading]:
        """With a sign or a mirrored frame beside another change."""
        for one in (best, *changed(best)):
            yield from (one, *mirrored(one), *(one.flipped([j]) for j in range(arm.links)))

    def simplest() -> Reading:
        """The fewest changes, and zeros among them, of those that leave about as little as the best."""
        enough = ALIKE * min(tried.values())
        near = [reading for reading, rms in tried.items() if rms <= enough]
        return min(near, key=lambda reading: (reading.changes, sum(map(bool, reading.quarters)), tried[reading]))

    for change in (moved_zero, moved_zero, changed, changed_twice, changed, changed):
        ranked = sorted(tried, key=tried.__getitem__)
        if tried[ranked[0]] < DRAWN * arm.reach:
            break
        starts = ranked[:1] if change is moved_zero else [written]
        if change is changed:  # effort
            starts += [reading for reading in ranked if not reading.moved_zeros][:5]
        for start in dict.fromkeys(starts):
            tried |= {reading: left(reading) for reading in change(start) if reading not in tried}
    best = simplest()
    if CLEARLY * tried[best] >= written.rms:
        return Readings(written, None)
    explained = tried[best] < DRAWN * arm.reach
    if explained and not best.moved_zeros:  # the search ends early: others may be as simple
        further = changed if best.changes == 1 else changed_twice
        tried |= {reading: left(reading) for reading in further(written) if reading not in tried}
        best = simplest()
    as_simple = (r for r in tried if explained and r.changes == best.changes and not r.moved_zeros)
    alike = sorted((r for r in as_simple if r != best and tried[r] <= ALIKE * tried[best]), key=tried.__getitem__)
    best, *others = map(placed, (best, *alike[:2]))  # two are named beside the simplest
    return Readings(written, best, tuple(others), explained, best.counting(arm.counting) if explained else None)


def parallel_joints(arm: Arm) -> list[tuple[int, tuple[int, ...]]]:
    """Runs of two or more joints that turn about parallel axes, one after the other: the first (from 0), and of each
    whether it turns as the first does (1) or the other way (-1)."""
    runs, before, turned = list[tuple[int, list[int]]](), None, np.eye(3)
    for j, joint in enumerate(arm.chain.joints):
        turned = turned @ joint.origin[:3, :3]
        axis = turned @ joint.axis if joint.type == REVOLUTE else None
        along = 0.0 if axis is None or before is None else float(axis @ before)
        if abs(along) > np.cos(np.radians(1.0)):  # a drawing's angles may be rounded
            runs[-1][1].append(runs[-1][1][-1] * int(np.sign(along)))
        else:
            runs.append((j, [1]))
        before = axis
    return [(first, tuple(senses)) for first, senses in runs if len(senses) > 1]


# -- what else the drawing tells ---------------------------------------------------------------------------------------
def joints_of_unseen_sign(arm: Arm, measurements: Measurements) -> tuple[int, ...]:
    """Turning joints (from 1) whose sign and zero no measured point shows: reversed and a quarter or half turn away the
    drawing leaves no more; none with orientations, few rows, or where the drawing leaves much as it is."""
    if measurements.orientations is not None:
        return ()
    arm, plain = anywhere(arm), Reading.as_written(arm.links)
    place, numbers = _place(arm), measurements.marker_numbers
    points = [np.ones(len(measurements), dtype=bool)] if numbers is None else (numbers == k for k in np.unique(numbers))
    unseen = {j for j, kind in enumerate(arm.joint_types) if kind != PRISMATIC}
    for point in points:
        rows = some_of_one_point(measurements.rows(np.flatnonzero(point)))
        written = plain.placed(rows, place).rms
        if _few(arm, rows) or written > DRAWN * arm.reach:
            return ()
        most = ALIKE * max(written, float(np.sqrt(np.finfo(float).eps)) * arm.reach)  # rounded, of data without noise
        for j in tuple(unseen):
            others = [plain.flipped([j]), *(plain.with_quarters(j, k) for k in (1, 2, 3))]
            if any(other.placed(rows, place).rms > most for other in others):
                unseen.remove(j)
    return tuple(j + 1 for j in sorted(unseen))


def out_of_step(arm: Arm, measurements: Measurements) -> list[str]:
    """Positions that stand beside the posture of another row, in a sentence; none where no step explains them."""
    arm, plain = anywhere(arm), Reading.as_written(arm.links)
    rows, place = some_of_one_point(measurements), _place(arm)
    if _few(arm, rows):
        return []
    written = plain.placed(rows, place).rms
    first, last = measurements.rows(slice(None, -1)), measurements.rows(slice(1, None))
    for postures, positions, when in ((first, last, "late"), (last, first, "early")):
        rows = some_of_one_point(replace(postures, positions=positions.positions))
        if CLEARLY * (left := plain.placed(rows, place).rms) < written:
            gain = f"the drawing then leaves {left:.3g} mm instead of {written:.4g}"
            return [f"it looks as if each position stands one row too {when}, beside another posture: {gain}"]
    return []


def placed_with_zeros(model: Model, measurements: Measurements) -> tuple[Model, dict[str, float]]:
    """The model where the closed form places it, and zeros of joints to start from where they are clearly not those of
    the drawing: far from them a fit may end with frames turned over."""
    start = placed_model(model, measurements)
    if start is model or not (arm := model.arm).chain.frame_kinds or arm.calibration is not None:
        return start, {}
    rows = spread_rows(measurements, measurements.session_rows[0])  # later ones have another base
    left = rows.positions - start.position(rows.postures, conditions=rows.conditions)
    better = read_differently(arm, measurements).better if rms_distance(left) > DRAWN * start.reach else None
    if better is None or not better.moved_zeros:
        return start, {}
    zeros = {f"{JOINT_OFFSET}:{j}": turn for j, turn in enumerate(better.zeros, start=1)}
    turned = placed_model(replace(model, arm=replace(arm, calibration=Calibration(zeros))), measurements)
    return replace(turned, arm=replace(turned.arm, calibration=None)), zeros
