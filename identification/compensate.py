"""Compensation: joint commands that bring the tip of the real arm, the calibrated model, to its targets.

Targets are positions, or poses of a spatial arm's tool, where an angle counts as the distance that it is at full reach.
Inverse kinematics is Levenberg-Marquardt on exact derivatives, all targets at once, from one start and then from many
(`best_of_seeds`). What no start reaches goes on by Newton's method; postures that miss a constraint are led away from
what is in the way, unless that is the target itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from identification.arm import Arm, Calibration
from identification.arrays import Array, frame_of, readonly
from identification.document import Document, Documented
from identification.documents.identification import compensation_document
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import Index, LeastSquares, Linearize, levenberg_marquardt
from identification.kinematics.corrected import standing_in
from identification.kinematics.counting import counting_in, in_columns, turned_into
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import POINT, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.model.placed import in_own_frame
from identification.newton import newton_ascent
from identification.origin import check_calibrated, extrapolated, familiar_range, identified, outside
from identification.sessions import BASE
from identification.simulate import servo_shift
from identification.workspace import PostureCondition

TOLERANCE = 1e-6  # [mm] a target is reached if the model comes this close; so near may a constraint be missed
MAX_ITERATIONS = 60
SEEDS = 32  # random postures per target where none is given, or where the nominal one leads nowhere
QUICK = 20  # iterations at first: 99 of 100 seeds that reach a target have reached it, the others creep along limits,
# and for a target out of reach damped least squares often end 1 % too far
MISSED = 1e3  # a rank from which a target is not reached, or constraints are missed
BEND = 1e-7  # [rad] of a joint, for second derivatives
APPROACH = {"directions", "past"}  # what an effect needs whose error depends on the side that a joint comes from
Constraints = Sequence[PostureCondition]
Tried = tuple[Array, Array, Array]  # of k goals, best first: postures (k, s, n), what they leave [mm] and rank (k, s)


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
    if orientations is not None and arm.chain.planar:
        raise InputError("orientations: found for a planar arm, allowed: for a spatial one")
    as_nominal = targets is None and orientations is None and arm.chain.angle_scale is not None
    turned = None if orientations is None else np.asarray(orientations, dtype=float).reshape(-1, 3, 3)
    arm, posed = in_own_frame(arm), turned is not None or as_nominal
    arm = replace(arm, chain=replace(arm.chain, angle_scale=arm.reach if posed else None))  # of an angle of a pose
    model, familiar, provenance = Model(arm), familiar_range(arm), identified(arm)
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
    where, sided = replace(conditions or Conditions(), orientation=turned), tuple[str, ...]()
    start = nominal
    if start is None:
        start = familiar_postures(drawing, familiar, goals, Conditions(orientation=turned), constraints)
    if where.directions is None and len(start):
        sided = tuple(sorted({effect.name for effect in model.effects if not APPROACH.isdisjoint(effect.needs)}))
        past = past_from_order(start) if model.remembers else None
        where = replace(where, directions=directions_from_order(start), past=past)
    commands = reaching(Task(model, goals, start, where, constraints), enough)
    left = goals - model.position(commands, conditions=where) if len(goals) else goals
    # found ones that are out of reach, where they are outside familiar angles: the nearest within them
    lower, upper = familiar
    strange = (np.linalg.norm(left, axis=1) > enough) & np.any((commands < lower) | (commands > upper), axis=1)
    if nominal is None and strange.any():
        # a joint that did not move has 1e-9 rad of room
        inside = Model(replace(model.arm, lower=lower, upper=np.maximum(upper, lower + 1e-9)))
        near = np.clip(commands[strange], lower, upper)
        task = Task(inside, goals[strange], near, where.rows(np.flatnonzero(strange)), constraints)
        commands[strange] = best_of_seeds(task)[0]
        left = goals - model.position(commands, conditions=where)
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
        tuple(each.kind for each in constraints),
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
    constraints : kinds of those given;  violations : (k, c) by how much each command misses them [mm]
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
            for number, (kind, size) in enumerate(zip(self.constraints, missed, strict=True), start=1):
                clauses += [f"constraint {number} ({kind}) is missed by {size:.4g} mm"] if size > 0.0 else []
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
        turning = np.array(self.joint_types or (REVOLUTE,) * self.commands.shape[1]) == REVOLUTE
        return np.where(turning, np.degrees(commands), commands)

    def to_json(self) -> dict[str, Any]:
        """Counts, largest errors over targets reached and over the others, unreached rows, and a row for each target
        (identification/files/README.md, "JSON keys")."""
        reached, commands, posed = self.reached, self.commands_in_file_units, self.angles is not None
        degrees = np.degrees(self.errors if self.angles is None else self.angles)
        unreachable = [int(row) + 1 for row in np.flatnonzero(~reached)]
        driven = reached | ~self.near  # or missed, by what is left

        def largest(values: Array, rows: NDArray[np.bool_]) -> float | None:
            return float(np.max(values[rows])) if rows.any() else None

        def where(shown: NDArray[np.bool_], rows: Array) -> list[Any]:
            """(k) rows, None where they are not to be said."""
            return [row if one else None for one, row in zip(shown.tolist(), rows.tolist(), strict=True)]

        columns = {
            "target": range(1, len(reached) + 1),
            "target_mm": self.targets.tolist(),
            "command": where(reached, commands),
            "nearest": where(~reached, commands),
            "error_mm": where(driven, self.errors),
            **({"error_deg": where(driven, degrees)} if posed else {}),
            "reachable": reached.tolist(),
            "message": self.messages,
        }
        beyond = None
        if (out := self.outside) is not None:  # targets and joints, from 1, beyond the angles of the identification
            counts = enumerate(out.sum(axis=0).tolist(), start=1)
            joints = [{"joint": joint, "targets": count} for joint, count in counts if count]
            beyond = {"targets": (np.flatnonzero(out.any(axis=1)) + 1).tolist(), "joints": joints}
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            "max_error_mm": largest(self.errors, reached),
            "max_error_over": "targets reached",
            "tolerance_mm": self.tolerance,
            "model_rms_mm": self.model_rms,
            "max_unreached_mm": largest(self.errors, ~self.near),
            **({"max_error_deg": largest(degrees, reached)} if posed else {}),
            "unreachable": unreachable,
            "unreachable_count": len(unreachable),
            "outside_identified": beyond,
            "warnings": self.warnings,
            "commands_deg": columns["command"],
            "commands": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        }

    def to_frame(self) -> Any:
        """A row for each target: `q1`.. [deg, mm], `x_mm`.., `error_mm`, `reachable`, `message`."""
        columns = {f"q{j}": values for j, values in enumerate(self.commands_in_file_units.T, start=1)}
        columns |= {f"{axis}_mm": values for axis, values in zip("xyz", self.targets.T, strict=False)}
        left: dict[str, Any] = {"error_mm": self.left, "reachable": self.reached, "message": self.messages}
        return frame_of(columns | left)

    def document(self) -> Document:
        """How many targets are reached and which are not, then joint commands for the first ones."""
        return compensation_document(self)

    def __repr__(self) -> str:
        return f"Compensation({int(np.count_nonzero(self.reached))} of {len(self.targets)} targets reached)"


# -- inverse kinematics ------------------------------------------------------------------------------------------------
class Task(NamedTuple):
    """Goals (k, d) of a model [mm], of poses three coordinates more, and postures (k, n) that theirs are to be near."""

    model: Model
    goals: Array
    near: Array
    conditions: Conditions
    constraints: Constraints = ()

    def at(self, rows: Index | NDArray[np.bool_]) -> Task:
        """Of some of the goals; rows may repeat."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        return self._replace(goals=self.goals[rows], near=self.near[rows], conditions=self.conditions.rows(rows))


def reaching(task: Task, enough: float) -> Array:
    """(k, n) postures, from many seeds where the search from near ends short of the goal, or where the arm may not
    stand. What ends so near as `enough` [mm] is left only for what gets there exactly: another branch of the arm that
    is nearer by less than anybody knows is none to go to."""
    arm = task.model.arm
    task = task._replace(near=turned_into(task.near, arm.lower, arm.upper, task.model.joint_types))
    commands, errors = inverse_kinematics(task, task.near)
    missed = violations(task.constraints, commands).sum(axis=1)
    short = np.flatnonzero((errors > TOLERANCE) | (missed > 0.0))
    if short.size:
        again, left = best_of_seeds(task.at(short))
        now = ranked(np.zeros(len(short)), left, violations(task.constraints, again).sum(axis=1))
        better = now < ranked(np.zeros(len(short)), errors[short], missed[short])
        better &= (errors[short] > enough) | (missed[short] > 0.0) | (left <= TOLERANCE)
        commands[short[better]] = again[better]
    return commands


def familiar_postures(
    model: Model, familiar: tuple[Array, Array], goals: Array, conditions: Conditions, constraints: Constraints
) -> Array:
    """(k, n) postures for goals (k, d) nearest to the middle of familiar angles, and where possible within them; the
    best found where no posture gets there."""
    lower, upper = familiar
    near = np.tile((lower + upper) / 2.0, (len(goals), 1))
    reached = best_of_seeds(Task(model, goals, near, conditions, constraints))[0]
    out = np.flatnonzero(np.any((reached < lower) | (reached > upper), axis=1))
    if np.any(lower >= upper):
        return reached
    inside = Task(Model(replace(model.arm, lower=lower, upper=upper)), goals, near, conditions)
    for starts in (np.clip(reached, lower, upper), near):
        if out.size:
            postures, left = inverse_kinematics(inside.at(out), starts[out])
            better = (left <= TOLERANCE) & ~violations(constraints, postures).any(axis=1)
            reached[out[better]] = postures[better]
            out = out[~better]
    return reached


def violations(constraints: Constraints, postures: Array) -> Array:
    """(m, c) by how much postures (m, n) miss each of c constraints [mm]; 0: satisfied."""
    if not constraints or not len(postures):
        return np.zeros((len(postures), len(constraints)))
    missed = np.column_stack([-np.min(each.margin(postures), axis=1) for each in constraints])
    return np.where(missed > TOLERANCE, missed, 0.0)


def inverse_kinematics(task: Task, starts: Array, iterations: int = MAX_ITERATIONS) -> tuple[Array, Array]:
    """Postures (k, n) within the limits and errors (k,) [mm], by Levenberg-Marquardt from starts (k, n); steps are the
    shortest in joint angles."""
    linearize = linearization(task.model, task.conditions)

    def gaps(postures: Array, rows: Index) -> tuple[Array, Array]:
        position, jacobian = linearize(postures, rows)
        return task.goals[rows] - position, jacobian

    return _least(task.model, gaps, starts, iterations)


def _least(model: Model, linearize: Linearize, starts: Array, iterations: int) -> tuple[Array, Array]:
    """(k, n) postures within the limits that make residuals least, from starts (k, n), and what they leave (k,)."""
    reach, negligible = metric(model), np.full(len(starts), 1e-5 * TOLERANCE)
    limits = model.arm.lower, model.arm.upper
    problem = LeastSquares(linearize, *limits, reach, negligible, metric=reach, iterations=iterations)
    solution = levenberg_marquardt(problem, starts)
    return solution.parameters, np.sqrt(solution.rss)


def metric(model: Model) -> Array:
    """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
    return np.where(np.array(model.joint_types) == REVOLUTE, model.reach, 1.0)


def linearization(model: Model, conditions: Conditions) -> Linearize:
    """Postures (k, n) and row numbers -> positions (k, d) and derivatives with respect to the posture (k, d, n)."""
    evaluate = model.expressions.posture_jacobian

    def linearize(postures: Array, rows: Index) -> tuple[Array, Array]:
        table = model.condition_table(postures, conditions.rows(rows))
        tips, jacobian = evaluate(postures, table, np.broadcast_to(model.values, (len(postures), len(model.values))))
        return tips[..., 0], jacobian

    return linearize


def ranked(distance: Array, left: Array, missed: Array) -> Array:
    """Of goals reached the distance; behind them what misses constraints, by how much; then what is left."""
    return np.where(left > TOLERANCE, 1e3 * MISSED + left, np.where(missed > 0.0, MISSED + missed, distance))


def tried(task: Task, seeds: Array, iterations: int = QUICK) -> Tried:
    """From `near` and from seeds (s, n), or (k, s, n) of each goal its own."""
    seeds = np.broadcast_to(seeds, (len(task.goals), *seeds.shape[-2:]))
    starts = np.concatenate([task.near[:, None], seeds], axis=1)
    k, s, n = starts.shape
    flat, left = inverse_kinematics(task.at(np.repeat(np.arange(k), s)), starts.reshape(-1, n), iterations)
    missed = violations(task.constraints, flat).sum(axis=1).reshape(k, s)
    reached, left = flat.reshape(k, s, n), left.reshape(k, s)
    distance = np.linalg.norm((reached - task.near[:, None]) * metric(task.model) / task.model.reach, axis=2)
    rank = ranked(distance, left, missed)
    order = np.argsort(rank, axis=1)
    left, rank = (np.take_along_axis(values, order, axis=1) for values in (left, rank))
    return np.take_along_axis(reached, order[:, :, None], axis=1), left, rank


def best_of_seeds(task: Task) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: of the solutions that reach a goal the nearest to `near`, else the closest.

    At first a few steps are made from each seed.
    """
    arm = task.model.arm
    # random postures, always the same
    seeds = np.random.default_rng(0).uniform(arm.lower, arm.upper, (256, arm.links))
    redundant = task.conditions.orientation is None and arm.links > task.goals.shape[1]
    postures, errors = np.empty_like(task.near), np.empty(len(task.goals))
    for start in range(0, len(task.goals), 1_000):  # targets at a time, times SEEDS starts
        rows = np.arange(start, min(start + 1_000, len(task.goals)))
        part = task.at(rows)
        chosen = seeds[:SEEDS]
        if redundant:  # reaches most goals from most seeds: the six whose linear steps to the goal end nearest
            positions, jacobians = linearization(task.model, Conditions())(seeds, np.arange(len(seeds)))
            scale = metric(task.model) / task.model.reach
            shortest = np.linalg.pinv(jacobians / scale) / scale[:, None]  # (s, n, d)
            steps = np.einsum("snd,ksd->ksn", shortest, part.goals[:, None] - positions)
            ends = np.clip(seeds + steps, arm.lower, arm.upper)
            away = np.linalg.norm((ends - part.near[:, None]) * scale, axis=2)
            chosen = seeds[np.argsort(away, axis=1, kind="stable")[:, :6]]
        first = tried(part, chosen)
        postures[rows], errors[rows] = first[0][:, 0], first[1][:, 0]
        rest = first[2][:, 0] >= MISSED
        if task.constraints and rest.any():
            rest[rest] = ~_barred(part.at(rest), *(values[rest] for values in first[:2]))
        if rest.any():
            again = first[0][rest], first[1][rest], first[2][rest]
            if task.constraints or redundant:
                again = tried(part.at(rest), seeds[:SEEDS], MAX_ITERATIONS if task.constraints else QUICK)
            postures[rows[rest]], errors[rows[rest]] = _led_on(part.at(rest), *again)
    missed = np.flatnonzero(errors > TOLERANCE) if not redundant else np.arange(0)
    missed = missed[np.argsort(errors[missed], kind="stable")]
    # effort: those missed by least with the other seeds, while there is progress
    for start in range(0, len(missed), 32):
        rows = missed[start : start + 32]
        reached, left = _led_on(task.at(rows), *tried(task.at(rows), seeds[SEEDS:]))
        better = left <= TOLERANCE
        if not better.any():
            break
        postures[rows[better]], errors[rows[better]] = reached[better], left[better]
    return postures, errors


def _barred(task: Task, postures: Array, left: Array) -> NDArray[np.bool_]:
    """(k,) where the goals themselves miss a constraint, as far as postures (k, s, n) that leave (k, s) tell: postures
    that reach a goal are different, and all miss some margin by the same amount."""
    reached = left <= TOLERANCE
    margins = np.column_stack([each.margin(postures.reshape(-1, postures.shape[2])) for each in task.constraints])

    def ends(values: Array) -> tuple[Array, Array]:
        """(k, c) largest and smallest of (k, s, c) over postures that reach the goal."""
        high, low = (np.where(reached[:, :, None], values, end) for end in (-np.inf, np.inf))
        return high.max(axis=1), low.min(axis=1)

    high, low = ends(margins.reshape(*left.shape, -1))
    # margins that differ by less than 1 % of what is missed are those of the target, whatever the posture
    same = np.any((high < -TOLERANCE) & (high - low <= 0.01 * -high), axis=1)
    # six witnesses must agree, and differ by 0.5 rad or mm of some joint
    spread = np.subtract(*ends(postures)).max(axis=1)
    return same & (np.count_nonzero(reached, axis=1) >= 6) & (spread > 0.5)


def _led_on(task: Task, postures: Array, left: Array, rank: Array) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors of goals that were tried: where no seed reaches one by Newton's method, where
    those that reach it miss constraints by what is missed as further residuals."""
    best, errors = postures[:, 0].copy(), left[:, 0].copy()
    beyond = errors > TOLERANCE
    missed = ~beyond & (rank[:, 0] >= MISSED) & bool(task.constraints)
    missed &= best.shape[1] > task.goals.shape[1]  # a redundant arm has more than the seeds found
    for which, further in ((beyond, _polished), (missed, _turned_away)):
        if which.any():
            best[which], errors[which] = further(task.at(which), postures[which])
    return best, errors


def _turned_away(task: Task, starts: Array) -> tuple[Array, Array]:
    """(k, n) postures and what they leave (k,): of those led from postures that miss constraints, starts (k, s, n),
    best first, to where they hold; the nearest to that where none gets there."""
    starts = starts[:, :4]  # a few seeds are led out of there, more is effort
    every, k, n = task.at(np.repeat(np.arange(len(starts)), starts.shape[1])), len(starts), starts.shape[2]
    linearize = linearization(task.model, every.conditions)
    bends = BEND * task.model.reach / metric(task.model)

    def gaps(postures: Array, rows: Index) -> tuple[Array, Array]:
        """Of the goal and, where a margin is missed, of a place 0.01 mm inside; derivatives by differences."""
        position, jacobian = linearize(postures, rows)
        residuals, slopes = [every.goals[rows] - position], [jacobian]
        for constraint in task.constraints:
            margins = constraint.margin(postures)
            missed, slope = np.maximum(0.01 - margins, 0.0), np.zeros((*margins.shape, n))
            out = np.flatnonzero(missed.any(axis=1))
            bent = constraint.margin((postures[out, None] + np.diag(bends)).reshape(-1, n))
            bent = bent.reshape(len(out), n, margins.shape[1])
            slope[out] = np.swapaxes(bent - margins[out, None], 1, 2) / bends
            slope[missed == 0.0] = 0.0
            residuals.append(missed)
            slopes.append(slope)
        return np.concatenate(residuals, axis=1), np.concatenate(slopes, axis=1)

    ends, _ = _least(task.model, gaps, starts.reshape(-1, n), MAX_ITERATIONS)
    ends, left = inverse_kinematics(every, ends)
    rank = ranked(np.zeros(len(left)), left, violations(task.constraints, ends).sum(axis=1)).reshape(k, -1)
    best = np.ravel_multi_index((np.arange(k), np.argmin(rank, axis=1)), rank.shape)
    return ends[best], left[best]


def _polished(task: Task, starts: Array) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: the closest to goals out of reach, within the limits, by Newton's method;
    starts (k, s, n), best first."""
    model, arm, units = task.model, task.model.arm, task.model.reach / metric(task.model)
    linearize = linearization(model, task.conditions)
    # of starts that are nearly the same the first
    firsts = (np.sort(np.unique(np.round(ordered, 1), axis=0, return_index=True)[1]) for ordered in starts)
    kinds = [ordered[first] for ordered, first in zip(starts, firsts, strict=True)]
    goal = np.repeat(np.arange(len(kinds)), [len(kind) for kind in kinds])
    bends = np.concatenate([np.zeros((1, arm.links)), np.diag(BEND * units)])

    def height(q: Array, rows: Index) -> Array:
        return -0.5 * np.sum((linearize(q, goal[rows])[0] - task.goals[goal[rows]]) ** 2, axis=1)

    def slopes(q: Array, rows: Index) -> tuple[Array, Array]:
        bent = (q[:, None] + bends).reshape(-1, arm.links)
        position, jacobian = linearize(bent, np.repeat(goal[rows], len(bends)))
        gap = task.goals[goal[rows]] - position.reshape(len(q), len(bends), -1)[:, 0]
        jacobian = jacobian.reshape(len(q), len(bends), *jacobian.shape[1:])
        along = np.einsum("kd,kidn->kin", gap, jacobian)
        bend = (along[:, 1:] - along[:, :1]) / (BEND * units[:, None])
        return along[:, 0], 0.5 * (bend + np.swapaxes(bend, 1, 2)) - np.swapaxes(jacobian[:, 0], 1, 2) @ jacobian[:, 0]

    ends = newton_ascent(np.concatenate(kinds), height, slopes, (arm.lower, arm.upper), units)
    order = np.lexsort((-height(ends, np.arange(len(ends))), goal))
    return inverse_kinematics(task, ends[order[np.unique(goal[order], return_index=True)[1]]])
