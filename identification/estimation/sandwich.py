"""Covariance of estimates that holds where the model is incomplete: clustered sandwich, corrected for few rows.

Rows are grouped so that what is left unexplained may be of any size and any correlation within a group, and is
independent between groups. With the whitened Jacobian J_g and residuals r_g of group g, B = (J^T J)^-1 and the leverage
H_gg = J_g B J_g^T (B. A. Pustejovsky, E. Tipton, 2018: CR2, after R. M. Bell, D. F. McCaffrey, 2002)

    cov = B [ sum_g J_g^T A_g r_g r_g^T A_g J_g ] B,     A_g = (I - H_gg)^(-1/2),

which is unbiased if the model is complete and the noise white. Intervals are Student's, with the degrees of freedom of
the chi-square that has the same first two moments as the variance (Satterthwaite), for each parameter its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

ALONE = 1e-8  # a group whose leverage is nearer to one than this determines a combination by itself


class Sandwich(NamedTuple):
    """covariance : (p, p);  freedom : (p,) degrees of freedom of each variance, infinite where it is zero by force."""

    covariance: Array
    freedom: Array


def sandwich(jacobian: Array, residual: Array, root: Array, groups: NDArray[np.int64]) -> Sandwich | None:
    """The covariance of least-squares estimates; None where one group alone determines a combination of parameters.

    jacobian : (m, d, p) and residual : (m, d), whitened;  root : (p, rank), root @ root.T = (J^T J)^-1
    groups : (m,) number of the group of each row, 0, 1, ...
    """
    grams, scores = grouped(jacobian @ root, residual, groups)
    leverages, vectors = np.linalg.eigh(grams)
    if leverages.max() > 1.0 - ALONE:
        return None
    across = np.swapaxes(vectors, 1, 2)
    factors = 1.0 / np.sqrt(1.0 - np.maximum(leverages, 0.0))
    turned = factors * (across @ scores[:, :, None])[:, :, 0]
    corrected = root @ (vectors @ turned[:, :, None])[:, :, 0].T  # (p, G): what each group adds to the estimates
    freedom = np.array([_freedom(row @ vectors, leverages, factors, vectors) for row in root])
    return Sandwich(corrected @ corrected.T, freedom)


def grouped(columns: Array, residual: Array, groups: NDArray[np.int64]) -> tuple[Array, Array]:
    """(G, r, r) Q_g^T Q_g and (G, r) Q_g^T r_g of columns Q (m, d, r);  groups as large as each other at a time."""
    order, counts = np.argsort(groups, kind="stable"), np.bincount(groups)
    starts = np.cumsum(counts) - counts
    grams, scores = (
        np.empty((len(counts), columns.shape[2], columns.shape[2])),
        np.empty((len(counts), columns.shape[2])),
    )
    for size in np.unique(counts):
        of_size = np.flatnonzero(counts == size)
        rows = order[starts[of_size, None] + np.arange(size)]
        q = columns[rows].reshape(len(of_size), -1, columns.shape[2])
        across = np.swapaxes(q, 1, 2)
        grams[of_size] = across @ q
        scores[of_size] = (across @ residual[rows].reshape(len(of_size), -1, 1))[:, :, 0]
    return grams, scores


def _freedom(turned: Array, leverages: Array, factors: Array, vectors: Array) -> float:
    """Satterthwaite's degrees of freedom of one variance, 2 E^2 / var, under white noise.

    The variance is |P^T e|^2 of white e with P^T P = diag(d) - W W^T: d_g = |A_g Q_g a|^2 and W_g = Q_g^T A_g Q_g a.
    turned : (G, r) a in the eigenvectors of each group
    """
    diagonal = np.sum(leverages * np.square(factors * turned), axis=1)
    inner = (vectors @ (leverages * factors * turned)[:, :, None])[:, :, 0]
    gram = inner.T @ inner
    first = diagonal.sum() - np.trace(gram)
    second = np.sum(diagonal**2) - 2.0 * np.sum(diagonal * np.sum(inner**2, axis=1)) + np.sum(gram**2)
    return float(first**2 / second) if second > 0.0 else float("inf")
