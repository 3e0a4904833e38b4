"""What a posture must satisfy besides the joint limits. Each constraint is written twice, independently.

`margin(postures)` is plain geometry in numpy, a signed distance [mm], satisfied where >= 0: plans are judged by it. It
compares what may be the nearest points of a link, or finds the nearest by golden section, since a distance from a
convex body is a convex function along a line. `symbolic(q)` is a CasADi expression of the same sign, smooth where it
can be: solvers climb along it. Links are thin and run from joint to joint, at the best known values of the model's
parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from doe.problem.model import Offers, offered
from identification import REVOLUTE, Array, InputError, design_model
from identification.workspace import PostureCondition, distance_to_segment

# every plan in space says this, in words and as the key `collisions_checked`, until collisions are looked at
COLLISIONS = (
    "Collisions were not looked at, neither of the arm with itself nor with what is around it: try each posture "
    "slowly, or let armcal design --candidates FILE choose from postures that you allow."
)
LINK_RADIUS = 0.03  # of the arm's reach: how near to a link a line of sight may pass
POINTER = 100.0  # [mm] from the reflector to the point that tells where it looks
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
PART = 1000  # postures at a time, whose sections stay in the processor's cache
FLAT = 1e-9  # [mm] lengths that divide nothing


class Constraint(PostureCondition, Protocol):
    """A condition on one posture, satisfied where all margins are >= 0."""

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k,) expressions of the same signs, differentiable almost everywhere."""
        ...


def constraints_of(model: Any) -> tuple[Constraint, ...]:
    """The constraints that a model has, ready to be evaluated; none of one that has none."""
    model, made = design_model(model), list[Constraint]()
    for limit in getattr(model, "constraints", ()):
        space = offered(model, "space", "constraints")
        if limit.kind == "joint_limits":
            made.append(WithinColumn(limit, model.reach if model.joint_types[limit.joint - 1] == REVOLUTE else 1.0))
        elif limit.kind == "workspace_box":
            sides = [limit.x, limit.y, limit.z or (-1e6, 1e6)][:space]  # [mm] for a side that the arm file leaves out
            made.append(InsideBox(model, tuple(side[0] for side in sides), tuple(side[1] for side in sides)))
        elif limit.kind == "keep_out_cylinder":
            made.append(OutsideCylinder(model, limit))
        elif limit.kind == "keep_out_circle":
            made.append(OutsideSphere(model, limit.center, limit.radius))
        elif limit.kind == "line_of_sight":
            made.append(InSight(model, limit) if space == 2 else InView(model, limit))
    return tuple(made)


@dataclass(frozen=True)
class WithinColumn:
    """A joint that the controller counts together with others stays within its limits; an angle is the distance [mm]
    that it is at full reach.

    unit : [mm] that stands for one of the limits' unit
    """

    limits: Any
    unit: float
    kind: str = "joint_limits"

    def margin(self, postures: Array) -> Array:
        """(m, 2) distances to both limits [mm]."""
        column = postures @ np.array(self.limits.coefficients)
        return self.unit * np.stack([column - self.limits.lower, self.limits.upper - column], axis=1)

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(2,) the same."""
        column = sum((c * q[j] for j, c in enumerate(self.limits.coefficients) if c), ca.SX(0.0))
        return self.unit * ca.vertcat(column - self.limits.lower, self.limits.upper - column)


@dataclass(frozen=True)
class InsideBox:
    """The tip stays between two corners (d,) [mm]."""

    chain: Offers
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    kind: str = "workspace_box"

    def margin(self, postures: Array) -> Array:
        """(m, 2 d) distances to the sides [mm]."""
        tip = self.chain.points(postures)[:, -1]
        return np.stack([tip - self.lower, self.upper - tip], axis=2).reshape(len(tip), 2 * tip.shape[1])

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(2 d,) the same."""
        tip = self.chain.symbolic_points(q)[-1]
        return ca.vec(ca.horzcat(tip - ca.DM(self.lower), ca.DM(self.upper) - tip).T)


@dataclass(frozen=True)
class OutsideSphere:
    """Every link stays outside the circle of the plane, or the sphere of space [mm]."""

    chain: Offers
    center: tuple[float, ...]
    radius: float
    kind: str = "keep_out_circle"

    def margin(self, postures: Array) -> Array:
        """(m, k - 1) distance of every link from the sphere [mm]."""
        points = self.chain.points(postures)
        return distance_to_segment(np.array(self.center), points[:, :-1], points[:, 1:]) - self.radius

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k - 1,) (distance^2 - radius^2) / (2 radius): smooth, and nearly the distance near the sphere."""
        center = ca.DM(self.center)
        squares = [symbolic_square_distance(center, a, b) for a, b in pairwise(self.chain.symbolic_points(q))]
        return (ca.vertcat(*squares) - self.radius**2) / (2.0 * self.radius)


@dataclass(frozen=True)
class InSight:
    """The tracker sees the tip: inside its cone, no link across the line of sight (but the last, which ends there).

    For a plane: in space a thin link never crosses a line. Raises `InputError` for a chain of another dimension.
    """

    chain: Offers
    sight: Any
    kind: str = "line_of_sight"

    def __post_init__(self) -> None:
        if self.chain.space != 2:
            raise InputError(f"line_of_sight: an arm in {self.chain.space} dimensions, allowed: a planar arm")

    def margin(self, postures: Array) -> Array:
        """(m, n) arc to the edge of the cone, and signed distances of links 1..n-1 from the line of sight [mm]."""
        points, tracker = self.chain.points(postures), np.array(self.sight.tracker)
        view, axis = points[:, -1] - tracker, np.array(self.sight.toward) - tracker
        turn = np.arctan2(cross(axis, view), view @ axis)
        cone = (self.sight.half_angle - np.abs(turn)) * np.linalg.norm(view, axis=1)
        links = signed_gap(tracker, points[:, None, -1], points[:, :-2], points[:, 1:-1])
        return np.concatenate([cone[:, None], links], axis=1)

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(n,) v . axis - |v| cos(half angle); the larger of two products of areas that are < 0 when segments cross."""
        points, tracker = self.chain.symbolic_points(q), ca.DM(self.sight.tracker)
        axis = np.subtract(self.sight.toward, self.sight.tracker)
        view = points[-1] - tracker
        cone = ca.dot(view, ca.DM(axis / np.linalg.norm(axis))) - np.cos(self.sight.half_angle) * ca.norm_2(view)
        gaps = [symbolic_gap(tracker, points[-1], a, b) for a, b in pairwise(points[:-1])]
        return ca.vertcat(cone, *gaps)


@dataclass(frozen=True)
class OutsideCylinder:
    """Every link stays outside a cylinder with flat ends [mm]."""

    model: Offers
    cylinder: Any
    kind: str = "keep_out_cylinder"

    def margin(self, postures: Array) -> Array:
        """(m, k - 1) signed distance of every link from the cylinder [mm]."""
        points = self.model.points(postures)
        return np.concatenate([self._margin(points[k : k + PART]) for k in range(0, max(len(points), 1), PART)])

    def _margin(self, points: Array) -> Array:
        """The same of (m, k, 3) points of the arm."""
        axis = np.subtract(self.cylinder.end, self.cylinder.start)
        length = float(np.linalg.norm(axis))
        heights = (points - self.cylinder.start) @ axis / length
        offsets = points - self.cylinder.start - heights[..., None] * axis / length
        height, rise = heights[:, :-1] - 0.5 * length, np.diff(heights, axis=1)
        offset, turned = offsets[:, :-1], np.diff(offsets, axis=1)
        square, slope, curvature = _dot(offset, offset), 2.0 * _dot(offset, turned), _dot(turned, turned)

        def depth(share: Array) -> Array:
            squares = square + share * (slope + share * curvature)
            away = np.sqrt(np.maximum(squares, 0.0)) - self.cylinder.radius
            beyond = np.abs(height + share * rise) - 0.5 * length
            outside = np.hypot(np.maximum(away, 0.0), np.maximum(beyond, 0.0))
            return np.where(np.maximum(away, beyond) > 0.0, outside, np.maximum(away, beyond))

        return smallest(depth, rise.shape)

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k - 1,) the larger of: how far a link is beyond an end; (distance from the axis, of what lies between the
        ends, squared, - radius^2) / (2 radius)."""
        start = np.array(self.cylinder.start)
        along = np.array(self.cylinder.end) - start
        length, radius = float(np.linalg.norm(along)), self.cylinder.radius
        axis, expressions = ca.DM(along / length), []
        for a, b in pairwise(self.model.symbolic_points(q)):
            start_along, end_along = ca.dot(a - ca.DM(start), axis), ca.dot(b - ca.DM(start), axis)
            beyond = ca.fmax(ca.fmin(start_along, end_along) - length, -ca.fmax(start_along, end_along))
            rise = end_along - start_along
            rise = ca.if_else(ca.fabs(rise) < FLAT, FLAT, rise)
            enters, leaves = -start_along / rise, (length - start_along) / rise
            offset = a - ca.DM(start) - start_along * axis
            turned = (b - a) - (end_along - start_along) * axis
            nearest = -ca.dot(offset, turned) / ca.fmax(ca.sumsqr(turned), FLAT)
            first, last = _share(ca.fmin(enters, leaves)), _share(ca.fmax(enters, leaves))
            away = ca.sumsqr(offset + ca.fmax(first, ca.fmin(last, nearest)) * turned) - radius**2
            expressions.append(ca.fmax(beyond, away / (2.0 * radius)))
        return ca.vertcat(*expressions)


@dataclass(frozen=True)
class InView:
    """The tracker sees the reflector: inside its cone and range, not from behind, no link near the line of sight.

    Links have a radius of 0.03 of the arm's reach here; the last, which carries the reflector, is not in the way.
    """

    model: Offers
    sight: Any
    kind: str = "line_of_sight"

    @cached_property
    def _pointing(self) -> Offers | None:
        """The model with the measured point moved to where the reflector looks; None: it looks everywhere."""
        if self.sight.facing is None:
            return None
        direction = np.array(self.sight.facing) / np.linalg.norm(self.sight.facing)
        return offered(self.model, "with_tip_moved", "line_of_sight")(POINTER * direction)

    @property
    def _clearance(self) -> float:
        return LINK_RADIUS * self.model.reach

    def margin(self, postures: Array) -> Array:
        """(m, k) arc to the edge of the cone, distances to both ends of the range, arc to the edge of acceptance,
        distances of all links but the last from the line of sight, less their radius [mm]; what is not asked for is
        left out."""
        points, tracker = self.model.points(postures), np.array(self.sight.tracker)
        view, axis = points[:, -1] - tracker, np.array(self.sight.toward) - tracker
        distance = np.linalg.norm(view, axis=1)
        margins = [(self.sight.half_angle - angle(view, axis)) * distance]
        if self.sight.reach is not None:
            margins += [distance - self.sight.reach[0], self.sight.reach[1] - distance]
        if self._pointing is not None:
            looks = self._pointing.points(postures)[:, -1] - points[:, -1]
            margins.append((self.sight.acceptance - angle(looks, -view)) * distance)
        links = distance_between(tracker, points[:, -1:], points[:, :-2], points[:, 1:-1]) - self._clearance
        return np.column_stack([*margins, links])

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k,) cosines in place of angles, and squares of distances: (distance^2 - radius^2) / (2 radius)."""
        points, tracker = self.model.symbolic_points(q), ca.DM(self.sight.tracker)
        axis = np.subtract(self.sight.toward, self.sight.tracker)
        view = points[-1] - tracker
        distance, radius = ca.norm_2(view), self._clearance
        expressions = [ca.dot(view, ca.DM(axis / np.linalg.norm(axis))) - np.cos(self.sight.half_angle) * distance]
        if self.sight.reach is not None:
            expressions += [distance - self.sight.reach[0], self.sight.reach[1] - distance]
        if self._pointing is not None:
            looks = (self._pointing.symbolic_points(q)[-1] - points[-1]) / POINTER
            expressions.append(-ca.dot(looks, view) - np.cos(self.sight.acceptance) * distance)
        for a, b in pairwise(points[:-1]):
            expressions.append((symbolic_square_between(tracker, points[-1], a, b) - radius**2) / (2.0 * radius))
        return ca.vertcat(*expressions)


@dataclass(frozen=True)
class Expression:
    """A user's own constraint: a function of a CasADi posture (n,) [rad] that returns expressions to be kept >= 0."""

    function: Callable[[ca.SX], ca.SX]
    joints: int
    kind: str = "expression"
    _compiled: ca.Function = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        q = ca.SX.sym("q", self.joints)
        object.__setattr__(self, "_compiled", ca.Function("constraint", [q], [self.symbolic(q)]))

    def margin(self, postures: Array) -> Array:
        """(m, k) values, by CasADi's own evaluation."""
        return np.asarray(self._compiled(np.asarray(postures).T)).T.reshape(len(postures), -1)

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k,) the user's expressions."""
        return ca.vec(self.function(q))


# -- geometry ----------------------------------------------------------------------------------------------------------
def signed_gap(a: Array, b: Array, c: Array, d: Array) -> Array:
    """(...) distance between segments a-b and c-d of a plane; negative by how deep they cross: it is continuous."""
    ends = [distance_to_segment(*points) for points in ((a, c, d), (b, c, d), (c, a, b), (d, a, b))]
    one_across = cross(b - a, c - a) * cross(b - a, d - a) < 0.0
    other_across = cross(d - c, a - c) * cross(d - c, b - c) < 0.0
    return np.where(one_across & other_across, -1.0, 1.0) * np.minimum.reduce(ends)


def cross(a: Array, b: Array) -> Array:
    """(...) twice the signed area that two vectors (..., 2) of a plane span."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def symbolic_square_distance(point: ca.DM, start: ca.SX, end: ca.SX) -> ca.SX:
    """Squared distance of a point from a segment."""
    along = end - start
    fraction = ca.fmax(0.0, ca.fmin(1.0, ca.dot(point - start, along) / ca.fmax(ca.sumsqr(along), 1e-12)))
    return ca.sumsqr(start + fraction * along - point)


def symbolic_gap(a: ca.DM, b: ca.SX, c: ca.SX, d: ca.SX) -> ca.SX:
    """>= 0 where segments do not cross [mm^2 over their lengths]: one lies on one side of the other's line."""

    def side(p: ca.SX | ca.DM, q: ca.SX, r: ca.SX | ca.DM) -> ca.SX:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    across = side(a, b, c) * side(a, b, d) / ca.sumsqr(b - a)
    along = side(c, d, a) * side(c, d, b) / ca.sumsqr(d - c)
    return ca.fmax(across, along) / ca.sqrt(ca.sumsqr(d - c))


def angle(one: Array, other: Array) -> Array:
    """(m,) angle [rad] between vectors (m, 3) or (3,)."""
    cross = np.linalg.norm(np.cross(one, other), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(one * other, axis=-1)))


def smallest(function: Callable[[Array], Array], shape: tuple[int, ...]) -> Array:
    """(*shape) smallest values between 0 and 1 of convex functions of one variable, by golden section."""
    low, high = np.zeros(shape), np.ones(shape)
    left, right = high - GOLDEN, low + GOLDEN
    at_left, at_right = function(left), function(right)
    for _ in range(50):  # 1e-10 of a link
        lower = at_left <= at_right
        low, high = np.where(lower, low, left), np.where(lower, right, high)
        new = np.where(lower, high - GOLDEN * (high - low), low + GOLDEN * (high - low))
        left, right, value = np.where(lower, new, right), np.where(lower, left, new), function(new)
        at_left, at_right = np.where(lower, value, at_right), np.where(lower, at_left, value)
    return np.minimum.reduce([at_left, at_right, function(np.zeros(shape)), function(np.ones(shape))])


def distance_between(a: Array, b: Array, c: Array, d: Array) -> Array:
    """(...) distance of the segments a-b and c-d (..., 3): the nearest points are an end of one and what is nearest
    to it on the other, or, where no end is nearest, the feet of the common normal of the two lines."""
    one, other, between = b - a, d - c, a - c
    square, crossed, second = _dot(one, one), _dot(one, other), _dot(other, other)
    first, last = _dot(one, between), _dot(other, between)
    square, second = np.maximum(square, FLAT), np.maximum(second, FLAT)
    sine = square * second - crossed**2
    inner = np.clip((crossed * last - first * second) / np.where(sine > FLAT, sine, np.inf), 0.0, 1.0)
    shares: list[tuple[ArrayLike, ArrayLike]] = [
        (s, np.clip((crossed * s + last) / second, 0.0, 1.0)) for s in (0.0, 1.0, inner)
    ]
    shares += [(np.clip((crossed * s - first) / square, 0.0, 1.0), s) for s in (0.0, 1.0)]
    return np.minimum.reduce([_length(between, one, other, *pair) for pair in shares])


def symbolic_square_between(a: ca.SX | ca.DM, b: ca.SX, c: ca.SX, d: ca.SX) -> ca.SX:
    """Squared distance of the segments a-b and c-d of space (C. Ericson, Real-Time Collision Detection, 5.1.9)."""
    one, other, between = b - a, d - c, a - c
    square, crossed, second = ca.sumsqr(one), ca.dot(one, other), ca.fmax(ca.sumsqr(other), FLAT)
    first, last = ca.dot(one, between), ca.dot(other, between)
    share = _share((crossed * last - first * second) / ca.fmax(square * second - crossed**2, FLAT))
    along = _share((crossed * share + last) / second)
    share = _share((crossed * along - first) / ca.fmax(square, FLAT))
    return ca.sumsqr(between + share * one - along * other)


def _dot(one: Array, other: Array) -> Array:
    return np.asarray(np.sum(one * other, axis=-1))


def _length(between: Array, one: Array, other: Array, share: ArrayLike, along: ArrayLike) -> Array:
    step = np.asarray(share)[..., None] * one - np.asarray(along)[..., None] * other
    return np.asarray(np.linalg.norm(between + step, axis=-1))


def _share(value: ca.SX) -> ca.SX:
    return ca.fmax(0.0, ca.fmin(1.0, value))
