"""Discriminating plans: little D-efficiency lost, effects visible; both recomputed here from the formulas."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from doe.design import Design
from doe.discrimination import design
from doe.discrimination.design import (
    DiscriminationDesign,
    EffectLibrary,
    Swaps,
    discrimination_design,
    has_repeats,
    initial_plans,
)
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.report import design as report
from doe.solvers import solve
from doe.solvers.solver import Budget
from doe.studies.blind.cells import CELLS, arm_of, truth_of
from doe.studies.blind.simulator import TrueArm, base_jacobian, column, session
from identification.arm import Arm, EffectSpec, Gravity
from identification.errors import InputError
from identification.model import Model
from identification.running import Status
from identification.workspace import WorkspaceBox

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])


def designed(lower: list[float], upper: list[float], runs: int, **options: Any) -> DiscriminationDesign:
    arm = Arm(LENGTHS[: len(lower)], np.radians(lower), np.radians(upper), sigma=0.1)
    return discrimination_design(DesignProblem.of(Model(arm)), arm, runs, **options)


def log_det(postures: np.ndarray) -> float:
    """2 log det H, H = mean z z^*, z_j = exp(i theta_j) (doe/README.md, "Information matrix")."""
    z = np.exp(1j * np.cumsum(postures, axis=1))
    return 2.0 * np.log(np.linalg.det(z.T @ z.conj() / len(z)).real)


def visible_share(postures: np.ndarray, joint: int, order: int) -> float:
    """Least share, over directions, of the columns of a cos(k q_j) + b sin(k q_j) that the base model leaves.

    Real columns from the complex derivative: dl_k -> exp(i theta_k), dtheta_k -> i l_k exp(i theta_k), dq_j -> the sum
    of i l_k exp(i theta_k) over k >= j.
    """
    e = np.exp(1j * np.cumsum(postures, axis=1))
    lever = (1j * LENGTHS * e)[:, joint:].sum(axis=1)
    effect = [lever * np.cos(order * postures[:, joint]), lever * np.sin(order * postures[:, joint])]

    def real(columns: np.ndarray) -> np.ndarray:
        return np.concatenate([columns.real, columns.imag])

    base = np.linalg.qr(real(np.hstack([e, 1j * e])))[0]
    columns = np.linalg.qr(real(np.array(effect).T))[0]
    return float(np.linalg.svd(columns - base @ (base.T @ columns), compute_uv=False).min())


def test_without_limits_everything_is_seen_and_nothing_looks_like_another() -> None:
    found = designed([-180] * 4, [180] * 4, 24)
    assert 0.0 >= log_det(found.design.plan.postures) >= 8.0 * np.log(0.95)  # 0 is the bound
    for joint in range(4):
        for order in (1, 2):
            assert visible_share(found.design.plan.postures, joint, order) > 0.3
    assert not found.sees.pairs()
    assert found.design.status is Status.local_optimum


def test_joint_limits_cost_at_most_the_loss_and_effects_become_visible() -> None:
    lower, upper = [-180, -120, -100, -90], [180, 120, 60, 90]
    found = designed(lower, upper, 16, loss=0.05)  # twice the factorial of eight: the best plan needs no search
    bound = 4 * np.log(np.sin(np.radians(80.0)))  # closed form, doe/README.md, "Planar theorem"
    postures, best = found.design.plan.postures, log_det(found.best.plan.postures)
    assert np.all(postures >= np.radians(lower))
    assert np.all(postures <= np.radians(upper))
    assert bound + 1e-12 >= best >= bound + 8.0 * np.log(0.998)  # the factorial reaches it, to rounding
    assert log_det(postures) >= best + 8.0 * np.log(0.95)
    assert visible_share(found.best.plan.postures, 2, 1) < 1e-6  # two levels hide it
    assert visible_share(postures, 2, 1) > 0.3


def likeness_of_sag(truth: TrueArm, postures: np.ndarray) -> float:
    """Cosine, off the base model, between bending links and equally soft joints, by the simulator of the study."""
    run = session(truth, postures, np.random.default_rng(0))
    base = np.linalg.qr(base_jacobian(truth, run))[0]
    sag = [("link_bending", None, {"flexibility": 1.0}), ("joint_compliance", None, {"c": np.ones(truth.n)})]
    one, two = (column(replace(truth, effects=[]), run, effect) for effect in sag)
    one, two = (values - base @ (base.T @ values) for values in (one, two))
    return float(one @ two / np.linalg.norm(one) / np.linalg.norm(two))


def test_links_that_bend_and_joints_that_twist_are_told_apart_better_than_by_random_postures() -> None:
    cell = "one, lambda 6, 4 links"
    truth = truth_of(CELLS[cell], np.random.default_rng(1))
    arm = arm_of(CELLS[cell], truth, np.random.default_rng(0))
    found = discrimination_design(DesignProblem.of(Model(arm)), arm, 36, starts=1)
    generator = np.random.default_rng(3)
    random = [likeness_of_sag(truth, generator.uniform(arm.lower, arm.upper, (36, 4))) for _ in range(20)]
    angle = np.degrees(np.arccos(likeness_of_sag(truth, found.design.plan.postures)))
    assert angle > np.degrees(np.arccos(min(random)))  # 8 to 15 degrees
    assert found.wrong < 0.5 * found.random_wrong


@pytest.mark.parametrize("seed", range(2))
def test_a_wrong_name_becomes_less_probable_with_every_swap(seed: int) -> None:
    arm = Arm(LENGTHS[:3], np.radians([-180, -120, -100]), np.radians([180, 120, 100]), sigma=0.1)
    problem = DesignProblem.of(Model(arm), kept=np.radians([[0.0, 30.0, 40.0], [10.0, -60.0, 20.0]]))
    state, generator = Swaps(problem, EffectLibrary.of(arm)), np.random.default_rng(seed)
    plan = generator.uniform(arm.lower, arm.upper, (12, 3))
    least = problem.objective(plan) - 0.05
    first, *steps = state.improved(plan, least, generator, Budget(1))
    wrong = [state.wrong(postures) for postures in (first, *steps)]
    assert len(steps) > 5
    assert np.all(np.diff(wrong) < 0.0)
    assert min(problem.objective(postures) for postures in steps) >= least
    assert all((np.abs(a - b).max(axis=1) > 0.0).sum() <= 1 for a, b in pairwise((plan, *steps)))  # one run at a time


def test_constraints_hold_after_the_swaps() -> None:
    arm = Arm(LENGTHS[:3], np.radians([-180, -120, -100]), np.radians([180, 120, 100]), sigma=0.1)
    arm = replace(arm, constraints=(WorkspaceBox((-700.0, 700.0), (-150.0, 700.0)),))
    problem = DesignProblem.of(Model(arm))
    found = discrimination_design(problem, arm, 20, starts=1)
    heights = np.sin(np.cumsum(found.design.plan.postures, axis=1)) @ LENGTHS[:3]
    assert heights.min() >= -150.0 - 1e-9
    assert found.wrong < found.best_wrong


def test_joints_that_play_no_part_do_not_bring_postures_too_near_each_other() -> None:
    """Two links: D-optimality chooses two angles of joint 2, and joint 1 alone sets the postures apart."""
    arm = Arm(LENGTHS[:2], np.radians([-180, -10]), np.radians([180, 10]), sigma=0.1)
    kept = np.radians([[0.0, 10.0], [1.5, -10.0], [90.0, 10.0]])
    found = discrimination_design(DesignProblem.of(Model(arm), kept=kept), arm, 60, starts=2)
    postures = np.vstack([kept, found.design.plan.postures])
    apart = np.abs(postures[:, None] - postures).max(axis=-1) + 9.0 * np.eye(len(postures))
    assert np.degrees(apart.min()) >= 1.0 - 1e-6
    assert found.wrong < found.best_wrong


def test_an_arm_that_has_every_joints_compliance_already() -> None:
    gravity = Gravity(np.array([0.0, -9.81]), np.array([12.0, 8.0, 5.0]), np.full(3, 0.5), payload=10.0)
    bare = Arm(LENGTHS[:3], np.radians([-180, -120, -100]), np.radians([180, 120, 60]), sigma=0.1, gravity=gravity)
    arm = bare.with_effects(EffectSpec("joint_compliance"))
    found = discrimination_design(DesignProblem.of(Model(arm)), arm, 14, starts=2)
    assert found.relative_efficiency >= 0.95 - 1e-9
    assert found.wrong < found.random_wrong


def test_ctrl_c_in_the_first_search_ends_the_second_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*parts: Any, **options: Any) -> Design:
        return replace(solve(*parts, **options), status=Status.interrupted)

    monkeypatch.setattr("doe.discrimination.design.solve", stopped)
    found = designed([-180, -120, -100, -90], [180, 120, 60, 90], 20)
    assert found.design.status is Status.interrupted
    assert sorted(map(tuple, found.design.plan.postures)) == sorted(map(tuple, found.best.plan.postures))


def test_ctrl_c_in_the_second_search_gives_the_plan_so_far() -> None:
    def press(done: float, total: float | None, message: str) -> None:
        if message.startswith("wrong names"):
            raise KeyboardInterrupt

    found = designed([-180, -120, -100, -90], [180, 120, 60, 90], 20, starts=2, progress=press)
    assert found.design.status is Status.interrupted
    assert found.wrong < found.best_wrong
    assert found.relative_efficiency >= 0.95 - 1e-9


def test_postures_measured_already_count_in_what_is_seen() -> None:
    """Ten measured and two new postures of two links: 24 equations, 4 parameters; the two alone leave none."""
    arm = Arm(LENGTHS[:2], np.radians([-180, -120]), np.radians([180, 120]), sigma=0.1)
    kept = np.random.default_rng(2).uniform(arm.lower, arm.upper, (10, 2))
    found = discrimination_design(DesignProblem.of(Model(arm), kept=kept), arm, 2)
    assert found.sees.freedom == found.best_sees.freedom == 24 - 4


def test_random_postures_are_plans_of_as_many_runs() -> None:
    """Few of them tell effects apart worse than many, and than their mean information would."""
    arm = Arm(LENGTHS, np.radians([-180] * 4), np.radians([180] * 4), sigma=0.1)
    problem = DesignProblem.of(Model(arm))
    wide, generator = Swaps(problem, EffectLibrary.of(arm)), np.random.default_rng(4)
    few, many = wide.at_random(12), wide.at_random(60)
    assert few > 2.0 * many > 2.0 * float(wide.bound.wrong(wide.bound.reference))
    plans = [wide.wrong(random_postures(problem, 12, generator)) for _ in range(200)]
    assert np.quantile(plans, 0.2) < few < np.quantile(plans, 0.8)  # a median of 25, 3 standard deviations


def test_what_a_very_long_plan_can_detect_is_not_worked_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor silently so."""
    monkeypatch.setattr(design, "MOST_SEEN", 19)
    found = designed([-180, -120], [180, 120], 20, starts=1, seconds=0.1)
    assert found.sees is None
    assert found.best_sees is None
    lines = [str(line) for line in report.discriminating_parts(found)]
    assert lines[-1] == "what a plan of more than 19 runs can detect is not worked out"


@pytest.mark.parametrize("kept", [0, 3])
def test_repeats_of_a_whole_plan_are_those_of_its_postures(kept: int) -> None:
    """Plans of few postures in a narrow box: some pairs are nearer than the distance in every joint, some are not."""
    rng, answers = np.random.default_rng(5), set()
    for _ in range(60):
        points = rng.uniform(0.0, 0.3 + 0.1 * kept, (7 + kept, 2))
        case = DesignProblem.of(Model(Arm(LENGTHS[:2])), kept=points[:kept], minimum_distance=0.06)
        apart = np.abs(points[:, None] - points).max(axis=2) + np.eye(len(points))
        expected = bool((apart[kept:] < 0.06).any())
        assert has_repeats(case, points[kept:]) == expected
        answers.add(expected)
    assert answers == {True, False}


def test_bad_loss() -> None:
    with pytest.raises(InputError, match="loss"):
        designed([-180] * 4, [180] * 4, 12, loss=1.0)


def test_out_of_a_list_of_postures_only_those() -> None:
    arm = Arm(LENGTHS, np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90]), sigma=0.1)
    choices = np.random.default_rng(3).uniform(arm.lower, arm.upper, (60, 4))
    problem = DesignProblem.of(Model(arm), choices=choices)
    found = discrimination_design(problem, arm, 10)
    nearest = np.abs(found.design.plan.postures[:, None] - choices).max(axis=-1).argmin(axis=1)
    np.testing.assert_array_equal(found.design.plan.postures, choices[nearest])
    assert len(set(nearest.tolist())) == 10
    lost = log_det(found.best.plan.postures) - log_det(found.design.plan.postures)
    assert lost <= -8.0 * np.log(0.95) + 1e-9


def test_a_list_that_has_nothing_more_to_offer() -> None:
    arm = Arm(LENGTHS[:3], np.radians([-180, -120, -100]), np.radians([180, 120, 60]), sigma=0.1)
    choices = np.random.default_rng(3).uniform(arm.lower, arm.upper, (12, 3))
    problem = DesignProblem.of(Model(arm), choices=choices)
    state = Swaps(problem, EffectLibrary.of(arm))
    state.begin(choices, least=-np.inf)
    state.draw(np.random.default_rng(0))
    assert not state.open.any()  # all of them are in the plan
    assert not state.swap()


def test_no_number_of_periods_hides_behind_another_on_joints_that_turn_all_the_way() -> None:
    arm = Arm([260.0, 180.0, 120.0], sigma=0.1)
    runs = 30
    found = discrimination_design(DesignProblem.of(Model(arm)), arm, runs)
    regular = 2.0 * np.pi * np.arange(runs) / runs
    for joint in range(1, 3):
        q = found.design.plan.postures[:, joint]
        for low in (1, 2):  # k = 29 or 31 against 1, 28 or 32 against 2: the same on 30 equal steps
            assert np.abs(np.mean(np.exp(1j * runs * regular))) == pytest.approx(1.0)
            columns = np.column_stack([np.cos(low * q), np.sin(low * q)])
            for high in (runs - low, runs + low):
                ripple = np.cos(high * q)
                left = ripple - columns @ np.linalg.lstsq(columns, ripple, rcond=None)[0]
                assert np.linalg.norm(left) > 0.5 * np.linalg.norm(ripple)
    assert found.relative_efficiency >= 0.95


def test_under_joint_limits_no_two_ripples_are_the_same_and_none_is_an_eccentric_encoder() -> None:
    """Least-squares share of every wave of 1 to 64 periods that every other one explains, joint by joint."""
    found = designed([-180, -120, -100], [180, 120, 100], 30, starts=2)
    for q in found.design.plan.postures.T:
        waves = [np.column_stack([np.cos(k * q), np.sin(k * q)]) for k in range(1, 65)]
        bases = [np.linalg.qr(wave - wave.mean(axis=0))[0] for wave in waves]
        for k, one in enumerate(bases[:-1]):
            assert max(np.linalg.norm(one.T @ other, 2) for other in bases[k + 1 :]) < 1.0 - 1e-3
            assert max(np.linalg.norm(one.T @ other) / np.sqrt(2.0) for other in bases[k + 1 :]) < 0.9
    assert found.relative_efficiency >= 0.95 - 1e-9


def test_the_time_budget_holds_between_swaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that goes on by 10 ms with every look: one second is a hundred looks, the swaps alone take more;
    another second is that of the order of measurement."""
    looks = 0

    def clock() -> float:
        nonlocal looks
        looks += 1
        return 0.01 * looks

    for module in ("doe.solvers.solving", "doe.solvers.solver", "doe.discrimination.design"):
        monkeypatch.setattr(f"{module}.perf_counter", clock)
    arm = Arm(LENGTHS, np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90]), sigma=0.1)
    found = discrimination_design(DesignProblem.of(Model(arm)), arm, 42, loss=0.2, seconds=1.0)
    assert found.design.status is Status.time_limit
    assert looks <= 210
    assert found.relative_efficiency >= 0.8


def test_many_runs_have_a_time_budget_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("doe.discrimination.design.LONG_PLAN", 20)
    monkeypatch.setattr("doe.discrimination.design.LONG_PLAN_SECONDS", 0.1)
    found = designed([-180, -120, -100, -90], [180, 120, 60, 90], 22)
    assert found.design.status is Status.time_limit


def test_under_limits_a_second_beginning_away_from_the_corners() -> None:
    """Random runs, as many as the loss allows; where joints turn all the way there is one beginning only."""
    arm = Arm(LENGTHS, np.radians([-90.0] * 4), np.radians([90.0] * 4), sigma=0.1)
    problem = DesignProblem.of(Model(arm))
    wide, best = Swaps(problem, EffectLibrary.of(arm)), solve(problem, 20, seconds=5.0)
    allowed = -8.0 * np.log(0.9)
    starts = [plan for plan, _ in initial_plans(wide, best, allowed, np.random.default_rng(0), Budget(1))]
    assert len(starts) == 2
    assert log_det(starts[1]) >= log_det(best.plan.postures) - 0.75 * allowed - 1e-9
    inside = [np.mean(np.abs(np.degrees(plan)) < 60.0) for plan in (best.plan.postures, starts[1])]
    assert inside[1] > inside[0] + 0.1
    free = Arm(LENGTHS, sigma=0.1)
    plan = solve(DesignProblem.of(Model(free)), 20)
    several = initial_plans(
        Swaps(DesignProblem.of(Model(free)), EffectLibrary.of(free)),
        plan,
        allowed,
        np.random.default_rng(0),
        Budget(1),
    )
    assert len(list(several)) == 1
