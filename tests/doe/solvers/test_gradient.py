"""Climbs on gradients with exchanges between them: near the bound, as good as what takes minutes, honest limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.bounds.certificate import Bound
from doe.problem.postures import random_postures
from doe.solvers import Fedorov, Gradient, solve
from doe.solvers.exchange import exchanged
from doe.solvers.solver import Budget
from tests.doe.problem.test_spatial_constraints import BOX, SIGHT
from tests.doe.six_axis import LIMITED, SIX_AXIS, difference_information, six_axis

NONE = Bound(np.inf, "continuous")


def test_the_bound_is_nearly_reached_by_thirty_runs() -> None:
    """Six axes, one reflector; 0.995 is the aim, and a random plan has 0.87."""
    problem = six_axis()
    design = solve(problem, 30, Gradient(count=2), seed=2)
    assert design.solver == "gradient"
    assert design.efficiency is not None
    assert 0.999 < design.efficiency <= 1.0
    expected = difference_information(problem, problem.model, design.plan.postures)  # type: ignore[arg-type]
    assert design.value == pytest.approx(np.linalg.slogdet(expected)[1], abs=1e-3)
    assert design.bound is not None
    plain = np.random.default_rng(4).uniform(problem.lower, problem.upper, (20, 30, 6))
    assert max(problem.objective(plan) for plan in plain) < design.bound.value - 39 * 0.05


def test_exchanges_between_climbed_plans_help() -> None:
    problem = six_axis(LIMITED)
    one, two = (solve(problem, 20, Gradient(batch=5), starts=n, seed=3, bound=NONE).value for n in (5, 10))
    assert two > one


def test_it_is_the_default_for_many_parameters() -> None:
    design = solve(six_axis(LIMITED), 12, starts=2, bound=NONE)
    assert (design.solver, design.starts) == ("gradient", 2)


def test_exchanged_plans_are_of_the_pool() -> None:
    problem = six_axis()
    generator = np.random.default_rng(0)
    pool = generator.uniform(problem.lower, problem.upper, (40, 6))
    plans = exchanged(problem, pool, (2, 12), generator, Budget(2))
    rows = {tuple(row) for row in pool}
    for plan in plans:
        assert {tuple(row) for row in plan} <= rows
        assert len({tuple(row) for row in plan}) == 12
        assert problem.objective(plan) > problem.objective(pool[:12])


def test_a_feasible_plan_better_than_the_best_list() -> None:
    """A box and a tracker that must see the reflector: exchanges on a list of 1,000 feasible postures fall short."""
    arm = replace(SIX_AXIS, constraints=(BOX, SIGHT))
    problem = six_axis(arm)
    design = solve(problem, 12, starts=4, bound=NONE)
    assert (design.solver, design.outside) == ("gradient", ())
    assert problem.feasible(design.plan.postures).all()
    choices = random_postures(problem, 1000, np.random.default_rng(1))
    chosen = solve(replace(problem, choices=choices), 12, Fedorov(), bound=NONE)
    # four seeds of the climb reach 0.978 to 1.004 of the list's best weights, the best exchange on the list 0.902
    assert problem.criterion.efficiency(chosen.value, design.value, problem.parameters) < 0.96
