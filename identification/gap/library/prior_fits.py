"""Repeat the fits of a diagnosis with the rest of the library under its prior, to allow for unnamed effects.

Names and tests do not change. Beside the named effects, which are free, the model has all others with a normal prior of
zero mean and their typical sizes times a common factor from 0 to 1. The factor maximizes the marginal likelihood: it is
small where the named effects explain everything, and 1 where much remains unexplained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identification.arm import Calibration
from identification.estimation.restricted_likelihood import Restricted
from identification.estimation.uncertainty import Uncertainty
from identification.gap.candidate import Candidate
from identification.gap.candidates import estimates
from identification.gap.curves.curves import CurveFit
from identification.gap.fits.fit import Fit, fit
from identification.gap.library.library_prior import LibraryPrior, given_by, library_prior
from identification.measurements import Measurements


def held(found: Fit, measurements: Measurements, names: Sequence[str] | None = None) -> tuple[Fit, LibraryPrior]:
    """Repeat a fit with the library's other effects in its model; returns it and the prior that was used.

    measurements : the rows of the fit;  names : restrict the prior to these effects, None: all
    """
    arm = replace(found.model.arm, calibration=Calibration(found.by_name))
    library = library_prior(arm, given_by(measurements), names, required=False)
    size, noise = likeliest_size(found, library)
    library = library.times(size)
    if not library.added:
        return found, library
    start = library.model.parameters.mapping(library.model.values)
    wide = fit(library.model, found.rows, start, prior=library.prior, noise=noise)
    return (_beside_curves(wide, found) if isinstance(found, CurveFit) else wide), library


def likeliest_size(found: Fit, library: LibraryPrior) -> tuple[float, float]:
    """Factor from 0 to 1 on the typical sizes that maximizes the marginal likelihood, and the noise beside it [mm]."""
    model, rows = library.model, found.rows
    deviations = model.parameters.vector(library.prior.deviations)
    jacobian = rows.whiten(model.jacobian(rows.postures, model.values, rows.conditions))
    known = deviations > 0.0
    free = found.basis
    return Restricted.of(found.residual, free, jacobian[:, known] * deviations[known]).likeliest_size()


def _beside_curves(wide: Fit, found: CurveFit) -> CurveFit:
    """The fit `wide` with the error curves of `found`, which keep their values and uncertainty."""
    columns, rows = wide.jacobian, wide.prior_rows
    penalized = columns if rows is None else np.concatenate([columns, rows])
    moved = found.rows.whiten(found.curve_columns(found.rows.postures, found.rows.conditions))
    padded = np.concatenate([moved, np.zeros((len(penalized) - len(columns), moved.shape[1]))])
    scales = wide.model.scales
    response = -np.linalg.lstsq(penalized / scales, padded, rcond=None)[0] / scales[:, None]
    return CurveFit.of(wide, found.bases, found.evidence, response)


def held_candidate(named: Candidate, fitted: Fit, library: LibraryPrior) -> Candidate:
    """A candidate with the estimates and intervals of a fit that has the library's other effects in its model."""
    covariance = fitted.covariance(bounded=False)
    freedom = float(max(fitted.freedom, 1))
    sure = Uncertainty("scatter", covariance, np.full(len(covariance), freedom))
    own = [name for name in fitted.model.names if name not in library.prior.deviations]
    labels = set(named.effects)
    shown = {p.name for effect in fitted.model.effects if effect.label in labels for p in effect.parameters}
    every = Calibration(fitted.by_name, fitted.model.names, covariance, named.calibration.provenance)
    return replace(
        named,
        parameters=estimates(fitted, sure, shown),
        calibration=every.about(own),
        intervals=sure.kind,
        reliance=f"{sure.sentence}, with a prior of typical sizes",
        freedom=(freedom,) * len(own),
        held=library.added,
    )
