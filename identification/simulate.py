"""Simulated measurements: a true arm, a plan, and noise from an explicit generator."""

from __future__ import annotations

import numpy as np

from identification.arm import Arm, Array
from identification.errors import InputError
from identification.measurements import Conditions, Measurements, directions_from_order, session_time
from identification.model import Model


def simulate(
    truth: Arm,
    postures: Array,
    generator: np.random.Generator,
    *,
    sigma: float | None = None,
    payload: Array | None = None,
    temperature: Array | None = None,
) -> Measurements:
    """Measure `truth` once at each posture, in the given order.

    truth : arm whose calibration and effect values are the true ones; what has no value is zero
    postures : (m, n) commanded joint angles [rad]
    sigma : standard deviation per axis [mm], default the arm's; 0 gives exact positions
    payload, temperature : (m,) conditions per row, where the truth needs them
    """
    q = np.atleast_2d(np.asarray(postures, dtype=float))
    noise = truth.sigma if sigma is None else sigma
    if noise is None or noise < 0.0:
        raise InputError(f"sigma_mm: {noise}, allowed: >= 0, in the arm file or given here")
    model = Model(truth)
    if "temperature" in model.needs and temperature is None:
        raise InputError("temperature_C: an effect of the truth needs a temperature per row, none is given")
    deviation = None if temperature is None else temperature - np.mean(temperature)
    order = np.arange(len(q), dtype=float)
    conditions = Conditions(payload, deviation, session_time(order), directions_from_order(q))
    exact = model.position(q, conditions=conditions)
    positions = exact + noise * generator.standard_normal(exact.shape)
    return Measurements(q, positions, order, payload, temperature, conditions.directions)
