"""Turn explanations into results: `Candidate` from a fit, `Trial` of every effect alone."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from scipy.special import fdtrc, logsumexp

from identification.arm import Calibration
from identification.arrays import Array
from identification.estimation.intervals import freedom_kept, limits_95
from identification.estimation.uncertainty import FittedRows, Uncertainty, uncertainty
from identification.gap.average import PredictingModel
from identification.gap.candidate import Candidate, Estimate
from identification.gap.evidence import SIZES
from identification.gap.fits.fit import Fit
from identification.gap.posterior import Posterior
from identification.gap.result import Trial
from identification.gap.verdict import block_probabilities
from identification.information import spectrum
from identification.kinematics.joint_range import joint_range
from identification.model import Model
from identification.validate.row_groups import DIAGNOSED


def certainty(found: Fit, given: float | None, doubtful: bool) -> Uncertainty:
    """Covariance and degrees of freedom of a fit's estimates, computed as if no bound were active.

    given : sigma of the arm file;  doubtful : a noise model was estimated, so that the sandwich covariance is used
    """
    rows = found.rows
    sigma = None if doubtful else rows.sigma or given
    unit, m, d = sigma or 1.0, len(rows), rows.dimension
    jacobian, residual = found.jacobian / unit, found.residual / unit
    tall, numbers = jacobian.reshape(m, d, -1), (rows.posture_numbers, rows.repeat_numbers)
    fitted = FittedRows(tall, residual.reshape(m, d), found.rank, rows.sequence, *numbers)
    return uncertainty(fitted, spectrum(jacobian, found.model.scales), known=sigma is not None, doubtful=doubtful)


def candidate_of(
    found: Fit, added: int, sure: Uncertainty, f: float, probability: float | None, delta: float = 0.0
) -> Candidate:
    """The last `added` effects of a fitted model as a result.

    sure : covariance and degrees of freedom of the estimates;  f : of the F test against the base model
    delta : -2 log odds to the best set
    """
    own = len(found.model.effects) - added  # the arm's own come first
    effects, specs = found.model.effects[own:], found.model.arm.effects
    ranges = joint_range(found.rows.postures, found.model.joint_types)
    origin = {"source": DIAGNOSED, **ranges, "scatter_mm": found.sigma}
    origin |= freedom_kept(found.model.names, sure.freedom)
    return Candidate(
        tuple(effect.label for effect in effects),
        specs[len(specs) - added :],
        tuple(sorted({effect.family for effect in effects})),
        delta,
        f,
        1.0 - (probability or 0.0),
        estimates(found.model, found.values, sure, {p.name for effect in effects for p in effect.parameters}),
        Calibration(found.by_name, found.model.names, sure.covariance, MappingProxyType(origin)),
        probability=probability,
        intervals=sure.kind,
        reliance=sure.sentence,
        freedom=tuple(sure.freedom.tolist()),
    )


def predicting_candidate(model: PredictingModel, named: Candidate, postures: Array) -> Candidate:
    """The posterior's average: what is named, with everything else that it has in it."""
    freedom = np.full(len(model.values), float(model.freedom))
    ranges = joint_range(postures, model.model.joint_types)
    origin = {"source": DIAGNOSED, **ranges, "scatter_mm": model.sigma, **freedom_kept(model.model.names, freedom)}
    return Candidate(
        named.effects,
        tuple(model.specs),
        named.classes,
        named.delta_bic,
        named.f,
        named.p_adjusted,
        named.parameters,
        Calibration(model.by_name, model.model.names, model.covariance, MappingProxyType(origin)),
        probability=named.probability,
        intervals=named.intervals,
        reliance=named.reliance,
        freedom=tuple(freedom.tolist()),
    )


def estimates(model: Model, values: Array, sure: Uncertainty, names: set[str]) -> tuple[Estimate, ...]:
    """Estimates and 95 % intervals of the parameters with these names."""
    parameters, deviations = model.parameters, np.sqrt(np.maximum(np.diag(sure.covariance), 0.0))  # of a perfect fit
    limits = limits_95(parameters, values, deviations, sure.freedom)
    figures = np.column_stack([values, deviations, limits])
    rows = zip(parameters, figures, strict=True)
    return tuple(Estimate(p.name, p.file_unit, *(row * p.to_file).tolist()) for p, row in rows if p.name in names)


def trial_list(found: Posterior) -> tuple[Trial, ...]:
    """Every effect alone against the base model, likeliest first; of a scanned setting only the best value.

    Rows that are left out have shifts of their own, too large for anything else to explain them.
    """
    problem, shares = found.whole, block_probabilities(found)
    products = problem.products
    wrong = [problem.numbers[block.label] for block in found.best.blocks if block.row]
    left = products.state([(block, len(SIZES) - 1) for block in wrong])
    freedom = products.freedom - len(left.places)
    added = logsumexp(products.added(left), axis=1) - np.log(products.limits)
    total = sum(b.weight for b in problem.blocks if not b.row)
    best: dict[str, Trial] = {}
    for (numbers, index), grams in zip(products.alike, left.within, strict=True):
        scores, width = left.scores[index], index.shape[1]
        gains = np.einsum("bi,bij,bj->b", scores, np.linalg.pinv(grams, hermitian=True), scores)
        rest = max(freedom - width, 1)
        f = gains / width / (np.maximum(left.squares - gains, 1e-300) / rest)
        for k, ratio, p in zip(numbers.tolist(), f.tolist(), fdtrc(width, rest, f).tolist(), strict=True):
            block = problem.blocks[k]
            odds = float(added[k] + np.log(max(block.weight, 1e-300) / total))
            trial = Trial(block.label, ratio, p, 1.0 - shares.get(block.key, 0.0), -2.0 * odds)
            if block.named and (block.key not in best or trial.delta_bic < best[block.key].delta_bic):
                best[block.key] = trial
    return tuple(sorted(best.values(), key=lambda t: (round(t.delta_bic, 9), t.effect)))
