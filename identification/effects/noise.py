"""Effects on the noise, not on the mean: `simulate` applies them, `diagnose` screens for them, models ignore them.

Each has a method `disturb`, which transforms the (m, d) errors of the measured positions [mm], in the order of the arm
file; values : short name of a parameter -> its value, as given in the arm file; nothing is estimated.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.effects.base import LEVER, Effect, Number, add_effect

Values = Mapping[str, float]
of_noise = partial(add_effect, scatter=True)


class Scene(NamedTuple):
    """Quantities on which noise may depend, for m measured postures.

    positions : (m, 2 or 3) exact [mm];  levers : (m, d, n) derivative of the tip by each joint angle [mm/rad]
    time : (m,) -0.5..0.5 over the session;  sigma : of the instrument [mm]
    """

    positions: Array
    levers: Array
    time: Array
    sigma: float


def _turned(self: Effect, errors: Array, scene: Scene, values: Values, generator: np.random.Generator) -> Array:
    """A joint's angles, drawn with `std`, times its lever."""
    angles = values.get("std", 0.0) * generator.standard_normal(len(errors))
    return errors + scene.levers[:, :, self.joint_index] * angles[:, None]


def _farther(self: Effect, errors: Array, scene: Scene, values: Values, generator: np.random.Generator) -> Array:
    """By the distance from the base."""
    share = np.linalg.norm(scene.positions, axis=1) / self.reach
    return np.asarray(errors * np.sqrt(1.0 + (values.get("g", 0.0) * share) ** 2)[:, None])


def _later(self: Effect, errors: Array, scene: Scene, values: Values, generator: np.random.Generator) -> Array:
    """By the time."""
    return np.asarray(errors * np.exp(values.get("g", 0.0) * scene.time)[:, None])


def _far_off(self: Effect, errors: Array, scene: Scene, values: Values, generator: np.random.Generator) -> Array:
    """A share of the rows in directions uniform over all; of lengths longer or shorter."""
    count = round(values.get("share", 0.0) * len(errors))
    rows = generator.choice(len(errors), count, replace=False)
    width = min(self.chain.dimension, errors.shape[1])  # a length is one number
    if width == 2:
        angle = generator.uniform(0.0, 2.0 * np.pi, count)
        directions = np.column_stack([np.cos(angle), np.sin(angle)])
    else:
        drawn = generator.standard_normal((count, width))
        directions = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    changed = errors.copy()
    changed[rows, :width] += values.get("size", 0.0) * scene.sigma * directions
    return changed


def _correlated(self: Effect, errors: Array, scene: Scene, values: Values, generator: np.random.Generator) -> Array:
    """Each row with a part of the one before."""
    rho, changed = values.get("rho", 0.0), errors.copy()
    for i in range(1, len(errors)):
        changed[i] = rho * changed[i - 1] + np.sqrt(1.0 - rho**2) * errors[i]
    return changed


of_noise(
    "joint_noise",
    "joint does not come to rest at the same angle",
    "A joint does not come to rest at the same angle: the tip scatters along the joint's lever.",
    [Number("std", "rad", 5e-5, LEVER, 0.0)],  # typical: repeatability of 0.05 mm at 1 m (ISO 9283)
    per_joint="required",
    disturb=_turned,
)
of_noise(
    "reach_noise",
    "scatter grows with the distance from the base",
    "The scatter grows with the distance from the base: errors times sqrt(1 + (g |p| / reach)^2).",
    # typical: error half constant, half proportional to the distance: sqrt(2) at full reach
    [Number("g", "1", 1.0, lower=0.0)],
    disturb=_farther,
)
of_noise(
    "time_noise",
    "scatter changes during the session",
    "The scatter changes during the session: errors times exp(g t).",
    [Number("g", "1", 0.5)],  # typical: scatter changes by exp(0.5) = 1.6 over the session
    disturb=_later,
)
of_noise(
    "outliers",
    "some rows are far off",
    "A share of the rows, drawn at random, is off by `size` standard deviations of the instrument, each in a random "
    "direction; orientations stay as they are.",
    # typical: arm not at rest, target turned away; well beyond the scatter, as a broken beam is
    [Number("share", "1", 0.02, lower=0.0, upper=1.0), Number("size", "1", 10.0, lower=0.0)],
    disturb=_far_off,
)
of_noise(
    "serial_correlation",
    "serially correlated errors",
    "Serially correlated errors: e_i = rho e_(i-1) + sqrt(1 - rho^2) new, of the same size as without.",
    [
        Number("rho", "1", 0.5, lower=-0.99, upper=0.99)
    ],  # typical: air and temperature change over minutes, rows follow faster
    disturb=_correlated,
)
