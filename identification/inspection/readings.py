"""Other readings of a measurement file: reversed joints, swapped columns, other zeros, mirrored axes, in words.

A wrong sign leaves decimetres where a real arm leaves millimetres, so the drawing is enough to see it: for each way to
read the columns the base (and in space the measured point) is fitted to the drawing in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.inspection.data_checks import CLEARLY, DRAWN
from identification.instruments import Placement, Unplaced
from identification.kinematics.chain import TOOL, KinematicChain
from identification.kinematics.counting import Counting
from identification.kinematics.parameters import JOINT_OFFSET, PRISMATIC, REVOLUTE
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.model.placed import placed_model, some

ENOUGH = 200  # rows that are used: a wrong sign shows in far fewer
ALIKE = 1.2  # times as much is left: no better, and the simpler reading counts
OTHERS = 2  # readings that are named beside the simplest
KEPT = 4  # effort: readings from which the next kind of change starts
ZEROS = tuple(np.arange(0.0, 4.0, 0.25))  # quarter turns: starts, of which one is near enough to the best
MANY = 6  # joints, up to which all combinations of signs are tried


# -- a reading ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Reading:
    """One way to read the columns.

    order : joint j is in column order[j];  signs : +1 or -1 of each joint
    quarters : quarter turns to add to each joint, whole ones or a zero of any angle
    mirrored : the positions are those of a mirror image: their last axis is read the other way
    sums : (n, n) how often column j has the angle of joint i in it: 1 on the diagonal, and 1 or -1 of joints before j
        where j is counted from farther back than from the link before; empty: no joint is
    turn : of the base [rad] that then explains the positions best, in the plane; None: it says nothing
    rms : distance [mm] that the drawing leaves
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    quarters: tuple[float, ...]
    mirrored: bool = False
    sums: tuple[tuple[int, ...], ...] = ()
    turn: float | None = None
    rms: float = np.inf

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
        as_written = Reading.as_written(len(self.order))
        same = replace(self, quarters=as_written.quarters, turn=None, rms=np.inf) == as_written
        return same and any(k % 1.0 for k in self.quarters)

    @property
    def zeros(self) -> tuple[float, ...]:
        """(n) what to add to each joint [rad], by the shorter way."""
        return tuple(float(np.radians(180.0 - (180.0 - 90.0 * k) % 360.0)) for k in self.quarters)

    def postures(self, columns: Array) -> Array:
        """(m, n) what the arm's joints are, of columns (m, n)."""
        read = columns[:, list(self.order)] * np.array(self.signs) + 0.5 * np.pi * np.array(self.quarters)
        return np.linalg.solve(self.matrix, read.T).T if self.sums else read

    def positions(self, columns: Array) -> Array:
        """(m, d) what the positions are in axes of the right hand."""
        return columns * np.r_[np.ones(columns.shape[1] - 1), -1.0] if self.mirrored else columns

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
            # with x and y swapped the last axis turned gives back the drawing a quarter turn away, with an axis turned
            # it stands as drawn or half a turn away
            swapped, flipped = "x_mm and y_mm are swapped", "an axis of the positions points the other way"
            if self.turn is None:
                swapped, turn_tells = "two of x_mm, y_mm, z_mm are swapped", False
            else:
                turn_tells = abs(np.sin(2.0 * self.turn)) <= np.sin(2.0 * np.radians(20.0))
            # nearer to upright, or to a half turn, than to a quarter turn
            upright = self.turn is not None and abs(np.cos(self.turn)) > np.cos(np.radians(45.0))
            sentences.append((flipped if upright else swapped) if turn_tells else f"{swapped}, or {flipped}")
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
        nothing = "no one or two signs, zeros, swapped columns or mirrored axes explain the positions"
        return [f"{nothing}: several faults at once, or another arm? Closest: {ways}, which leaves {gain}"]

    def to_json(self) -> dict[str, Any] | None:
        """`better_reading` of `check` (identification/files/README.md, "JSON keys")."""
        if (better := self.better) is None:
            return None
        return {
            "changes": better.words,
            "arm_file": None if self.counting is None else self.counting.toml,
            "rms_mm": better.rms,
            "explains": self.explained,
            "equally_good": [reading.words for reading in self.alike],
        }


# -- the search --------------------------------------------------------------------------------------------------------
def read_differently(arm: Arm, measurements: Measurements) -> Readings:
    """Look for another way to read the columns that explains the positions clearly better (`CLEARLY`).

    Tried are zeros, of one joint at any angle, joints that are counted from farther back than the link before, signs,
    pairs of swapped columns, zeros off by quarter turns, and a mirrored frame. With few rows nothing is tried. Where a
    spatial arm stands and what is measured on it are fitted.
    """
    return _read_differently(anywhere(arm), some_of_one_point(measurements))


def as_written(arm: Arm, measurements: Measurements) -> Readings:
    """What the columns say, and no other reading looked for."""
    reading = Reading.as_written(arm.links)
    arm, rows = anywhere(arm), some_of_one_point(measurements)
    return Readings(_placed(arm, rows)(reading), None)


@lru_cache(maxsize=2)  # a fit asks before it begins, and again when it has placed the arm
def _read_differently(arm: Arm, rows: Measurements) -> Readings:
    written = _placed(arm, rows)(Reading.as_written(arm.links))
    if _few(arm, rows):
        return Readings(written, None)
    left = _distance(arm, rows, 2.0 * max(DRAWN * arm.reach, written.rms / CLEARLY))  # twice what may be left: no hope
    plain = replace(written, rms=0.0, turn=None)
    tried = {plain: replace(written, turn=None)}
    zero = partial(_moved_zero, left=left)
    for stage in (zero, zero, _absolute, _mirrored, _signs, _swaps, _zeros, _flips, _zeros, _pairs_and_zero):
        ranked = sorted(tried.values(), key=lambda reading: reading.rms)
        if ranked[0].rms < DRAWN * arm.reach:
            break
        whole = [reading for reading in ranked if not reading.moved_zeros][:KEPT]
        starts = ranked[:1] if stage is zero else [tried[plain], *([] if stage is _pairs_and_zero else whole)]
        for reading in (other for start in dict.fromkeys(starts) for other in stage(replace(start, rms=0.0), arm)):
            if reading not in tried:
                tried[reading] = replace(reading, rms=left(reading))
    # the fewest changes of those that leave about as little as the best
    least = min(reading.rms for reading in tried.values())
    best = min((r for r in tried.values() if r.rms <= ALIKE * least), key=lambda r: (r.changes, r.rms))
    if CLEARLY * best.rms >= written.rms:
        return Readings(written, None)
    explained = best.rms < DRAWN * arm.reach
    if explained and not best.moved_zeros:  # the search ends early: at a zero, say, that a sign is as good as
        tried |= {r: replace(r, rms=left(r)) for r in _signs(plain, arm) if r not in tried}
    as_simple = (r for r in tried.values() if explained and r.changes == best.changes and not r.moved_zeros)
    alike = sorted((r for r in as_simple if r != best and r.rms <= ALIKE * best.rms), key=lambda reading: reading.rms)
    best, *alike = map(_placed(arm, rows), (best, *alike[:OTHERS]))
    counting = best.counting(arm.counting) if explained else None
    return Readings(written, best, tuple(alike), explained, counting)


def _moved_zero(best: Reading, arm: Arm, left: Callable[[Reading], float]) -> Iterator[Reading]:
    """The zero of one turning joint where it explains the positions best; a whole quarter turn where it is near one."""
    from scipy.optimize import minimize_scalar

    for j in (j for j, kind in enumerate(arm.joint_types) if kind != PRISMATIC):

        def left_with(k: float, j: int = j) -> float:
            return left(_with_quarters(best, j, k))

        near = min(ZEROS, key=left_with)
        bounds = (near - ZEROS[1], near + ZEROS[1])
        k = float(minimize_scalar(left_with, bounds=bounds, options={"xatol": 1e-3}).x)  # to 0.1 deg
        yield _with_quarters(best, j, round(k) % 4 if abs(k - round(k)) < 0.02 else k)  # within 2 deg it is a whole one


def _with_quarters(reading: Reading, joint: int, k: float) -> Reading:
    """With so many quarter turns added to a joint, from 0."""
    return replace(reading, quarters=(*reading.quarters[:joint], k, *reading.quarters[joint + 1 :]))


def _absolute(best: Reading, arm: Arm) -> Iterator[Reading]:
    """One joint, or all from one on, counted from a link farther back than the one before, or from the base: of joints
    that turn about parallel axes one after the other."""
    for first, senses in parallel_joints(arm):
        last = first + len(senses)
        for start in range(first, last - 1):
            every = best.matrix
            for j in range(start + 1, last):
                one = best.matrix
                one[j, start:j] = every[j, start:j] = [senses[i - first] * senses[j - first] for i in range(start, j)]
                yield replace(best, sums=tuple(map(tuple, one.tolist())))
            yield replace(best, sums=tuple(map(tuple, every.tolist())))


def parallel_joints(arm: Arm) -> list[tuple[int, tuple[int, ...]]]:
    """Runs of two or more joints that turn about parallel axes, one after the other: the first (from 0), and of each
    whether it turns as the first does (1) or the other way (-1)."""
    axes, turned = list[Array | None](), np.eye(3)
    for joint in arm.chain.joints:
        turned = turned @ joint.origin[:3, :3]
        axes.append(turned @ joint.axis if joint.type == REVOLUTE else None)
    runs = list[tuple[int, list[int]]]()
    for j, (before, axis) in enumerate(zip([None, *axes], axes, strict=False)):
        along = 0.0 if axis is None or before is None else float(axis @ before)
        if abs(along) > np.cos(np.radians(1.0)):  # a drawing's angles may be rounded
            runs[-1][1].append(runs[-1][1][-1] * int(np.sign(along)))
        else:
            runs.append((j, [1]))
    return [(first, tuple(senses)) for first, senses in runs if len(senses) > 1]


def _mirrored(best: Reading, arm: Arm) -> Iterator[Reading]:
    """The frame of the positions mirrored; lengths are the same in it."""
    if arm.chain.instrument.reads_positions:
        yield replace(best, mirrored=not best.mirrored)


def _signs(best: Reading, arm: Arm) -> Iterator[Reading]:
    """All combinations of signs, of many joints those with up to two changes, with and without a mirrored frame."""
    for signs in product((1, -1), repeat=arm.links):
        if arm.links <= MANY or sum(sign < 0 for sign in signs) <= 2:
            changed = replace(best, signs=signs)
            yield changed
            yield from _mirrored(changed, arm)


def _swaps(best: Reading, arm: Arm) -> Iterator[Reading]:
    """Every pair of columns of like joints swapped, as it is and with one joint turning the other way."""
    for a, b in combinations(range(arm.links), 2):
        if arm.joint_types[a] == arm.joint_types[b]:
            order = list(best.order)
            order[a], order[b] = order[b], order[a]
            swapped = replace(best, order=tuple(order))
            yield swapped
            yield from _flips(swapped, arm)


def _flips(best: Reading, arm: Arm) -> Iterator[Reading]:
    """One joint turning the other way than before."""
    for j in range(arm.links):
        yield replace(best, signs=tuple(-sign if i == j else sign for i, sign in enumerate(best.signs)))


def _zeros(best: Reading, arm: Arm) -> Iterator[Reading]:
    """The zero of one turning joint off by quarter turns."""
    for j, k in product(range(arm.links), (1, 2, 3)):
        if arm.joint_types[j] != PRISMATIC:
            yield _with_quarters(best, j, k)


def _pairs_and_zero(best: Reading, arm: Arm) -> Iterator[Reading]:
    """Up to two joints turning the other way, and the zero of one: each alone may explain next to nothing."""
    for signs in {pair for flip in _flips(best, arm) for pair in (flip, *_flips(flip, arm))}:
        yield from _zeros(signs, arm)


# -- what a reading leaves ---------------------------------------------------------------------------------------------
def anywhere(arm: Arm) -> Arm:
    """The arm as drawn, where it stands left open, and in space what is measured on it."""
    chain = arm.chain
    tip = chain.settled & {TOOL} if chain.planar else frozenset[str]()
    return replace(
        arm, chain=KinematicChain(chain.joints, chain.end, settled=tip, instrument=chain.instrument, axes=chain.axes)
    )


def some_of_one_point(measurements: Measurements) -> Measurements:
    """Rows of the point that is measured most, spread over the file."""
    rows = np.arange(len(measurements))
    if (markers := measurements.marker_numbers) is not None:
        rows = rows[markers == np.bincount(markers).argmax()]
    if measurements.session is not None:  # between sessions the base may have moved
        sessions = measurements.session[rows]
        names, counts = np.unique(sessions, return_counts=True)
        rows = rows[sessions == names[counts.argmax()]]
    return measurements.rows(rows[np.unique(np.linspace(0, len(rows) - 1, ENOUGH).astype(int))])


def _few(arm: Arm, rows: Measurements) -> bool:
    """Whether another reading would fit by chance: of a pose, and of a point where it is open."""
    point = 0 if TOOL in anywhere(arm).chain.settled else arm.dimension
    # below four equations for each fitted number anything may fit
    return rows.positions.size < 4 * (arm.dimension + len(arm.chain.turning) + point)


def _distance(arm: Arm, rows: Measurements, hopeless: float = np.inf) -> Callable[[Reading], float]:
    """Root mean square distance [mm] of the drawing from the positions of a reading, its place fitted; of lengths
    roughly, where it is `hopeless`."""
    place = _place(arm, rows, hopeless)
    return lambda reading: place(reading).rms


def _place(arm: Arm, rows: Measurements, hopeless: float = np.inf) -> Callable[[Reading], Placement]:
    """Where the drawing stands by a reading."""
    chain = anywhere(arm).chain
    measured = rows.positions[:, : chain.coordinates]
    tool = np.zeros(3) if TOOL in chain.settled else None
    read = partial(Unplaced, reach=chain.reach, tool=tool, hopeless=hopeless)
    return lambda reading: chain.instrument.place(
        read(chain.tip_frames(reading.postures(rows.postures)), reading.positions(measured))
    )


def _placed(arm: Arm, rows: Measurements) -> Callable[[Reading], Reading]:
    """A reading with what it leaves, and with the turn of the base in the plane."""
    place = _place(arm, rows)

    def placed(reading: Reading) -> Reading:
        base, _, rms = place(reading)
        turn = float(np.arctan2(base[1, 0], base[0, 0])) if arm.chain.positions_in_plane else None
        return replace(reading, rms=rms, turn=turn)

    return placed


# -- what else the drawing tells ---------------------------------------------------------------------------------------
def joints_of_unseen_sign(arm: Arm, measurements: Measurements) -> tuple[int, ...]:
    """Turning joints (from 1) whose sign and zero no measured point shows: reversed and a quarter or half turn away the
    drawing leaves no more; none with orientations, few rows, or where the drawing leaves much as it is."""
    if measurements.orientations is not None:
        return ()
    numbers, arm = measurements.marker_numbers, anywhere(arm)
    numbers = np.zeros(len(measurements), dtype=np.int64) if numbers is None else numbers
    points = (some_of_one_point(measurements.rows(np.flatnonzero(numbers == number))) for number in np.unique(numbers))
    return tuple(sorted(set.intersection(*(_unseen(arm, rows) for rows in points))))


def _unseen(arm: Arm, rows: Measurements) -> set[int]:
    """Those that one measured point does not show."""
    plain, left = Reading.as_written(arm.links), _distance(arm, rows)
    written = left(plain)
    if _few(arm, rows) or written > DRAWN * arm.reach:
        return set()
    most = ALIKE * max(written, float(np.sqrt(np.finfo(float).eps)) * arm.reach)  # rounded, of data without noise
    shown = {
        next(j for j, (sign, k) in enumerate(zip(other.signs, other.quarters, strict=True), start=1) if sign < 0 or k)
        for other in (*_flips(plain, arm), *_zeros(plain, arm))
        if left(other) > most
    }
    return {j for j, kind in enumerate(arm.joint_types, start=1) if kind != PRISMATIC} - shown


def out_of_step(arm: Arm, measurements: Measurements) -> list[str]:
    """Positions that stand beside the posture of another row, in a sentence; none where no step explains them."""
    plain = Reading.as_written(arm.links)
    if _few(arm, rows := some_of_one_point(measurements)):
        return []
    written = _distance(arm, rows)(plain)
    first, last = measurements.rows(slice(None, -1)), measurements.rows(slice(1, None))
    for postures, positions, when in ((first, last, "late"), (last, first, "early")):
        rows = some_of_one_point(replace(postures, positions=positions.positions))
        if CLEARLY * (left := _distance(arm, rows)(plain)) < written:
            gain = f"the drawing then leaves {left:.3g} mm instead of {written:.4g}"
            return [f"it looks as if each position stands one row too {when}, beside another posture: {gain}"]
    return []


def placed_with_zeros(model: Model, measurements: Measurements) -> tuple[Model, dict[str, float]]:
    """The model where the closed form places it, and zeros of joints to start from where they are clearly not those of
    the drawing: far from them a fit may end with frames turned over."""
    start = placed_model(model, measurements)
    if start is model or (arm := model.arm).chain.planar or arm.calibration is not None:
        return start, {}
    rows = some(measurements, measurements.session_rows[0])  # later ones have another base
    left = rows.positions - start.position(rows.postures, conditions=rows.conditions)
    better = read_differently(arm, measurements).better if rms_distance(left) > DRAWN * start.reach else None
    if better is None or not better.moved_zeros:
        return start, {}
    zeros = {f"{JOINT_OFFSET}:{j}": turn for j, turn in enumerate(better.zeros, start=1)}
    turned = placed_model(replace(model, arm=replace(arm, calibration=Calibration(zeros))), measurements)
    return replace(turned, arm=replace(turned.arm, calibration=None)), zeros
