"""Gauss-Newton steps for many data sets on one plan by inverse normal matrices that are made once: the chord method.

Steps N^-1 J(p)^T W r with N^-1 taken at one point, for all data sets together or for each, where J(p)^T W r comes
exactly from CasADi's reverse mode at the price of a few position evaluations: no Jacobian, no decomposition per step,
several times as many fits per second as `levenberg_marquardt` gives (tests/benchmarks/test_identification_speed.py).
The matrix only sets the speed: what is accepted is stationary for its own data set. What does not contract quickly, or
meets a physical bound, is left to others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import GRADIENT_TOLERANCE
from identification.estimation.problem import Problem
from identification.information import information_matrix

STEPS = 12
CONTRACTION = 0.3  # a step that shrinks the gradient by less hands the data set over


class Chord:
    """Inverse normal matrices of a problem, and exact gradients anywhere."""

    def __init__(self, problem: Problem, jacobians: Array) -> None:
        """jacobians : (k, N, p) of each data set with the rows of the prior; (1, N, p): for all"""
        self._known = problem.prior_rows.T @ problem.prior_rows
        self._lengths = np.linalg.norm(jacobians, axis=1)
        scaled = jacobians / self._lengths[:, None]
        # for scaled gradients
        self._inverse = np.linalg.inv(information_matrix(scaled[:, :, None])) / self._lengths[:, None]
        self._table = problem.model.condition_table(problem.postures, problem.conditions)

    def gradient(self, problem: Problem, measured: Array, parameters: Array) -> tuple[Array, Array]:
        """(k, p) J^T W r, and (k,) weighted sums of squares, for components-first (d, k, m) data; both with the rows of
        the prior."""
        arguments = problem.postures, self._table, parameters[:, None, :], np.moveaxis(measured, 0, -1)
        gradient, squares = problem.model.expressions.residual_gradient(*arguments)
        # components come first in memory, so these sums over rows are products with contiguous memory
        sums = np.moveaxis(gradient[..., 0], -1, 0) @ problem.weights
        prior = parameters @ self._known
        cost = squares[..., 0, 0] @ problem.weights + np.einsum("kp,kp->k", prior, parameters)
        return sums.T - prior, cost

    def solve(self, problem: Problem, starts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Parameters (k, p), weighted sums of squares (k,) and stationary (k,); of data sets that are left to others
        the last parameters inside the bounds to which steps led quickly."""
        lower, upper = problem.bounds
        parameters, squares, stationary = starts.copy(), np.full(len(starts), np.nan), np.zeros(len(starts), dtype=bool)
        index, x, last = np.arange(len(starts)), starts, np.full(len(starts), np.inf)
        data, rounding = np.ascontiguousarray(np.moveaxis(problem.positions, -1, 0)), problem.rounding
        lengths, inverse = self._lengths, self._inverse
        for _ in range(STEPS):
            gradient, cost = self.gradient(problem, data, x)
            gradient /= lengths
            size = np.max(np.abs(gradient), axis=1)
            inside = np.all((x >= lower) & (x <= upper), axis=1)
            done = (size <= GRADIENT_TOLERANCE * np.sqrt(cost) + rounding) & inside
            finished = index[done]
            squares[finished], stationary[finished] = cost[done], True
            contracts = size <= CONTRACTION * last
            parameters[index[(contracts | done) & inside]] = x[(contracts | done) & inside]
            going = ~done & contracts
            if not going.any():
                break
            index, last, rounding = index[going], size[going], rounding[going]
            data = data if going.all() else np.ascontiguousarray(data[:, going])
            if len(inverse) == 1:
                x = x[going] + gradient[going] @ inverse[0]
                continue
            lengths, inverse = lengths[going], inverse[going]
            x = x[going] + (gradient[going][:, None] @ inverse)[:, 0]
        return parameters, squares, stationary
