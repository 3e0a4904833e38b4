"""Orders of a plan: brute force for short ones, lower bounds and no-gain checks for long ones."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
import pytest

from doe.plan.plan import Plan, ordered, shortest_path, travel
from identification.errors import InputError


def by_hand(postures: np.ndarray, speeds: np.ndarray) -> float:
    return sum(max(abs(a - b) / s for a, b, s in zip(p, q, speeds)) for p, q in zip(postures[:-1], postures[1:]))  # noqa: B905, RUF007


@pytest.mark.parametrize("seed", range(5))
def test_shortest_of_all_permutations(seed: int) -> None:
    generator = np.random.default_rng(seed)
    postures, speeds = generator.uniform(-2, 2, (7, 3)), np.array([1.0, 2.0, 0.5])
    best = min(by_hand(postures[list(p)], speeds) for p in permutations(range(7)))
    path = shortest_path(postures, speeds)
    assert sorted(path) == list(range(7))
    assert travel(postures[path], speeds) == pytest.approx(by_hand(postures[path], speeds))
    assert travel(postures[path], speeds) == pytest.approx(best)


def test_points_on_a_line_are_visited_in_order() -> None:
    """The shortest path on a line is its length, whatever m: 20 and 40 exactly, 100 by 2-opt."""
    for m in (20, 40, 100):
        postures = np.random.default_rng(m).permutation(np.linspace(-1, 1, m))[:, None] * [1.0, 0.3]
        assert travel(postures[shortest_path(postures)]) == pytest.approx(2.0)


def test_long_plans_have_no_exchange_left_and_gain() -> None:
    postures = np.random.default_rng(3).uniform(-2, 2, (60, 4))
    found = postures[shortest_path(postures)]
    assert travel(found) < 0.7 * travel(postures)
    for i, k in combinations(range(1, 60), 2):
        other = np.vstack([found[:i], found[i:k][::-1], found[k:]])
        assert travel(other) >= travel(found) - 1e-9


def test_ordered() -> None:
    plan = Plan(np.random.default_rng(0).uniform(-1, 1, (9, 3)), np.linspace(1, 2, 9) / 13.5)
    np.testing.assert_array_equal(ordered(plan, "given").postures, plan.postures)
    for order in ("random", "travel"):
        found = ordered(plan, order, seed=1)
        rows = [int(np.flatnonzero((plan.postures == p).all(axis=1))[0]) for p in found.postures]
        assert sorted(rows) == list(range(9))
        assert found.weights is not None
        assert plan.weights is not None
        np.testing.assert_array_equal(found.weights, plan.weights[rows])
        assert travel(found.postures) == pytest.approx(by_hand(found.postures, np.ones(3)))
    with pytest.raises(InputError, match="did you mean 'travel'"):
        ordered(plan, "travl")


def test_one_and_two_postures() -> None:
    for m in (1, 2, 3):
        plan = Plan(np.random.default_rng(m).uniform(-1, 1, (m, 2)))
        assert travel(ordered(plan, "travel").postures) <= travel(plan.postures)
