"""The climb: exact derivatives, never downhill, never outside, and up to the walls of constraints."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from doe.bounds.column_generation import ContinuousSet, distinct
from doe.problem.postures import random_postures
from doe.problem.problem import PriorInformation
from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.workspace import KeepOutCircle, LineOfSight, WorkspaceBox
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem

BOXED = Arm(FOUR.lengths, FOUR.lower, FOUR.upper, 0.1, constraints=(WorkspaceBox((-400.0, 600.0), (0.0, 650.0)),))
WALLED = Arm(
    FOUR.lengths, FOUR.lower, FOUR.upper, 0.1,
    constraints=(
        WorkspaceBox((-400.0, 600.0), (0.0, 650.0)),
        KeepOutCircle((350.0, 200.0), 60.0),
        LineOfSight((1500.0, 300.0), np.radians(25.0), (0.0, 200.0)),
    ),
)  # fmt: skip
CASES = {
    "base": problem(FOUR),
    "five links, effects": problem(FIVE, OFFSET, EffectSpec("gear_ratio", 3)),
    "walls": problem(WALLED, OFFSET, ECCENTRICITY),
}


def some_gradient(case, generator: np.random.Generator) -> Array:  # type: ignore[no-untyped-def]
    """M^-1 of a random design."""
    postures = generator.uniform(case.lower, case.upper, (3 * case.parameters, case.joints))
    return np.linalg.inv(case.information(postures))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_slopes_by_finite_differences(case) -> None:  # type: ignore[no-untyped-def]
    generator = np.random.default_rng(0)
    everything = ContinuousSet(case, PriorInformation(np.eye(case.parameters), 0.4))
    gradient = some_gradient(case, generator)
    q = generator.uniform(case.lower, case.upper, (5, case.joints))
    slope, hessian = everything.slopes(q, gradient)
    h = 1e-5
    for joint, e in enumerate(np.eye(case.joints)):
        up, down = (everything.sensitivities(q + s * h * e, gradient) for s in (1, -1))
        assert slope[:, joint] == pytest.approx((up - down) / (2 * h), rel=1e-6, abs=1e-6 * np.abs(slope).max())
        up, down = (everything.slopes(q + s * h * e, gradient)[0] for s in (1, -1))
        assert hessian[:, joint] == pytest.approx((up - down) / (2 * h), rel=1e-6, abs=1e-6 * np.abs(hessian).max())


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_climbs_within_the_set(case) -> None:  # type: ignore[no-untyped-def]
    generator = np.random.default_rng(1)
    everything = ContinuousSet(case, PriorInformation())
    gradient = some_gradient(case, generator)
    starts = random_postures(case, 50, generator)
    ends = everything.climb(starts, gradient)
    assert np.all((ends >= case.lower) & (ends <= case.upper))
    assert case.feasible(ends).all()
    before, after = (everything.sensitivities(q, gradient) for q in (starts, ends))
    assert after.max() >= before.max()
    if not case.constraints:
        assert np.all(after >= before)


def test_nothing_higher_within_limits_by_scipy() -> None:
    """L-BFGS-B from 100 random starts does not find a higher sensitivity."""
    case = problem(FOUR, OFFSET, ECCENTRICITY)
    generator = np.random.default_rng(2)
    everything, gradient = ContinuousSet(case, PriorInformation()), some_gradient(case, generator)
    best = everything.best(gradient, np.empty((0, 4)))[1][0]
    limits = list(zip(case.lower, case.upper, strict=True))
    for start in generator.uniform(case.lower, case.upper, (100, 4)):
        found = minimize(
            lambda q: -everything.sensitivities(q[None], gradient)[0],
            start, jac=lambda q: -everything.slopes(q[None], gradient)[0][0], method="L-BFGS-B", bounds=limits,
        )  # fmt: skip
        assert -found.fun <= best + 1e-8


def test_nothing_higher_within_walls_by_scipy() -> None:
    """Nor does SLSQP under the constraints."""
    case = problem(BOXED, OFFSET, ECCENTRICITY)
    generator = np.random.default_rng(3)
    everything, gradient = ContinuousSet(case, PriorInformation()), some_gradient(case, generator)
    best = everything.best(gradient, np.empty((0, 4)), generator)[1][0]
    walls = {"type": "ineq", "fun": lambda q: case.constraints[0].margin(q[None])[0] / 100.0}
    for start in random_postures(case, 40, generator):
        found = minimize(
            lambda q: -everything.sensitivities(q[None], gradient)[0],
            start, jac=lambda q: -everything.slopes(q[None], gradient)[0][0], method="SLSQP",
            bounds=list(zip(case.lower, case.upper, strict=True)), constraints=[walls],
        )  # fmt: skip
        if case.constraints[0].margin(case.clip(found.x)[None]).min() >= 0.0:
            assert everything.sensitivities(case.clip(found.x)[None], gradient)[0] <= best + 1e-6


def test_distinct_keeps_the_first_of_each() -> None:
    postures = np.array([[0.0, 0.0], [1.0, 0.0], [1e-9, 0.0], [1.0, 0.2], [0.0, 0.0]])
    assert distinct(postures).tolist() == [0, 1, 3]
    assert distinct(postures, 0.5).tolist() == [0, 1]
