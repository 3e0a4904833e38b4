"""What an instrument is to the rest of the program: one class, which says all that depends on the kind of instrument.

The frame of an instrument is chosen such that readings are simplest in it: its origin is the center of measured
distances, or its z axis the normal of a plane that is touched. What nobody knows of center or plane is then where the
base of the arm stands in that frame, as with a tracker.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.instruments.search import Placement, Unplaced, placed, searched
from identification.kinematics.frames import from_quaternions, to_angles
from identification.kinematics.parameters import AXES, Parameter
from identification.vectorized import vectorize

PLACE = "base"  # kind of a parameter that says where something stands, as that of the base
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


@dataclass(frozen=True)
class Instrument:
    """An instrument that reads a function of where the measured point is; a new one is one class.

    Each coordinate of a reading has the same standard deviation, `sigma` of the arm. Subclasses are frozen dataclasses,
    whose fields, numbers or tuples of them, are what is known of the instrument.
    """

    kind: ClassVar[str] = ""  # the word in arm files; empty: these need none
    axes: ClassVar[str] = AXES  # of the points that it reads: `xyz`, or `xy` of planar arms
    keys: ClassVar[frozenset[str]] = frozenset()  # of `[instrument]` that it has, besides `kind`
    coordinates: ClassVar[tuple[Coordinate, ...]] = ()  # of a reading; none: a target is touched (`contact`)
    target: ClassVar[str] = ""  # column of files that names what is touched, each with a place of its own
    # word of the `parameters` of what is touched or measured from, `cup` of `cup[A].x`, where these stand in the frame
    # of the base and rows name them as they name measured points (`Measurements.marker`); empty: they count as
    # sessions, each of which has a base
    own_targets: ClassVar[str] = ""
    offers: ClassVar[frozenset[str]] = frozenset()  # what effects may need of it (`Effect.needs`)
    reads_positions: ClassVar[bool] = False  # a reading is the measured point's position, or with its orientation pose
    size_is_open: ClassVar[Any] = ("", "")  # what reads so of an arm twice as large, and what to do about it

    # -- what a row reads ------------------------------------------------------------------------------------------
    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        """(d,) what it reads of a point (3,) [mm] in its frame.

        values : of its own `parameters`;  target : number of what the row touches, from 0, of those with `own_targets`
        """
        raise NotImplementedError

    def readings(self, points: Array, values: Array) -> Array:
        """(..., d) what it reads of points (..., 3) in its frame with values (k,) of its own parameters."""
        point, parameters = ca.SX.sym("point", len(self.axes)), ca.SX.sym("parameters", len(self.parameters))
        reading = ca.densify(ca.SX(self.reading(point, parameters, ca.SX(0))))
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
        return searched(self, rows, bases)

    def with_targets(
        self, points: Array, readings: Array, numbers: NDArray[np.int64], names: Sequence[str]
    ) -> Instrument:
        """With `own_targets` where rows find them.

        points, readings : (m, 3 or 2) measured points in its frame, as best known, and (m, d) what was read
        numbers : (m,) of the targets, by their `names`
        """
        return self

    @property
    def unplaced(self) -> Instrument:
        """The same before anything is known of where it stands."""
        return self

    @property
    def targets(self) -> Mapping[str, Array]:
        """Name -> (3,) about where these are; empty: not known."""
        return {}

    # -- files -----------------------------------------------------------------------------------------------------
    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Instrument:
        """Of a table `[instrument]`."""
        return cls()


@dataclass(frozen=True)
class Tracker(Instrument):
    """A laser tracker, a camera system, a coordinate measuring machine: positions of one or several reflectors in the
    frame of the instrument, in the plane the first two coordinates, or the pose of a measured frame."""

    coordinates = tuple(Coordinate(axis) for axis in AXES)
    reads_positions = True

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point

    def place(self, rows: Unplaced) -> Placement:
        return placed(rows)


TRACKER = Tracker()


@dataclass(frozen=True)
class AtTargets(Instrument):
    """An instrument whose targets stand in the frame of the base, where they are parameters, `cup[A].x`.

    at : names and places (d,) [mm] in the frame of the base, about, where fits start; empty: not known yet
    numbers : of the targets, by which rows name them, from 0; empty: in order
    """

    at: tuple[tuple[str, tuple[float, ...]], ...] = ()
    numbers: tuple[int, ...] = field(default=(), kw_only=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{self.own_targets}[{name}].{axis}", "mm", kind=PLACE, start=start)
            for name, place in self.at
            for axis, start in zip(self.axes, place, strict=True)
        )

    @property
    def targets(self) -> dict[str, Array]:
        return {name: np.array(place) for name, place in self.at}

    @property
    def unplaced(self) -> Self:
        return replace(self, at=(), numbers=())

    def of_row(self, each: Sequence[ca.SX], target: ca.SX, otherwise: ca.SX) -> ca.SX:
        """What belongs to the target of this number, of one for each target."""
        for number, one in zip(self.numbers or range(len(self.at)), each, strict=True):
            otherwise = ca.if_else(target == number, one, otherwise)
        return otherwise

    def with_targets(self, points: Array, readings: Array, numbers: NDArray[np.int64], names: Sequence[str]) -> Self:
        at, measured = [], np.unique(numbers).tolist()
        for number in measured:
            rows = numbers == number
            at.append((names[number], tuple(self.target_of(points[rows], readings[rows]).tolist())))
        return replace(self, at=tuple(at), numbers=tuple(measured))

    def target_of(self, points: Array, readings: Array) -> Array:
        """(d,) of one target where these rows find it;  points, readings : as of `with_targets`"""
        raise NotImplementedError


KINDS: dict[str, dict[str, type[Instrument]]] = {"xyz": {}, "xy": {}}  # axes of an arm -> word of its files -> class


def register_instrument(cls: type[Instrument]) -> type[Instrument]:
    """Class decorator that makes an instrument known to files of arms with its `axes` under its `kind`.

    A user's own class may be defined again, as in notebooks. Raises `InputError` for a word that is taken.
    """
    of_axes = KINDS[cls.axes]
    taken = of_axes.get(cls.kind)
    if taken is not None and taken.__module__.startswith(OWN) and not cls.__module__.startswith(OWN):
        raise InputError(f"instrument: the kind {cls.kind!r} is taken, allowed: another word")
    in_order = sorted({**of_axes, cls.kind: cls}.items())
    of_axes.clear()
    of_axes.update(in_order)
    return cls
