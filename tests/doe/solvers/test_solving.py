"""The door: the same seed gives the same plan, and what is no problem, plan or solver is refused."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from doe import DesignProblem, score_plan
from doe.bounds.certificate import Bound
from doe.criteria import A, Criterion, Ds, DStar, E, I
from doe.plan.accuracy import with_choices
from doe.solvers import Offer, Random, solve
from doe.solvers.solving import AGREEMENT, SOLVERS, available_solvers
from identification import Arm, DHRow, EffectSpec, InputError, JobError, Plan, Progress, Status, chain_of
from tests.doe.arms import FIVE, FOUR, OFFSET, SIX, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det, factorial


@pytest.mark.parametrize("solver", [None, "exchange", "ipopt", "random", "analytic"])
def test_same_seed_same_plan(solver: str | None) -> None:
    runs = 8 if solver == "analytic" else 6
    told = list[str]()
    progress = Progress(lambda done, total, message: told.append(message))
    plans = [solve(problem(FOUR), runs, solver, seed=s, starts=4, progress=progress).plan.postures for s in (3, 3, 4)]
    assert solver in ("random", "analytic") or len(told) > 3 * 10  # while a start goes on, too
    np.testing.assert_array_equal(plans[0], plans[1])
    assert not np.array_equal(plans[0], plans[2])


def test_bad_input() -> None:
    with pytest.raises(InputError, match=r"runs: 3 with 8 parameters.*at least 4"):
        solve(problem(FOUR), 3)
    with pytest.raises(InputError, match="at least 5"):
        solve(problem(FOUR, OFFSET), 4)
    for runs in (8.0, "8", None, True):
        with pytest.raises(InputError, match=r"runs: .*allowed: a whole number"):
            solve(problem(FOUR), runs)
    with pytest.raises(InputError, match=r"found Arm, allowed: a DesignProblem"):
        solve(FOUR, 8)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="did you mean 'ipopt'"):
        solve(problem(FIVE), 8, "ipot")


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (np.where(np.arange(32).reshape(8, 4) == 9, np.nan, 1.0), "run 3 is not finite"),
        (np.ones((8, 3)), r"shape \(8, 3\), allowed: \(m, 4\)"),
        ([[1.0, 2.0], [3.0]], "allowed: an array"),
        ("plan.csv", "'plan.csv', allowed: an array"),
        *((Plan(np.ones((4, 4)), np.array(w)), f"{len(w)} weights of") for w in ([0.2] * 4, [0.5] * 2, [2, -1, 0, 0])),
    ],
)
def test_what_is_no_plan_is_not_scored(plan: Any, expected: str) -> None:
    with pytest.raises(InputError, match=f"plan: .*{expected}"):
        score_plan(problem(FOUR), plan)


# -- the search --------------------------------------------------------------------------------------------------------
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
    solver = Scripted([Offer(POOR, 1), Offer(GOOD + 1e-8 * np.sign(GOOD), 1), Offer(POOR, 1)])
    design = solve(problem(FOUR), 8, solver)
    assert (design.status, design.starts, solver.taken) == (Status.bound_reached, 2, 2)
    postures = design.plan.postures
    assert np.all(postures >= FOUR.lower)
    assert np.all(postures <= FOUR.upper)
    assert design.value == pytest.approx(complex_log_det(postures), abs=1e-12)
    assert design.value <= -0.0612353258  # a plan outside the limits would be better
    assert design.certified_optimal


def test_stops_when_independent_starts_agree_unless_a_number_is_asked_for() -> None:
    offers = [Offer(POOR, 1, independent=True)] * 50
    assert solve(problem(FOUR), 8, Scripted(offers)).status is Status.agreed
    assert solve(problem(FOUR), 8, Scripted(offers)).starts == AGREEMENT
    assert solve(problem(FOUR), 8, Scripted(offers), starts=50).starts == 50
    assert solve(problem(FOUR), 8, Scripted([Offer(POOR, 1)] * 50)).status is Status.starts_finished


GIVEN, NEAR = (Bound(complex_log_det(POOR) + above, "continuous") for above in (0.0, 4e-6))


@pytest.mark.parametrize(
    ("script", "options", "status", "starts"),
    [
        ([Offer(POOR, 1), KeyboardInterrupt()], {}, Status.interrupted, 1),
        ([Offer(POOR, 1)] * 10, {"seconds": 1e-9}, Status.time_limit, 1),
        ([Offer(POOR, 1)] * 3, {"bound": GIVEN}, Status.bound_reached, 1),
        # certified at the end of the search: more starts are of no use
        ([Offer(POOR, 1)] * 3, {"bound": NEAR, "starts": 3}, Status.bound_reached, 3),
    ],
)
def test_a_search_that_ends_early_has_the_best_so_far(
    monkeypatch: pytest.MonkeyPatch, script: list[Any], options: dict[str, Any], status: Status, starts: int
) -> None:
    design = solve(problem(FOUR), 8, Scripted(script), **options)
    assert (design.status, design.starts) == (status, starts)
    assert design.value == pytest.approx(complex_log_det(POOR))
    assert "bound" not in options or design.bound.source == "continuous"
    many = problem(
        FOUR, *(EffectSpec(name, j) for name in ("encoder_eccentricity", "gear_ratio") for j in (1, 2, 3, 4))
    )
    plan = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (12, 4))
    bound = solve(many, 12, Scripted([Offer(plan, 1), KeyboardInterrupt()])).bound
    assert bound is not None
    assert bound.cut  # who stops the search does not wait for it
    with pytest.raises(KeyboardInterrupt):  # before the first plan there is none
        solve(problem(FOUR), 8, Scripted([KeyboardInterrupt()]))
    monkeypatch.setattr("doe.solvers.solving.best_known_bound", Mock(side_effect=KeyboardInterrupt))
    design = solve(many, 12, Scripted([Offer(plan, 1)]))  # stopped after the search, there is a plan
    assert (design.status, design.bound) == (Status.interrupted, None)


def test_a_solver_without_a_useful_plan() -> None:
    offered = {"no plan that identifies all 8 parameters": [Offer(np.zeros((8, 4)), 1)], "scripted": []}
    offered[r"scripted offers postures of shape \(7, 4\), allowed: \(8, 4\)"] = [Offer(POOR[:7], 1)]
    for said, offers in offered.items():
        with pytest.raises(JobError, match=said):
            solve(problem(FOUR), 8, Scripted(offers))


def test_a_plan_that_breaks_the_minimum_distance_is_no_result() -> None:
    crowded = Scripted([Offer(np.random.default_rng(0).uniform(-0.1, 0.1, (12, 4)), 1)])  # tells all
    apart = replace(problem(FOUR), minimum_distance=2.0)  # just 12 fit into the limits
    with pytest.raises(JobError, match=r"postures 114.592 deg apart was found by scripted; armcal design --repeats"):
        solve(apart, 12, crowded)


# -- what cannot be solved ---------------------------------------------------------------------------------------------
def test_what_no_posture_tells_apart_is_named() -> None:
    lost = {"base_rotation": r"joint_offset:1 \+ base_rotation.angle", "base_drift": "base_drift.vx; base_drift.vy"}
    for name, combination in lost.items():
        with pytest.raises(JobError, match=f"no posture distinguishes: {combination}"):
            solve(problem(FOUR, EffectSpec(name)), 12, "random")


def test_candidates_that_cannot_identify_are_no_plan() -> None:
    """One posture gives two equations; det M is 0 but for rounding, whatever the angles."""
    for posture in ([0.0, 0.0, 0.0, 0.0], [0.3, 0.7, -0.5, 0.2]):
        case = problem(FOUR, choices=np.array([posture]), minimum_distance=0.0)
        with pytest.raises(JobError, match="1 candidates cannot identify all 8 parameters"):
            solve(case, 8, starts=5)


@pytest.mark.filterwarnings("ignore:tool. the place of the measured point is not known")
def test_a_scara_whose_height_no_posture_tells_is_asked_for_its_tool() -> None:
    table = [DHRow(325.0, 0.0, 400.0), DHRow(275.0, np.pi, 0.0), DHRow(0.0, 0.0, 20.0), DHRow(0.0, 0.0, 30.0)]
    scara = DesignProblem.of(Arm(chain_of(table), sigma=0.02))
    for case, solver in ((scara, Scripted([])), (with_choices(scara), "exchange")):  # of a search none hears of it
        with pytest.raises(JobError, match=r"base.z - tool\[1\].z; add \[tool\] or \[base\] to the arm file"):
            solve(case, 16, solver, seconds=0.1)


# -- solvers by name ---------------------------------------------------------------------------------------------------
pytestmark = pytest.mark.filterwarnings("ignore:armcal.solvers of installed packages")


@pytest.mark.parametrize(
    ("value", "broken"),
    [
        ("doe.solvers.solving:Random", ""),
        ("no_such_package_at_all:Mine", "No module named"),
        ("math:pi", "a solver with offers"),
        ("math:tau2", "tau2"),
    ],
)
def test_solvers_of_installed_packages(monkeypatch: pytest.MonkeyPatch, value: str, broken: str) -> None:
    """A class is called without arguments; one that is broken is named."""
    point = EntryPoint("mine", value, "armcal.solvers")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == "armcal.solvers" else [])
    available_solvers.cache_clear()
    try:
        with pytest.raises(InputError, match=f"mine = {value}.*{broken}") if broken else nullcontext():
            assert available_solvers() == {**SOLVERS, "mine": Random()}
    finally:
        available_solvers.cache_clear()


# -- the best values known ---------------------------------------------------------------------------------------------
KNOWN = [
    (FOUR, 5, -0.28087), (FOUR, 6, -0.29680), (FOUR, 7, -0.19865), (FOUR, 9, -0.13103), (FOUR, 10, -0.14288),
    (FOUR, 14, -0.10247), (FOUR, 18, -0.08608), (FIVE, 5, -1.358410), (FIVE, 8, -0.704661), (FIVE, 11, -0.830502),
    (FIVE, 16, -0.704178), (SIX, 12, -1.433950), (SIX, 20, -1.3515), (SIX, 32, -1.2994579),
]  # fmt: skip
WITHIN_A_SECOND = {(4, 9), (4, 14), (6, 32)}  # links, runs


@pytest.mark.parametrize(
    ("arm", "runs", "value"),
    [pytest.param(*row, marks=() if (row[0].links, row[1]) in WITHIN_A_SECOND else pytest.mark.slow) for row in KNOWN],
)
def test_best_known_values(arm: Arm, runs: int, value: float) -> None:
    """At least the best value known, to the digits it is printed with (doe/README.md, "Exact plans").

    Fewer starts than the default find it or not by the last digit of a processor: no test asks for it.
    """
    assert complex_log_det(solve(problem(arm), runs).plan.postures) >= value - (1e-5 if arm is FOUR else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_six_links_eight_runs(seed: int) -> None:
    """The hardest of the table: few of the starts lead there."""
    assert complex_log_det(solve(problem(SIX), 8, seed=seed).plan.postures) >= -1.624468


# -- other criteria ----------------------------------------------------------------------------------------------------
SEARCHED = 1e-7  # plans whose values differ by less are the same to the solver (`AGREES` in doe/solvers/solving.py)
POSES = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (20, 4))
CASES = {
    "A": A(), "E": E(), "I": I(problem(FOUR).scaled_jacobians(POSES)), "Ds": Ds((0, 1, 2, 3)),
    "Dstar": DStar(((0, 1, 2, 3), (4, 5, 6, 7))),
}  # fmt: skip


@pytest.mark.parametrize("criterion", CASES.values(), ids=CASES)
def test_twenty_runs_are_near_the_bound(criterion: Criterion) -> None:
    """With m = 20 >> p exact plans are within a percent of the approximate optimum, and above a D-optimal plan."""
    case = problem(FOUR, criterion=criterion)
    design = solve(case, 20, starts=5)
    assert design.bound.source == "continuous"
    assert design.value <= design.bound.value + 1e-8
    assert design.efficiency >= 0.99
    assert design.value >= case.objective(solve(problem(FOUR), 20).plan.postures) - SEARCHED  # D-optimal, by theory


def test_the_papers_criterion_within_narrow_limits() -> None:
    """Of the base model D* = 2 log det Re H. Its best weights are here on two postures, which determine 4 of the 6
    parameters, and M is singular: the bound holds for all weights, and plans of 7 runs come near it."""
    narrow = Arm([260.0, 180.0, 120.0], np.radians([-100, -60, -30]), np.radians([100, 80, 75]))
    design, generator = solve(problem(narrow, criterion=DStar(((0, 1, 2), (3, 4, 5)))), 7), np.random.default_rng(0)
    assert 0.95 < design.efficiency <= 1.0
    for count in generator.integers(3, 9, 3000):
        unit = np.exp(1j * np.cumsum(generator.uniform(narrow.lower, narrow.upper, (count, 3)), axis=1))
        real = ((unit.conj().T * generator.dirichlet(np.full(count, 0.5))) @ unit).real
        assert 2.0 * np.linalg.slogdet(real)[1] <= design.bound.value
