"""The Bayes factor in closed form against the density of the data under its covariance, written out in full."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag, null_space

from identification.gap.fits.fit import Fit
from identification.gap.probability import marginal_likelihood
from identification.gap.probability.marginal_likelihood import ALIKE, SIZES, Decomposition, decomposed, log_bayes_factor
from identification.kinematics.parameters import Parameter, ParameterSet
from identification.status import Status

THREE = np.array([0, 1, 1])  # effects of three amplitudes


class Linear:
    """Stands for a model with two base parameters and those of the effects."""

    def __init__(self, names: list[str]) -> None:
        self.parameters = ParameterSet(tuple(Parameter(name, "mm") for name in names))
        self.scales = np.ones(len(names))


def linear_fit(columns: np.ndarray, data: np.ndarray, names: list[str]) -> Fit:
    values = np.linalg.lstsq(columns, data, rcond=None)[0]
    free = np.ones(len(values), dtype=bool)
    model: Any = Linear(names)
    rows: Any = None
    return Fit(model, rows, values, data - columns @ values, columns, free, len(values), Status.converged)


def log_density(data: np.ndarray, base: np.ndarray, covariance: np.ndarray) -> float:
    """Of the data off the base columns, sigma^2 integrated over 1 / sigma, up to a constant."""
    rest = null_space(base.T)
    seen, inner = rest.T @ data, rest.T @ covariance @ rest
    return float(-0.5 * np.linalg.slogdet(inner)[1] - 0.5 * len(seen) * np.log(seen @ np.linalg.solve(inner, seen)))


def in_full(data: np.ndarray, base: np.ndarray, blocks: list[np.ndarray], family: bool) -> np.ndarray:
    """(sizes, sizes, ..) log factor for the sizes of each effect, with the covariance of the data written out, and the
    mean of what each effect explains by conditioning on them."""
    rest = null_space(base.T)
    seen, columns = rest.T @ data, rest.T @ np.hstack(blocks)
    factors = []
    for sizes in product(SIZES, repeat=len(blocks)):
        priors = []
        for block, size in zip(blocks, sizes, strict=True):
            off = rest.T @ block
            alike = np.ones((block.shape[1],) * 2) + ALIKE**2 * np.eye(block.shape[1])
            prior = alike if family else np.linalg.inv(off.T @ off)
            priors.append(size**2 * prior / np.trace(off @ prior @ off.T))
        prior = block_diag(*priors)
        inverse = np.linalg.inv(np.eye(len(seen)) + columns @ prior @ columns.T)
        gain = prior @ columns.T @ inverse
        mean, spread = gain @ seen, np.linalg.inv(np.linalg.inv(prior) + columns.T @ columns)
        moment, start = 1.0, 0
        for block, size in zip(blocks, sizes, strict=True):
            own = slice(start, start + block.shape[1])
            information = (rest.T @ block).T @ (rest.T @ block)
            squares = mean[own] @ information @ mean[own] * len(seen) / (seen @ inverse @ seen)
            moment *= (np.trace(information @ spread[own, own]) + squares) / size**2
            start += block.shape[1]
        full = np.eye(len(data)) + np.hstack(blocks) @ prior @ np.hstack(blocks).T
        factors.append(np.log(moment) + log_density(data, base, full) - log_density(data, base, np.eye(len(data))))
    return np.reshape(factors, (len(SIZES),) * len(blocks))


def averaged(factors: np.ndarray) -> float:
    """The factor where it is largest, times the average of each effect relative to it with the others there."""
    there = np.unravel_index(np.argmax(factors), factors.shape)
    lines = [factors[(*there[:k], slice(None), *there[k + 1 :])] for k in range(factors.ndim)]
    return float(factors[there] + sum(np.log(np.mean(np.exp(line - factors[there]))) for line in lines))


@pytest.mark.parametrize(("sizes", "family"), [([1], False), ([2], False), ([1, 2], False), ([3], True)])
def test_closed_form_is_the_density_of_the_data(sizes: list[int], family: bool) -> None:
    rng = np.random.default_rng(5)
    base, data = rng.standard_normal((12, 2)), 3.0 * rng.standard_normal(12)
    blocks = [rng.standard_normal((12, size)) * 10.0 ** rng.uniform(-2.0, 2.0, size) for size in sizes]
    factor = factor_of(data, base, blocks, family)
    assert factor == pytest.approx(averaged(in_full(data, base, blocks, family)), abs=1e-8)


def factor_of(data: np.ndarray, base: np.ndarray, blocks: list[np.ndarray], family: bool = False) -> float:
    """`log_bayes_factor` of these effects."""
    names = [[f"e{k}.{i}" for i in range(block.shape[1])] for k, block in enumerate(blocks)]
    bases = [f"b{k}" for k in range(base.shape[1])]
    found = linear_fit(np.hstack([base, *blocks]), data, [*bases, *(n for own in names for n in own)])
    before = linear_fit(base, data, bases)
    groups = decomposed(found, names, [family] * len(blocks))
    return float(log_bayes_factor(groups, found.squares, before.squares, before.freedom))


@pytest.mark.parametrize("amplitudes", [(9.0, 11.0), (8.0, 2000.0)])
def test_effects_are_averaged_one_by_one(amplitudes: tuple[float, float]) -> None:
    """Against the average over all pairs of sizes, of effects with something in common (cosine 0.5): what sigma and the
    common part tie together is worth less than odds of 1.2."""
    rng = np.random.default_rng(6)
    base = rng.standard_normal((60, 2))
    first, other = np.linalg.qr(np.hstack([base, rng.standard_normal((60, 2))]))[0][:, 2:].T
    blocks = [first[:, None], (0.5 * first + np.sqrt(0.75) * other)[:, None]]
    data = rng.standard_normal(60) + np.hstack(blocks) @ amplitudes
    factors = in_full(data, base, blocks, family=False)
    assert factor_of(data, base, blocks) == pytest.approx(float(np.log(np.mean(np.exp(factors)))), abs=np.log(1.2))


def test_each_effect_has_a_size_of_its_own() -> None:
    """A small effect is as clear beside one of any size: with one size for both the large one would hide it."""
    rng = np.random.default_rng(7)
    columns = np.linalg.qr(rng.standard_normal((100, 3)))[0]
    base, small, large = columns[:, :1], columns[:, 1:2], columns[:, 2:]
    noise = rng.standard_normal(100)
    noise -= columns @ (columns.T @ noise)
    gains = []
    for size in (10.0, 20000.0):
        data = noise + columns @ [0.0, 10.0, size]
        gains.append(factor_of(data, base, [small, large]) - factor_of(data, base, [large]))
    assert gains[1] == pytest.approx(gains[0], abs=1.0)
    assert min(gains) > 20.0


def test_closed_form_is_the_integral_over_amplitude_and_sigma() -> None:
    """One amplitude, no base parameters: midpoint sums over x = amplitude / sigma and log sigma, 1e-4 accurate."""
    data, column = np.array([3.0, -1.0, 0.5, 2.0]), np.array([0.5, -0.5, 0.5, 0.5])
    x, log_sigma = np.linspace(-80.0, 80.0, 4001), np.linspace(-4.0, 7.0, 221)
    sigma = np.exp(log_sigma)

    def likelihood(amplitude: np.ndarray) -> np.ndarray:
        misfit = data[:, None, None] - column[:, None, None] * amplitude[None, :, None] * sigma
        return np.exp(-0.5 * np.sum((misfit / sigma) ** 2, axis=0)) * sigma ** -len(data)

    nothing = likelihood(np.zeros(1)).sum()
    factors = []
    for size in SIZES[:2]:
        prior = x**2 / size**2 * np.exp(-0.5 * x**2 / size**2) / np.sqrt(2.0 * np.pi) / size
        factors.append((likelihood(x) * prior[:, None]).sum() * (x[1] - x[0]) / nothing)
    score = float(data @ column)
    groups = Decomposition(np.ones((1, 1)), np.array([score]), np.zeros(1, dtype=int))
    left, squares = float(data @ data) - score**2, float(data @ data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marginal_likelihood, "SIZES", SIZES[:2])
        factor = log_bayes_factor(groups, left, squares, len(data))
    assert float(factor) == pytest.approx(np.log(np.mean(factors)), abs=1e-3)


def test_a_further_effect_is_an_effect_of_its_own() -> None:
    """Orthogonal columns and one size: added to a set or fitted with it, the factor is the same."""
    one = Decomposition(np.ones((1, 1)), np.array([5.0]), np.zeros(1, dtype=int))
    both = Decomposition(np.diag([1.0, 0.5, 0.5]), np.array([5.0, *(np.sqrt(2.0) * np.array([4.0, -2.0]))]), THREE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marginal_likelihood, "SIZES", SIZES[:1])
        longer = log_bayes_factor(one.with_each(np.array([2]), np.array([20.0])), 70.0, 100.0, 60)
        assert longer[0] == pytest.approx(float(log_bayes_factor(both, 50.0, 100.0, 60)), abs=1e-12)


def test_nothing_explained_is_evidence_against_an_effect() -> None:
    """An effect of lambda >= 6 that is there explains far more than nothing: the moment prior has none of size 0."""
    nothing = Decomposition(np.ones((1, 1)), np.zeros(1), np.zeros(1, dtype=int))
    assert float(log_bayes_factor(nothing, 100.0, 100.0, 100)) < -np.log(6.0**3)


def test_no_effect_has_no_factor() -> None:
    nothing = Decomposition(np.zeros((0, 0)), np.zeros(0), np.zeros(0, dtype=int))
    assert float(log_bayes_factor(nothing, 100.0, 100.0, 100)) == 0.0


def test_an_effect_that_moves_nothing_explains_nothing() -> None:
    """A wrong payload alone, in a model without compliance: its probability is zero, and no warning."""
    unseen = Decomposition(np.zeros((1, 1)), np.zeros(1), np.zeros(1, dtype=int))
    assert float(log_bayes_factor(unseen, 100.0, 100.0, 100)) == -np.inf


@pytest.mark.parametrize("seed", [0, 2, 6, 9, 10, 22])
def test_sizes_are_found_where_rounding_makes_up_a_rise(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two effects of which the data show one combination each, without noise: the search for sizes ends, and nothing is
    more evident than the best fit: sigma^36 in the likelihood, moments up to the largest amplitude over sigma."""
    rng, calls = np.random.default_rng(seed), []
    common = np.eye(2) + 0.3 * rng.standard_normal((2, 2))
    shown = rng.standard_normal((2, 2))
    factor = (unit(shown)[:, :, None] * unit(common)[:, None, :]).reshape(4, 2)
    groups = Decomposition(factor @ factor.T, 1e7 * rng.standard_normal(4), np.array([0, 0, 1, 1]))
    squares, left = float(groups.amplitudes @ groups.information @ groups.amplitudes), 1e-12
    around = marginal_likelihood._Posterior.around

    def counted(found: Decomposition, sizes: np.ndarray) -> Any:
        calls.append(sizes)
        assert len(calls) < 1000
        return around(found, sizes)

    monkeypatch.setattr(marginal_likelihood._Posterior, "around", counted)
    most = 0.5 * 36 * np.log(squares / left) + 2.0 * np.log(36.0 * squares / left)
    assert 0.0 < float(log_bayes_factor(groups, left, squares, 36)) < most


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1)[:, None]
