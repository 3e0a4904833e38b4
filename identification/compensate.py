"""Compensation: joint commands that bring the tip of the real arm to where the nominal arm would have been.

Targets are positions, or poses of a spatial arm's tool, where an angle counts as the distance that it is at full reach.

The real arm is the calibrated model. Its inverse kinematics are solved by Levenberg-Marquardt on exact derivatives, all
targets at once; steps are the shortest that close the gap, so a redundant arm stays near where it started.
The arm file's `[[constraints]]` do not enter: commands stay near the nominal postures, which should satisfy them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import Index, LeastSquares, Linearize, levenberg_marquardt
from identification.kinematics.corrected import standing_in
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import POINT, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.servo import servo_shift

TOLERANCE, TURNED = 1e-6, 1e-8  # [mm, rad] a target is reached if the model comes this close
SEEDS = 32  # random postures per target where none is given, or where the nominal one leads nowhere
MAX_ITERATIONS = 60
CHUNK = 1_000  # targets at a time, times SEEDS starts
POLISHED = 12  # of the seeds, for a target out of reach: there damped least squares creep, and often end 1 % too far


@dataclass(frozen=True, eq=False)
class Compensation:
    """Joint commands for k targets.

    targets : (k, d) [mm];  orientations : (k, 3, 3) of the tool for the instrument, None: any will do
    nominal : (k, n) postures [rad] that would reach them on the nominal arm
    commands : (k, n) postures [rad] for the real arm, within the joint limits; the nearest found where unreachable
    errors : (k,) distance of the real arm's tip from the target [mm], by the calibrated model
    angles : (k,) between the orientation wanted and that of the tool [rad], None: any will do
    joint_types : (n) of the arm, empty: all revolute
    """

    targets: Array
    nominal: Array
    commands: Array
    errors: Array
    joint_types: tuple[str, ...] = ()
    orientations: Array | None = None
    angles: Array | None = None

    def __post_init__(self) -> None:
        for name in ("targets", "nominal", "commands", "errors"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(k,) True where the error is at most `TOLERANCE`, and the angle at most `TURNED`."""
        near = self.errors <= TOLERANCE
        return near if self.angles is None else near & (self.angles <= TURNED)

    def to_json(self) -> dict[str, Any]:
        """Counts, largest error over targets reached, unreached rows (identification/files/README.md, "JSON keys")."""
        reached = self.reached
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            "max_error_mm": float(np.max(self.errors[reached])) if reached.any() else None,
            **({} if self.angles is None else {"max_error_deg": self._largest_angle}),
            "unreachable": [int(row) + 1 for row in np.flatnonzero(~reached)],
            "commands_deg": [
                row if near else None
                for row, near in zip(self.commands_in_file_units.tolist(), reached.tolist(), strict=True)
            ],
        }

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

    def __repr__(self) -> str:
        return f"Compensation({int(np.count_nonzero(self.reached))} of {len(self.targets)} targets reached)"


def compensate(
    arm: Arm,
    targets: ArrayLike | None = None,
    postures: ArrayLike | None = None,
    conditions: Conditions | None = None,
    orientations: ArrayLike | None = None,
) -> Compensation:
    """Joint commands within the limits whose tip, on the calibrated arm, is at the targets.

    arm : with a calibration, or with known effect values
    targets : (k, d) tip positions [mm]; left out: where the nominal arm has its tip at `postures`
    postures : (k, n) nominal joint commands [rad]; left out: found, the nearest to the middle of the limits
    conditions : payload, temperature and the like of every row; directions follow from the order of the rows
    orientations : (k, 3, 3) axes of a spatial arm's tool for the instrument at the targets; left out: any will do, but
        that where targets are left out, too, an arm that measures orientations keeps those of its nominal postures

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
    nominal = given if given is not None else _nominal_postures(nominal_arm, goals, where)
    if where.directions is None and len(nominal):
        where = replace(where, directions=directions_from_order(nominal), past=past_from_order(nominal))
    return _compensation(arm, goals, nominal, where)


def _compensation(arm: Arm, goals: Array, nominal: Array, where: Conditions) -> Compensation:
    """From nominal postures (k, n), under conditions with directions."""
    model = Model(arm)
    commands = _solve(model, goals, nominal, where)
    left = goals - model.position(commands, conditions=where) if len(goals) else goals
    angles = None if where.orientation is None else np.linalg.norm(left[:, POINT.stop :], axis=1) / model.reach
    if where.directions is not None:
        commands = commands - servo_shift(arm, where.directions)
    figures = commands, distances(left), arm.joint_types, where.orientation, angles
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
    return arm if arm.chain is None else replace(arm, chain=replace(arm.chain, angle_scale=scale))


def as_drawn(arm: Arm) -> Arm:
    """The nominal arm, without effects; a spatial one stands where the calibration found it, and with its points."""
    chain = arm.chain
    if chain is not None and arm.calibration is not None:
        chain = standing_in(chain, arm.calibration.values)
    return replace(arm, effects=(), calibration=None, chain=chain)


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


# -- inverse kinematics --------------------------------------------------------------------------------------------
def _nominal_postures(model: Model, goals: Array, conditions: Conditions) -> Array:
    """(k, n) nominal inverse kinematics nearest to the middle of the limits; where none exists, the best found."""
    middle = np.tile((model.arm.lower + model.arm.upper) / 2.0, (len(goals), 1))
    return _best_of_seeds(model, goals, middle, Conditions(orientation=conditions.orientation))[0]


def _solve(model: Model, goals: Array, nominal: Array, conditions: Conditions) -> Array:
    """(k, n) postures from the nominal postures; from many seeds where that ends short of the target."""
    commands, errors = inverse_kinematics(model, goals, nominal, conditions)
    short = np.flatnonzero(errors > TOLERANCE)
    if short.size:
        again, left = _best_of_seeds(model, goals[short], nominal[short], conditions.rows(short))
        better = left < errors[short]
        commands[short[better]] = again[better]
    return commands


def _best_of_seeds(model: Model, goals: Array, near: Array, conditions: Conditions) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: of the solutions that reach a goal the nearest to `near`, else the closest.

    Where no seed reaches the goal, the best of them go on by a quasi-Newton method.
    """
    arm, generator = model.arm, np.random.default_rng(0)  # the same postures for the same question
    seeds = np.concatenate([np.empty((1, arm.links)), generator.uniform(arm.lower, arm.upper, (SEEDS, arm.links))])
    postures, errors = np.empty_like(near), np.empty(len(goals))
    for start in range(0, len(goals), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(goals)))
        tried = np.tile(seeds, (len(rows), 1, 1))
        tried[:, 0] = near[rows]
        every = np.repeat(rows, len(seeds))
        found, left = inverse_kinematics(model, goals[every], tried.reshape(-1, arm.links), conditions.rows(every))
        found, left = found.reshape(tried.shape), left.reshape(len(rows), -1)
        distance = np.linalg.norm((found - near[rows, None]) * _metric(model) / model.reach, axis=2)
        # a reached goal is ranked by distance, any other behind it by its error
        rank = np.where(left <= TOLERANCE, distance, 1e6 + left)
        best = np.argmin(rank, axis=1)
        postures[rows], errors[rows] = found[np.arange(len(rows)), best], left[np.arange(len(rows)), best]
        for row in np.flatnonzero(errors[rows] > TOLERANCE):
            k, ordered = rows[row], found[row, np.argsort(rank[row])]
            postures[k], errors[k] = _polished(model, goals[k], ordered, conditions, k)
    return postures, errors


def _polished(model: Model, goal: Array, starts: Array, conditions: Conditions, row: int) -> tuple[Array, float]:
    """(n,) posture and error: the closest to a goal out of reach, within the limits; starts (s, n), best first."""
    from scipy.optimize import Bounds, minimize  # only such targets pay for its import

    linearize, rows = _linearization(model, conditions), np.array([row])

    def squared(q: Array) -> tuple[float, Array]:
        position, jacobian = linearize(q[None], rows)
        gap = position[0] - goal
        return float(gap @ gap), 2.0 * gap @ jacobian[0]

    _, first = np.unique(np.round(starts, 1), axis=0, return_index=True)  # one of each kind
    starts = starts[np.sort(first)[:POLISHED]]
    limits = Bounds(model.arm.lower, model.arm.upper)
    options = {"maxiter": 300, "ftol": 1e-14, "gtol": 1e-9}
    ends = [minimize(squared, start, jac=True, method="L-BFGS-B", bounds=limits, options=options) for start in starts]
    best = min(ends, key=lambda end: float(end.fun))
    return np.clip(best.x, model.arm.lower, model.arm.upper), float(np.sqrt(best.fun))


def inverse_kinematics(model: Model, goals: Array, starts: Array, conditions: Conditions) -> tuple[Array, Array]:
    """Postures (k, n) within the limits and errors (k,) [mm], by Levenberg-Marquardt from starts (k, n).

    Steps are the shortest in joint angles, so that a redundant arm stays near where it started.
    """
    linearize = _linearization(model, conditions)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        position, jacobian = linearize(postures, rows)
        return goals[rows] - position, jacobian

    reach = _metric(model)
    negligible = np.full(len(goals), 1e-5 * TOLERANCE)
    limits = model.arm.lower, model.arm.upper
    problem = LeastSquares(distances, *limits, reach, negligible, metric=reach, iterations=MAX_ITERATIONS)
    found = levenberg_marquardt(problem, starts)
    return found.parameters, np.sqrt(found.squares)


def _metric(model: Model) -> Array:
    """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
    return np.where(np.array(model.joint_types) == REVOLUTE, model.reach, 1.0)


def _linearization(model: Model, conditions: Conditions) -> Linearize:
    """Postures (k, n) and row numbers -> positions (k, d) and derivatives with respect to the posture (k, d, n)."""
    evaluate = model.expressions.posture_jacobian

    def linearize(postures: Array, rows: Index) -> tuple[Array, Array]:
        table = model.condition_table(postures, conditions.rows(rows))
        found, jacobian = evaluate(postures, table, np.broadcast_to(model.values, (len(postures), len(model.values))))
        return found[..., 0], jacobian

    return linearize
