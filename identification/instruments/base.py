"""What an instrument is to the rest of the program: one class, which says all that depends on the kind of instrument.

The frame of an instrument is chosen such that readings are simplest in it: its origin is the center of measured
distances, or its z axis the normal of a plane that is touched. What nobody knows of center or plane is then where the
base of the arm stands in that frame, as with a tracker.

Where the arm stands and where its tool is, from nothing, is the start of a fit that needs no guess:

    y_i = B (p_i + R_i t) + b,    B, b: pose of the base for the instrument;  t: measured point in the tip's frame

Positions are a closed form (`Tracker`): for a given t the best base is a rigid registration of two clouds of points
(Kabsch 1976, Arun 1987), for a given base the best t a mean; taken in turns the sum of squares falls to a minimum. Any
other reading is searched (`Instrument.searched`): least squares from many starts at once; the start that ends with the
least squares wins. Starts are random bases, or what the instrument makes of each t: those of t lie around the tip.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.frames import Frame, from_angles, from_quaternions, nearest_rotation, pose, to_angles
from identification.kinematics.parameters import AXES, Parameter, error_names
from identification.levenberg_marquardt import Index, levenberg_marquardt
from identification.vectorized import Evaluate, vectorize

OWN = "identification.instruments"


class Coordinate(NamedTuple):
    """A number of a reading and its column in files, `distance_mm` of a length named distance."""

    name: str
    quantity: str = "length"  # [mm], or `pixel`
    positive: bool = False  # whether it must be


class OwnValue(NamedTuple):
    """A row of the corrected values that an instrument adds."""

    name: str  # in words
    parameter: str | None  # that it is, None: it is made of several
    value: float
    slopes: Mapping[str, float]  # parameter name -> derivative [unit per API unit]
    unit: str
    convention: str  # what it is


class Placement(NamedTuple):
    """base : (4, 4) pose of the base [mm];  tool : (3,) place of the measured point [mm];  rms : what is left [mm]."""

    base: Array
    tool: Array
    rms: float


class Unplaced(NamedTuple):
    """Rows of which base and measured point are to be found.

    frames : (m, 4, 4) nominal poses of the tip in the base;  readings : (m, d) of one target
    reach : [mm] that gives the starts their size;  base, tool : (4, 4) and (3,), known; None: to be found
    hopeless : root mean square residual; where more must be left the search may end early, and say about how much
    near : (3,) where an unknown tool may be, from where the search starts as well
    """

    frames: Array
    readings: Array
    reach: float
    base: Array | None = None
    tool: Array | None = None
    hopeless: float = np.inf
    near: Array = np.zeros(3)

    @property
    def tools(self) -> Array:
        """(s, 3) places [mm] from which the measured point is looked for: that known, or 27 in a cube and one near."""
        if self.tool is not None:
            return self.tool[None]
        cube = np.array(sorted(product((1.0, 0.0, -1.0), repeat=3), key=np.count_nonzero)) * 0.1 * self.reach
        return np.concatenate([cube, self.near[None]])

    @property
    def points(self) -> Array:
        """(s, m, 3) measured points in the base for these tools."""
        return self.frames[:, :3, 3] + np.tensordot(self.tools, self.frames[:, :3, :3], (1, 2))


@dataclass(frozen=True)
class Instrument:
    """An instrument whose reading is a function of the position of the measured point; a new one is one class.

    Each coordinate of a reading has the same standard deviation, `sigma` of the arm. Subclasses are frozen dataclasses,
    whose fields (numbers or tuples of them) describe the instrument.
    """

    kind: ClassVar[str] = ""  # the word in arm files; empty: these need none
    axes: ClassVar[str] = AXES  # of the points that it reads: `xyz`, or `xy` of planar arms
    keys: ClassVar[frozenset[str]] = frozenset()  # of `[instrument]` that it has, besides `kind`
    coordinates: ClassVar[tuple[Coordinate, ...]] = ()  # of a reading; none: a target is touched (`contact`)
    target: ClassVar[str] = ""  # column of files that names what is touched, each with a place of its own
    # word of the `parameters` of what is touched or measured from, `cup` of `cup[A].x`, where these stand in the frame
    # of the base, other ones in each session, and rows name them as they name measured points (`Measurements.marker`);
    # empty: they count as sessions, each of which has a base
    own_targets: ClassVar[str] = ""
    meaning: ClassVar[str] = ""  # of its `own_targets`, in the table of corrected values
    offers: ClassVar[frozenset[str]] = frozenset()  # what effects may need of it (`Effect.needs`)
    reads_positions: ClassVar[bool] = False  # a reading is the measured point's position, or with its orientation pose
    angle_scale: ClassVar[float | None] = None  # [mm/rad] a radian of a measured orientation counts as; None: of none
    # what reads so of an arm twice as large, "": nothing does; and what would tell the size better
    size_is_open: ClassVar[Any] = ("", "")

    # -- what a row reads ------------------------------------------------------------------------------------------
    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        """(d,) what it reads of a point (3,) [mm] in its frame;  values : of its own `parameters`;  target : (2,) the
        numbers, from 0, of the row's session and of what it touches, of those with `own_targets`"""
        raise NotImplementedError

    def readings(self, points: Array, values: Array) -> Array:
        """(..., d) what it reads of points (..., 3) in its frame with values (k,) of its own parameters."""
        point, parameters = ca.SX.sym("point", len(self.axes)), ca.SX.sym("parameters", len(self.parameters))
        reading = ca.densify(ca.SX(self.reading(point, parameters, ca.SX.zeros(2))))
        return vectorize(ca.Function("reading", [point, parameters], [reading]))(points, values)[0][..., 0]

    @property
    def dimension(self) -> int:
        """d, numbers of a reading; 1 of a contact: the length that it stands for."""
        return max(len(self.coordinates), 1)

    # whether it reads nothing but the joints: the reading of what is touched is zero
    contact = property(lambda self: not self.coordinates)

    # -- what it does not show, and what is to be found besides the arm --------------------------------------------
    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its own, which are estimated with those of the arm."""
        return ()

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        """Rows of the corrected values at values of its own parameters."""
        for p in self.parameters:
            value = values.get(p.name, p.neutral) * p.to_file
            yield OwnValue(p.name, p.name, value, {p.name: p.to_file}, p.file_unit, self.kind)

    def released(self) -> tuple[Self, dict[str, float]]:
        """Without what is known of its `own_values`, and that: name -> value."""
        return self, {}

    def hidden(self, base: Array) -> frozenset[str]:
        """Names of parameters on which no reading depends: those that move arm and instrument together, or turn the
        frame of the instrument about what it reads;  base : (4, 4) about where that stands in the frame"""
        return frozenset()

    @property
    def places(self) -> bool:
        """Whether its readings say where the arm stands in its frame; else positions are asked for in the base's."""
        return not self.hidden(np.eye(4))

    def between(self, first: Array, base: Array) -> tuple[dict[str, float], frozenset[str]]:
        """What brings a base (4, 4) to where it stands in a later session, `x y z wx wy wz` [mm, rad] (`session_base`):
        a shift along the axes of the instrument and rotations about its own; and those on which no reading depends."""
        shift, turn = base[:3, 3] - first[:3, 3], to_angles(first[:3, :3].T @ base[:3, :3])
        movement = dict(zip(["x", "y", "z", "wx", "wy", "wz"], [*shift.tolist(), *turn.tolist()], strict=True))
        return movement, frozenset(name.partition(".")[2].replace("r", "w") for name in self.hidden(base))

    # -- where a fit starts ----------------------------------------------------------------------------------------
    def place(self, rows: Unplaced) -> Placement:
        """Base and measured point that explain readings best, from nothing."""
        # bases turned anyhow, within three times the reach along each axis
        generator, bases = np.random.default_rng(0), np.tile(np.eye(4), (3000, 1, 1))  # effort
        bases[:, :3, :3] = from_quaternions(generator.standard_normal((len(bases), 4)))
        bases[:, :3, 3] = 3.0 * rows.reach * generator.uniform(-1.0, 1.0, (len(bases), 3))
        return self.searched(rows, bases)

    def place_each(self, rows: Unplaced) -> list[Placement]:
        """The same for each of k sets of rows, with frames (k, m, 4, 4) and readings (k, m, d)."""
        return [self.place(rows._replace(frames=f, readings=y)) for f, y in zip(*rows[:2], strict=True)]

    def searched(self, rows: Unplaced, bases: Array) -> Placement:
        """Base and measured point that explain readings best, of the base what they depend on, from bases (s, 4, 4)
        with the tools of the rows in turns; of a base that is known none is needed."""
        if rows.base is not None:
            bases = np.broadcast_to(rows.base, (len(rows.tools), 4, 4))
        starts = np.concatenate([bases[:, :3].reshape(-1, 12), np.resize(rows.tools, (len(bases), 3))], axis=1)
        hidden = self.hidden(np.eye(4)) if rows.base is None else error_names("base")
        free = np.array([name not in hidden for name in error_names("base")] + [rows.tool is None] * 3)
        unknown, moves = np.eye(9)[free], np.array([1.0, rows.reach, 1.0]).repeat(3)[free]
        evaluate, changes = _reading(self), np.zeros((len(starts), len(unknown)))

        def followed(chosen: Index, part: slice, steps: int) -> Array:
            """(k,) root mean squares that part of the rows leave after at most so many steps from the starts of these
            numbers, of which `changes` keeps where they led."""
            frames, readings = rows.frames[part, :3].reshape(-1, 12), rows.readings[part]

            def linearize(change: Array, index: Index) -> tuple[Array, Array]:
                with np.errstate(all="ignore"):  # of places that no instrument reads
                    read, slopes = evaluate(starts[chosen[index], None], frames, (change @ unknown)[:, None])
                residuals = (readings - read[..., 0]).reshape(len(index), -1)
                return residuals, (slopes @ unknown.T).reshape(*residuals.shape, -1)

            rounding = np.full(len(chosen), 1e-12 * rows.reach * np.sqrt(len(frames)))  # of lengths 1e-12 reaches
            settings: dict[str, Any] = {"scales": moves, "rounding": rounding, "iterations": steps}
            solution = levenberg_marquardt(linearize, changes[chosen], **settings)
            changes[chosen] = solution.parameters
            return np.sqrt(np.nan_to_num(solution.rss, nan=np.inf) / len(frames))

        # effort: of many starts 100 are followed with some 30 rows, which tell good ones: three times the nine unknowns
        # and more. Of starts that the readings were fitted with, the best of 99 of 100 wrong readings leaves after 2
        # steps at most 1.3 times what its end leaves
        whole, sample = slice(None), slice(None, None, max(len(rows.frames) // 30, 1))
        stages = [(sample, 0, 100), (sample, 15, 5)] if len(starts) > 100 else []
        chosen = np.arange(len(starts))
        # of few rows, which mislead, every start is followed to its end
        for part, steps, count in (*stages, (whole, 2, max(5, 1000 // len(rows.frames))), (whole, 60, 1)):
            left = followed(chosen, part, steps)
            chosen = chosen[np.argsort(left, kind="stable")[:count]]
            if part is whole and np.min(left) > rows.hopeless:
                break
        start, change = starts[chosen[0]], changes[chosen[0]] @ unknown
        base = pose(start[3:12:4] + change[:3], from_angles(change[3:6]) @ start[:12].reshape(3, 4)[:, :3])
        return Placement(base, start[12:] + change[6:], float(np.min(left)))

    def without_targets(self) -> Self:
        """With places of none of its `own_targets`."""
        return self

    @property
    def targets(self) -> Mapping[str, Array]:
        """Name -> (3,) about where these are; empty: not known."""
        return {}

    # -- files -----------------------------------------------------------------------------------------------------
    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Self:
        """Of a table `[instrument]`."""
        return cls()


@lru_cache(maxsize=32)
def _reading(instrument: Instrument) -> Evaluate:
    """Of arrays (start, frame, change): the reading (d) and its derivative (d, 9) by the change.

    start : (15) base, by rows, and tool;  frame : (12) of the tip, by rows
    change : (9) of these: shift, angles about the axes of the instrument, and shift of the tool
    """
    start, tip, change = (ca.SX.sym(name, size) for name, size in (("start", 15), ("tip", 12), ("change", 9)))
    base, frame = (ca.reshape(each[:12], 4, 3).T for each in (start, tip))
    arm = ca.mtimes(base[:, :3], ca.mtimes(frame[:, :3], start[12:] + change[6:]) + frame[:, 3])
    turned = Frame.world().shifted(base[:, 3] + change[:3]).turned_about(range(3), change[3:6])
    point = turned.point(arm)[: len(instrument.axes)]
    values = ca.DM([parameter.neutral for parameter in instrument.parameters])
    reading = ca.densify(ca.SX(instrument.reading(point, ca.SX(values), ca.SX.zeros(2))))
    outputs = [reading, ca.densify(ca.jacobian(reading, change))]
    return vectorize(ca.Function("reading", [start, tip, change], ca.cse(outputs)))


@dataclass(frozen=True)
class AtTargets(Instrument):
    """An instrument whose targets stand in the frame of the base, where they are parameters, `cup[A].x`.

    at : names and places (d,) [mm] in the frame of the base, about, where fits start; empty: not known yet
    numbers : of session and target in the rows that touch each, from 0; empty: of one session, in order
    """

    at: tuple[tuple[str, tuple[float, ...]], ...] = ()
    numbers: tuple[tuple[int, int], ...] = field(default=(), kw_only=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{self.own_targets}[{name}].{axis}", "mm", kind="base", start=start)
            for name, place in self.at
            for axis, start in zip(self.axes, place, strict=True)
        )

    @property
    def targets(self) -> dict[str, Array]:
        return {name: np.array(place) for name, place in self.at}

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        for value in super().own_values(values):
            target = value.name.removeprefix(f"{self.own_targets}[").replace("]", "").replace(".", " ")
            yield value._replace(name=f"{self.own_targets} {target}", convention=self.meaning)

    def of_row(self, each: Sequence[ca.SX], target: ca.SX, otherwise: ca.SX) -> ca.SX:
        """What belongs to the target of these numbers, of one for each target."""
        for (session, number), one in zip(self.numbers or [(0, k) for k in range(len(each))], each, strict=True):
            otherwise = ca.if_else(ca.logic_and(target[0] == session, target[1] == number), one, otherwise)
        return otherwise

    def without_targets(self) -> Self:
        return replace(self, at=(), numbers=())

    def with_targets(self, points: Array, readings: Array, numbers: Index, names: Sequence[Sequence[str]]) -> Self:
        """With `own_targets` where rows find them

        points, readings : (m, d) measured points in its frame, as best known, and (m, d) what was read
        numbers : (m, 2) of session and target of each row, by their `names`
        """
        at, touched = [], np.unique(numbers, axis=0).tolist()
        for pair in touched:
            rows = np.all(numbers == pair, axis=1)
            name = "/".join(labels[k] for labels, k in zip(names, pair, strict=True) if labels) or "1"
            at.append((name, tuple(self.target_of(points[rows], readings[rows]).tolist())))
        return replace(self, at=tuple(at), numbers=tuple(map(tuple, touched)))

    def target_of(self, points: Array, readings: Array) -> Array:
        """(d,) of one target where these rows find it;  points, readings : as of `with_targets`"""
        raise NotImplementedError


KINDS: dict[str, dict[str, type[Instrument]]] = {"xyz": {}, "xy": {}}  # axes of an arm -> word of its files -> class


def register_instrument(cls: type[Instrument]) -> type[Instrument]:
    """Class decorator that makes an instrument known to files of arms with its `axes` under its `kind`; a user's own
    class may be defined again, as in notebooks. Raises `InputError` for a word that is taken."""
    of_axes = KINDS[cls.axes]
    taken = of_axes.get(cls.kind)
    if taken is not None and taken.__module__.startswith(OWN) and not cls.__module__.startswith(OWN):
        raise InputError(f"instrument: the kind {cls.kind!r} is taken, allowed: another word")
    of_axes[cls.kind] = cls
    return cls


# -- positions ---------------------------------------------------------------------------------------------------------
def registered(points: Array, measured: Array) -> Array:
    """(..., 4, 4) pose that brings points (..., m, 3) closest to the measured ones (..., m, d) in least squares; in the
    plane, d = 2, it is a turn about z."""
    d = measured.shape[-1]
    center, target = (each.mean(axis=-2, keepdims=True) for each in (points[..., :d], measured))
    frame = np.zeros((*measured.shape[:-2], 4, 4)) + np.eye(4)
    frame[..., :d, :d] = nearest_rotation((measured - target).mT @ (points[..., :d] - center))
    frame[..., :d, 3] = (target - center @ frame[..., :d, :d].mT)[..., 0, :]
    return frame
