"""What the tests of the estimators share: arms, plans, and simulated data with a fixed generator."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from identification import Arm, EffectSpec, Gravity, Measurements, Model

LENGTHS = (260.0, 180.0, 120.0, 100.0)
TRUTH = np.r_[1.5, -0.6, -0.4, 0.7, np.radians([0.5, -0.5, 0.7, -0.3])]
SIGMA = 0.1
GRAVITY = Gravity(np.array([0.0, -9.81]), np.array([12.0, 8.0, 5.0, 3.0]), np.full(4, 0.5), 10.0)


def arm(*effects: EffectSpec, sigma: float | None = None) -> Arm:
    return Arm(LENGTHS, sigma=sigma, gravity=GRAVITY, effects=effects)


def tip(q: np.ndarray, lengths: Sequence[float] | np.ndarray) -> np.ndarray:
    """(..., 2) of links in a plane at angles (..., n), by complex numbers."""
    z = np.exp(1j * np.cumsum(q, axis=-1)) @ lengths
    return np.stack([z.real, z.imag], axis=-1)


def plan(m: int, seed: int = 1) -> np.ndarray:
    """m random postures (m, 4) [rad] with limits that an arm may have."""
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (m, 4))


def truth(model: Model, size: float = 0.5) -> np.ndarray:
    """TRUTH and effects that move the tip by about `size` mm (their scale is crude)."""
    return np.r_[TRUTH, [size / p.scale for p in model.parameters[8:]]]


def data(model: Model, postures: np.ndarray, seed: int = 2, sigma: float = SIGMA, size: float = 0.5) -> Measurements:
    """One data set; temperatures and directions vary."""
    generator = np.random.default_rng(seed)
    m = len(postures)
    empty = Measurements(postures, np.zeros((m, 2)), temperature=20.0 + generator.uniform(-3, 3, m))
    exact = model.position(postures, truth(model, size), empty.conditions)
    noise = sigma * generator.standard_normal(exact.shape)
    return Measurements(postures, exact + noise, temperature=empty.temperature)


def scipy_fit(model: Model, measurements: Measurements, weights: np.ndarray | None = None) -> OptimizeResult:
    """scipy's trust region on the same weighted residuals, in millimetres at the tip; `x` is in API units."""
    root = np.ones(len(measurements)) if weights is None else np.sqrt(weights)

    def residuals(scaled: np.ndarray) -> np.ndarray:
        position = model.position(measurements.postures, scaled / model.scales, measurements.conditions)
        return (root[:, None] * (measurements.positions - position)).ravel()

    def jacobian(scaled: np.ndarray) -> np.ndarray:
        rows = model.jacobian(measurements.postures, scaled / model.scales, measurements.conditions) / model.scales
        return -(root[:, None, None] * rows).reshape(-1, len(scaled))

    lower = np.array([p.lower * p.scale for p in model.parameters])
    upper = np.array([p.upper * p.scale for p in model.parameters])
    start = np.clip(np.zeros(len(lower)) + 1e-3, lower, upper)
    tolerances = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-12}
    result = least_squares(residuals, start, jacobian, bounds=(lower, upper), max_nfev=2000, **tolerances)
    result.x = result.x / model.scales
    return result
