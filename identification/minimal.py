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
from identification.kinematics.parameters import JOINT_OFFSET
from identification.kinematics.spatial import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.measurements import Conditions
from identification.model import Model

FIRST = (BASE, TOOL, JOINT_OFFSET, TRANSLATION_ERROR, ROTATION_ERROR)  # what is kept before what
POSTURES = 100  # at random: three equations each for some forty parameters
TOLD = 1e-6  # share of a column of unit length that those kept before do not explain; rounding is 1e-13 of it
SEED = 0


def minimal(model: Model) -> Model:
    """The model of a spatial arm with a minimal set of geometric parameters, free of any prior; the others are zero, or
    what a calibration says.

    Where the measured points lie decides how many there are: for points that are to be found, of `placed_model`.
    """
    parameters = model.parameters
    kinds = [kind for kind in FIRST if kind in parameters.kinds]
    order = [k for kind in kinds for k in parameters.indices(kind)]
    kept = set(independent(_jacobian(model)[:, order] * (1.0 / model.scales[order])))
    known = {parameters[k].name: float(model.values[k]) for place, k in enumerate(order) if place not in kept}
    return replace(model, known={**(model.known or {}), **known}, held=False)


def independent(columns: Array) -> list[int]:
    """Numbers of the columns (N, p) that those kept before them do not span (Gram and Schmidt, twice for rounding)."""
    basis = np.zeros((len(columns), 0))
    kept = []
    lengths = np.linalg.norm(columns, axis=0)
    for k in np.flatnonzero(lengths > TOLD * lengths.max(initial=0.0)).tolist():
        left = columns[:, k] / lengths[k]
        for _ in range(2):
            left = left - basis @ (basis.T @ left)
        if (size := float(np.linalg.norm(left))) > TOLD:
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
