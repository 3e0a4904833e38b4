"""Whether measurements and an earlier calibration as their prior agree, and which of its parameters they contradict.

The drop of the weighted squares, where a parameter's own prior is released and the others' stay, is chi2 of one degree
of freedom if both agree (F where the noise is estimated). What drops it most is released first, since errors of one
parameter look like errors of others, and the fit is made again without it before the others are tested.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc

from identification.arrays import Array
from identification.estimation.checks import Noise
from identification.estimation.levenberg_marquardt import levenberg_marquardt
from identification.estimation.prior import Earlier, Prior, effective_count
from identification.estimation.problem import Problem
from identification.estimation.uncertainty import LEVEL
from identification.information import spectrum
from identification.kinematics.parameters import Parameter
from identification.kinematics.spatial import BASE, TOOL

if TYPE_CHECKING:
    from identification.estimation.result import Identification

ROUNDS = 3  # of noise and of what the machining's prior is worth beside it
LEAST = 1e-12  # [mm] of noise: data without any
RIVAL = 0.05  # p-value from which another parameter explains a contradiction as well
SHOWN = 3  # parameters in a sentence


@dataclass(frozen=True)
class Contradiction:
    """A parameter in file units: as the prior has it, and as the measurements do without that prior; both with the
    parameters that are not contradicted as the earlier calibration has them."""

    name: str
    unit: str
    prior: float
    prior_std: float
    value: float
    std: float
    instead: tuple[str, ...] = ()  # parameters that would explain the measurements as well

    @classmethod
    def of(cls, name: str, before: Earlier, fit: Identification, instead: tuple[str, ...]) -> Contradiction:
        """Of a parameter before, and of a fit without that prior."""
        p, deviations = fit.model.parameters[k := fit.names.index(name)], np.sqrt(np.diag(before.covariance))
        k_before = before.names.index(name)
        figures = before.values[k_before], deviations[k_before], fit.parameters[k], fit.std[k]
        prior, prior_std, value, std = (float(x * p.to_file) for x in figures)
        return cls(name, p.file_unit, prior, prior_std, value, std, instead)

    def __str__(self) -> str:
        before, now = f"{self.prior:.4g} +- {self.prior_std:.2g}", f"{self.value:.4g} +- {self.std:.2g}"
        return f"{self.name} is {before} {self.unit} in the earlier calibration, {now} by these measurements" + (
            f" (or instead {', '.join(self.instead)}: they do not tell)" if self.instead else ""
        )

    def to_json(self) -> dict[str, Any]:
        """An entry of `contradicted` (identification/files/README.md, "JSON keys")."""
        return dict(vars(self))


def warning(contradictions: Sequence[Contradiction], without_prior: Sequence[Parameter]) -> list[str]:
    """The warning;  without_prior : parameters without a prior."""
    if not contradictions:
        return []
    rest = f"; and {len(contradictions) - SHOWN} more" if len(contradictions) > SHOWN else ""
    words = [one.name for one in contradictions] + [p.kind if p.kind in (BASE, TOOL) else p.name for p in without_prior]
    sentence = (
        f"the measurements contradict the prior: {'; '.join(map(str, contradictions[:SHOWN]))}{rest} (others as there)"
    )
    do = f"armcal identify with the earlier calibration as ARM and --only {','.join(dict.fromkeys(words))}"
    lacks = "the model lacks what differs between both measurements: armcal diagnose"
    return [
        f"{sentence}. The fit is right for neither. Either they changed and are to be estimated again: {do}; or {lacks}"
    ]


class Linear(NamedTuple):
    """A problem about values x (p,), without its prior: residual (N,) and jacobian (N, p), both weighted."""

    problem: Problem
    x: Array
    residual: Array
    jacobian: Array

    def released(self, names: Collection[str]) -> Prior:
        """The prior with that of the earlier calibration released for these; the machining's stays."""
        assert self.problem.prior is not None
        return released(self.problem.prior, names, self.problem.model.prior)

    def squares(self, prior: Prior, noise: float) -> float:
        """Least weighted squares, of measurements and prior together, in units of the noise."""
        parameters = self.problem.model.parameters
        rows = prior.rows(parameters, noise)
        whole = np.concatenate([self.jacobian, rows])
        target = np.concatenate([self.residual, rows @ (prior.center(parameters) - self.x)])
        scaled = whole / np.maximum(np.linalg.norm(whole, axis=0), np.finfo(float).tiny)
        left = target - scaled @ np.linalg.lstsq(scaled, target, rcond=None)[0]
        return float(left @ left) / noise**2

    def noise(self, has_sigma: bool, sigma_holds: bool) -> tuple[float, float]:
        """That the measurements have without the earlier calibration, and its degrees of freedom: infinite where it is
        the one given, 0 where nothing is left to tell.

        has_sigma : rows are divided by sigma, which the noise is not below;  sigma_holds : it is the noise
        """
        alone = self.released(self.problem.model.names)
        equations = self.problem.model.dimension * int(np.count_nonzero(self.problem.weights))
        noise, spare = 1.0 if has_sigma or sigma_holds else self.problem.noise, 0.0
        for _ in range(0 if sigma_holds else ROUNDS):
            rows = alone.rows(self.problem.model.parameters, noise)
            spare = equations - effective_count(self.jacobian, rows)
            if spare < 1.0:
                break
            noise = float(np.sqrt(self.squares(alone, noise) * noise**2 / spare))
            noise = max(noise, 1.0 if has_sigma else LEAST)
        return (noise, np.inf) if sigma_holds or (has_sigma and noise == 1.0) else (noise, max(spare, 0.0))


def released(prior: Prior, names: Collection[str], machining: Mapping[str, float]) -> Prior:
    """A prior without what the earlier calibration says of these; that of the machining stays."""
    assert prior.earlier is not None
    kept = prior.earlier.about(set(prior.earlier.names) - set(names))
    machined = {name: size for name, size in machining.items() if name in names}
    return Prior({**machined, **prior.deviations}, kept if kept.names else None)


Tested = tuple[Linear, float, float]  # with its noise and degrees of freedom, as of `Linear.noise`


def contradicted(at: Callable[[Collection[str]], Tested]) -> dict[str, tuple[str, ...]]:
    """Parameters whose prior the measurements contradict, the clearest first, each with those that would explain it as
    well;  at : the problem about the fit without the prior of some parameters."""
    explained = dict[str, tuple[str, ...]]()
    while True:
        linear, noise, freedom = at(explained)
        assert linear.problem.prior is not None
        assert linear.problem.prior.earlier is not None
        rest = [name for name in linear.problem.prior.earlier.names if name in linear.problem.model.names]
        rest = [name for name in rest if freedom >= 1.0 and noise > LEAST and name not in explained]
        least = linear.squares(linear.released(explained), noise)
        left = {name: linear.squares(linear.released([*explained, name]), noise) for name in rest}
        best = min(left, key=lambda name: left[name], default="")
        if not rest or _p_value(least - left[best], freedom) * len(rest) >= LEVEL:
            return explained
        instead = [name for name in rest if name != best and _p_value(left[name] - left[best], freedom) > RIVAL]
        explained[best] = tuple(instead)


def about_fits(problem: Problem, x: Array, has_sigma: bool, sigma_holds: bool) -> Callable[[Collection[str]], Tested]:
    """For `contradicted`: each fit starts from the one before, since an error of degrees is not linear.

    x : (p,) of the fit with the whole prior;  has_sigma, sigma_holds : as of `Linear.noise`
    """

    def linear_at(values: Array) -> Tested:
        residuals, jacobians = replace(problem, prior=None).least_squares.linearize(values[None], np.arange(1))
        linear = Linear(problem, values, residuals[0], jacobians[0])
        return linear, *linear.noise(has_sigma, sigma_holds)

    last = linear_at(x)

    def at(names: Collection[str]) -> Tested:
        nonlocal last
        if names:
            linear, noise, _ = last
            freed = replace(problem, prior=linear.released(names), noise=noise)
            last = linear_at(levenberg_marquardt(freed.least_squares, linear.x[None]).parameters[0])
        return last

    return at


def _p_value(drop: float, freedom: float) -> float:
    """Of a drop of the squares by one parameter."""
    drop = max(drop, 0.0)
    return float(chdtrc(1.0, drop) if np.isinf(freedom) else fdtrc(1.0, freedom, drop))


def with_contradictions(
    fit: Identification, problem: Problem, noise: Noise, again: Callable[[Mapping[str, float]], Identification]
) -> Identification:
    """The fit with what contradicts its prior, and with the covariance of the noise that is there without it.

    problem : as it was solved;  again : the fit without the earlier calibration's prior, some parameters known
    """
    at = about_fits(problem, fit.parameters, noise.sigma is not None, noise.reliance == "given")
    linear, least, _ = at(())
    names = contradicted(at)
    rows = replace(problem, noise=min(least, problem.noise)).prior_rows
    seen = spectrum(np.concatenate([linear.jacobian, rows]), problem.model.scales, problem.tolerance).covariance
    fit = replace(fit, covariance_seen=min(least, problem.noise) ** 2 * seen)
    if not names or problem.prior is None or problem.prior.earlier is None:
        return fit
    earlier = problem.prior.earlier
    held = {name: x for name, x in zip(earlier.names, earlier.values.tolist(), strict=True) if name not in names}
    free, before = again(held), earlier.conditioned_on(held)
    return replace(fit, contradictions=tuple(Contradiction.of(name, before, free, names[name]) for name in names))
