"""Gauss-Newton for many data sets on one plan that share one inverse normal matrix: the chord method.

Steps N^-1 J(p)^T W r with N^-1 taken at one point for all data sets, where J(p)^T W r comes exactly from CasADi's
reverse mode at the price of a few position evaluations: no Jacobian, no decomposition per data set, several times as
many fits per second as `levenberg_marquardt` gives (tests/benchmarks/test_identification_speed.py). The shared matrix
only sets the speed: what is accepted is stationary for its own data set. What does not contract quickly, or meets a
physical bound, is left to `levenberg_marquardt`.
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
    """The inverse normal matrix of a problem at one point, and exact gradients anywhere."""

    def __init__(self, problem: Problem, center: Array) -> None:
        rows = problem.prior_rows
        jacobian = np.concatenate([problem.jacobian(center), rows])
        self._known = rows.T @ rows
        self._lengths = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / self._lengths
        self._inverse = np.linalg.inv(information_matrix(scaled[:, None, :])) / self._lengths  # for scaled gradients
        model = problem.model
        self._table = model.condition_table(problem.postures, problem.conditions)
        self._compiled = model.expressions.residual_gradient

    def gradient(self, problem: Problem, measured: Array, parameters: Array) -> tuple[Array, Array]:
        """(k, p) J^T W r / column lengths, and (k,) weighted sums of squares, for components-first (d, k, m) data; both
        with the rows of the prior."""
        arguments = problem.postures, self._table, parameters[:, None, :], np.moveaxis(measured, 0, -1)
        gradient, squares = self._compiled(*arguments)
        # components come first in memory, so these sums over rows are products with contiguous memory
        sums = np.moveaxis(gradient[..., 0], -1, 0) @ problem.weights
        prior = parameters @ self._known
        cost = squares[..., 0, 0] @ problem.weights + np.einsum("kp,kp->k", prior, parameters)
        return (sums.T - prior) / self._lengths, cost

    def solve(self, problem: Problem, starts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Parameters (k, p), weighted sums of squares (k,) and stationary (k,); for data sets
        passed on to Levenberg-Marquardt, the starting values."""
        lower, upper = problem.bounds
        parameters, squares, stationary = starts.copy(), np.full(len(starts), np.nan), np.zeros(len(starts), dtype=bool)
        index, x, last = np.arange(len(starts)), starts, np.full(len(starts), np.inf)
        data, rounding = np.ascontiguousarray(np.moveaxis(problem.positions, -1, 0)), problem.rounding
        for _ in range(STEPS):
            gradient, cost = self.gradient(problem, data, x)
            size = np.max(np.abs(gradient), axis=1)
            inside = np.all((x >= lower) & (x <= upper), axis=1)
            done = (size <= GRADIENT_TOLERANCE * np.sqrt(cost) + rounding) & inside
            finished = index[done]
            parameters[finished], squares[finished], stationary[finished] = x[done], cost[done], True
            going = ~done & (size <= CONTRACTION * last)
            if not going.any():
                break
            x = x[going] + gradient[going] @ self._inverse
            index, last, rounding = index[going], size[going], rounding[going]
            data = data if going.all() else np.ascontiguousarray(data[:, going])
        return parameters, squares, stationary
