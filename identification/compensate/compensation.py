"""Joint commands that compensation found: which targets they reach, what is left, and what must be known of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, readonly
from identification.compensate.inverse_kinematics import TOLERANCE
from identification.data_frames import frame_of_columns
from identification.document import Document
from identification.documents.use import compensation_document
from identification.kinematics.counting import counting_in, in_columns
from identification.kinematics.parameters import REVOLUTE
from identification.validate.row_groups import extrapolated

TURNED = 1e-8  # [rad] a pose is reached if the model comes this close
FEW = 0.5  # of the targets: of more out of reach, the frame or the unit is likelier to be wrong than each of them


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
    sided : effects of the model for which the order of the targets was taken as that of the approach
    tolerance : [mm] what counts as reached, see `tolerance_of`;  reach : of the arm [mm], at which an angle is that far
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
    sided: tuple[str, ...] = ()
    tolerance: float = TOLERANCE
    reach: float = np.inf

    def __post_init__(self) -> None:
        for name in ("targets", "nominal", "commands", "errors"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(k,) True where the error is at most `tolerance`, the angle no more at full reach, or `TURNED`, and every
        constraint holds."""
        near = self.near
        return near if self.violations is None else near & ~np.any(self.violations > 0.0, axis=1)

    @property
    def near(self) -> NDArray[np.bool_]:
        """(k,) as `reached`, whatever the constraints say."""
        near = self.errors <= self.tolerance
        return near if self.angles is None else near & (self.angles <= max(TURNED, self.tolerance / self.reach))

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
        familiar = " (within the angles identified)" if inside else ""
        by = f"{error:.4g} mm{'' if self.angles is None else f' and {angle:.4g} deg'}"
        clauses = (
            [] if near else [f"out of reach within the joint limits: the nearest posture{familiar} misses it by {by}"]
        )
        numbered = enumerate(zip(self.constraints, missed, strict=True), start=1)
        clauses += [f"constraint {k} ({kind}) is missed by {size:.4g} mm" for k, (kind, size) in numbered if size > 0.0]
        return "; ".join(clauses)

    @property
    def safe_commands(self) -> Array:
        """(k, n) as `commands`, NaN where the target is not reached: no controller may be fed with these."""
        return np.where(self.reached[:, None], self.commands, np.nan)

    @property
    def left(self) -> Array:
        """(k,) as `errors`, NaN where a constraint bars the target: nothing is driven to there."""
        return np.where(self.near & ~self.reached, np.nan, self.errors)

    @property
    def left_angles(self) -> Array | None:
        """(k,) as `angles` [rad], NaN as in `left`."""
        return None if self.angles is None else np.where(np.isnan(self.left), np.nan, self.angles)

    @property
    def warnings(self) -> list[str]:
        """What must be known of the commands, in sentences."""
        outside = extrapolated(self.outside, "targets")
        notes = [] if outside is None else [f"{outside}, and the error that is left may be larger than it says"]
        if (out := np.count_nonzero(~self.near)) > FEW * len(self.targets):
            frame = "are they in mm, and in the frame of the measurements that calibrated the arm"
            notes.append(f"{out} of {len(self.targets)} targets are out of reach: {frame}?")
        if close := np.count_nonzero(self.reached & (self.errors > TOLERANCE)):
            most = f"by {float(np.max(self.errors[self.reached])):.2g} mm at most"
            least = f"less than the {self.tolerance:.2g} mm that the calibration itself is uncertain by"
            notes.append(f"{close} of the targets reached are missed {most}, {least}: no posture of the arm is nearer")
        if self.sided and self.reached.any():
            side = f"{', '.join(self.sided)}: the error depends on the side that a joint comes from"
            notes.append(f"{side}. Drive the targets in this order, and to the first with every joint {self._rising}")
        return notes

    @property
    def _rising(self) -> str:
        """How joints that all rise move as the controller counts."""
        counting, joints = counting_in(self.joint_types), self.commands.shape[1]
        moves = np.ones(joints) if counting is None else counting.signs_of_columns(np.ones((1, joints)))[0]
        falling = [str(j) for j, sign in enumerate(moves, start=1) if sign < 0.0]
        return f"rising, but {', '.join(falling)} falling" if falling else "rising"

    def to_json(self) -> dict[str, Any]:
        """Counts, largest errors over targets reached and over the others, unreached rows, and a row for each target
        (identification/files/README.md, "JSON keys")."""
        reached, out = self.reached, ~self.near
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            "max_error_mm": float(np.max(self.errors[reached])) if reached.any() else None,
            "max_error_over": "targets reached",
            "tolerance_mm": self.tolerance,
            "model_rms_mm": self.model_rms,
            "max_unreached_mm": float(np.max(self.errors[out])) if out.any() else None,
            **({} if self.angles is None else {"max_error_deg": self._largest_angle}),
            "unreachable": [int(row) + 1 for row in np.flatnonzero(~reached)],
            "unreachable_count": int(np.count_nonzero(~reached)),
            "outside_identified": self._outside,
            "warnings": self.warnings,
            "commands_deg": _where(reached, self.commands_in_file_units),
            "commands": self._rows(),
        }

    def _rows(self) -> list[dict[str, Any]]:
        """One entry for each target, in file units; None for what it does not have."""
        reached, commands = self.reached, self.commands_in_file_units
        driven = reached | ~self.near  # or missed, by what is left
        columns = {
            "target_mm": self.targets.tolist(),
            "command": _where(reached, commands),
            "nearest": _where(~reached, commands),
            "error_mm": _where(driven, self.errors),
            **({} if self.angles is None else {"error_deg": _where(driven, np.degrees(self.angles))}),
            "reachable": reached.tolist(),
        }
        rows = zip(*columns.values(), self.messages, strict=True)
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
        """(k, n) [deg], of prismatic joints [mm], as the controller counts."""
        commands = in_columns(self.commands, self.joint_types)
        turning = np.array(self.joint_types or (REVOLUTE,) * self.commands.shape[1]) == REVOLUTE
        return np.where(turning, np.degrees(commands), commands)

    def to_frame(self, kind: str = "polars") -> Any:
        """A row for each target: `q1`.. [deg, mm], `x_mm`.., `error_mm`, `reachable`, `message`; polars or pandas."""
        columns = {f"q{j}": values for j, values in enumerate(self.commands_in_file_units.T, start=1)}
        columns |= {f"{axis}_mm": values for axis, values in zip("xyz", self.targets.T, strict=False)}
        left: dict[str, Any] = {"error_mm": self.left, "reachable": self.reached, "message": self.messages}
        return frame_of_columns(columns | left, kind)

    def document(self) -> Document:
        """How many targets are reached and which are not, then joint commands for the first ones."""
        return compensation_document(self)

    def __repr__(self) -> str:
        return f"Compensation({int(np.count_nonzero(self.reached))} of {len(self.targets)} targets reached)"

    def _repr_html_(self) -> str:
        return self.document()._repr_html_()


def _where(shown: NDArray[np.bool_], rows: Array) -> list[Any]:
    """(k) rows, None where they are not to be said."""
    return [row if one else None for one, row in zip(shown.tolist(), rows.tolist(), strict=True)]
