"""The search against the enumeration of all sets of a small dictionary."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.special import logsumexp

from identification.gap.evidence import Products
from identification.gap.search import SOME, TAIL, WRONG, Search, log_odds_of_count, shares

WIDTHS = (1, 2, 1, 1, 2, 1, 1)
STARTS = np.concatenate([[0], np.cumsum(WIDTHS)])
WEIGHTS = np.array([1.0, 0.5, 1.0, 0.2, 0.5, 1.0, 0.0])
ROWS = np.array([False] * 6 + [True])


def products(seed: int, sizes: dict[int, float]) -> Products:
    """40 rows of white noise with contributions of these sizes by column; columns 0 and 3 are alike to 0.9."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(40, STARTS[-1])) / np.sqrt(40.0)
    z[:, 3] = 0.9 * z[:, 0] + 0.44 * z[:, 3]
    y = rng.normal(size=40) + sum((size * z[:, k] for k, size in sizes.items()), np.zeros(40))
    return Products(z.T @ z, z.T @ y, float(y @ y), 36, STARTS, np.zeros(7, dtype=bool))


@pytest.mark.parametrize(
    ("seed", "sizes"), [(1, {}), (2, {0: 8.0}), (3, {0: 10.0, 5: -9.0}), (4, {1: 6.0, 3: 7.0, 6: 9.0})]
)
def test_probabilities_are_those_of_all_sets(seed: int, sizes: dict[int, float]) -> None:
    given = products(seed, sizes)
    search = Search(given, WEIGHTS, ROWS)
    sets = search.posterior()
    found = {one.blocks: p for one, p in zip(sets, shares(sets), strict=True)}
    exact = {}
    for count in range(8):
        for blocks in combinations(range(7), count):
            start = (2,) * count
            exact[blocks] = given.likeliest(blocks, start).ratio + Search(given, WEIGHTS, ROWS).log_prior(blocks)
    total = logsumexp(list(exact.values()))
    assert sum(found.values()) == pytest.approx(1.0)
    for blocks, odds in exact.items():  # neighbors of what was expanded are weighed at the sizes of the others
        assert found.get(blocks, 0.0) == pytest.approx(np.exp(odds - total), abs=0.01)


def test_the_prior_is_that_of_drawing_blocks() -> None:
    """p(K) is normalized, and the probabilities of all sets of K blocks drawn in any order sum to it, nearly."""
    counts = np.array([0.0, *(np.exp(log_odds_of_count(k)) / np.prod(np.arange(1.0, k + 1.0)) for k in range(1, 150))])
    assert counts.sum() == pytest.approx(SOME, rel=1e-4)
    assert counts[2] / counts[1] == pytest.approx(2.0**-TAIL)
    search = Search(products(1, {}), WEIGHTS, ROWS)
    one = [search.log_prior((b,)) for b in range(6)]
    np.testing.assert_allclose(np.exp(one), counts[1] * WEIGHTS[:6] / WEIGHTS.sum())
    assert search.log_prior((6,)) == pytest.approx(np.log(WRONG))
    assert search.log_prior((2, 6)) == pytest.approx(one[2] + np.log(WRONG))


def test_what_contains_another_or_needs_one_is_not_beside_or_without_it() -> None:
    given = products(5, {0: 10.0, 1: 12.0, 7: 12.0})
    apart = Search(given, WEIGHTS, ROWS, frozenset({(0, 2)})).posterior()
    assert not any({0, 2} <= set(one.blocks) for one in apart)
    needy = Search(given, WEIGHTS, ROWS, frozenset(), frozenset({5}), frozenset({1})).posterior()
    assert any(5 in one.blocks for one in needy)
    assert all(1 in one.blocks for one in needy if 5 in one.blocks)


def test_two_blocks_that_hide_each_other_are_found() -> None:
    rng = np.random.default_rng(6)
    z = rng.normal(size=(60, 12)) / np.sqrt(60.0)
    z[:, 1] = -0.97 * z[:, 0] + 0.24 * z[:, 1]
    y = rng.normal(size=60) + 40.0 * (z[:, 0] + z[:, 1])
    given = Products(z.T @ z, z.T @ y, float(y @ y), 56, np.arange(13), np.zeros(12, dtype=bool))
    best = Search(given, np.ones(12), np.zeros(12, dtype=bool)).posterior()[0]
    assert best.blocks == (0, 1)
