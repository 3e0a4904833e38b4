"""Inverse kinematics of the model: joint positions that reach targets, within joint limits.

Levenberg-Marquardt on exact derivatives, all targets at once; steps are the shortest that close the gap, so a redundant
arm stays near where it started. Where one start does not reach a target, or no arm may stand with what it reaches,
there are many more (`best_of_seeds`): at first a few steps are made from each. Where no start reaches a target the best
go on by Newton's method; where those that reach it miss a constraint, they are led away from what is in the way, unless
that is the target itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from identification.arm import Arm, Calibration
from identification.arrays import Array, readonly
from identification.data_frames import frame_of_columns
from identification.document import Document
from identification.documents.identification import compensation_document
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import Index, LeastSquares, Linearize, levenberg_marquardt
from identification.kinematics.corrected import standing_in
from identification.kinematics.counting import counting_in, in_columns, turned_into
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import POINT, Conditions, directions_from_order, distances, past_from_order
from identification.model import Model
from identification.model.placed import in_own_frame
from identification.newton_ascent import newton_ascent
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
CHUNK = 1_000  # targets at a time, times SEEDS starts
BEND = 1e-7  # [rad] of a joint, for second derivatives
WITNESSES = 6  # postures at a target that must agree before it counts as barred, and seeds that are tried for them
SAME = 0.01  # of what is missed: margins that differ by less are those of the target, whatever the posture

Constraints = Sequence[PostureCondition]


def violations(constraints: Constraints, postures: Array) -> Array:
    """(m, c) by how much postures (m, n) miss each of c constraints [mm]; 0: satisfied."""
    if not constraints or not len(postures):
        return np.zeros((len(postures), len(constraints)))
    missed = np.column_stack([-np.min(each.margin(postures), axis=1) for each in constraints])
    return np.where(missed > TOLERANCE, missed, 0.0)


def inverse_kinematics(
    model: Model, goals: Array, starts: Array, conditions: Conditions, iterations: int = MAX_ITERATIONS
) -> tuple[Array, Array]:
    """Postures (k, n) within the limits and errors (k,) [mm], by Levenberg-Marquardt from starts (k, n).

    Steps are the shortest in joint angles, so that a redundant arm stays near where it started.
    """
    linearize = linearization(model, conditions)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        position, jacobian = linearize(postures, rows)
        return goals[rows] - position, jacobian

    return _least(model, distances, starts, iterations)


def _least(model: Model, linearize: Linearize, starts: Array, iterations: int) -> tuple[Array, Array]:
    """(k, n) postures within the limits that make residuals least, from starts (k, n), and what they leave (k,)."""
    limits, reach, negligible = (
        (model.arm.lower, model.arm.upper),
        metric(model),
        np.full(len(starts), 1e-5 * TOLERANCE),
    )
    problem = LeastSquares(linearize, *limits, reach, negligible, metric=reach, iterations=iterations)
    solution = levenberg_marquardt(problem, starts)
    return solution.parameters, np.sqrt(solution.rss)


def metric(model: Model) -> Array:
    """(n,) length [mm] that stands for a unit of each joint: the reach for an angle."""
    return np.where(np.array(model.joint_types) == REVOLUTE, model.reach, 1.0)


def linearization(model: Model, conditions: Conditions) -> Linearize:
    """Postures (k, n) and row numbers -> positions (k, d) and derivatives with respect to the posture (k, d, n)."""
    evaluate = model.posture_jacobian

    def linearize(postures: Array, rows: Index) -> tuple[Array, Array]:
        table = model.condition_table(postures, conditions.rows(rows))
        tips, jacobian = evaluate(postures, table, np.broadcast_to(model.values, (len(postures), len(model.values))))
        return tips[..., 0], jacobian

    return linearize


class Tried(NamedTuple):
    """What searches for k goals found, best first: (k, s, n) postures, what they leave [mm] and their rank (k, s)."""

    postures: Array
    left: Array
    rank: Array

    def at(self, rows: Index | NDArray[np.bool_]) -> Tried:
        """Of some of the goals."""
        return Tried._make(values[rows] for values in self)


def ranked(distance: Array, left: Array, missed: Array) -> Array:
    """Of goals reached the distance; behind them what misses constraints, by how much; then what is left."""
    return np.where(left > TOLERANCE, 1e3 * MISSED + left, np.where(missed > 0.0, MISSED + missed, distance))


def best_of_seeds(
    model: Model, goals: Array, near: Array, conditions: Conditions, constraints: Constraints
) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: of the solutions that reach a goal the nearest to `near`, else the closest.

    At first a few steps are made, of a redundant arm from those seeds alone that promise to end near. What fails waits
    for others: a search of few takes nearly as long as one of many.
    """
    arm, generator = model.arm, np.random.default_rng(0)  # the same postures for the same question
    # effort: random postures of a redundant arm, of which the nearest six are tried at first
    seeds = generator.uniform(arm.lower, arm.upper, (256, arm.links))
    redundant = conditions.orientation is None and arm.links > goals.shape[1]
    promising = _promising(model, seeds) if redundant else None
    search = _Search(model, goals, near, conditions, constraints, seeds[:SEEDS], redundant)
    postures, errors, failed = np.empty_like(near), np.empty(len(goals)), list[tuple[Index, Tried]]()
    for rows in _parts(np.arange(len(goals))):
        tried = search.tried(rows, None if promising is None else promising(goals[rows], near[rows]))
        postures[rows], errors[rows] = tried.postures[:, 0], tried.left[:, 0]
        fails = tried.rank[:, 0] >= MISSED
        failed.append((rows[fails], tried.at(fails)))
    if failed:
        rest = np.concatenate([rows for rows, _ in failed])
        first = Tried._make(np.concatenate(each) for each in zip(*(tried for _, tried in failed), strict=True))
        for part in _parts(np.arange(len(rest))):
            if constraints:
                part = part[~search.barred(rest[part], first.at(part))]
            if len(part):
                postures[rest[part]], errors[rest[part]] = search.led_on(rest[part], first.at(part))
    if not redundant:
        search._replace(seeds=seeds[SEEDS:]).again(postures, errors)
    return postures, errors


def _parts(rows: Index, size: int = CHUNK) -> list[Index]:
    """So many at a time; none of no rows."""
    return [rows[start : start + size] for start in range(0, len(rows), size)]


class _Search(NamedTuple):
    """Goals (k, d) of a model, the postures (k, n) that theirs are to be near, and seeds (s, n)."""

    model: Model
    goals: Array
    near: Array
    conditions: Conditions
    constraints: Constraints
    seeds: Array
    redundant: bool  # the arm has more joints than a goal needs, and any orientation will do

    def tried(self, rows: Index, seeds: Array | None = None, iterations: int = QUICK) -> Tried:
        """Of some goals, from `near` and from seeds (k, s, n) of their own; None: the common ones."""
        seeds = np.broadcast_to(self.seeds, (len(rows), *self.seeds.shape)) if seeds is None else seeds
        starts = np.concatenate([self.near[rows, None], seeds], axis=1)
        every, flat = np.repeat(rows, starts.shape[1]), starts.reshape(-1, starts.shape[2])
        flat, left = inverse_kinematics(self.model, self.goals[every], flat, self.conditions.rows(every), iterations)
        missed = violations(self.constraints, flat).sum(axis=1).reshape(starts.shape[:2])
        reached, left = flat.reshape(starts.shape), left.reshape(starts.shape[:2])
        distance = np.linalg.norm((reached - self.near[rows, None]) * metric(self.model) / self.model.reach, axis=2)
        rank = ranked(distance, left, missed)
        order = np.argsort(rank, axis=1)
        left, rank = (np.take_along_axis(values, order, axis=1) for values in (left, rank))
        return Tried(np.take_along_axis(reached, order[:, :, None], axis=1), left, rank)

    def again(self, postures: Array, errors: Array) -> None:
        """Replaces postures (k, n) and errors (k,) of goals that other seeds missed, those first that were missed
        by least, until there is no progress."""
        missed = np.flatnonzero(errors > TOLERANCE)
        missed = missed[np.argsort(errors[missed], kind="stable")]
        for rows in _parts(missed, 32):  # with the seeds that were only glanced at: effort
            reached, left = self.led_on(rows, self.tried(rows))
            better = left <= TOLERANCE
            if not better.any():
                break
            postures[rows[better]], errors[rows[better]] = reached[better], left[better]

    def barred(self, rows: Index, first: Tried) -> NDArray[np.bool_]:
        """(k,) where the goals themselves miss a constraint, as far as a first try and a few more seeds tell: postures
        that reach a goal are different, and all miss some margin by the same amount."""
        few = np.broadcast_to(self.seeds[:WITNESSES], (len(rows), WITNESSES, self.seeds.shape[1]))
        further = self.tried(rows, few)
        postures, left = (np.concatenate(pair, axis=1) for pair in zip(first[:2], further[:2], strict=True))
        reached = left <= TOLERANCE
        margins = np.column_stack([each.margin(postures.reshape(-1, postures.shape[2])) for each in self.constraints])
        high, low = _ends(margins.reshape(*left.shape, -1), reached)
        # witnesses differ by 0.5 rad or mm of some joint
        spread = np.subtract(*_ends(postures, reached)).max(axis=1)
        same = np.any((high < -TOLERANCE) & (high - low <= SAME * -high), axis=1)
        return same & (np.count_nonzero(reached, axis=1) >= WITNESSES) & (spread > 0.5)

    def led_on(self, rows: Index, first: Tried) -> tuple[Array, Array]:
        """(k, n) postures and (k,) errors: where no seed reaches a goal by Newton's method, where those that reach it
        miss constraints by what is missed as further residuals."""
        again = bool(self.constraints) or self.redundant
        tried = self.tried(rows, iterations=MAX_ITERATIONS if self.constraints else QUICK) if again else first
        postures, errors = tried.postures[:, 0].copy(), tried.left[:, 0].copy()
        beyond = errors > TOLERANCE
        missed = ~beyond & (tried.rank[:, 0] >= MISSED) & bool(self.constraints)
        missed &= postures.shape[1] > self.goals.shape[1]  # a redundant arm has more than the seeds found
        for which, further in ((beyond, _polished), (missed, partial(_turned_away, constraints=self.constraints))):
            if which.any():
                where = self.conditions.rows(rows[which])
                postures[which], errors[which] = further(
                    self.model, self.goals[rows[which]], tried.postures[which], where
                )
        return postures, errors


def _ends(values: Array, counted: NDArray[np.bool_]) -> tuple[Array, Array]:
    """(k, c) largest and smallest of values (k, s, c) over those that count (k, s)."""
    high, low = (np.where(counted[:, :, None], values, end) for end in (-np.inf, np.inf))
    return high.max(axis=1), low.min(axis=1)


def _promising(model: Model, seeds: Array) -> Callable[[Array, Array], Array]:
    """Of goals (k, d) and postures (k, n), the (k, 6, n) of random postures (s, n) of a redundant arm whose
    linear steps to the goals end nearest to the postures."""
    scale = metric(model) / model.reach
    positions, jacobians = linearization(model, Conditions())(seeds, np.arange(len(seeds)))
    shortest = np.linalg.pinv(jacobians / scale) / scale[:, None]  # (s, n, d)

    def promising(goals: Array, near: Array) -> Array:
        steps = np.einsum("snd,ksd->ksn", shortest, goals[:, None] - positions)
        ends = np.clip(seeds + steps, model.arm.lower, model.arm.upper)
        distances = np.linalg.norm((ends - near[:, None]) * scale, axis=2)
        return np.asarray(seeds[np.argsort(distances, axis=1, kind="stable")[:, :6]])

    return promising


def _turned_away(
    model: Model, goals: Array, starts: Array, conditions: Conditions, constraints: Constraints
) -> tuple[Array, Array]:
    """(k, n) postures at goals (k, d) and what is left (k,): of those led from postures that miss constraints, starts
    (k, s, n), best first, to where they hold; the nearest to that where none gets there."""
    starts = starts[:, :4]  # a few seeds are led out of there, more is effort
    every = np.repeat(np.arange(len(goals)), starts.shape[1])
    linearize, units = linearization(model, conditions.rows(every)), model.reach / metric(model)

    def distances(postures: Array, rows: Index) -> tuple[Array, Array]:
        """Of the goal and, where a margin is missed, of a place inside."""
        position, jacobian = linearize(postures, rows)
        parts = [_missed(each, postures, BEND * units) for each in constraints]
        missed, slopes = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        gap = goals[every[rows]] - position
        return np.concatenate([gap, missed], axis=1), np.concatenate([jacobian, slopes], axis=1)

    ends, _ = _least(model, distances, starts.reshape(len(every), -1), MAX_ITERATIONS)
    ends, left = inverse_kinematics(model, goals[every], ends, conditions.rows(every))
    rank = ranked(np.zeros(len(every)), left, violations(constraints, ends).sum(axis=1)).reshape(len(goals), -1)
    best = np.ravel_multi_index((np.arange(len(goals)), np.argmin(rank, axis=1)), rank.shape)
    return ends[best], left[best]


def _missed(constraint: PostureCondition, postures: Array, bends: Array) -> tuple[Array, Array]:
    """(k, c) by how much postures (k, n) are not 0.01 mm inside the margins of a constraint, and (k, c, n) derivatives
    of the margins that they miss, by differences of `bends` (n,)."""
    margins = constraint.margin(postures)
    missed = np.maximum(0.01 - margins, 0.0)
    slopes, n = np.zeros((*margins.shape, len(bends))), len(bends)
    rows = np.flatnonzero(missed.any(axis=1))
    bent = constraint.margin((postures[rows, None] + np.diag(bends)).reshape(-1, n))
    bent = bent.reshape(len(rows), n, margins.shape[1])
    slopes[rows] = np.swapaxes(bent - margins[rows, None], 1, 2) / bends
    slopes[missed == 0.0] = 0.0
    return missed, slopes


def _polished(model: Model, goals: Array, starts: Array, conditions: Conditions) -> tuple[Array, Array]:
    """(k, n) postures and (k,) errors: the closest to goals (k, d) out of reach, within the limits; starts (k, s, n),
    best first."""
    linearize, arm, units = linearization(model, conditions), model.arm, model.reach / metric(model)
    # of starts that are nearly the same the first
    firsts = (np.sort(np.unique(np.round(ordered, 1), axis=0, return_index=True)[1]) for ordered in starts)
    kinds = [ordered[first] for ordered, first in zip(starts, firsts, strict=True)]
    goal = np.repeat(np.arange(len(kinds)), [len(kind) for kind in kinds])
    bends = np.concatenate([np.zeros((1, arm.links)), np.diag(BEND * units)])

    def height(q: Array, rows: Index) -> Array:
        gap = linearize(q, goal[rows])[0] - goals[goal[rows]]
        return -0.5 * np.sum(gap**2, axis=1)

    def slopes(q: Array, rows: Index) -> tuple[Array, Array]:
        bent = (q[:, None] + bends).reshape(-1, arm.links)
        position, jacobian = linearize(bent, np.repeat(goal[rows], len(bends)))
        gap = goals[goal[rows]] - position.reshape(len(q), len(bends), -1)[:, 0]
        jacobian = jacobian.reshape(len(q), len(bends), *jacobian.shape[1:])
        along = np.einsum("kd,kidn->kin", gap, jacobian)
        bend = (along[:, 1:] - along[:, :1]) / (BEND * units[:, None])
        return along[:, 0], 0.5 * (bend + np.swapaxes(bend, 1, 2)) - np.swapaxes(jacobian[:, 0], 1, 2) @ jacobian[:, 0]

    ends = newton_ascent(np.concatenate(kinds), height, slopes, (arm.lower, arm.upper), units)
    order = np.lexsort((-height(ends, np.arange(len(ends))), goal))
    best = order[np.unique(goal[order], return_index=True)[1]]
    return inverse_kinematics(model, goals, ends[best], conditions)  # where two postures meet Newton's method is slow


# -- compensation ------------------------------------------------------------------------------------------------------
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
    check_calibrated(arm)
    nominal = None if postures is None else _checked("postures", postures, arm.links)
    if orientations is not None and arm.chain.planar:
        raise InputError("orientations: found for a planar arm, allowed: for a spatial one")
    as_nominal = targets is None and orientations is None and arm.chain.angle_scale is not None
    turned = None if orientations is None else np.asarray(orientations, dtype=float).reshape(-1, 3, 3)
    poses = turned is not None or as_nominal
    arm = in_own_frame(arm)
    if not arm.chain.planar:  # what an angle of a pose counts times
        arm = replace(arm, chain=replace(arm.chain, angle_scale=arm.reach if poses else None))
    drawing, model, familiar = Model(drawn_arm(arm)), Model(arm), familiar_range(arm)
    # where no posture gets to a target, as of an arm with fewer joints than coordinates, it counts as reached within
    # what one in a thousand of the calibration's own measurements may be off, by what the fit left and is unsure of
    figures = [identified(arm).get(key) for key in ("rms_after_mm", "expected_tip_mm")]
    likely = float(np.linalg.norm([float(x) for x in figures if isinstance(x, float | int)]))
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
    commands = reaching(model, goals, start, where, constraints, enough)
    if nominal is None:
        commands = nearest_familiar(model, familiar, goals, commands, where, constraints, enough)
    missed = violations(constraints, commands)
    left = goals - model.position(commands, conditions=where) if len(goals) else goals
    beyond = outside(arm, commands)
    if beyond is not None:  # nobody drives to what misses a constraint
        beyond = beyond & ~np.any(missed > 0.0, axis=1)[:, None]
    rms = identified(arm).get("rms_after_mm")
    return Compensation(
        goals[:, POINT],
        start,
        commands if where.directions is None else commands - servo_shift(arm, where.directions),
        distances(left),
        arm.joint_types,
        where.orientation,
        None if where.orientation is None else np.linalg.norm(left[:, POINT.stop :], axis=1) / model.reach,
        tuple(each.kind for each in constraints),
        missed,
        beyond,
        float(rms) if isinstance(rms, float | int) else None,
        sided,
        enough,
        model.reach,
    )


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


def _checked(name: str, values: ArrayLike, columns: int) -> Array:
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != columns or not np.all(np.isfinite(array)):
        raise InputError(f"{name}: shape {array.shape}, allowed: (k, {columns}) finite numbers")
    return array


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
    def reached(self) -> NDArray[np.bool_]:
        """(k,) True where the error is at most `tolerance`, the angle no more at full reach, or 1e-8 rad, and every
        constraint holds."""
        near = self.near
        return near if self.violations is None else near & ~np.any(self.violations > 0.0, axis=1)

    @property
    def near(self) -> NDArray[np.bool_]:
        """(k,) as `reached`, whatever the constraints say."""
        near = self.errors <= self.tolerance
        return near if self.angles is None else near & (self.angles <= max(1e-8, self.tolerance / self.reach))

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

        def largest(values: Array, rows: NDArray[np.bool_]) -> float | None:
            return float(np.max(values[rows])) if rows.any() else None

        angles = {} if self.angles is None else {"max_error_deg": largest(np.degrees(self.angles), reached)}
        return {
            "targets": len(self.targets),
            "reached": int(np.count_nonzero(reached)),
            "max_error_mm": largest(self.errors, reached),
            "max_error_over": "targets reached",
            "tolerance_mm": self.tolerance,
            "model_rms_mm": self.model_rms,
            "max_unreached_mm": largest(self.errors, out),
            **angles,
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


def reaching(
    model: Model,
    goals: Array,
    nominal: Array,
    conditions: Conditions,
    constraints: Constraints,
    enough: float,
) -> Array:
    """(k, n) postures from nominal ones (k, n); from many seeds where that ends short of the target, or where the arm
    may not stand. What ends so near as `enough` [mm] is left only for what gets there exactly: another branch of the
    arm that is nearer by less than anybody knows is none to go to. Goals (k, d) [mm], of poses three more."""
    nominal = turned_into(nominal, model.arm.lower, model.arm.upper, model.joint_types)
    commands, errors = inverse_kinematics(model, goals, nominal, conditions)
    missed = violations(constraints, commands).sum(axis=1)
    short = np.flatnonzero((errors > TOLERANCE) | (missed > 0.0))
    if short.size:
        again, left = best_of_seeds(model, goals[short], nominal[short], conditions.rows(short), constraints)
        now = ranked(np.zeros(len(short)), left, violations(constraints, again).sum(axis=1))
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
    reached = best_of_seeds(model, goals, near, conditions, constraints)[0]
    out = np.flatnonzero(np.any((reached < lower) | (reached > upper), axis=1))
    if not out.size or np.any(lower >= upper):
        return reached
    inside = Model(replace(model.arm, lower=lower, upper=upper))
    for starts in (np.clip(reached, lower, upper), near):
        if not out.size:
            break
        postures, left = inverse_kinematics(inside, goals[out], starts[out], conditions.rows(out))
        better = (left <= TOLERANCE) & ~violations(constraints, postures).any(axis=1)
        reached[out[better]] = postures[better]
        out = out[~better]
    return reached


def nearest_familiar(
    model: Model,
    familiar: tuple[Array, Array],
    goals: Array,
    reached: Array,
    where: Conditions,
    constraints: Constraints,
    enough: float,
) -> Array:
    """(k, n) postures that were found for goals (k, d); for those out of reach, farther than `enough` [mm], where they
    are outside familiar angles, the nearest within them."""
    lower, upper = familiar
    left = np.linalg.norm(goals - model.position(reached, conditions=where), axis=1)
    out = np.flatnonzero((left > enough) & np.any((reached < lower) | (reached > upper), axis=1))
    if out.size:
        # a joint that did not move has 1e-9 rad of room
        inside = Model(replace(model.arm, lower=lower, upper=np.maximum(upper, lower + 1e-9)))
        starts = np.clip(reached[out], lower, upper)
        reached[out] = best_of_seeds(inside, goals[out], starts, where.rows(out), constraints)[0]
    return reached
