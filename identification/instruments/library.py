"""The instruments: a tracker, distances from a center in space and in the plane, a probe on balls and planes, cups.

    |p_i + R_i t - c| = d_i,    n . (p_i + R_i t) - h = z_i

For a given measured point t the sphere about c is linear in c and |c|^2 (algebraic fit), and the plane in n and h
(total least squares): these are the starts of the search for both (identification/instruments/search.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, product
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.information import RANK_TOLERANCE
from identification.instruments.base import PLACE, Coordinate, Guide, Instrument, OwnValue, register_instrument
from identification.instruments.search import Placement, Unplaced, placed, searched
from identification.kinematics.frames import from_angles, pose, rotation_about
from identification.kinematics.parameters import AXES, JOINT_OFFSET, Parameter, error_names
from identification.workspace import circle_across

TOUCHES = 1e-6  # [mm] by which these are kept
DISTINCT = 1e-6  # share of the largest derivative below which a distance says nothing new


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


def distance_to_center(point: ca.SX) -> ca.SX:
    """[mm] of a point (3,) from the origin."""
    return ca.sqrt(ca.sumsqr(point) + 1e-9**2)  # a point this near [mm] has no direction from there


@register_instrument
@dataclass(frozen=True)
class Distance(Instrument):
    """Its frame has the origin at the center; how that frame is turned no distance shows."""

    kind = "distance"
    keys = frozenset({"center_mm"})
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Coordinate("distance", positive=True),)
    offers = frozenset({"distance"})
    guide = Guide(
        about="a ball bar, a draw wire, a laser distance: how far the measured point is from a fixed center",
        table='kind = "distance"\n'
        "center_mm = [700.0, 0.0, 300.0]  # EXAMPLE: about where the center is, in the frame of the base: plans are "
        "made for it",
        reads="distance",
        stands="center",
    )

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return distance_to_center(point)

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset(error_names(PLACE)[3:])

    def place(self, rows: Unplaced) -> Placement:
        """From algebraic fits of lengths d, |a|^2 - d^2 = 2 a . c - (|c|^2), about the mean of the points; what the
        lengths leave open of the base is along the arm's own axes."""
        points, bases = rows.points, np.tile(np.eye(4), (len(rows.tools), 1, 1))
        middle = points.mean(axis=1, keepdims=True)
        around = (points - middle) / rows.reach
        columns = np.concatenate([2.0 * around, np.ones((*around.shape[:2], 1))], axis=2)
        goals = np.sum(around**2, axis=2) - (rows.readings[:, 0] / rows.reach) ** 2
        solved = (np.linalg.pinv(columns, rcond=RANK_TOLERANCE) @ goals[..., None])[..., 0]
        bases[:, :3, 3] = -middle[:, 0] - rows.reach * solved[:, :3]
        return searched(self, rows, bases)


@register_instrument
@dataclass(frozen=True)
class Sphere(Distance):
    """A touch probe on a ball, wherever that stands. Its frame has the origin at the center of the ball.

    radius : [mm] of ball and stylus tip together
    """

    kind = "sphere"
    keys = frozenset({"center_mm", "radius_mm"})
    coordinates = ()
    target = "surface"
    offers = frozenset()
    guide = Guide(
        about="a touch probe: the measured point is on a ball, wherever that stands",
        table='kind = "sphere"\nradius_mm = 15.0  # EXAMPLE: of the ball and of the stylus\' tip, together',
        reads="touch",
        stands="ball",
        labels="ball that is touched, a new one wherever it is moved",
        touches="a ball in two places or more",
    )

    radius: float

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        """The height above the surface."""
        return distance_to_center(point) - self.radius

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Sphere:
        if "radius_mm" not in table:
            raise InputError("instrument.radius_mm: is missing, allowed: of ball and stylus tip together [mm]")
        return cls(table["radius_mm"])


@register_instrument
@dataclass(frozen=True)
class Plane(Instrument):
    """A touch probe on planes: the measured point is on a plane, or always off it by the same.

    The z axis of its frame is the normal of the plane: read is the height above; shifts along the plane and turns about
    its normal no contact shows.
    """

    kind = "plane"
    keys = frozenset({"center_mm", "normal"})
    target = "surface"
    size_is_open = "contacts with planes", "only [machining] tells"
    guide = Guide(
        about="a touch probe: the measured point is on a plane, wherever that lies",
        table='kind = "plane"',
        reads="touch",
        stands="plane",
        labels="plane that is touched",
        touches="three planes or more\nthat lean differently",
    )

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point[2]

    def hidden(self, base: Array) -> frozenset[str]:
        """The turn about that axis of the base that is nearest to the normal stands for the turn about the normal."""
        return frozenset({"base.x", "base.y", error_names(PLACE)[3 + int(np.argmax(np.abs(base[2, :3])))]})

    def between(self, first: Array, base: Array) -> tuple[dict[str, float], frozenset[str]]:
        """A plane does not show how the base is turned about the normal: of such turns that is taken which lets two of
        the three rotations, without that about the axis held, tilt the normal best where they tilt it least."""
        best, choice, steps = -1.0, (dict[str, float](), frozenset[str]()), 1e-5 * np.eye(3)  # [rad]
        for angle, held in product(np.arange(0.0, np.pi, np.pi / 6.0), range(3)):
            spun = pose(rotation=rotation_about([0.0, 0.0, 1.0], angle)) @ base
            movement = super().between(first, spun)[0]
            turn = np.array([movement[f"w{axis}"] for axis in AXES])
            ends = [[first[2, :3] @ from_angles(turn + s * steps[k]) for s in (1, -1)] for k in {0, 1, 2} - {held}]
            tilt = float(np.linalg.svd([(up - down) / 2e-5 for up, down in ends], compute_uv=False)[-1])
            if tilt > best:
                best, choice = tilt, (movement, frozenset({"x", "y", f"w{AXES[held]}"}))
        return choice

    def place(self, rows: Unplaced) -> Placement:
        """Its z axis the normal, its origin in the middle of the points, its x axis near one of the arm's."""
        bases = []
        for points in rows.points:
            about = points - points.mean(axis=0)
            normal = np.linalg.eigh(about.T @ about)[1][:, 0]  # of the least scatter; of few points any
            bases.append(_standing_above(points, normal, normal @ points.mean(axis=0)))
        best = searched(self, rows, np.array(bases))
        if rows.base is not None:
            return best
        (points,) = rows._replace(tool=best.tool).points
        return best._replace(base=_standing_above(points, best.base[2, :3], -best.base[2, 3]))


def _standing_above(points: Array, normal: Array, height: float) -> Array:
    """(4, 4) base, in the frame of a plane, of an arm above it;  points : (m, 3) in the frame of the base"""
    if height > 0.0:
        normal, height = -normal, -height
    one, other = circle_across(normal)
    axes = np.array([-other, one, normal])
    middle = axes @ points.mean(axis=0)
    return pose([-middle[0], -middle[1], -height], axes)


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


@register_instrument
@dataclass(frozen=True)
class PlanarDistance(AtTargets):
    """A ball bar or a draw wire beside a planar arm: how far the tip is from a fixed center in the plane.

    The frame is that of the base, and the centers, one for each session, are parameters in it. A turn of arm and
    centers together no distance shows: the offset of joint 1 is not estimated.
    """

    kind = "distance"
    axes = "xy"
    keys = frozenset({"center_mm"})
    coordinates = Distance.coordinates
    own_targets = "center"

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        centers = [values[2 * k : 2 * k + 2] for k in range(len(self.at))] or [ca.SX.zeros(2)]
        return distance_to_center(point - self.of_row(centers[: len(self.at)], target, centers[0]))

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        for value in super().own_values(values):
            name = f"center {value.name.removeprefix('center[').replace(']', '').replace('.', ' ')}"
            yield value._replace(name=name, convention="of the distances, in the frame of the base")

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset({f"{JOINT_OFFSET}:1"})

    def place(self, rows: Unplaced) -> Placement:
        """The center alone is to be found, and is the origin of the base that is found."""
        return Distance().place(rows._replace(base=None, tool=np.zeros(3)))

    def target_of(self, points: Array, readings: Array) -> Array:
        """The center that explains the distances best."""
        frames = np.array([pose((*point, 0.0)) for point in points])
        return -self.place(Unplaced(frames, readings, float(np.abs(points).max()))).base[:2, 3]

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> PlanarDistance:
        center = table.get("center_mm")
        return cls() if center is None else cls((("1", tuple(map(float, center))),))


@register_instrument
@dataclass(frozen=True)
class Socket(AtTargets):
    """A ball at the tool that is seated in fixed cups, each in several orientations: nothing is read but the joints.

        p(q_i) = c_k    for all rows i in cup k

    The frame is that of the base, which no row places: so neither a motion of arm and cups together, nor a turn about
    the line through two cups, is a parameter. Where the cups are is found with the arm; distances between them that are
    known (a bar with two cups, a plate) give the arm its size, and tie coordinates of the cups:

        |c_a - c_b| = d

    Of the coordinates, as many as there are independent distances follow from the others, by a few steps of Newton's
    method with the derivative at the start, which is near: each gains two digits or more where cups are found to some
    mm. Read is where the ball is from the cup of the row, nothing as measured.

    distances : pairs of cups and what is known between their centers [mm]
    """

    kind = "socket"
    keys = frozenset({"cups", "distances_mm"})
    target = "cup"
    own_targets = "cup"
    guide = Guide(
        about="a ball at the tool, seated in cups that stand anywhere",
        table='kind = "socket"\n'
        'distances_mm = [["A", "B", 300.0]]  # EXAMPLE: between centers; left out: only [machining] tells the size\n'
        "\n[instrument.cups]  # EXAMPLE: about where, in the frame of the base: plans are made for them\n"
        "A = [600.0, -150.0, 100.0]\nB = [600.0, 150.0, 100.0]",
        reads="seating",
        stands="cup",
        labels="cup in which the ball is seated, a new one wherever it is moved",
        touches="three cups or more, each in five\norientations or more",
    )

    distances: tuple[tuple[str, str, float], ...] = ()

    @property
    def dimension(self) -> int:
        return len(AXES)

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        """From the cup of this number; where there is none from the nearest."""
        if not self.at:
            return point
        beside = [point - cup for cup in self._cups(values)]
        nearest, least = beside[0], ca.sumsqr(beside[0])
        for other in beside[1:]:
            nearest, least = ca.if_else(ca.sumsqr(other) < least, other, nearest), ca.fmin(least, ca.sumsqr(other))
        return self.of_row(beside, target, nearest)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        starts, following = self._tied
        every = zip(super().parameters, starts.tolist(), strict=True)
        return tuple(replace(p, start=x) for k, (p, x) in enumerate(every) if k not in following)

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        """Where the cups are, and how far apart."""
        if not self.at:
            return
        names = [parameter.name for parameter in self.parameters]
        symbols = ca.SX.sym("v", len(names))
        cups = self._cups(symbols)
        labels = [f"cup {name} {axis}" for name, _ in self.at for axis in AXES]
        labels += [f"cups {a} to {b}" for (a, _), (b, _) in combinations(self.at, 2)]
        table = ca.vertcat(*cups, *(ca.norm_2(one - other) for one, other in combinations(cups, 2)))
        function = ca.Function("cups", [symbols], [table, ca.jacobian(table, symbols)])
        figures, slopes = function([values.get(p.name, p.neutral) for p in self.parameters])
        for label, value, row in zip(labels, np.array(figures).ravel().tolist(), np.array(ca.DM(slopes)), strict=True):
            by_name = {name: float(slope) for name, slope in zip(names, row, strict=True) if slope}
            yield OwnValue(label, None, value, by_name, "mm", "center in the frame of the base, axis 1 as drawn")

    @property
    def size_is_open(self) -> tuple[str, str]:
        pairs = self._pairs if self.at else self.distances  # between these cups, of all that are given
        return ("", "") if pairs else ("cups without a distance that is known", "give distances_mm between them")

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset(error_names(PLACE))

    # -- where a fit starts --------------------------------------------------------------------------------------------
    def place(self, rows: Unplaced) -> Placement:
        """Of rows in one cup: the point of the tip that moves least, in closed form."""
        positions, turns = (a - a.mean(axis=0) for a in (rows.frames[:, :3, 3], rows.frames[:, :3, :3]))
        tool = rows.tool
        if tool is None:
            tool = -np.linalg.lstsq(turns.reshape(-1, 3), positions.ravel(), rcond=1e-6)[0]
        moved = positions + turns @ tool
        return Placement(np.eye(4), tool, float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))

    def target_of(self, points: Array, readings: Array) -> Array:
        """In the middle of the points."""
        return np.asarray(points.mean(axis=0))

    @property
    def targets(self) -> dict[str, Array]:
        return dict(zip((name for name, _ in self.at), self._tied[0].reshape(-1, 3), strict=True))

    # -- cups ----------------------------------------------------------------------------------------------------------
    @cached_property
    def _pairs(self) -> list[tuple[int, int, float]]:
        """Numbers of cups whose distances are known, and these [mm]; of `monday/A` and `monday/B`, too."""
        split = [name.rpartition("/")[::2] for name, _ in self.at]
        return [
            (a, split.index((group, second)), length)
            for first, second, length in self.distances
            for a, (group, name) in enumerate(split)
            if name == first and (group, second) in split
        ]

    @cached_property
    def _tied(self) -> tuple[Array, dict[int, Array]]:
        """(3 C,) coordinates of all cups, nearest to `at` with the distances that are known; and coordinate that
        follows from the others -> by how much it closes each gap (k,), as there."""
        cups, k = np.array([place for _, place in self.at], dtype=float).reshape(-1, 3), len(self._pairs)
        one, other, lengths = np.array(self._pairs, dtype=float).reshape(k, 3).T
        ends, slopes = (one.astype(int), other.astype(int)), np.zeros((k, len(cups), 3))
        for _ in range(100):  # effort: distances that can be true are reached in a few steps
            across = cups[ends[1]] - cups[ends[0]]
            apart = np.linalg.norm(across, axis=1)
            for end, sign in zip(ends, (-1.0, 1.0), strict=True):
                slopes[np.arange(k), end] = sign * across / np.maximum(apart, TOUCHES)[:, None]
            if np.abs(apart - lengths).max(initial=0.0) < TOUCHES:
                break
            cups = cups - (np.linalg.pinv(slopes.reshape(k, -1), rcond=DISTINCT) @ (apart - lengths)).reshape(-1, 3)
        else:
            pairs = ", ".join(f"{self.at[a][0]} to {self.at[b][0]}" for a, b, _ in self._pairs)
            allowed = "allowed: distances that can all be true"
            raise InputError(f"instrument.distances_mm: no cups are as far apart as {pairs}, {allowed}")
        if not k:
            return cups.ravel(), {}
        from scipy.linalg import qr  # only cups with distances pay for the import

        table = slopes.reshape(k, -1)
        _, triangle, order = qr(table, mode="economic", pivoting=True)
        chosen = order[: np.count_nonzero(np.abs(np.diag(triangle)) > DISTINCT)]
        return cups.ravel(), dict(zip(chosen.tolist(), np.linalg.pinv(table[:, chosen], rcond=DISTINCT), strict=True))

    def _cups(self, values: ca.SX) -> list[ca.SX]:
        """Centers (3,) of all cups at values of the parameters."""
        starts, following = self._tied
        places, cups = ca.SX(ca.DM(starts)), [slice(3 * k, 3 * k + 3) for k in range(len(self.at))]
        free = [k for k in range(len(starts)) if k not in following]
        places[free] = values
        for _ in range(4 if following else 0):  # effort: of Newton's method
            gaps = (ca.norm_2(places[cups[b]] - places[cups[a]]) - length for a, b, length in self._pairs)
            places[[*following]] -= ca.mtimes(ca.DM(np.array([*following.values()])), ca.vertcat(*gaps))
        return [places[cup] for cup in cups]

    # -- files ---------------------------------------------------------------------------------------------------------
    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Socket:
        cups = tuple((name, tuple(map(float, place))) for name, place in (table.get("cups") or {}).items())
        distances = tuple((str(a), str(b), float(d)) for a, b, d in table.get("distances_mm") or ())
        return cls(cups, distances)
