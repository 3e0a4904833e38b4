"""Constraints of spatial arms only: cylinders that no link may enter, a tracker that must see the reflector.

As in `doe.problem.constraints` each is said twice: `margin` compares what may be the nearest points of a link, or finds
the nearest by golden section, since a distance from a convex body is a convex function along a line; `symbolic` has
closed forms of the same sign.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from identification.arrays import Array
from identification.model import Model
from identification.workspace import KeepOutCylinder, LineOfSight

LINK_RADIUS = 0.03  # of the arm's reach: how near to a link a line of sight may pass
POINTER = 100.0  # [mm] from the reflector to the point that tells where it looks
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
SECTIONS = 50  # of golden section: 1e-10 of a link
PART = 1000  # postures at a time, whose sections stay in the processor's cache
FLAT = 1e-9  # [mm] lengths that divide nothing


@dataclass(frozen=True)
class OutsideCylinder:
    """Every link stays outside a cylinder with flat ends [mm]."""

    model: Model
    cylinder: KeepOutCylinder
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

    model: Model
    sight: LineOfSight
    kind: str = "line_of_sight"

    @cached_property
    def _pointing(self) -> Model | None:
        """The model with the measured point moved to where the reflector looks; None: it looks everywhere."""
        chain = self.model.arm.chain
        if self.sight.facing is None or chain.planar:
            return None
        direction = np.array(self.sight.facing) / np.linalg.norm(self.sight.facing)
        tools = {name: place + POINTER * direction for name, place in chain.tools.items()}
        return replace(self.model, arm=replace(self.model.arm, chain=replace(chain, tools=tools)))

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


def angle(one: Array, other: Array) -> Array:
    """(m,) angle [rad] between vectors (m, 3) or (3,)."""
    cross = np.linalg.norm(np.cross(one, other), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(one * other, axis=-1)))


def circle_across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) perpendicular to an axis and to each other."""
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    one = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    one /= np.linalg.norm(one)
    return one, np.cross(unit, one)


def smallest(function: Callable[[Array], Array], shape: tuple[int, ...]) -> Array:
    """(*shape) smallest values between 0 and 1 of convex functions of one variable, by golden section."""
    low, high = np.zeros(shape), np.ones(shape)
    left, right = high - GOLDEN, low + GOLDEN
    at_left, at_right = function(left), function(right)
    for _ in range(SECTIONS):
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
