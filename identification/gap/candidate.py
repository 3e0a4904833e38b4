"""Effects as results: `Candidate`, a set of them with estimates and intervals, and `Trial`, one of them alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp

from identification.arm import Calibration, EffectSpec
from identification.arrays import Array
from identification.estimation.intervals import freedom_kept, limits_95
from identification.estimation.uncertainty import FittedRows, uncertainty
from identification.gap.detectability import Beside
from identification.gap.fit import Fit
from identification.gap.posterior import Posterior
from identification.gap.verdict import block_probabilities
from identification.information import spectrum
from identification.kinematics.joint_range import joint_range
from identification.model import Model
from identification.validate.row_groups import DIAGNOSED


class Estimate(NamedTuple):
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
    """A set of effects as a result.

    effects : labels such as `transmission_ripple:2[k=17]`;  classes : their classes, sorted
    specs : entries of an arm file in the same order (settings, no estimates)
    calibration : all estimates with their covariance;  parameters : those of the effects, for people
    freedom : degrees of freedom of each variance in that covariance
    intervals, reliance : basis of the 95 % intervals, as a keyword of `estimation.uncertainty` and in words
    f : F statistic of the set against the base model
    probability : that exactly these effects are missing, None where it is not that of these names
    delta_bic : -2 log odds to the best set
    """

    effects: tuple[str, ...]
    classes: tuple[str, ...]
    specs: tuple[EffectSpec, ...]
    calibration: Calibration
    parameters: tuple[Estimate, ...]
    freedom: tuple[float, ...] = ()
    intervals: str = "scatter"
    reliance: str = "from the scatter of the residuals"
    f: float = 0.0
    probability: float | None = None
    delta_bic: float = 0.0

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
        named = zip(self.effects, self.keys, strict=True)
        return {
            label: tuple(p for p in self.parameters if p.name.rpartition(".")[0] in (label, key))
            for label, key in named
        }

    def to_json(self) -> dict[str, Any]:
        """An entry of `candidates` (identification/files/README.md, "JSON keys")."""
        owners = {p.name.rpartition(".")[0] for p in self.parameters}
        named = [
            (label if label in owners else spec.key, spec) for label, spec in zip(self.effects, self.specs, strict=True)
        ]
        return {
            "effects": list(self.effects),
            "classes": list(self.classes),
            "probability": self.probability,
            "delta_bic": self.delta_bic,
            "f": self.f,
            "p_adjusted": 1.0 - (self.probability or 0.0),
            "parameters": [p._asdict() for p in self.parameters],
            # `transmission_ripple:2.k` -> 17: under the name that the effect's parameters have
            "settings": {f"{owner}.{name}": value for owner, spec in named for name, value in spec.values.items()},
            "intervals": self.intervals,
        }


class Trial(NamedTuple):
    """One effect alone against the base model, an entry of `trials` (identification/files/README.md, "JSON keys").

    f, p : F statistic and its p-value;  p_adjusted : 1 less the probability that it is missing
    delta_bic : -2 log posterior odds against nothing
    """

    effect: str
    f: float
    p: float
    p_adjusted: float
    delta_bic: float


def candidate_of(fitted: Fit, added: int, given: float | None = None, doubtful: bool = False) -> Candidate:
    """The last `added` effects of a fitted model as a result, with intervals as if no bound were active.

    given : sigma of the arm file;  doubtful : a noise model was estimated, so that the sandwich covariance is used
    """
    model, rows, sigma = fitted.model, fitted.rows, None if doubtful else fitted.rows.sigma or given
    jacobian, residual = fitted.jacobian / (sigma or 1.0), fitted.residual / (sigma or 1.0)
    tall = jacobian.reshape(len(rows), rows.dimension, -1), residual.reshape(len(rows), rows.dimension)
    table = FittedRows(*tall, fitted.rank, rows.sequence, rows.posture_numbers, rows.repeat_numbers)
    sure = uncertainty(table, spectrum(jacobian, model.scales), known=sigma is not None, doubtful=doubtful)
    effects = model.effects[len(model.effects) - added :]  # the arm's own come first
    names = {p.name for effect in effects for p in effect.parameters}
    deviations = np.sqrt(np.maximum(np.diag(sure.covariance), 0.0))  # of a perfect fit
    limits = limits_95(model.parameters, fitted.values, deviations, sure.freedom)
    figures = zip(model.parameters, np.column_stack([fitted.values, deviations, limits]), strict=True)
    return Candidate(
        tuple(effect.label for effect in effects),
        tuple(sorted({effect.family for effect in effects})),
        model.arm.effects[len(model.arm.effects) - added :],
        as_calibration(model, fitted.values, sure.covariance, sure.freedom, fitted.sigma, rows.postures),
        tuple(Estimate(p.name, p.file_unit, *(row * p.to_file).tolist()) for p, row in figures if p.name in names),
        tuple(sure.freedom.tolist()),
        sure.kind,
        sure.sentence,
    )


def as_calibration(
    model: Model, values: Array, covariance: Array, freedom: Array, sigma: float, postures: Array
) -> Calibration:
    """Estimates (p,) as an arm file has them, with the postures (m, n) and the scatter [mm] that they come from."""
    origin = {"source": DIAGNOSED, **joint_range(postures, model.joint_types), "scatter_mm": sigma}
    origin |= freedom_kept(model.names, freedom)
    return Calibration(model.parameters.mapping(values), model.names, covariance, MappingProxyType(origin))


def trials(posterior: Posterior, beside: Beside) -> tuple[Trial, ...]:
    """Every effect alone against the base model, likeliest first; of a scanned setting only the best value."""
    blocks, limits, shares = posterior.whole.blocks, posterior.whole.products.limits, block_probabilities(posterior)
    ratios = logsumexp(posterior.whole.products.added(beside.left), axis=1) - np.log(limits)
    total = sum(block.weight for block in blocks if not block.row)
    best: dict[str, Trial] = {}
    for k, block in enumerate(blocks):
        if block.named:
            odds = float(ratios[k] + np.log(block.weight / total))
            trial = Trial(block.label, *beside.f_test([k]), 1.0 - shares.get(block.key, 0.0), -2.0 * odds)
            best[block.key] = min(best.get(block.key, trial), trial, key=lambda one: one.delta_bic)
    return tuple(sorted(best.values(), key=lambda one: (round(one.delta_bic, 9), one.effect)))
