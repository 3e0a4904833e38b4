"""How frame and instrument were set up, against what the arm file says: turned, elsewhere, off by a constant length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.errors import InputError
from identification.estimation import Identification, estimate
from identification.estimation.doubts import FAR_ZERO, SPARE
from identification.estimation.uncertainty import LEVEL
from identification.inspection.data_checks import DRAWN
from identification.inspection.readings import anywhere, as_written, some_of_one_point
from identification.kinematics.frames import pose_table
from identification.kinematics.spatial import BASE
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.model.placed import placed_model
from identification.sessions import with_sessions

OFFSET = "length_offset"  # the effect
HALVED = 2.0  # times the squares that are left with a constant length: clearly more than one parameter's share
NOTHING = 1e-6  # [mm] RMS that is no measurement's: below, nothing is compared
AWAY = 0.02  # of the reach: a base this far from where the file has it stands elsewhere


def turned_frame(arm: Arm, measurements: Measurements) -> list[str]:
    """How far the positions of a planar arm are turned against its drawing, in a sentence; none for less than a zero
    may be off by, or where the drawing does not explain the positions at any angle."""
    if not arm.chain.positions_in_plane or measurements.links != arm.links:
        return []
    reading = as_written(arm, measurements).written
    if reading.turn is None or abs(reading.turn) < FAR_ZERO or reading.rms > DRAWN * arm.reach:
        return []
    turn = f"{np.degrees(reading.turn):.1f} deg"
    return [
        f"the frame of the positions is turned by {turn} against the arm file, or the zero of joint 1 is, which looks "
        "the same: a fit puts it into the zero of joint 1. Where it is the frame, turn the positions back by "
        f"{turn} or leave that zero out of the controller"
    ]


def other_base(arm: Arm, measurements: Measurements) -> list[str]:
    """Where a spatial arm stands if its `[base]` is wrong, in a sentence; none where the file says nothing, and where
    the drawing explains the positions from no place."""
    chain = arm.chain
    if chain.planar or BASE not in chain.known or not chain.instrument.reads_positions:
        return []
    rows = some_of_one_point(measurements)
    try:
        placed = placed_model(Model(anywhere(arm)), rows)
    except InputError:  # too few rows to place it
        return []
    left = rows.positions[:, :3] - placed.position(rows.postures, conditions=rows.conditions)[:, :3]
    if placed.arm.chain.planar or rms_distance(left) > DRAWN * arm.reach:
        return []
    base = placed.arm.chain.base
    turn, shift = angle_between(chain.base, base), float(np.linalg.norm(base[:3, 3] - chain.base[:3, 3]))
    if turn < FAR_ZERO and shift < AWAY * arm.reach:
        return []
    stands = ", ".join(f"{name} = {round(x, 1) + 0.0:g}" for name, x in pose_table(base).items())
    axis = chain.joints[0].origin[:3, :3] @ chain.joints[0].axis
    about = float(axis @ chain.base[:3, :3].T @ base[:3, :3] @ axis) > np.cos(FAR_ZERO)
    zero = ", or the zero of joint 1 is off by that" if about and shift < AWAY * arm.reach else ""
    how = f"turned by {np.degrees(turn):.1f} deg and {shift:.4g} mm away from there{zero}"
    return [
        f"the positions are in another frame than [base] says: {how}. From the drawing {stands}; write that there, or "
        "leave [base] out, and a fit finds it"
    ]


def angle_between(first: Array, second: Array) -> float:
    """[rad] by which one pose (4, 4) is turned against another."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1.0) / 2.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def constant_length(arm: Arm, measurements: Measurements, fit: Identification | None) -> list[str]:
    """The offer of `length_offset` where much less is left with it, in a sentence.

    fit : without it, None: there is none
    """
    settled = fit is None or "distance" not in arm.offers or any(spec.name == OFFSET for spec in arm.effects)
    if settled or fit is None or fit.dof <= SPARE or rms_distance(fit.residuals_after) < NOTHING:
        return []
    wider = replace(arm, calibration=None).with_effects(*arm.effects, EffectSpec(OFFSET))
    wider_fit = estimate(Model(with_sessions(wider, measurements)), measurements)
    before, after = (float(np.sum(one.residuals_after**2)) for one in (fit, wider_fit))
    after = max(after, NOTHING**2 * len(measurements))
    if before < HALVED * after or fdtrc(1, fit.dof - 1, (before - after) * (fit.dof - 1) / after) > LEVEL:
        return []
    value = float(wider_fit.parameters[wider_fit.names.index(f"{OFFSET}.c")])
    what = f"all distances look {abs(value):.3g} mm too {'long' if value > 0.0 else 'short'}"
    fall = f"the RMS falls from {fit.rms_after:.3g} to {wider_fit.rms_after:.3g} mm where that is estimated, too"
    return [f'{what}, as by the zero of a wire or the length of a bar: {fall}; add [[effects]] name = "{OFFSET}"']
