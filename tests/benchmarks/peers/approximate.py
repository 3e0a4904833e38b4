"""Weights on candidates by armcal and by what people use instead, on a grid of joints 2 to n: joint 1 cancels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.benchmarks.peers.geometry import ARMS, Planar
from tests.benchmarks.peers.tool import Answer, Tool

TARGET = 1e-4  # gap at which the multiplicative algorithm stops
EVERY = 50  # of its steps between two looks at the gap


def grid(arm: Planar, levels: int) -> np.ndarray:
    """(levels^(n - 1), n) postures from limit to limit, joint 1 at zero."""
    axes = [np.linspace(low, high, levels) for low, high in zip(arm.lower[1:], arm.upper[1:], strict=True)]
    found = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    return np.hstack([np.zeros((len(found), 1)), found])


def armcal(arm: Planar, levels: int) -> np.ndarray:
    """`relax` on the same grid."""
    from doe import DesignProblem
    from doe.bounds.column_generation import relax
    from identification import Arm, Model

    q = grid(arm, levels)
    plan = relax(DesignProblem.of(Model(Arm(arm.lengths, arm.lower, arm.upper))), q).plan
    return placed_weights(q, plan.postures, plan.weights)


def placed_weights(q: np.ndarray, support: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N,) weights of all candidates from those of the few that have one."""
    from scipy.spatial import cKDTree

    found = np.zeros(len(q))
    np.add.at(found, cKDTree(q).query(support)[1], weights)
    return found


def cvxpy(solver: str) -> Callable[[Planar, int], np.ndarray]:
    """One program: log det of the weighted sum, vectorized; the textbook's V diag(w) V' takes gigabytes."""

    def solve(arm: Planar, levels: int) -> np.ndarray:
        import cvxpy as cp

        rows, p = arm.rows(grid(arm, levels)), arm.parameters
        flat = np.einsum("mdp,mdq->mpq", rows, rows).reshape(len(rows), p * p)
        weights = cp.Variable(len(rows), nonneg=True)
        information = cp.reshape(flat.T @ weights, (p, p), order="C")
        problem = cp.Problem(cp.Maximize(cp.log_det((information + information.T) / 2.0)), [cp.sum(weights) == 1.0])
        problem.solve(solver=solver)
        return np.maximum(weights.value, 0.0)

    return solve


def multiplicative(arm: Planar, levels: int) -> np.ndarray:
    """w <- w d / p, until the gap is small."""
    rows, p = arm.rows(grid(arm, levels)), arm.parameters
    flat, d = rows.reshape(-1, p), rows.shape[1]
    weights, gap = np.full(len(rows), 1.0 / len(rows)), np.inf
    while gap > TARGET:
        for _ in range(EVERY):
            inverse = np.linalg.inv(flat.T @ (flat * np.repeat(weights, d)[:, None]))
            sensitivity = np.einsum("ij,ij->i", flat @ inverse, flat).reshape(-1, d).sum(axis=1)
            weights *= sensitivity / p
        gap = float(sensitivity.max()) - p
    return weights / weights.sum()


def job(solve: Callable[[Planar, int], np.ndarray], *modules: str) -> Tool:
    """A tool of this file."""

    def run(arm_name: str, levels: int) -> Answer:
        return {"weights": solve(ARMS[arm_name], levels)}

    return Tool(run, modules)


TOOLS = {
    "armcal": job(armcal, "doe.bounds.column_generation", "scipy.spatial"),
    "cvxpy + Clarabel": job(cvxpy("CLARABEL"), "cvxpy", "clarabel"),
    "cvxpy + SCS": job(cvxpy("SCS"), "cvxpy", "scs"),
    "multiplicative, numpy": job(multiplicative),
}
