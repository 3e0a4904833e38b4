"""Fit smooth functions of joint angles beside a linear model, with the smoothness estimated from the data.

The error of a joint is a cubic spline on equally spaced nodes. In the cosine transform of its coefficients a stationary
prior is diagonal: with node spacing h the k-th of K cosines has the variance

    v_k  ~  (t_k + w)^-2,      t_k = 2 - 2 cos(pi k / K),      w = 3 (h / length)^2,

a Matern process of smoothness 3/2 (C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006,
section 4.2). Its size and correlation length maximize the marginal likelihood, in which the scale of the noise and
the parameters that are not penalized are integrated out (R. Christensen, W. Wecker, C. Ansley: restricted likelihood).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.error_curve import ErrorCurve, local_splines

# reasons: identification/README.md, "Constants"
SPACING = np.radians(2.0)  # from node to node [rad]
MOST_NODES = 720  # of all curves
FEWEST_NODES = 8  # of one
SMALLEST, LARGEST = 1e-3, 1e3  # size of a curve, relative to one that contributes as much as the noise
ITERATIONS, FLAT = 100, 1e-9


@dataclass(frozen=True)
class Basis:
    """Spline basis of one joint (from 0) between the smallest and the largest measured angle [rad].

    start, stop : these angles;  count : K, number of nodes and of cosines
    """

    joint: int
    start: float
    stop: float
    count: int

    @classmethod
    def of(cls, angles: Array, joint: int, spacing: float) -> Basis:
        """Basis for measured angles (m,), not all equal, with nodes at most `spacing` apart [rad]."""
        low, high = float(angles.min()), float(angles.max())
        return cls(joint, low, high, max(FEWEST_NODES, int(np.ceil((high - low) / spacing)) + 1))

    @property
    def spacing(self) -> float:
        """Node spacing h [rad]."""
        return (self.stop - self.start) / (self.count - 1)

    @cached_property
    def cosines(self) -> Array:
        """(K, K) orthonormal matrix that maps coefficients of the cosines to those of the splines."""
        k = np.arange(self.count)
        table = np.cos(np.pi / self.count * np.outer(k + 0.5, k)) * np.sqrt(2.0 / self.count)
        table[:, 0] /= np.sqrt(2.0)
        return table

    def at(self, angles: Array) -> Array:
        """(m, K) values of the K cosines' functions at angles (m,) [rad]."""
        place, parts = local_splines(angles, self.start, self.stop, self.count)
        splines = np.zeros((len(place), self.count + 6))
        np.put_along_axis(splines, place + 3, parts, axis=1)
        return np.asarray(splines[:, 3:-3] @ self.cosines)

    def variances(self, size: float, length: float) -> tuple[Array, Array]:
        """(K,) prior variances with mean size^2, and their derivatives with respect to log(length)."""
        t = 2.0 - 2.0 * np.cos(np.pi * np.arange(self.count) / self.count)
        w = 3.0 * (self.spacing / length) ** 2
        shape, slope = (t + w) ** -2.0, 4.0 * w * (t + w) ** -3.0
        mean = shape.mean()
        return size**2 * shape / mean, size**2 * (slope / mean - shape * slope.mean() / mean**2)

    def curve(self, coefficients: Array) -> ErrorCurve:
        """The function with these coefficients of the cosines (K,)."""
        splines = np.pad(self.cosines @ coefficients, 1)
        return ErrorCurve(self.start, self.stop, (splines[:-2] + 4.0 * splines[1:-1] + splines[2:]) / 6.0)


class Posterior(NamedTuple):
    """Posterior of coefficients (K,) for unit noise, with covariance diag(known) + sign * factor^T factor.

    log_shrunk : log ratio of the determinants of prior and posterior covariance
    """

    coefficients: Array
    known: Array
    sign: float
    factor: Array
    log_shrunk: float

    @property
    def variances(self) -> Array:
        """(K,) diagonal of the covariance."""
        return np.asarray(self.known + self.sign * np.einsum("nk,nk->k", self.factor, self.factor))

    @property
    def covariance(self) -> Array:
        """(K, K) covariance of the coefficients."""
        return np.asarray(np.diag(self.known) + self.sign * self.factor.T @ self.factor)


@dataclass(frozen=True)
class Evidence:
    """Fit of the curves at given sizes and lengths of their priors.

    cost : -2 log of the marginal likelihood, up to a constant of the data
    slope : (2 x curves,) its derivatives with respect to the log sizes and lengths
    posterior : of the K coefficients of all curves;  variances : (K,) of their prior, for unit noise
    effective : effective number of coefficients;  squares : penalized sum of squares
    """

    cost: float
    slope: Array
    posterior: Posterior
    variances: Array
    effective: float
    squares: float

    @property
    def coefficients(self) -> Array:
        """(K,) of all curves."""
        return self.posterior.coefficients

    @cached_property
    def covariance(self) -> Array:
        """(K, K) of the coefficients, for unit noise."""
        return self.posterior.covariance


@dataclass(frozen=True)
class Penalized:
    """Columns (N, K) of the curves and a residual (N,), both projected off the columns that are not penalized.

    bases : of the curves, in the order of the columns
    freedom : number of coordinates (before any compression) less the rank of the columns that are not penalized
    """

    bases: tuple[Basis, ...]
    columns: Array
    residual: Array
    freedom: int

    @cached_property
    def gram(self) -> Array:
        """(K, K) products of the columns."""
        return np.asarray(self.columns.T @ self.columns)

    @cached_property
    def right(self) -> Array:
        """(K,) products of the columns with the residual."""
        return np.asarray(self.columns.T @ self.residual)

    def evidence(self, logs: Array) -> Evidence:
        """The fit at these logs (2 x curves,) of size (in units of the noise) and length [rad] of each prior."""
        found = [basis.variances(*np.exp(pair)) for basis, pair in zip(self.bases, logs.reshape(-1, 2), strict=True)]
        variances = np.concatenate([v for v, _ in found])
        solve = self._by_rows if len(self.residual) < len(variances) else self._by_columns
        posterior = solve(variances)
        whole = float(self.residual @ self.residual)
        # a perfect fit leaves rounding
        squares = max(whole - float(self.right @ posterior.coefficients), 1e-14 * whole, 1e-300)
        cost = self.freedom * np.log(squares / self.freedom) + posterior.log_shrunk
        left = 1.0 - posterior.variances / variances  # share of each coefficient that the data determine
        pull = self.freedom / squares * posterior.coefficients**2 / variances
        parts = np.split((left - pull) / variances, np.cumsum([b.count for b in self.bases])[:-1])
        slope = [(2.0 * part @ v, part @ by_length) for part, (v, by_length) in zip(parts, found, strict=True)]
        return Evidence(float(cost), np.ravel(slope), posterior, variances, float(left.sum()), squares)

    def _by_columns(self, variances: Array) -> Posterior:
        """Posterior from a K x K matrix."""
        root = np.sqrt(variances)
        triangle, determinant = _inverse_root(root[:, None] * self.gram * root)
        factor = triangle * root
        return Posterior(factor.T @ (factor @ self.right), np.zeros(len(root)), 1.0, factor, determinant)

    def _by_rows(self, variances: Array) -> Posterior:
        """The same from an N x N matrix (Woodbury's identity), for fewer rows than columns."""
        spread = self.columns * variances
        triangle, determinant = _inverse_root(spread @ self.columns.T)
        factor = triangle @ spread
        return Posterior(factor.T @ (triangle @ self.residual), variances, -1.0, factor, determinant)

    def best(self, start: Array | None = None) -> tuple[Array, Evidence]:
        """Logs of size and length of each prior that maximize the marginal likelihood, and the fit there.

        start : (2 x curves,) logs to start from, None: `guess`
        """
        from scipy.optimize import minimize

        def likelihood(logs: Array) -> tuple[float, Array]:
            found = self.evidence(logs)
            return found.cost, found.slope

        low, high = np.transpose(self._bounds)
        first = np.clip(self.guess.ravel() if start is None else start, low, high)
        options = {"bounds": self._bounds, "options": {"maxiter": ITERATIONS, "ftol": FLAT}}
        logs = minimize(likelihood, first, jac=True, method="L-BFGS-B", **options).x
        return logs, self.evidence(logs)

    @property
    def guess(self) -> Array:
        """(curves, 2) default start of the search: as large as the noise, and three nodes long."""
        lengths = [3.0 * basis.spacing for basis in self.bases]
        return np.log(np.column_stack([self._units, lengths]))

    @property
    def _bounds(self) -> list[tuple[float, float]]:
        pairs = []
        for basis, one in zip(self.bases, self._units.tolist(), strict=True):
            pairs += [(SMALLEST * one, LARGEST * one), (basis.spacing, max(2.0 * np.pi, basis.spacing))]
        return [(float(np.log(low)), float(np.log(high))) for low, high in pairs]

    @property
    def _units(self) -> Array:
        """(curves,) sizes at which a curve contributes as much to the residuals as the noise."""
        parts = np.split(np.diag(self.gram), np.cumsum([b.count for b in self.bases])[:-1])
        return np.array([np.sqrt(self.freedom / part.sum()) for part in parts])


def _inverse_root(matrix: Array) -> tuple[Array, float]:
    """Lower triangle L with L^T L = (1 + M)^-1 for a symmetric M >= 0, which is overwritten, and log det(1 + M).

    Half the work of the inverse, of which a search needs the diagonal alone.
    """
    from scipy.linalg import lapack

    matrix[np.diag_indices_from(matrix)] += 1.0
    triangle, _ = lapack.dpotrf(matrix.T, lower=1, clean=1, overwrite_a=1)  # columns first, as LAPACK has them
    determinant = float(2.0 * np.log(np.diag(triangle)).sum())
    return np.asarray(lapack.dtrtri(triangle, lower=1, overwrite_c=1)[0]), determinant


def inverse_if_clear(matrix: Array, condition: float) -> Array | None:
    """Inverse of a symmetric matrix if it is positive definite and well conditioned, else None.

    condition : smallest allowed ratio of smallest to largest eigenvalue, estimated in the 1-norm with a safety factor
    """
    from scipy.linalg import lapack

    triangle, failed = lapack.dpotrf(matrix, lower=1)
    size = float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    if failed or lapack.dpocon(triangle, size, uplo="L")[0] <= 10.0 * len(matrix) * condition:
        return None
    lower = lapack.dpotri(triangle, lower=1)[0]
    strict = np.tril(lower, -1)
    return np.asarray(strict + strict.T + np.diag(np.diag(lower)))


def curve_columns(bases: Sequence[Basis], postures: Array, levers: Array) -> Array:
    """(m, d, K) derivative of the positions with respect to the coefficients of all curves.

    postures : (m, n) [rad];  levers : (m, d, n) derivative with respect to each joint's angle [mm/rad]
    """
    columns = [levers[:, :, b.joint, None] * b.at(postures[:, b.joint])[:, None, :] for b in bases]
    return np.concatenate([np.zeros((*levers.shape[:2], 0)), *columns], axis=2)


def bases_of(postures: Array, joints: Sequence[int]) -> tuple[Basis, ...]:
    """Bases of those joints (from 0) that move, with nodes `SPACING` apart, or wider to stay within `MOST_NODES`."""
    ranges = np.ptp(postures, axis=0)
    moving = [j for j in joints if ranges[j] > 0.0]
    spacing = max(SPACING, float(sum(ranges[j] for j in moving)) / MOST_NODES)
    return tuple(Basis.of(postures[:, j], j, spacing) for j in moving)
