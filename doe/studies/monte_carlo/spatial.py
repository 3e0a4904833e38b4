"""Spatial arms in a study: which parameters are fitted, and their values equivalent to the simulated errors.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.problem.spatial import with_points, without_prior
from identification.arm import Arm
from identification.arrays import Array
from identification.estimation import estimate_batch
from identification.estimation.batch import sessions
from identification.kinematics.counting import in_columns, in_joints
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.measurements import Conditions, Measurements
from identification.model import Model

POSTURES = 100  # where both geometries are compared: three equations each for some forty parameters


def simulated(arm: Arm) -> Arm:
    """The arm with its measured points in place; a planar arm as it is."""
    return arm if arm.chain is None else replace(arm, chain=with_points(arm.chain))


def points(model: Model) -> int:
    """Number of measured points, each a row at every posture."""
    return 1 if model.arm.chain is None else len(model.arm.chain.tools)


def rows_of(truth: Model, postures: Array, remembers: bool = False) -> tuple[Array, Conditions]:
    """(..., m P, n) a posture for each row of plans (..., m, n), and conditions of the rows in their order, with the
    orientations of the true arm.

    remembers : with the past of the joints
    """
    count = points(truth)
    rows = np.repeat(postures, count, axis=-2)
    conditions = sessions(rows, remembers or truth.remembers)
    if count > 1:
        conditions = replace(conditions, marker=np.broadcast_to(np.arange(rows.shape[-2]) % count, rows.shape[:-1]))
    if truth.arm.chain is None or truth.arm.chain.angle_scale is None:
        return rows, conditions
    return rows, replace(conditions, orientation=truth.orientations(rows, conditions))


def plan_of(truth: Model, postures: Array) -> Measurements:
    """A plan (m, n) as measurements without positions: rows of `rows_of`."""
    rows, conditions = rows_of(truth, postures)
    chain, named = truth.arm.chain, {}
    if chain is not None and conditions.marker is not None:
        names = tuple(chain.tools)
        named = {"marker": np.array(names)[conditions.marker], "marker_names": names}
    zeros = np.zeros((len(rows), truth.dimension))
    return Measurements(rows, zeros, orientations=conditions.orientation, **named)


def fitted_model(arm: Arm) -> Model:
    """The model of an arm as it is fitted: of a spatial one with a minimal set of parameters."""
    return Model(without_prior(arm))


def true_values(model: Model, truth: Model) -> Array:
    """(p,) values of the fitted parameters that are true: those of the truth, zero for those that it does not have;
    of a spatial arm's geometry those that mean the same."""
    values = model.parameters.mapping(model.parameters.vector(truth.best_known))
    if model.arm.chain is not None:
        drawn, real = (Model(replace(each.arm, effects=())) for each in (model, truth))
        postures = np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (POSTURES, model.joints))
        plan = plan_of(real, postures)
        found = estimate_batch(drawn, plan, real.position(plan.postures, conditions=plan.conditions)[None])
        values |= drawn.parameters.mapping(found.parameters[0])
    return model.parameters.vector(values)


def in_file_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """Postures [rad, mm] as files have them, in degrees, of prismatic joints in millimetres."""
    columns = in_columns(postures, joint_types)
    return np.where(np.array(joint_types) == REVOLUTE, np.degrees(columns), columns)


def in_api_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """The reverse of `in_file_units`."""
    return in_joints(np.where(np.array(joint_types) == PRISMATIC, postures, np.radians(postures)), joint_types)
