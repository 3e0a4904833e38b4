"""How often must a wave of unknown order at a joint be missed? The power of tests that know the simulator.

    .venv/bin/pytest -m benchmark -s tests/benchmarks/test_wave_limit.py

Off the geometry a wave is two unit columns of every order and joint. Two tests of all of them at once, for orders from
3 to 256 per turn in steps of 1/4, each with exactly the level that `diagnose` has where nothing is named (white noise
reaches 0.6 of Bonferroni's): the largest F statistic, which does not know sigma, and the likelihood ratio averaged over
joints, orders and phases, which knows sigma and lambda and is the most powerful of all on that average.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ive

from doe.studies.blind import cells, hidden_effects, simulator, spatial_cells, spatial_hidden_effects, spatial_simulator
from identification.gap.outside.unmodelled_survey import LEVEL_FIRST

SETS, NULL, DRAWS, ORDERS = 8, 1000, 200, np.arange(3.0, 256.25, 0.25)
LEVEL = 0.6 * LEVEL_FIRST
CONSTANT = {"a": 1.0, "b": 0.0, "k": 0.0}  # a wave of no period: the lever of a joint
Problem = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def planar(cell: str, number: int) -> Problem:
    """(N, r) basis of the geometry, (n, m, d) levers, (m, n) angles, (N,) the hidden wave in units of sigma."""
    spec = cells.CELLS[cell]
    rng = np.random.default_rng([20261121, list(cells.CELLS).index(cell), number])
    truth, q = cells._undesigned(spec, rng)
    run = simulator.session(truth, q, rng)
    effect = cells.hidden(spec, truth, run, rng)[0]

    def column(one: tuple) -> np.ndarray:
        return hidden_effects.column(truth, run, one)

    levers = np.array([column((effect[0], j + 1, CONSTANT)) for j in range(truth.n)]).reshape(truth.n, len(q), -1)
    return np.linalg.qr(hidden_effects.base_jacobian(truth, run))[0], levers, q, column(effect) / truth.sigma


def spatial(cell: str, number: int) -> Problem:
    """The same of a six-axis arm."""
    spec = spatial_cells.CELLS[cell]
    rng = np.random.default_rng([20261125, list(spatial_cells.CELLS).index(cell), number])
    truth = spatial_cells.random_truth(spec, rng)
    run, _ = (spatial_cells._session(spec, truth, count, rng) for count in (spec.m, spatial_cells.FRESH))
    spatial_cells.arm_of(spec, truth, rng)
    marker = spatial_cells.markers(spec, run)
    (effect,) = spatial_cells.hidden(spec, truth, run, rng)
    bare = replace(truth, effects=[])

    def column(one: tuple) -> np.ndarray:
        return spatial_hidden_effects.column(bare, run, marker, one)

    levers = np.array([column((effect[0], j + 1, CONSTANT)) for j in range(truth.n)]).reshape(truth.n, len(run.q), -1)
    left, sizes, _ = np.linalg.svd(spatial_simulator.base_jacobian(bare, run, marker), full_matrices=False)
    return left[:, sizes > 1e-9 * sizes[0]], levers, run.q, column(effect) / truth.sigma


def waves(basis: np.ndarray, levers: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N, 2S) orthonormal pairs of the waves of all orders at all joints, off the geometry; unseen joints left out."""
    pairs = []
    for lever, angle in zip(levers, q.T, strict=True):
        if np.linalg.norm(lever) < 1e-3 * np.linalg.norm(levers[0]):
            continue
        turned = np.multiply.outer(ORDERS, angle)
        both = np.stack([np.cos(turned), np.sin(turned)], axis=-1)[:, :, None, :] * lever[None, :, :, None]
        both = both.reshape(len(ORDERS), len(basis), 2)
        pairs.append(np.linalg.qr(both - basis @ (basis.T @ both))[0])
    return np.concatenate(pairs).transpose(1, 0, 2).reshape(len(basis), -1).astype(np.float32)


def statistics(pairs: np.ndarray, basis: np.ndarray, data: np.ndarray, lam: float = 8.0) -> tuple[np.ndarray, ...]:
    """(B,) share of the squares that the best wave explains, and log of the mean likelihood ratio, of data (N, B)."""
    explained, ratio = [], []
    for some in np.array_split(data - basis @ (basis.T @ data), max(data.shape[1] // 200, 1), axis=1):
        lengths = np.sqrt(np.square(pairs.T @ some.astype(np.float32)).reshape(-1, 2, some.shape[1]).sum(axis=1))
        explained.append(lengths.max(axis=0) ** 2 / np.square(some).sum(axis=0))
        most = lam * lengths.max(axis=0)
        ratio.append(most + np.log(np.mean(ive(0, lam * lengths) * np.exp(lam * lengths - most), axis=0)))
    return np.concatenate(explained), np.concatenate(ratio)


def missed(problem: Problem, rng: np.random.Generator) -> list[float]:
    """Share of draws of the noise with which each test misses the wave."""
    basis, levers, q, hidden = problem
    pairs = waves(basis, levers, q)
    nothing = statistics(pairs, basis, rng.standard_normal((len(basis), NULL)))
    there = statistics(pairs, basis, hidden[:, None] + rng.standard_normal((len(basis), DRAWS)))
    return [float(np.mean(x <= np.quantile(n, 1.0 - LEVEL))) for x, n in zip(there, nothing, strict=True)]


@pytest.mark.benchmark
@pytest.mark.parametrize("cell", [*(f"wave {k:g}, lambda 8" for k in cells.WAVES), "space, wave 101, lambda 8"])
def test_waves_that_must_be_missed(cell: str) -> None:
    drawn = spatial if cell in spatial_cells.CELLS else planar
    rng = np.random.default_rng(1)
    found = np.array([missed(drawn(cell, number), rng) for number in range(SETS)])
    error = found.std(axis=0, ddof=1) / np.sqrt(SETS)
    said = [f"{mean:.3f} +- {e:.3f}" for mean, e in zip(found.mean(axis=0), error, strict=True)]
    print(f"\n{cell}, {SETS} sets: missed by the largest F {said[0]}, by the most powerful test {said[1]}")
    assert np.all(found.mean(axis=0) < 0.05)
