"""Speed of identification, as ratios measured in one run: `pytest -m benchmark -s tests/benchmarks`.

The rival is a loop over scipy `least_squares` with residuals (and Jacobian) written by hand in plain numpy, so that it
pays for nothing of ours. The loop is timed on a subset and scaled per fit; the best of several rounds counts for both.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from identification.arm import Arm, EffectSpec
from identification.estimation import estimate_batch
from identification.model import Model

pytestmark = pytest.mark.benchmark

LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
TRUTH = np.r_[1.5, -0.6, -0.4, 0.7, np.radians([0.5, -0.5, 0.7, -0.3])]
ECCENTRICITY = np.radians([0.03, -0.01])
SIGMA, RUNS, DATA_SETS, LOOP = 0.1, 20, 10_000, 100


def case(model: Model, extra: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Postures (m, 4) and measured positions (count, m, 2), every data set of the same arm."""
    generator = np.random.default_rng(1)
    postures = generator.uniform(-2.0, 2.0, (RUNS, 4))
    exact = model.position(postures, np.r_[TRUTH, extra])
    return postures, exact + SIGMA * generator.standard_normal((count, RUNS, 2))


def residuals(x: np.ndarray, postures: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(2m,) lengths, offsets and, with ten parameters, the eccentricity of encoder 2."""
    angles = postures + x[4:8]
    if x.size > 8:
        angles[:, 1] += x[8] * np.cos(postures[:, 1]) + x[9] * np.sin(postures[:, 1])
    theta = np.cumsum(angles, axis=1)
    lengths = LENGTHS + x[:4]
    return np.concatenate([np.cos(theta) @ lengths - measured[:, 0], np.sin(theta) @ lengths - measured[:, 1]])


def jacobian(x: np.ndarray, postures: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(2m, p) exact."""
    cosine2, sine2 = np.cos(postures[:, 1]), np.sin(postures[:, 1])
    angles = postures + x[4:8]
    if x.size > 8:
        angles[:, 1] += x[8] * cosine2 + x[9] * sine2
    theta = np.cumsum(angles, axis=1)
    cosine, sine, lengths, m = np.cos(theta), np.sin(theta), LENGTHS + x[:4], len(postures)
    rows = np.empty((2 * m, x.size))
    rows[:m, :4], rows[m:, :4] = cosine, sine
    rows[:m, 4:8] = -np.cumsum((lengths * sine)[:, ::-1], axis=1)[:, ::-1]
    rows[m:, 4:8] = np.cumsum((lengths * cosine)[:, ::-1], axis=1)[:, ::-1]
    if x.size > 8:
        for part in (slice(0, m), slice(m, None)):
            rows[part, 8], rows[part, 9] = rows[part, 5] * cosine2, rows[part, 5] * sine2
    return rows


def best(job: Callable[[], object], rounds: int) -> float:
    """Seconds of the fastest of some rounds: the others waited for somebody else."""
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def loop(postures: np.ndarray, positions: np.ndarray, p: int, **options: object) -> np.ndarray:
    """(k, p) one scipy fit after the other."""
    fits = [least_squares(residuals, np.zeros(p), args=(postures, data), **options) for data in positions]
    return np.array([fit.x for fit in fits])


def report(title: str, rows: list[tuple[str, float, float | None]]) -> None:
    print(f"\n{title}\n{'':<44}{'us per fit':>12}{'fits per s':>12}{'ratio':>9}{'bar':>7}")
    ours = rows[0][1]
    for name, seconds, bar in rows:
        ratio = "" if bar is None else f"{seconds / ours:9.1f}{bar:7.0f}"
        print(f"{name:<44}{1e6 * seconds:12.2f}{1 / seconds:12.0f}{ratio}")


def test_closed_form_against_a_loop_over_scipy() -> None:
    model = Model(Arm(LENGTHS))
    postures, positions = case(model, np.zeros(0), DATA_SETS)
    some = positions[:LOOP]
    np.testing.assert_allclose(
        estimate_batch(model, postures, some).parameters * model.scales,
        loop(postures, some, 8, x_scale=1 / model.scales, xtol=1e-12, ftol=1e-12) * model.scales,
        rtol=0,
        atol=1e-4,
    )
    ours = best(lambda: estimate_batch(model, postures, positions), 7) / DATA_SETS
    scipy = best(lambda: loop(postures, some, 8), 3) / LOOP
    report("closed form, 10,000 data sets, m = 20, 4 links", [("closed form", ours, None), ("scipy", scipy, 500.0)])
    assert scipy / ours >= 500.0


def test_batched_gauss_newton_against_a_loop_over_scipy() -> None:
    model = Model(Arm(LENGTHS, effects=(EffectSpec("encoder_eccentricity", 2),)))
    postures, positions = case(model, ECCENTRICITY, DATA_SETS)
    some = positions[:LOOP]
    fits = estimate_batch(model, postures, some)
    exact = loop(postures, some, 10, jac=jacobian, method="lm")
    np.testing.assert_allclose(fits.parameters * model.scales, exact * model.scales, rtol=0, atol=1e-4)
    ours = best(lambda: estimate_batch(model, postures, positions), 5) / DATA_SETS
    default = best(lambda: loop(postures, some, 10), 3) / LOOP
    with_jacobian = best(lambda: loop(postures, some, 10, jac=jacobian, method="lm"), 5) / LOOP
    rows = [
        ("batched Gauss-Newton", ours, None),
        ("scipy, default settings", default, 25.0),
        ("scipy, exact Jacobian, method lm", with_jacobian, 6.0),
    ]
    report("one effect (encoder_eccentricity:2), 10,000 data sets, m = 20", rows)
    assert fits.converged.all()
    assert default / ours >= 25.0
    assert with_jacobian / ours >= 6.0


def test_large_batches_in_bounded_time_and_memory() -> None:
    """1,000,000 closed-form fits in 5 s and 2 GB on one core; 100,000 with two effects in 20 s."""
    model = Model(Arm(LENGTHS))
    postures, positions = case(model, np.zeros(0), 1_000_000)
    closed = best(lambda: estimate_batch(model, postures, positions), 1)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    del positions
    two = Model(Arm(LENGTHS, effects=(EffectSpec("encoder_eccentricity", 2), EffectSpec("gear_ratio", 3))))
    postures, positions = case(two, np.r_[ECCENTRICITY, 1e-3], 100_000)
    start = time.perf_counter()
    fits = estimate_batch(two, postures, positions)
    iterated = time.perf_counter() - start
    print(f"\n1,000,000 closed-form fits: {closed:.2f} s (5), {memory:.2f} GB (2)")
    print(f"100,000 fits with two effects: {iterated:.2f} s (20)")
    assert fits.converged.all()
    assert closed <= 5.0
    assert memory <= 2.0
    assert iterated <= 20.0
