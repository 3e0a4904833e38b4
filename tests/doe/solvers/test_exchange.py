"""Exchange: its gains against direct evaluation, its ends against brute force."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest

from doe.bounds.certificate import Bound
from doe.criteria import D
from doe.solvers import Exchange, solve
from doe.solvers.solver import Budget
from identification.arm import Arm
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem


def test_determinant_lemma_is_direct_evaluation() -> None:
    generator = np.random.default_rng(0)
    root = generator.normal(size=(3, 9, 6))
    information = np.swapaxes(root, -1, -2) @ root
    for d in (2, 3):
        jacobians = generator.normal(size=(3, 11, d, 6))
        direct = np.linalg.slogdet(information[:, None] + np.swapaxes(jacobians, -1, -2) @ jacobians)[1]
        found = D().values_after_adding(information, jacobians) + np.linalg.slogdet(information)[1][:, None]
        np.testing.assert_allclose(found, direct, atol=1e-7)  # the ridge is 1e-9 of the mean eigenvalue


def test_no_single_exchange_improves_the_end() -> None:
    case = problem(FOUR, OFFSET)
    solver = Exchange(levels=5, batch=4)
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
    arm = Arm([200.0, 150.0, 90.0], np.radians([-180, -50, -70]), np.radians([180, 90, 60]))
    case = problem(arm)
    levels = Exchange(levels=5).grid(case)
    postures = np.array([[0.0, a, b] for a in levels[1] for b in levels[2]])
    every = np.array(list(combinations_with_replacement(range(25), 4)))
    jacobians = case.scaled_jacobians(postures)
    products = np.swapaxes(jacobians, -1, -2) @ jacobians
    best = np.linalg.slogdet(products[every].sum(axis=1) / 4)[1].max()
    design = solve(case, 4, Exchange(levels=5), starts=100)
    assert design.value == pytest.approx(best, abs=1e-12)


def test_limits_are_on_the_grid_and_kept() -> None:
    case = problem(FOUR, ECCENTRICITY)
    design = solve(case, 9, Exchange(levels=4), starts=20, bound=Bound(np.inf, "grid"))
    grid = np.linspace(case.lower, case.upper, 4)
    for joint in case.active_joints:
        assert np.all(np.isin(design.plan.postures[:, joint], grid[:, joint]))


def test_measured_postures_count() -> None:
    kept = np.tile((FOUR.lower + FOUR.upper) / 2, (10, 1))
    case = problem(FOUR, kept=kept)
    assert case.fewest_runs == 1  # 8 unknowns, 20 equations there: but all of one posture
    design = solve(case, 4, "exchange", starts=50, bound=Bound(np.inf, "grid"))
    jacobians = case.scaled_jacobians(np.vstack([design.plan.postures, kept])).reshape(28, 8)
    assert design.log_det == pytest.approx(np.linalg.slogdet(jacobians.T @ jacobians / 14)[1])


def test_single_link() -> None:
    assert solve(problem(Arm([100.0])), 1, "exchange").value == pytest.approx(0.0, abs=1e-12)
