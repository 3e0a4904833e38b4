"""What returns in another session: simulated in complex numbers, judged as a reader of the definition would."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.special import logsumexp, softmax

from identification import Arm, EffectSpec, Measurements, Model
from identification.documents.diagnosis import findings
from identification.gap.across_sessions import SAME, replications
from identification.gap.fit import Rows, fit
from identification.gap.likelihood import SIZES
from identification.measurements import pooled_sessions
from identification.model.placed import with_sessions

LENGTHS, SIGMA, K = np.array([300.0, 200.0]), 0.1, 5
BASES = [(0.0, 0.0), (0.7, 100.0 - 50.0j), (-2.0, 30.0j)]


def session(number: int, size: complex, m: int = 60) -> Measurements:
    """A wave of 5 per turn in joint 2, a cos + b sin with a + ib = `size` [rad]."""
    generator = np.random.default_rng(number)
    q = generator.uniform(-np.pi, np.pi, (m, 2))
    bent = q + np.array([0.001, -0.002])
    bent[:, 1] += size.real * np.cos(K * q[:, 1]) + size.imag * np.sin(K * q[:, 1])
    turn, shift = BASES[number]
    z = np.exp(1j * turn) * (LENGTHS * np.exp(1j * np.cumsum(bent, axis=1))).sum(axis=1) + shift
    return Measurements(q, np.column_stack([z.real, z.imag]) + generator.normal(0.0, SIGMA, (m, 2)))


def replication(*parts: Measurements) -> tuple[dict[str, Any], Measurements]:
    data = pooled_sessions({f"day {k + 1}": part for k, part in enumerate(parts)})
    arm = with_sessions(Arm(LENGTHS), data)
    spec = EffectSpec("transmission_ripple", 2, {"k": K})
    fitted = fit(Model(arm.with_effects(*arm.effects, spec)), Rows.of(data))
    (one,) = replications(fitted, data.session_names, (f"transmission_ripple:2[k={K}]",))
    return one, data


SIZE = 0.001 - 0.0005j  # some 0.2 mm at the tip of a link of 200 mm


@pytest.mark.parametrize(
    ("sizes", "answer", "each"),
    [
        ((SIZE, SIZE), True, (True, True)),
        ((SIZE, SIZE, SIZE), True, (True, True, True)),
        ((10.0 * SIZE, 11.0 * SIZE), True, (True, True)),  # a difference of ten standard deviations, and of a tenth
        ((SIZE, -SIZE), False, (False, False)),  # what one session says is wrong by twice the effect in the other
        ((SIZE, 0.0j), False, (None, False)),  # of nothing the other session can learn nothing
    ],
)
def test_what_returns_and_what_does_not(
    sizes: tuple[complex, ...], answer: bool, each: tuple[bool | None, ...]
) -> None:
    one, _ = replication(*(session(k, size) for k, size in enumerate(sizes)))
    assert one["replicates"] is answer
    assert tuple(s["replicates"] for s in one["sessions"]) == each
    for there, size in zip(one["sessions"], sizes, strict=True):
        values, deviations = np.radians([[p["value"], p["std"]] for p in there["parameters"]]).T
        assert np.all(np.abs((values - [size.real, size.imag]) / deviations) < 5.0)
    told = {"shape": None, "misfit": None, "replication": [one]}
    assert findings(told) == [f"{'Replicates' if answer else 'Does not replicate'} across sessions: {one['effect']}."]


def log_likelihood(y: np.ndarray, blocks: list[np.ndarray], sizes: tuple[float, ...]) -> float:
    """Of y ~ N(0, sigma^2 (1 + sum s^2 Z Z^T)) with p(sigma) ~ 1 / sigma."""
    covariance = np.eye(len(y)) + sum(s**2 * z @ z.T for s, z in zip(sizes, blocks, strict=True))
    quadratic = float(y @ np.linalg.solve(covariance, y))
    return -0.5 * np.linalg.slogdet(covariance)[1] - 0.5 * len(y) * np.log(quadratic)


def test_the_probability_is_that_of_dense_algebra() -> None:
    """In coordinates off the base; an effect of unit size has the inverse of its information as covariance."""
    one, data = replication(session(0, SIZE, 14), session(1, 0.4 * SIZE, 9))
    q, second = data.postures, (data.session == "day 2")[:, None]
    links = LENGTHS * np.exp(1j * np.cumsum(q, axis=1)) * np.exp(1j * np.where(second, BASES[1][0], 0.0))
    lever, ones = 1j * links[:, 1:], np.ones((len(q), 1))
    tip = 1j * links.sum(axis=1, keepdims=True)
    base = np.hstack([links, tip, lever, ones, 1j * ones, tip * second, second, 1j * second])
    wave = lever * np.column_stack([np.cos(K * q[:, 1]), np.sin(K * q[:, 1])])
    rest = data.positions @ [1.0, 1.0j] - np.where(second[:, 0], BASES[1][1], 0.0) - links.sum(axis=1)
    base, wave, first, y = (np.concatenate([z.real, z.imag]) for z in (base, wave, wave * ~second, rest))
    off = null_space(base.T).T
    wave, first, y = off @ wave, off @ first, off @ y
    root = np.linalg.cholesky(np.linalg.inv(wave.T @ wave) / 2.0)
    wave, first = wave @ root, first @ root
    same, other = np.hstack([wave, SAME * first]), wave - first
    tables = [
        [log_likelihood(y, [same], (s,)) for s in SIZES],
        [log_likelihood(y, [first, other], (s, t)) for s in SIZES for t in SIZES],
        [log_likelihood(y, [other], (s,)) for s in SIZES],
        [log_likelihood(y, [first], (s,)) for s in SIZES],
    ]
    expected = softmax([logsumexp(table) - np.log(len(table)) for table in tables])[0]
    assert 0.1 < expected < 0.9
    assert one["sessions"][0]["replicates"] is None  # nine rows leave it open
    assert one["sessions"][0]["probability"] == pytest.approx(expected, rel=0.01)  # linearized at the drawing
