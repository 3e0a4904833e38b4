"""Compensation: joint commands that bring the tip of the real arm, the calibrated model, to its targets.

    min |g_k - f(q_k)|^2   within the joint limits,   q_k near a posture that is given,   constraints(q_k) >= 0

Targets are positions, or poses of a spatial arm's tool, where an angle counts as the distance that it is at full reach.
Searches are Levenberg-Marquardt on exact derivatives, all targets at once: from the posture given, and where that does
not get there from random ones whose tips are nearest. Out of reach the nearest posture is found by Newton's method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from identification.arm import SERVO, Arm, Calibration
from identification.arrays import Array, ReadOnly, rows_in_words
from identification.document import Document, Documented, Sheet, number
from identification.documents.identification import extrapolated
from identification.errors import InputError, require
from identification.files.csv import csv_text
from identification.files.measurement import angle_columns, posture_columns
from identification.instruments import Tracker
from identification.kinematics.counting import range_of, turned_into
from identification.kinematics.parameters import REVOLUTE
from identification.levenberg_marquardt import Index, levenberg_marquardt, newton_ascent
from identification.measurements import POINT, REMEMBERED, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.model.placed import in_own_frame

TOLERANCE = 1e-6  # [mm] a target is reached if the model comes this close; so near may a constraint be missed
QUICK = 20  # steps from a start: 99 of 100 that reach a target have reached it, the others creep along limits
NEAR, MISSED, BEYOND = 1.0, 2.0, 1e9  # ranks from which a goal is reached nearly, not for constraints, not at all
FEW = 4  # postures that are kept for each goal
BEND = 1e-7  # [rad] of a joint, for derivatives by differences
SEEDS, NEAREST = 256, 16  # random postures, and how many of them each goal is searched from
AT_ONCE = 8_000  # searches, for memory
Constraints = Sequence[Any]  # conditions on postures, see `compensate`


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
    postures : (k, n) nominal joint commands [rad], which the commands stay near; left out: where the search starts is
        the middle of the angles of the identification, which the commands stay within where that is possible; where
        these are not known, of the limits
    conditions : payload, temperature and the like of every row; directions follow from the order of the rows. What
        happened once in the session of the identification is over, as for `validate`, where no times are given
    orientations : (k, 3, 3) axes of a spatial arm's tool for the instrument at the targets; left out: any will do, but
        that where targets are left out, too, an arm that measures orientations keeps those of its nominal postures
    constraints : that commands keep to: each has a `kind`, its name in messages, and `margin` of postures (m, n), which
        are (m, k) [mm] and to be >= 0, as those of `doe.problem.constraints.constraints_of(Model(arm))`

    Where the arm has servo errors they are taken off the commands: the joints are to be read where the tip is right.

    Raises `InputError` for an arm without calibration and for shapes or values that do not fit.
    """
    arm.require_calibrated()
    keeps_nominal = targets is None and orientations is None and arm.chain.angle_scale is not None
    posed, arm = orientations is not None or keeps_nominal, in_own_frame(arm)
    arm = replace(
        arm, chain=replace(arm.chain, instrument=Tracker(arm.reach if posed else None))
    )  # of an angle of a pose
    model = Model(arm)
    nominal = None if postures is None else _checked("postures", postures, arm.links)
    if targets is not None:
        points = _checked("targets", targets, arm.dimension)
    elif nominal is None:
        raise InputError(f"targets: none given, allowed: positions (k, {arm.dimension}) or postures (k, n)")
    else:
        # the nominal arm, without effects; where its base is not given it stands where the calibration has it, a planar
        # one turned by the offset of joint 1, and a spatial one with its points
        chain = arm.chain if arm.calibration is None else arm.chain.standing_in(arm.calibration.values)
        stands = tuple(spec for spec in arm.effects if spec.name in chain.standing_effects)
        place = Calibration({name: model.best_known.get(name, 0.0) for name in chain.standing}) if stands else None
        drawing = Model(replace(arm, effects=stands, calibration=place, chain=chain))
        points = drawing.position(nominal)[:, POINT]
        orientations = drawing.orientations(nominal) if keeps_nominal else orientations
    turned = None if orientations is None else np.asarray(orientations, dtype=float).reshape(-1, 3, 3)
    for name, rows in (("postures", nominal), ("orientations", turned)):
        number = len(points) if rows is None else len(rows)
        require(number == len(points), f"{name}: {number} rows for {len(points)} targets, allowed: as many")
    # where no posture gets to a target, as of an arm with fewer joints than coordinates, it counts as reached within
    # what one in a thousand of the calibration's own measurements may be off, by what the fit left and is unsure of
    likely = math.hypot(*(arm.provenance.get(key) or 0.0 for key in ("rms_after_mm", "expected_tip_mm")))
    tolerance = max(TOLERANCE, float(likely * np.sqrt(chdtri(arm.dimension, 1e-3) / arm.dimension)))
    goals = np.pad(points, ((0, 0), (0, model.dimension - arm.dimension)))  # of poses three zeros more
    # angles of the identification, moved by whole turns into the limits, and these, where those are not known
    familiar = limits = arm.lower, arm.upper
    if (ends := range_of(arm.provenance, arm.joint_types)) is not None:
        middle = ends.mean(axis=0)
        turns = turned_into(middle[None], *limits, arm.joint_types)[0] - middle
        # 2 % of a joint's range at either end are left for the corrections of a posture
        low, high = np.clip(middle + (1.0 - 2.0 * 0.02) * (ends - middle) + turns, *limits)
        familiar = low, high
    boxes = [limits] if nominal is not None or np.array_equal(familiar, limits) else [familiar, limits]
    where, (tip, *others) = replace(conditions or Conditions(), orientation=turned), arm.chain.tools
    assumed = [f"targets are for measured point {tip}, not for {', '.join(others)}"] if others else []
    if where.time is None and (once := [effect.key for effect in model.effects if effect.once]):
        where = where.afterwards(len(goals))
        assumed.append(f"{', '.join(once)}: the value at the end of the session of the identification is used")
    if where.temperature is None and (warm := [e.key for e in model.effects if "temperature" in e.needs]):
        mean = arm.provenance.get("mean_temperature_C")
        at = "" if mean is None else f", {float(mean):.1f} deg C"
        assumed.append(f"{', '.join(warm)}: taken at the mean temperature of the identification{at}")
    if where.payload is None and (loaded := [e.key for e in model.effects if "gravity" in e.needs]):
        assumed.append(f"{', '.join(loaded)}: taken with the payload of the arm file, {arm.payload:g} kg")
    if arm.chain.instrument.reads_positions and (read := [e.key for e in model.effects if hasattr(e, "instrument")]):
        assumed.append(f"{', '.join(read)}: an instrument error, which targets are assumed to have, as readings do")
    near = np.tile(np.add(*familiar) / 2.0, (len(goals), 1)) if nominal is None else nominal
    task, sided = Task(model, goals, near, where, *limits, constraints, tolerance), tuple[str, ...]()
    commands, driven = task.reached_within(boxes)
    if where.directions is None and driven.any():  # effects whose error depends on the side that a joint comes from
        sided = tuple(sorted({e.name for e in model.effects if not {"directions", "past"}.isdisjoint(e.needs)}))
        # that of the target before which is driven to, which others are not
        directions, past = np.ones_like(commands), np.repeat(commands[:, :, None], REMEMBERED, axis=2)
        directions[driven] = directions_from_order(commands[driven])
        from_afar = commands[driven][:1] - (arm.upper - arm.lower)  # what the first is come from, rising
        past[driven] = past_from_order(np.concatenate([from_afar, commands[driven]]))[1:]
        where = replace(where, directions=directions, past=past)
        rising, falling = (commands + arm.servo_shift(side * np.ones_like(commands)) for side in (1.0, -1.0))
        apart = model.position(rising, conditions=where) - model.position(falling, conditions=where)
        sided += (SERVO,) if distances(apart).max() > 0.1 * likely else ()  # convention: what counts beside the rest
    if sided:
        commands, _ = task._replace(near=commands, conditions=where).reached_within(boxes)
    left = goals - model.position(commands, conditions=where) if len(goals) else goals
    angles = None if turned is None else np.linalg.norm(left[:, POINT.stop :], axis=1) / model.reach
    missed = [list[str]() for _ in goals]  # constraints, of bodies with the two that come nearest to what they keep
    for order, each in enumerate(constraints if len(goals) else (), start=1):
        margins, pairs = each.margin(commands), getattr(each, "pairs", ())
        for k in np.flatnonzero(margins.min(axis=1, initial=np.inf) < -TOLERANCE).tolist():
            worst = int(np.argmin(margins[k]))
            by = f"{-margins[k, worst]:.4g} mm"
            of_bodies = f"{' and '.join(pairs[worst])} are {by} too close to each other" if pairs else ""
            missed[k].append(of_bodies or f"constraint {order} ({each.kind}) is missed by {by}")
    barred = tuple("; ".join(clauses) for clauses in missed)
    if where.directions is not None:
        commands = commands - arm.servo_shift(where.directions)
    errors, given = distances(left), commands if nominal is None else turned_into(nominal, *limits, arm.joint_types)
    apart = (np.abs(commands - given) > 0.5 * np.pi)[:, [kind == REVOLUTE for kind in arm.joint_types]]
    if (other := np.any(apart, axis=1) & (errors <= tolerance)).any():
        assumed.append(f"{rows_in_words(other)}: a joint is more than 90 deg from the posture given; try the way there")
    return Compensation(arm, points, commands, errors, barred, turned, angles, sided, tolerance, tuple(assumed))


def _checked(name: str, values: ArrayLike, columns: int) -> Array:
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != columns or not np.all(np.isfinite(array)):
        raise InputError(f"{name}: shape {array.shape}, allowed: (k, {columns}) finite numbers")
    return array


def miss_text(error: float) -> str:
    """What the calibrated model misses, [mm] or [deg], not to be read as the robot's accuracy; a dash for NaN."""
    return "< 1e-6" if error < 1e-6 else f"{error:.0f}" if error >= 100.0 else number(error)


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(Documented, ReadOnly):
    """Joint commands for k targets.

    arm : the calibrated arm
    targets : (k, d) [mm]
    commands : (k, n) postures [rad] for the real arm, within the joint limits; the nearest found where unreachable, at
        angles of the identification where no nominal postures were given
    errors : (k,) distance of the real arm's tip from the target [mm], by the calibrated model
    barred : (k) constraints that a command misses, in words, empty where all hold
    orientations : (k, 3, 3) of the tool for the instrument, None: any will do
    angles : (k,) between the orientation wanted and that of the tool [rad], None: any will do
    sided : effects of the model for which the order of the targets was taken as that of the approach
    tolerance : [mm] what counts as reached
    assumed : sentences on the conditions that were taken because none were given
    """

    arm: Arm
    targets: Array
    commands: Array
    errors: Array
    barred: tuple[str, ...]
    orientations: Array | None = None
    angles: Array | None = None
    sided: tuple[str, ...] = ()
    tolerance: float = TOLERANCE
    assumed: tuple[str, ...] = ()

    @property
    def near(self) -> NDArray[np.bool_]:
        """(k,) True where the error is at most `tolerance`, the angle no more at full reach, or 1e-8 rad."""
        near = self.errors <= self.tolerance
        return near if self.angles is None else near & (self.angles <= max(1e-8, self.tolerance / self.arm.reach))

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(k,) True where it is near, and every constraint holds."""
        return self.near & (np.array(self.barred, dtype=str) == "")

    @property
    def outside(self) -> NDArray[np.bool_] | None:
        """(k, n) True where a joint is outside the angles of the identification, None: these are not known. Not where a
        constraint is missed: nobody drives there."""
        out = self.arm.outside(self.commands)
        return None if out is None else out & (np.array(self.barred, dtype=str) == "")[:, None]

    @property
    def messages(self) -> list[str]:
        """(k) why a target is not reached; empty where it is."""
        messages, out = [], self.outside
        for k, (error, near, barred) in enumerate(zip(self.errors, self.near, self.barred, strict=True)):
            nearest = f"the nearest posture{'' if out is None or out[k].any() else ' (within the angles identified)'}"
            by = f"{error:.4g} mm{'' if self.angles is None else f' and {np.degrees(self.angles[k]):.4g} deg'}"
            far = "" if near else f"out of reach within the joint limits: {nearest} misses it by {by}"
            messages.append("; ".join(filter(None, [far, barred])))
        return messages

    @property
    def safe_commands(self) -> Array:
        """(k, n) as `commands`, NaN where the target is not reached: no controller may be fed with these."""
        return np.where(self.reached[:, None], self.commands, np.nan)

    @property
    def misses(self) -> dict[str, Array]:
        """`error_mm`, of poses `error_deg`: (k,) what is left, NaN where a constraint keeps from driving there."""
        left = {"error_mm": self.errors} | ({} if self.angles is None else {"error_deg": np.degrees(self.angles)})
        return {name: np.where(self.near & ~self.reached, np.nan, column) for name, column in left.items()}

    def text(self) -> str:
        """CSV `q1_deg..qn_deg, x_mm, y_mm, error_mm, reachable`: joint commands, empty where none may be driven to, the
        targets, and what is left [mm]; of poses `rx_deg..` and `error_deg`, and `message` where any says why not."""
        columns = posture_columns(self.safe_commands, self.arm.joint_types)
        columns |= {f"{axis}_mm": column for axis, column in zip("xyz", self.targets.T, strict=False)}
        columns |= {} if self.orientations is None else angle_columns(self.orientations)
        columns |= {**self.misses, "reachable": self.reached.astype(int)}
        return csv_text(columns | ({"message": np.array(self.messages)} if any(self.messages) else {}))

    @property
    def warnings(self) -> list[str]:
        """What must be known of the commands, in sentences."""
        beyond = extrapolated(self.outside, "targets")
        notes = [] if beyond is None else [f"{beyond}, and the remaining error may be larger than stated"]
        # of more than half of the targets out of reach, the frame or the unit is likelier to be wrong than each of them
        if (out := np.count_nonzero(~self.near)) > 0.5 * len(self.targets):
            frame = "are they in mm, and in the frame of the measurements that calibrated the arm"
            notes.append(f"{out} of {len(self.targets)} targets are out of reach: {frame}?")
        if close := np.count_nonzero(self.reached & (self.errors > TOLERANCE)):
            most = f"by {float(np.max(self.errors[self.reached])):.2g} mm at most"
            least = f"within the {self.tolerance:.2g} mm that 999 of 1,000 measured positions are off by"
            notes.append(f"{close} of the reached targets are missed {most}, {least}: no posture comes closer")
        notes += self.assumed if self.reached.any() else ()
        if self.sided and self.reached.any():
            # how columns of the controller move if all joints rise: q_j = sign_j c_j -+ sign_k c_k where coupled
            counting = self.arm.counting
            falling = ", ".join(str(j) for j, sign in enumerate(counting.sign, start=1) if sign < 0)
            rising = f"rising, but {falling} falling" if falling else "rising"
            rising += "".join(f", {j} by more than {k}" for j, k in enumerate(counting.coupled_to, start=1) if k > 0)
            side = f"{', '.join(self.sided)}: the error depends on the approach direction"
            notes.append(
                f"{side}. Approach the targets in this order, and the first from a distance with every joint {rising}"
            )
        return notes

    def to_json(self) -> dict[str, Any]:
        """Counts, the largest error reached, a row for each target (identification/files/README.md, "JSON keys")."""
        reached, angles = self.reached, posture_columns(self.commands, self.arm.joint_types)
        rows = np.column_stack([*angles.values()]).tolist()
        commands = [row if drive else None for row, drive in zip(rows, reached.tolist(), strict=True)]
        columns = {"target": range(1, len(reached) + 1), "target_mm": self.targets.tolist(), "command": commands}
        columns |= {key: [None if np.isnan(x) else x for x in left.tolist()] for key, left in self.misses.items()}
        columns |= {"reachable": reached.tolist(), "message": self.messages}
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            **{f"max_{key}": float(x[reached].max()) if reached.any() else None for key, x in self.misses.items()},
            "tolerance_mm": self.tolerance,
            "model_rms_mm": self.arm.provenance.get("rms_after_mm"),
            "unreachable": (np.flatnonzero(~reached) + 1).tolist(),
            "warnings": self.warnings,
            "commands_deg": commands,
            "commands": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        }

    def document(self) -> Document:
        """How many targets are reached and which are not, then joint commands for the first ones."""
        reached, near = self.reached, self.near
        verdict = f"{np.count_nonzero(reached)} of {len(self.targets)} targets reached by the calibrated model"
        if (rms := self.arm.provenance.get("rms_after_mm")) is not None:
            verdict += f" (RMS {rms:.4g} mm on its own measurements)"
        if self.angles is not None and reached.any():
            most = float(np.degrees(np.max(self.angles[reached])))
            verdict += f"; orientations are reached to {miss_text(most)} deg, by the same model"
        verdict += "."
        if missed := int(np.count_nonzero(~reached)):
            counts = {"out of reach": np.sum(~near), "blocked by a constraint": np.sum(near & ~reached)}
            why = [f"{count} {reason}" for reason, count in counts.items() if count]
            counted = ", ".join(why) if len(why) > 1 else why[0].partition(" ")[2]
            have = "have" if missed > 1 else "has"
            verdict += f" {missed} {have} no command (angles left empty): {counted} ({rows_in_words(~reached)})."
        reasons = [f"target {k} ! {message}" for k, message in enumerate(self.messages, start=1) if message]
        rest = [f"... and {len(reasons) - 24} more without a command; --out writes all"] if len(reasons) > 24 else []
        commands, dimension = posture_columns(self.safe_commands, self.arm.joint_types), self.targets.shape[1]
        digits = 3 if len(commands) + dimension <= 6 else 2  # of more joints and axes than 80 columns have room
        rows = [
            [str(row), *(f"{x:.{digits - 2}f}" for x in target), *(number(q, digits) for q in command), miss_text(miss)]
            for row, (target, command, miss) in enumerate(
                zip(self.targets, np.column_stack([*commands.values()]), self.misses["error_mm"], strict=True), start=1
            )
        ]
        joints = [name.replace("_deg", "").replace("_mm", " [mm]") for name in commands]
        table = Sheet(["row", *"xyz"[:dimension], *joints, "miss"], rows, "Targets and miss [mm], commands [deg]", 24)
        rounded = [] if digits == 3 else ["Rounded to 0.01 deg here; --out and --json give every digit."]
        return Document("Commands", [verdict], [table, *rounded, *reasons[:24], *rest], warnings=self.warnings)


# -- inverse kinematics ------------------------------------------------------------------------------------------------
class Task(NamedTuple):
    """Goals (k, d) of a model [mm], of poses three coordinates more, and postures (k, n) that theirs are to be near,
    within the limits (n,);  enough : [mm] what is nearly reached, where nothing gets there exactly"""

    model: Model
    goals: Array
    near: Array
    conditions: Conditions
    lower: Array
    upper: Array
    constraints: Constraints
    enough: float

    @property
    def units(self) -> Array:
        """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
        return np.where(np.array(self.model.joint_types) == REVOLUTE, self.model.reach, 1.0)

    def at(self, rows: Index) -> Task:
        """Of some of the goals."""
        return self._replace(goals=self.goals[rows], near=self.near[rows], conditions=self.conditions.rows(rows))

    def reached_within(self, boxes: Sequence[tuple[Array, Array]]) -> tuple[Array, NDArray[np.bool_]]:
        """(k, n) postures that reach the goals within the first of the limits in which one does; where none does, the
        closest to the goal within the first. And (k,) where one does."""
        kinds = self.model.joint_types
        first, *wider = (
            self._replace(near=turned_into(self.near, low, high, kinds), lower=low, upper=np.maximum(high, low + 1e-9))
            for low, high in boxes
        )
        postures, ranks = first.searched()
        for part in wider:
            missed = np.flatnonzero(ranks[:, 0] >= MISSED)
            ends, ranks_within = part.at(missed).searched()
            good = ranks_within[:, 0] < MISSED
            postures[missed[good]], ranks[missed[good]] = ends[good], NEAR
        if (beyond := np.flatnonzero(ranks[:, 0] >= BEYOND)).size:
            postures[beyond, 0] = first.at(beyond).closest(postures[beyond])
        return postures[:, 0], ranks[:, 0] < MISSED

    def searched(self) -> tuple[Array, Array]:
        """The best few postures (k, f, n) and their ranks (k, f): what `near` leads to; of goals not reached what
        the seeds with the nearest tips do, and more of them where constraints are missed."""
        k, n = self.near.shape
        postures, ranks = np.repeat(self.near[:, None], FEW, axis=1), np.full((k, FEW), np.inf)
        seeds = np.random.default_rng(0).uniform(self.lower, self.upper, (SEEDS, n))
        for count, bad in ((1, 0.0), (NEAREST, NEAR), (4 * NEAREST, MISSED)):
            missed = np.flatnonzero(ranks[:, 0] >= bad)
            for rows in np.split(missed, range(AT_ONCE // count, len(missed), AT_ONCE // count)) if len(missed) else ():
                part, starts = self.at(rows), self.near[rows, None]
                if bad:
                    away, _ = part.gaps(np.tile(seeds, (len(rows), 1)), np.repeat(np.arange(len(rows)), SEEDS))
                    order = np.argsort(np.linalg.norm(away, axis=1).reshape(-1, SEEDS), axis=1)
                    starts = seeds[order[:, :count]]
                ends = zip((postures[rows], ranks[rows]), part.descended(starts), strict=True)
                every, ranked = (np.concatenate(each, axis=1) for each in ends)
                order = np.argsort(ranked, axis=1, kind="stable")[:, :FEW]
                postures[rows] = np.take_along_axis(every, order[:, :, None], axis=1)
                ranks[rows] = np.take_along_axis(ranked, order, axis=1)
        return postures, ranks

    def descended(self, starts: Array) -> tuple[Array, Array]:
        """Postures (k, s, n) to which the shortest steps lead from starts (k, s, n), and ranks (k, s): those that
        reach the goal by their distance from `near`; then those that nearly do; those that miss constraints, by how
        much; the others, by what they leave."""
        k, s, n = starts.shape
        solution = levenberg_marquardt(
            lambda q, rows: self.gaps(q, rows // s),
            starts.reshape(-1, n),
            lower=self.lower,
            upper=self.upper,
            scales=self.units,
            rounding=np.full(k * s, 1e-5 * TOLERANCE),
            metric=self.units,
            iterations=QUICK,
        )
        postures, left = solution.parameters.reshape(k, s, n), np.sqrt(solution.rss).reshape(k, s)
        distance = np.linalg.norm((postures - self.near[:, None]) * self.units / self.model.reach, axis=2)
        missed = np.zeros((k, s))
        for constraint in self.constraints:
            by = -constraint.margin(solution.parameters).min(axis=1, initial=np.inf).reshape(k, s)
            missed += np.where(by > TOLERANCE, by, 0.0)
        rank = NEAR * (left > TOLERANCE) + distance / (1.0 + distance)
        rank = np.where(left > self.enough, BEYOND + left, np.where(missed > 0.0, MISSED + missed, rank))
        return postures, rank

    def gaps(self, postures: Array, rows: Index) -> tuple[Array, Array]:
        """Goals (k, d) of the rows less the positions of postures (k, n), and the positions' derivatives (k, d, n)."""
        table = self.model.condition_table(postures, self.conditions.rows(rows))
        values = np.broadcast_to(self.model.values, (len(postures), len(self.model.values)))
        tips, jacobian = self.model.expressions.posture_jacobian(postures, table, values)
        return self.goals[rows] - tips[..., 0], jacobian

    def closest(self, starts: Array) -> Array:
        """(k, n) the closest postures to goals out of reach, by Newton's method from several each (k, f, n)."""
        (k, few, n), units = starts.shape, self.model.reach / self.units
        goal, bends = np.repeat(np.arange(k), few), np.concatenate([np.zeros((1, n)), np.diag(BEND * units)])

        def height(q: Array, rows: Index) -> Array:
            return -0.5 * np.sum(self.gaps(q, goal[rows])[0] ** 2, axis=1)

        def slopes(q: Array, rows: Index) -> tuple[Array, Array]:
            gap, jacobian = self.gaps((q[:, None] + bends).reshape(-1, n), np.repeat(goal[rows], len(bends)))
            gap, jacobian = (each.reshape(len(q), len(bends), *each.shape[1:]) for each in (gap, jacobian))
            along = np.einsum("kd,kidn->kin", gap[:, 0], jacobian)
            bend = (along[:, 1:] - along[:, :1]) / (BEND * units[:, None])
            middle = jacobian[:, 0]
            return along[:, 0], 0.5 * (bend + np.swapaxes(bend, 1, 2)) - np.swapaxes(middle, 1, 2) @ middle

        ends = newton_ascent(starts.reshape(-1, n), height, slopes, (self.lower, self.upper), units)
        best = np.argmax(height(ends, np.arange(len(ends))).reshape(k, few), axis=1)
        return ends.reshape(k, few, n)[np.arange(k), best]
