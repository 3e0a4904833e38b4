"""Discriminating plans: little D-efficiency lost, effects visible; both recomputed here from the formulas."""

from dataclasses import replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from doe import DesignProblem
from doe.discrimination import design
from doe.discrimination.design import (
    LAMBDA,
    Discrimination,
    EffectLibrary,
    MisidentificationBound,
    Swaps,
    discrimination_design,
)
from doe.solvers.solver import Budget
from doe.studies.blind.cells import arm_of
from doe.studies.blind.simulator import TrueArm, base_jacobian, column, session
from identification import Arm, Model, Status
from identification.workspace import WorkspaceBox
from tests.doe.arms import FOUR
from tests.doe.bounds.test_planar_theorem import complex_log_det

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])


def designed(lower: list[float], upper: list[float], runs: int, **options: Any) -> Discrimination:
    arm = Arm(LENGTHS[: len(lower)], np.radians(lower), np.radians(upper), sigma=0.1)
    return discrimination_design(DesignProblem.of(Model(arm)), arm, runs, **options)


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
    found = designed([-180] * 4, [180] * 4, 16)
    assert 0.0 >= complex_log_det(found.design.plan.postures) >= 8.0 * np.log(0.95)  # 0 is the bound
    for joint in range(4):
        for order in (1, 2):
            assert visible_share(found.design.plan.postures, joint, order) > 0.3
    assert not found.sees.pairs()
    assert found.design.status is Status.local_optimum


def test_joint_limits_cost_at_most_the_loss_and_effects_become_visible() -> None:
    lower, upper = [-180, -120, -100, -90], [180, 120, 60, 90]
    found = designed(lower, upper, 16)  # twice the factorial of eight: the best plan needs no search
    bound = 4 * np.log(np.sin(np.radians(80.0)))  # closed form, doe/README.md, "Planar theorem"
    postures, best = found.design.plan.postures, complex_log_det(found.best.plan.postures)
    assert np.all(postures >= np.radians(lower))
    assert np.all(postures <= np.radians(upper))
    assert bound + 1e-12 >= best >= bound + 8.0 * np.log(0.998)  # the factorial reaches it, to rounding
    assert complex_log_det(postures) >= best + 8.0 * np.log(0.95)
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
    limit, exact = np.full(4, np.pi), np.zeros(4)
    loads = {"masses": np.array([12.0, 8.0, 5.0, 3.0]), "payload": 10.0, "sigma": 0.1}
    truth = TrueArm.planar(np.array([260.0, 180.0, 120.0, 100.0]), exact, exact, lower=-limit, upper=limit, **loads)
    arm = arm_of(truth)
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
    found = discrimination_design(DesignProblem.of(Model(arm)), arm, 12, starts=1)
    assert (np.sin(np.cumsum(found.design.plan.postures, axis=1)) @ LENGTHS[:3]).min() >= -150.0 - 1e-9
    assert found.wrong < found.best_wrong


def test_what_a_very_long_plan_can_detect_is_not_worked_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor silently so."""
    monkeypatch.setattr(design, "MOST_SEEN", 19)
    found = designed([-180, -120], [180, 120], 20, starts=1, seconds=0.1)
    assert found.sees is None
    assert found.best_sees is None
    assert found.document().parts[-1] == "what a plan of more than 19 runs can detect is not computed"


def test_ctrl_c_in_the_second_search_gives_the_plan_so_far() -> None:
    def press(done: float, total: float | None, message: str) -> None:
        if message.startswith("wrong names"):
            raise KeyboardInterrupt

    found = designed([-180, -120, -100, -90], [180, 120, 60, 90], 20, starts=2, progress=press)
    assert found.design.status is Status.interrupted
    assert found.wrong < found.best_wrong
    assert found.relative_efficiency >= 0.95 - 1e-9


def test_the_best_of_all_plans_of_a_small_list() -> None:
    arm = Arm(LENGTHS[:3], np.radians([-180, -120, -100]), np.radians([180, 120, 60]), sigma=0.1)
    choices = np.random.default_rng(2).uniform(arm.lower, arm.upper, (10, 3))
    problem = DesignProblem.of(Model(arm), choices=choices)
    found, state = discrimination_design(problem, arm, 8), Swaps(problem, EffectLibrary.of(arm))
    least = found.best.value + problem.parameters * np.log1p(-0.05)
    plans = [choices[list(rows)] for rows in combinations(range(10), 8)]
    allowed = [plan for plan in plans if problem.objective(plan) >= least - 1e-12]
    assert 1 < len(allowed) < len(plans)
    assert found.wrong == pytest.approx(min(1.0, *(state.wrong(plan) for plan in allowed)), rel=1e-9)


def test_the_time_budget_holds_between_swaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that goes on by 20 ms with every look: one second is fifty looks, the swaps alone take more;
    another second is that of the order of measurement."""
    looks = 0

    def clock() -> float:
        nonlocal looks
        looks += 1
        return 0.02 * looks

    for module in ("doe.solvers.solving", "doe.solvers.solver", "doe.discrimination.design"):
        monkeypatch.setattr(f"{module}.perf_counter", clock)
    monkeypatch.setattr(design, "LOSS", 0.2)
    found = discrimination_design(DesignProblem.of(Model(FOUR)), FOUR, 42, seconds=1.0)
    assert found.design.status is Status.time_limit
    assert looks <= 105
    assert found.relative_efficiency >= 0.8


# -- the bound on wrong names ------------------------------------------------------------------------------------------
OWN, EFFECTS, RUNS, MODEL = 3, 7, 12, Model(Arm(LENGTHS))
BASES = (  # two effects of one parameter, one of two, one that takes the sum of two, one of three
    np.eye(EFFECTS)[:, [0]],
    np.eye(EFFECTS)[:, [1]],
    np.eye(EFFECTS)[:, [2, 3]],
    np.eye(EFFECTS)[:, [0]] + 2.0 * np.eye(EFFECTS)[:, [1]],
    np.eye(EFFECTS)[:, [4, 5, 6]],
)
WEIGHTS = np.array([1.0, 0.5, 1.0, 1.0, 0.25])


def columns(seed: int, rows: int = 2 * RUNS) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, OWN + EFFECTS))


def made(reference: np.ndarray) -> MisidentificationBound:
    information = reference.T @ reference / (len(reference) / 2)
    return MisidentificationBound(EffectLibrary(OWN, MODEL, BASES, WEIGHTS), information)


def left_of(targets: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Length of what least squares leaves of each column of targets."""
    return np.asarray(np.linalg.norm(targets - others @ np.linalg.lstsq(others, targets, rcond=None)[0], axis=0))


def mixed(size: int) -> np.ndarray:
    """(size, D) unit vectors along each axis, and along the sum and the difference of every two."""
    pairs = [(i, j, sign) for i in range(size) for j in range(i) for sign in (1.0, -1.0)]
    mixes = np.zeros((size, len(pairs)))
    for k, (i, j, sign) in enumerate(pairs):
        mixes[[i, j], k] = np.sqrt(0.5) * np.array([1.0, sign])
    return np.hstack([np.eye(size), mixes])


def brute_force(plan: np.ndarray, reference: np.ndarray) -> float:
    """Every direction of every effect against nothing and every other effect, by least squares."""
    drawn = np.hstack([basis @ mixed(basis.shape[1]) for basis in BASES])
    owner = np.repeat(np.arange(len(BASES)), [mixed(basis.shape[1]).shape[1] for basis in BASES])
    random = reference[:, OWN:] @ drawn
    lengths = left_of(random, reference[:, :OWN])
    # what random postures do not show beside the base model is no rival
    shown = lengths > 1e-5 * np.linalg.norm(random, axis=0)
    drawn, owner, lengths = drawn[:, shown], owner[shown], lengths[shown]
    # LAMBDA long with as many random runs as the plan has
    seen = plan[:, OWN:] @ drawn * (LAMBDA / (lengths * np.sqrt(len(plan) / len(reference))))
    wrong = norm.cdf(-left_of(seen, plan[:, :OWN]) / 2.0)
    for g in np.unique(owner):
        beside = left_of(seen, np.hstack([plan[:, :OWN], plan[:, OWN:] @ BASES[g]]))
        wrong += (owner != g) * norm.cdf(-beside / 2.0)
    return float(np.average(wrong, weights=WEIGHTS[owner] / np.bincount(owner)[owner]))


@pytest.mark.parametrize("seed", range(4))
def test_by_least_squares(seed: int) -> None:
    plan, reference = columns(seed), columns(100 + seed, 60)
    misidentification = made(reference)
    expected = brute_force(plan, reference)
    both = np.array([plan.T @ plan / RUNS] * 2)
    both[1, :, 0] = both[1, 0, :] = 0.0  # a base parameter that the plan does not show
    assert misidentification.wrong(both) == pytest.approx([expected, np.inf], rel=1e-9)


def test_an_effect_that_the_plan_hides_and_two_that_are_the_same() -> None:
    reference, plan = columns(9, 60), columns(1)
    plan[:, OWN + 1] = plan[:, OWN]  # the first two effects are one and the same column
    plan[:, OWN + 4] = 0.0
    wrong = float(made(reference).wrong(plan.T @ plan / RUNS))
    assert np.isfinite(wrong)
    assert wrong == pytest.approx(brute_force(plan, reference), rel=1e-4)  # lstsq's rank cut against the ridge
    assert np.all(np.isfinite(made(reference).gradient(plan.T @ plan / RUNS)))


@pytest.mark.parametrize("seed", range(3))
def test_gradient_by_finite_differences(seed: int) -> None:
    generator = np.random.default_rng(seed)
    misidentification, plan = made(columns(50 + seed, 60)), columns(seed)
    information = plan.T @ plan / RUNS
    gradient = misidentification.gradient(information)
    for _ in range(5):
        step = generator.normal(size=information.shape)
        step = step + step.T
        ends = [-np.log(float(misidentification.wrong(information + t * step))) for t in (-1e-6, 1e-6)]
        assert (ends[1] - ends[0]) / 2e-6 == pytest.approx(float(np.sum(gradient * step)), rel=1e-5, abs=1e-7)


def test_the_bound_holds_for_simulated_measurements() -> None:
    """Two effects of one parameter, hidden with either sign, named by least squares: wrong at most as often."""
    generator = np.random.default_rng(7)
    reference, plan = columns(9, 600), columns(1)
    plan[:, OWN + 1] = plan[:, OWN] + 0.25 * plan[:, OWN + 1]  # much alike
    library = EffectLibrary(OWN, MODEL, BASES[:2], np.ones(2))
    bound = float(MisidentificationBound(library, reference.T @ reference / 300).wrong(plan.T @ plan / RUNS))
    basis = np.linalg.qr(plan[:, :OWN])[0]
    seen = [column - basis @ (basis.T @ column) for column in plan[:, OWN : OWN + 2].T]
    scale = [LAMBDA / left_of(reference[:, OWN + h], reference[:, :OWN]) * np.sqrt(300 / RUNS) for h in (0, 1)]
    count, wrong = 4000, 0
    for number in range(count):
        h = number % 2
        data = seen[h] * scale[h] + generator.normal(size=len(plan))
        falls = [(data @ column) ** 2 / (column @ column) for column in seen]
        wrong += falls[h] < falls[1 - h]
    assert 0.02 < bound < 0.5
    error = np.sqrt(bound / count)
    assert wrong / count < bound + 3.0 * error
    assert wrong / count > 0.3 * bound - 3.0 * error  # the pair's own part of it, the rest is `nothing`
