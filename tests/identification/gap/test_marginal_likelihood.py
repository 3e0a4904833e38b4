"""The Bayes factor in closed form against the density of the data under its covariance, written out in full."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import null_space

from identification.gap.fit import Fit
from identification.gap.marginal_likelihood import ALIKE, SIZES, Explained, explained, log_bayes_factor
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
    rest = null_space(base.T)
    densities = []
    for size in SIZES:
        covariance = np.eye(len(data))
        for block in blocks:
            off = rest.T @ block
            alike = np.ones((block.shape[1],) * 2) + ALIKE**2 * np.eye(block.shape[1])
            prior = alike if family else np.linalg.inv(off.T @ off)
            covariance += size**2 * block @ (prior / np.trace(off @ prior @ off.T)) @ block.T
        densities.append(log_density(data, base, covariance))
    nothing = log_density(data, base, np.eye(len(data)))
    return float(np.log(np.mean(np.exp(np.array(densities) - nothing))))


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
    groups = explained(found, names, [family] * len(sizes))
    factor = log_bayes_factor(groups, np.array(found.squares), before.squares, before.freedom)
    assert float(factor) == pytest.approx(in_full(data, base, blocks, family), abs=1e-8)


def test_a_further_effect_is_a_group_of_its_own() -> None:
    """Orthogonal columns: added to a set or fitted with it, the factor is the same."""
    first, second = Explained(np.ones(1), np.ones(1), np.array([30.0])), (np.array([2]), np.array([20.0]))
    both = Explained(np.array([1.0, 0.5, 0.5]), np.ones(3), np.array([30.0, 12.0, 8.0]))
    longer = log_bayes_factor(first.with_each(*second), np.array([50.0]), 100.0, 60)
    assert longer[0] == pytest.approx(float(log_bayes_factor(both, np.array(50.0), 100.0, 60)), abs=1e-12)


def test_nothing_explained_is_evidence_against_an_effect() -> None:
    """An effect of lambda >= 6 that is there explains far more than nothing."""
    nothing = Explained(np.ones(1), np.ones(1), np.zeros(1))
    assert float(log_bayes_factor(nothing, np.array(100.0), 100.0, 100)) < -np.log(6.0)
