"""What a posture must satisfy besides the joint limits: margins that are kept >= 0.

Solvers climb along them, and plans are judged by them. Each is a signed distance [mm], or has the sign of one and about
its size where it is near zero, at the best known values of the model's parameters. Most are expressions, written once
in CasADi, for which links are thin and run from joint to joint; those of bodies are in `doe.problem.clearance`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from doe.problem.clearance import Clearance
from doe.problem.model import PRISMATIC, Offers, offered, offers
from identification import Array, InputError, design_model, vectorize

LINK_RADIUS = 0.03  # of the arm's reach: how near to a link a line of sight may pass
FLAT = 1e-9  # [mm] lengths that divide nothing


class Derivatives:
    """Of an expression C, whose entries have the `shape` (...), by a of the joints, at many postures.

    A criterion needs second derivatives only in sums <W, C> over the entries with weights W (m, ...), and its gradient
    alone no more than the slope of such a sum: reverse differentiation gives each at a few times the cost of C itself.
    """

    def __init__(self, q: ca.SX, expression: ca.SX, joints: Sequence[int], shape: tuple[int, ...]) -> None:
        self.shape = shape
        entries = ca.densify(ca.vec(expression.T))
        self._active, self.count = q[list(joints)], entries.numel()
        weights = ca.SX.sym("w", self.count)
        total = ca.dot(entries, weights)
        self._parts = {
            "values": ([q], lambda: [entries]),
            "first": ([q], lambda: [entries, ca.jacobian(entries, self._active)]),
            "slope": ([q, weights], lambda: [ca.gradient(total, self._active)]),
            "bend": ([q, weights], lambda: [ca.hessian(total, self._active)[0]]),
        }
        self._compiled: dict[str, Callable[..., tuple[Array, ...]]] = {}

    def _evaluated(self, name: str, *arguments: Array) -> tuple[Array, ...]:
        if name not in self._compiled:
            inputs, outputs = self._parts[name]
            function = ca.Function("derivatives", inputs, ca.cse([ca.densify(each) for each in outputs()]))
            self._compiled[name] = vectorize(function)
        return self._compiled[name](*arguments)

    def values(self, postures: Array) -> Array:
        """(m, ...) C."""
        return self._evaluated("values", postures)[0].reshape(-1, *self.shape)

    def first(self, postures: Array) -> tuple[Array, Array]:
        """(m, ...) C and its derivatives (m, a, ...)."""
        values, slopes = self._evaluated("first", postures)
        slopes = np.swapaxes(slopes, 1, 2)
        return values.reshape(-1, *self.shape), slopes.reshape(*slopes.shape[:2], *self.shape)

    def slope(self, postures: Array, weights: Array) -> Array:
        """(m, a) gradients of <W, C>."""
        return self._evaluated("slope", postures, weights.reshape(-1, self.count))[0][..., 0]

    def bend(self, postures: Array, weights: Array) -> Array:
        """(m, a, a) Hessians of <W, C>."""
        return self._evaluated("bend", postures, weights.reshape(-1, self.count))[0]


class Expression(Derivatives):
    """A condition on one posture: a function of a CasADi posture q (n,) whose expressions (k,) are to be kept >= 0,
    differentiable almost everywhere.

    joints : n;  kind : its name in messages
    """

    def __init__(self, function: Callable[[ca.SX], ca.SX], joints: int, kind: str = "expression") -> None:
        q = ca.SX.sym("q", joints)
        expressions = ca.vec(function(q))
        super().__init__(q, expressions, range(joints), (expressions.numel(),))
        self.kind, self._made = kind, (function, joints, kind)

    def __reduce__(self) -> tuple[Any, ...]:
        return Expression, self._made

    margin = Derivatives.values


Constraint = Expression | Clearance


class Walls(tuple[Constraint, ...]):
    """The margins of all constraints, side by side, and their derivatives by the n joints."""

    def values(self, postures: Array) -> Array:
        """(m, k) margins."""
        return np.concatenate([np.empty((len(postures), 0)), *(each.margin(postures) for each in self)], axis=1)

    def first(self, postures: Array) -> tuple[Array, Array]:
        """(m, k) margins and their derivatives (m, n, k)."""
        none = np.empty((len(postures), 0)), np.empty((*postures.shape, 0))
        values, slopes = zip(none, *(each.first(postures) for each in self), strict=True)
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=2)

    def bend(self, postures: Array, weights: Array) -> Array:
        """(m, n, n) Hessians of the sums of margins with weights (m, k)."""
        parts = np.split(weights, np.cumsum([each.count for each in self], dtype=int), axis=1)
        return np.sum([each.bend(postures, part) for each, part in zip(self, parts, strict=False)], axis=0)


def constraints_of(model: Any) -> tuple[Constraint, ...]:
    """The constraints that a model has, ready to be evaluated; none of one that has none."""
    model, made = design_model(model), list[Constraint]()
    given = getattr(model, "constraints", ())
    sights = [np.array([*each.tracker, 0.0][:3]) for each in given if hasattr(each, "tracker")]
    if sights and offers(model, "placed"):
        model = model.placed()  # what is to be seen is where plans assume it, if the arm does not say
    for limit in given:
        for member in ("space", "symbolic_points"):
            offered(model, member, "constraints")
        build = in_view if limit.kind == "line_of_sight" else KINDS[limit.kind]
        made.append(Expression(partial(build, model, limit), len(model.joint_types), limit.kind))
    if offers(model, "cell") and model.cell.bodies:
        made.append(Clearance(model, sights))
    return tuple(made)


# -- one function a kind: of the model, what the arm file says, and a posture ------------------------------------------
def within_column(model: Offers, limit: Any, q: ca.SX) -> ca.SX:
    """(2,) A joint that the controller counts together with others stays within its limits; an angle is the distance
    that it is at full reach."""
    unit = 1.0 if model.joint_types[limit.joint - 1] == PRISMATIC else model.reach
    column = sum((c * q[j] for j, c in enumerate(limit.coefficients) if c), ca.SX(0.0))
    return unit * ca.vertcat(column - limit.lower, limit.upper - column)


def inside_box(model: Offers, box: Any, q: ca.SX) -> ca.SX:
    """(2 d k,) The k measured points stay between the sides, those that the arm file names."""
    low, high = np.transpose([box.x, box.y, box.z or (-1e6, 1e6)][: model.space])
    return ca.vertcat(*(ca.vertcat(point - low, high - point) for point in model.symbolic_points(q)[1]))


def outside_round(model: Offers, region: Any, q: ca.SX) -> ca.SX:
    """(k,) Every link, the last to each measured point, stays outside the circle of the plane, the sphere of space, or
    the cylinder with round ends: away from its center, or its axis."""
    (start, end), (joints, points, _) = map(ca.DM, region.axis), model.symbolic_points(q)
    links = [*pairwise(joints), *((joints[-1], point) for point in points)]
    return ca.vertcat(*(_distance(start, end, *link) - region.radius for link in links))


def in_view(model: Offers, sight: Any, q: ca.SX) -> ca.SX:
    """(k,) The tracker sees the reflectors, all of them: inside its cone and range, not from behind, no link near the
    line of sight; links have a radius here, and the last, which carries the reflectors, is not in the way. Of joints
    that carry bodies these are looked at instead (`Clearance`)."""
    if len(sight.tracker) != model.space:
        raise InputError(f"line_of_sight: a tracker in {len(sight.tracker)} dimensions, allowed: in {model.space}")
    (joints, reflectors, axes), tracker = model.symbolic_points(q), ca.DM(sight.tracker)
    axis, expressions = np.subtract(sight.toward, sight.tracker), list[ca.SX]()
    carry = {body.joint for body in model.cell.bodies} if offers(model, "cell") else set[int]()
    first = len(model.joint_types) + 1 - len(joints)  # joint that the first link moves with, 0 of an arm's foot
    links = [link for j, link in enumerate(pairwise(joints), first) if max(j, 1) not in carry]
    for reflector in reflectors:
        view, distance = reflector - tracker, ca.norm_2(reflector - tracker)
        # |view| (cos of the angle to the cone's axis - cos of half the cone's)
        expressions.append(ca.dot(view, ca.DM(axis / np.linalg.norm(axis))) - np.cos(sight.half_angle) * distance)
        if sight.reach is not None:
            expressions += [distance - sight.reach[0], sight.reach[1] - distance]
        if sight.facing is not None:
            looks = ca.mtimes(axes, ca.DM(np.array(sight.facing) / np.linalg.norm(sight.facing)))
            expressions.append(ca.dot(looks, -view) - np.cos(sight.acceptance) * distance)
        expressions += [_distance(tracker, reflector, *link) - LINK_RADIUS * model.reach for link in links]
    return ca.vertcat(*expressions)


KINDS: dict[str, Callable[..., ca.SX]] = {
    "joint_limits": within_column,
    "workspace_box": inside_box,
    **dict.fromkeys(("keep_out_circle", "keep_out_sphere", "keep_out_cylinder"), outside_round),
}


# -- geometry ----------------------------------------------------------------------------------------------------------
def _distance(a: ca.SX | ca.DM, b: ca.SX | ca.DM, c: ca.SX, d: ca.SX) -> ca.SX:
    """Distance of the segments a-b and c-d (C. Ericson, Real-Time Collision Detection, 2005, 5.1.9)."""
    one, other, between = b - a, d - c, a - c
    square, crossed, second = ca.sumsqr(one), ca.dot(one, other), ca.fmax(ca.sumsqr(other), FLAT)
    first, last = ca.dot(one, between), ca.dot(other, between)
    share = _share((crossed * last - first * second) / ca.fmax(square * second - crossed**2, FLAT))
    along = _share((crossed * share + last) / second)
    share = _share((crossed * along - first) / ca.fmax(square, FLAT))
    return ca.sqrt(ca.fmax(ca.sumsqr(between + share * one - along * other), FLAT**2))  # has a derivative at zero


def _share(value: ca.SX) -> ca.SX:
    return ca.fmax(0.0, ca.fmin(1.0, value))
