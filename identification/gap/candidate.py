"""`Candidate`: one member of the ambiguity set, a set of effects with its estimates and their intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from identification.arm import Calibration, EffectSpec


@dataclass(frozen=True)
class Estimate:
    """Estimate of one parameter with its 95 % interval; all figures in `unit`, the unit of files and tables."""

    name: str
    unit: str
    value: float
    std: float
    low_95: float
    high_95: float

    @property
    def short(self) -> str:
        """Parameter name without its effect: `a`."""
        return self.name.rpartition(".")[2]

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.short} = {self.value:.4g} +- {self.high_95 - self.value:.2g}{unit}"


@dataclass(frozen=True)
class Candidate:
    """A set of effects that is not much less likely than the best set.

    effects : labels such as `transmission_ripple:2[k=17]`
    specs : entries of an arm file in the same order (settings, no estimates)
    classes : classes of the effects, sorted;  delta_bic : -2 log odds to the best set
    f : F statistic of the set against the base model;  p_adjusted : 1 less the probability of the set
    parameters : estimates of the effects' parameters;  calibration : all estimates with their covariance
    probability : posterior probability that exactly these effects are missing; None where it was not computed
    intervals, reliance : basis of the 95 % intervals, as a keyword of `estimation.uncertainty` and in words
    freedom : degrees of freedom of each variance in the calibration's covariance; empty: those of the residuals
    """

    effects: tuple[str, ...]
    specs: tuple[EffectSpec, ...]
    classes: tuple[str, ...]
    delta_bic: float
    f: float
    p_adjusted: float
    parameters: tuple[Estimate, ...]
    calibration: Calibration
    probability: float | None = None
    intervals: str = "scatter"
    reliance: str = "from the scatter of the residuals"
    freedom: tuple[float, ...] = ()

    @property
    def title(self) -> str:
        """All effects with their settings: `axes_skew + transmission_ripple:2[k=18]`."""
        return " + ".join(self.effects)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names and joints without settings: `transmission_ripple:2`."""
        return tuple(spec.key for spec in self.specs)

    @property
    def estimates(self) -> Mapping[str, tuple[Estimate, ...]]:
        """Label of each effect -> estimates of its parameters."""
        owners = [p.name.rpartition(".")[0] for p in self.parameters]
        rows = list(zip(owners, self.parameters, strict=True))
        return {
            label: tuple(p for owner, p in rows if owner in (label, key))
            for label, key in zip(self.effects, self.keys, strict=True)
        }

    def to_json(self) -> dict[str, Any]:
        """An entry of `candidates` (identification/files/README.md, "JSON keys")."""
        return {
            "effects": list(self.effects),
            "classes": list(self.classes),
            "probability": self.probability,
            "delta_bic": self.delta_bic,
            "f": self.f,
            "p_adjusted": self.p_adjusted,
            "parameters": [vars(p) for p in self.parameters],
            "settings": self._settings(),
            "intervals": self.intervals,
        }

    def _settings(self) -> dict[str, float]:
        """`transmission_ripple:2.k` -> 17: settings under the name that the effect's parameters have."""
        owners = {p.name.rpartition(".")[0] for p in self.parameters}
        named = zip(self.effects, self.specs, strict=True)
        prefixes = [(label if label in owners else spec.key, spec) for label, spec in named]
        return {f"{prefix}.{name}": value for prefix, spec in prefixes for name, value in spec.values.items()}
