"""Weights made proper, and Caratheodory's reduction to few postures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.bounds.weights import clearly_independent, proper_weights, sparsest
from identification.errors import InputError


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


def test_independent_information_is_left_alone() -> None:
    """Six matrices of twenty parameters are independent; not with a multiple, a zero, or more than entries."""
    generator = np.random.default_rng(0)
    jacobians = generator.standard_normal((6, 2, 20))
    weights = generator.dirichlet(np.ones(6))
    assert clearly_independent(jacobians)
    assert sparsest(jacobians, weights) == pytest.approx(weights, abs=1e-15)
    assert not clearly_independent(np.concatenate([jacobians, 2.0 * jacobians[:1]]))
    assert not clearly_independent(generator.standard_normal((7, 2, 3)))
    assert not clearly_independent(np.concatenate([jacobians, np.zeros((1, 2, 20))]))


def test_proper_weights() -> None:
    assert proper_weights(np.array([0.3, -1e-9, 0.9])) == pytest.approx([0.25, 0.0, 0.75], abs=1e-15)
    for bad in ([0.0, 0.0], [-1.0, -2.0], [np.nan, 1.0]):
        with pytest.raises(InputError, match="weights"):
            proper_weights(np.array(bad))
