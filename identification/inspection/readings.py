"""Alternative readings of a measurement file: reversed joints, swapped columns, other zeros, mirrored axes.

A wrong sign leaves decimetres where a real arm leaves millimetres, so the drawing is enough to see it: for each way to
read the columns the base (and in space the measured point) is fitted to the drawing in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, Calibration
from identification.inspection.data_checks import CLEARLY, DRAWN
from identification.inspection.parallel_axes import parallel_joints
from identification.inspection.reading import Reading, Readings
from identification.kinematics.length_placement import placed_by_lengths
from identification.kinematics.parameters import JOINT_OFFSET, PRISMATIC
from identification.kinematics.placement import placed
from identification.kinematics.spatial import SpatialChain
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.model.placed import frames_of_tip, placed_model, some

ENOUGH = 200  # rows that are used: a wrong sign shows in far fewer
ALIKE = 1.2  # times as much is left: no better, and the simpler reading counts
EQUATIONS = 4  # for each fitted number, below which anything may fit
OTHERS = 2  # readings that are named beside the simplest
HOPELESS = 2.0  # times what a better reading may leave
KEPT = 4  # effort: readings from which the next kind of change starts
ZEROS = tuple(np.arange(0.0, 4.0, 0.25))  # quarter turns: starts, of which one is near enough to the best
FINE, WHOLE = 1e-3, 0.02  # quarter turns, 0.1 and 2 deg: how well a zero is found; what is a whole quarter turn
MANY = 6  # joints, up to which all combinations of signs are tried
PLANE, SPACE = 3, 9  # numbers fitted: a pose in the plane; a pose and a point in space


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
    return Readings(_turned(arm, rows, replace(reading, rms=_distance(arm, rows)(reading))), None)


def joints_of_unseen_sign(arm: Arm, measurements: Measurements) -> tuple[int, ...]:
    """Turning joints (from 1) whose sign and zero no measured point shows: reversed and a quarter or half turn away the
    drawing leaves no more; none with orientations, few rows, or where the drawing leaves much as it is."""
    numbers, arm = measurements.marker_numbers, anywhere(arm)
    numbers = np.zeros(len(measurements), dtype=np.int64) if numbers is None else numbers
    points = (some_of_one_point(measurements.rows(np.flatnonzero(numbers == number))) for number in np.unique(numbers))
    if measurements.orientations is not None:
        return ()
    return tuple(sorted(set.intersection(*(_unseen(arm, rows) for rows in points))))


def _unseen(arm: Arm, rows: Measurements) -> set[int]:
    """Those that one measured point does not show."""
    plain, left = Reading.as_written(arm.links), _distance(arm, rows)
    written = left(plain)
    if _few(arm, rows) or written > DRAWN * arm.reach:
        return set()
    most = ALIKE * max(written, float(np.sqrt(np.finfo(float).eps)) * arm.reach)  # rounded, of data without noise
    others = [*_flips(plain, arm), *_zeros(plain, arm)]
    shown = {_changed(reading) for reading in others if left(reading) > most}
    turning = {j for j, kind in enumerate(arm.joint_types, start=1) if kind != PRISMATIC}
    return turning - shown


def _changed(reading: Reading) -> int:
    """The joint (from 1) that is read differently."""
    return next(j for j, (s, k) in enumerate(zip(reading.signs, reading.quarters, strict=True), start=1) if s < 0 or k)


def anywhere(arm: Arm) -> Arm:
    """The arm as drawn, where it stands and what is measured on it left open."""
    chain = arm.chain and SpatialChain(arm.chain.joints, arm.chain.end, instrument=arm.chain.instrument)
    return replace(arm, chain=chain)


@lru_cache(maxsize=2)  # a fit asks before it begins, and again when it has placed the arm
def _read_differently(arm: Arm, rows: Measurements) -> Readings:
    n = arm.links
    written = replace(Reading.as_written(n), rms=_distance(arm, rows)(Reading.as_written(n)))
    if _few(arm, rows):
        return Readings(written, None)
    left = _distance(arm, rows, HOPELESS * max(DRAWN * arm.reach, written.rms / CLEARLY))
    known = {replace(written, rms=0.0): written}
    zero = partial(_moved_zero, left=left)
    for stage in (zero, zero, _absolute, _mirrored, _signs, _swaps, _zeros, _flips, _zeros, _pairs_and_zero):
        kept = sorted(known.values(), key=lambda reading: reading.rms)
        if kept[0].rms < DRAWN * arm.reach:
            break
        whole = [reading for reading in kept if not reading.moved_zeros][:KEPT]
        starts = kept[:1] if stage is zero else dict.fromkeys((written, *([] if stage is _pairs_and_zero else whole)))
        for reading in (other for start in starts for other in stage(replace(start, rms=0.0), arm)):
            if reading not in known:
                known[reading] = replace(reading, rms=left(reading))
    best = _simplest(list(known.values()))
    if CLEARLY * best.rms >= written.rms:
        return Readings(written, None)
    explained = best.rms < DRAWN * arm.reach
    if explained and not best.moved_zeros:  # the search ends early: at a zero, say, that a sign is as good as
        known |= {r: replace(r, rms=left(r)) for r in _signs(replace(written, rms=0.0), arm) if r not in known}
    alike = [r for r in _as_good(best, known.values()) if explained and r != best]
    best, *alike = (_turned(arm, rows, reading) for reading in (best, *alike[:OTHERS]))
    counting = best.counting(arm.counting) if explained else None
    return Readings(written, best, tuple(alike), explained, counting)


def _as_good(best: Reading, tried: Iterable[Reading]) -> list[Reading]:
    """Those as simple as the best that leave about as little, the least first."""
    alike = [r for r in tried if r.changes == best.changes and r.rms <= ALIKE * best.rms and not r.moved_zeros]
    return sorted(alike, key=lambda reading: reading.rms)


def _turned(arm: Arm, rows: Measurements, reading: Reading) -> Reading:
    """The reading with the turn of the base, in the plane."""
    if arm.chain is not None:
        return reading
    return replace(reading, turn=float(np.angle(np.vdot(*_in_plane(arm, rows, reading)))))


def _few(arm: Arm, rows: Measurements) -> bool:
    """Whether another reading would fit by chance."""
    return rows.positions.size < EQUATIONS * (PLANE if arm.chain is None else SPACE)


def out_of_step(arm: Arm, measurements: Measurements) -> list[str]:
    """Positions that stand beside the posture of another row, in a sentence; none where no step explains them."""
    as_written = Reading.as_written(arm.links)
    if _few(arm, some := some_of_one_point(measurements)):
        return []
    written = _distance(arm, some)(as_written)
    first, last = measurements.rows(slice(None, -1)), measurements.rows(slice(1, None))
    for postures, positions, when in ((first, last, "late"), (last, first, "early")):
        rows = some_of_one_point(replace(postures, positions=positions.positions))
        if CLEARLY * (left := _distance(arm, rows)(as_written)) < written:
            gain = f"the drawing then leaves {left:.3g} mm instead of {written:.4g}"
            return [f"it looks as if each position stands one row too {when}, beside another posture: {gain}"]
    return []


def placed_with_zeros(model: Model, measurements: Measurements) -> tuple[Model, dict[str, float]]:
    """The model where the closed form places it, and zeros of joints to start from where they are clearly not those of
    the drawing: far from them a fit may end with frames turned over."""
    found = placed_model(model, measurements)
    if found is model or (arm := model.arm).chain is None or arm.calibration is not None:
        return found, {}
    rows = some(measurements, measurements.session_rows[0])  # later ones have another base
    left = rows.positions - found.position(rows.postures, conditions=rows.conditions)
    better = read_differently(arm, measurements).better if rms_distance(left) > DRAWN * found.reach else None
    if better is None or not better.moved_zeros:
        return found, {}
    zeros = {f"{JOINT_OFFSET}:{j}": turn for j, turn in enumerate(better.zeros, start=1)}
    there = placed_model(replace(model, arm=replace(arm, calibration=Calibration(zeros))), measurements)
    return replace(there, arm=replace(there.arm, calibration=None)), zeros


def _simplest(tried: list[Reading]) -> Reading:
    """The reading with the fewest changes of those that leave about as little as the best."""
    least = min(reading.rms for reading in tried)
    return min((r for r in tried if r.rms <= ALIKE * least), key=lambda r: (r.changes, r.rms))


def _moved_zero(best: Reading, arm: Arm, left: Callable[[Reading], float]) -> Iterator[Reading]:
    """The zero of one turning joint where it explains the positions best; a whole quarter turn where it is near one."""
    for j in (j for j, kind in enumerate(arm.joint_types) if kind != PRISMATIC):
        yield _best_zero(best, j, left)


def _best_zero(best: Reading, joint: int, left: Callable[[Reading], float]) -> Reading:
    from scipy.optimize import minimize_scalar

    def with_zero(k: float) -> Reading:
        return replace(best, quarters=tuple(k if i == joint else old for i, old in enumerate(best.quarters)))

    near = min(ZEROS, key=lambda k: left(with_zero(k)))
    bounds = (near - ZEROS[1], near + ZEROS[1])
    found = float(minimize_scalar(lambda k: left(with_zero(k)), bounds=bounds, options={"xatol": FINE}).x)
    return with_zero(round(found) % 4 if abs(found - round(found)) < WHOLE else found)


def _absolute(best: Reading, arm: Arm) -> Iterator[Reading]:
    """One joint, or all from one on, counted from a link farther back than the one before, or from the base: of joints
    that turn about parallel axes one after the other."""
    for first, senses in parallel_joints(arm):
        last = first + len(senses)
        for start in range(first, last - 1):
            every = best.sums
            for j in range(start + 1, last):
                row = list(best.sums[j])
                row[start:j] = [senses[i - first] * senses[j - first] for i in range(start, j)]
                every = (*every[:j], tuple(row), *every[j + 1 :])
                yield replace(best, sums=(*best.sums[:j], tuple(row), *best.sums[j + 1 :]))
            yield replace(best, sums=every)


def _mirrored(best: Reading, arm: Arm) -> Iterator[Reading]:
    """The frame of the positions mirrored; lengths are the same in it."""
    if arm.chain is None or arm.chain.instrument.whole:
        yield replace(best, mirrored=not best.mirrored)


def _signs(best: Reading, arm: Arm) -> Iterator[Reading]:
    """All combinations of signs, of many joints those with up to two changes, with and without a mirrored frame."""
    n = arm.links
    every = product((1, -1), repeat=n)
    for signs in every if n <= MANY else (s for s in every if sum(x < 0 for x in s) <= 2):
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
            yield replace(best, quarters=tuple(k if i == j else old for i, old in enumerate(best.quarters)))


def _pairs_and_zero(best: Reading, arm: Arm) -> Iterator[Reading]:
    """Up to two joints turning the other way, and the zero of one: each alone may explain next to nothing."""
    for signs in {pair for flip in _flips(best, arm) for pair in (flip, *_flips(flip, arm))}:
        yield from _zeros(signs, arm)


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


def _distance(arm: Arm, rows: Measurements, hopeless: float = np.inf) -> Callable[[Reading], float]:
    """Root mean square distance [mm] of the drawing from the positions of a reading, its place fitted; of lengths
    roughly, where it is `hopeless`."""
    if (chain := arm.chain) is not None:
        frames, measured, instrument = frames_of_tip(chain), rows.positions[:, :3], chain.instrument
        if not instrument.whole:
            lengths = partial(placed_by_lengths, instrument, reach=chain.reach, hopeless=hopeless)
            return lambda reading: lengths(frames(reading.postures(rows.postures)), measured[:, 0]).rms
        return lambda reading: (
            placed(frames(reading.postures(rows.postures)), reading.positions(measured), chain.reach).rms
        )

    def in_plane(reading: Reading) -> float:
        tip, measured = _in_plane(arm, rows, reading)
        crossed = abs(np.vdot(tip, measured))  # at the best rotation
        squares = np.sum(np.abs(tip) ** 2 + np.abs(measured) ** 2) - 2.0 * crossed
        return float(np.sqrt(max(squares, 0.0) / len(tip)))

    return in_plane


def _in_plane(arm: Arm, rows: Measurements, reading: Reading) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """(m,) tips as drawn and as measured, each less its mean."""
    tip = np.exp(1j * np.cumsum(reading.postures(rows.postures), axis=1)) @ arm.lengths
    measured = reading.positions(rows.positions) @ np.array([1.0, 1.0j])
    return tip - tip.mean(), measured - measured.mean()
