"""The information matrix, and what a plan makes estimable before any data exist (paper, eq. 16-19, corrected).

One rule decides every rank (`column_lengths` and `significant`): columns are scaled to unit length, one whose length,
counted in mm at the tip (`Model.scales`), is nothing beside the longest is zero, and singular values below a share of
the largest are zero. No choice of units can change whether a parameter is estimable. An information matrix holds the
squares of the singular values, half their digits: `log_determinants` applies the rule to it, its share being rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, readonly

RANK_TOLERANCE = 1e-9  # singular values of columns of unit length below this share of the largest are zero
CLEAR = 1e-8  # smallest eigenvalue of a normal matrix of unit columns that needs no closer look
EPS = float(np.finfo(float).eps)
SHOWN = 0.02  # coefficients below this share of the largest are not shown, and such differences from 1 neither
TOUCHED = 1e-3  # a parameter with less than this in every null direction is estimable


def information_matrix(jacobian: Array, weights: Array | None = None) -> Array:
    """(..., p, p) sum_i w_i J_i^T J_i of Jacobians (..., m, d, p); weights (m,) default to one."""
    *batch, m, d, p = jacobian.shape
    rows = jacobian if weights is None else jacobian * np.sqrt(np.asarray(weights))[:, None, None]
    rows = rows.reshape(*batch, m * d, p)
    return np.swapaxes(rows, -1, -2) @ rows


def column_lengths(sizes: Array, scales: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(..., p) what to divide the columns of a Jacobian by, and which of them are zero (those by their scale).

    sizes : (..., p) Euclidean lengths of the columns;  scales : (p,) `Model.scales` [mm/unit]
    """
    relative = sizes / scales
    longest = np.minimum(relative, sizes)  # a joint behind a short link moves the tip by far more than its scale
    zero = relative <= RANK_TOLERANCE * np.max(longest, axis=-1, keepdims=True, initial=np.finfo(float).tiny)
    return np.where(zero, scales, sizes), zero


def significant(values: Array, tolerance: float = RANK_TOLERANCE) -> NDArray[np.bool_]:
    """(..., r) which singular values of unit columns count: those above `tolerance` times the largest."""
    return values > tolerance * np.max(values, axis=-1, keepdims=True, initial=0.0)


def log_determinants(information: Array) -> Array:
    """(...) log det of information matrices (..., p, p) of scaled parameters; -inf where the rule calls them singular.

    Of unit columns an eigenvalue below (8 + p) times the rounding unit of the largest is nothing but rounding: of
    matrices that lack a rank it comes to 3 to 7 units for p up to 60. The determinant of a matrix of trace p is at most
    e times its smallest eigenvalue, and spares most matrices their eigenvalues.
    """
    p = information.shape[-1]
    sizes = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0.0))
    usable = np.array(np.all(np.isfinite(information), axis=(-2, -1)))
    lengths, zero = column_lengths(np.where(usable[..., None], sizes, 1.0), np.ones(p))
    usable &= ~np.any(zero, axis=-1)
    scaled = information / lengths[..., :, None] / lengths[..., None, :]
    unit = np.where(usable[..., None, None], scaled, np.eye(p))
    signs, logs = np.linalg.slogdet(unit)
    usable &= signs > 0
    close = usable & (logs <= 1.0 + np.log(p * (8 + p) * EPS))
    if np.any(close):
        usable[close] = np.all(significant(np.linalg.eigvalsh(unit[close]), (8 + p) * EPS), axis=-1)
    return np.where(usable, logs + 2.0 * np.sum(np.log(lengths), axis=-1), -np.inf)


def inverses(information: Array) -> Array:
    """(..., p, p) inverses of information matrices of scaled parameters, infinite where `log_determinants` is -inf."""
    p = information.shape[-1]
    singular = np.isneginf(log_determinants(information))[..., None, None]
    matrices = np.where(singular, np.eye(p), information)
    lengths = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
    inverse = np.linalg.inv(matrices / lengths[..., :, None] / lengths[..., None, :])
    return np.where(singular, np.inf, inverse / lengths[..., :, None] / lengths[..., None, :])


def column_space(jacobian: Array, scales: Array) -> Array:
    """(N, rank) orthonormal basis of the columns of a Jacobian (N, p) that may be whitened."""
    return column_space_of(jacobian, scales)[0]


def column_space_of(jacobian: Array, scales: Array) -> tuple[Array, Array]:
    """`column_space`, and (p, rank) of what combinations of the columns it consists."""
    lengths, zero = column_lengths(np.linalg.norm(jacobian, axis=0), scales)
    unit = np.where(zero, 0.0, jacobian / lengths)
    values, vectors = np.linalg.eigh(unit.T @ unit)
    if values.min(initial=1.0) > CLEAR:
        return _orthonormal(unit, vectors / np.sqrt(values), lengths)
    left, singular, right = np.linalg.svd(unit, full_matrices=False)
    seen = significant(singular)
    return left[:, seen], right[seen].T / singular[seen] / lengths[:, None]


def _orthonormal(unit: Array, turn: Array, lengths: Array) -> tuple[Array, Array]:
    """Unit columns times `turn`, which are orthonormal but for what a normal matrix loses, half the digits; a Newton
    step (A. Bjorck, C. Bowie, 1971) makes up for it. Products of matrices alone, in half the time of an SVD."""
    basis = unit @ turn
    step = 1.5 * np.eye(len(turn)) - 0.5 * basis.T @ basis
    return basis @ step, turn @ step / lengths[:, None]


@dataclass(frozen=True)
class Spectrum:
    """Singular value decomposition of a Jacobian whose columns are scaled to unit length.

    lengths : (p,) what each column was divided by
    values : (p,) singular values, largest first
    directions : (p, p) orthonormal columns, in the scaled parameters lengths * parameters
    rank : number of singular values that count
    """

    lengths: Array
    values: Array
    directions: Array
    rank: int

    def truncated(self, tolerance: float) -> Spectrum:
        """The same decomposition with the rank at another tolerance (share of the largest singular value)."""
        return replace(self, rank=int(np.count_nonzero(significant(self.values, tolerance))))

    @property
    def estimable(self) -> Array:
        """(p, rank) orthonormal basis of the combinations that the data determine."""
        return self.directions[:, : self.rank]

    @property
    def null_space(self) -> Array:
        """(p, p - rank) orthonormal basis of the combinations that the data leave undetermined."""
        return self.directions[:, self.rank :]

    @property
    def covariance(self) -> Array:
        """(p, p) (J^T J)^-1 on the estimable directions, zero on the others: pseudo-inverse in scaled parameters."""
        return self.root @ self.root.T

    @property
    def root(self) -> Array:
        """(p, rank) whose product with its transpose is the covariance; J @ root has orthonormal columns."""
        return self.estimable / self.values[: self.rank] / self.lengths[:, None]


def spectrum(
    jacobian: Array, scales: Array, tolerance: float = RANK_TOLERANCE, held: NDArray[np.bool_] | bool = False
) -> Spectrum:
    """Decomposes a Jacobian (m, d, p) or (rows, p), whose rows may carry weights.

    scales : (p,) `Model.scales` [mm/unit];  tolerance : of `significant`
    held : (p,) columns that have a row of a prior, which is exact: they are not zero however short
    """
    p = jacobian.shape[-1]
    triangle = np.linalg.qr(jacobian.reshape(-1, p), mode="r")
    sizes = np.linalg.norm(triangle, axis=0)
    zero = column_lengths(sizes, scales)[1] & np.logical_not(held)
    lengths = np.where(zero, scales, sizes)
    _, singular_values, rows = np.linalg.svd(np.where(zero, 0.0, triangle / lengths), full_matrices=True)
    values = np.zeros(p)
    values[: singular_values.size] = singular_values
    return Spectrum(lengths, values, rows.T, p).truncated(tolerance)


def covariance(jacobian: Array, scales: Array, sigma: float = 1.0) -> Array:
    """(p, p) sigma^2 (sum J^T J)^-1 (eq. 16) on the estimable directions: see `Spectrum.covariance`."""
    return sigma**2 * spectrum(jacobian, scales).covariance


def full_rank(jacobians: Array, scales: Array) -> NDArray[np.bool_]:
    """(K,) True where every parameter is estimable: `spectrum(...).rank == p` of many Jacobians (K, m, d, p)."""
    normal, lengths = _unit_normal(jacobians)
    full = _clear(np.linalg.eigh(normal)[0], lengths, scales)
    for k in np.flatnonzero(~full):
        full[k] = spectrum(jacobians[k], scales).rank == len(scales)
    return full


def covariances(jacobians: Array, scales: Array, sigma: float = 1.0) -> Array:
    """(K, p, p) `covariance` of many Jacobians (K, m, d, p); not a number where not all is estimable."""
    normal, lengths = _unit_normal(jacobians)
    values, vectors = np.linalg.eigh(normal)
    clear = _clear(values, lengths, scales)
    vectors = vectors / lengths[:, :, None]
    inverse = (vectors / np.where(clear[:, None], values, np.nan)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    for k in np.flatnonzero(~clear):
        one = spectrum(jacobians[k], scales)
        inverse[k] = one.covariance if one.rank == len(scales) else np.nan
    return sigma**2 * inverse


def _unit_normal(jacobians: Array) -> tuple[Array, Array]:
    """(K, p, p) E^T E of the columns scaled to unit length, and (K, p) their lengths, no less than a tiny number."""
    count, m, d, p = jacobians.shape
    rows = jacobians.reshape(count, m * d, p)
    lengths = np.maximum(np.sqrt(np.einsum("kip,kip->kp", rows, rows)), np.finfo(float).tiny)
    rows = rows / lengths[:, None, :]
    return np.swapaxes(rows, 1, 2) @ rows, lengths


def _clear(values: Array, lengths: Array, scales: Array) -> NDArray[np.bool_]:
    """(K,) True where full rank is clear by far; a normal matrix holds half the digits, the rest needs singular values.

    values : (K, p) eigenvalues, smallest first
    """
    sizes = lengths / scales
    return (values[:, 0] > CLEAR) & (np.min(sizes, axis=1) > np.sqrt(CLEAR) * np.max(sizes, axis=1))


@dataclass(frozen=True)
class Identifiability:
    """Which of p parameters a plan makes estimable.

    rank : number of estimable combinations
    identifiable : (p,) True where the parameter itself is estimable
    null_space : (p, p - rank) sparse basis of what is not estimable, in `scales` * parameters [mm], largest entry 1
    combinations : the basis in words, see `describe`
    """

    rank: int
    identifiable: NDArray[np.bool_]
    null_space: Array
    combinations: tuple[str, ...]


def identifiability(jacobian: Array, names: Sequence[str], scales: Array) -> Identifiability:
    """Rank of a Jacobian (m, d, p), and the combinations of parameters that it cannot distinguish."""
    return identifiability_of(spectrum(jacobian, scales), names, scales)


def identifiability_of(decomposed: Spectrum, names: Sequence[str], scales: Array) -> Identifiability:
    """`identifiability` of a Jacobian that is decomposed already."""
    identifiable = np.linalg.norm(decomposed.null_space, axis=1) <= TOUCHED
    identifiable.setflags(write=False)
    basis = sparse_basis(decomposed.null_space) / decomposed.lengths[:, None] * scales[:, None]
    basis /= np.max(np.abs(basis), axis=0, initial=np.finfo(float).tiny)
    return Identifiability(decomposed.rank, identifiable, readonly(basis), tuple(describe(v, names) for v in basis.T))


def describe(direction: Array, names: Sequence[str]) -> str:
    """A direction of the null space in words: `joint_offset:1 + base_rotation.angle`.

    The last parameter named acts exactly as the sum of the others does (its Jacobian column is that combination of
    theirs, each in mm at the tip), so only what they make together is estimable. Coefficients near 1 are left out.
    """
    shown = np.flatnonzero(np.abs(direction) > SHOWN * np.max(np.abs(direction)))
    coefficients = direction[shown] / np.max(np.abs(direction))
    coefficients[-1] *= -1.0 if shown.size > 1 else 1.0
    coefficients *= np.sign(coefficients[0])
    words = ""
    for coefficient, k in zip(coefficients, shown.tolist(), strict=True):
        size = abs(coefficient)
        factor = "" if abs(size - 1.0) <= SHOWN else f"{size:.2g} "
        words += (" + " if coefficient > 0.0 else " - ") + factor + names[k]
    return words[3:]


def sparse_basis(orthonormal: Array) -> Array:
    """(p, k) sparse vectors that span the columns of an orthonormal (p, k).

    For every parameter the vector of least sum |v| with a one there (a linear program, whose vertices are sparse);
    then the sparsest independent ones. The reduced echelon form completes them where they do not span.
    """
    p, k = orthonormal.shape
    if k == 0:
        return np.zeros((p, 0))
    from scipy.linalg import qr  # deferred: only rank-deficient plans pay for the import

    _, _, pivots = qr(orthonormal.T, pivoting=True, mode="economic")
    echelon = orthonormal @ np.linalg.inv(orthonormal[pivots[:k]])
    touched = np.flatnonzero(np.linalg.norm(orthonormal, axis=1) > TOUCHED)
    candidates = [_sparsest(orthonormal, i) for i in touched.tolist()] + list(echelon.T)
    chosen = _independent([v / np.max(np.abs(v)) for v in candidates if v is not None], k)
    return np.array(sorted(chosen, key=lambda v: tuple(np.flatnonzero(np.abs(v) > TOUCHED)))).T


def _sparsest(orthonormal: Array, one: int) -> Array | None:
    """The vector v of least sum |v| in the span with v[one] = 1: variables are coefficients z and bounds t >= |N z|."""
    from scipy.optimize import linprog

    p, k = orthonormal.shape
    above = np.block([[orthonormal, -np.eye(p)], [-orthonormal, -np.eye(p)]])
    result = linprog(
        np.r_[np.zeros(k), np.ones(p)],
        A_ub=above,
        b_ub=np.zeros(2 * p),
        A_eq=np.r_[orthonormal[one], np.zeros(p)][None],
        b_eq=[1.0],
        bounds=[(None, None)] * k + [(0.0, None)] * p,
        method="highs-ds",
    )
    return orthonormal @ result.x[:k] if result.status == 0 else None


def _independent(vectors: list[Array], k: int) -> list[Array]:
    """The first k independent vectors, fewest parameters first (greedy: the independent sets are a matroid)."""
    ordered = sorted(vectors, key=lambda v: (int(np.sum(np.abs(v) > TOUCHED)), float(np.sum(np.abs(v)))))
    chosen: list[Array] = []
    for vector in ordered:
        clean = np.where(np.abs(vector) > 1e-9, vector, 0.0)
        trial = np.array([v / np.linalg.norm(v) for v in (*chosen, clean)])
        if np.linalg.svd(trial, compute_uv=False)[-1] > 1e-6:
            chosen.append(clean)
        if len(chosen) == k:
            break
    return chosen
