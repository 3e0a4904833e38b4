"""Measured postures: what was commanded, what was measured, and under which conditions; and what follows from their
order: time, directions, the joints' past.

Beside it: which rows a calibration comes from, in little space, to tell later whether measurements are among them. Each
row's angles and position have a digest; of more than `KEPT` rows those with the smallest digests are kept: a random
sample that is the same whatever the order, and the smallest of a union are among the smallest of its parts (A. Z.
Broder, "On the resemblance and containment of documents", 1997).
"""

from __future__ import annotations

import warnings
from base64 import b64decode, b64encode
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import LARGEST
from identification.arrays import Array, ByValue, slices
from identification.errors import InputError, require
from identification.kinematics.parameters import MAX_LINKS

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
    """The conditions under which postures are measured, one row per posture. None: the neutral value.

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
        """(..., m, C) in these columns (`condition_columns`), of postures (..., m, n). What is not given is
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

    def afterwards(self, rows: int) -> Conditions:
        """The conditions of so many rows once all sessions of an identification are over: later than any step."""
        return replace(self, time=np.full(rows, 0.5), session=np.full(rows, 1000.0))

    def rows(self, index: Any) -> Conditions:
        """The conditions of some rows (any numpy index)."""
        return replace(self, **{name: value[index] for name, value in vars(self).items() if value is not None})


def condition_columns(n: int, further: Collection[str] = ()) -> dict[str, slice]:
    """Where each condition of a model of n joints stands among its columns, in this order.

    further : which of those that not every model has: `past` of the joints, if an effect has a memory; `marker`, where
        there are several; measured `orientation`, row by row; `errors` of the joints by their curves, with `off`, the
        share of the curves' geometry that does not hold
    """
    sizes = {"payload": 1, "temperature": 1, "time": 1, "session": 1, "directions": n}
    others = {"past": n * REMEMBERED, "marker": 1, "orientation": 9, "errors": n, "off": 1}
    return slices(sizes | {name: size for name, size in others.items() if name in further})


def in_turns(postures: Array) -> Array:
    """(m, n) joint positions of which a range of more than a turn, as of a slide [mm], counts as a turn, 2 pi."""
    return postures / np.maximum(np.ptp(postures, axis=0) / (2.0 * np.pi), 1.0)


def directions_from_order(postures: Array, before: float = 1.0) -> Array:
    """(m, n) sign of the change from the posture before; no change: as before. What an encoder reads differently of a
    joint that stays, up to `SAME_POSTURE`, is no change.

    postures : (m, n) in the order of measurement;  before : of a joint until it moves, NaN: unknown
    """
    signs = np.empty_like(postures)
    for j, angles in enumerate(in_turns(postures).T.tolist()):
        sign, last = before, angles[0]  # where it came to: of a scan in small steps these add up
        for row, angle in enumerate(angles):
            if abs(angle - last) > SAME_POSTURE:
                sign, last = np.sign(angle - last), angle
            signs[row, j] = sign
    return signs


def past_from_order(postures: Array) -> Array:
    """(m, n, 12) what each joint remembers when a posture is reached: turning points, the oldest first.

    The first is where the session began, the last the posture before; in between stand the turning points that no
    later swing has wiped out, which decide the state of hysteresis (I. D. Mayergoyz, "Mathematical models of
    hysteresis", 1991). Fewer than 12 are filled up by repeating the first; of more, the smallest swing is left out. In
    the first row all are the posture itself.

    postures : (m, n) in the order of measurement
    """
    past = np.empty((*postures.shape, REMEMBERED))
    for j, angles in enumerate(postures.T.tolist()):
        kept = angles[:1]
        for row, angle in enumerate(angles):
            past[row, j] = [kept[0]] * (REMEMBERED - len(kept)) + kept
            kept.append(angle)
            while len(kept) > 2:  # turning points on the way, and swings inside larger ones, are forgotten
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
                    break
    return past


# -- measurements ------------------------------------------------------------------------------------------------------
# [rad] repeats of one posture agree to some thousandths or hundredths of a degree, as the encoders were read. Within
# this, 0.1 / 202, a wave of 202 periods per turn (two per turn of a gear of 1:101) changes by a tenth of its amplitude.
SAME_POSTURE = 5e-4
POINT = slice(3)  # the coordinates of a residual that are those of a point, in a plane, in space and of a pose
OPTIONAL = frozenset(VALUES.keys() - {"postures", "positions"})


def rms_distance(residuals: Array) -> float:
    """Root mean square over rows of the distances of (m, d) residuals."""
    return float(np.sqrt(np.mean(np.sum(residuals[:, POINT] ** 2, axis=1))))


def distances(residuals: Array) -> Array:
    """(m,) distances [mm] of (m, d) residuals: of poses, d = 6, those of the points."""
    return np.asarray(np.linalg.norm(residuals[:, POINT], axis=1))


def repeats_of(postures: NDArray[np.int64], *others: ArrayLike | None) -> NDArray[np.int64]:
    """(m,) equal numbers for rows of equal posture (m,) and equal in others (m,), marker, session and payload: these
    are no repeats, since what the model leaves of each is another error."""
    columns = np.column_stack([np.asarray(numbers) for numbers in (postures, *others) if numbers is not None])
    return np.unique(columns, axis=0, return_inverse=True)[1].ravel()


@dataclass(frozen=True, eq=False)
class Measurements(ByValue):
    """m measured postures of an n-link arm, in the order of the file.

    postures : (m, n) joint angles [rad], as read, or else as commanded
    positions : (m, d) measured tip positions [mm], in a plane or in space; of poses d = 6: the last three are rotation
        vectors that `orientations` are turned by, times `angle_scale` [mm], zero where they are left out
    order : (m,) order or time stamps; rows in order if the file has none
    gaps : (m,) 1 where measurements just before are missing, so that nothing follows from the order; None: nowhere
    sigma : (m,) standard deviation per row and axis [mm], None: not given per row
    repeats : (m,) equal numbers mark repeats of one posture, None: not given
    session : (m,) name of the session of each row, between which the arm or the instrument was set up again; None: one
    session_names : the sessions in the order of their numbers, also where only some of them are among these rows
    marker : (m,) name of the measured point of each row, where several are measured; None: one
    marker_names : the points in the order of their numbers
    directions : (m, n) +1 or -1, sign of the last motion of each joint; NaN: unknown; None: it follows from the order
    commanded : (m, n) what was asked for where `postures` are as read; None: not given
    reference : temperature [deg C] that those of the rows count from; None: their mean
    orientations : (m, 3, 3) measured axes of the tool in space, by columns; None: not measured
    fit : how the plan asks to be fitted, as options of `armcal identify`, such as `library-prior`; empty: it does not
    past : (m, n, 12) what each joint remembers of the rows before; None: it follows from the order

    Raises `InputError` for no rows, other shapes (nothing is broadcast), and values that no measurement can have.
    """

    postures: Array
    positions: Array
    order: Array | None = None
    payload: Array | None = None
    temperature: Array | None = None  # [deg C] as measured
    directions: Array | None = None
    sigma: Array | None = None
    repeats: NDArray[np.int64] | None = None
    session: NDArray[np.str_] | None = None
    session_names: tuple[str, ...] = ()
    marker: NDArray[np.str_] | None = None
    marker_names: tuple[str, ...] = ()
    past: Array | None = None
    orientations: Array | None = None
    commanded: Array | None = None
    gaps: Array | None = None
    reference: float | None = None
    fit: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        m = n = 0
        for name, (shapes, allowed, test) in VALUES.items():
            if (value := getattr(self, name)) is None and name in OPTIONAL:
                continue
            place, labels = f"measurements.{name}", name in ("session", "marker")
            try:
                array: NDArray[Any] = np.array(value, dtype=np.str_ if labels else float)
            except (TypeError, ValueError):
                raise InputError(f"{place}: not an array of numbers, allowed: real numbers") from None
            if name == "postures":
                if array.ndim != 2 or not (len(array) and 1 <= array.shape[1] <= MAX_LINKS):
                    needed = f"(m, n) with m >= 1 rows and n = 1 to {MAX_LINKS} joints"
                    raise InputError(f"{place}: shape {array.shape}, allowed: {needed}")
                m, n = array.shape
            if name == "positions" and self.orientations is not None and array.shape[1:] == (3,):
                array = np.pad(array, ((0, 0), (0, 3)))  # the orientations are as measured
            full = [(m, *(n if size == "n" else size for size in shape)) for shape in shapes]
            actual = f"shape {array.shape} for {m} postures of {n} joints"
            require(array.shape in full, f"{place}: {actual}, allowed: {' or '.join(map(str, full))}")
            if not (good := test(array)).all():
                row = int(np.argmin(np.all(good.reshape(m, -1), axis=1)))
                raise InputError(f"{place}: row {row + 1} has {array[row].tolist()!r}, allowed: {allowed}")
            if labels:
                every = dict.fromkeys((*getattr(self, f"{name}_names"), *array.tolist()))
                object.__setattr__(self, f"{name}_names", tuple(every))
            array = array.astype(np.int64) if name == "repeats" else array
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        super().__post_init__()

    def __len__(self) -> int:
        return len(self.postures)

    @property
    def links(self) -> int:
        """n, the number of joints measured."""
        return int(self.postures.shape[1])

    @property
    def dimension(self) -> int:
        """d, the number of coordinates measured of each position."""
        return int(self.positions.shape[1])

    @property
    def optional_columns(self) -> frozenset[str]:
        """Names of the optional fields that the data have: order, sigma and so on, session and marker."""
        return frozenset(name for name in OPTIONAL if getattr(self, name) is not None)

    @property
    def sessions(self) -> tuple[str, ...]:
        """Names of the sessions that rows are of, in the order of their numbers; empty if the data do not name them."""
        present = set() if self.session is None else set(self.session.tolist())
        return tuple(name for name in self.session_names if name in present)

    @property
    def session_rows(self) -> tuple[NDArray[np.int64], ...]:
        """Row numbers of every session; of all rows where the data name none."""
        numbers = self.numbers("session")
        return tuple(np.flatnonzero(numbers == number) for number in np.unique(numbers))

    def numbers(self, name: str) -> NDArray[np.int64]:
        """(m,) number of each row's `session` or `marker` among their names, from 0; 0 where the data name none."""
        if (labels := getattr(self, name)) is None:
            return np.zeros(len(self), dtype=np.int64)
        number = {label: k for k, label in enumerate(getattr(self, f"{name}_names"))}
        return np.array([number[label] for label in labels.tolist()], dtype=np.int64)

    @property
    def _order(self) -> Array:
        """(m,) `order`, that of the rows where there is none."""
        return np.arange(len(self), dtype=float) if self.order is None else self.order

    @property
    def _gaps(self) -> Array:
        """(m,) `gaps`, zero where there are none."""
        return np.zeros(len(self)) if self.gaps is None else self.gaps

    @property
    def sequences(self) -> list[NDArray[np.int64]]:
        """Of each session, and behind each gap in it, the row numbers in the order of measurement."""
        ordered = (rows[np.argsort(self._order[rows], kind="stable")] for rows in self.session_rows)
        return [part for rows in ordered for part in np.split(rows, np.flatnonzero(self._gaps[rows])) if len(part)]

    @property
    def sequence(self) -> NDArray[np.int64]:
        """(m,) row numbers in the order of measurement, one session after another."""
        return np.concatenate(self.sequences)

    @cached_property
    def posture_numbers(self) -> NDArray[np.int64]:
        """(m,) number of each row's posture, 0, 1, ...: rows of one posture share its errors, whatever their marker.

        From the column `posture`; without it, of rows whose angles are linked by differences of up to `SAME_POSTURE`
        and all lie within three of these. Longer chains of links come from a joint that moves on slowly; in such a scan
        only rows of equal angles share a posture.
        """
        if self.repeats is not None:
            return np.unique(self.repeats, return_inverse=True)[1]
        q, numbers = np.unique(in_turns(self.postures), axis=0, return_inverse=True)
        groups = np.arange(len(q))
        if np.any(np.diff(q[:, 0]) <= SAME_POSTURE):  # else no two are near
            from scipy.sparse import coo_array
            from scipy.sparse.csgraph import connected_components
            from scipy.spatial import KDTree

            pairs = KDTree(q).query_pairs(SAME_POSTURE, p=np.inf, output_type="ndarray").T
            linked = coo_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(len(q), len(q)))
            count, linked_groups = connected_components(linked, directed=False)
            low, high = np.full((2, count, self.links), [[[np.inf]], [[-np.inf]]])
            np.minimum.at(low, linked_groups, q)
            np.maximum.at(high, linked_groups, q)
            scanned = np.max(high - low, axis=1)[linked_groups] > 3.0 * SAME_POSTURE
            groups = np.where(scanned, count + groups, linked_groups)
        groups = groups[numbers.ravel()]
        _, first, numbers = np.unique(groups, return_index=True, return_inverse=True)
        return np.argsort(np.argsort(first))[numbers]  # in the order of the rows

    @cached_property
    def repeat_numbers(self) -> NDArray[np.int64]:
        """(m,) equal numbers mark repeats: rows of one posture, marker, session and payload, which noise parts."""
        return repeats_of(self.posture_numbers, self.numbers("marker"), self.numbers("session"), self.payload)

    @cached_property
    def originals(self) -> NDArray[np.int64]:
        """(m,) number of the first row of equal angles, position, orientation and marker, to the last digit: for
        a row that is a copy, in this or another session, not its own number."""
        columns = (self.postures, self.positions, self.numbers("marker"), self.orientations)
        rows = np.column_stack([np.reshape(each, (len(self), -1)) for each in columns if each is not None])
        _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return np.asarray(first[number.ravel()])

    @cached_property
    def conditions(self) -> Conditions:
        """Conditions for the model: time and directions follow, in each session, from the order where not given."""
        order, time = self._order, np.empty(len(self))
        for rows in self.session_rows:  # -0.5 to 0.5 (identification/README.md, "Effects"); 0 if all are equal
            first, length = order[rows].min(), np.ptp(order[rows])
            time[rows] = (order[rows] - first) / length - 0.5 if length > 0.0 else 0.0
        directions = np.nan_to_num(self._directions, nan=0.0)
        temperature = None if self.temperature is None else self.temperature - self.reference_temperature
        session, marker = (self.numbers(name).astype(float) for name in ("session", "marker"))
        return Conditions(self.payload, temperature, time, directions, session, self._past, marker, self.orientations)

    @property
    def reference_temperature(self) -> float:
        """[deg C] that temperatures count from."""
        mean = 0.0 if self.temperature is None else float(np.mean(self.temperature))
        return mean if self.reference is None else self.reference

    @cached_property
    def _directions(self) -> Array:
        """(m, n) +1 or -1, NaN: unknown, as behind a gap until the joint moves."""
        if self.directions is not None:
            return self.directions
        directions = np.empty(self.postures.shape)
        for rows in self.sequences:
            directions[rows] = directions_from_order(self.postures[rows], np.nan if self._gaps[rows[0]] else 1.0)
        return directions

    @cached_property
    def _past(self) -> Array:
        """(m, n, 12) see `past_from_order`; what was before a gap is unknown."""
        if self.past is not None:
            return self.past
        past = np.empty((*self.postures.shape, REMEMBERED))
        for rows in self.sequences:
            past[rows] = past_from_order(self.postures[rows])
        return past

    @property
    def origin(self) -> dict[str, Any]:
        """What a calibration keeps of its data beside `kinematics.joint_range`: file and hash, number of rows and their
        digests, temperature that theirs count from [deg C]."""
        kept = {
            **self.provenance,
            "rows": len(self),
            ROW_DIGESTS: digests_text(row_digests(self.postures, self.positions)),
        }
        return kept if self.temperature is None else {**kept, "mean_temperature_C": self.reference_temperature}

    def shared_rows(self, text: str) -> tuple[float, float]:
        """Estimated from the digests of a calibration's rows: the share of these rows that are among those, and the
        share of those that are among these."""
        kept, digests = digests_in(text), row_digests(self.postures, self.positions)
        if len(kept) >= KEPT:  # of these rows alone it can be told
            digests = {digest for digest in digests if digest <= max(kept)}
        shared = len(digests & kept)
        return shared / max(len(digests), 1), shared / max(len(kept), 1)

    def share_fitted(self, provenance: Mapping[str, Any]) -> float:
        """Share of the rows that are among those that a calibration of this provenance, or what it holds, was fitted
        to, in whatever file; of an earlier version, which does not say which these are, all of its file."""
        if isinstance(text := provenance.get(ROW_DIGESTS), str):
            return self.shared_rows(text)[0]
        ours, theirs = ({*np.atleast_1d(one.get("sha256", [])).tolist()} for one in (provenance, self.provenance))
        return float(not ours.isdisjoint(theirs))

    def rows(self, index: Any) -> Self:
        """Some of the rows (any numpy index), as a session of their own. Directions and the past stay what they were
        among all rows; session time and mean temperature are the subset's."""
        return replace(self, directions=self._directions, past=self._past)._picked(index)

    def without_copies(self) -> Self:
        """The rows without exact copies of others, as if they had not been listed again."""
        once = self._picked(np.unique(self.originals))
        return replace(once, session_names=once.sessions)

    def of_sessions(self, measurements: Measurements) -> Measurements:
        """A hold-out with the sessions numbered as in its data; raises `InputError` for one that these lack."""
        if len(names := measurements.session_names) < 2:
            return replace(self, session=None, session_names=())
        for name in self.sessions or ("",):
            which = f"session {name!r}" if name else "no column session"
            allowed = f"{', '.join(names)}, as in the data; or armcal validate"
            require(name in names, f"holdout: found {which}, allowed: {allowed}")
        return replace(self, session_names=names)

    def _picked(self, index: Any) -> Self:
        columns = [name for name in (*VALUES, "past") if getattr(self, name) is not None]
        return replace(self, **{name: getattr(self, name)[index] for name in columns})


# -- several sessions --------------------------------------------------------------------------------------------------
def pooled_sessions(tables: Mapping[str, Measurements]) -> Measurements:
    """Sessions by name as one table; a table that names sessions of its own keeps them, its name before theirs. Columns
    that not every table has are left out, with a warning. Raises `InputError` for tables of different arms."""
    parts = []
    for name, table in tables.items():
        several = table.sessions if len(table.sessions) > 1 else ()
        labels = [f"{name}/{session}" for session in table.session] if several else np.full(len(table), name)  # type: ignore[union-attr]
        parts.append(replace(table, session=np.array(labels), session_names=()))
    if len({part.dimension for part in parts}) > 1 and {part.dimension for part in parts} <= {3, 6}:
        parts = [replace(part, positions=part.positions[:, POINT], orientations=None) for part in parts]
        warnings.warn("not in all of the data, and left out: orientations", UserWarning, stacklevel=2)
    first = parts[0]
    for name, part in zip(tables, parts, strict=True):
        if (part.links, part.dimension) != (first.links, first.dimension):
            counted = f"found {part.links} joints and {part.dimension} coordinates"
            raise InputError(f"{name}: {counted}, allowed: {first.links} and {first.dimension} as in the other data")
    following = {"order": "_order", "directions": "_directions", "gaps": "_gaps", "repeats": "posture_numbers"}
    for name, source in following.items():  # of tables without them they follow from the rows
        if any(getattr(part, name) is not None for part in parts):
            parts = [replace(part, **{name: getattr(part, source)}) for part in parts]
    columns_of_all = frozenset.intersection(*(part.optional_columns for part in parts))
    if missing := sorted(frozenset.union(*(part.optional_columns for part in parts)) - columns_of_all):
        warnings.warn(f"not in all of the data, and left out: {', '.join(missing)}", UserWarning, stacklevel=2)
    columns = {name: [getattr(part, name) for part in parts] for name in ("postures", "positions", *columns_of_all)}
    if "repeats" in columns:  # such that no two tables share a number
        ends = np.cumsum([0, *map(len, parts)])
        columns["repeats"] = [numbers + end for numbers, end in zip(columns["repeats"], ends, strict=False)]
    joined: dict[str, Any] = {name: np.concatenate(values) for name, values in columns.items()}
    origins = {key: [str(p.provenance[key]) for p in parts if key in p.provenance] for key in ("file", "sha256")}
    provenance: dict[str, Any] = {"file": ", ".join(origins["file"])} if origins["file"] else {}
    provenance |= {"sha256": origins["sha256"]} if origins["sha256"] else {}
    return Measurements(**joined, provenance=provenance)


# -- which rows --------------------------------------------------------------------------------------------------------
ROW_DIGESTS = "digests_of_rows"  # key of a calibration's provenance
KEPT = 2000  # digests: of 12,000 rows one in six, so that 30 of them are missed once in 240 times; 16 kB of text
MOST = 0.5  # convention: share of rows from which they are the same; coarse readings of postures may agree by chance
BYTES = 6  # of a digest: two of a million rows share one with a probability of 0.002 for each of a thousand others


def row_digests(postures: Array, positions: Array) -> set[bytes]:
    """Of postures (m, n) [rad, mm] and positions (m, d) [mm] to the nearest 1e-3 rad or mm: those written with three
    digits are still the same; what lies half way goes up, whatever its last bits are."""
    whole = np.floor(np.column_stack([postures, positions]) / 1e-3 + (0.5 + 1e-6)).astype("<i8")
    return {blake2b(row.tobytes(), digest_size=BYTES).digest() for row in whole}


def digests_text(digests: set[bytes]) -> str:
    """The first of the digests in ascending order, in base 64."""
    return b64encode(b"".join(sorted(digests)[:KEPT])).decode()


def digests_in(text: str) -> set[bytes]:
    """Those of `digests_text`; none of a text that no program wrote."""
    try:
        joined = b64decode(text, validate=True)
    except ValueError:
        return set()
    return {joined[k : k + BYTES] for k in range(0, len(joined) - BYTES + 1, BYTES)}
