"""Batched ascent of plans under constraints: a growing penalty, and Newton steps back inside at the end.

    f(q) - r / 2 * sum over runs and constraints max(0, -c(q))^2

climbs as the criterion f itself (`doe.plan.ascent`), for three values of r, each from where the last one ended. A
constraint is one of single postures; c is it over its mean slope, so that it is about an angle [rad], and r is in units
of the mean slope of f. What is outside at the end by about a thousandth of a radian is put inside.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from doe.plan.ascent import IN_TIME, PlanAscent
from doe.problem.derivatives import ConstraintDerivatives
from doe.problem.problem import DesignProblem
from identification.arrays import Array

FIRMNESS = (10.0, 100.0, 1000.0)  # r in units of the mean slope: a tenth, hundredth, thousandth of a radian outside
ROUGHLY = 10.0  # times the tolerance, as long as r still grows
MOVES = 1e-3  # of the steepest constraint: less steep ones, such as the height of the base, do not count as walls
INSIDE = 1e-6  # [rad] constraints are kept by this much: geometry and symbolic forms differ by rounding
CORRECTIONS, CORRECTION = 20, 0.3  # Newton steps back inside, and the largest change of a joint in one


class ConstrainedAscent(PlanAscent):
    """The criterion of feasible plans (s, k, n), and how they climb without leaving the constraints."""

    def __init__(self, problem: DesignProblem, runs: int | None = None) -> None:
        super().__init__(problem, runs)
        self.walls = ConstraintDerivatives(problem, self.joints)
        self.firmness = 0.0
        self.steepness: Array = np.ones(())

    def rise(self, plans: Array) -> tuple[Array, Array]:
        """As of plans without constraints, less the penalty."""
        values, slopes = super().rise(plans)
        if self.firmness == 0.0:
            return values, slopes
        postures = plans.reshape(-1, plans.shape[-1])
        forces = self.firmness * np.maximum(0.0, INSIDE - self.walls.values(postures) / self.steepness)
        out = np.flatnonzero(forces.any(axis=1))
        back = np.zeros((len(postures), slopes.shape[-1]))
        back[out] = self.walls.slope(postures[out], forces[out] / self.steepness)
        penalties = np.sum(forces.reshape(len(plans), -1) ** 2, axis=1) / (2.0 * self.firmness)
        return values - penalties, slopes + back.reshape(slopes.shape)

    def __call__(self, plans: Array, tolerance: float = 1e-5, stop: Callable[[], bool] = IN_TIME) -> Array:
        """(s, k, n) feasible plans from feasible ones, climbed until steps gain less than `tolerance` (relative)."""
        postures = plans.reshape(-1, plans.shape[-1])
        self.firmness = 0.0
        slope = float(np.sqrt(np.mean(self.rise(plans)[1] ** 2)))
        steepness = np.sqrt(np.mean(np.sum(self.walls.first(postures)[1] ** 2, axis=2), axis=0))
        self.steepness = np.maximum(steepness, MOVES * steepness.max(initial=0.0))
        moved = plans
        for share in FIRMNESS if slope > 0.0 else ():
            self.firmness = share * slope
            moved = super().__call__(moved, tolerance * (1.0 if share == FIRMNESS[-1] else ROUGHLY), stop)
        inside = self.put_inside(moved.reshape(postures.shape))
        feasible = self.problem.feasible(inside)
        return np.where(feasible[:, None], inside, postures).reshape(plans.shape)

    def put_inside(self, postures: Array) -> Array:
        """(m, n) postures moved by as little as satisfies the constraints that are broken, most of them into all."""
        inside = np.array(postures)
        for _ in range(CORRECTIONS):
            values, slopes = self.walls.first(inside)
            missing = np.maximum(0.0, 2.0 * INSIDE - values / self.steepness)
            out = np.flatnonzero((missing > INSIDE).any(axis=1))
            if not len(out):
                break
            slopes = np.where(missing[out, :, None] > 0.0, slopes[out] / self.steepness[:, None], 0.0)
            steps = (np.linalg.pinv(slopes, rcond=1e-6) @ missing[out, :, None])[..., 0]
            steps *= np.minimum(1.0, CORRECTION / np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1e-300))
            moved = inside[out]
            moved[:, self.joints] += steps
            inside[out] = self.problem.clip(moved)
        return inside


def ascent(problem: DesignProblem, runs: int | None = None) -> PlanAscent:
    """How plans of the problem climb."""
    return ConstrainedAscent(problem, runs) if problem.constraints else PlanAscent(problem, runs)
