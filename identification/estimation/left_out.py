"""What a fit leaves of postures that it has not seen: each left out in turn, without a second fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.measurements import POINT, Measurements, rms_distance
from identification.threads import single_thread

if TYPE_CHECKING:
    from identification.estimation.result import Identification

ALONE = 1e-9  # of 1: what is left of a posture that alone determines something


@single_thread()
def left_out_residuals(fit: Identification, measurements: Measurements) -> Array | None:
    """(m, d) each posture's positions less where a fit to all other postures puts them [mm].

    With the leverages H_g of the rows of a posture the residuals without them are (I - H_g)^-1 r_g: exact for a model
    that is linear in its parameters, and to first order for any other (R. D. Cook, S. Weisberg, "Residuals and
    Influence in Regression", 1982, section 2.2). The noise of one measurement is in it.

    measurements : the rows of the fit; copies do not count, and get what is left of the row they copy

    None where something is not identifiable, or a posture alone determines it.
    """
    if fit.not_identifiable or len(measurements) != len(fit.residuals_after):
        return None
    kept, weights = measurements.originals == np.arange(len(measurements)), np.ones(len(measurements))
    if (sigma := measurements.sigma) is not None:
        weights = np.sqrt(np.mean(sigma**2)) / sigma
    _, jacobian = fit.model.linearize(measurements.postures, fit.parameters, measurements.conditions)
    weights = weights[kept]
    rows = weights[:, None, None] * jacobian[kept]
    m, d, p = rows.shape
    prior = np.zeros((0, p)) if fit.prior is None else fit.prior.rows(fit.model.parameters, fit.scatter or 0.0)
    leverage = _orthonormal(np.concatenate([rows.reshape(-1, p), prior]))[: m * d].reshape(m, d, -1)
    residuals = weights[:, None] * fit.residuals_after[kept]
    without = np.empty_like(residuals)
    for group in _groups(measurements.posture_numbers[kept]):
        block = leverage[group].reshape(-1, leverage.shape[-1])
        left = np.eye(len(block)) - block @ block.T
        if np.linalg.eigvalsh(left)[0] < ALONE:
            return None
        without[group] = np.linalg.solve(left, residuals[group].ravel()).reshape(-1, d)
    return np.asarray((without / weights[:, None])[np.cumsum(kept)[measurements.originals] - 1])


def left_out_rms(fit: Identification, measurements: Measurements) -> float | None:
    """Root mean square distance [mm] of `left_out_residuals`, copies not counted; None as there."""
    residuals = left_out_residuals(fit, measurements)
    return None if residuals is None else rms_distance(residuals[np.unique(measurements.originals)][:, POINT])


def _orthonormal(rows: Array) -> Array:
    """(N, p) columns of the same span, orthonormal."""
    sizes = np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    return np.asarray(np.linalg.qr(rows / sizes)[0])


def _groups(numbers: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Row numbers of each posture, from the number of each row's (m,)."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1)
