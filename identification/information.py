"""What rows of a Jacobian make estimable, before any data exist (paper, eq. 16-19, corrected).

One rule decides every rank, here and elsewhere (`column_lengths` and `significant`): columns are scaled to unit length,
one whose length, counted in mm at the tip (`Model.scales`), is nothing beside the longest is zero, and values below a
share of the largest are zero. No choice of units can change whether a parameter is estimable. Only the share differs,
with what the values are of:

    RANK_TOLERANCE     singular values of a Jacobian or another table: what data determine. Models are exact to 1e-13 or
                       so, and what is a billion times less certain than the rest is of no use
    PRODUCT_TOLERANCE  eigenvalues of a product: normal matrix, covariance, correlations. They are the squares, but
                       rounded as the largest is: below this too few digits are left to divide by
    VISIBLE            what can be seen at all: squares that a column adds beside others, with less of which it looks
                       like the others whatever rounding says, and tables of slopes by differences or of splines
    rounding_share     either, where the question is whether a value is anything but rounding: what a prior holds, and
                       determinants, which do not divide
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

RANK_TOLERANCE = 1e-9  # of the largest singular value
PRODUCT_TOLERANCE = 1e-12  # of the largest eigenvalue: a rounding of 1e-15 of that leaves three digits
VISIBLE = 1e-6  # of the largest
ALONE = 1e-8  # of 1: rows with less than this left beside their leverage determine a combination by themselves
TOUCHED = 1e-3  # a parameter with less than this in every null direction is estimable


def column_lengths(sizes: Array, scales: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(..., p) what to divide the columns of a Jacobian by, and which of them are zero (those by their scale);  sizes :
    (..., p) Euclidean lengths of the columns;  scales : (p,) `Model.scales` [mm/unit]"""
    relative = sizes / scales
    longest = np.minimum(relative, sizes)  # a joint behind a short link moves the tip by far more than its scale
    zero = relative <= RANK_TOLERANCE * np.max(longest, axis=-1, keepdims=True, initial=np.finfo(float).tiny)
    return np.where(zero, scales, sizes), zero


def significant(values: Array, tolerance: float = RANK_TOLERANCE) -> NDArray[np.bool_]:
    """(..., r) which singular values or eigenvalues count: those above `tolerance` times the largest."""
    return values > tolerance * np.max(values, axis=-1, keepdims=True, initial=0.0)


def rounding_share(p: int) -> float:
    """The share of the largest below which values of p unit columns are nothing but rounding: of matrices that lack a
    rank they come to 3 to 7 rounding units for p up to 60."""
    return (8 + p) * float(np.finfo(float).eps)


def log_determinants(information: Array) -> Array:
    """(...) log det of information matrices (..., p, p) of scaled parameters; -inf: singular by the rule of ranks. The
    determinant of a matrix of trace p is at most e times its smallest eigenvalue, and spares most these."""
    p = information.shape[-1]
    lengths = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0.0))
    usable = np.array(np.all(np.isfinite(information), axis=(-2, -1)))
    usable &= np.all(significant(np.where(usable[..., None], lengths, 1.0)), axis=-1)
    lengths = np.where(usable[..., None], lengths, 1.0)
    unit = np.where(usable[..., None, None], information / lengths[..., :, None] / lengths[..., None, :], np.eye(p))
    signs, logs = np.linalg.slogdet(unit)
    usable &= signs > 0
    close = usable & (logs <= 1.0 + np.log(p * rounding_share(p)))
    if np.any(close):
        usable[close] = np.all(significant(np.linalg.eigvalsh(unit[close]), rounding_share(p)), axis=-1)
    return np.where(usable, logs + 2.0 * np.sum(np.log(lengths), axis=-1), -np.inf)


def product_inverse(product: Array) -> Array:
    """(p, p) pseudo-inverse of a product: of a normal matrix or a covariance, whatever its units."""
    sizes = np.sqrt(np.maximum(np.diagonal(product), 0.0))
    lengths = np.where(sizes > 0.0, sizes, 1.0)
    inverse = np.linalg.pinv(product / lengths / lengths[:, None], rcond=PRODUCT_TOLERANCE, hermitian=True)
    return np.asarray(inverse / lengths / lengths[:, None])


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

    # (p, p - rank) orthonormal basis of the combinations that the data leave undetermined
    null_space = property(lambda self: self.directions[:, self.rank :])

    @property
    def covariance(self) -> Array:
        """(p, p) (J^T J)^-1 on the estimable directions, zero on the others: pseudo-inverse in scaled parameters."""
        return self.root @ self.root.T

    @property
    def root(self) -> Array:
        """(p, rank) whose product with its transpose is the covariance; J @ root has orthonormal columns."""
        return self.directions[:, : self.rank] / self.values[: self.rank] / self.lengths[:, None]

    @property
    def identifiable(self) -> NDArray[np.bool_]:
        """(p,) True where the parameter itself is estimable."""
        return np.asarray(np.linalg.norm(self.null_space, axis=1) <= TOUCHED)

    def combinations(self, names: Sequence[str], scales: Array) -> tuple[str, ...]:
        """What of the parameters of these names cannot be distinguished, in words (`describe`), as a sparse basis of
        the null space;  scales : (p,) `Model.scales` [mm/unit]"""
        basis = sparse_basis(self.null_space) / self.lengths[:, None] * scales[:, None]
        return tuple(describe(direction, names) for direction in basis.T)

    def determined(self, jacobian: Array) -> float:
        """How many of p parameters the data determine, a prior the rest: tr J (J^T J + R^T R)^-1 J^T, with rows J
        (N, p) of the data alone; the prior's R are in this decomposition, too."""
        return float(np.sum(np.square(jacobian @ self.root)))


def spectrum(jacobian: Array, scales: Array, tolerance: float = RANK_TOLERANCE, prior: Array | None = None) -> Spectrum:
    """Decomposes a Jacobian (m, d, p) or (rows, p), whose rows may carry weights.

    scales : (p,) `Model.scales` [mm/unit];  tolerance : of `significant`
    prior : (r, p) rows of a prior, in the units of the others. What it holds is determined, however short its column
        and however much more exact the rows of the data are: what counts as zero is a tenth of the least that it holds,
        as long as that is no rounding
    """
    p = jacobian.shape[-1]
    rows = jacobian.reshape(-1, p)
    triangle = np.linalg.qr(rows if prior is None else np.concatenate([rows, prior]), mode="r")
    sizes = np.linalg.norm(triangle, axis=0)
    held = np.zeros(p, dtype=bool) if prior is None else np.any(prior != 0.0, axis=0)
    zero = column_lengths(sizes, scales)[1] & ~held
    lengths = np.where(zero, scales, sizes)
    _, singular_values, turned = np.linalg.svd(np.where(zero, 0.0, triangle / lengths), full_matrices=True)
    values = np.zeros(p)
    values[: singular_values.size] = singular_values
    if np.any(held):
        strengths = np.asarray(np.linalg.svd(prior / lengths, compute_uv=False), dtype=float)
        least = np.min(strengths, initial=np.inf, where=significant(strengths, rounding_share(p)))
        tolerance = float(np.clip(0.1 * least / values[0], rounding_share(p), tolerance))
    return Spectrum(lengths, values, turned.T, int(np.count_nonzero(significant(values, tolerance))))


def describe(direction: Array, names: Sequence[str]) -> str:
    """A direction of the null space in words: `joint_offset:1 + base_rotation.angle`.

    The last parameter named acts exactly as the sum of the others does (its Jacobian column is that combination of
    theirs, each in mm at the tip), so only what they make together is estimable. Coefficients of 1 within 2 % are
    left out, and parameters with less than 2 % of the largest.
    """
    shown = np.flatnonzero(np.abs(direction) > 0.02 * np.max(np.abs(direction)))
    coefficients = direction[shown] / np.max(np.abs(direction))
    coefficients[-1] *= -1.0 if shown.size > 1 else 1.0
    coefficients *= np.sign(coefficients[0])
    words = ""
    for coefficient, size, k in zip(coefficients, np.abs(coefficients), shown.tolist(), strict=True):
        factor = "" if abs(size - 1.0) <= 0.02 else f"{size:.2g} "
        words += (" + " if coefficient > 0.0 else " - ") + factor + names[k]
    return words[3:]


def conditional_covariance(covariance: Array, kept: NDArray[np.int64], conditioned: NDArray[np.int64]) -> Array:
    """Covariance of the parameters `kept` once those `conditioned` have their values.

    Combinations of these that hardly vary are not conditioned on: what is there of them is rounding, which their
    inverse would amplify. Of a square root R R^T it is what rows have off the others, and so positive semidefinite, as
    an arm file's covariance is.
    """
    every = np.concatenate([kept, conditioned])
    sizes = np.sqrt(np.diag(covariance)[every].clip(min=0.0))
    scale = np.where(sizes > 0.0, sizes, np.inf)
    values, vectors = np.linalg.eigh(covariance[np.ix_(every, every)] / np.outer(scale, scale))
    root, others = np.split(vectors * np.sqrt(values.clip(min=0.0)), [len(kept)])
    values, vectors = np.linalg.eigh(others @ others.T)
    fixed = (vectors[:, values > VISIBLE] / np.sqrt(values[values > VISIBLE])).T @ others
    root = sizes[: len(kept), None] * (root - root @ fixed.T @ fixed)
    return np.asarray(root @ root.T)


def sparse_basis(orthonormal: Array) -> Array:
    """(p, k) vectors that span the columns of an orthonormal (p, k), each with a one where the others have none: the
    reduced echelon form about the rows that are farthest from each other."""
    if not (k := orthonormal.shape[1]):
        return orthonormal
    from scipy.linalg import qr  # deferred: only rank-deficient plans pay for the import

    basis = orthonormal @ np.linalg.inv(orthonormal[np.sort(qr(orthonormal.T, pivoting=True, mode="economic")[2][:k])])
    basis = basis / np.max(np.abs(basis), axis=0, initial=np.finfo(float).tiny)
    basis[np.abs(basis) <= RANK_TOLERANCE] = 0.0
    return np.asarray(basis[:, sorted(range(k), key=lambda j: tuple(np.flatnonzero(np.abs(basis[:, j]) > TOUCHED)))])
