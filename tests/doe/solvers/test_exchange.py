"""Exchange: its gains against direct evaluation, its ends against brute force."""

from dataclasses import replace
from itertools import combinations, combinations_with_replacement

import numpy as np
import pytest

from doe.bounds.certificate import Bound
from doe.problem.problem import random_postures
from doe.solvers import Exchange, solve
from doe.solvers.solver import Budget
from identification import Arm, InputError
from identification.workspace import KeepOut, WorkspaceBox
from tests.doe.arms import FOUR, OFFSET, problem
from tests.doe.problem.test_spatial_constraints import BOX, SIGHT
from tests.doe.six_axis import LIMITED, SIX_AXIS, difference_information, six_axis


def test_no_single_exchange_improves_the_end() -> None:
    case = problem(FOUR, OFFSET)
    solver = Exchange(levels=5, batch=4, climb=False)
    offers = solver.offers(case, 6, np.random.default_rng(1), Budget(4))
    ends = (offer for offer in offers if offer.independent)
    grid = solver.grid(case)
    for _, offer in zip(range(4), ends, strict=False):
        value = case.objective(offer.postures)
        for run in range(6):
            for joint in range(4):
                for angle in grid[joint]:
                    other = np.array(offer.postures)
                    other[run, joint] = angle
                    assert case.objective(other) <= value + 1e-8


def test_finds_the_best_of_all_grid_plans() -> None:
    case = problem(Arm([200.0, 150.0, 90.0], np.radians([-180, -50, -70]), np.radians([180, 90, 60])))
    levels = Exchange(levels=5).grid(case)
    postures = np.array([[0.0, a, b] for a in levels[1] for b in levels[2]])
    every = np.array(list(combinations_with_replacement(range(25), 4)))
    jacobians = case.scaled_jacobians(postures)
    best = np.linalg.slogdet((np.swapaxes(jacobians, -1, -2) @ jacobians)[every].sum(axis=1) / 4)[1].max()
    assert solve(case, 4, Exchange(levels=5, climb=False), starts=100).value == pytest.approx(best, abs=1e-12)


def test_few_starts_end_exactly_at_an_optimal_plan_of_the_grid() -> None:
    """Starts on it do; a climb from anywhere ends within some 1e-7."""
    lower, upper = np.radians([[-180.0, -120.0, -100.0], [180.0, 120.0, 60.0]])
    design = solve(problem(Arm([260.0, 180.0, 120.0], lower, upper)), 8, "exchange", starts=4)
    assert design.value == pytest.approx(4.0 * np.log(np.sin(np.radians(80.0))), abs=1e-12)


# -- of a list ---------------------------------------------------------------------------------------------------------
LIST = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (18, 4))


@pytest.mark.parametrize(("runs", "kept"), [(5, 0), (3, 4)])
def test_best_of_all_subsets(runs: int, kept: int) -> None:
    """Of a list, alone and around measured postures."""
    case = problem(FOUR, choices=LIST, kept=LIST[:kept])
    jacobians = case.scaled_jacobians(LIST)
    products = np.swapaxes(jacobians, -1, -2) @ jacobians
    every = np.array(list(combinations(range(18), runs)))
    values = np.linalg.slogdet((products[every].sum(axis=1) + products[:kept].sum(axis=0)) / (runs + kept))[1]
    design = solve(case, runs)
    assert design.value == pytest.approx(values.max(), abs=1e-12)
    assert sorted(map(tuple, design.plan.postures)) == sorted(map(tuple, LIST[every[values.argmax()]]))
    assert design.bound.source == "grid"
    assert design.bound.value >= values.max() - 1e-12


def test_repeats_only_when_asked_for() -> None:
    few = LIST[:6]
    assert len(np.unique(solve(problem(FOUR, choices=few), 6).plan.postures, axis=0)) == 6
    assert len(solve(problem(FOUR, choices=few, minimum_distance=0.0), 12).plan) == 12
    with pytest.raises(InputError, match=r"runs: found 12, allowed: up to 6, the different postures"):
        solve(problem(FOUR, choices=np.vstack([few, few])), 12)


def test_choices_outside_the_limits_are_not_chosen() -> None:
    beyond = np.array(LIST)
    beyond[:5, 1] = np.radians(150.0)
    assert np.all(solve(problem(FOUR, OFFSET, choices=beyond), 8).plan.postures <= FOUR.upper)


def test_bad_input() -> None:
    with pytest.raises(InputError, match="ipopt cannot choose from a list"):
        solve(problem(FOUR, choices=LIST), 6, "ipopt")
    with pytest.raises(InputError, match=r"allowed: \(k, 4\)"):
        solve(problem(FOUR, choices=LIST[:, :3]), 6)


# -- with climbs on gradients ------------------------------------------------------------------------------------------
NONE = Bound(np.inf, "continuous")


def test_the_bound_is_nearly_reached_by_thirty_runs() -> None:
    """Six axes, one reflector; 0.995 is the aim, and a random plan has 0.87."""
    problem = six_axis()
    design = solve(problem, 30, starts=2, seed=2)
    assert design.solver == "exchange"
    assert 0.999 < design.efficiency <= 1.0
    expected = difference_information(problem, problem.model, design.plan.postures)  # type: ignore[arg-type]
    assert design.value == pytest.approx(np.linalg.slogdet(expected)[1], abs=1e-3)
    plain = np.random.default_rng(4).uniform(problem.lower, problem.upper, (20, 30, 6))
    assert max(problem.objective(plan) for plan in plain) < design.bound.value - 39 * 0.05


def test_a_feasible_plan_better_than_the_best_list() -> None:
    """A box and a tracker that must see the reflector: exchanges on a list of 1,000 feasible postures fall short."""
    problem = six_axis(replace(SIX_AXIS, constraints=(BOX, SIGHT)))
    design = solve(problem, 12, starts=2, bound=NONE)
    assert (design.solver, design.missed) == ("exchange", {})
    assert problem.feasible(design.plan.postures).all()
    choices = random_postures(problem, 1000, np.random.default_rng(1))
    chosen = solve(replace(problem, choices=choices), 12, starts=2, bound=NONE)
    # four seeds of the climb reach 0.978 to 1.004 of the list's best weights, the best exchange on the list 0.902
    assert problem.criterion.efficiency(chosen.value, design.value, problem.parameters) < 0.96


def test_a_search_where_hardly_any_posture_is_allowed_ends_in_a_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between narrow walls the same few postures are drawn again and again: fewer than runs."""
    case = six_axis(replace(LIMITED, constraints=(BOX,)))
    few = random_postures(case, 4, np.random.default_rng(0))
    monkeypatch.setattr("doe.solvers.exchange.random_postures", lambda _, count, __: np.resize(few, (count, 6)))
    design = solve(case, 14, "exchange", starts=1, bound=Bound(np.inf, "continuous"))
    assert case.feasible(design.plan.postures).all()
    assert len(np.unique(design.plan.postures, axis=0)) == 14


@pytest.mark.parametrize("distance", [np.radians(1.0), 0.0])
def test_what_constraints_leave_need_not_be_on_a_grid(distance: float) -> None:
    """Of 81 postures on a grid of 9 levels a box leaves some of one angle of the second joint, which tell nothing."""
    limits = np.radians([[-178.4, -66.8], [91.8, 138.5]])
    walls = (WorkspaceBox((-79.3, 280.4), (-205.6, 286.4)), KeepOut((160.3, 46.8), 27.1))
    narrow = problem(Arm([374.3, 168.0], *limits, sigma=0.1, constraints=walls), minimum_distance=distance)
    design = solve(narrow, 6, "exchange", starts=20)
    assert narrow.feasible(design.plan.postures).all()
    assert design.efficiency is not None
    assert design.efficiency > 0.7  # of the bound; begun on the grid 0.1, or no plan at all
