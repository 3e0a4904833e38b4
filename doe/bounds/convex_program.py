"""The relaxation as one convex program in cvxpy, with Clarabel or SCS.

    maximise Phi(M),  M = sum_i w_i F_i,  w >= 0, sum w = 1

The textbook's V diag(w) V^T takes 1.2 GB at a thousand candidates. Here M is a small expression, tied to the weights by
as many equations as the F_i have dimensions (13 for four links), after a change of coordinates in which the average
posture has the unit matrix.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from doe.bounds.weights import Weights, proper_weights
from doe.criteria import Criterion, E
from doe.problem.prior import PriorInformation
from identification.arrays import Array
from identification.errors import InputError, JobError
from identification.information import log_determinants


@dataclass(frozen=True)
class SolverAnswer:
    """A solver's weights (N,), None if it returned none; its own name for its status; (p, p) gradient from the dual."""

    weights: Array | None
    status: str
    gradient: Array | None = None


def solve_program(rows: Array, criterion: Criterion, solver: str) -> SolverAnswer:
    """The convex program for (N, p (p + 1) / 2) upper triangles of F_i."""
    import cvxpy as cp

    p = int((np.sqrt(8 * rows.shape[1] + 1) - 1) / 2)
    root = _whitening(rows, p)
    basis, coordinates = _coordinates(_transformed(rows, root, p))
    weights = cp.Variable(len(rows), nonneg=True)
    place = cp.Variable(basis.shape[1])
    matrix = cp.reshape(_square(basis.T, p).reshape(-1, p * p).T @ place, (p, p), order="C")
    objective, floor = _objective(criterion, matrix, np.asarray(np.linalg.inv(root)))
    tied = [place == coordinates.T @ weights, cp.sum(weights) == 1.0]
    program = cp.Problem(cp.Maximize(objective), tied if floor is None else [*tied, floor])
    status = _run(program, solver)
    if weights.value is None or not np.all(np.isfinite(weights.value)):
        return SolverAnswer(None, status)
    return SolverAnswer(np.asarray(weights.value), status, None if floor is None else _dual(floor.dual_value, root))


# Clarabel fails on some of these programs with its own scaling of the rows and on others without it
SETTINGS: Mapping[str, Sequence[Mapping[str, Any]]] = MappingProxyType(
    {
        "clarabel": ({"equilibrate_enable": False}, {}),
        "scs": ({"eps": 1e-8, "max_iters": 20_000},),
    }
)


def _run(program: Any, solver: str) -> str:
    import cvxpy as cp

    for settings in SETTINGS[solver]:
        with warnings.catch_warnings(), suppress(cp.error.SolverError):
            warnings.simplefilter("ignore")  # what cvxpy warns of is the status, which is reported
            program.solve(solver=solver.upper(), **settings)
            return str(program.status)
    return "solver_error"


def _objective(criterion: Criterion, matrix: Any, unroot: Array) -> tuple[Any, Any]:
    """Phi of M = U matrix U^T, U = `unroot`, as a cvxpy expression; for E with the constraint whose dual is needed."""
    import cvxpy as cp

    if criterion.name == "D":
        return cp.log_det(matrix), None
    if criterion.name in ("A", "I"):
        values, vectors = np.linalg.eigh(criterion.weight(len(unroot)))  # type: ignore[attr-defined]
        weight = np.linalg.solve(unroot, vectors * np.sqrt(np.maximum(values, 0.0)))
        return -cp.matrix_frac(weight, matrix), None
    if criterion.name == "E":
        smallest = cp.Variable()
        return smallest, matrix - smallest * np.linalg.inv(unroot.T @ unroot) >> 0
    raise InputError(
        f"criterion: {criterion.name} has no program for this solver, allowed: D, A, I, E; column_generation knows more"
    )


def _dual(multiplier: Array, root: Array) -> Array:
    """(p, p) G >= 0 of unit trace: any such G bounds the smallest eigenvalue, lambda_min(N) <= tr(G N)."""
    turned = root.T @ (0.5 * (multiplier + multiplier.T)) @ root
    values, vectors = np.linalg.eigh(turned)
    positive = np.maximum(values, 0.0)
    return (vectors * (positive / positive.sum())) @ vectors.T


def _whitening(rows: Array, p: int) -> Array:
    """(p, p) R with R mean(F) R^T = I. Raises JobError where the mean is singular."""
    mean = _square(rows.mean(axis=0), p)
    if np.isneginf(log_determinants(mean)):
        raise JobError(
            "relaxation: the candidates do not identify all parameters; drop an effect or allow more postures"
        )
    return np.linalg.inv(np.linalg.cholesky(mean))


def _square(rows: Array, p: int) -> Array:
    """(..., p, p) symmetric matrices of upper triangles."""
    upper = np.triu_indices(p)
    matrices = np.zeros((*rows.shape[:-1], p, p))
    matrices[..., upper[0], upper[1]] = rows
    matrices[..., upper[1], upper[0]] = rows
    return matrices


def _transformed(rows: Array, root: Array, p: int) -> Array:
    """Upper triangles of R F R^T: of many a linear map of the triangles, applied at once."""
    upper = np.triu_indices(p)
    if len(rows) < rows.shape[1]:
        return (root @ _square(rows, p) @ root.T)[:, upper[0], upper[1]]
    units = root @ _square(np.eye(rows.shape[1]), p) @ root.T
    return rows @ units[:, upper[0], upper[1]]


def _coordinates(rows: Array) -> tuple[Array, Array]:
    """Basis (t, r) of the span of the rows (N, t), and the rows' coordinates (N, r) in it."""
    if len(rows) < rows.shape[1]:  # by the smaller of the two normal matrices
        values, vectors = np.linalg.eigh(rows @ rows.T)
        seen = values > 1e-12 * values[-1]
        basis = rows.T @ (vectors[:, seen] / np.sqrt(values[seen]))
        return basis, vectors[:, seen] * np.sqrt(values[seen])
    values, vectors = np.linalg.eigh(rows.T @ rows)
    basis = vectors[:, values > 1e-12 * values[-1]]
    return basis, rows @ basis


def smallest_eigenvalue_weights(jacobians: Array, prior: PriorInformation) -> Weights:
    """E-optimal weights for scaled Jacobians (k, d, p): the restricted master of a criterion without a gradient."""
    upper = np.triu_indices(jacobians.shape[2])
    posture_information = prior.posture_information(jacobians)
    answer = solve_program(posture_information[:, upper[0], upper[1]], E(), "clarabel")
    if answer.weights is None or answer.gradient is None:
        raise JobError(f"clarabel: status {answer.status} on the restricted master of {len(jacobians)} postures")
    weights = proper_weights(answer.weights)
    g = prior.sensitivities(jacobians, answer.gradient)
    return Weights(weights, answer.gradient, float(g.max() - weights @ g), 0)
