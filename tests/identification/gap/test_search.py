"""The search against the enumeration of all sets of a small dictionary."""

from itertools import combinations, product
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp, softmax, zeta
from scipy.stats import norm

from identification import Array
from identification.gap import search as search_module
from identification.gap.blocks import Block
from identification.gap.likelihood import SIZES, Products
from identification.gap.search import SPREAD, STRAY, TAIL, WRONG, Search, Weighed, log_odds_of_count, log_odds_of_sizes
from tests.identification.gap.test_likelihood import products_of

WIDTHS = (1, 2, 1, 1)
STARTS = np.concatenate([[0], np.cumsum(WIDTHS)])
WEIGHTS = np.array([1.0, 0.5, 1.0, 0.0])
BLOCKS = [Block(f"{k}", "time", weight, rows=(0,) if k == 3 else ()) for k, weight in enumerate(WEIGHTS.tolist())]


@pytest.fixture(autouse=True)
def _long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Walks so long that what they find is where they lead to."""
    monkeypatch.setattr(search_module, "MOVES", 6000)


def products(seed: int, sizes: dict[int, float]) -> Products:
    """40 rows of white noise with contributions of these sizes by column; columns 0 and 3 are alike to 0.9."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(40, STARTS[-1])) / np.sqrt(40.0)
    z[:, 3] = 0.9 * z[:, 0] + 0.44 * z[:, 3]
    y = rng.normal(size=40) + sum((size * z[:, k] for k, size in sizes.items()), np.zeros(40))
    return products_of(z, y, 36, STARTS, np.zeros(len(WIDTHS), dtype=bool))


def log_of_sizes(sizes: Array) -> Array:
    """(...) log probability of sizes (..., k) around a common one, that is any with equal probability."""
    near = norm.pdf(*np.meshgrid(np.arange(len(SIZES)), np.arange(len(SIZES))), SPREAD)
    chances = (1.0 - STRAY) * near / near.sum(axis=1, keepdims=True) + STRAY / len(SIZES)
    return np.asarray(np.log(np.mean(np.prod(chances[:, sizes], axis=-1), axis=0)))


def exact(search: Search) -> dict[tuple[int, ...], float]:
    """Probability of every set, of all combinations of sizes."""
    these, odds = search.products, {}
    for blocks in (b for k in range(len(WIDTHS) + 1) for b in combinations(range(len(WIDTHS)), k)):
        if np.isfinite(prior := search.log_prior(blocks)):
            sizes = np.array([*product(range(len(SIZES)), repeat=len(blocks))], dtype=int)
            places = these.columns_of(blocks)
            d = np.repeat(SIZES[sizes], [WIDTHS[b] for b in blocks], axis=1)
            wide = np.eye(len(places)) + d[:, :, None] * these.gram[np.ix_(places, places)] * d[:, None, :]
            right = d * these.right[places]
            left = these.squares - np.sum(right * np.linalg.solve(wide, right[:, :, None])[:, :, 0], axis=1)
            ratios = -0.5 * np.linalg.slogdet(wide)[1] - 0.5 * these.freedom * np.log(left / these.squares)
            alike = sizes[:, search.counted[list(blocks)]]
            of_rows = (len(blocks) - alike.shape[1]) * np.log(len(SIZES))
            odds[blocks] = prior + logsumexp(ratios + log_of_sizes(alike)) - of_rows
    total = logsumexp(list(odds.values()))
    return {blocks: float(np.exp(o - total)) for blocks, o in odds.items()}


def blocks_of(one: Weighed) -> tuple[int, ...]:
    return tuple(block for block, _ in one[0])


def variation(search: Search, sets: list[Weighed]) -> float:
    """Total variation between what a walk found and all sets."""
    shares = softmax([log_odds for _, log_odds in sets]).tolist()
    found = {blocks_of(one): p for one, p in zip(sets, shares, strict=True)}
    return 0.5 * sum(abs(p - found.get(blocks, 0.0)) for blocks, p in exact(search).items())


@pytest.mark.parametrize(("seed", "sizes"), [(1, {}), (3, {0: 10.0, 4: -9.0}), (4, {1: 4.0, 3: 5.0})])
def test_a_walk_finds_the_probabilities_of_all_sets(seed: int, sizes: dict[int, float]) -> None:
    search = Search(products(seed, sizes), BLOCKS)
    sets = search.walk(search.climb(), np.random.default_rng(seed))[0]
    assert variation(search, sets) < 0.05
    # and the evidence against nothing
    assert logsumexp([odds for _, odds in sets]) == pytest.approx(-np.log(exact(search)[()]), abs=0.1)


def test_a_walk_keeps_to_what_may_be_together() -> None:
    """Blocks 0 and 2 are one, 3 shows through 0 and 1."""
    search = Search(products(5, {0: 10.0, 1: 12.0, 4: 12.0}), BLOCKS)
    search.apart[0, 2] = search.apart[2, 0] = search.needy[3] = search.givers[0] = search.givers[1] = True
    sets = search.walk(search.climb(), np.random.default_rng(1))[0]
    assert not any({0, 2} <= set(blocks_of(one)) for one in sets)
    assert any(3 in blocks_of(one) for one in sets)
    assert all({0, 1} <= set(blocks_of(one)) for one in sets if 3 in blocks_of(one))
    assert variation(search, sets) < 0.05


def test_a_walk_among_the_near_blocks_has_the_same_odds() -> None:
    """Blocks that are left out take their weight along, and all sets with them are unlikely together."""
    search = Search(products(3, {0: 25.0, 4: -25.0}), BLOCKS)
    near = search.near(search.climb())
    assert sum(p for blocks, p in exact(search).items() if not set(blocks) <= set(near)) < 0.05
    few = Search(search.products.of_blocks(near), [BLOCKS[b] for b in near], search.total)
    assert few.log_prior((near.index(0),)) == pytest.approx(search.log_prior((0,)))


def test_the_prior_is_that_of_drawing_blocks() -> None:
    """p(K) is normalized, and of K blocks drawn one after the other each set has the probability of all its orders."""
    counts = np.array([0.0, *(np.exp(log_odds_of_count(k)) / np.prod(np.arange(1.0, k + 1.0)) for k in range(1, 150))])
    assert counts.sum() + 1.0 / zeta(TAIL) * zeta(TAIL, 150) == pytest.approx(1.0, rel=1e-10)
    assert counts[2] / counts[1] == pytest.approx(2.0**-TAIL)
    search = Search(products(1, {}), BLOCKS)
    chances = WEIGHTS[:3] / WEIGHTS[:3].sum()
    one = [search.log_prior((b,)) for b in range(3)]
    np.testing.assert_allclose(np.exp(one), counts[1] * chances)
    for k in (1, 2, 3):
        drawn = [np.prod(chances[list(d)]) for d in product(range(3), repeat=k) if len(set(d)) == k]
        every = [np.exp(search.log_prior(blocks)) for blocks in combinations(range(3), k)]
        assert sum(every) == pytest.approx(counts[k] * sum(drawn))
    assert search.log_prior((3,)) == pytest.approx(np.log(WRONG))
    assert search.log_prior((2, 3)) == pytest.approx(one[2] + np.log(WRONG))


@given(st.lists(st.integers(0, len(SIZES) - 1), max_size=8), st.randoms(use_true_random=False))
def test_sizes_are_exchangeable(sizes: list[int], random: Random) -> None:
    """In whatever order effects are seen, what each tells of the next one makes up what is likely of all."""
    random.shuffle(sizes)
    one_by_one = sum(log_odds_of_sizes(sizes[:k])[1][size] for k, size in enumerate(sizes))
    assert log_odds_of_sizes(sizes)[0] == pytest.approx(one_by_one, abs=1e-9)
    assert log_odds_of_sizes(sizes)[0] == pytest.approx(float(log_of_sizes(np.array(sizes, dtype=int))), abs=1e-9)
    assert np.exp(log_odds_of_sizes(sizes)[1]).sum() == pytest.approx(1.0)


def test_two_blocks_that_hide_each_other_are_found() -> None:
    rng = np.random.default_rng(6)
    z = rng.normal(size=(60, 12)) / np.sqrt(60.0)
    z[:, 1] = -0.97 * z[:, 0] + 0.24 * z[:, 1]
    y = rng.normal(size=60) + 40.0 * (z[:, 0] + z[:, 1])
    these = products_of(z, y, 56, np.arange(13), np.zeros(12, dtype=bool))
    search = Search(these, [Block(f"{k}", "time", 1.0) for k in range(12)])
    assert search.climb().blocks == (0, 1)
    assert blocks_of(search.walk(search.climb(), np.random.default_rng(1))[0][0]) == (0, 1)


def test_the_climb_ends_where_rows_are_fitted_exactly() -> None:
    """Without noise every further block makes what is left smaller, in the ratio of rounding."""
    z = np.random.default_rng(7).normal(size=(12, 40)) / np.sqrt(12.0)
    these = products_of(z, z[:, :3] @ [40.0, -30.0, 20.0], 9, np.arange(41), np.zeros(40, dtype=bool))
    assert len(Search(these, [Block(f"{k}", "time", 1.0) for k in range(40)]).climb().blocks) <= 9
