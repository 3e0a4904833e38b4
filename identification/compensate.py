"""Compensation: joint commands that bring the tip of the real arm, the calibrated model, to its targets.

Targets are positions, or poses of a spatial arm's tool, where an angle counts as the distance that it is at full reach.
Inverse kinematics is Levenberg-Marquardt on exact derivatives, all targets at once, from one start and then from many
(`search`). What no start reaches goes on by Newton's method; postures that miss a constraint are led away from what is
in the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from identification.arm import Arm, Calibration
from identification.arrays import Array, readonly
from identification.document import Document, Documented, Sheet
from identification.documents.identification import command_rows, miss_text, rows_listed
from identification.errors import InputError
from identification.files.csv import csv_text
from identification.files.measurement import angle_columns, posture_columns
from identification.kinematics.corrected import standing_in
from identification.kinematics.counting import counting_in, in_columns, turned_into
from identification.kinematics.parameters import REVOLUTE
from identification.levenberg_marquardt import Index, LeastSquares, levenberg_marquardt
from identification.measurements import POINT, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.model.placed import in_own_frame
from identification.newton import newton_ascent
from identification.origin import check_calibrated, extrapolated, familiar_range, identified, outside
from identification.sessions import BASE
from identification.simulate import servo_shift
from identification.workspace import PostureCondition

TOLERANCE = 1e-6  # [mm] a target is reached if the model comes this close; so near may a constraint be missed
QUICK = 20  # iterations from each: 99 of 100 seeds that reach a target have reached it, the others creep along limits
NEAR, MISSED, BEYOND = 1.0, 2.0, 1e9  # ranks from which a goal is reached nearly, not for constraints, not at all
BEND = 1e-7  # [rad] of a joint, for derivatives by differences
Constraints = Sequence[PostureCondition]


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
    check_calibrated(arm)
    nominal = None if postures is None else _checked("postures", postures, arm.links)
    if orientations is not None and not arm.chain.frame_kinds:
        raise InputError("orientations: found for a planar arm, allowed: for a spatial one")
    as_nominal = targets is None and orientations is None and arm.chain.angle_scale is not None
    turned = None if orientations is None else np.asarray(orientations, dtype=float).reshape(-1, 3, 3)
    arm, posed = in_own_frame(arm), turned is not None or as_nominal
    arm = replace(arm, chain=replace(arm.chain, angle_scale=arm.reach if posed else None))  # of an angle of a pose
    model, provenance = Model(arm), identified(arm)
    # the nominal arm, without effects; where its base is not given it stands where the calibration found it, a planar
    # one turned by the offset of joint 1, and a spatial one with its points
    chain, stands, place = arm.chain, tuple(spec for spec in arm.effects if spec.name == "base_offset"), None
    if arm.calibration is not None:
        chain = standing_in(chain, arm.calibration.values)
    if stands:
        place = Calibration({name: model.best_known.get(name, 0.0) for name in BASE})
    drawing = Model(replace(arm, effects=stands if place else (), calibration=place, chain=chain))
    # where no posture gets to a target, as of an arm with fewer joints than coordinates, it counts as reached within
    # what one in a thousand of the calibration's own measurements may be off, by what the fit left and is unsure of
    rms, tip = (
        x if isinstance(x, float | int) else None for x in map(provenance.get, ("rms_after_mm", "expected_tip_mm"))
    )
    likely = float(np.hypot(rms or 0.0, tip or 0.0))
    enough = max(TOLERANCE, likely * float(np.sqrt(chdtri(arm.dimension, 1e-3) / arm.dimension)))
    if targets is not None:
        points = _checked("targets", targets, arm.dimension)
    elif nominal is None:
        raise InputError(f"targets: none given, allowed: positions (k, {arm.dimension}) or postures (k, n)")
    else:
        points, turned = drawing.position(nominal)[:, POINT], drawing.orientations(nominal) if as_nominal else turned
    goals = np.pad(points, ((0, 0), (0, drawing.dimension - arm.dimension)))  # of poses three zeros more
    for name, rows in (("postures", nominal), ("orientations", turned)):
        if rows is not None and len(rows) != len(goals):
            raise InputError(f"{name}: {len(rows)} rows for {len(goals)} targets, allowed: as many")
    limits, familiar = (arm.lower, arm.upper), familiar_range(arm)
    boxes = [limits] if nominal is not None or np.array_equal(familiar, limits) else [familiar, limits]
    start, where, sided = nominal, replace(conditions or Conditions(), orientation=turned), tuple[str, ...]()
    if start is None:
        middle = np.tile(np.add(*familiar) / 2.0, (len(goals), 1))
        start = search(Task(drawing, goals, middle, Conditions(orientation=turned), constraints), boxes, closest=False)
    if where.directions is None and len(start):  # effects whose error depends on the side that a joint comes from
        sided = tuple(sorted({e.name for e in model.effects if not {"directions", "past"}.isdisjoint(e.needs)}))
        past = past_from_order(start) if "past" in model.needs else None
        where = replace(where, directions=directions_from_order(start), past=past)
    commands = search(Task(model, goals, start, where, constraints, enough), boxes, keeps_branch=True)
    left = goals - model.position(commands, conditions=where) if len(goals) else goals
    missed = violations(constraints, commands)
    beyond = outside(arm, commands)
    if beyond is not None:  # nobody drives to what misses a constraint
        beyond = beyond & ~np.any(missed > 0.0, axis=1)[:, None]
    return Compensation(
        goals[:, POINT],
        start,
        commands if where.directions is None else commands - servo_shift(arm, where.directions),
        distances(left),
        arm.joint_types,
        turned,
        None if turned is None else np.linalg.norm(left[:, POINT.stop :], axis=1) / model.reach,
        names_at(constraints, commands),
        missed,
        beyond,
        rms,
        sided,
        enough,
        model.reach,
    )


def _checked(name: str, values: ArrayLike, columns: int) -> Array:
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != columns or not np.all(np.isfinite(array)):
        raise InputError(f"{name}: shape {array.shape}, allowed: (k, {columns}) finite numbers")
    return array


def violations(constraints: Constraints, postures: Array) -> Array:
    """(m, c) by how much postures (m, n) miss each of c constraints [mm]; 0: satisfied."""
    if not constraints or not len(postures):
        return np.zeros((len(postures), len(constraints)))
    missed = np.column_stack([-np.min(each.margin(postures), axis=1) for each in constraints])
    return np.where(missed > TOLERANCE, missed, 0.0)


def names_at(constraints: Constraints, postures: Array) -> tuple[tuple[str, ...], ...]:
    """(m, c) kinds of the constraints, where bodies keep apart with the two that come nearest to what they keep."""
    names = []
    for each in constraints if len(postures) else ():
        pairs = getattr(each, "pairs", ())
        worst = np.argmin(each.margin(postures), axis=1)
        names.append([f"{each.kind} of {' and '.join(pairs[k])}" if pairs else each.kind for k in worst.tolist()])
    return tuple(zip(*names, strict=True))


@dataclass(frozen=True, eq=False)
class Compensation(Documented):
    """Joint commands for k targets.

    targets : (k, d) [mm];  orientations : (k, 3, 3) of the tool for the instrument, None: any will do
    nominal : (k, n) postures [rad] that would reach them on the nominal arm
    commands : (k, n) postures [rad] for the real arm, within the joint limits; the nearest found where unreachable, at
        angles of the identification where no nominal postures were given
    errors : (k,) distance of the real arm's tip from the target [mm], by the calibrated model
    angles : (k,) between the orientation wanted and that of the tool [rad], None: any will do
    joint_types : (n) of the arm, empty: all revolute
    constraints : (k, c) names of those given;  violations : (k, c) by how much each command misses them [mm]
    outside : (k, n) True where a joint is outside the angles of the identification, None: these are not known
    model_rms : [mm] that the calibrated model left of its own measurements, None: not known
    sided : effects of the model for which the order of the targets was taken as that of the approach
    tolerance : [mm] what counts as reached;  reach : of the arm [mm], at which an angle is that far
    """

    targets: Array
    nominal: Array
    commands: Array
    errors: Array
    joint_types: tuple[str, ...] = ()
    orientations: Array | None = None
    angles: Array | None = None
    constraints: tuple[tuple[str, ...], ...] = ()
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
    def near(self) -> NDArray[np.bool_]:
        """(k,) True where the error is at most `tolerance`, the angle no more at full reach, or 1e-8 rad."""
        near = self.errors <= self.tolerance
        return near if self.angles is None else near & (self.angles <= max(1e-8, self.tolerance / self.reach))

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(k,) True where it is near, and every constraint holds."""
        return self.near if self.violations is None else self.near & ~np.any(self.violations > 0.0, axis=1)

    @property
    def messages(self) -> list[str]:
        """(k) why a target is not reached; empty where it is."""
        messages = []
        for k, (error, near) in enumerate(zip(self.errors, self.near, strict=True)):
            familiar = self.outside is not None and not self.outside[k].any()
            nearest = f"the nearest posture{' (within the angles identified)' if familiar else ''} misses it by"
            by = f"{error:.4g} mm{'' if self.angles is None else f' and {np.degrees(self.angles[k]):.4g} deg'}"
            clauses = [] if near else [f"out of reach within the joint limits: {nearest} {by}"]
            missed = () if self.violations is None else self.violations[k]
            names = self.constraints[k] if self.constraints else ()
            for number, (name, size) in enumerate(zip(names, missed, strict=True), start=1):
                clauses += [f"constraint {number} ({name}) is missed by {size:.4g} mm"] if size > 0.0 else []
            messages.append("; ".join(clauses))
        return messages

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

    def text(self) -> str:
        """CSV `q1_deg..qn_deg, x_mm, y_mm, error_mm, reachable`: joint commands, empty where none may be driven to, the
        targets, and what is left [mm]; of poses `rx_deg..` and `error_deg`, and `message` where any says why not."""
        columns = posture_columns(self.safe_commands, self.joint_types or None)
        columns |= {f"{axis}_mm": column for axis, column in zip("xyz", self.targets.T, strict=False)}
        columns |= {} if self.orientations is None else angle_columns(self.orientations)
        columns["error_mm"] = self.left
        columns |= {} if self.left_angles is None else {"error_deg": np.degrees(self.left_angles)}
        columns["reachable"] = self.reached.astype(int)
        return csv_text(columns | ({"message": np.array(self.messages)} if any(self.messages) else {}))

    @property
    def warnings(self) -> list[str]:
        """What must be known of the commands, in sentences."""
        outside = extrapolated(self.outside, "targets")
        notes = [] if outside is None else [f"{outside}, and the error that is left may be larger than it says"]
        # of more than half of the targets out of reach, the frame or the unit is likelier to be wrong than each of them
        if (out := np.count_nonzero(~self.near)) > 0.5 * len(self.targets):
            frame = "are they in mm, and in the frame of the measurements that calibrated the arm"
            notes.append(f"{out} of {len(self.targets)} targets are out of reach: {frame}?")
        if close := np.count_nonzero(self.reached & (self.errors > TOLERANCE)):
            most = f"by {float(np.max(self.errors[self.reached])):.2g} mm at most"
            least = f"less than the {self.tolerance:.2g} mm that the calibration itself is uncertain by"
            notes.append(f"{close} of the targets reached are missed {most}, {least}: no posture of the arm is nearer")
        if self.sided and self.reached.any():
            # how joints that all rise move as the controller counts
            counting, joints = counting_in(self.joint_types), self.commands.shape[1]
            moves = np.ones(joints) if counting is None else counting.signs_of_columns(np.ones((1, joints)))[0]
            falling = ", ".join(str(j) for j, sign in enumerate(moves, start=1) if sign < 0.0)
            rising = f"rising, but {falling} falling" if falling else "rising"
            side = f"{', '.join(self.sided)}: the error depends on the side that a joint comes from"
            notes.append(f"{side}. Drive the targets in this order, and to the first with every joint {rising}")
        return notes

    @property
    def commands_in_file_units(self) -> Array:
        """(k, n) [deg], of prismatic joints [mm], as the controller counts."""
        commands = in_columns(self.commands, self.joint_types)
        return np.where(self.turning, np.degrees(commands), commands)

    @property
    def turning(self) -> NDArray[np.bool_]:
        """(n,) True for revolute joints."""
        return np.array(self.joint_types or (REVOLUTE,) * self.commands.shape[1]) == REVOLUTE

    def to_json(self) -> dict[str, Any]:
        """Counts, the largest error over targets reached, the others, and a row for each target
        (identification/files/README.md, "JSON keys")."""
        reached, posed = self.reached, self.angles is not None
        degrees = np.degrees(self.errors if self.angles is None else self.angles)

        def where(shown: NDArray[np.bool_], rows: Array) -> list[Any]:
            """(k) rows, None where they are not to be said."""
            return [row if one else None for one, row in zip(shown.tolist(), rows.tolist(), strict=True)]

        columns = {
            "target": range(1, len(reached) + 1),
            "target_mm": self.targets.tolist(),
            "command": where(reached, self.commands_in_file_units),
            "error_mm": where(reached | ~self.near, self.errors),  # missed by that, if not barred
            **({"error_deg": where(reached | ~self.near, degrees)} if posed else {}),
            "reachable": reached.tolist(),
            "message": self.messages,
        }
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            "max_error_mm": float(np.max(self.errors[reached])) if reached.any() else None,
            "tolerance_mm": self.tolerance,
            "model_rms_mm": self.model_rms,
            **({"max_error_deg": float(np.max(degrees[reached])) if reached.any() else None} if posed else {}),
            "unreachable": (np.flatnonzero(~reached) + 1).tolist(),
            "warnings": self.warnings,
            "commands_deg": columns["command"],
            "commands": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        }

    def document(self) -> Document:
        """How many targets are reached and which are not, then joint commands for the first ones."""
        reached, near = self.reached, self.near
        verdict = f"{np.count_nonzero(reached)} of {len(self.targets)} targets reached by the calibrated model"
        if self.model_rms is not None:
            verdict += f" (RMS {self.model_rms:.4g} mm on its own measurements)"
        if self.angles is not None and reached.any():
            most = float(np.degrees(np.max(self.angles[reached])))
            verdict += f"; orientations are those wanted to {miss_text(most)} deg, by the same model"
        verdict += "."
        if missed := (np.flatnonzero(~reached) + 1).tolist():
            counts = {"out of reach": ~near, "barred by a constraint": near & ~reached}
            why = {reason: int(np.count_nonzero(which)) for reason, which in counts.items() if which.any()}
            counted = ", ".join(f"{count} {reason}" if len(why) > 1 else reason for reason, count in why.items())
            have = "have" if len(missed) > 1 else "has"
            verdict += f" {len(missed)} {have} no command (angles left empty): {counted} ({rows_listed(missed)})."
        reasons = [f"target {k} ! {message}" for k, message in enumerate(self.messages, start=1) if message]
        rest = [f"... and {len(reasons) - 24} more without a command; --out writes all"] if len(reasons) > 24 else []
        (_, joints), dimension = self.commands.shape, self.targets.shape[1]
        digits = 3 if joints + dimension <= 6 else 2  # of more joints and axes than 80 columns have room
        units = ["" if turns else " [mm]" for turns in self.turning]
        commands = np.where(reached[:, None], self.commands_in_file_units, np.nan)
        rows = command_rows(self.targets, commands, self.left, digits)
        headings = ["row", *"xyz"[:dimension], *(f"q{j}{unit}" for j, unit in enumerate(units, start=1)), "miss"]
        table = Sheet(headings, rows, "Targets and miss [mm], commands [deg]", 24)
        rounded = [] if digits == 3 else ["Rounded to 0.01 deg here; --out and --json give every digit."]
        return Document("Commands", [verdict], [table, *rounded, *reasons[:24], *rest], warnings=self.warnings)

    def __repr__(self) -> str:
        return f"Compensation({int(np.count_nonzero(self.reached))} of {len(self.targets)} targets reached)"


# -- inverse kinematics ------------------------------------------------------------------------------------------------
class Task(NamedTuple):
    """Goals (k, d) of a model [mm], of poses three coordinates more, and postures (k, n) that theirs are to be near.

    enough : [mm] what is nearly reached, where nothing gets there exactly
    """

    model: Model
    goals: Array
    near: Array
    conditions: Conditions
    constraints: Constraints = ()
    enough: float = TOLERANCE

    @property
    def redundant(self) -> bool:
        """Whether postures reach a goal in more ways than one by one."""
        return self.conditions.orientation is None and self.near.shape[1] > self.goals.shape[1]

    def at(self, rows: Index) -> Task:
        """Of some of the goals."""
        return self._replace(goals=self.goals[rows], near=self.near[rows], conditions=self.conditions.rows(rows))

    def within(self, limits: tuple[Array, Array]) -> Task:
        """With other limits of the joints; of those that do not move 1e-9 rad."""
        lower, upper = limits
        return self._replace(model=Model(replace(self.model.arm, lower=lower, upper=np.maximum(upper, lower + 1e-9))))

    @property
    def units(self) -> Array:
        """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
        return np.where(np.array(self.model.joint_types) == REVOLUTE, self.model.reach, 1.0)

    def gaps(self, postures: Array, rows: Index) -> tuple[Array, Array]:
        """Goals (k, d) of the rows less the positions of postures (k, n), and the positions' derivatives (k, d, n)."""
        table = self.model.condition_table(postures, self.conditions.rows(rows))
        values = np.broadcast_to(self.model.values, (len(postures), len(self.model.values)))
        tips, jacobian = self.model.expressions.posture_jacobian(postures, table, values)
        return self.goals[rows] - tips[..., 0], jacobian

    def descended(self, starts: Array, iterations: int = 60, *, clear: bool = False) -> tuple[Array, Array]:
        """Postures (k, s, n) within the limits to which the shortest steps lead from starts (k, s, n), and what they
        leave (k, s) [mm];  clear : with margins that are missed as further residuals, of a place 0.01 mm inside."""
        k, s, n = starts.shape
        bends = BEND * self.model.reach / self.units

        def gaps(postures: Array, rows: Index) -> tuple[Array, Array]:
            residual, jacobian = self.gaps(postures, rows // s)
            residuals, slopes = [residual], [jacobian]
            for constraint in self.constraints if clear else ():  # derivatives by differences
                margins = constraint.margin(postures)
                missed, slope = np.maximum(0.01 - margins, 0.0), np.zeros((*margins.shape, n))
                out = np.flatnonzero(missed.any(axis=1))
                bent = constraint.margin((postures[out, None] + np.diag(bends)).reshape(-1, n))
                slope[out] = np.swapaxes(bent.reshape(len(out), n, margins.shape[1]) - margins[out, None], 1, 2) / bends
                slope[missed == 0.0] = 0.0
                residuals.append(missed)
                slopes.append(slope)
            return (residual, jacobian) if not clear else (np.hstack(residuals), np.concatenate(slopes, axis=1))

        limits, rounding = (self.model.arm.lower, self.model.arm.upper), np.full(k * s, 1e-5 * TOLERANCE)
        problem = LeastSquares(gaps, *limits, self.units, rounding, metric=self.units, iterations=iterations)
        solution = levenberg_marquardt(problem, starts.reshape(-1, n))
        return solution.parameters.reshape(k, s, n), np.sqrt(solution.rss).reshape(k, s)

    def ranked(self, postures: Array, left: Array) -> tuple[Array, Array, Array]:
        """Postures (k, s, n), what they leave and ranks (k, s), best first: those that reach the goal by their distance
        from `near`; those that nearly do; those that miss constraints, by how much; the others, by what they leave."""
        distance = np.linalg.norm((postures - self.near[:, None]) * self.units / self.model.reach, axis=2)
        missed = violations(self.constraints, postures.reshape(-1, postures.shape[2])).sum(axis=1).reshape(left.shape)
        free = np.where(left > TOLERANCE, NEAR + left / (self.enough + left), distance / (1.0 + distance))
        rank = np.where(left > self.enough, BEYOND + left, np.where(missed > 0.0, MISSED + missed, free))
        order = np.argsort(rank, axis=1)
        left, rank = (np.take_along_axis(values, order, axis=1) for values in (left, rank))
        return np.take_along_axis(postures, order[:, :, None], axis=1), left, rank


def search(
    task: Task, boxes: Sequence[tuple[Array, Array]], *, keeps_branch: bool = False, closest: bool = True
) -> Array:
    """(k, n) postures that reach the goals within the first of the limits in which one does, of which the second hold
    the first; where none does, the closest to the goal within the first.

    keeps_branch : of the postures that reach a goal that to which `near` leads is taken, not the nearest to `near`
    closest : False: where none does, a posture near to the goal is enough
    """
    if len(task.near) > 1_000:
        parts = np.split(np.arange(len(task.near)), range(1_000, len(task.near), 1_000))
        return np.concatenate(
            [search(task.at(rows), boxes, keeps_branch=keeps_branch, closest=closest) for rows in parts]
        )
    inner, *outer = (task.within(limits) for limits in boxes)
    postures, rank = _tried_quickly(inner, keeps_branch)
    missed, beside = np.flatnonzero(rank >= MISSED), np.empty(0, dtype=int)
    if outer and missed.size:  # what is out of reach there is out of reach within the first, too
        wider = outer[0].at(missed)
        ends, ranks = _tried_thoroughly(wider, *_tried_quickly(wider, keeps_branch), all_seeds=closest)
        beside, missed = missed[ranks < MISSED], missed[ranks < BEYOND]
        ends = ends[ranks < MISSED]
    if missed.size:
        rest = inner.at(missed), postures[missed], rank[missed]
        postures[missed], rank[missed] = _tried_thoroughly(*rest, all_seeds=closest)
    if beside.size:
        only_there = rank[beside] >= MISSED
        postures[beside[only_there]], rank[beside[only_there]] = ends[only_there], NEAR
    if closest and (beyond := np.flatnonzero(rank >= BEYOND)).size:
        postures[beyond] = _closest(inner.at(beyond), postures[beyond])
    return postures


def _seeds(task: Task) -> Array:
    """(256, n) postures within the limits, always the same."""
    arm = task.model.arm
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (256, arm.links))


def _better(old: tuple[Array, Array], new: tuple[Array, Array]) -> tuple[Array, Array]:
    """Postures (k, n) and ranks (k,), those of the better rank. A branch that is nearer to a goal that is nearly
    reached, by less than anybody knows, is none to go to."""
    (postures, rank), (ends, ranks) = old, new
    better = ranks < np.where((rank >= NEAR) & (rank < MISSED), NEAR, rank)
    return np.where(better[:, None], ends, postures), np.where(better, ranks, rank)


def _tried_quickly(task: Task, keeps_branch: bool) -> tuple[Array, Array]:
    """(k, n) postures and (k,) ranks to which `near` and 32 seeds lead, of a redundant arm six."""
    arm, (k, n) = task.model.arm, task.near.shape
    task = task._replace(near=turned_into(task.near, arm.lower, arm.upper, task.model.joint_types))
    best = task.near.copy(), np.full(k, np.inf)
    if keeps_branch:
        ends, _, ranks = task.ranked(*task.descended(task.near[:, None]))
        best = _better(best, (ends[:, 0], ranks[:, 0]))
    rest, seeds = np.flatnonzero(best[1] >= NEAR), _seeds(task)
    if not rest.size:
        return best
    part, starts = task.at(rest), np.broadcast_to(seeds[:32], (len(rest), 32, n))
    if task.redundant:  # most seeds reach most goals: those whose linear steps to them end nearest
        origin = Task(task.model, np.zeros((256, task.goals.shape[1])), seeds, Conditions())
        gaps, jacobians = origin.gaps(seeds, np.arange(256))
        scale = task.units / task.model.reach
        shortest = np.linalg.pinv(jacobians / scale) / scale[:, None]  # (s, n, d)
        ends = seeds + np.einsum("snd,ksd->ksn", shortest, part.goals[:, None] + gaps)
        away = np.linalg.norm((np.clip(ends, arm.lower, arm.upper) - part.near[:, None]) * scale, axis=2)
        starts = seeds[np.argsort(away, axis=1, kind="stable")[:, :6]]
    tried = _tried(part, np.concatenate([part.near[:, None], starts], axis=1))
    for array, of_rest in zip(best, _better((best[0][rest], best[1][rest]), tried), strict=True):
        array[rest] = of_rest
    return best


def _tried_thoroughly(task: Task, postures: Array, rank: Array, *, all_seeds: bool) -> tuple[Array, Array]:
    """Better postures (k, n) and ranks (k,), of a redundant arm from the first 32 seeds, then from all."""
    arm, seeds = task.model.arm, _seeds(task)
    task = task._replace(near=turned_into(task.near, arm.lower, arm.upper, task.model.joint_types))
    if task.redundant and (rest := np.flatnonzero(rank >= BEYOND)).size:
        tried = _tried(task.at(rest), np.broadcast_to(seeds[:32], (len(rest), *seeds[:32].shape)))
        postures[rest], rank[rest] = _better((postures[rest], rank[rest]), tried)
    missed = np.flatnonzero((rank >= MISSED) & all_seeds)
    missed = missed[np.argsort(rank[missed], kind="stable")]
    for start in range(0, len(missed), 32):  # effort: those missed by least, while it helps
        rows = missed[start : start + 32]
        tried = _tried(task.at(rows), np.broadcast_to(seeds[32:], (len(rows), *seeds[32:].shape)))
        postures[rows], rank[rows] = _better((postures[rows], rank[rows]), tried)
        if np.all(rank[rows] >= MISSED):
            break
    return postures, rank


def _tried(task: Task, starts: Array) -> tuple[Array, Array]:
    """(k, n) the best postures that starts (k, s, n) lead to, and their ranks (k,): where all miss a constraint by what
    is missed as further residuals."""
    ends, _, rank = task.ranked(*task.descended(starts, QUICK))
    best, ranks = ends[:, 0], rank[:, 0]
    barred = (ranks >= MISSED) & (ranks < BEYOND)
    if ends.shape[2] > task.goals.shape[1] and barred.any():  # a redundant arm has more than the starts found
        part = task.at(np.flatnonzero(barred))
        clear = part.descended(ends[barred][:, :3], 8, clear=True)[0]  # of a few, more is effort
        further, _, better = part.ranked(*part.descended(clear, QUICK))
        gains = better[:, 0] < ranks[barred]
        rows = np.flatnonzero(barred)[gains]
        best[rows], ranks[rows] = further[gains, 0], better[gains, 0]
    return best, ranks


def _closest(task: Task, postures: Array) -> Array:
    """(k, n) the closest postures to goals out of reach, by Newton's method from postures (k, n) and from seeds."""
    arm, units = task.model.arm, task.model.reach / task.units
    seeds = np.broadcast_to(_seeds(task)[:32], (len(postures), 32, arm.links))
    starts = np.concatenate([postures[:, None], seeds], axis=1)
    starts = task.ranked(*task.descended(starts, QUICK))[0]
    # of starts that are nearly the same the first
    firsts = (np.sort(np.unique(np.round(ordered, 1), axis=0, return_index=True)[1]) for ordered in starts)
    kinds = [ordered[first] for ordered, first in zip(starts, firsts, strict=True)]
    goal = np.repeat(np.arange(len(kinds)), [len(kind) for kind in kinds])
    bends = np.concatenate([np.zeros((1, arm.links)), np.diag(BEND * units)])

    def height(q: Array, rows: Index) -> Array:
        return -0.5 * np.sum(task.gaps(q, goal[rows])[0] ** 2, axis=1)

    def slopes(q: Array, rows: Index) -> tuple[Array, Array]:
        bent = (q[:, None] + bends).reshape(-1, arm.links)
        gap, jacobian = task.gaps(bent, np.repeat(goal[rows], len(bends)))
        gap, jacobian = (each.reshape(len(q), len(bends), *each.shape[1:]) for each in (gap, jacobian))
        along = np.einsum("kd,kidn->kin", gap[:, 0], jacobian)
        bend = (along[:, 1:] - along[:, :1]) / (BEND * units[:, None])
        return along[:, 0], 0.5 * (bend + np.swapaxes(bend, 1, 2)) - np.swapaxes(jacobian[:, 0], 1, 2) @ jacobian[:, 0]

    ends = newton_ascent(np.concatenate(kinds), height, slopes, (arm.lower, arm.upper), units)
    order = np.lexsort((-height(ends, np.arange(len(ends))), goal))
    best = ends[order[np.unique(goal[order], return_index=True)[1]], None]
    return task.ranked(*task.descended(np.concatenate([best, postures[:, None]], axis=1), 1))[0][:, 0]
