"""Effects on the noise, not on the mean: `simulate` applies them, `diagnose` screens for them, models ignore them.

Each transforms the (m, d) errors of the measured positions [mm], in the order of the arm file. Their values are given
in the arm file; nothing is estimated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.effects.base import Effect, register
from identification.kinematics.parameters import Parameter


@dataclass(frozen=True)
class Scene:
    """Quantities on which noise may depend, for m measured postures.

    positions : (m, 2 or 3) exact [mm];  levers : (m, d, n) derivative of the tip by each joint angle [mm/rad]
    time : (m,) -0.5..0.5 over the session;  sigma : of the instrument [mm]
    """

    positions: Array
    levers: Array
    time: Array
    sigma: float


class NoiseEffect(Effect):
    """Base class of effects on the noise; subclasses override `disturb`."""

    scatter = True

    def disturb(self, errors: Array, scene: Scene, values: dict[str, float], generator: np.random.Generator) -> Array:
        """Apply the effect to (m, d) errors [mm];  values : short name of a parameter -> its value."""
        raise NotImplementedError


@register
class JointNoise(NoiseEffect):
    """A joint does not come to rest at the same angle: the tip scatters along the joint's lever."""

    name = "joint_noise"
    summary = "joint does not come to rest at the same angle"
    per_joint = "required"

    def define(self) -> tuple[Parameter, ...]:
        # typical: repeatability of 0.05 mm at 1 m (ISO 9283)
        return (self.parameter("std", "rad", scale=self.link_length, lower=0.0, typical=5e-5),)

    def disturb(self, errors: Array, scene: Scene, values: dict[str, float], generator: np.random.Generator) -> Array:
        angles = values.get("std", 0.0) * generator.standard_normal(len(errors))
        return errors + scene.levers[:, :, self.joint_index] * angles[:, None]


@register
class ReachNoise(NoiseEffect):
    """The scatter grows with the distance from the base: errors times sqrt(1 + (g |p| / reach)^2)."""

    name = "reach_noise"
    summary = "scatter grows with the distance from the base"

    def define(self) -> tuple[Parameter, ...]:
        # typical: error half constant, half proportional to the distance: sqrt(2) at full reach
        return (self.parameter("g", "1", scale=1.0, lower=0.0, typical=1.0),)

    def disturb(self, errors: Array, scene: Scene, values: dict[str, float], generator: np.random.Generator) -> Array:
        share = np.linalg.norm(scene.positions, axis=1) / self.reach
        return errors * np.sqrt(1.0 + (values.get("g", 0.0) * share) ** 2)[:, None]


@register
class TimeNoise(NoiseEffect):
    """The scatter changes during the session: errors times exp(g t)."""

    name = "time_noise"
    summary = "scatter changes during the session"

    def define(self) -> tuple[Parameter, ...]:
        # typical: scatter changes by exp(0.5) = 1.6 over the session
        return (self.parameter("g", "1", scale=1.0, typical=0.5),)

    def disturb(self, errors: Array, scene: Scene, values: dict[str, float], generator: np.random.Generator) -> Array:
        return errors * np.exp(values.get("g", 0.0) * scene.time)[:, None]


@register
class Outliers(NoiseEffect):
    """A share of the rows, drawn at random, is off by `size` standard deviations of the instrument, each in a random
    direction; orientations stay as they are."""

    name = "outliers"
    summary = "some rows are far off"

    def define(self) -> tuple[Parameter, ...]:
        return (
            # typical: arm not at rest, target turned away; well beyond the scatter, as a broken beam is
            self.parameter("share", "1", scale=1.0, lower=0.0, upper=1.0, typical=0.02),
            self.parameter("size", "1", scale=1.0, lower=0.0, typical=10.0),
        )

    def disturb(self, errors: Array, scene: Scene, values: dict[str, float], generator: np.random.Generator) -> Array:
        count = round(values.get("share", 0.0) * len(errors))
        rows = generator.choice(len(errors), count, replace=False)
        changed = errors.copy()
        width = min(self.dimension, errors.shape[1])  # a length is one number
        changed[rows, :width] += values.get("size", 0.0) * scene.sigma * self._directions(count, width, generator)
        return changed

    def _directions(self, count: int, width: int, generator: np.random.Generator) -> Array:
        """(count, width) unit vectors, uniform over all directions; of width 1 a sign."""
        if width == 2:
            angle = generator.uniform(0.0, 2.0 * np.pi, count)
            return np.column_stack([np.cos(angle), np.sin(angle)])
        drawn = generator.standard_normal((count, width))
        return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


@register
class SerialCorrelation(NoiseEffect):
    """Serially correlated errors: e_i = rho e_(i-1) + sqrt(1 - rho^2) new, of the same size as without."""

    name = "serial_correlation"
    summary = "serially correlated errors"

    def define(self) -> tuple[Parameter, ...]:
        # typical: air and temperature change over minutes, rows follow faster
        return (self.parameter("rho", "1", scale=1.0, lower=-0.99, upper=0.99, typical=0.5),)

    def disturb(self, errors: Array, scene: Scene, values: dict[str, float], generator: np.random.Generator) -> Array:
        rho = values.get("rho", 0.0)
        changed = errors.copy()
        for i in range(1, len(errors)):
            changed[i] = rho * changed[i - 1] + np.sqrt(1.0 - rho**2) * errors[i]
        return changed
