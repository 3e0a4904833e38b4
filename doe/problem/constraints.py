"""What a posture must satisfy besides the joint limits. Each constraint says it twice, independently.

`margin(postures)` is plain geometry in numpy, a signed distance [mm], satisfied where >= 0: plans are judged by it.
`symbolic(q)` is a CasADi expression of the same sign, smooth where it can be: solvers climb along it.
Links are thin, at their nominal lengths (calibrated, where the arm is). The base stands at the origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, KeepOutCircle, LineOfSight, WorkspaceBox
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.kinematics.planar import joint_points, symbolic_points

Points = NDArray[np.complex128]


class Constraint(Protocol):
    """A condition on one posture, satisfied where all margins are >= 0."""

    @property
    def kind(self) -> str:
        """Name in messages, as in the arm file."""
        ...

    def margin(self, postures: Array) -> Array:
        """(m, k) margins of postures (m, n), numerically."""
        ...

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(k,) expressions of the same signs, differentiable almost everywhere."""
        ...


def lengths_of(arm: Arm) -> Array:
    """(n,) best known link lengths [mm]."""
    return readonly(arm.lengths if arm.calibration is None else arm.lengths + arm.calibration.length_errors)


def constraints_of(arm: Arm) -> tuple[Constraint, ...]:
    """The constraints of an arm file, ready to be evaluated."""
    lengths = lengths_of(arm)
    made: list[Constraint] = []
    for spec in arm.constraints:
        if isinstance(spec, WorkspaceBox):
            made.append(InsideBox(lengths, spec.x, spec.y))
        elif isinstance(spec, KeepOutCircle):
            made.append(OutsideCircle(lengths, spec.center, spec.radius))
        else:
            made.append(InSight(lengths, spec))
    return tuple(made)


def complex_points(lengths: Array, postures: Array) -> Points:
    """(m, n + 1) base, joints and tip as complex numbers [mm]."""
    points = joint_points(lengths, postures)
    return np.asarray(points[..., 0] + 1j * points[..., 1])


@dataclass(frozen=True)
class InsideBox:
    """The tip stays inside x and y [mm]."""

    lengths: Array
    x: tuple[float, float]
    y: tuple[float, float]
    kind: str = "workspace_box"

    def margin(self, postures: Array) -> Array:
        """(m, 4) distances to the four sides [mm]."""
        tip = complex_points(self.lengths, postures)[:, -1]
        return np.stack([tip.real - self.x[0], self.x[1] - tip.real, tip.imag - self.y[0], self.y[1] - tip.imag], 1)

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(4,) the same."""
        x, y = ca.vertsplit(symbolic_points(self.lengths, q)[-1])
        return ca.vertcat(x - self.x[0], self.x[1] - x, y - self.y[0], self.y[1] - y)


@dataclass(frozen=True)
class OutsideCircle:
    """Every link stays outside the circle [mm]."""

    lengths: Array
    center: tuple[float, float]
    radius: float
    kind: str = "keep_out_circle"

    def margin(self, postures: Array) -> Array:
        """(m, n) distance of every link from the circle [mm]."""
        points = complex_points(self.lengths, postures)
        return distance_to_segment(complex(*self.center), points[:, :-1], points[:, 1:]) - self.radius

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(n,) (distance^2 - radius^2) / (2 radius): smooth, and nearly the distance near the circle."""
        points, center = symbolic_points(self.lengths, q), ca.DM(self.center)
        squares = [symbolic_square_distance(center, a, b) for a, b in pairwise(points)]
        return (ca.vertcat(*squares) - self.radius**2) / (2.0 * self.radius)


@dataclass(frozen=True)
class InSight:
    """The tracker sees the tip: inside its cone, no link across the line of sight (but the last, which ends there)."""

    lengths: Array
    sight: LineOfSight
    kind: str = "line_of_sight"

    def margin(self, postures: Array) -> Array:
        """(m, n) arc to the edge of the cone, and signed distances of links 1..n-1 from the line of sight [mm]."""
        points, tracker = complex_points(self.lengths, postures), complex(*self.sight.tracker)
        tip = points[:, -1]
        turn = np.angle((tip - tracker) * np.conj(complex(*self.sight.toward) - tracker))
        cone = (self.sight.half_angle - np.abs(turn)) * np.abs(tip - tracker)
        links = signed_gap(np.full((len(tip), 1), tracker), tip[:, None], points[:, :-2], points[:, 1:-1])
        return np.concatenate([cone[:, None], links], axis=1)

    def symbolic(self, q: ca.SX) -> ca.SX:
        """(n,) v . axis - |v| cos(half angle); the larger of two products of areas that are < 0 when segments cross."""
        points, tracker = symbolic_points(self.lengths, q), ca.DM(self.sight.tracker)
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


def distance_to_segment(point: complex | Points, start: Points, end: Points) -> Array:
    """(...) distance of points from segments."""
    along = end - start
    share = np.clip(((point - start) * along.conj()).real / np.maximum(np.abs(along) ** 2, 1e-300), 0.0, 1.0)
    return np.abs(start + share * along - point)


def signed_gap(a: Points, b: Points, c: Points, d: Points) -> Array:
    """(...) distance between segments a-b and c-d; negative by how deep they cross, so that it is continuous."""
    ends = [distance_to_segment(*args) for args in ((a, c, d), (b, c, d), (c, a, b), (d, a, b))]
    crossing = (area(a, b, c) * area(a, b, d) < 0.0) & (area(c, d, a) * area(c, d, b) < 0.0)
    return np.where(crossing, -1.0, 1.0) * np.minimum.reduce(ends)


def area(a: Points, b: Points, c: Points) -> Array:
    """(...) twice the signed area of a triangle."""
    return ((b - a).conj() * (c - a)).imag


def symbolic_square_distance(point: ca.DM, start: ca.SX, end: ca.SX) -> ca.SX:
    """Squared distance of a point from a segment."""
    along = end - start
    share = ca.fmax(0.0, ca.fmin(1.0, ca.dot(point - start, along) / ca.sumsqr(along)))
    return ca.sumsqr(start + share * along - point)


def symbolic_gap(a: ca.DM, b: ca.SX, c: ca.SX, d: ca.SX) -> ca.SX:
    """>= 0 where segments do not cross [mm^2 over their lengths]: one lies on one side of the other's line."""

    def side(p: ca.SX | ca.DM, q: ca.SX, r: ca.SX | ca.DM) -> ca.SX:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    across = side(a, b, c) * side(a, b, d) / ca.sumsqr(b - a)
    along = side(c, d, a) * side(c, d, b) / ca.sumsqr(d - c)
    return ca.fmax(across, along) / ca.sqrt(ca.sumsqr(d - c))


def infeasible(constraints: tuple[Constraint, ...], postures: Array) -> InputError:
    """The diagnosis when none of these (many, well spread) postures satisfies all constraints: which exclude all."""
    fits = np.array([np.all(c.margin(postures) >= 0.0, axis=1) for c in constraints])
    names = [f"constraint {k + 1} ({c.kind})" for k, c in enumerate(constraints)]
    alone = [name for name, fit in zip(names, fits, strict=True) if not fit.any()]
    if alone:
        return InputError(f"constraints: no posture within the joint limits satisfies {' nor '.join(alone)}")
    for k in range(len(names)):
        for other in range(k):
            if not np.any(fits[k] & fits[other]):
                return InputError(f"constraints: no posture satisfies {names[other]} and {names[k]} together")
    return InputError(f"constraints: no posture satisfies all of {', '.join(names)} together")
