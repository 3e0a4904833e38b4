"""Uncertainty of the estimates of a diagnosis, by the rule that `identify` uses, and warnings about its fit."""

from __future__ import annotations

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.plausibility import another_frame, copied_rows, far_off, flipped, misread, outside_limits
from identification.estimation.uncertainty import FittedRows, Uncertainty, uncertainty
from identification.gap.fits.fit import Fit
from identification.gap.selection.selection import HypothesisSearch
from identification.information import spectrum
from identification.measurements import Measurements


def certainty(search: HypothesisSearch, found: Fit) -> Uncertainty:
    """Covariance and degrees of freedom of a fit's estimates, computed as if no bound were active.

    A given sigma is used unless a noise model was estimated from the residuals; in that case the sandwich covariance
    is used, which holds whether or not the noise model is right. A fit with a prior uses the scatter of its residuals.
    """
    rows = search.rows
    if found.prior_rows is not None:
        freedom = np.full(len(found.values), float(max(found.freedom, 1)))
        return Uncertainty("scatter", found.covariance(bounded=False), freedom)
    sigma = None if search.noise_estimated else rows.sigma or search.hypotheses.arm.sigma
    unit, m, d = sigma or 1.0, len(rows), rows.dimension
    jacobian, residual = found.jacobian / unit, found.residual / unit
    tall, numbers = jacobian.reshape(m, d, -1), (rows.posture_numbers, rows.repeat_numbers)
    fitted = FittedRows(tall, residual.reshape(m, d), found.rank, rows.sequence, *numbers)
    decomposed = spectrum(jacobian, found.model.scales)
    return uncertainty(fitted, decomposed, known=sigma is not None, doubtful=search.noise_estimated)


def fit_doubts(arm: Arm, measurements: Measurements, found: Fit, left: Array) -> tuple[str, ...]:
    """Warnings about the data and about a model fitted to them, one sentence each;  left : (m, d) residuals [mm]."""
    estimable = np.ones(len(found.values), dtype=bool)
    bad = [*far_off(left, found.model), *flipped(found.model, found.values, estimable)]
    place = (*another_frame(arm, measurements), *outside_limits(arm, measurements))
    return (*misread(arm, measurements).sentences, *bad, *place, *copied_rows(measurements))
