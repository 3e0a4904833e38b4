"""Weights on few postures: textbook optima, other solvers, the equivalence theorem; Caratheodory's reduction."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.bounds.weights import interior_point_weights, optimal_weights, solve_program, sparsest
from doe.criteria import A, Criterion, D, Ds, E
from doe.problem.problem import PriorInformation
from tests.doe.six_axis import LIMITED, six_axis

POINTS = np.linspace(-1.0, 1.0, 21)
QUADRATIC = np.power.outer(POINTS, np.arange(3))[:, None, :]  # (21, 1, 3)
EACH = np.swapaxes(QUADRATIC, 1, 2) @ QUADRATIC


@pytest.mark.parametrize(
    ("criterion", "ends", "middle", "tolerance"),
    [
        # F. Pukelsheim, Optimal Design of Experiments (2006), section 9.12 and exhibit 9.9: support -1, 0, 1
        (D(), 1 / 3, 1 / 3, 1e-10),
        (A(), 1 / 4, 1 / 2, 1e-10),
        (E(), 1 / 5, 3 / 5, 1e-3),  # a semidefinite program to 1e-8 of the value, which is flat at the optimum
        (Ds((2,)), 1 / 4, 1 / 2, 1e-10),  # the highest coefficient alone: Chebyshev points
    ],
    ids=["D", "A", "E", "Ds"],
)
def test_quadratic_regression(criterion: Criterion, ends: float, middle: float, tolerance: float) -> None:
    weights = optimal_weights(QUADRATIC, criterion, PriorInformation())[0]
    expected = np.zeros(21)
    expected[[0, 10, 20]] = ends, middle, ends
    assert weights == pytest.approx(expected, abs=tolerance)
    if criterion.name == "Ds":
        return
    weights, status, _ = solve_program(EACH, criterion)
    assert status == "optimal"
    value, optimum = (float(criterion.value(np.tensordot(w, EACH, 1))) for w in (weights, expected))
    assert value == pytest.approx(optimum, rel=1e-4, abs=1e-5)  # Clarabel stops at 1e-8 of a scaled program


def test_a_part_of_the_runs_is_fixed() -> None:
    """With a fixed offset the multiplicative algorithm (Silvey, Titterington, Torsney) is the oracle."""
    generator = np.random.default_rng(4)
    jacobians, kept = (generator.standard_normal((k, 2, 4)) for k in (15, 3))
    known = np.einsum("kda,kdb->ab", kept, kept)
    prior = PriorInformation(known, 2.0).per_new_run(3)  # two of five runs are known
    atoms = 0.6 * np.einsum("kda,kdb->kab", jacobians, jacobians) + 0.2 * known
    w = np.full(15, 1 / 15)
    for _ in range(20_000):
        w *= np.einsum("ab,kab->k", np.linalg.inv(np.einsum("k,kab->ab", w, atoms)), atoms) / 4
    mine, gradient = interior_point_weights(jacobians, D(), prior)
    best = np.linalg.slogdet(np.einsum("k,kab->ab", w, atoms))[1]
    assert np.linalg.slogdet(prior.mixture(jacobians, mine))[1] >= best - 1e-12
    assert mine == pytest.approx(w, abs=1e-3)  # the multiplicative algorithm is slow near zero weights
    g = prior.sensitivities(jacobians, gradient)
    assert g.max() - mine @ g <= 1e-10


# -- the convex program ------------------------------------------------------------------------------------------------
def test_dual_of_the_smallest_eigenvalue_is_a_bound() -> None:
    """G >= 0 with unit trace, and max tr(G F_i) is not below the optimum 1/5 (Pukelsheim)."""
    _, gradient = optimal_weights(QUADRATIC, E(), PriorInformation())
    assert np.linalg.eigvalsh(gradient)[0] >= -1e-12
    assert np.trace(gradient) == pytest.approx(1.0, abs=1e-12)
    assert 0.2 - 1e-12 <= max(float(row @ gradient @ row) for row in QUADRATIC[:, 0]) <= 0.2 + 1e-5
    # an arm in space, whose parameters are known to very different degrees
    arm, rng = six_axis(LIMITED), np.random.default_rng(3)
    jacobians = arm.scaled_jacobians(rng.uniform(arm.lower, arm.upper, (80, 6)))
    weights, gradient = optimal_weights(jacobians, E(), arm.prior)
    least = np.linalg.eigvalsh(arm.prior.mixture(jacobians, weights))[0]
    assert arm.prior.sensitivities(jacobians, gradient).max() == pytest.approx(least, rel=1e-6)


def test_few_postures_of_many_parameters() -> None:
    """Postures that each determine two parameters of their own, F_i = s_i^2 I there: E-optimal weights are 1 / s_i^2 by
    the equal eigenvalues w_i s_i^2 = 1 / sum_i s_i^-2 of the mean."""
    sizes = np.array([1.0, 2.0, 0.5, 3.0])
    jacobians = np.kron(np.diag(sizes), np.eye(2)).reshape(4, 2, 8)
    weights, _ = optimal_weights(jacobians, E(), PriorInformation())
    np.testing.assert_allclose(weights, sizes**-2.0 / np.sum(sizes**-2.0), atol=1e-5)
    information = np.einsum("k,kda,kdb->ab", weights, jacobians, jacobians)
    assert np.linalg.eigvalsh(information)[0] == pytest.approx(1.0 / np.sum(sizes**-2.0), rel=1e-5)


# -- sparse weights ----------------------------------------------------------------------------------------------------
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), p=st.integers(1, 5))
def test_sparsest_keeps_the_information(seed: int, p: int) -> None:
    generator = np.random.default_rng(seed)
    jacobians = generator.standard_normal((60, 2, p))
    weights = generator.dirichlet(np.ones(60))
    weights[::7] = 0.0
    weights /= weights.sum()
    few = sparsest(jacobians, weights)
    assert np.count_nonzero(few) <= p * (p + 1) // 2 + 1
    assert few.min() >= 0.0
    assert not few[::7].any()
    before, after = (np.einsum("k,kda,kdb->ab", w, jacobians, jacobians) for w in (weights, few))
    assert after == pytest.approx(before, rel=1e-10, abs=1e-10)
