"""A minimal set of a spatial arm's parameters: as many as measurements can distinguish, the others as drawn.

Every combination of the geometry's errors that moves the measured points is one of the parameters that are kept (the
continuous and complete set of the literature: L. J. Everett, M. Driels, B. W. Mooring, "Kinematic modelling for robot
calibration", ICRA 1987): four for each revolute joint and two for each prismatic one, and three for each reflector off
the last axis or six for a measured frame; of a six-axis arm 27 with one reflector, 33 with three, 30 with a frame.
Which of several equivalent ones is kept is a choice: those that an engineer looks for first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from identification.arm import Arm
from identification.arrays import Array
from identification.kinematics.chain import BASE, ROTATION_ERROR, TOOL, TRANSLATION_ERROR
from identification.kinematics.parameters import JOINT_OFFSET, error_names
from identification.measurements import Conditions, Measurements
from identification.model.arm_model import Model
from identification.model.placed import placed_model

DISTINCT = 1e-6  # [mm] RMS change of a coordinate by an error of machining size, beside those kept; rounding is 1e-12
PRACTICAL = 1e-2  # [mm] the same without what measurements hardly determine: below what trackers resolve


def minimal(model: Model, least: float = DISTINCT, rows: Measurements | None = None) -> Model:
    """The model of a spatial arm with a minimal set of geometric parameters, free of any prior; the others are zero, or
    what a calibration says.

    least : [mm] what the smallest parameter that counts moves a coordinate by, see `DISTINCT`
    rows : at which something is touched, which show less than postures inside the limits; None: every measured point at
        any of these
    Where the measured points lie decides how many there are: for points that are to be found, of `placed_model`.
    """
    arm, parameters = model.arm, model.parameters
    order, sizes = ordered(model)
    if rows is None:  # three equations each for some forty parameters
        postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (100, arm.links))
        each = [Conditions(marker=np.full(len(postures), float(k))) for k in range(len(arm.chain.tools))]
    else:
        postures, each = rows.postures, [rows.conditions]
    columns = np.concatenate([model.jacobian(postures, None, at) for at in each]).reshape(-1, len(parameters))
    kept = {order[k] for k in independent(columns[:, order] * sizes, least)}
    return _fixing(model, (parameters[k].name for k in order if k not in kept))


def practical(arm: Arm, measurements: Measurements, least: float = PRACTICAL) -> Arm:
    """A spatial arm for fits without a prior: base and measured points where the closed form finds them, and what
    measurements hardly determine (`least`, as of `minimal`) as drawn; of contacts what the surfaces show at the
    postures measured. A planar arm, and a spatial one whose set was chosen, stays as it is."""
    if not arm.chain.redundant:
        return arm
    model, instrument = Model(arm), arm.chain.instrument
    placed = placed_model(model, measurements)
    if not instrument.contact:
        return minimal(placed, least).arm
    if instrument.own_targets:
        shown = minimal(placed, least, measurements)
    else:
        # what they show together, each beside a base of its own: a level surface does not show where axes lie along it
        bases, others, names = list[Array](), list[Array](), list[str]()
        for rows in (measurements.rows(index) for index in measurements.session_rows):
            there = placed_model(model, rows)
            order, sizes = ordered(there)
            columns = (
                there.jacobian(rows.postures, None, rows.conditions).reshape(-1, len(there.names))[:, order] * sizes
            )
            count = len(there.parameters.indices(BASE))
            bases.append(columns[:, :count])
            others.append(columns[:, count:])
            names = [there.names[k] for k in order[count:]]
        tall = np.concatenate(others)
        # the longest step stays as drawn where nothing shows the size, and what is kept takes its place
        if longest := longest_step(placed, names):
            tall[:, names.index(longest)] = 0.0
        own = sum(base.shape[1] for base in bases)
        kept = {k - own for k in independent(np.column_stack([block_diag(*bases), tall]), least)}
        return _fixing(placed, (name for k, name in enumerate(names) if k not in kept)).arm
    # readings that do not show the size of the arm would all the same, where they do not fit, fit an arm better that is
    # next to nothing: the longest step that is a parameter stays as drawn
    longest = longest_step(shown, shown.names)
    return _fixing(shown, [longest] if longest else ()).arm


def longest_step(model: Model, names: Iterable[str]) -> str | None:
    """Of these parameters the step along the longest drawn one, where readings do not show the size of the arm."""
    steps: dict[str, float] = {}
    for j, joint in enumerate(model.arm.chain.joints if model.arm.chain.instrument.size_is_open[0] else (), start=1):
        along = np.abs(joint.origin[:3, :3].T @ joint.origin[:3, 3])
        steps |= {n: size for n, size in zip(error_names(j), along.tolist(), strict=False) if n in names}
    return max(steps, key=steps.__getitem__, default=None)


def ordered(model: Model) -> tuple[list[int], Array]:
    """Numbers of the geometric parameters, what is kept before what, and what each can be off by."""
    parameters = model.parameters
    first = (BASE, TOOL, JOINT_OFFSET, TRANSLATION_ERROR, ROTATION_ERROR)
    order = [k for kind in first for k in parameters.indices(kind)]
    return order, np.array([model.prior.get(parameters[k].name, 1.0 / parameters[k].scale) for k in order])


def _fixing(model: Model, names: Iterable[str]) -> Model:
    """The model with these parameters as drawn, too."""
    chain = replace(model.arm.chain, fixed=model.arm.chain.fixed | frozenset(names))
    return replace(model, arm=replace(model.arm, chain=chain))


def independent(columns: Array, least: float = DISTINCT) -> list[int]:
    """Numbers of the columns (N, p) of which those kept before leave an RMS above `least` (Gram and Schmidt, twice for
    rounding)."""
    basis, kept = np.zeros((len(columns), 0)), []
    for k, left in enumerate(columns.T):
        for _ in range(2):
            left = left - basis @ (basis.T @ left)
        if (size := float(np.linalg.norm(left))) > least * np.sqrt(len(columns)):
            basis = np.column_stack([basis, left / size])
            kept.append(k)
    return kept
