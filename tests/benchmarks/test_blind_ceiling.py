"""How well could anybody name the hidden effects of the blind study? The Bayes classifier that knows the simulator.

    .venv/bin/pytest -m benchmark -s tests/benchmarks/test_blind_ceiling.py

It knows what no user knows: sigma, the size lambda of the effect, the distributions from which the simulator drew
phases, orders and stiffnesses, and that there is one effect. With the most probable name it is right more often than
any other rule can be (on average over the simulator's draws), so its shares are the ceiling for `armcal study blind`.

For a hypothesis h with unit columns u_s off the base Jacobian, s drawn as the simulator draws them, the likelihood of
the whitened residual r against no effect is mean_s exp(lambda u_s . r - lambda^2 / 2).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from tests.identification.gap import blind

COUNT = 400
PHASES = np.arange(48) * 2.0 * np.pi / 48
CIRCLE = np.vstack([np.cos(PHASES), np.sin(PHASES)])
PAIRS = {"encoder_eccentricity": "ab", "encoder_second_harmonic": "ab", "axes_skew": "ab", "transmission_ripple": "ab"}
PAIRS |= {"base_offset": "xy", "base_drift": "xy"}
SAGGING = ("joint_compliance", "gravity_backlash", "link_bending")  # of one sign only
CELLS = ["one, lambda 6, m=50", "one, lambda 6, m=200", "one, lambda 8, m=50", "one, lambda 8, m=20"]


def log_mean(x: np.ndarray) -> float:
    return float(x.max() + np.log(np.mean(np.exp(x - x.max()))))


def directions(bare: blind.Truth, run: blind.Session, name: str, j: int | None) -> Iterator[np.ndarray]:
    """(2m, S) sampled columns of an effect, one array per order of a ripple."""

    def probe(values: dict) -> np.ndarray:
        return blind.column(bare, run, (name.rstrip("*"), j, values))

    if name in PAIRS:
        for k in range(3, 65) if name == "transmission_ripple" else [None]:
            order = {} if k is None else {"k": k}
            both = [probe({c: float(c == one) for c in PAIRS[name]} | order) for one in PAIRS[name]]
            yield np.column_stack(both) @ CIRCLE
    elif name == "joint_compliance*":
        each = [blind.column(bare, run, ("joint_compliance", i + 1, {"c": 1.0})) for i in range(bare.n)]
        yield np.column_stack(each) @ np.random.default_rng(1).uniform(0.5, 1.5, (bare.n, 400))
    else:
        one = probe(blind.directions_of(name, bare.n, np.random.default_rng(0)))[:, None]
        yield one if name in SAGGING else np.hstack([one, -one])


def posterior(cell: str, seed: int) -> tuple[dict[str, float], str]:
    """Key -> log posterior (up to a constant) for one data set, and the key that is hidden."""
    spec = blind.CELLS[cell]
    assert spec.lam is not None
    lam = spec.lam
    rng = np.random.default_rng([20261121, list(blind.CELLS).index(cell), seed])
    truth = blind.truth_of(spec, rng)
    m = max(spec.m, truth.n + 4)
    run = blind.session(truth, rng.uniform(truth.lower, truth.upper, (m, truth.n)), rng)
    truth = replace(truth, effects=blind.hidden(spec, truth, run, rng))
    bare = replace(truth, effects=[])
    measured = blind.position(truth, run) + blind.noise(truth, run, rng, spec.noise)
    miss = (measured - blind.position(bare, run)) / truth.sigma
    basis = np.linalg.qr(blind.base_jacobian(truth, run))[0]

    def off(columns: np.ndarray) -> np.ndarray:
        return columns - basis @ (basis.T @ columns)

    residual = off(np.column_stack([miss.real, miss.imag]).ravel())

    def likelihood(columns: np.ndarray) -> float:
        seen = off(columns)
        norms = np.linalg.norm(seen, axis=0)
        keep = norms >= 0.02 * np.linalg.norm(columns, axis=0)  # the simulator draws again what cannot be seen
        if not keep.any():
            return -np.inf
        return log_mean(lam * (residual @ (seen[:, keep] / norms[keep])) - lam**2 / 2.0)

    found = {}
    for name in blind.LIBRARY_JOINT + blind.LIBRARY_WHOLE:
        whole = name in blind.LIBRARY_WHOLE
        joints = [None] if whole else range(2 if name == "joint_coupling" else 1, truth.n + 1)
        for j in joints:
            parts = [likelihood(columns) for columns in directions(bare, run, name, j)]
            key = blind.key((name.rstrip("*"), j, {}))
            found[key] = log_mean(np.array(parts)) - np.log(len(joints))
    return found, blind.key(truth.effects[0])


def class_of(key: str) -> str:
    return blind.family((key.partition(":")[0], None, {}))


@pytest.mark.benchmark
@pytest.mark.parametrize("cell", CELLS)
def test_ceiling(cell: str) -> None:
    exact, classes, inside, sizes = [], [], [], []
    for seed in range(COUNT):
        found, hidden = posterior(cell, seed)
        best = max(found, key=lambda key: found[key])
        families: dict[str, float] = {}
        for key, value in found.items():
            families[class_of(key)] = float(np.logaddexp(families.get(class_of(key), -np.inf), value))
        near = [key for key, value in found.items() if value > found[best] - 3.0]  # as Delta BIC <= 6
        exact.append(best == hidden)
        classes.append(max(families, key=lambda name: families[name]) == class_of(hidden))
        inside.append(hidden in near)
        sizes.append(len(near))
    shares = [float(np.mean(values)) for values in (exact, classes, inside, sizes)]
    print(f"\n{cell}: exact {shares[0]:.3f}, class {shares[1]:.3f}, in the set {shares[2]:.3f}, size {shares[3]:.2f}")
    assert shares[1] > 0.9  # the classifier itself works
