"""A design that is better than its numerical bound shows that the bound is wrong: it is never reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe import DesignProblem, solve
from doe.bounds.best_known import bound_that_holds
from doe.bounds.bound import Bound
from doe.bounds.planar_theorem import closed_form_log_det
from identification.arm import Arm, EffectSpec
from identification.model import Model

BOX = Arm([300.0, 200.0, 150.0], lower=np.radians([-180, -120, -100]), upper=np.radians([180, 60, 90]), sigma=0.1)


def test_a_bound_that_is_beaten_is_found_again_and_equals_the_closed_form() -> None:
    problem = DesignProblem.of(Model(BOX))
    design = solve(problem, 12, seed=1)
    wrong = Bound(design.value - 0.1, "continuous")
    assert replace(design, bound=wrong).efficiency > 1.0
    bound = bound_that_holds(problem, wrong, design.plan.postures, design.value)
    assert bound is not None
    assert bound.value == pytest.approx(closed_form_log_det(problem), abs=1e-6)
    assert bound.value >= design.value - 1e-9


def test_a_bound_that_holds_is_kept() -> None:
    problem = DesignProblem.of(Model(BOX))
    design = solve(problem, 12, seed=1)
    for bound in (design.bound, None):
        assert bound_that_holds(problem, bound, design.plan.postures, design.value) is bound


def test_with_a_fast_ripple_no_design_is_better_than_its_bound() -> None:
    """Nor is an approximate one: the multiplicative algorithm on 2,000 random postures, w <- w d / p in plain numpy."""
    problem = DesignProblem.of(Model(BOX.with_effects(EffectSpec("transmission_ripple", 2, {"k": 23.0}))))
    design = solve(problem, 12, seed=1, starts=10)
    assert design.bound is not None
    assert design.bound.source == "continuous"
    assert design.value <= design.bound.value
    blocks = problem.blocks(np.random.default_rng(0).uniform(BOX.lower, BOX.upper, (2000, 3)))
    weights = np.full(2000, 1.0 / 2000.0)
    for _ in range(200):
        information = np.einsum("k,kda,kdb->ab", weights, blocks, blocks, optimize=True)
        weights *= np.einsum("kda,ab,kdb->k", blocks, np.linalg.inv(information), blocks, optimize=True) / 8.0
    assert np.sum(weights) == pytest.approx(1.0)
    # the algorithm ends below the best weights, and random postures miss the best angles: 4 % of D-efficiency at most
    assert design.bound.value - 0.32 <= np.linalg.slogdet(information)[1] <= design.bound.value
