"""The Bayes factor in closed form against the density of the data under its covariance, written out in full."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag, null_space

from identification.gap import marginal_likelihood
from identification.gap.fit import Fit
from identification.gap.marginal_likelihood import ALIKE, SIZES, Decomposition, decomposed, log_bayes_factor
from identification.kinematics.parameters import Parameter, ParameterSet
from identification.status import Status


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


def in_full(data: np.ndarray, base: np.ndarray, blocks: list[np.ndarray], family: bool) -> float:
    """With the covariance of the data written out, and the mean of each effect's size by conditioning on them."""
    rest, factors = null_space(base.T), []
    seen, columns = rest.T @ data, rest.T @ np.hstack(blocks)
    for size in SIZES:
        priors = []
        for block in blocks:
            off = rest.T @ block
            alike = np.ones((block.shape[1],) * 2) + ALIKE**2 * np.eye(block.shape[1])
            prior = alike if family else np.linalg.inv(off.T @ off)
            priors.append(size**2 * prior / np.trace(off @ prior @ off.T))
        prior = block_diag(*priors)
        inverse = np.linalg.inv(np.eye(len(seen)) + columns @ prior @ columns.T)
        gain = prior @ columns.T @ inverse
        mean, spread = gain @ seen, prior - gain @ columns @ prior
        moment, start = 1.0, 0
        for block in blocks:
            own = slice(start, start + block.shape[1])
            information = (rest.T @ block).T @ (rest.T @ block)
            squares = mean[own] @ information @ mean[own] * len(seen) / (seen @ inverse @ seen)
            moment *= (np.trace(information @ spread[own, own]) + squares) / size**2
            start += block.shape[1]
        full = np.eye(len(data)) + np.hstack(blocks) @ prior @ np.hstack(blocks).T
        factors.append(moment * np.exp(log_density(data, base, full) - log_density(data, base, np.eye(len(data)))))
    return float(np.log(np.mean(factors)))


@pytest.mark.parametrize(("sizes", "family"), [([1], False), ([2], False), ([1, 2], False), ([3], True)])
def test_closed_form_is_the_density_of_the_data(sizes: list[int], family: bool) -> None:
    rng = np.random.default_rng(5)
    base, data = rng.standard_normal((12, 2)), 3.0 * rng.standard_normal(12)
    blocks = [rng.standard_normal((12, size)) * 10.0 ** rng.uniform(-2.0, 2.0, size) for size in sizes]
    if family:
        blocks = [rng.standard_normal((12, 3))]
    names = [[f"e{k}.{i}" for i in range(size)] for k, size in enumerate(sizes)]
    found = linear_fit(np.hstack([base, *blocks]), data, ["b1", "b2", *(n for own in names for n in own)])
    before = linear_fit(base, data, ["b1", "b2"])
    groups = decomposed(found, names, [family] * len(sizes))
    factor = log_bayes_factor(groups, np.array(found.squares), before.squares, before.freedom)
    assert float(factor) == pytest.approx(in_full(data, base, blocks, family), abs=1e-8)


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
    groups = Decomposition(np.ones(1), np.ones(1), np.array([score]), np.ones((1, 1, 1)))
    left, squares = float(data @ data) - score**2, float(data @ data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marginal_likelihood, "SIZES", SIZES[:2])
        factor = log_bayes_factor(groups, np.array(left), squares, len(data))
    assert float(factor) == pytest.approx(np.log(np.mean(factors)), abs=1e-3)


def test_a_further_effect_is_a_group_of_its_own() -> None:
    """Orthogonal columns: added to a set or fitted with it, the factor is the same."""
    one = Decomposition(np.ones(1), np.ones(1), np.array([5.0]), np.ones((1, 1, 1)))
    forms = np.array([np.diag([1.0, 0.0, 0.0]), np.diag([0.0, 1.0, 1.0])])
    both = Decomposition(np.array([1.0, 0.5, 0.5]), np.ones(3), np.array([5.0, 4.0, -2.0]), forms)
    longer = log_bayes_factor(one.with_each(np.array([2]), np.array([20.0])), np.array([50.0]), 100.0, 60)
    assert longer[0] == pytest.approx(float(log_bayes_factor(both, np.array(50.0), 100.0, 60)), abs=1e-12)


def test_nothing_explained_is_evidence_against_an_effect() -> None:
    """An effect of lambda >= 6 that is there explains far more than nothing: the moment prior has none of size 0."""
    nothing = Decomposition(np.ones(1), np.ones(1), np.zeros(1), np.ones((1, 1, 1)))
    assert float(log_bayes_factor(nothing, np.array(100.0), 100.0, 100)) < -np.log(6.0**3)


def test_no_effect_has_no_factor() -> None:
    nothing = Decomposition(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 0, 0)))
    assert float(log_bayes_factor(nothing, np.array(100.0), 100.0, 100)) == 0.0


def test_an_effect_that_moves_nothing_explains_nothing() -> None:
    """A wrong payload alone, in a model without compliance: its probability is zero, and no warning."""
    unseen = Decomposition(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((1, 0, 0)))
    assert float(log_bayes_factor(unseen, np.array(100.0), 100.0, 100)) == -np.inf
