"""What a posture must satisfy besides the joint limits. Each constraint is written twice, independently.

`margin(postures)` is plain geometry in numpy, a signed distance [mm], satisfied where >= 0: plans are judged by it.
`symbolic(q)` is a CasADi expression of the same sign, smooth where it can be: solvers climb along it.
Links are thin and run from joint to joint, at the best known values of the model's parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from doe.problem.spatial_constraints import InView, OutsideCylinder
from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.parameters import REVOLUTE
from identification.model import Model
from identification.workspace import (
    ColumnLimits,
    KeepOutCircle,
    KeepOutCylinder,
    LineOfSight,
    PostureCondition,
    WorkspaceBox,
)

ANYWHERE = 1e6  # [mm] a side that the arm file leaves out


class Constraint(PostureCondition, Protocol):
    """A condition on one posture, satisfied where all margins are >= 0."""

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k,) expressions of the same signs, differentiable almost everywhere."""
        ...


class ArmPoints(Protocol):
    """Interface to a model for geometric constraints: the points of the arm."""

    @property
    def dimension(self) -> int:
        """d, coordinates of a point."""
        ...

    def points(self, postures: ArrayLike) -> Array:
        """(m, k, d) base, joints and tip [mm] at postures (m, n)."""
        ...

    def symbolic_points(self, q: ca.SX) -> list[ca.SX]:
        """k points (d,), the same at one posture (n,)."""
        ...


def constraints_of(model: Model) -> tuple[Constraint, ...]:
    """The constraints of the model's arm file, ready to be evaluated."""
    made: list[Constraint] = []
    for limit in model.arm.constraints:
        if isinstance(limit, ColumnLimits):
            made.append(WithinColumn(limit, model.reach if model.joint_types[limit.joint - 1] == REVOLUTE else 1.0))
        elif isinstance(limit, WorkspaceBox):
            sides = [limit.x, limit.y, limit.z or (-ANYWHERE, ANYWHERE)][: model.dimension]
            made.append(InsideBox(model, tuple(side[0] for side in sides), tuple(side[1] for side in sides)))
        elif isinstance(limit, KeepOutCylinder):
            made.append(OutsideCylinder(model, limit))
        elif isinstance(limit, KeepOutCircle):
            made.append(OutsideSphere(model, limit.center, limit.radius))
        elif isinstance(limit, LineOfSight):
            made.append(InSight(model, limit) if model.dimension == 2 else InView(model, limit))
    return tuple(made)


@dataclass(frozen=True)
class WithinColumn:
    """A joint that the controller counts together with others stays within its limits; an angle is the distance [mm]
    that it is at full reach.

    unit : [mm] that stands for one of the limits' unit
    """

    limits: ColumnLimits
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

    chain: ArmPoints
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

    chain: ArmPoints
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

    chain: ArmPoints
    sight: LineOfSight
    kind: str = "line_of_sight"

    def __post_init__(self) -> None:
        if self.chain.dimension != 2:
            raise InputError(f"line_of_sight: an arm in {self.chain.dimension} dimensions, allowed: a planar arm")

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


def distance_to_segment(point: Array, start: Array, end: Array) -> Array:
    """(...) distance of points (..., d) from segments."""
    return np.asarray(np.linalg.norm(nearest_on_segment(point, start, end) - point, axis=-1))


def nearest_on_segment(point: Array, start: Array, end: Array) -> Array:
    """(..., d) the points of segments that are nearest to points (..., d)."""
    along = end - start
    square = np.maximum(np.sum(along**2, axis=-1), 1e-300)
    fraction = np.clip(np.sum((point - start) * along, axis=-1) / square, 0.0, 1.0)
    return np.asarray(start + fraction[..., None] * along)


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


SOME = "constraints that leave some"  # postures


def infeasible(constraints: tuple[Constraint, ...], postures: Array) -> InputError:
    """The diagnosis when none of these (many, well spread) postures satisfies all constraints: which exclude all."""
    fits = np.array([np.all(c.margin(postures) >= 0.0, axis=1) for c in constraints])
    names = [f"constraint {k + 1} ({c.kind})" for k, c in enumerate(constraints)]
    alone = [name for name, fit in zip(names, fits, strict=True) if not fit.any()]
    if alone:
        conflict = f"no posture within the joint limits satisfies {' nor '.join(alone)}"
        return InputError(f"constraints: {conflict}, allowed: {SOME}")
    for k in range(len(names)):
        for other in range(k):
            if not np.any(fits[k] & fits[other]):
                conflict = f"no posture satisfies {names[other]} and {names[k]} together"
                return InputError(f"constraints: {conflict}, allowed: {SOME}")
    return InputError(f"constraints: no posture satisfies all of {', '.join(names)} together, allowed: {SOME}")
