"""The sensitivity as a trigonometric polynomial: that of the Jacobians where the model is one, None where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds.branch_and_bound import TrigonometricJacobian
from identification.arm import Calibration, EffectSpec, Gravity
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem
from tests.doe.regression import regression

GRAVITY = Gravity(np.array([0.0, -9.81]), np.array([12.0, 8.0, 5.0, 3.0]), np.full(4, 0.5), 10.0)
HEAVY = type(FOUR)(FOUR.lengths, FOUR.lower, FOUR.upper, 0.1, gravity=GRAVITY)
CALIBRATED = type(FOUR)(
    FOUR.lengths, FOUR.lower, FOUR.upper, 0.1,
    calibration=Calibration.of(np.array([1.5, -0.6, -0.4, 0.7]), np.array([0.01, -0.02, 0.03, 0.0])),
)  # fmt: skip
CASES = {
    "base": problem(FOUR),
    "five links": problem(FIVE),
    "base offset": problem(FOUR, OFFSET),
    "calibrated": problem(CALIBRATED),
    "harmonics": problem(FOUR, OFFSET, ECCENTRICITY, EffectSpec("encoder_second_harmonic", 3)),
    "ripple": problem(FOUR, EffectSpec("transmission_ripple", 2, {"k": 5})),
    "skew": problem(FOUR, EffectSpec("axes_skew")),
    "compliance": problem(HEAVY, EffectSpec("joint_compliance")),
    "bending": problem(HEAVY, EffectSpec("link_bending")),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_equals_the_jacobians(case) -> None:  # type: ignore[no-untyped-def]
    generator = np.random.default_rng(0)
    q = generator.uniform(-4.0, 4.0, (200, case.joints))  # outside the limits too: it is an identity
    root = generator.standard_normal((case.parameters, case.parameters))
    gradient = root @ root.T
    jacobians = case.scaled_jacobians(q)
    expected = 0.7 * np.einsum("kda,ab,kdb->k", jacobians, gradient, jacobians) + 3.0
    found = TrigonometricJacobian.of(case)
    assert found is not None
    polynomial = found.sensitivity(gradient, 0.7, 3.0)
    assert polynomial.value(q) == pytest.approx(expected, rel=1e-11)
    assert polynomial.magnitude >= np.abs(expected).max()  # what the margin for rounding is taken of


def test_base_model_has_a_wave_per_pair_of_links() -> None:
    """d depends on q through exp(i (q_(j+1) + .. + q_k)), j < k, only; q_1 plays no part.

    doe/README.md, "Information matrix".
    """
    found = TrigonometricJacobian.of(problem(FOUR))
    assert found is not None
    frequencies = {tuple(f) for f in found.sensitivity(np.diag(np.arange(1.0, 9.0)) + 1.0).frequencies}
    pairs = {tuple(int(j < c <= k) for c in range(4)) for j in range(4) for k in range(j + 1, 4)}
    # sums of two orientations appear too, with coefficients that cancel: the metric need not be a real form here
    assert pairs <= frequencies


@pytest.mark.parametrize(
    "case",
    [
        problem(FOUR, EffectSpec("gear_ratio", 2)),
        problem(HEAVY, EffectSpec("gravity_backlash", 2)),
        problem(FOUR, EffectSpec("joint_coupling", 3)),
        regression(2),
    ],
    ids=["gear ratio", "sign", "coupling", "regression"],
)
def test_others_are_not(case) -> None:  # type: ignore[no-untyped-def]
    assert TrigonometricJacobian.of(case) is None
