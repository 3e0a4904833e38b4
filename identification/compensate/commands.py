"""Compensation: joint commands that bring the tip of the real arm to where the nominal arm would have been.

Targets are positions, or poses of a spatial arm's tool, where an angle counts as the distance that it is at full reach.

The real arm is the calibrated model (`identification.compensate.inverse_kinematics`). A command keeps to the
constraints that are given: where none does, the target counts as not reached, and its message says which constraint is
in the way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.compensate.compensation import Compensation
from identification.compensate.inverse_kinematics import TOLERANCE, Constraints, violations
from identification.compensate.reaching import near_or_within, reaching, within_or_near
from identification.errors import InputError
from identification.kinematics.corrected import standing_in
from identification.measurements import POINT, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.model.positions import in_own_frame
from identification.servo import servo_shift
from identification.sessions import BASE
from identification.validate.row_groups import familiar_range, identified, outside

MISSED_BY_CHANCE = 1e-3  # share of right targets that lie beyond the tolerance
APPROACH = {"directions", "past"}  # what an effect needs whose error depends on the side that a joint comes from


def compensate(
    arm: Arm,
    targets: ArrayLike | None = None,
    postures: ArrayLike | None = None,
    conditions: Conditions | None = None,
    orientations: ArrayLike | None = None,
    constraints: Constraints = (),
) -> Compensation:
    """Joint commands within the limits whose tip, on the calibrated arm, is at the targets.

    arm : with a calibration, or with known effect values
    targets : (k, d) tip positions [mm]; left out: where the nominal arm has its tip at `postures`
    postures : (k, n) nominal joint commands [rad]; left out: found, the nearest to the middle of the
        angles of the identification, and where possible within them; where these are not known, of the limits
    conditions : payload, temperature and the like of every row; directions follow from the order of the rows
    orientations : (k, 3, 3) axes of a spatial arm's tool for the instrument at the targets; left out: any will do, but
        that where targets are left out, too, an arm that measures orientations keeps those of its nominal postures
    constraints : that commands keep to, as of `doe.problem.constraints.constraints_of(Model(arm))`

    Where the arm has servo errors they are taken off the commands: the joints are to be read where the tip is right.

    Raises `InputError` for an arm without calibration and for shapes or values that do not fit.
    """
    if arm.calibration is None and not any(spec.values for spec in arm.effects):
        raise InputError("calibration: the arm has none, allowed: a file written by `armcal identify --out`")
    nominal_postures = None if postures is None else _checked("postures", postures, arm.links)
    turned = _orientations(arm, orientations, targets is None)
    scale = None if turned is None else arm.reach  # which an angle of a pose counts times
    arm = in_own_frame(arm)
    if not arm.chain.planar:
        arm = replace(arm, chain=replace(arm.chain, angle_scale=scale))
    nominal_arm = Model(drawn_arm(arm))
    goals = _goals(nominal_arm, targets, nominal_postures)
    if turned is not None and targets is None and nominal_postures is not None:
        turned = nominal_arm.orientations(nominal_postures)
    if turned is not None and len(turned) != len(goals):
        raise InputError(f"orientations: {len(turned)} rows for {len(goals)} targets, allowed: as many")
    where = replace(conditions or Conditions(), orientation=turned)
    nominal = (
        nominal_postures
        if nominal_postures is not None
        else within_or_near(nominal_arm, familiar_range(arm), goals, Conditions(orientation=turned), constraints)
    )
    model = Model(arm)
    sided: tuple[str, ...] = ()
    if where.directions is None and len(nominal):
        sided = tuple(sorted({effect.name for effect in model.effects if not APPROACH.isdisjoint(effect.needs)}))
        past = past_from_order(nominal) if model.remembers else None
        where = replace(where, directions=directions_from_order(nominal), past=past)
    enough = tolerance_of(arm)
    commands = reaching(model, goals, nominal, where, constraints, enough)
    if nominal_postures is None:
        commands = near_or_within(model, familiar_range(arm), goals, commands, where, constraints, enough)
    return replace(_compensation(model, goals, nominal, commands, where, constraints), sided=sided)


def _compensation(
    model: Model, goals: Array, nominal: Array, commands: Array, where: Conditions, constraints: Constraints
) -> Compensation:
    """From nominal postures and commands (k, n), under conditions with directions."""
    arm = model.arm
    missed = violations(constraints, commands)
    left = goals - model.position(commands, conditions=where) if len(goals) else goals
    beyond = outside(arm, commands)
    if beyond is not None:  # nobody drives to what misses a constraint
        beyond = beyond & ~np.any(missed > 0.0, axis=1)[:, None]
    angles = None if where.orientation is None else np.linalg.norm(left[:, POINT.stop :], axis=1) / model.reach
    if where.directions is not None:
        commands = commands - servo_shift(arm, where.directions)
    kinds = tuple(each.kind for each in constraints)
    rms = identified(arm).get("rms_after_mm")
    rms = float(rms) if isinstance(rms, float | int) else None
    figures = commands, distances(left), arm.joint_types, where.orientation, angles, kinds, missed, beyond, rms
    return Compensation(goals[:, POINT], nominal, *figures, tolerance=tolerance_of(arm), reach=model.reach)


def tolerance_of(arm: Arm) -> float:
    """[mm] within which a target counts as reached where no posture gets there exactly, as of an arm with fewer joints
    than coordinates: what one in `MISSED_BY_CHANCE` of the calibration's own measurements may be off, by what the fit
    left of them and by its own uncertainty. `TOLERANCE` where they are not known.
    """
    figures = [identified(arm).get(key) for key in ("rms_after_mm", "expected_tip_mm")]
    rms = float(np.linalg.norm([float(x) for x in figures if isinstance(x, float | int)]))
    d = arm.dimension
    return max(TOLERANCE, rms * float(np.sqrt(chdtri(d, MISSED_BY_CHANCE) / d)))


def _orientations(arm: Arm, orientations: ArrayLike | None, as_nominal: bool) -> Array | None:
    """(k, 3, 3) wanted, (0, 3, 3) where they follow from nominal postures, None where any will do."""
    if orientations is not None:
        if arm.chain.planar:
            raise InputError("orientations: found for a planar arm, allowed: for a spatial one")
        return np.asarray(orientations, dtype=float).reshape(-1, 3, 3)
    poses = as_nominal and arm.chain.angle_scale is not None
    return np.zeros((0, 3, 3)) if poses else None


def drawn_arm(arm: Arm) -> Arm:
    """The nominal arm, without effects; where its base is not given it stands where the calibration found it, a planar
    one turned by the offset of joint 1, and a spatial one with its points."""
    chain, stands = arm.chain, tuple(spec for spec in arm.effects if spec.name == "base_offset")
    if not chain.planar and arm.calibration is not None:
        chain = standing_in(chain, arm.calibration.values)
    if not chain.planar or not stands:
        return replace(arm, effects=(), calibration=None, chain=chain)
    values = Model(arm).best_known
    return replace(arm, effects=stands, calibration=Calibration({name: values.get(name, 0.0) for name in BASE}))


def _goals(nominal: Model, targets: ArrayLike | None, postures: Array | None) -> Array:
    """(k, d) targets [mm], or where the nominal arm has its tip at the postures; of poses three zeros more."""
    if targets is None:
        if postures is None:
            raise InputError(f"targets: none given, allowed: positions (k, {nominal.arm.dimension}) or postures (k, n)")
        points = nominal.position(postures)[:, POINT]
    else:
        points = _checked("targets", targets, nominal.arm.dimension)
    goals = np.pad(points, ((0, 0), (0, nominal.dimension - nominal.arm.dimension)))
    if postures is not None and len(postures) != len(goals):
        raise InputError(f"postures: {len(postures)} rows for {len(goals)} targets, allowed: as many")
    return goals


def _checked(name: str, values: ArrayLike, columns: int) -> Array:
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != columns or not np.all(np.isfinite(array)):
        raise InputError(f"{name}: shape {array.shape}, allowed: (k, {columns}) finite numbers")
    return array
