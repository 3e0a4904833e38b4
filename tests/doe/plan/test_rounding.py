"""Efficient apportionment: the properties that Pukelsheim and Rieder prove."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.plan.plan import Plan, apportion, rounded_plan
from identification.errors import InputError


@settings(max_examples=100)
@given(st.integers(1, 12), st.integers(0, 60), st.integers(0, 2**32 - 1))
def test_sums_and_guaranteed_efficiency(k: int, more: int, seed: int) -> None:
    weights = np.random.default_rng(seed).dirichlet(np.ones(k)) * 0.98 + 0.02 / k
    runs = k + more
    numbers = apportion(weights / weights.sum(), runs)
    assert numbers.sum() == runs
    assert numbers.min() >= 1
    # an apportionment is efficient exactly if no move of one run raises the smallest n_i / (m w_i)  (their eq. 3)
    shares = weights / weights.sum()
    assert np.min(numbers / shares) >= np.max((numbers - 1) / shares) - 1e-9
    assert np.min(numbers / (runs * shares)) >= 1 - k / runs


def test_whole_shares_stay() -> None:
    np.testing.assert_array_equal(apportion(np.array([0.5, 0.25, 0.25]), 8), [4, 2, 2])


def test_fewer_runs_than_postures() -> None:
    np.testing.assert_array_equal(apportion(np.array([0.1, 0.4, 0.2, 0.3]), 2), [0, 1, 0, 1])


def test_rounded() -> None:
    plan = Plan(np.array([[1.0], [2.0], [3.0]]), np.array([0.5, 0.0, 0.5]))
    np.testing.assert_array_equal(rounded_plan(plan, 4).ravel(), [1, 1, 3, 3])


@pytest.mark.parametrize("weights", [[0.5, 0.4], [1.1, -0.1], [1.0, 0.0]])
def test_bad_weights(weights: list[float]) -> None:
    with pytest.raises(InputError, match="sum one"):
        apportion(np.array(weights), 5)
