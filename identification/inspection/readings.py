"""Other readings of a measurement file than its columns say: other units, reversed joints, swapped columns, other
zeros, mirrored axes; other conventions of orientations, markers and rows that are not what they say, in words.

A wrong unit or sign leaves decimetres where a real arm leaves millimetres, so the drawing is enough to see it: for each
way to read the columns the base (and in space the measured point) is fitted to the drawing in closed form.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import accumulate, combinations, islice, pairwise, product
from operator import matmul
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.errors import require
from identification.instruments import Unplaced
from identification.kinematics.chain import TOOL, KinematicChain
from identification.kinematics.counting import Counting
from identification.kinematics.frames import to_angles
from identification.kinematics.parameters import JOINT_OFFSET, PRISMATIC, REVOLUTE
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.model.placed import placed_model, spread_rows

UNITS = {10.0: "centimetres", 100.0: "decimetres", 1000.0: "metres", 25.4: "inches", 304.8: "feet"}  # to millimetres
UNITS_OF_JOINTS = {  # what joints are multiplied by -> which, their unit, and how their columns end
    180.0 / np.pi: ("joint angles", "radians", "_rad"),
    np.pi / 180.0: ("joint angles", "degrees", "_deg"),
    1e3: ("sliding joints", "metres", "_m"),
    1e-3: ("sliding joints", "millimetres", "_mm"),
}
DRAWN = 0.02  # of the reach: what may well be the drawing's errors
CLEARLY = 3.0  # times better: another unit or reading is suspected
FAR = 10.0  # times the median distance: 15 standard deviations of normal errors in three coordinates
ALIKE = 1.2  # times as much is left: no better, and the simpler reading counts


# -- a reading ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Reading:
    """One way to read the columns.

    order : joint j is in column order[j];  signs : +1 or -1 of each joint
    quarters : quarter turns to add to each joint, whole ones or a zero of any angle
    mirrored : the positions are those of a mirror image: their last axis is read the other way
    sums : (n, n) how often column j has the angle of joint i in it: 1 on the diagonal, and 1 or -1 of joints before j
        where j is counted from farther back than from the link before; empty: no joint is
    units : what each joint is multiplied by, 1 where it is not written in another unit; empty: none is
    scaled : what the positions are multiplied by that were written in another unit
    base : (4, 4) [mm] where the drawing then explains the positions best;  rms : distance [mm] that it leaves
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    quarters: tuple[float, ...]
    mirrored: bool = False
    sums: tuple[tuple[int, ...], ...] = ()
    units: tuple[float, ...] = ()
    scaled: float = 1.0
    base: Array | None = field(default=None, compare=False)
    rms: float = field(default=np.inf, compare=False)

    @property
    def matrix(self) -> NDArray[np.int64]:
        """(n, n) `sums`."""
        return np.array(self.sums or np.eye(len(self.order)), dtype=np.int64)

    @property
    def changes(self) -> int:
        """How many things are read differently."""
        swapped = int(np.count_nonzero(self.order - np.arange(len(self.order))))
        others = (self.mirrored, bool(self.sums), self.other_units)
        return swapped // 2 + int(np.count_nonzero(self.quarters)) + self.signs.count(-1) + sum(others)

    @property
    def moved_zeros(self) -> bool:
        """Nothing but zeros of joints that are off by no whole quarter turns: a fit takes them for what they are."""
        return self.changes == np.count_nonzero(self.quarters) and any(k % 1.0 for k in self.quarters)

    @property
    def other_units(self) -> bool:
        """Angles or lengths are in others."""
        return any(times != 1.0 for times in (*self.units, self.scaled))

    @property
    def zeros(self) -> tuple[float, ...]:
        """(n,) what to add to each joint [rad], by the shorter way."""
        return tuple(float(np.radians(180.0 - (180.0 - 90.0 * k) % 360.0)) for k in self.quarters)

    def with_quarters(self, joint: int, k: float) -> Self:
        """With so many quarter turns added to a joint, from 0."""
        return replace(self, quarters=(*self.quarters[:joint], k, *self.quarters[joint + 1 :]))

    def with_scale(self, logarithm: float) -> Self:
        """With lengths that are e to this times those of the file."""
        return replace(self, scaled=float(np.exp(logarithm)))

    def postures(self, columns: Array) -> Array:
        """(m, n) what the arm's joints are, of columns (m, n) in the right units."""
        read = columns[:, list(self.order)] * np.array(self.signs) + 0.5 * np.pi * np.array(self.quarters)
        return np.asarray(np.linalg.solve(self.matrix, read.T).T, float) if self.sums else read

    def counting(self, before: Counting) -> Counting | None:
        """How the controller counts, where this is what its columns say to an arm whose file says `before`; None where
        that is not all that is different, or a joint is coupled to several."""
        if self.order != tuple(range(len(self.order))) or self.other_units or self.mirrored:
            return None
        # signs (sums q - zeros) are the joints as read so far, from which follow the columns
        through = before.matrix * np.array(self.signs)
        zero = (before.zero - through @ self.zeros + np.pi) % (2.0 * np.pi) - np.pi
        return Counting.of_matrix(through @ self.matrix, np.where(np.isclose(zero, -np.pi), np.pi, zero))

    @property
    def words(self) -> tuple[str, ...]:
        """What is different, each in a sentence; joints and columns from 1."""
        sentences = []
        for factor, (joints, unit, column) in UNITS_OF_JOINTS.items():
            if (first := [j for j, times in enumerate(self.units, start=1) if times == factor]) and len(first) > 1:
                sentences.append(f"the {joints} are in {unit} (name the columns q{first[0]}{column}..)")
            elif first:
                sentences.append(f"joint {first[0]} is in {unit} (name its column q{first[0]}{column})")
        if self.scaled != 1.0:
            times, larger = max(self.scaled, 1.0 / self.scaled), self.scaled > 1.0
            large, small = ("arm file", "measurements")[:: 1 if larger else -1]
            lengths = f"the lengths of the {large} are {times:.4g} times those of the {small}"
            unit = next((name for factor, name in UNITS.items() if abs(times / factor - 1.0) <= 0.02), "")
            columns = ", whose columns end in _m" if larger and unit == "metres" else ""
            whose = "positions" if larger else "lengths of the arm file"
            which_unit = ", which is the factor of no unit (another arm, or a length that is mistyped)"
            sentences.append(f"the {whose} are in {unit}{columns} ({lengths})" if unit else lengths + which_unit)
        swaps = sorted({tuple(sorted((a, b))) for a, b in enumerate(self.order) if a != b})
        sentences += [f"columns of joints {a + 1} and {b + 1} are swapped" for a, b in swaps]
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
    certain : it leaves a tenth of what the columns as written do, too, for how far apart the positions are
    counting : as the better one says, where the arm file can say it; None: it cannot, or it explains nothing
    """

    written: Reading
    better: Reading | None = None
    alike: tuple[Reading, ...] = ()
    explained: bool = True
    certain: bool = False
    counting: Counting | None = None

    @property
    def sentences(self) -> list[str]:
        """What looks wrong, in a sentence; none where nothing does."""
        if self.better is None:
            return []
        ways = ", or, equally well, ".join(", and ".join(reading.words) for reading in (self.better, *self.alike))
        farther = ", at postures that are farther apart" if self.better.rms > self.written.rms else ""  # as of contacts
        gain = f"{self.better.rms:.3g} mm instead of {self.written.rms:.4g}{farther}"
        if self.explained or self.better.other_units:
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
def read_differently(arm: Arm, measurements: Measurements, *, search: bool = True, doubted: bool = False) -> Readings:
    """Look for another way to read the columns that explains the positions clearly better (`CLEARLY`).

    Tried are other units, then zeros of joints at any angle, then one change after another of the readings that leave
    least: signs, pairs of swapped columns, zeros off by quarter turns, joints that are counted from farther back than
    the link before, a mirrored frame; and all signs together, whatever is counted from where. With few rows nothing is
    tried. Where a spatial arm stands and what is measured on it are fitted. Raises `InputError` if the numbers of
    joints differ.

    search : False: for units only
    doubted : a fit of the columns as they are is no good, so that `DRAWN` of the reach is too much
    """
    joints = f"found {measurements.links} joints, allowed: {arm.links}, as the arm has"
    require(measurements.links == arm.links, f"measurements: {joints}")
    # as drawn, where it stands left open, and in space what is measured on it
    chain = replace(type(arm.chain)(arm.chain.joints, arm.chain.end), settled=arm.chain.drawn & {TOOL})
    chain = replace(chain, instrument=arm.chain.instrument.without_targets())
    return _of_drawing(replace(arm, chain=chain), measurements, search, doubted)


@lru_cache(maxsize=4)  # asked for before a fit, and again for its warnings, of the arm that was placed for it
def _of_drawing(arm: Arm, measurements: Measurements, search: bool, doubted: bool) -> Readings:
    """`read_differently` of an arm as drawn."""
    chain, kinds, (q, x, few) = arm.chain, arm.joint_types, _rows(arm, measurements)
    slides, frames_at = np.array([kind == PRISMATIC for kind in kinds]), chain.frames_at({})
    turning, sliding = np.flatnonzero(~slides).tolist(), np.flatnonzero(slides).tolist()
    mirrors = chain.instrument.reads_positions
    hopeless = np.inf  # of what is left more than this: no hope, and a search for lengths may end early

    def placed(readings: Iterable[Reading]) -> Iterator[Reading]:
        """With where the drawing stands by each."""
        tool, each = np.zeros(3) if TOOL in chain.settled else None, iter(readings)
        while some := [*islice(each, 64)]:  # together they take a third of the time, and bounded space
            positions = np.multiply.outer([reading.scaled for reading in some], x)
            positions[[reading.mirrored for reading in some], :, -1] *= -1.0
            postures = np.array([reading.postures(q * (reading.units or 1.0)) for reading in some])
            rows = Unplaced(frames_at(postures)[..., -2, :, :], positions, chain.reach, tool=tool, hopeless=hopeless)
            for reading, place in zip(some, chain.instrument.place_each(rows), strict=True):
                yield replace(reading, base=place.base, rms=place.rms)

    as_said = (1.0,) * arm.links
    written = Reading(tuple(range(arm.links)), (1,) * arm.links, (0,) * arm.links, units=as_said)
    if few:
        return Readings(next(placed([written])))

    def in_units(units: tuple[float, ...], joints: list[int]) -> list[tuple[float, ...]]:
        """These units, and with the joints in another one: radians where all of `_deg` columns are below 7 deg, degrees
        where one of `_rad` columns is above 7 rad, metres or millimetres where slides are far from the reach."""
        largest, (small, large) = float(np.abs(q[:, joints]).max(initial=0.0)), (np.radians(7.0), 7.0)
        factors = (180.0 / np.pi, np.pi / 180.0)
        if slides[joints].all():
            factors, (small, large) = (1e3, 1e-3), (0.02 * arm.reach, 50.0 * arm.reach)
        tried = [factors[0]] if 0.0 < largest < small else [factors[1]] if largest > large else []
        return [units, *(tuple(np.where(np.isin(range(arm.links), joints), k, units).tolist()) for k in tried)]

    both = [each for units in in_units(as_said, turning) for each in in_units(units, sliding)]
    alone = [each for j in range(arm.links) for each in in_units(as_said, [j])[1:]]
    # how far apart the drawing then has the positions, and they are; of contacts, which read nothing and may leave the
    # tip where it is, the joints on average
    which = slice(0 if chain.instrument.contact else -2, -1)  # frames, of the base first and the tip last
    places = {units: frames_at(q * units)[:, which, : arm.dimension, 3].swapaxes(0, 1) for units in (*both, *alone)}
    drawn = {units: max(float(np.mean([*map(_spread, each)])), np.finfo(float).tiny) for units, each in places.items()}
    spread, readings = 0.0 if chain.instrument.contact else _spread(x), []

    def least(read: Callable[[float], Reading], values: Array, tolerance: float) -> float:
        """Where a reading leaves least, near the best of these values."""
        from scipy.optimize import minimize_scalar  # 0.06 s to import

        def left(k: float) -> float:
            return next(placed([read(k)])).rms

        near, step = values[np.argmin([reading.rms for reading in placed(map(read, values))])], values[1] - values[0]
        return float(minimize_scalar(left, bounds=(near - step, near + step), options={"xatol": tolerance}).x)

    for other in (replace(written, units=units) for units in drawn):
        readings.append(other)
        # lengths some times those of the other file: no drawing is wrong by half or twice the size; what repeats of one
        # posture scatter by has no ratio to it
        if spread and not 0.5 < (ratio := drawn[other.units] / spread) < 2.0:
            two = np.log(2.0)  # a point far from the tip adds to the spread of positions
            k = least(other.with_scale, np.log(ratio) + two * np.arange(-3, 4), 1e-4)
            readings += [other.with_scale(k)] if abs(k) > two else []
    if len(readings) > 1 and max(drawn.values()) >= 1e-3 * arm.reach:
        share = {reading: reading.rms / drawn[reading.units] for reading in placed(readings)}
        whole, best = (min(of, key=share.__getitem__) for of in ([r for r in share if r.units in both], share))
        best = whole if share[whole] <= CLEARLY * share[best] else best  # the likelier mistake is that of all joints
        if CLEARLY * share[best] < share[written]:
            explained = best.rms <= DRAWN * arm.reach
            certain = explained and share[written] > 10.0 * share[best]
            return Readings(next(iter(share)), best, explained=explained, certain=certain)
    if not search:
        return Readings(written)

    (written,) = placed([written])
    # [mm] may be left, and 1e-9 of the reach by rounding
    enough = max(min(DRAWN * arm.reach, written.rms / CLEARLY if doubted else np.inf), 1e-9 * arm.reach)
    hopeless = 2.0 * max(enough, written.rms / CLEARLY)
    tried = {written: written.rms}

    def moved_zero(best: Reading) -> Iterator[Reading]:
        """The zero of one turning joint where it explains the positions best; near whole quarter turns these."""
        for j in turning:
            # one start is near enough to the best
            k = least(partial(best.with_quarters, j), np.arange(0.0, 4.0, 0.25), 1e-3)
            yield best.with_quarters(j, round(k) % 4 if abs(k - round(k)) < 0.02 else k)  # whole within 2 deg

    def flips(best: Reading) -> Iterator[Reading]:
        """A mirrored frame, in which lengths are the same, or one joint that turns the other way."""
        yield from [replace(best, mirrored=not best.mirrored)] if mirrors else []
        for j, sign in enumerate(best.signs):
            yield replace(best, signs=(*best.signs[:j], -sign, *best.signs[j + 1 :]))

    def changed(best: Reading) -> Iterator[Reading]:
        """One more thing read differently: a mirrored frame, a sign, a zero off by quarter turns, two columns of like
        joints swapped, and one joint, or all from one on, counted from a link farther back than the one before, or from
        the base: of joints that turn about parallel axes one after the other."""
        yield from flips(best)
        yield from (best.with_quarters(j, k) for j in turning for k in (1, 2, 3))
        for a, b in (each for each in combinations(range(arm.links), 2) if kinds[each[0]] == kinds[each[1]]):
            order = list(best.order)
            order[a], order[b] = order[b], order[a]
            yield replace(best, order=tuple(order))
        yield from farther_back(best)

    def farther_back(best: Reading) -> Iterator[Reading]:
        for first, senses in parallel_joints(chain):
            last = first + len(senses)
            for start in range(first, last - 1):
                every = best.matrix
                for j in range(start + 1, last):
                    one, back = best.matrix, np.array(senses[start - first : j - first]) * senses[j - first]
                    one[j, start:j] = every[j, start:j] = back
                    yield replace(best, sums=tuple(map(tuple, one.tolist())))
                yield replace(best, sums=tuple(map(tuple, every.tolist())))

    def counted(best: Reading) -> Iterator[Reading]:
        """As a controller may count: any joints turn the other way, and any are counted from farther back."""
        if arm.links <= 7:  # effort
            for signs in product((1, -1), repeat=arm.links):
                yield from (replace(one, signs=signs) for one in (best, *farther_back(best)))

    def changed_twice(best: Reading) -> Iterator[Reading]:
        """With a sign or a mirrored frame beside another change."""
        for one in (best, *changed(best)):
            yield from (one, *flips(one))

    def simplest() -> Reading:
        """Of the fewest changes beside which no more are clearly better: what leaves about the least, zeros last."""
        fewest = min(reading.changes for reading, rms in tried.items() if rms <= CLEARLY * min(tried.values()))
        of_these = {reading: rms for reading, rms in tried.items() if reading.changes == fewest}
        near = [reading for reading, rms in of_these.items() if rms <= ALIKE * min(of_these.values())]
        return min(near, key=lambda reading: (np.count_nonzero(reading.quarters), tried[reading]))

    for change in (moved_zero, moved_zero, changed, changed_twice, counted, changed, changed):
        ranked = sorted(tried, key=tried.__getitem__)
        if tried[simplest()] < enough:  # several changes may be near by chance
            break
        starts = ranked[:1] if change is moved_zero else [written]
        if change is changed:  # effort
            starts += [reading for reading in ranked if not reading.moved_zeros][:5]
        for start in dict.fromkeys(starts):
            tried |= {new: new.rms for new in placed(dict.fromkeys(r for r in change(start) if r not in tried))}
    best = simplest()
    explained = tried[best] < enough
    if explained and best != written:  # the search ends early: others may be as simple, or leave far less
        for further in (changed if best.changes == 1 else changed_twice, counted):
            tried |= {new: new.rms for new in placed(dict.fromkeys(r for r in further(written) if r not in tried))}
        best = simplest()
        for less in (one for one in flips(best) if one.changes < best.changes):  # half a turn in place of a sign
            tried |= {new: new.rms for new in placed(dict.fromkeys(r for r in changed(less) if r not in tried))}
    if CLEARLY * tried[best] >= written.rms:
        return Readings(written)
    as_simple = (r for r in tried if explained and r.changes == best.changes and not r.moved_zeros)
    alike = sorted((r for r in as_simple if r != best and tried[r] <= ALIKE * tried[best]), key=tried.__getitem__)
    hopeless = np.inf
    best, *others = placed((best, *alike[:2]))  # two are named beside the simplest
    counting = best.counting(arm.counting) if explained else None
    return Readings(written, best, tuple(others), explained, counting=counting)


def _rows(arm: Arm, measurements: Measurements) -> tuple[Array, Array, bool]:
    """Postures (m, n) and positions (m, d) of the point and session that is measured most, spread over the file, those
    far from all others left out; and whether they are so few that another reading would fit by chance: of a pose, of a
    point where it is open, and of one number more."""
    rows = np.arange(len(measurements))
    for name in ("marker", "session"):  # between sessions the base may have moved
        numbers = measurements.numbers(name)
        rows = rows[numbers[rows] == np.bincount(numbers[rows]).argmax()]
    # 200 of them: a wrong sign shows in far fewer
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, 200).astype(int))]
    x = measurements.positions[rows, : arm.chain.instrument.dimension]  # of poses the points
    off = np.linalg.norm(x - np.median(x, axis=0), axis=1)
    near = off <= FAR * np.quantile(off, 0.75)
    # below three equations for each fitted number anything may fit
    unknowns = arm.dimension + len(arm.chain.turning) + (0 if TOOL in arm.chain.settled else arm.dimension) + 1
    return measurements.postures[rows][near], x[near], x.size < 3 * unknowns


def parallel_joints(chain: KinematicChain) -> list[tuple[int, tuple[int, ...]]]:
    """Runs of two or more joints that turn about parallel axes, one after the other: the first (from 0), and of each
    whether it turns as the first does (1) or the other way (-1)."""
    turns = accumulate((joint.origin[:3, :3] for joint in chain.joints), matmul)
    axes = [turn @ joint.axis * (joint.type == REVOLUTE) for turn, joint in zip(turns, chain.joints, strict=True)]
    runs = [(0, [1])]
    for j, (before, axis) in enumerate(pairwise(axes), start=1):
        if abs(along := float(before @ axis)) > np.cos(np.radians(1.0)):  # a drawing's angles may be rounded
            runs[-1][1].append(runs[-1][1][-1] * int(np.sign(along)))
        else:
            runs.append((j, [1]))
    return [(first, tuple(senses)) for first, senses in runs if len(senses) > 1]


def _spread(points: Array) -> float:
    """Median distance of points (m, d) from their median, of distances (m, 1) that of the points they are of, if these
    lie on all sides: of normal ones 1.54 and 0.67 standard deviations of a coordinate."""
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.median(off) * (1.54 / 0.67 if points.shape[1] == 1 else 1.0))


# -- orientations, and what is said of every file ----------------------------------------------------------------------
def data_warnings(measurements: Measurements, arm: Arm) -> list[str]:
    """Sentences about units that the numbers contradict and other conventions of orientations; and of an arm that
    reaches farther than any does. Raises `InputError` if the numbers of joints differ."""
    units = read_differently(arm, measurements, search=False).sentences
    far = min(arm.reach, float(np.linalg.norm(arm.chain.tip_frames(measurements.postures)[:, :3, 3], axis=1).max()))
    if far > 20000.0:  # [mm]; long steps between nearly parallel axes cancel
        how = "lengths that were written in millimetres there come out 1000 times too large"
        units.insert(0, f"the arm of the file reaches {far / 1000.0:.4g} m: a URDF has metres, and {how}")
    # convention: 1 deg or 1 mm, far above what a controller leaves
    most = np.where([kind == PRISMATIC for kind in arm.joint_types], 1.0, np.radians(1.0))
    if measurements.repeats is not None:
        _, firsts, numbers = np.unique(measurements.repeats, return_index=True, return_inverse=True)
        off = np.abs(measurements.postures - measurements.postures[firsts[numbers]])
        if (elsewhere := np.any(np.minimum(off, np.abs(off - 2.0 * np.pi)) > most, axis=1)).any():
            row = int(np.argmax(elsewhere))
            said = f"row {row + 1} has the number of row {firsts[numbers[row]] + 1} in the column posture"
            units.append(f"{said}, but other joint positions: equal numbers mark repeats of one posture")
    if measurements.commanded is not None:
        off = np.median(np.abs(measurements.postures - measurements.commanded), axis=0)
        beside = off > most
        if beside.any():
            joints = ", ".join(map(str, np.flatnonzero(beside) + 1))
            units.append(f"commanded and read differ by more than 1 deg or 1 mm, joints {joints}: are the units right?")
    first = measurements.rows(measurements.session_rows[0])
    if units or (turns := first.orientations) is None or _rows(arm, measurements)[2]:
        return units
    # as it is drawn; with one measured point where it has several and the rows name none
    chain = arm.chain.one_unnamed(measurements.marker_names)
    model, missed = Model(replace(arm, chain=chain, effects=(), calibration=None)), dict[str, float]()
    tips, marker = chain.tip_frames(first.postures), first.numbers("marker")
    for name, read in other_orientations(turns).items():
        placed = placed_model(model, replace(first, orientations=read)).arm.chain
        apart = (placed.base @ tips @ np.array([*placed.tools.values()])[marker])[:, :3, :3] - read
        half = np.linalg.norm(apart, axis=(1, 2)) / np.sqrt(8.0)  # the sine of half the angle between them
        missed[name] = 2.0 * float(np.arcsin(min(np.median(half), 1.0)))
        if missed[""] <= FAR * arm.machining.rotation:
            return []
    best = min(missed, key=missed.__getitem__)
    looks = f"; they look like {best}" if CLEARLY * missed[best] < missed[""] else ""
    return [
        f"the orientations are {np.degrees(missed['']):.3g} deg from the nominal arm's in the median{looks}; rx_deg, "
        "ry_deg and rz_deg turn the tool about its own x, then y, then z axis, from the frame of the instrument"
    ]


def other_orientations(turns: Array) -> dict[str, Array]:
    """Orientations (m, 3, 3) as they were read, and as they would have been by other conventions of controllers and
    programs, in words: nothing -> as they were read."""
    from scipy.spatial.transform import Rotation  # deferred: only poses pay for the import

    near = to_angles(turns)
    far = near + np.pi * np.where(near > 0.0, -1.0, 1.0)  # the same rotations
    far[:, 1] = np.pi * np.where(near[:, 1] > 0.0, 1.0, -1.0) - near[:, 1]
    # rotation vectors are no longer than half a turn; for the others it makes no difference
    angles = np.where(
        np.linalg.norm(near, axis=1, keepdims=True) > np.linalg.norm(far, axis=1, keepdims=True), far, near
    )
    orders = {"angles about fixed axes": "xyz", "angles about z, then y, then x": "ZYX"}
    four = Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]  # as columns qw, qx, qy, qz have them
    read = {"": turns, "quaternions in the order x, y, z, w": Rotation.from_quat(four).as_matrix()}
    read["angles in radians"] = Rotation.from_euler("XYZ", np.degrees(angles)).as_matrix()
    for unit, columns in (("", angles), (" in radians", np.degrees(angles))):
        read |= {name + unit: Rotation.from_euler(order, columns).as_matrix() for name, order in orders.items()}
        read[f"rotation vectors{unit}"] = Rotation.from_rotvec(columns).as_matrix()
    inverse = "the instrument in the frame of the tool"
    return read | {f"{inverse}{name and f', by {name}'}": np.swapaxes(each, -1, -2) for name, each in read.items()}


def gap_notes(measurements: Measurements) -> list[str]:
    """Rows of which nothing says from which side their joints came, in a sentence; none where that is known."""
    if (given := measurements.directions) is not None:
        unknown = [f"joint {j} in {count}" for j, count in enumerate(np.isnan(given).sum(axis=0), start=1) if count]
        why = "not given, or left open by columns of coupled joints; backlash needs it"
        return [f"unknown approach directions: {', '.join(unknown)} of {len(given)} rows ({why})"] if unknown else []
    if measurements.gaps is None:
        return []
    left_out = f"column order: numbers are missing before {int(measurements.gaps.sum())} of {len(measurements)} rows"
    how = "give order 1, 2, 3 .. without gaps, or columns direction1, direction2 .."
    return [f"{left_out}: the approach direction is unknown there (backlash needs it; {how})"]


# -- what else the drawing tells ---------------------------------------------------------------------------------------
def placed_with_zeros(model: Model, measurements: Measurements) -> tuple[Model, dict[str, float]]:
    """The model where the closed form places it, and zeros of joints to start from where they are clearly not those of
    the drawing: far from them a fit may end with frames turned over."""
    start = placed_model(model, measurements)
    if start is model or (arm := model.arm).calibration is not None:
        return start, {}
    rows = spread_rows(measurements, measurements.session_rows[0])  # later ones have another base
    left = rows.positions - start.position(rows.postures, conditions=rows.conditions)
    better = read_differently(arm, measurements).better if rms_distance(left) > DRAWN * start.reach else None
    if better is None or not better.moved_zeros:
        return start, {}
    zeros = {f"{JOINT_OFFSET}:{j}": turn for j, turn in enumerate(better.zeros, start=1)}
    turned = placed_model(replace(model, arm=replace(arm, calibration=Calibration(zeros))), measurements)
    return replace(turned, arm=replace(turned.arm, calibration=None)), zeros
