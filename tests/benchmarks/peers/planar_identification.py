"""Many data sets of one planar arm identified: 4 links, 8 parameters, the same 20 postures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.benchmarks.peers.geometry import ARMS
from tests.benchmarks.peers.tool import Answer, Tool

LENGTHS = ARMS["4 links"].lengths  # type: ignore[union-attr]
TRUTH = np.r_[1.5, -0.6, -0.4, 0.7, np.radians([0.5, -0.5, 0.7, -0.3])]  # length errors [mm], joint offsets [rad]
SIGMA, RUNS = 0.1, 20


def positions(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(m, 2) [mm] with length errors and joint offsets (8,)."""
    theta = np.cumsum(q + values[4:], axis=1)
    lengths = LENGTHS + values[:4]
    return np.stack([np.cos(theta) @ lengths, np.sin(theta) @ lengths], axis=1)


def rows(sets: int) -> tuple[np.ndarray, np.ndarray]:
    """(m, 4) postures and (sets, m, 2) measurements [mm]."""
    generator = np.random.default_rng(1)
    q = ARMS["4 links"].random(RUNS, generator)
    return q, positions(TRUTH, q) + SIGMA * generator.standard_normal((sets, RUNS, 2))


def armcal(q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """`estimate_batch`."""
    from identification import Arm, Model
    from identification.estimation import estimate_batch

    return estimate_batch(Model(Arm(LENGTHS)), q, x).parameters


def scipy(**options: object) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """`least_squares`, one data set after the other."""

    def fit(q: np.ndarray, x: np.ndarray) -> np.ndarray:
        from scipy.optimize import least_squares

        def residuals(values: np.ndarray, measured: np.ndarray) -> np.ndarray:
            return (positions(values, q) - measured).ravel()

        return np.array([least_squares(residuals, np.zeros(8), args=(one,), **options).x for one in x])

    return fit


def job(fit: Callable[[np.ndarray, np.ndarray], np.ndarray], *modules: str) -> Tool:
    """A tool of this file."""

    def run(sets: int) -> Answer:
        return {"parameters": fit(*rows(sets))}

    return Tool(run, modules)


TOOLS = {
    "armcal": job(armcal, "identification.estimation"),
    "SciPy least_squares, defaults": job(scipy(), "scipy.optimize"),
    "SciPy least_squares, lm": job(scipy(method="lm"), "scipy.optimize"),
}
