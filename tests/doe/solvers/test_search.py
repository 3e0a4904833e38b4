"""The driver: whatever a solver offers, the result is clipped, recomputed, certified and honest about how it ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from doe.bounds.certificate import Bound
from doe.solvers import Offer, solve
from doe.solvers.solving import AGREEMENT
from identification.errors import JobError
from identification.running import Status
from tests.doe.arms import FOUR, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det, factorial

GOOD = factorial(FOUR, offset=False)
POOR = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (8, 4))


@dataclass
class Scripted:
    """A solver that offers what it is told to; a `BaseException` in the script is raised."""

    script: list[Any]
    name: str = "scripted"
    taken: int = field(default=0)

    def starts_for(self, problem: object) -> int:
        return 100

    def offers(self, *_: object) -> Iterator[Offer]:
        for entry in self.script:
            self.taken += 1
            if isinstance(entry, BaseException):
                raise entry
            yield entry


def test_clips_and_recomputes() -> None:
    beyond = GOOD + 1e-8 * np.sign(GOOD)
    design = solve(problem(FOUR), 8, Scripted([Offer(POOR, 1), Offer(beyond, 1)]))
    postures = design.plan.postures
    assert np.all(postures >= FOUR.lower)
    assert np.all(postures <= FOUR.upper)
    assert design.value == pytest.approx(complex_log_det(postures), abs=1e-12)
    assert design.value <= -0.0612353258  # a plan outside the limits would be better
    assert design.certified_optimal


def test_keeps_the_best_and_stops_at_the_bound() -> None:
    solver = Scripted([Offer(POOR, 1), Offer(GOOD, 1), Offer(POOR, 1)])
    design = solve(problem(FOUR), 8, solver)
    assert solver.taken == 2
    assert (design.status, design.starts) == (Status.bound_reached, 2)
    np.testing.assert_array_equal(design.plan.postures[:, 1:], problem(FOUR).clip(GOOD)[:, 1:])


def test_stops_when_independent_starts_agree_unless_a_number_is_asked_for() -> None:
    offers = [Offer(POOR, 1, independent=True)] * 50
    assert solve(problem(FOUR), 8, Scripted(offers)).status is Status.agreed
    assert solve(problem(FOUR), 8, Scripted(offers)).starts == AGREEMENT
    assert solve(problem(FOUR), 8, Scripted(offers), starts=50).starts == 50
    assert solve(problem(FOUR), 8, Scripted([Offer(POOR, 1)] * 50)).status is Status.starts_finished


def test_ctrl_c_returns_the_best_so_far() -> None:
    design = solve(problem(FOUR), 8, Scripted([Offer(POOR, 1), KeyboardInterrupt()]))
    assert design.status is Status.interrupted
    assert design.value == pytest.approx(complex_log_det(POOR))


def test_ctrl_c_before_the_first_plan() -> None:
    with pytest.raises(KeyboardInterrupt):
        solve(problem(FOUR), 8, Scripted([KeyboardInterrupt()]))


def test_time_limit() -> None:
    design = solve(problem(FOUR), 8, Scripted([Offer(POOR, 1)] * 10), seconds=1e-9)
    assert (design.status, design.starts) == (Status.time_limit, 1)


def test_a_solver_without_a_useful_plan() -> None:
    singular = Offer(np.zeros((8, 4)), 1)
    with pytest.raises(JobError, match="no plan that identifies all 8 parameters"):
        solve(problem(FOUR), 8, Scripted([singular]))
    assert solve(problem(FOUR), 8, Scripted([singular]), throw=False).value == -np.inf
    with pytest.raises(JobError, match="scripted"):
        solve(problem(FOUR), 8, Scripted([]), throw=False)


def test_a_plan_that_breaks_the_minimum_distance_is_no_result() -> None:
    crowded = Scripted([Offer(np.random.default_rng(0).uniform(-0.1, 0.1, (12, 4)), 1)])  # tells all
    apart = replace(problem(FOUR), minimum_distance=2.0)  # just 12 fit into the limits
    with pytest.raises(JobError, match=r"postures 114.592 deg apart was found by scripted"):
        solve(apart, 12, crowded)


def test_a_bound_may_be_given() -> None:
    value = complex_log_det(POOR)
    design = solve(problem(FOUR), 8, Scripted([Offer(POOR, 1)] * 3), bound=Bound(value, "continuous"))
    assert design.status is Status.bound_reached
    assert design.bound is not None
    assert design.bound.source == "continuous"
