"""The design problem: exactly the mathematical ingredients, frozen; and which postures may be chosen: random ones that
satisfy the constraints, however few there are, grids and lists. `doe.solvers` solves it.

What is known beforehand, K and k of doe/README.md, "Prior information", is added to every information matrix:

    M = (sum_i B_i^T B_i + K) / (m + k)

With K / m and k / m in place of K and k, weights that sum to one give the same M.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from doe.criteria import Criterion, D, information_matrix
from doe.problem.constraints import Constraint, Derivatives, Walls, constraints_of
from doe.problem.model import NEEDS_SIGMA, DesignModel, check_model, joint_units, offers, turns
from identification import Array, InputError, design_model, require, vectorize

ONE_DEGREE = float(np.radians(1.0))
INSIDE = 1e-6  # [rad] by which constraints are kept: rounding
MANY = 16  # parameters above which gradients pay: exchanges and second derivatives of plans cost the cube of them
Stop = Callable[[], bool]  # is asked now and then in a search, which ends where it says True


def never() -> bool:
    """A `Stop` that lets a search come to its end."""
    return False


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """Information known before the new runs: K and k of the formula.

    total : (p, p) sum of B^T B, positive semidefinite, or 0;  runs : how many runs it counts as, >= 0
    """

    total: Array = field(default_factory=lambda: np.zeros(()))
    runs: float = 0.0

    @property
    def empty(self) -> bool:
        """True if nothing is known."""
        return self.runs == 0.0 and not self.total.any()

    def per_new_run(self, new_runs: int | None = None) -> PriorInformation:
        """K / m and k / m. Raises `InputError` where something is known and `new_runs`, m, is no number >= 1."""
        if self.empty:
            return self
        if new_runs is None or new_runs < 1:
            raise InputError(f"runs: {new_runs}, allowed: >= 1, the number of new runs beside what is known already")
        return PriorInformation(self.total / new_runs, self.runs / new_runs)

    def information(self, new: Array, new_runs: float = 1.0) -> Array:
        """(..., p, p) M of new runs whose B^T B sum to `new`; or of a weighted mean, with the prior per new run."""
        return np.asarray((new + self.total) / (new_runs + self.runs))

    def mixture(self, jacobians: Array, weights: Array) -> Array:
        """(p, p) M of (j, d, p) scaled Jacobians with weights (j,) that sum to one, with the prior per new run."""
        return self.information(information_matrix(jacobians, weights))

    def sensitivities(self, jacobians: Array, gradient: Array) -> Array:
        """(j,) tr(G F_i) of (j, d, p) scaled Jacobians; the literature calls it d for G = M^-1."""
        return self.mixed(np.einsum("kda,kda->k", jacobians @ gradient, jacobians), gradient)

    def mixed(self, values: Array | float, gradient: Array) -> Array:
        """tr(G F) of values tr(G B^T B)."""
        return np.asarray((values + np.sum(gradient * self.total)) / (1.0 + self.runs))


@dataclass(frozen=True)
class DesignProblem:
    """Choose postures within the limits and constraints that maximise the criterion of the information per run.

    model : see `DesignModel`; that of an arm is taken with all of its measured points
    lower, upper : (n,) joint limits [rad], of prismatic joints [mm]; None: the model's
    constraints : what a posture must satisfy besides the limits, see `doe.problem.constraints`
    kept : (k, n) postures already measured, which count in the information (`prior`); None: none
    kept_excess : [mm^2] by how much their variance exceeds that of the new runs: one number, (k,) of each, or (k, d) of
        each coordinate; inf: that was not read
    choices : (N, n) postures to choose from, None: anything within limits and constraints
    sampled : True if the choices are only a random sample, for the search: bounds are then over all postures
    minimum_distance : [rad] any two postures of a plan differ by at least this in some joint, in `joint_units`; 0:
        repeats are allowed
    deviations : parameter name -> standard deviation [API unit] of its normal prior around the model's value, which
        needs sigma; parameters without one are free
    fit : how measurements of its plans are to be fitted, see `Plan`
    beyond : mean square [mm^2] of the tip error that no plan can reduce: errors that postures do not share
    """

    model: DesignModel
    lower: Array = None  # type: ignore[assignment]  # arrays from construction on
    upper: Array = None  # type: ignore[assignment]
    criterion: Criterion = field(default_factory=D)
    constraints: Sequence[Constraint] = ()
    kept: Array = None  # type: ignore[assignment]
    kept_excess: ArrayLike = 0.0
    choices: Array | None = None
    sampled: bool = False
    minimum_distance: float = ONE_DEGREE
    deviations: Mapping[str, float] = field(default_factory=dict)
    fit: str = ""
    beyond: float = 0.0

    def __post_init__(self) -> None:
        model = design_model(self.model)
        check_model(model)
        if not callable(getattr(self.criterion, "value", None)):
            allowed = "an object with value(), such as doe.criteria.A()"
            raise InputError(f"criterion: {self.criterion!r:.40}, allowed: {allowed}")
        n = len(model.joint_types)
        usual = {"lower": model.lower, "upper": model.upper, "kept": np.empty((0, n))}
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "deviations", dict(self.deviations))
        for name, value in usual.items():
            array = np.array(value if getattr(self, name) is None else getattr(self, name), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, name, np.atleast_2d(array) if name == "kept" else array)
        if {self.lower.shape, self.upper.shape} != {(n,)} or not np.all(self.lower < self.upper):
            found = f"{self.lower} to {self.upper}"
            raise InputError(f"joint limits: {found}, allowed: lower < upper for each of {n} joints")
        for name, rows in (("kept", self.kept), ("candidates", self.choices)):
            if rows is not None and np.shape(rows)[1:] != (n,):
                raise InputError(f"{name}: shape {np.shape(rows)}, allowed: (k, {n})")
        _ = self.precisions  # raises for deviations that do not fit

    def __getstate__(self) -> dict[str, Any]:
        """What pickles: the CasADi functions do not, and are rebuilt where they are needed."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def of(cls, model: Any, **changes: Any) -> DesignProblem:
        """The problem of a model within its own limits and constraints, with its prior; of an arm's model with its
        measured points in place, and of one that touches a surface with postures at which it does, to choose from."""
        model = design_model(model)
        check_model(model)
        if offers(model, "placed"):
            model = model.placed()
        fields: dict[str, Any] = {"constraints": constraints_of(model), "deviations": model.prior, **changes}
        free = cls(model, **fields)
        if free.choices is not None or not getattr(model, "tied", False):
            return free
        return replace(free, choices=model.tied_postures(free.lower, free.upper, free.joint_units, free.feasible))

    joints = property(lambda self: int(self.lower.size))  # n, joints of a posture

    @cached_property
    def joint_units(self) -> Array:
        """(n,) what counts as one radian of each joint, see there."""
        return joint_units(self.model)

    def comparable(self, postures: Array) -> Array:
        """(..., n) postures in `joint_units`, in which one tolerance [rad] holds for every joint."""
        return np.asarray(postures / self.joint_units)

    @property
    def spacing(self) -> str:
        """The minimum distance in words."""
        return f"{np.degrees(self.minimum_distance):g} {self.degrees}"

    @property
    def degrees(self) -> str:
        """What joints are compared in, in words."""
        return "deg" if turns(self.model).all() else "deg (360 deg: the range of a prismatic joint)"

    @property
    def parameters(self) -> int:
        """p, parameters to identify."""
        return len(self.model.parameters)

    @property
    def many_parameters(self) -> bool:
        """True where climbing on gradients is the best there is."""
        return self.parameters > MANY

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the parameters of effects that may be missing, which have a prior."""
        return tuple(p.name for p in self.model.parameters if p.of_effect and p.name in self.deviations)

    @property
    def fewest_runs(self) -> int:
        """The smallest number of runs with as many equations as unknowns of which nothing is known: m d >= p."""
        missing = self.parameters - len(self.deviations) - self.model.dimension * len(self.kept)
        return max(1, -(-missing // self.model.dimension))

    def scaled_jacobians(self, postures: ArrayLike) -> Array:
        """(..., d, p) dimensionless Jacobians B of (..., n) postures: Jacobian columns over their scales."""
        angles = np.atleast_2d(np.asarray(postures, dtype=float))
        require(angles.shape[-1] == self.joints, f"postures: shape {angles.shape}, allowed: (..., {self.joints})")
        return self._evaluate(angles)[0]

    @cached_property
    def _evaluate(self) -> Callable[..., tuple[Array, ...]]:
        return vectorize(self.scaled_jacobian_function)

    def information(self, postures: ArrayLike, weights: Array | None = None) -> Array:
        """(p, p) information per run M' = S (sum_i w_i J_i^T J_i) S; the mean over runs without weights.

        Postures already measured (`kept`) count as runs; weights are the shares of the new runs only.
        """
        rows = np.atleast_2d(postures)
        shares = np.full(len(rows), 1.0 / len(rows)) if weights is None else weights
        return self.prior.per_new_run(len(rows)).mixture(self.scaled_jacobians(rows), shares)

    def objective(self, postures: ArrayLike, weights: Array | None = None) -> float:
        """Criterion value of a plan (to maximise); -inf if its information matrix is singular."""
        return float(self.criterion.value(self.information(postures, weights)))

    def clip(self, postures: ArrayLike) -> Array:
        """Postures moved into the joint limits (solvers exceed bounds by about 1e-8)."""
        return np.clip(np.asarray(postures, dtype=float), self.lower, self.upper)

    def feasible(self, postures: Array) -> NDArray[np.bool_]:
        """(...) True where postures (..., n) satisfy every constraint (joint limits apart)."""
        flat = np.reshape(postures, (-1, self.joints))
        fits = np.ones(len(flat), dtype=bool)
        for constraint in self.constraints:
            left = np.flatnonzero(fits)  # most random postures fail the first that fails, and geometry takes time
            fits[left] = np.all(constraint.margin(flat[left]) >= 0.0, axis=1)
        return fits.reshape(np.shape(postures)[:-1])

    @cached_property
    def prior(self) -> PriorInformation:
        """The information of the postures measured already, and of what else is known beforehand."""
        return PriorInformation(information_matrix(self.kept_jacobians) + np.diag(self.precisions), len(self.kept))

    @cached_property
    def kept_jacobians(self) -> Array:
        """(k, d, p) B of the postures measured already, in units of the noise of a new run."""
        excess = np.asarray(self.kept_excess) / (self.model.sigma or 1.0) ** 2
        of_each = excess if excess.ndim == 2 else excess[..., None]
        return np.asarray(self.scaled_jacobians(self.kept) / np.sqrt(1.0 + of_each)[..., None])

    @cached_property
    def precisions(self) -> Array:
        """(p,) what `deviations` add to the diagonal of sum B^T B; 0: nothing is known.

        Raises `InputError` for unknown names, deviations that are not > 0, and where sigma is not known.
        """
        parameters, sizes = self.model.parameters, np.full(self.parameters, np.inf)
        for name, deviation in self.deviations.items():
            require(0.0 < deviation < np.inf, f"deviations: {name} has {deviation:g}, allowed: a finite number > 0")
            sizes[parameters.index(name)] = deviation
        require(not self.deviations or self.model.sigma is not None, f"a prior {NEEDS_SIGMA}")
        return np.asarray(((self.model.sigma or 0.0) / (parameters.scales * sizes)) ** 2)

    @cached_property
    def scaled_jacobian_function(self) -> ca.Function:
        """CasADi q -> B (d, p) at the model's best known parameter values."""
        q, p = ca.SX.sym("q", self.joints), ca.SX.sym("p", self.parameters)
        position = ca.SX(self.model.symbolic_position(q, p))
        if position.shape != (self.model.dimension, 1):
            wrong = f"symbolic_position has shape {position.shape}"
            raise InputError(f"model: {wrong}, allowed: ({self.model.dimension},), as its dimension says")
        jacobian = ca.substitute(ca.jacobian(position, p), p, ca.DM(self.model.values))
        scaled = ca.cse(jacobian @ ca.diag(ca.DM(1.0 / self.model.parameters.scales)))
        return ca.Function("scaled_jacobian", [q], [scaled], ["q"], ["jacobian"])

    @cached_property
    def without_effect(self) -> tuple[str, ...]:
        """Names of free parameters that move the tip at no posture, as thermal growth at the mean temperature."""
        cloud = self.choices
        if cloud is None:
            cloud = np.random.default_rng(0).uniform(self.lower, self.upper, (16, self.joints))
        still = ~np.any(self.scaled_jacobians(cloud), axis=(0, 1)) & (self.precisions == 0.0)
        return tuple(name for name, zero in zip(self.model.parameters.names, still, strict=True) if zero)

    @cached_property
    def active_joints(self) -> tuple[int, ...]:
        """Joints (from 0) that change B^T B; the others, such as q_1 of the base model, are free for other purposes.

        Raises `InputError` for a model whose derivatives are not finite.
        """
        base, other = np.random.default_rng(0).uniform(self.lower, self.upper, (2, 16, self.joints))
        moved = np.where(np.eye(self.joints, dtype=bool)[:, None], other, base)  # (n, 16, n)
        before, after = (information_of_each(self.scaled_jacobians(q)) for q in (base, moved))
        if not (np.all(np.isfinite(before)) and np.all(np.isfinite(after))):
            wrong = "derivatives by its parameters are not numbers at some postures"
            raise InputError(f"model: {wrong}, allowed: finite ones within the joint limits")
        return tuple(np.flatnonzero(np.abs(after - before).max(axis=(1, 2, 3)) > 1e-9 * np.abs(before).max()).tolist())

    @cached_property
    def searched_joints(self) -> tuple[int, ...]:
        """Joints (from 0) that a solver must choose: the active ones, or all where constraints or a list tie them."""
        return tuple(range(self.joints)) if self.constraints or self.choices is not None else self.active_joints

    def jacobian_derivatives(self, joints: Sequence[int]) -> Derivatives:
        """Of B (d, p) by some joints."""
        q = ca.SX.sym("q", self.joints)
        jacobian = self.scaled_jacobian_function(q)
        return Derivatives(q, jacobian, joints, jacobian.shape)

    @cached_property
    def walls(self) -> Walls:
        """All constraints' margins (k,), which are kept >= 0, and their derivatives by the joints."""
        return Walls(self.constraints)

    @cached_property
    def steepness(self) -> Array:
        """(k,) mean slope of each constraint [mm/rad] over random postures: those of a plan may all lie where it
        does not vary, as the lowest height of an arm while its shoulder is lowest.

        Less than a thousandth of the steepest is no wall, as the height of the base.
        """
        drawn = np.random.default_rng(0).uniform(self.lower, self.upper, (256, self.joints))
        slopes = np.sqrt(np.mean(np.sum(self.walls.first(drawn)[1] ** 2, axis=1), axis=0))
        return np.maximum(slopes, 1e-3 * slopes.max(initial=0.0))


def information_of_each(jacobians: Array) -> Array:
    """(..., p, p) B^T B of every posture by itself, from (..., d, p) B."""
    return np.swapaxes(jacobians, -1, -2) @ jacobians


# -- random postures ---------------------------------------------------------------------------------------------------
def random_postures(problem: DesignProblem, count: int, generator: Generator) -> Array:
    """(count, n) uniform over the feasible set within the joint limits; near its known points where it is tiny.

    Raises `InputError` naming the constraints that exclude everything.
    """
    limits = problem.lower, problem.upper
    if not problem.constraints:
        return generator.uniform(*limits, (count, problem.joints))
    feasible, seen = np.empty((0, problem.joints)), []
    for _ in range(8):  # batches, before feasible postures are searched for
        drawn = generator.uniform(*limits, (max(4096, count), problem.joints))
        seen.append(drawn)
        for part in np.array_split(drawn, max(1, len(drawn) // max(256, count))):  # of geometry no more than is needed
            feasible = np.concatenate([feasible, part[problem.feasible(part)]])
            if len(feasible) >= count:
                return feasible[:count]
    if not len(feasible):  # those near the least infeasible of many
        every = np.concatenate(seen)
        lacking = np.maximum(0.0, -problem.walls.values(every) / problem.steepness).sum(axis=1)
        best = put_inside(problem, every[np.argsort(lacking)[:64]])
        feasible, every = best[problem.feasible(best)], np.concatenate([every, best])
    if not len(feasible):
        fits = np.array([np.all(c.margin(every) >= 0.0, axis=1) for c in problem.constraints])
        names = []
        for k, c in enumerate(problem.constraints, start=1):
            most = zip(getattr(c, "pairs", ()), c.margin(every).max(axis=0), strict=False)
            never = ", ".join(" and ".join(pair) for pair, margin in most if margin < 0.0)
            names.append(f"constraint {k} ({c.kind}{' of ' * bool(never)}{never})")
        alone = [name for name, fit in zip(names, fits, strict=True) if not fit.any()]
        pairs = [(a, b) for b in range(len(names)) for a in range(b) if not np.any(fits[a] & fits[b])]
        conflict = f"no posture satisfies all of {', '.join(names)} together"
        if alone:
            conflict = f"no posture within the joint limits satisfies {' nor '.join(alone)}"
        elif pairs:
            conflict = f"no posture satisfies {names[pairs[0][0]]} and {names[pairs[0][1]]} together"
        raise InputError(f"constraints: {conflict}, allowed: constraints that leave some")
    near = feasible[generator.integers(len(feasible), size=count)]
    steps = generator.standard_normal(near.shape) * 0.2 * (problem.upper - problem.lower)
    moved = put_inside(problem, problem.clip(near + steps))
    return np.concatenate([feasible, np.where(problem.feasible(moved)[:, None], moved, near)])[:count]


def half_at_limits(problem: DesignProblem, count: int, generator: Generator) -> Array:
    """(k, n) so many random postures, and as many of which each joint is at its nearer limit with probability one half,
    as far as constraints allow that."""
    anywhere, others = (random_postures(problem, count, generator) for _ in range(2))
    nearer = np.where(others < 0.5 * (problem.lower + problem.upper), problem.lower, problem.upper)
    at_limits = np.where(generator.random(others.shape) < 0.5, nearer, others)
    return np.concatenate([anywhere, at_limits[problem.feasible(at_limits)]])


def connected(problem: DesignProblem, postures: Array | None = None) -> Array:
    """Where 1,000 random allowed postures leave a gap of half a radian in the angles of a joint, no move crosses it:
    those of postures (k, n), or of the 1,000, on the side that has most. Where the tracker does not see, moves pass."""
    passes = not problem.constraints or any(each.kind == "line_of_sight" for each in problem.constraints)
    drawn = postures if passes and postures is not None else random_postures(problem, 1000, np.random.default_rng(0))
    if passes:
        return drawn
    postures = drawn if postures is None else postures
    inside = np.ones(len(postures), dtype=bool)
    for angles, row in zip(problem.comparable(postures).T, np.sort(problem.comparable(drawn).T), strict=True):
        side = max(np.split(row, np.flatnonzero(np.diff(row) > 0.5) + 1), key=len)
        inside &= (angles > side[0] - 0.25) & (angles < side[-1] + 0.25)
    return postures[inside] if inside.any() else postures


def put_inside(problem: DesignProblem, postures: Array) -> Array:
    """(m, n) postures moved until they satisfy all constraints, most of them: by short steps, each back over the wall
    that is missed most (T. S. Motzkin, I. J. Schoenberg, "The relaxation method for linear inequalities", 1954)."""
    inside = np.array(postures)
    for _ in range(20):  # effort: steps
        values, slopes = problem.walls.first(inside)
        lacking = 2.0 * INSIDE - values / problem.steepness
        most = lacking.max(axis=1, initial=-np.inf)
        if not len(outside := np.flatnonzero(most > INSIDE)):
            break
        slope = (slopes / problem.steepness)[outside, :, lacking[outside].argmax(axis=1)]
        steps = slope * (most[outside] / np.maximum(np.sum(slope**2, axis=1), 1e-300))[:, None]
        # the largest change of a joint in one step
        steps *= np.minimum(1.0, 0.3 / np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1e-300))
        inside[outside] = problem.clip(inside[outside] + steps)
    return inside


# -- grids and lists ---------------------------------------------------------------------------------------------------
def grid(problem: DesignProblem, levels: int) -> Array:
    """(N, n) `levels` values per joint from limit to limit, over the joints that matter, without what constraints
    forbid; the last joint fastest.

    A joint that changes neither information nor constraints (q_1 of a free base model) stays in the middle of its
    range. Raises InputError for fewer than two levels and where no candidate is left.
    """
    require(levels >= 2, f"grid: {levels} levels per joint, allowed: at least 2 (the joint limits)")
    gridded, count = problem.searched_joints, 2**24  # candidates at most: a gigabyte
    if levels ** len(gridded) > count:
        asked, most = f"{levels} levels for each of {len(gridded)} joints", int(count ** (1.0 / len(gridded)) + 1e-9)
        raise InputError(f"grid: {asked}, allowed: 2 to {most}, which are {count:,} candidates at most")
    axes = [
        np.linspace(low, high, levels) if joint in gridded else np.array([0.5 * (low + high)])
        for joint, (low, high) in enumerate(zip(problem.lower, problem.upper, strict=True))
    ]
    postures = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    return _allowed(problem, postures, np.ones(len(postures), dtype=bool))


def listed_candidates(problem: DesignProblem, postures: ArrayLike) -> Array:
    """(N, n) those of the `postures` [rad] that are within the limits and satisfy the constraints.

    Raises InputError for another number of joints and where no candidate is left.
    """
    listed = np.atleast_2d(np.asarray(postures, dtype=float))
    if listed.ndim != 2 or listed.shape[1] != problem.joints:
        raise InputError(f"candidates: shape {np.shape(postures)}, allowed: (N, {problem.joints})")
    if len(rows := np.flatnonzero(~np.isfinite(listed).all(axis=1))):
        raise InputError(f"candidates: row {rows[0] + 1} is not finite, allowed: finite joint angles")
    rounding = 1e-9  # [rad] from a file in degrees
    inside = np.all((listed >= problem.lower - rounding) & (listed <= problem.upper + rounding), axis=1)
    return _allowed(problem, problem.clip(listed), inside)


def _allowed(problem: DesignProblem, postures: Array, inside: Array) -> Array:
    """Those inside that satisfy the constraints."""
    inside[inside] = problem.feasible(postures[inside])
    require(inside.any(), f"candidates: 0 of {len(inside)} are within limits and constraints, allowed: at least one")
    return postures[inside]


def some_of(candidates: Array, count: int) -> Array:
    """(count, n) of the candidates (k, n), at random; all of them if there are no more."""
    chosen = np.random.default_rng(0).choice(len(candidates), min(count, len(candidates)), replace=False)
    return candidates[np.sort(chosen)]
