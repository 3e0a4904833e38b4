"""The relaxation as one convex program in cvxpy, with Clarabel or SCS: independent of column generation.

    maximise Phi(M),  M = sum_i w_i F_i,  w >= 0, sum w = 1

The textbook's V diag(w) V^T takes 1.2 GB at a thousand candidates. Here M is a variable, tied to the weights by as many
equations as the F_i have dimensions (13 for four links), after a change of coordinates in which the average posture has
the unit matrix.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any

import numpy as np

from doe.bounds.weights import proper_weights
from doe.criteria import Criterion, E
from doe.criteria.inverse_trace import InverseTrace
from doe.problem.problem import PriorInformation
from identification.arrays import Array
from identification.errors import InputError, JobError
from identification.information import log_determinants

# Clarabel fails on some of these programs with its own scaling of the rows and on others without it
SETTINGS: Mapping[str, Sequence[Mapping[str, Any]]] = MappingProxyType(
    {
        "clarabel": ({"equilibrate_enable": False}, {}),
        "scs": ({"eps": 1e-8, "max_iters": 20_000},),
    }
)


def solve_program(
    posture_information: Array, criterion: Criterion, solver: str
) -> tuple[Array | None, str, Array | None]:
    """The solver's weights (N,) for F_i (N, p, p), None if it returned none; its own name for its status; and for E
    (p, p) G >= 0 of unit trace from the dual: any such G bounds the smallest eigenvalue, lambda_min(N) <= tr(G N)."""
    import cvxpy as cp

    mean = posture_information.mean(axis=0)
    if np.isneginf(log_determinants(mean)):
        raise JobError(
            "relaxation: the candidates do not identify all parameters; drop an effect or allow more postures"
        )
    unroot = np.linalg.cholesky(mean)
    root = np.linalg.inv(unroot)
    n, p = posture_information.shape[:2]
    rows, columns = np.triu_indices(p)
    basis, coordinates = _coordinates((root @ posture_information @ root.T)[:, rows, columns])
    square = np.zeros((p, p, basis.shape[1]))
    square[rows, columns], square[columns, rows] = basis, basis
    weights, place = cp.Variable(n, nonneg=True), cp.Variable(basis.shape[1])
    matrix = cp.reshape(square.reshape(p * p, -1) @ place, (p, p), order="C")
    tied, floor = [place == coordinates.T @ weights, cp.sum(weights) == 1.0], None
    if criterion.name == "D":
        objective = cp.log_det(matrix)
    elif isinstance(criterion, InverseTrace):
        values, vectors = np.linalg.eigh(criterion.weight(p))
        objective = -cp.matrix_frac(root @ (vectors * np.sqrt(np.maximum(values, 0.0))), matrix)
    elif criterion.name == "E":
        objective = cp.Variable()
        floor = matrix - objective * (root @ root.T) >> 0
        tied.append(floor)
    else:
        reason = f"{criterion.name} has no program for this solver"
        raise InputError(f"criterion: {reason}, allowed: D, A, I, E; column_generation knows more")
    status = _run(cp.Problem(cp.Maximize(objective), tied), solver)
    if weights.value is None or not np.all(np.isfinite(weights.value)):
        return None, status, None
    if floor is None:
        return np.asarray(weights.value), status, None
    values, vectors = np.linalg.eigh(root.T @ (floor.dual_value + floor.dual_value.T) @ root)
    positive = np.maximum(values, 0.0)
    return np.asarray(weights.value), status, (vectors * (positive / positive.sum())) @ vectors.T


def _run(program: Any, solver: str) -> str:
    import cvxpy as cp

    for settings in SETTINGS[solver]:
        with warnings.catch_warnings(), suppress(cp.error.SolverError):
            warnings.simplefilter("ignore")  # what cvxpy warns of is the status, which is reported
            program.solve(solver=solver.upper(), **settings)
            return str(program.status)
    return "solver_error"


def _coordinates(rows: Array) -> tuple[Array, Array]:
    """Basis (t, r) of the span of the rows (N, t), and the rows' coordinates (N, r) in it."""
    if len(rows) < rows.shape[1]:  # by the smaller of the two normal matrices
        values, vectors = np.linalg.eigh(rows @ rows.T)
        seen = values > 1e-12 * values[-1]
        return rows.T @ (vectors[:, seen] / np.sqrt(values[seen])), vectors[:, seen] * np.sqrt(values[seen])
    values, vectors = np.linalg.eigh(rows.T @ rows)
    basis = vectors[:, values > 1e-12 * values[-1]]
    return basis, rows @ basis


def smallest_eigenvalue_weights(jacobians: Array, prior: PriorInformation) -> tuple[Array, Array]:
    """E-optimal weights for scaled Jacobians (k, d, p), and (p, p) G of the dual: the restricted master of a criterion
    without a gradient."""
    weights, status, gradient = solve_program(prior.posture_information(jacobians), E(), "clarabel")
    if weights is None or gradient is None:
        raise JobError(f"clarabel: status {status} on the restricted master of {len(jacobians)} postures")
    return proper_weights(weights), gradient
