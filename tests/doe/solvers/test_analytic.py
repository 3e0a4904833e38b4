"""Plans from theory attain the bound: checked by complex arithmetic, limits by comparison."""

from __future__ import annotations

import numpy as np
import pytest

from doe.closed_form import closed_form_log_det
from doe.solvers import Analytic, Random, solve
from doe.solvers.base import Budget
from identification.arm import Arm
from identification.errors import JobError
from identification.status import Status
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, SIX, problem
from tests.doe.test_closed_form import complex_log_det


@pytest.mark.parametrize("links", range(2, 9))
def test_without_limits_any_number_of_runs_is_optimal_without_a_solver(links: int) -> None:
    arm = Arm(np.full(links, 100.0))
    for runs in range(links, 3 * links + 1):
        design = solve(problem(arm), runs, seed=runs)
        assert design.solver == "analytic"
        assert abs(complex_log_det(design.plan.postures)) < 1e-8  # the bar
        assert design.certified_optimal
    for runs in (links + 1, 3 * links):
        with_offset = solve(problem(arm, OFFSET), runs)
        assert abs(complex_log_det(with_offset.plan.postures, offset=True)) < 1e-8


@pytest.mark.parametrize(("arm", "runs"), [(FOUR, 8), (FOUR, 12), (FOUR, 16), (FIVE, 16), (SIX, 32), (SIX, 64)])
def test_with_limits(arm: Arm, runs: int) -> None:
    offers = Analytic().offers(problem(arm), runs, np.random.default_rng(0), Budget(5))
    for _, offer in zip(range(5), offers, strict=False):
        assert np.all(offer.postures >= arm.lower)
        assert np.all(offer.postures <= arm.upper)
        assert complex_log_det(offer.postures) == pytest.approx(closed_form_log_det(problem(arm)), abs=1e-12)


def test_frequencies_phases_and_order_are_random() -> None:
    case = problem(Arm(FOUR.lengths))
    plans = [solve(case, 13, seed=seed).plan.postures for seed in (0, 1)]
    assert np.ptp(np.diff(plans[0], axis=0), axis=0).min() > 0.1  # not the plain ordered plan, whose steps are equal
    assert not np.allclose(np.sort(plans[0], axis=0), np.sort(plans[1], axis=0))
    assert np.array_equal(plans[0], solve(case, 13, seed=0).plan.postures)


def test_first_joint_is_spread_over_its_limits_in_shuffled_order() -> None:
    first = solve(problem(FOUR), 8).plan.postures[:, 0]
    np.testing.assert_allclose(np.sort(first), np.radians(np.arange(-180 + 22.5, 180, 45)))
    assert np.any(np.diff(first) < 0)


@pytest.mark.parametrize("arm", [SIX, FIVE])
def test_none_where_the_number_of_runs_does_not_allow_it(arm: Arm) -> None:
    with pytest.raises(JobError, match="analytic"):
        solve(problem(arm), 13, "analytic")


def test_none_for_models_without_the_theorem() -> None:
    with pytest.raises(JobError, match="analytic"):
        solve(problem(Arm(FOUR.lengths), ECCENTRICITY), 20, Analytic())


def test_random_is_no_rival() -> None:
    """The same interface, the same certificate: a random plan is worth less, and says by how much."""
    design = solve(problem(FOUR), 8, Random())
    best = solve(problem(FOUR), 8, "best_of_random")
    assert design.status is Status.starts_finished
    assert best.starts == 1000
    assert design.value < best.value < closed_form_log_det(problem(FOUR))
