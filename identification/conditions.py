"""Conditions of each measurement, and what follows from their order: time, directions, the joints' past."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arm import LARGEST
from identification.arrays import Array, ByValue, slices

# what follows from the order of measurement: all, and what only rows that follow each other show
BY_ORDER = frozenset({"time", "directions", "past"})
FOLLOWING = frozenset({"directions", "past"})
REMEMBERED = 12  # turning points of a past: of 60 random postures in 3,000 one row needs more


# -- what a row may have -----------------------------------------------------------------------------------------------
# for every field of `Measurements` its shapes behind the rows (n: joints), what is allowed in words, and a test; files
# have the same rules for its column
VALUES: dict[str, tuple[tuple[tuple[int | str, ...], ...], str, Callable[[Any], NDArray[np.bool_]]]] = {
    "postures": ((("n",),), "finite angles [rad]", np.isfinite),
    # 1: a length
    "positions": (((2,), (3,), (6,), (1,)), "finite coordinates [mm]", np.isfinite),
    "order": (((),), "a finite number", np.isfinite),
    "payload": (((),), f"a number >= 0 [kg], up to {LARGEST:g}", lambda v: (v >= 0.0) & (v <= LARGEST)),
    "temperature": (((),), "a number >= -273.15 [deg C]", lambda v: np.isfinite(v) & (v >= -273.15)),
    "directions": ((("n",),), "+1 or -1, empty: unknown", lambda v: (np.abs(v) == 1.0) | np.isnan(v)),
    "gaps": (((),), "0 or 1", lambda v: np.isin(v, (0.0, 1.0))),
    "sigma": (((),), "a number > 0 [mm]", lambda v: np.isfinite(v) & (v > 0.0)),
    "repeats": (((),), "a whole number", lambda v: (v == np.round(v)) & (np.abs(v) < 2.0**53)),
    "commanded": ((("n",),), "finite angles [rad]", np.isfinite),
    "orientations": (
        ((3, 3),),
        "rotation matrices",  # they turn and do not mirror
        lambda v: (np.abs(np.swapaxes(v, 1, 2) @ v - np.eye(3)) < 1e-6) & (np.linalg.det(v) > 0.0)[:, None, None],
    ),
    "session": (((),), "a name", lambda v: v != ""),
    "marker": (((),), "a name", lambda v: v != ""),
}


# -- what a row is measured under --------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Conditions(ByValue):
    """What a posture is measured under, one row per posture. None: the neutral value.

    payload : (m,) [kg], None: the arm's own payload
    temperature : (m,) [K] deviation from the mean temperature, None: 0
    time : (m,) position in the session, -0.5..0.5, None: 0
    directions : (m, n) sign of the last motion of each joint, +1 or -1, 0: unknown, None: +1
    session : (m,) number of the session of each row, from 0, None: 0
    past : (m, n, 12) what each joint remembers of the postures before (`past_from_order`) [rad], None: nothing
    marker : (m,) number of the measured point of each row, from 0, None: the first
    orientation : (m, 3, 3) measured, which computed ones are compared with; None: those of the arm as best known
    """

    payload: Array | None = None
    temperature: Array | None = None
    time: Array | None = None
    directions: Array | None = None
    session: Array | None = None
    past: Array | None = None
    marker: Array | None = None
    orientation: Array | None = None

    def table(self, columns: Mapping[str, slice], postures: Array, payload: float) -> Array:
        """(..., m, C) in these columns (`condition_columns`), of postures (..., m, n). Of which nothing is said is
        neutral: the arm's payload [kg], approach +1, the first of several markers, of joints that remember the posture
        itself, and zero."""
        neutral: dict[str, Any] = {"payload": payload, "directions": 1.0, "marker": -1.0}
        table = np.zeros((*postures.shape[:-1], [*columns.values()][-1].stop))  # they follow one another
        for name, place in columns.items():
            if (value := getattr(self, name, None)) is None:
                value = np.repeat(postures, REMEMBERED, axis=-1) if name == "past" else neutral.get(name, 0.0)
            elif name in ("past", "orientation"):
                value = np.reshape(value, (*np.shape(value)[:-2], -1))
            elif name != "directions":
                value = np.asarray(value)[..., None]
            table[..., place] = value
        return table

    @property
    def follow(self) -> bool:
        """Whether what joints did before is known of more than the first row."""
        return self.directions is None or int(np.any(self.directions != 0.0, axis=-1).sum()) > 1

    def rows(self, index: Any) -> Conditions:
        """The conditions of some rows (any numpy index)."""
        pick = {name: value[index] for name, value in vars(self).items() if value is not None}
        return replace(self, **pick)


def condition_columns(n: int, further: Collection[str] = ()) -> dict[str, slice]:
    """Where each condition of a model of n joints stands among its columns, in this order.

    further : which of those that not every model has: `past` of the joints, if an effect has a memory; `marker`, where
        there are several; measured `orientation`, row by row; `errors` of the joints by their curves, with `off`, the
        share of the curves' geometry that does not hold
    """
    sizes = {"payload": 1, "temperature": 1, "time": 1, "session": 1, "directions": n}
    others = {"past": n * REMEMBERED, "marker": 1, "orientation": 9, "errors": n, "off": 1}
    return slices(sizes | {name: size for name, size in others.items() if name in further})


def gaps_of(order: Array) -> NDArray[np.bool_]:
    """(m,) True where numbers are left out of an `order` that counts measurements: the row before is missing.

    Where numbers are left out before more than 3 of 4 rows they are frames or labels, no counts: then the row before is
    the one before.
    """
    sequence = np.argsort(order, kind="stable")
    gaps = np.zeros(len(order), dtype=bool)
    gaps[sequence[1:]] = np.diff(order[sequence]) > 1.0
    return gaps & (gaps.mean() <= 0.75)


def directions_from_order(postures: Array, order: Array | None = None, gaps: Array | None = None) -> Array:
    """(m, n) sign of the change from the posture measured before; first row +1, no change: as before.

    postures : (m, n);  order : (m,), None: as they stand
    gaps : (m,) rows before which measurements are missing: 0 there, until the joint moves again
    """
    m = len(postures)
    sequence = np.arange(m) if order is None else np.argsort(order, kind="stable")
    cut = np.zeros((m, 1), dtype=bool) if gaps is None else gaps[sequence, None].astype(bool)
    signs = np.ones_like(postures)
    signs[1:] = np.where(cut[1:], 0.0, np.sign(np.diff(postures[sequence], axis=0)))
    # the last row that moved, for every row: a running maximum of row numbers
    moved = np.maximum.accumulate(np.where((signs != 0.0) | cut, np.arange(m)[:, None], 0), axis=0)
    directions = np.empty_like(signs)
    directions[sequence] = np.take_along_axis(signs, moved, axis=0)
    return directions


def past_from_order(postures: Array, order: Array | None = None, gaps: Array | None = None) -> Array:
    """(m, n, 12) what each joint remembers when a posture is reached: turning points, the oldest first.

    The first is where the session began, the last the posture before; in between stand the turning points that no
    later swing has wiped out, which decide the state of hysteresis (I. D. Mayergoyz, "Mathematical models of
    hysteresis", 1991). Fewer than 12 are filled up by repeating the first; of more, the smallest swing is left out. In
    the first row all are the posture itself, and so they are after a gap.

    postures, order, gaps : as of `directions_from_order`
    """
    m, n = postures.shape
    sequence = np.arange(m) if order is None else np.argsort(order, kind="stable")
    cut = [False] * m if gaps is None else gaps[sequence].astype(bool).tolist()  # what was before is unknown
    past = np.empty((m, n, REMEMBERED))
    for j, angles in enumerate(postures[sequence].T.tolist()):
        rows, kept = list[list[float]](), angles[:1]
        for k, angle in enumerate(angles):
            if cut[k]:
                kept = [angle]
            rows.append([kept[0]] * (REMEMBERED - len(kept)) + kept)
            if k and not cut[k]:
                _remember(kept, angle)
        past[sequence, j] = rows
    return past


def _remember(kept: list[float], angle: float) -> None:
    """Add an angle to turning points, in place: those on the way and swings inside larger ones are forgotten."""
    kept.append(angle)
    while len(kept) > 2:
        last, before = kept[-1] - kept[-2], kept[-2] - kept[-3]
        if last * before >= 0.0:
            del kept[-2]
        elif len(kept) > 3 and abs(before) <= min(abs(last), abs(kept[-3] - kept[-4])):
            del kept[-3:-1]
        elif len(kept) > REMEMBERED:
            swings = [abs(b - a) for a, b in pairwise(kept)]
            least = 1 + min(range(len(swings) - 2), key=swings[1:-1].__getitem__)
            del kept[least : least + 2]
        else:
            return
