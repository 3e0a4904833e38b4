"""Climbs under constraints: slopes with the penalty by differences, plans back inside, near what scipy reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from doe.plan.constrained_ascent import ConstrainedAscent, ascent
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from tests.doe.problem.test_spatial_constraints import ARM
from tests.doe.six_axis import SIX_AXIS, six_axis

STEP = 1e-6
WALLS = six_axis(ARM)  # box, sphere, pillar and line of sight
BOXED = six_axis(replace(SIX_AXIS, constraints=ARM.constraints[:1]))


def feasible_plans(problem: DesignProblem, plans: int, runs: int) -> Array:
    postures = random_postures(problem, plans * runs, np.random.default_rng(0))
    return postures.reshape(plans, runs, -1)


def test_slopes_of_the_penalty_by_finite_differences() -> None:
    climb = ConstrainedAscent(WALLS)
    climb.firmness, climb.steepness = 30.0, np.full(climb.walls.values(WALLS.lower[None]).shape[1], 500.0)
    plans = np.random.default_rng(3).uniform(WALLS.lower, WALLS.upper, (2, 12, 6))  # most of it outside
    values, slopes = climb.rise(plans)
    assert np.all(values < [WALLS.objective(plan) - 1.0 for plan in plans])
    for run, joint in ((0, 1), (5, 4), (11, 5)):
        step = np.zeros_like(plans)
        step[:, run, joint] = STEP
        differences = (climb.rise(plans + step)[0] - climb.rise(plans - step)[0]) / (2 * STEP)
        np.testing.assert_allclose(slopes[:, run, joint], differences, rtol=1e-4, atol=1e-3)


def test_plans_end_better_and_feasible() -> None:
    start, climb = feasible_plans(WALLS, 2, 12), ascent(WALLS)
    ended = climb(start, tolerance=1e-3)
    assert WALLS.feasible(ended).all()
    assert np.all((ended >= WALLS.lower) & (ended <= WALLS.upper))
    for before, after in zip(start, ended, strict=True):
        assert WALLS.objective(after) > WALLS.objective(before) + 1.0


def test_postures_outside_are_put_inside_by_little() -> None:
    climb = ConstrainedAscent(BOXED)
    climb.steepness = np.full(6, 500.0)
    inside = feasible_plans(BOXED, 1, 200)[0]
    pushed = BOXED.clip(inside + np.random.default_rng(1).normal(0.0, 0.05, inside.shape))
    assert not BOXED.feasible(pushed).all()
    back = climb.put_inside(pushed)
    assert BOXED.feasible(back).all()
    assert np.abs(back - pushed).max() < 0.5
    stayed = BOXED.feasible(pushed)
    np.testing.assert_array_equal(back[stayed], pushed[stayed])


def test_near_what_slsqp_reaches() -> None:
    """Ten runs in a box, from the same start: a method of another kind gains no more than a few percent more."""
    start, climb = feasible_plans(BOXED, 1, 10), ConstrainedAscent(BOXED)

    def fall(x: Array) -> tuple[float, Array]:
        value, slope = climb.rise(x.reshape(1, 10, 6))
        return -float(value[0]), -slope.ravel()

    def walls(x: Array) -> Array:
        return climb.walls.values(x.reshape(10, 6)).ravel() / 500.0

    limits = list(zip(np.tile(BOXED.lower, 10), np.tile(BOXED.upper, 10), strict=True))
    constraint = {"type": "ineq", "fun": walls}
    options = {"maxiter": 25}
    other = minimize(
        fall, start.ravel(), jac=True, method="SLSQP", bounds=limits, constraints=constraint, options=options
    )
    began, ended = BOXED.objective(start[0]), BOXED.objective(climb(start)[0])
    assert ended - began > 0.9 * (-other.fun - began)


def test_without_time_or_constraints() -> None:
    plans = feasible_plans(WALLS, 1, 12)
    np.testing.assert_allclose(ascent(WALLS)(plans, stop=lambda: True), plans, atol=1e-12)
    assert not isinstance(ascent(six_axis()), ConstrainedAscent)
