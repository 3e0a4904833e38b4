"""Inverse kinematics of the model: joint positions that reach targets, within joint limits.

Levenberg-Marquardt on exact derivatives, all targets at once; steps are the shortest that close the gap, so a redundant
arm stays near where it started. `identification.compensate.seeds` has more starts where that leads nowhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import Index, LeastSquares, Linearize, levenberg_marquardt
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import Conditions
from identification.model import Model
from identification.workspace import PostureCondition

TOLERANCE = 1e-6  # [mm] a target is reached if the model comes this close; so near may a constraint be missed
MAX_ITERATIONS = 60

Constraints = Sequence[PostureCondition]


def violations(constraints: Constraints, postures: Array) -> Array:
    """(m, c) by how much postures (m, n) miss each of c constraints [mm]; 0: satisfied."""
    if not constraints or not len(postures):
        return np.zeros((len(postures), len(constraints)))
    missed = np.column_stack([-np.min(each.margin(postures), axis=1) for each in constraints])
    return np.where(missed > TOLERANCE, missed, 0.0)


def inverse_kinematics(
    model: Model, goals: Array, starts: Array, conditions: Conditions, iterations: int = MAX_ITERATIONS
) -> tuple[Array, Array]:
    """Postures (k, n) within the limits and errors (k,) [mm], by Levenberg-Marquardt from starts (k, n).

    Steps are the shortest in joint angles, so that a redundant arm stays near where it started.
    """
    linearize = linearization(model, conditions)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        position, jacobian = linearize(postures, rows)
        return goals[rows] - position, jacobian

    reach = metric(model)
    negligible = np.full(len(goals), 1e-5 * TOLERANCE)
    limits = model.arm.lower, model.arm.upper
    problem = LeastSquares(distances, *limits, reach, negligible, metric=reach, iterations=iterations)
    solution = levenberg_marquardt(problem, starts)
    return solution.parameters, np.sqrt(solution.squares)


def metric(model: Model) -> Array:
    """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
    return np.where(np.array(model.joint_types) == REVOLUTE, model.reach, 1.0)


def linearization(model: Model, conditions: Conditions) -> Linearize:
    """Postures (k, n) and row numbers -> positions (k, d) and derivatives with respect to the posture (k, d, n)."""
    evaluate = model.expressions.posture_jacobian

    def linearize(postures: Array, rows: Index) -> tuple[Array, Array]:
        table = model.condition_table(postures, conditions.rows(rows))
        tips, jacobian = evaluate(postures, table, np.broadcast_to(model.values, (len(postures), len(model.values))))
        return tips[..., 0], jacobian

    return linearize
