"""The convex program alone, on a regression whose optimal weights are in the textbook."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds.column_generation import optimal_weights
from doe.bounds.weights import SETTINGS, solve_program
from doe.criteria import A, Criterion, D, E
from doe.problem.problem import PriorInformation
from identification.errors import JobError

POINTS = np.linspace(-1.0, 1.0, 21)
QUADRATIC = np.power.outer(POINTS, np.arange(3))[:, None, :]  # (21, 1, 3)
EACH = np.swapaxes(QUADRATIC, 1, 2) @ QUADRATIC


@pytest.mark.parametrize("solver", SETTINGS)
@pytest.mark.parametrize(
    ("criterion", "ends", "middle"),
    # F. Pukelsheim, Optimal Design of Experiments (2006), section 9.12 and exhibit 9.9: support -1, 0, 1
    [(D(), 1 / 3, 1 / 3), (A(), 1 / 4, 1 / 2), (E(), 1 / 5, 3 / 5)],
    ids=["D", "A", "E"],
)
def test_quadratic_regression(solver: str, criterion: Criterion, ends: float, middle: float) -> None:
    weights, status, _ = solve_program(EACH, criterion, solver)
    assert status == "optimal"
    assert weights is not None
    value = float(criterion.value(np.einsum("k,kda,kdb->ab", weights, QUADRATIC, QUADRATIC)))
    best = np.zeros(21)
    best[[0, 10, 20]] = ends, middle, ends
    optimum = float(criterion.value(np.einsum("k,kda,kdb->ab", best, QUADRATIC, QUADRATIC)))
    assert value == pytest.approx(optimum, rel=1e-4, abs=1e-5)  # solvers stop at 1e-8 of a scaled program


def test_dual_of_the_smallest_eigenvalue_is_a_bound() -> None:
    """G >= 0 with unit trace, and max tr(G F_i) is not below the optimum 1/5 (Pukelsheim)."""
    _, gradient = optimal_weights(QUADRATIC, E(), PriorInformation())
    assert np.linalg.eigvalsh(gradient)[0] >= -1e-12
    assert np.trace(gradient) == pytest.approx(1.0, abs=1e-12)
    largest = max(float(row @ gradient @ row) for row in QUADRATIC[:, 0])
    assert 0.2 - 1e-12 <= largest <= 0.2 + 1e-5


def test_postures_that_do_not_identify() -> None:
    with pytest.raises(JobError, match="identify"):
        solve_program(EACH[:2], D(), "scs")


def test_few_postures_of_many_parameters() -> None:
    """Postures that each determine two parameters of their own, F_i = s_i^2 I there: E-optimal weights are 1 / s_i^2 by
    the equal eigenvalues w_i s_i^2 = 1 / sum_i s_i^-2 of the mean."""
    sizes = np.array([1.0, 2.0, 0.5, 3.0])
    jacobians = np.kron(np.diag(sizes), np.eye(2)).reshape(4, 2, 8)
    weights, _ = optimal_weights(jacobians, E(), PriorInformation())
    np.testing.assert_allclose(weights, sizes**-2.0 / np.sum(sizes**-2.0), atol=1e-5)
    information = np.einsum("k,kda,kdb->ab", weights, jacobians, jacobians)
    assert np.linalg.eigvalsh(information)[0] == pytest.approx(1.0 / np.sum(sizes**-2.0), rel=1e-5)
