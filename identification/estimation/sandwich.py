"""Covariance of estimates that holds where the model is incomplete: clustered sandwich, corrected for few rows.

Rows are grouped so that what is left unexplained may be of any size and any correlation within a group, and is
independent between groups. With the whitened Jacobian J_g and residuals r_g of group g, B = (J^T J)^-1 and the leverage
H_gg = J_g B J_g^T (B. A. Pustejovsky, E. Tipton, 2018: CR2, after R. M. Bell, D. F. McCaffrey, 2002)

    cov = B [ sum_g J_g^T A_g r_g r_g^T A_g J_g ] B,     A_g = (I - H_gg)^(-1/2),

which is unbiased if the model is complete and the noise white. With a prior, whose rows R are whitened as J is, the
estimates are those of the posterior's mode, B = (J^T J + R^T R)^-1, and the prior adds s^2 R^T R in the middle, s^2
being the variance of white noise: its part of the errors is as the prior says. Intervals are Student's, with the
degrees of freedom of the chi-square that has the same first two moments as the variance (Satterthwaite), for each
parameter its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

TINY = 1e-15  # leverages below it are rounding
LARGE = 200  # groups, and combinations: of more, what two groups share through the fit is left out of the freedom
ALONE = 1e-8  # a group whose leverage is nearer to one than this determines a combination by itself


class Sandwich(NamedTuple):
    """covariance : (p, p);  freedom : (p,) degrees of freedom of each variance, infinite where it is zero by force."""

    covariance: Array
    freedom: Array


def sandwich(
    jacobian: Array, residual: Array, root: Array, groups: NDArray[np.int64], variance: float = 1.0
) -> Sandwich | None:
    """The covariance of least-squares estimates; None where one group alone determines a combination of parameters.

    jacobian : (m, d, p) and residual : (m, d), whitened;  root : (p, rank), root @ root.T = (J^T J + R^T R)^-1
    groups : (m,) number of the group of each row, 0, 1, ...;  variance : of white noise, beside a prior
    """
    columns = jacobian @ root
    leverages, vectors, scores = decomposed_groups(columns, residual, groups)
    if leverages.max() > 1.0 - ALONE:
        return None
    factors = 1.0 / np.sqrt(1.0 - np.maximum(leverages, 0.0))
    corrected = (
        root @ (vectors @ (factors * scores)[:, :, None])[:, :, 0].T
    )  # (p, G): what each group adds to the estimates
    held = np.eye(root.shape[1]) - np.einsum("mdr,mds->rs", columns, columns, optimize=True)  # R^T R; without it zero
    held = root @ held @ root.T
    held_variances = np.maximum(np.diag(held), 0.0)
    freedom = np.array(
        [_freedom(row @ vectors, leverages, factors, vectors, k) for row, k in zip(root, held_variances, strict=True)]
    )
    return Sandwich(corrected @ corrected.T + variance * held, freedom)


def decomposed_groups(columns: Array, residual: Array, groups: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Of columns Q (m, d, r), Q_g^T Q_g = V diag(l) V^T: (G, k) l, (G, r, k) V and (G, k) V^T Q_g^T r_g, zero where a
    group has fewer than k directions;  groups as large as each other at a time, small ones by Q_g Q_g^T."""
    d, r = columns.shape[1:]
    order, counts = np.argsort(groups, kind="stable"), np.bincount(groups)
    starts, most = np.cumsum(counts) - counts, min(r, d * int(counts.max()))
    values, vectors = np.zeros((len(counts), most)), np.zeros((len(counts), r, most))
    scores = np.zeros((len(counts), most))
    for size in np.unique(counts):
        of_size, columns_used = np.flatnonzero(counts == size), slice(min(r, d * int(size)))
        rows = order[starts[of_size, None] + np.arange(size)]
        q = columns[rows].reshape(len(of_size), -1, r)
        across = np.swapaxes(q, 1, 2)
        if q.shape[1] < r:
            eigenvalues, left = np.linalg.eigh(q @ across)
            directions = across @ left / np.sqrt(np.where(eigenvalues > TINY, eigenvalues, np.inf))[:, None, :]
        else:
            eigenvalues, directions = np.linalg.eigh(across @ q)
        values[of_size, columns_used], vectors[of_size, :, columns_used] = eigenvalues, directions
        projected = np.swapaxes(directions, 1, 2) @ (across @ residual[rows].reshape(len(of_size), -1, 1))
        scores[of_size, columns_used] = projected[:, :, 0]
    return values, vectors, scores


def _freedom(turned: Array, leverages: Array, factors: Array, vectors: Array, held: float) -> float:
    """Satterthwaite's degrees of freedom of one variance, 2 E^2 / var, under white noise of variance one.

    The variance is |P^T e|^2 of white e with P^T P = diag(d) - W W^T: d_g = |A_g Q_g a|^2 and W_g = Q_g^T A_g Q_g a.
    turned : (G, r) a in the eigenvectors of each group;  held : the prior's part of the variance
    """
    diagonal = np.sum(leverages * np.square(factors * turned), axis=1)
    inner = (vectors @ (leverages * factors * turned)[:, :, None])[:, :, 0]
    lengths = np.sum(inner**2, axis=1)
    if min(inner.shape) > LARGE:
        squares = np.sum(lengths**2)
    else:
        squares = np.sum(np.square(inner.T @ inner if inner.shape[0] > inner.shape[1] else inner @ inner.T))
    first = diagonal.sum() - lengths.sum()
    second = np.sum(diagonal**2) - 2.0 * np.sum(diagonal * lengths) + squares
    return float((first + held) ** 2 / second) if second > 0.0 else float("inf")
