"""A minimal set of a spatial arm's parameters: as many as measurements can tell apart, the others as drawn.

Every combination of the geometry's errors that moves the measured points is one of the parameters that are kept (the
continuous and complete set of the literature: L. J. Everett, M. Driels, B. W. Mooring, "Kinematic modelling for robot
calibration", ICRA 1987), 27 of a six-axis arm with one reflector off its last axis. Which of several equivalent ones
is kept is a choice: those that an engineer looks for first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.parameters import JOINT_OFFSET
from identification.kinematics.spatial import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.measurements import Conditions
from identification.model import Model

FIRST = (BASE, TOOL, JOINT_OFFSET, TRANSLATION_ERROR, ROTATION_ERROR)  # what is kept before what
POSTURES = 100  # at random: three equations each for some forty parameters
TOLD = 1e-6  # share of a column of unit length that those kept before do not explain; rounding is 1e-13 of it
WELL_TOLD = 1e-3  # the same where little told is not wanted: noise is a share of a thousandth of what errors do
SEED = 0


def minimal(model: Model, told: float = TOLD) -> Model:
    """The model of a spatial arm with a minimal set of geometric parameters, free of any prior; the others are zero, or
    what a calibration says.

    told : smallest share of a column that counts, see `TOLD`
    Where the measured points lie decides how many there are: for points that are to be found, of `placed_model`.
    """
    parameters = model.parameters
    kinds = [kind for kind in FIRST if kind in parameters.kinds]
    order = [k for kind in kinds for k in parameters.indices(kind)]
    kept = set(independent(_jacobian(model)[:, order] / model.scales[order], told))
    fixed = frozenset(parameters[k].name for place, k in enumerate(order) if place not in kept)
    chain = model.arm.chain
    if chain is None:
        raise InputError("minimal: a planar arm, allowed: a spatial one; the parameters of a planar arm are minimal")
    return replace(model, arm=replace(model.arm, chain=replace(chain, fixed=chain.fixed | fixed)))


def independent(columns: Array, told: float = TOLD) -> list[int]:
    """Numbers of the columns (N, p) that those kept before them do not span (Gram and Schmidt, twice for rounding)."""
    basis = np.zeros((len(columns), 0))
    kept = []
    lengths = np.linalg.norm(columns, axis=0)
    for k in np.flatnonzero(lengths > told * lengths.max(initial=0.0)).tolist():
        left = columns[:, k] / lengths[k]
        for _ in range(2):
            left = left - basis @ (basis.T @ left)
        if (size := float(np.linalg.norm(left))) > told:
            basis = np.column_stack([basis, left / size])
            kept.append(k)
    return kept


def _jacobian(model: Model) -> Array:
    """(N, p) at random postures inside the limits, of every measured point."""
    arm, generator = model.arm, np.random.default_rng(SEED)
    postures = generator.uniform(arm.lower, arm.upper, (POSTURES, arm.links))
    markers = 1 if arm.chain is None else len(arm.chain.tools)
    rows = [model.jacobian(postures, None, Conditions(marker=np.full(POSTURES, float(k)))) for k in range(markers)]
    return np.concatenate(rows).reshape(-1, len(model.parameters))
