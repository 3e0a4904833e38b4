"""The closed form (identification/README.md, "Closed form"): the paper says there is none, but eq. 1 is linear in u_j.

With u_j = (l_j + dl_j) exp(i dtheta_j) the tip is sum_j exp(i theta_j) u_j (+ x0 + i y0): a complex linear
least-squares problem. Its solution is the exact global minimiser of eq. 3, then dl_j = |u_j| - l_j and
dtheta_j = arg u_j. Of combinations that the postures do not determine, the nominal arm's values stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.kinematics.parameters import JOINT_OFFSET, LENGTH_ERROR, ParameterSet

Complex = NDArray[np.complex128]
Solver = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class PlanarClosedForm:
    """Length errors, joint offsets and, if `offset`, the base's offset of a planar chain.

    lengths : (n,) nominal [mm]
    indices : (q,) where the q parameters stand among those of the model
    exact : the model has no other parameters, so that the closed form is its least-squares solution; else a start
    """

    lengths: Array
    offset: bool
    indices: NDArray[np.intp]
    exact: bool

    @classmethod
    def of(cls, lengths: Array, parameters: ParameterSet, others: bool) -> PlanarClosedForm | None:
        """For the parameters of a model, None where one of a length or an offset is missing.

        others : the model has parameters or curves beside these
        """
        chain = [*parameters.indices(LENGTH_ERROR), *parameters.indices(JOINT_OFFSET)]
        base = [k for k, name in enumerate(parameters.names) if name in ("base_offset.x0", "base_offset.y0")]
        if len(chain) < 2 * len(lengths):
            return None
        offset = len(base) == 2
        indices = np.array(chain + base if offset else chain)
        return cls(lengths, offset, indices, not others and len(indices) == len(parameters))

    def solver(self, postures: Array, weights: Array, tolerance: float) -> Solver:
        """Function of positions (K, m, 2) [mm] -> (K, q) parameters and (K,) weighted sums of squares.

        postures : (m, n) [rad] for all data sets, or (K, m, n) for each its own;  weights : (m,) of the rows
        tolerance : singular values below this share of the largest are zero; the columns have equal lengths
        """
        columns, root = np.exp(1j * np.cumsum(postures, axis=-1)), np.sqrt(weights)  # exp(i theta_j)
        nominal = np.r_[self.lengths, np.zeros(int(self.offset))].astype(complex)  # l_j, and 0 for the base
        if self.offset:
            columns = np.concatenate([columns, np.ones((*columns.shape[:-1], 1))], axis=-1)
        back = _pseudo_inverse(root[:, None] * columns, tolerance) * root
        back, forth = (np.ascontiguousarray(np.swapaxes(a, -1, -2)) for a in (back, columns))

        def solve(positions: Array) -> tuple[Array, Array]:
            # x + iy, without a copy where memory allows
            measured = np.ascontiguousarray(positions, dtype=float).view(np.complex128)[..., 0]
            # differences to the nominal arm: the sum of squares then loses no digits
            rest = measured - columns @ nominal
            change = _times(rest, back)
            residuals = (rest - _times(change, forth)) * root
            squares = residuals.view(np.float64)
            return self._parameters(nominal + change), np.einsum("ki,ki->k", squares, squares)

        return solve

    def _parameters(self, unknowns: Complex) -> Array:
        """(..., q) parameters dl_j, dq_j and base offset of the unknowns (..., u); dq_j in (-pi, pi]."""
        n = len(self.lengths)
        u = unknowns[..., :n]
        # dq_j = arg u_j - arg u_(j-1) as one argument, so that it needs no wrapping
        turned = u.copy()
        turned[..., 1:] *= np.conj(u[..., :-1])
        parts = [np.abs(u) - self.lengths, np.angle(turned)]
        if self.offset:
            parts += [unknowns[..., n:].real, unknowns[..., n:].imag]
        return np.concatenate(parts, axis=-1)


def _times(rows: Complex, matrix: Complex) -> Complex:
    """(K, b) rows (K, a) times one matrix (a, b), or each times its own (K, a, b)."""
    return rows @ matrix if matrix.ndim == 2 else (rows[:, None, :] @ matrix)[:, 0, :]


def _pseudo_inverse(columns: Complex, tolerance: float) -> Complex:
    """(..., u, m) of columns (m, u) or (K, m, u).

    Of many, by the inverse of the normal matrix, which squares the condition, where that costs no digits that matter.
    """
    if columns.ndim == 2:
        return np.asarray(np.linalg.pinv(columns, rcond=tolerance))
    across = np.swapaxes(columns.conj(), -1, -2)
    normal = across @ columns
    inverse = np.asarray(
        np.linalg.inv(normal + np.finfo(float).eps * normal[:, :1, :1].real * np.eye(normal.shape[-1])), dtype=complex
    )
    pseudo_inverses = inverse @ across
    condition = np.linalg.norm(normal, 1, axis=(-2, -1)) * np.linalg.norm(inverse, 1, axis=(-2, -1))
    # from a condition (1-norm) of 1e6 on the inverse is not used
    ill = np.flatnonzero(~(condition < min(1e6, tolerance**-2)))
    pseudo_inverses[ill] = np.linalg.pinv(columns[ill], rcond=tolerance)
    return pseudo_inverses
