"""Ascent of a plan to a local optimum of the criterion within limits and constraints: L-BFGS-B on exact gradients.

    df/dq_ia = (2 r / (k N)) tr(G B_i^T dB_i/dq_a),   M = ((r / k) sum_i B_i^T B_i + K) / N,   N = r + runs of K

of a plan of k postures that stand for r runs (an exact plan: r = k), with G = dPhi/dM. Under constraints a penalty is
climbed with,

    f(q) - s / 2 * sum over runs and constraints max(0, -c(q))^2,

for three values of s, each from where the last one ended. A constraint is one of single postures; c is it over its mean
slope at random ones, so that it is about an angle [rad], and s is in units of the mean slope of f. What is outside at
the end, by about a thousandth of a radian, is put inside by Newton's method.
"""

import numpy as np

from doe.criteria import information_matrix
from doe.problem.problem import INSIDE, DesignProblem, Stop, never, put_inside
from identification import Array


class PlanAscent:
    """The criterion of plans (k, n) that stand for `runs` runs, None: for k, less a penalty, and how they climb."""

    def __init__(self, problem: DesignProblem, runs: int | None = None) -> None:
        self.problem, self.runs = problem, runs
        self.criterion = problem.criterion.smooth
        self.joints = list(problem.searched_joints)
        self.derivatives = problem.jacobian_derivatives(self.joints)
        self.firmness = 0.0

    def rise(self, plan: Array) -> tuple[float, Array]:
        """Value and slopes (k, a) by the joints that matter; -inf and zero where M is singular."""
        k, runs = len(plan), self.runs or len(plan)
        jacobians = self.problem.scaled_jacobians(plan)
        information = self.problem.prior.information(information_matrix(jacobians) * (runs / k), runs)
        value = float(self.criterion.value(information))
        if not np.isfinite(value):
            return value, np.zeros((k, len(self.joints)))
        slopes = self.derivatives.slope(plan, jacobians @ self.criterion.gradient(information))
        slopes *= 2.0 * runs / k / (runs + self.problem.prior.runs)
        if self.firmness == 0.0:
            return value, slopes
        margins, steps = self.problem.walls.first(plan)
        forces = self.firmness * np.maximum(0.0, INSIDE - margins / self.problem.steepness)
        slopes += (steps @ (forces / self.problem.steepness)[..., None])[..., 0]
        return value - float(np.sum(forces**2)) / (2.0 * self.firmness), slopes

    def __call__(self, plan: Array, tolerance: float | None = None, stop: Stop = never) -> Array:
        """(k, n) a plan at least as good as the one given, and feasible if that is, climbed until steps gain less than
        `tolerance` (relative).

        tolerance : None: 1e-8, and 1e-6 under constraints, where the last digits are the penalty's
        stop : asked after every step
        """
        if not self.problem.constraints:
            return self._climbed(plan, 1e-8 if tolerance is None else tolerance, stop)
        tolerance = 1e-6 if tolerance is None else tolerance
        self.firmness = 0.0
        slope = float(np.sqrt(np.mean(self.rise(plan)[1] ** 2)))
        moved = plan
        # s in units of the mean slope: a tenth, hundredth, thousandth of a radian outside
        for firmness in (10.0, 100.0, 1000.0) if slope > 0.0 else ():
            self.firmness = firmness * slope
            # less exact as long as s still grows
            moved = self._climbed(moved, tolerance * (1.0 if firmness == 1000.0 else 10.0), stop)
        inside = put_inside(self.problem, moved)
        return np.where(self.problem.feasible(inside)[:, None], inside, plan)

    def _climbed(self, plan: Array, tolerance: float, stop: Stop) -> Array:
        if stop() or not self.joints:
            return plan
        from scipy.optimize import minimize  # 0.1 s to import

        # of half the ranges, the length of the first step: a longer one ends on limits
        unit = np.tile(0.1 * 0.5 * (self.problem.upper - self.problem.lower)[self.joints], len(plan))
        limits = [np.tile(limit[self.joints], len(plan)) / unit for limit in (self.problem.lower, self.problem.upper)]

        def postures(point: Array) -> Array:
            moved = np.array(plan)
            moved[:, self.joints] = (point * unit).reshape(len(plan), -1)
            return self.problem.clip(moved)

        def fall(point: Array) -> tuple[float, Array]:
            value, slopes = self.rise(postures(point))
            return (-value if np.isfinite(value) else 1e10), -slopes.ravel() * unit  # no step leads where M is singular

        def ended(_: Array) -> None:
            if stop():
                raise StopIteration

        start = np.clip(plan[:, self.joints].ravel() / unit, *limits)
        # pairs of steps and slopes that stand for the Hessian
        options = {"ftol": tolerance, "gtol": 0.0, "maxcor": 12, "maxiter": 400}
        box = list(zip(*limits, strict=True))
        found = minimize(fall, start, jac=True, method="L-BFGS-B", bounds=box, callback=ended, options=options)
        climbed = postures(found.x)
        return climbed if self.rise(climbed)[0] >= self.rise(plan)[0] else plan
