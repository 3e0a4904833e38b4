"""The closed-form optimum, against complex arithmetic, the factorial that attains it, and rivals of it."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.bounds.planar_theorem import closed_form_bound, pair_means, table_1_max_residual
from identification import Arm, Calibration, EffectSpec
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem, random_box

ROUNDING = 1e-9  # log det of well-conditioned matrices of at most 14 rows, condition below 1e6


def complex_log_det(postures: np.ndarray, *, offset: bool = False) -> float:
    """2 log det H from complex exponentials, without the project's code (doe/README.md, "Information matrix")."""
    columns = np.exp(1j * np.cumsum(postures, axis=1))
    if offset:
        columns = np.hstack([np.ones((len(columns), 1)), columns])
    gram = columns.conj().T @ columns / len(columns)
    return 2.0 * float(np.linalg.slogdet(gram)[1])


def factorial(arm: Arm, *, offset: bool) -> np.ndarray:
    """Two angles per joint in all combinations: the limits, or a pair pi apart where the range allows."""
    levels = []
    for j, (low, high) in enumerate(zip(arm.lower, arm.upper, strict=True)):
        middle, half = (low + high) / 2, min((high - low) / 2, np.pi / 2)
        levels.append((middle - half, middle + half) if j or offset else (middle,))
    return np.array(list(product(*levels)))


@pytest.mark.parametrize("offset", [False, True])
@pytest.mark.parametrize("links", [1, 2, 3, 4, 5, 6])
def test_factorial_at_the_limits_attains_it(links: int, offset: bool) -> None:
    generator = np.random.default_rng([links, offset])
    for _ in range(3):
        arm = random_box(generator, links)
        case = problem(arm, *([OFFSET] if offset else []))
        plan = factorial(arm, offset=offset)
        assert case.objective(plan) == pytest.approx(complex_log_det(plan, offset=offset), abs=ROUNDING)
        assert closed_form_bound(case).value == pytest.approx(complex_log_det(plan, offset=offset), abs=ROUNDING)


@settings(max_examples=60)
@given(st.integers(2, 6), st.booleans(), st.integers(0, 2**32 - 1))
def test_no_design_is_better(links: int, offset: bool, seed: int) -> None:
    generator = np.random.default_rng(seed)
    arm = random_box(generator, links)
    bound = closed_form_bound(problem(arm, *([OFFSET] if offset else []))).value
    levels = [arm.lower, arm.upper, (arm.lower + arm.upper) / 2]
    at_limits = np.choose(generator.integers(0, 2, (64, links)), levels[:2])
    anywhere = generator.uniform(arm.lower, arm.upper, (64, links))
    for plan in (at_limits, anywhere, np.vstack([at_limits, anywhere[:8]])):
        assert complex_log_det(plan, offset=offset) <= bound + ROUNDING


@pytest.mark.parametrize("errors", [[5.0, -3.0, 2.0, 1.0], [10.0] * 4, [-520.0, 90.0, -60.0, 0.0]])
def test_log_det_does_not_depend_on_lengths_calibrated_or_not(errors: list[float]) -> None:
    """log det M' of the base model is 2 log det H <= 0 whatever the lengths (doe/README.md, "Information matrix").

    The third case turns link 1 round: its length is -260 mm.
    """
    calibration = Calibration.of(np.array(errors), np.array([0.02, -0.01, 0.03, 0.01]))
    arm = Arm(FOUR.lengths, FOUR.lower, FOUR.upper, calibration=calibration)
    assert closed_form_bound(problem(arm)).value == pytest.approx(-0.0612353259, abs=5e-11)  # the box of doe/README.md
    anywhere = np.random.default_rng(4).uniform(FOUR.lower, FOUR.upper, (9, 4))
    for plan in (factorial(arm, offset=False), anywhere):
        assert problem(arm).objective(plan) == pytest.approx(complex_log_det(plan), abs=ROUNDING)
    for plan in (factorial(arm, offset=True), anywhere):
        assert problem(arm, OFFSET).objective(plan) == pytest.approx(complex_log_det(plan, offset=True), abs=ROUNDING)


def test_says_where_it_does_not_apply() -> None:
    fixed = EffectSpec("base_offset", values={"x0": 1.0, "y0": 2.0})
    for case in (problem(FOUR, ECCENTRICITY), problem(FOUR, fixed), problem(FOUR, kept=np.zeros((3, 4)))):
        assert closed_form_bound(case) is None


def test_table_1_is_the_corrected_row_of_the_paper() -> None:
    plan = np.random.default_rng(3).uniform(-2, 2, (7, 4))
    q2, q3, q4 = plan.T[1:]
    angles = {"q2": q2, "q3": q3, "q4": q4, "q2+q3": q2 + q3, "q3+q4": q3 + q4, "q2+q3+q4": q2 + q3 + q4}
    found = pair_means(plan)
    assert found.keys() == angles.keys()
    for name, angle in angles.items():
        assert found[name] == pytest.approx(np.mean(np.cos(angle)) + 1j * np.mean(np.sin(angle)), abs=1e-14)
    assert table_1_max_residual(plan) == pytest.approx(max(abs(np.mean(np.exp(1j * a))) for a in angles.values()))
    assert table_1_max_residual(plan[:, :1]) == 0.0  # of one link there are none
