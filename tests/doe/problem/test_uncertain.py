"""Uncertain arms: the block-diagonal model against the definition, arm by arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.criteria import Average, SoftWorst, Worst
from doe.design import score
from doe.problem.problem import DesignProblem
from doe.problem.uncertain import ensemble_problem, prior_draws
from doe.report.design import accuracy
from doe.solvers import solve
from identification.arm import Arm, Calibration, EffectSpec, Machining
from identification.document import Sheet
from identification.errors import InputError
from identification.model import Model

ARM = Arm(
    np.array([300.0, 200.0, 150.0]), np.radians([-170, -100, -80]), np.radians([170, 110, 100]), 0.1,
    effects=(EffectSpec("gear_ratio", 2), EffectSpec("encoder_eccentricity", 3)),
)  # fmt: skip
MODEL = Model(ARM)
ROUGH = replace(ARM, machining=Machining(8.0, np.radians(6.0)))
DRAWS = prior_draws(Model(ROUGH), 3, np.random.default_rng(1))


def each_log_det(postures: np.ndarray) -> np.ndarray:
    """log det of every arm's own scaled information per run, from its own Jacobians."""
    found = []
    for draw in DRAWS:
        scaled = [block / MODEL.scales for block in MODEL.jacobian(postures, draw)]
        found.append(np.linalg.slogdet(sum(b.T @ b for b in scaled) / len(scaled))[1])
    return np.array(found)


def test_average_and_worst_are_what_they_say() -> None:
    postures = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (9, 3))
    plain = DesignProblem.of(MODEL)
    assert ensemble_problem(plain, DRAWS).objective(postures) == pytest.approx(each_log_det(postures).sum(), rel=1e-12)
    assert ensemble_problem(plain, DRAWS, "worst").objective(postures) == pytest.approx(
        each_log_det(postures).min(), rel=1e-12
    )


@pytest.mark.parametrize("kind", ["average", "worst"])
def test_design_for_the_prior_beats_the_design_for_one_guess(kind: str) -> None:
    plain = DesignProblem.of(MODEL)
    problem = ensemble_problem(plain, DRAWS, kind)
    design = solve(problem, 9, starts=10)
    one_guess = solve(plain, 9, starts=10)
    judge = np.sum if kind == "average" else np.min
    assert judge(each_log_det(design.plan.postures)) >= judge(each_log_det(one_guess.plan.postures))
    assert design.bound is not None
    assert design.value <= design.bound.value + 1e-9
    generator = np.random.default_rng(3)
    for _ in range(20):  # no other plan exceeds the bound
        other = generator.uniform(ARM.lower, ARM.upper, (9, 3))
        assert judge(each_log_det(other)) <= design.bound.value


@pytest.mark.parametrize("criterion", [Average(3), SoftWorst(3), SoftWorst(3, 5.0)])
def test_derivatives_by_differences(criterion: Average | SoftWorst) -> None:
    generator = np.random.default_rng(2)
    root = generator.normal(size=(12, 30))
    information = root @ root.T / 30
    steps = generator.normal(size=(2, 12, 12))
    steps = steps + np.swapaxes(steps, 1, 2)
    size = 1e-4
    value = {(i, k): float(criterion.value(information + size * (i * steps[0] + k * steps[1])))
             for i in (-1, 0, 1) for k in (-1, 0, 1)}  # fmt: skip
    slope = float(np.sum(criterion.gradient(information) * steps[0]))
    assert (value[1, 0] - value[-1, 0]) / (2 * size) == pytest.approx(slope, rel=1e-5)
    mixed = (value[1, 1] - value[1, -1] - value[-1, 1] + value[-1, -1]) / (4 * size**2)
    assert mixed == pytest.approx(criterion.curvature(information, steps)[0, 1], rel=1e-3)


@pytest.mark.parametrize("criterion", [Average(3), SoftWorst(3)])
def test_adding_a_run_ranks_as_the_value_does(criterion: Average | SoftWorst) -> None:
    generator = np.random.default_rng(6)
    ensemble = ensemble_problem(DesignProblem.of(MODEL), DRAWS)
    postures = generator.uniform(ARM.lower, ARM.upper, (20, 3))
    jacobians = ensemble.scaled_jacobians(postures)
    information = np.einsum("kda,kdb->ab", jacobians[:10], jacobians[:10])
    direct = np.array([float(criterion.value(information + b.T @ b)) for b in jacobians[10:]])
    surrogate = criterion.values_after_adding(information[None], jacobians[None, 10:])[0]
    np.testing.assert_allclose(
        surrogate - surrogate[0], direct - direct[0], atol=1e-5
    )  # the ridge is 1e-9 of the trace


def test_soft_worst_is_below_the_worst_by_at_most_log_k_over_t() -> None:
    root = np.random.default_rng(4).normal(size=(6, 8, 20))
    for information in root @ np.swapaxes(root, 1, 2) / 20:
        gap = float(Worst(2).value(information) - SoftWorst(2, 20.0).value(information))
        assert -1e-12 <= gap <= np.log(2) / 20 + 1e-12


def test_draws_follow_a_calibration() -> None:
    spread = np.diag(np.arange(1.0, len(MODEL.names) + 1.0) ** 2 * 1e-6)
    calibration = Calibration.of(np.ones(3), np.zeros(3), {}, MODEL.names, spread)
    calibrated = Model(Arm(ARM.lengths, ARM.lower, ARM.upper, 0.1, effects=ARM.effects, calibration=calibration))
    draws = prior_draws(calibrated, 4000, np.random.default_rng(5))
    # 4,000 draws: a standard deviation is known to 1.1 %, so 5 % is a 4-sigma event
    np.testing.assert_allclose(draws.std(axis=0), np.sqrt(np.diag(spread)), rtol=0.05)


def test_bad_input() -> None:
    plain = DesignProblem.of(MODEL)
    with pytest.raises(InputError, match="did you mean 'worst'"):
        ensemble_problem(plain, DRAWS, "wurst")
    with pytest.raises(InputError, match="draws"):
        ensemble_problem(plain, DRAWS[:, :-1])


def test_expected_deviations_are_those_of_every_arm_by_itself() -> None:
    plan = np.random.default_rng(5).uniform(ARM.lower, ARM.upper, (9, 3))
    design = score(ensemble_problem(DesignProblem.of(MODEL), DRAWS), plan)
    orientation = np.tri(3)  # dtheta_j = dq_1 + ... + dq_j, parameters 3..5
    each = []
    for draw in DRAWS:
        jacobians = MODEL.jacobian(plan, draw)
        covariance = 0.1**2 * np.linalg.inv(sum(j.T @ j for j in jacobians))
        turned = orientation @ covariance[3:6, 3:6] @ orientation.T
        each.append(np.sqrt([np.diag(covariance)[:3], np.diag(turned), np.diag(covariance)[3:6]]))
    data = design.to_json()
    for key, judge in (("std", np.mean), ("std_worst_draw", np.max)):
        length, turn, joint = judge(each, axis=0)
        np.testing.assert_allclose(data[key]["length_mm"], length, rtol=1e-8)
        np.testing.assert_allclose(data[key]["orientation_deg"], np.degrees(turn), rtol=1e-8)
        np.testing.assert_allclose(data[key]["joint_offset_deg"], np.degrees(joint), rtol=1e-8)
    table = accuracy(design)[0]
    assert isinstance(table, Sheet)
    assert len(table.headings) == 7
    assert "std_worst_draw" not in score(DesignProblem.of(MODEL), plan).to_json()
