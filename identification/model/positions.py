"""What an arm that is measured by no positions says of these: where its tip is, in the frame of its own base where the
readings do not say where that stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from identification.arm import Arm
from identification.arrays import Array
from identification.effects import library
from identification.errors import InputError
from identification.instruments import TRACKER
from identification.kinematics.chain import BASE
from identification.model.arm_model import Model

FEWEST = 4  # positions, of which a rigid motion explains half the coordinates


def of_positions(model: Model) -> Model:
    """The model of the measured point's position with the same parameters, without those of the reading; of an
    instrument that reads positions as it is."""
    chain = model.arm.chain
    if chain.instrument.reads_positions:
        return model
    arm = replace(model.arm, chain=replace(chain, instrument=TRACKER))
    held_values = dict(model.held or {})
    for parameter in chain.instrument.parameters:
        held_values.pop(parameter.name, None)
    held = {*Model(arm).geometry_parameters.names} - {*model.geometry_parameters.names} | (chain.held - chain.fixed)
    held |= {p.name for effect in model.effects if effect.needs & chain.instrument.offers for p in effect.parameters}
    return Model(arm, {**held_values, **dict.fromkeys(held, 0.0)})


def tip_jacobian(model: Model, postures: ArrayLike, parameters: ArrayLike | None = None) -> Array:
    """(m, d, p) derivative of the measured point's position with respect to the parameters, in the frame of the
    instrument; where readings do not say where the arm stands in it, of what no rigid motion of all m positions makes
    up for: the first use of its positions is to find that.

    Raises `InputError` for fewer than `FEWEST` postures then.
    """
    whole = of_positions(model)
    if whole is model:
        return model.linearize(postures, parameters)[1]
    free = [model.names.index(name) for name in whole.names]
    points, moved = whole.linearize(postures, None if parameters is None else np.asarray(parameters)[..., free])
    jacobian = np.zeros((*moved.shape[:-1], len(model.names)))  # how a length is read moves no point
    jacobian[..., free] = moved
    if model.arm.chain.instrument.places:
        return jacobian
    if (m := len(points)) < FEWEST:
        raise InputError(f"postures: {m} for the error of the tip from lengths, allowed: at least {FEWEST}")
    d = points.shape[1]
    around = np.pad(points - points.mean(axis=0), ((0, 0), (0, 3 - d)))
    turns = np.cross(np.eye(3)[[*model.arm.chain.turning]], around[:, None, :])[..., :d]  # a row of each axis
    rigid = np.concatenate([np.tile(np.eye(d), (m, 1, 1)), np.swapaxes(turns, 1, 2)], axis=2)
    basis = np.linalg.qr(rigid.reshape(d * m, -1))[0]
    flat = jacobian.reshape(d * m, -1)
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(jacobian.shape))


def in_own_frame(arm: Arm) -> Arm:
    """An arm whose readings do not say where it stands as if its positions were measured in the frame of its base, of
    another instrument as if positions were read; one that reads them as it is."""
    chain, calibration = arm.chain, arm.calibration
    if chain.instrument.reads_positions:
        return arm
    effects = [spec for spec in arm.effects if not library()[spec.name].needs & chain.instrument.offers]
    if chain.instrument.places:
        return replace(arm, chain=replace(chain, instrument=TRACKER)).with_effects(*effects)
    chain = replace(chain, base=np.eye(4), settled=chain.settled | {BASE}, instrument=TRACKER)
    if calibration is not None:
        values = {name: value for name, value in calibration.values.items() if not name.startswith(f"{BASE}.")}
        calibration = replace(calibration, values=values, base=None)
    return replace(arm, chain=chain, calibration=calibration).with_effects(*effects)
