"""The loop of column generation, with a pricing that is written out: all postures of a short list."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds.column_generation import Stage, generate_columns
from doe.criteria import A, Criterion, D, E
from doe.problem.problem import PriorInformation
from identification.arrays import Array
from identification.errors import JobError
from tests.doe.arms import FOUR, problem

POSTURES = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (200, 4))


@pytest.mark.parametrize("criterion", [D(), A()], ids=["D", "A"])
def test_ends_at_the_optimum_of_a_list(criterion: Criterion) -> None:
    """Equivalence theorem: tr(G B^T B) <= tr(G M) for every posture, with equality where there is weight."""
    case, prior = problem(FOUR, criterion=criterion), PriorInformation()
    jacobians = case.scaled_jacobians(POSTURES)

    def price(gradient: Array, level: float, _: Array) -> tuple[Array, float]:
        g = np.array([np.trace(gradient @ b.T @ b) for b in jacobians])
        return POSTURES[[int(g.argmax())]], float(g.max())

    found, gap = generate_columns(case, prior, POSTURES[:40], [Stage(price, 1e-9)])
    carried = zip(found.plan.shares, case.scaled_jacobians(found.plan.postures), strict=True)
    information = sum(w * b.T @ b for w, b in carried)
    gradient = criterion.gradient(information)
    level = float(np.sum(gradient * information))
    g = np.array([np.trace(gradient @ b.T @ b) for b in jacobians])
    assert abs(gap) <= 1e-9 * level
    assert g.max() == pytest.approx(level, rel=1e-8)
    assert found.level == pytest.approx(level, rel=1e-10)
    p = case.parameters
    assert len(found.plan) <= p * (p + 1) // 2 + 1  # Caratheodory


@pytest.mark.parametrize("criterion", [D(), A(), E()], ids=["D", "A", "E"])
def test_without_time_equal_weights_prove_a_bound(criterion: Criterion) -> None:
    """No weights on the list are better than what the gradient at equal ones allows: none of 200 random mixtures."""
    case, prior = problem(FOUR, criterion=criterion), PriorInformation()
    jacobians = case.scaled_jacobians(POSTURES)
    found, _ = generate_columns(case, prior, POSTURES[:40], [Stage(lambda *_: (POSTURES[:0], 0.0), 1e-9)], lambda: True)
    assert sum(found.plan.shares) == pytest.approx(1.0)
    np.testing.assert_allclose(found.information, np.einsum("kda,kdb->ab", *[jacobians[:40]] * 2) / 40.0, atol=1e-12)
    largest = max(float(np.trace(found.gradient @ b.T @ b)) for b in jacobians)
    bound = criterion.upper_bound(found.information, largest)
    mixtures = np.random.default_rng(1).dirichlet(np.full(200, 0.05), 200)
    assert criterion.value(np.einsum("wk,kda,kdb->wab", mixtures, jacobians, jacobians)).max() <= bound


def test_postures_that_identify_nothing() -> None:
    with pytest.raises(JobError, match="singular on these postures"):
        generate_columns(problem(FOUR), PriorInformation(), np.zeros((20, 4)), [])
