"""Batched ascent of plans to local optima of the criterion within the joint limits: L-BFGS on exact gradients.

    df/dq_ia = (2 r / (k N)) tr(G B_i^T dB_i/dq_a),   M = ((r / k) sum_i B_i^T B_i + K) / N,   N = r + runs of K

of a plan of k postures that stand for r runs (an exact plan: r = k), with G = dPhi/dM. Each joint is put as
q = middle + half the range * sin t, which leaves t free; D. C. Liu, J. Nocedal, "On the limited memory BFGS method",
Mathematical Programming 45 (1989), with a backtracking search. All plans share each pass over numpy arrays, so that
ten cost little more than one. Constraints: `doe.plan.constrained_ascent`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from doe.criteria.criterion import smooth
from doe.problem.derivatives import JacobianDerivatives
from doe.problem.problem import DesignProblem
from identification.arrays import Array

WIDE = 16  # parameters from which gradients pay: exchanges and second derivatives of plans cost the cube of them
MEMORY = 12  # pairs of steps and slopes that stand for the Hessian
STEPS = 400
INSIDE = 0.999  # sin t of a start on a limit: a joint exactly on it would never leave
ON_LIMIT = 1e-6  # of half the range: a joint this near to its limit is put on it
NEAR_LIMIT = 1e-3  # of half the range: where a joint may be held by the lack of a slope of t alone
RELEASES, RELEASED = 3, 0.95  # times that such joints are put inside, and how far
WEAK = 1e-3  # of the largest slope: too small for a release
FIRST = 0.1  # largest component of the first step of t
LONGEST = 1.0  # and of any other
SHORTER = 0.3  # of a step that does not gain
ENOUGH = 1e-4  # of the gain that the slope promises (Armijo)
STANDSTILL = 10  # steps in a row that gain less than the tolerance
SHORTEST = 1e-12  # step of t at which a search along a line gives up
IN_TIME: Callable[[], bool] = lambda: False  # noqa: E731


@dataclass
class History:
    """The last steps and changes of slope of s plans with N variables, newest last; products of zero are empty."""

    steps: Array  # (MEMORY, s, N)
    changes: Array  # (MEMORY, s, N)
    products: Array = field(init=False)  # (MEMORY, s) step . change

    def __post_init__(self) -> None:
        self.products = np.zeros(self.steps.shape[:2])

    def add(self, plans: NDArray[np.intp], steps: Array, changes: Array) -> None:
        """Of some plans; a pair without positive curvature is left out."""
        products = np.einsum("sn,sn->s", steps, changes)
        convex = products > 1e-12 * np.linalg.norm(steps, axis=1) * np.linalg.norm(changes, axis=1)
        rows = plans[convex]
        for stored, new in ((self.steps, steps), (self.changes, changes), (self.products, products)):
            stored[:-1, rows] = stored[1:, rows]
            stored[-1, rows] = new[convex]

    def downhill(self, slopes: Array) -> Array:
        """(s, N) minus the inverse Hessian times the slopes (s, N): the two loops of Liu and Nocedal."""
        direction, parts = slopes.copy(), np.zeros(self.products.shape)
        inverse = np.divide(1.0, self.products, out=np.zeros(self.products.shape), where=self.products > 0.0)
        for k in reversed(range(MEMORY)):
            parts[k] = inverse[k] * np.einsum("sn,sn->s", self.steps[k], direction)
            direction -= parts[k][:, None] * self.changes[k]
        squares = np.einsum("sn,sn->s", self.changes[-1], self.changes[-1])
        first = FIRST / np.maximum(np.abs(slopes).max(axis=1, initial=0.0), 1e-300)
        direction *= np.where(squares > 0.0, self.products[-1] / np.maximum(squares, 1e-300), first)[:, None]
        for k in range(MEMORY):
            back = inverse[k] * np.einsum("sn,sn->s", self.changes[k], direction)
            direction += (parts[k] - back)[:, None] * self.steps[k]
        longest = np.abs(direction).max(axis=1, initial=0.0)
        return -direction * np.minimum(1.0, LONGEST / np.maximum(longest, 1e-300))[:, None]


def climbs(problem: DesignProblem) -> bool:
    """True where climbing on gradients is the best there is: many parameters."""
    return problem.parameters > WIDE


class PlanAscent:
    """The criterion of plans (s, k, n) that stand for `runs` runs each, and how they climb.

    runs : None: as many as the plan has postures
    """

    def __init__(self, problem: DesignProblem, runs: int | None = None) -> None:
        self.problem, self.runs = problem, runs
        self.criterion = smooth(problem.criterion)
        self.joints = list(problem.searched_joints)
        self.derivatives = JacobianDerivatives(problem, self.joints)
        self.middle = 0.5 * (problem.lower + problem.upper)[self.joints]
        self.half = 0.5 * (problem.upper - problem.lower)[self.joints]

    def rise(self, plans: Array) -> tuple[Array, Array]:
        """(s,) values and (s, k, a) slopes by the joints that matter; -inf and zero where M is singular."""
        s, k, _ = plans.shape
        runs = self.runs or k
        jacobians = self.problem.scaled_jacobians(plans.reshape(s * k, -1))
        rows = jacobians.reshape(s, -1, self.problem.parameters)
        information = self.problem.prior.information(np.swapaxes(rows, 1, 2) @ rows * (runs / k), runs)
        values = np.array(self.criterion.value(information))
        gradients = np.zeros(information.shape)
        for one in np.flatnonzero(np.isfinite(values)):
            gradients[one] = self.criterion.gradient(information[one])
        weights = (rows @ gradients).reshape(jacobians.shape)
        slopes = self.derivatives.slope(plans.reshape(s * k, -1), weights).reshape(s, k, -1)
        return values, slopes * (2.0 * runs / k / (runs + self.problem.prior.runs))

    def __call__(self, plans: Array, tolerance: float = 1e-8, stop: Callable[[], bool] = IN_TIME) -> Array:
        """(s, k, n) plans at least as good as those given, climbed until steps gain less than `tolerance` (relative).

        stop : asked after every step
        """
        sines = (plans[..., self.joints] - self.middle) / self.half
        ended = self._climb(np.arcsin(np.clip(sines, -INSIDE, INSIDE)).reshape(len(plans), -1), plans, tolerance, stop)
        for _ in range(RELEASES):
            leaving = self._leaving(ended, plans)
            if not leaving.any() or stop():
                break
            inside = np.where(leaving, np.arcsin(RELEASED) * np.sign(np.sin(ended)), ended)
            ended = self._climb(inside, plans, tolerance, stop)
        return self._best(plans, ended)

    def _leaving(self, points: Array, plans: Array) -> NDArray[np.bool_]:
        """(s, k a) joints on a limit, where t has no slope, that would gain by leaving it: a step went too far."""
        sines = np.sin(points)
        _, slopes = self.rise(self._postures(sines, plans))
        slopes = slopes.reshape(points.shape)
        strong = np.abs(slopes) > WEAK * np.abs(slopes).max(axis=1, initial=0.0)[:, None]
        return (np.abs(sines) > 1.0 - NEAR_LIMIT) & (slopes * sines < 0.0) & strong

    def _climb(self, points: Array, plans: Array, tolerance: float, stop: Callable[[], bool]) -> Array:
        """(s, k a) values of t from which steps gain nothing more."""
        points, s = np.array(points), len(plans)
        values, slopes = self._fall(points, plans)
        history = History(*(np.zeros((MEMORY, *points.shape)) for _ in range(2)))
        directions, lengths, still = history.downhill(slopes), np.ones(s), np.zeros(s, dtype=int)
        moving = np.flatnonzero(np.isfinite(values))
        for _ in range(STEPS):
            if not len(moving) or stop():
                break
            steps = lengths[moving, None] * directions[moving]
            trial, found = points[moving] + steps, self._fall(points[moving] + steps, plans[moving])
            promised = np.einsum("sn,sn->s", steps, slopes[moving])
            better = found[0] <= values[moving] + ENOUGH * promised
            taken = moving[better]
            gains = values[taken] - found[0][better]
            still[taken] = np.where(gains <= tolerance * np.maximum(1.0, np.abs(values[taken])), still[taken] + 1, 0)
            history.add(taken, steps[better], found[1][better] - slopes[taken])
            points[taken], values[taken], slopes[taken] = trial[better], found[0][better], found[1][better]
            directions[moving] = np.where(better[:, None], history.downhill(slopes)[moving], directions[moving])
            lengths[moving] = np.where(better, 1.0, SHORTER * lengths[moving])
            moving = moving[(still[moving] < STANDSTILL) & (lengths[moving] > SHORTEST)]
        return points

    def _fall(self, points: Array, plans: Array) -> tuple[Array, Array]:
        """(s,) minus the values and (s, k a) their slopes by t."""
        values, slopes = self.rise(self._postures(np.sin(points), plans))
        return -values, -(slopes * self.half).reshape(points.shape) * np.cos(points)

    def _postures(self, sines: Array, plans: Array) -> Array:
        moved = np.array(plans)
        moved[..., self.joints] = self.middle + self.half * sines.reshape(*plans.shape[:2], -1)
        return self.problem.clip(moved)

    def _best(self, plans: Array, points: Array) -> Array:
        """Of each plan the best: as climbed, with joints put on limits that they are near, as it was."""
        sines = np.sin(points)
        snapped = np.where(np.abs(sines) > 1.0 - ON_LIMIT, np.sign(sines), sines)
        offered = np.stack([self._postures(snapped, plans), self._postures(sines, plans), plans])
        values = np.array([self.rise(each)[0] for each in offered])
        return np.asarray(offered[np.argmax(values, axis=0), np.arange(len(plans))])
