"""`find_curves`: replace named functions of a joint's angle by error curves where these explain the data better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import casadi as ca
import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from identification.arrays import Array
from identification.error_curve import all_hold
from identification.estimation.uncertainty import Uncertainty
from identification.gap.candidate import Candidate
from identification.gap.candidates import candidate_of
from identification.gap.curves.curve import Curve
from identification.gap.curves.curve_choice import CurveChoice, Members, System, choose_curves
from identification.gap.curves.curve_fit import Basis, Evidence, curve_columns
from identification.gap.fits.fit import Fit, fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis
from identification.gap.noise.noise import Finding
from identification.gap.selection.selection import WINDOW
from identification.gap.workflow import Findings
from identification.kinematics.base_axes import along, planar_axes
from identification.kinematics.parameters import JOINT_OFFSET
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.sessions import SESSIONS

IMPLAUSIBLE = 4.0  # typical sizes of an effect: one arm in 16,000 has it so large
TIDY = 7  # decimals of a value in degrees, in files
SHARES = (0.0, 0.5, 0.75, 1.0)  # of a serial correlation


@dataclass(frozen=True)
class CurveFit(Fit):
    """A fit whose model has error curves, estimated together with its parameters.

    bases : of the curves;  evidence : their K coefficients with prior and posterior
    response : (p, K) derivative of the parameters with respect to the coefficients [API units]
    """

    bases: tuple[Basis, ...] = ()
    evidence: Evidence = None  # type: ignore[assignment]
    response: Array = None  # type: ignore[assignment]

    @classmethod
    def of(cls, found: Fit, bases: tuple[Basis, ...], evidence: Evidence, response: Array) -> CurveFit:
        """Combine a fit of a model with fixed error curves and the estimates of these curves."""
        own = {field.name: getattr(found, field.name) for field in fields(Fit)}
        return cls(**own, bases=bases, evidence=evidence, response=response)

    @property
    def effective(self) -> float:
        """Effective number of parameters and coefficients."""
        return super().effective + self.evidence.effective

    def covariance(self, bounded: bool = True) -> Array:
        """(p, p) covariance of the estimates, as of `Fit`, including the uncertainty of the curves."""
        free = self.free if bounded else np.ones(len(self.values), dtype=bool)
        response = np.where(free[:, None], self.response, 0.0)
        return super().covariance(bounded) + self.sigma**2 * response @ self.evidence.covariance @ response.T

    def regression(self) -> tuple[Array, Array, Array]:
        """As of `Fit`, with the coefficients of the curves and their prior after the parameters."""
        parameters, rows, left = super().regression()
        curves = self.curve_columns(self.rows.postures, self.rows.conditions)
        precisions = self.evidence.variances**-0.5
        prior = np.asarray(block_diag(rows, np.diag(precisions)))
        missed = -precisions * self.evidence.coefficients
        return np.concatenate([parameters, curves], axis=2), prior, np.r_[left, missed]

    def curve_columns(self, postures: Array, conditions: Conditions) -> Array:
        """(m, d, K) derivative of the positions with respect to the coefficients."""
        return curve_columns(self.bases, postures, self.model.joint_levers(postures, self.values, conditions))

    def uncertain(self, postures: Array, conditions: Conditions) -> tuple[Array, Array]:
        """As of `Fit`, with the coefficients of the curves after the parameters."""
        jacobian = self.model.jacobian(postures, self.values, conditions)
        moved = self.curve_columns(postures, conditions) + jacobian @ self.response
        moved *= all_hold(self.model.expressions.curves, postures)[:, None, None]
        covariance = block_diag(super().covariance(), self.sigma**2 * self.evidence.covariance)
        return np.concatenate([jacobian, moved], axis=2), np.asarray(covariance)


@dataclass(frozen=True)
class Curves:
    """The best explanation with error curves.

    fit : with the curves in the model;  kept : named effects beside them;  scatter : remaining properties of the noise
    base : fit of the base model to the same rows;  gain : cost of the named effects alone less that with curves
    held_out : mean square distance [mm^2] at postures left out
    """

    fit: CurveFit
    curves: tuple[Curve, ...]
    kept: Members
    scatter: tuple[Finding, ...]
    base: Fit
    gain: float
    held_out: float

    @property
    def excess(self) -> float:
        """Mean square distance [mm^2] at postures left out, beyond noise and parameter uncertainty; >= 0."""
        n, row = len(self.fit.residual), self.fit.rows.dimension * self.fit.sigma**2
        return max(0.0, self.held_out - row * (1.0 + self.fit.effective / n))


def find_curves(found: Findings, measurements: Measurements) -> Curves | None:
    """Error curves at the joints where they explain more than the named functions of the angle; None if there are none.

    Curves are tried only if an effect was found at a joint: they describe it, but do not establish it. The noise is
    taken as found and as white, since an unmodelled curve resembles correlated or heteroscedastic noise.
    """
    chosen = found.unknown.chosen
    if not chosen and not (found.unknown.place or "").startswith("joint"):
        return None
    named, base = found.fits.fit(chosen), found.fits.fit(())
    systems = [(System(named, found.fits.rows, chosen, base.rank), found.scatter)]
    if found.scatter:
        plain = Rows.of(measurements).pick(~found.outlier)
        again = fit(named.model, plain, named.by_name)
        systems.append((System(again, plain, chosen, base.rank), ()))
    before = systems[0][0].explain(chosen, ()).cost + _noise_cost(*systems[0])
    options = [(system, scatter, choose_curves(system, WINDOW)) for system, scatter in systems]
    system, scatter, best = min(options, key=lambda o: o[2].cost + _noise_cost(o[0], o[1]))
    gain = before - best.cost - _noise_cost(system, scatter)
    if not best.joints or gain <= WINDOW or not _predicts_better(system, best):
        return None
    system, scatter, best = _for_other_times(system, scatter, best)
    best, (fitted, curves) = _plausible(system, best)
    again = fit(base.model, system.rows, base.by_name)
    return Curves(fitted, curves, best.kept, scatter, again, gain, system.cross_validated(best) / len(system.rows))


def _plausible(system: System, best: CurveChoice) -> tuple[CurveChoice, tuple[CurveFit, tuple[Curve, ...]]]:
    """Remove named effects of implausible size, if the curves then still predict better than the named effects alone.

    Returns the explanation, and its fit and curves.
    """
    trial, fitted = best, _fitted(system, best)
    first = fitted
    while (far := _least_plausible(fitted[0], trial.kept)) is not None:
        trial = system.explain(tuple(h for h in trial.kept if h is not far), trial.joints, trial.logs)
        fitted = _fitted(system, trial)
    return (trial, fitted) if trial is best or _predicts_better(system, trial) else (best, first)


def _least_plausible(fitted: Fit, kept: Members) -> Hypothesis | None:
    """The named effect farthest beyond its typical size, if implausibly large; else None.

    Beside flexible curves an effect can become large and be cancelled by them at the measured angles only. The same
    holds for drifts and steps: on a grid measured in order, time follows the angles.
    """
    sizes = {
        h: max(abs(fitted.by_name[p.name]) / p.typical for p in effect.parameters if p.typical)
        for h in kept
        for effect in fitted.model.effects
        if effect.label == h.effect.label and any(p.typical for p in effect.parameters)
    }
    farthest = max(sizes, key=lambda h: sizes[h], default=None)
    return farthest if farthest is not None and sizes[farthest] > IMPLAUSIBLE else None


def _for_other_times(
    system: System, scatter: tuple[Finding, ...], best: CurveChoice
) -> tuple[System, tuple[Finding, ...], CurveChoice]:
    """Choose the fraction of the serial correlation that best predicts intervals of time left out.

    Where consecutive postures are close, unmodelled errors common to neighbors resemble correlation in time. Treating
    all of it as noise discards information; treating none of it as noise counts neighboring rows as independent.
    """
    if not system.rows.correlation:
        return system, scatter, best
    options = []
    for share in SHARES:
        other = system if share == 1.0 else system.with_correlation(share * system.rows.correlation)
        explained = best if share == 1.0 else other.explain(best.kept, best.joints, best.logs)
        white = tuple(f for f in scatter if f.name != "serial_correlation")
        options.append((other, scatter if share else white, explained))
    return min(options, key=lambda option: option[0].left_in_time(option[2]))


def _noise_cost(system: System, scatter: Sequence[Finding]) -> float:
    return system.rows.log_determinant + len(scatter) * float(np.log(len(system.found.residual)))


def _predicts_better(system: System, best: CurveChoice) -> bool:
    """Whether the curves predict postures left out better than the named effects do."""
    return system.cross_validated(best) < system.cross_validated(system.explain(system.named, ()))


def _fitted(system: System, best: CurveChoice) -> tuple[CurveFit, tuple[Curve, ...]]:
    """The fit of the parameters with the curves in the model, and the curves."""
    evidence = system.evidence(best)
    bases = tuple(basis for basis in system.bases if basis.joint in best.joints)
    ends = np.cumsum([basis.count for basis in bases])
    noise = np.sqrt(evidence.squares / (len(system.found.residual) - system.base_rank))
    curves = tuple(
        _curve(
            b, evidence.coefficients[e - b.count : e], evidence.covariance[e - b.count : e, e - b.count : e], noise, lg
        )
        for b, e, lg in zip(bases, ends, best.logs[1::2], strict=True)
    )
    response, arm = system.model_response(best), system.found.model.arm
    added = len(system.named)  # the arm's own come first
    own, stay = arm.effects[: len(arm.effects) - added], {h.effect.label for h in best.kept}
    there = zip(
        arm.effects[len(own) :], system.found.model.effects[len(system.found.model.effects) - added :], strict=True
    )
    specs = [spec for spec, effect in there if effect.label in stay]
    model = Model(arm.with_effects(*own, *specs))
    parts = np.split(response * evidence.coefficients, ends[:-1], axis=1)
    curves = tuple(
        _tied(c, model, part.sum(axis=1), system.found.by_name) for c, part in zip(curves, parts, strict=True)
    )
    model = Model(arm.with_effects(*own, *specs, *(curve.spec for curve in curves)))
    refit = fit(model, system.rows, system.found.by_name)
    return CurveFit.of(refit, bases, evidence, response), curves


def _tied(curve: Curve, model: Model, geometry: Array, found: Mapping[str, float]) -> Curve:
    """With the part (p,) of the model's values that was fitted with it, by name; shifts of the base along its axes.

    found : values of the model's parameters
    """
    chain, values = model.arm.chain, model.parameters.mapping(geometry)
    values = {name: value for name, value in values.items() if not name.startswith(f"{SESSIONS}.")}
    axes = np.array(ca.DM(planar_axes(found[f"{JOINT_OFFSET}:1"]))) if chain is None else chain.base[:3, :3]
    own = {name: float(value) for name, value in along(axes.T, values).items() if name in values}
    return replace(curve, table=replace(curve.table, geometry={**values, **own}))


def _curve(basis: Basis, coefficients: Array, covariance: Array, noise: float, log_length: float) -> Curve:
    table = basis.curve(coefficients)
    tidy = np.radians(np.round(np.degrees(table.values), TIDY))
    table = replace(table, values=tidy)
    angles = np.linspace(basis.start, basis.stop, 2 * basis.count - 1)
    at = basis.at(angles)
    std = noise * np.sqrt(np.maximum(np.einsum("ak,kl,al->a", at, covariance, at, optimize=True), 0.0))
    return Curve(basis.joint + 1, table, angles, table.at(angles), std, float(np.exp(log_length)))


def curve_candidate(found: Curves) -> Candidate:
    """The best set including the curves as a candidate, with an F test against the base model."""
    fitted, base = found.fit, found.base
    covariance = fitted.covariance(bounded=False)
    sure = Uncertainty("scatter", covariance, np.full(len(covariance), float(max(fitted.freedom, 1))))
    size = fitted.effective - base.rank
    f = max(base.squares / fitted.sigma**2 - fitted.freedom, 0.0) / size
    test = float(f), float(fdtrc(size, max(fitted.freedom, 1), f))
    return candidate_of(fitted, len(found.kept) + len(found.curves), test, sure)
