"""Branch and bound on trigonometric polynomials against dense sampling and known maxima; and the sensitivity as one,
where the model allows, None where it does not."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.bounds.branch_and_bound import TrigonometricPolynomial, maximum, trigonometric_jacobian
from identification import Array, Calibration, EffectSpec
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem, regression
from tests.identification.estimation.cases import GRAVITY


def random_polynomial(generator: np.random.Generator, n: int, terms: int, degree: int) -> TrigonometricPolynomial:
    frequencies = generator.integers(-degree, degree + 1, (terms, n))
    coefficients = generator.standard_normal(terms) + 1j * generator.standard_normal(terms)
    return TrigonometricPolynomial(float(generator.standard_normal()), frequencies, coefficients)


def plainly(polynomial: TrigonometricPolynomial, q: Array) -> Array:
    """a cos - b sin, term by term."""
    total = np.full(len(q), polynomial.constant)
    for f, c in zip(polynomial.frequencies, polynomial.coefficients, strict=True):
        total += c.real * np.cos(q @ f) - c.imag * np.sin(q @ f)
    return total


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 3), terms=st.integers(1, 8))
def test_upper_bound_holds_and_is_tight(seed: int, n: int, terms: int) -> None:
    generator = np.random.default_rng(seed)
    polynomial = random_polynomial(generator, n, terms, 2)
    lower = generator.uniform(-3.0, 0.0, n)
    upper = lower + generator.uniform(0.1, 4.0, n)
    tried = ((lower + upper) / 2)[None]
    found = maximum(polynomial, lower, upper, tried=tried, tolerance=1e-6, most_boxes=100_000)
    samples = plainly(polynomial, np.array(list(product(*np.linspace(lower, upper, {1: 2001, 2: 101, 3: 31}[n]).T))))
    ridge = np.linalg.matrix_rank(polynomial.frequencies) < n  # of equal maxima, which takes boxes without end
    assert found.proven or ridge
    assert samples.max() <= found.upper
    assert found.upper <= found.value + 1e-6 + 1e-11 or not found.proven
    assert np.all((found.posture >= lower) & (found.posture <= upper))
    assert found.value == pytest.approx(plainly(polynomial, found.posture[None])[0], abs=1e-12)


def test_waves_of_separate_joints_need_one_box() -> None:
    """Then the termwise bound is exact, flat directions included: the base model at its optimum."""
    polynomial = TrigonometricPolynomial(1.0, np.eye(5, dtype=int), np.array([1.0, 2.0j, -0.5, 0.0, 1.0 - 1.0j]))
    lower, upper = np.full(5, -1.0), np.full(5, 0.6)
    # cos q at 0; -2 sin q at -1; -cos(q)/2 at -1; nothing; sqrt(2) cos(q - pi/4) at 0.6, which is below pi/4
    top = 1.0 + 1.0 + 2.0 * np.sin(1.0) - 0.5 * np.cos(1.0) + 0.0 + np.sqrt(2.0) * np.cos(0.6 - np.pi / 4.0)
    found = maximum(polynomial, lower, upper, tried=np.array([[0.0, -1.0, -1.0, 0.2, 0.6]]), tolerance=1e-9)
    assert found.proven
    assert found.boxes == 1
    assert found.value == pytest.approx(top, abs=1e-13)
    assert top <= found.upper <= top + 1e-12


def test_out_of_boxes_is_not_a_proof_but_still_a_bound() -> None:
    generator = np.random.default_rng(1)
    polynomial = random_polynomial(generator, 4, 40, 3)
    lower, upper = np.full(4, -np.pi), np.full(4, np.pi)
    found = maximum(polynomial, lower, upper, tried=np.zeros((1, 4)), tolerance=1e-9, most_boxes=3000)
    assert not found.proven
    assert found.upper >= plainly(polynomial, generator.uniform(-np.pi, np.pi, (200_000, 4))).max()


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 3))
def test_bounds_over_boxes(seed: int, n: int) -> None:
    """Termwise bound and curvature enclose what samples in the box show."""
    generator = np.random.default_rng(seed)
    polynomial = random_polynomial(generator, n, 6, 3)
    center, half = generator.uniform(-3.0, 3.0, (1, n)), generator.uniform(0.01, 1.0, (1, n))
    q = center + half * generator.uniform(-1.0, 1.0, (200, n))
    assert polynomial.termwise(center, half)[0] >= plainly(polynomial, q).max() - 1e-12
    assert polynomial.bound(center, half)[1][0] >= plainly(polynomial, q).max() - 1e-12
    curvature = polynomial.curvature(center, half)[0]
    for point in q[:20]:
        slope = numerical_slope(polynomial, point)
        hessian = np.array([numerical_slope(polynomial, point + 1e-5 * e) - slope for e in np.eye(n)]) / 1e-5
        assert np.linalg.eigvalsh(0.5 * (hessian + hessian.T))[-1] <= curvature + 1e-3


def numerical_slope(polynomial: TrigonometricPolynomial, point: Array) -> Array:
    h = 1e-6
    values = plainly(polynomial, np.concatenate([point + h * np.eye(len(point)), point - h * np.eye(len(point))]))
    return (values[: len(point)] - values[len(point) :]) / (2 * h)


# -- sensitivities of models -------------------------------------------------------------------------------------------
HEAVY = replace(FOUR, gravity=GRAVITY)
CALIBRATED = replace(FOUR, calibration=Calibration.of([1.5, -0.6, -0.4, 0.7], [0.01, -0.02, 0.03, 0.0]))
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
    polynomial = TrigonometricPolynomial.of_sensitivity(trigonometric_jacobian(case), gradient, 0.7, 3.0)
    assert polynomial.value(q) == pytest.approx(expected, rel=1e-11)
    assert polynomial.magnitude >= np.abs(expected).max()  # what the margin for rounding is taken of


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
    assert trigonometric_jacobian(case) is None
