"""Spatial arms in a study: which parameters are fitted, and their values equivalent to the simulated errors.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured point where all of the simulated errors together do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.problem.spatial import with_points, without_prior
from identification.arm import Arm
from identification.arrays import Array
from identification.errors import InputError
from identification.estimation import estimate_batch
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.model import Model

POSTURES = 100  # where both geometries are compared: three equations each for some forty parameters


def simulated(arm: Arm) -> Arm:
    """The arm with its measured point in place; a planar arm as it is. Raises `InputError` for several points and for
    measured orientations."""
    if (chain := arm.chain) is None:
        return arm
    if len(chain.tools) > 1:
        raise InputError(f"tool: arm {arm.name} has {len(chain.tools)} measured points, allowed of a study: one")
    if chain.angle_scale is not None:
        raise InputError(f"sigma_deg: arm {arm.name} measures orientations, allowed of a study: positions")
    return replace(arm, chain=with_points(chain))


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
        found = estimate_batch(drawn, postures, real.position(postures)[None])
        values |= drawn.parameters.mapping(found.parameters[0])
    return model.parameters.vector(values)


def in_file_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """Postures [rad, mm] in degrees, of prismatic joints in millimetres."""
    return np.where(np.array(joint_types) == REVOLUTE, np.degrees(postures), postures)


def in_api_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """The reverse of `in_file_units`."""
    return np.where(np.array(joint_types) == PRISMATIC, postures, np.radians(postures))
