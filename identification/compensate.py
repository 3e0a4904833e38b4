"""Compensation: joint commands that bring the tip of the real arm to where the nominal arm would have been.

Targets are positions, or poses of a spatial arm's tool, where an angle counts as the distance that it is at full reach.

The real arm is the calibrated model (`identification.inverse_kinematics`). A command keeps to the constraints that are
given: where none does, the target counts as not reached, and its message says which constraint is in the way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import Arm, Calibration
from identification.arrays import Array, readonly
from identification.data_frames import frame_of_columns
from identification.errors import InputError
from identification.inverse_kinematics import (
    TOLERANCE,
    Constraints,
    near_or_within,
    reaching,
    violations,
    within_or_near,
)
from identification.kinematics.corrected import standing_in
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import POINT, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.positions import in_own_frame
from identification.row_groups import extrapolated, familiar_range, identified, outside
from identification.servo import servo_shift
from identification.sessions import BASE

TURNED = 1e-8  # [rad] a pose is reached if the model comes this close


@dataclass(frozen=True, eq=False)
class Compensation:
    """Joint commands for k targets.

    targets : (k, d) [mm];  orientations : (k, 3, 3) of the tool for the instrument, None: any will do
    nominal : (k, n) postures [rad] that would reach them on the nominal arm
    commands : (k, n) postures [rad] for the real arm, within the joint limits; the nearest found where unreachable, at
        angles of the identification where no nominal postures were given
    errors : (k,) distance of the real arm's tip from the target [mm], by the calibrated model
    angles : (k,) between the orientation wanted and that of the tool [rad], None: any will do
    joint_types : (n) of the arm, empty: all revolute
    constraints : kinds of those given;  violations : (k, c) by how much each command misses them [mm]
    outside : (k, n) True where a joint is outside the angles of the identification, None: these are not known
    model_rms : [mm] that the calibrated model left of its own measurements, None: not known
    """

    targets: Array
    nominal: Array
    commands: Array
    errors: Array
    joint_types: tuple[str, ...] = ()
    orientations: Array | None = None
    angles: Array | None = None
    constraints: tuple[str, ...] = ()
    violations: Array | None = None
    outside: NDArray[np.bool_] | None = None
    model_rms: float | None = None

    def __post_init__(self) -> None:
        for name in ("targets", "nominal", "commands", "errors"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(k,) True where the error is at most `TOLERANCE`, the angle at most `TURNED`, and every constraint holds."""
        near = self.near
        return near if self.violations is None else near & ~np.any(self.violations > 0.0, axis=1)

    @property
    def near(self) -> NDArray[np.bool_]:
        """(k,) as `reached`, whatever the constraints say."""
        near = self.errors <= TOLERANCE
        return near if self.angles is None else near & (self.angles <= TURNED)

    @property
    def messages(self) -> list[str]:
        """(k) why a target is not reached; empty where it is."""
        angles = np.zeros(len(self.errors)) if self.angles is None else np.degrees(self.angles)
        missed = np.zeros((len(self.errors), 0)) if self.violations is None else self.violations
        inside = np.zeros(len(missed), dtype=bool) if self.outside is None else ~self.outside.any(axis=1)
        rows = zip(*(column.tolist() for column in (self.near, self.errors, angles, missed, inside)), strict=True)
        return [self._message(*row) for row in rows]

    def _message(self, near: bool, error: float, angle: float, missed: list[float], inside: bool) -> str:
        """Of one target: what is left [mm], [deg], at the angles identified or not, and what constraints are missed by
        [mm]."""
        familiar = " at the angles identified" if inside else ""
        turned = "" if self.angles is None else f" and {angle:.4g} deg"
        said = [] if near else [f"out of reach within the joint limits: {error:.4g} mm{turned} are left{familiar}"]
        numbered = enumerate(zip(self.constraints, missed, strict=True), start=1)
        said += [f"constraint {k} ({kind}) is missed by {size:.4g} mm" for k, (kind, size) in numbered if size > 0.0]
        return "; ".join(said)

    @property
    def safe_commands(self) -> Array:
        """(k, n) as `commands`, NaN where they miss a constraint: nobody may drive to these."""
        if self.violations is None:
            return self.commands
        return np.where(np.any(self.violations > 0.0, axis=1)[:, None], np.nan, self.commands)

    @property
    def warnings(self) -> list[str]:
        """What must be known of the commands, in sentences."""
        said = extrapolated(self.outside, "targets")
        return [] if said is None else [f"{said}, and the error that is left may be larger than it says"]

    def to_json(self) -> dict[str, Any]:
        """Counts, largest errors over targets reached and over the others, unreached rows, and a row for each target
        (identification/files/README.md, "JSON keys")."""
        reached = self.reached
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            "max_error_mm": float(np.max(self.errors[reached])) if reached.any() else None,
            "max_error_over": "targets reached",
            "model_rms_mm": self.model_rms,
            "max_unreached_mm": None if reached.all() else float(np.max(self.errors[~reached])),
            **({} if self.angles is None else {"max_error_deg": self._largest_angle}),
            "unreachable": [int(row) + 1 for row in np.flatnonzero(~reached)],
            "unreachable_count": int(np.count_nonzero(~reached)),
            "outside_identified": self._outside,
            "warnings": self.warnings,
            "commands_deg": [
                row if near else None
                for row, near in zip(self.commands_in_file_units.tolist(), reached.tolist(), strict=True)
            ],
            "commands": self._rows(),
        }

    def _rows(self) -> list[dict[str, Any]]:
        """One entry for each target, in file units; the command is the nearest found where it is not reached."""
        columns = {
            "target_mm": self.targets,
            "command": self.commands_in_file_units,
            "error_mm": self.errors,
            **({} if self.angles is None else {"error_deg": np.degrees(self.angles)}),
            "reachable": self.reached,
        }
        rows = zip(*(column.tolist() for column in columns.values()), self.messages, strict=True)
        return [dict(zip(("target", *columns, "message"), (k, *row), strict=True)) for k, row in enumerate(rows, 1)]

    @property
    def _outside(self) -> dict[str, Any] | None:
        """Targets and joints, from 1, beyond the angles of the identification; None where these are not known."""
        if (out := self.outside) is None:
            return None
        counts = enumerate(out.sum(axis=0).tolist(), start=1)
        joints = [{"joint": joint, "targets": count} for joint, count in counts if count]
        return {"targets": (np.flatnonzero(out.any(axis=1)) + 1).tolist(), "joints": joints}

    @property
    def _largest_angle(self) -> float | None:
        """[deg] over targets reached."""
        angles = () if self.angles is None else np.degrees(self.angles[self.reached])
        return float(np.max(angles)) if len(angles) else None

    @property
    def commands_in_file_units(self) -> Array:
        """(k, n) [deg], of prismatic joints [mm]."""
        turning = np.array(self.joint_types or (REVOLUTE,) * self.commands.shape[1]) == REVOLUTE
        return np.where(turning, np.degrees(self.commands), self.commands)

    def to_frame(self, kind: str = "polars") -> Any:
        """A row for each target: `q1`.. [deg, mm], `x_mm`.., `error_mm`, `reachable`, `message`; polars or pandas."""
        columns = {f"q{j}": values for j, values in enumerate(self.commands_in_file_units.T, start=1)}
        columns |= {f"{axis}_mm": values for axis, values in zip("xyz", self.targets.T, strict=False)}
        left: dict[str, Any] = {"error_mm": self.errors, "reachable": self.reached, "message": self.messages}
        return frame_of_columns(columns | left, kind)

    def __repr__(self) -> str:
        return f"Compensation({int(np.count_nonzero(self.reached))} of {len(self.targets)} targets reached)"


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
    given = None if postures is None else _checked("postures", postures, arm.links)
    turned = _orientations(arm, orientations, targets is None)
    arm = _aiming(arm, poses=turned is not None)
    nominal_arm = Model(as_drawn(arm))
    goals = _goals(nominal_arm, targets, given)
    if turned is not None and targets is None and given is not None:
        turned = nominal_arm.orientations(given)
    if turned is not None and len(turned) != len(goals):
        raise InputError(f"orientations: {len(turned)} rows for {len(goals)} targets, allowed: as many")
    where = replace(conditions or Conditions(), orientation=turned)
    nominal = (
        given
        if given is not None
        else within_or_near(nominal_arm, familiar_range(arm), goals, Conditions(orientation=turned), constraints)
    )
    model = Model(arm)
    if where.directions is None and len(nominal):
        past = past_from_order(nominal) if model.remembers else None
        where = replace(where, directions=directions_from_order(nominal), past=past)
    commands = reaching(model, goals, nominal, where, constraints)
    if given is None:
        commands = near_or_within(model, familiar_range(arm), goals, commands, where, constraints)
    return _compensation(model, goals, nominal, commands, where, constraints)


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
    return Compensation(goals[:, POINT], nominal, *figures)


def _orientations(arm: Arm, given: ArrayLike | None, as_nominal: bool) -> Array | None:
    """(k, 3, 3) wanted, (0, 3, 3) where they follow from nominal postures, None where any will do."""
    if given is not None:
        if arm.chain is None:
            raise InputError("orientations: found for a planar arm, allowed: for a spatial one")
        return np.asarray(given, dtype=float).reshape(-1, 3, 3)
    poses = as_nominal and arm.chain is not None and arm.chain.angle_scale is not None
    return np.zeros((0, 3, 3)) if poses else None


def _aiming(arm: Arm, poses: bool) -> Arm:
    """The arm as if its tool were measured by points, or by poses of which an angle counts times the reach."""
    scale = arm.reach if poses else None
    arm = in_own_frame(arm)
    return arm if arm.chain is None else replace(arm, chain=replace(arm.chain, angle_scale=scale))


def as_drawn(arm: Arm) -> Arm:
    """The nominal arm, without effects; where its base is not given it stands where the calibration found it, a planar
    one turned by the offset of joint 1, and a spatial one with its points."""
    chain, stands = arm.chain, tuple(spec for spec in arm.effects if spec.name == "base_offset")
    if chain is not None and arm.calibration is not None:
        chain = standing_in(chain, arm.calibration.values)
    if chain is not None or not stands:
        return replace(arm, effects=(), calibration=None, chain=chain)
    known = Model(arm).best_known
    return replace(arm, effects=stands, calibration=Calibration({name: known.get(name, 0.0) for name in BASE}))


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
