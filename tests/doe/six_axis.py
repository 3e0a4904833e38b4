"""A UR10-like arm to design for, and the information of its plans from products of exponentials in plain numpy."""

from dataclasses import replace
from typing import Any

import numpy as np

from doe import DesignProblem
from identification import Arm, Array, DHRow, Model, chain_of
from tests.identification.kinematics.test_spatial import tip_by_exponentials

# a [mm], alpha [deg], d [mm]: the maker's table
TABLE = (
    *((0.0, 90.0, 127.3), (-612.0, 0.0, 0.0), (-572.3, 0.0, 0.0)),
    *((0.0, 90.0, 163.941), (0.0, -90.0, 115.7), (0.0, 0.0, 92.2)),
)
REFLECTOR = np.array([60.0, 40.0, 100.0])  # off the last axis
CHAIN = replace(chain_of([DHRow(a, np.radians(alpha), d) for a, alpha, d in TABLE]), tools={"1": REFLECTOR})
SIX_AXIS = Arm(CHAIN, sigma=0.05, name="six-axis")
WITHIN = np.radians(100.0)  # of limits that matter
LIMITED = replace(SIX_AXIS, lower=np.full(6, -WITHIN), upper=np.full(6, WITHIN) * [1.0, 0.6, 1.0, 0.8, 1.0, 1.0])
STEP = 1e-5  # [mm, rad] of central differences


def six_axis(arm: Arm = SIX_AXIS, **changes: Any) -> DesignProblem:
    """Its design problem."""
    return DesignProblem.of(Model(arm), **changes)


def difference_jacobian(model: Model, postures: Array, tool: Array = REFLECTOR) -> Array:
    """(m, 3, p) of one measured point, by central differences of products of exponentials."""
    found, chain = np.zeros((len(postures), 3, len(model.names))), model.arm.chain
    for row, q in enumerate(postures):
        for k, name in enumerate(model.names):
            if not name.startswith("tool") or name.startswith("tool[1]"):
                up, down = (tip_by_exponentials(chain, q, {name: sign * STEP}, tool) for sign in (1.0, -1.0))
                found[row, :, k] = (up - down) / (2.0 * STEP)
    return found


def difference_information(problem: DesignProblem, model: Model, postures: Array, shares: Array | None = None) -> Array:
    """(p, p) of a plan per run, in scaled parameters, with the prior that the problem has."""
    rows = difference_jacobian(model, postures) / model.scales
    if shares is not None:
        rows = rows * np.sqrt(len(postures) * shares)[:, None, None]
    scaled = rows.reshape(-1, len(model.names))
    sizes = np.array([problem.deviations.get(name, np.inf) for name in model.names])
    prior = np.diag((float(model.sigma or 0.0) / (model.scales * sizes)) ** 2)
    return (scaled.T @ scaled + prior) / len(postures)
