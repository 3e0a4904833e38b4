"""The design problem: exactly the mathematical ingredients, frozen. `doe.solvers` solves it.

`doe` knows a model only as an `InformationModel`: parameters, a dimension d, types of joints, Jacobians (m, d, p).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from doe.criteria import Criterion, D
from doe.problem.constraints import Constraint, constraints_of
from doe.problem.prior import PriorInformation, precisions
from doe.problem.spatial import designed
from doe.problem.touching import touches, touching_postures
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.information import information_matrix
from identification.kinematics.parameters import EFFECT, PRISMATIC, ParameterSet
from identification.model import Model
from identification.vectorize import PART, vectorize

ONE_DEGREE = float(np.radians(1.0))
MANY = 16  # parameters above which gradients pay: exchanges and second derivatives of plans cost the cube of them
Stop = Callable[[], bool]  # is asked now and then in a search, which ends where it says True


def never() -> bool:
    """A `Stop` that lets a search come to its end."""
    return False


class InformationModel(Protocol):
    """All that design needs of a model, of any dimension: `identification.model.Model` has it."""

    @property
    def parameters(self) -> ParameterSet:
        """The p parameters to identify."""
        ...

    @property
    def values(self) -> Array:
        """(p,) their best known values."""
        ...

    @property
    def dimension(self) -> int:
        """d, measured coordinates per posture."""
        ...

    @property
    def joint_types(self) -> tuple[str, ...]:
        """(n) `revolute`, posture in rad, or `prismatic`, in mm."""
        ...

    @property
    def sigma(self) -> float | None:
        """Standard deviation of a measured coordinate [mm], None: not known."""
        ...

    @property
    def neutral_conditions(self) -> Array:
        """(c,) conditions of measurement where nothing is said."""
        ...

    @property
    def jacobian_function(self) -> ca.Function:
        """CasADi (q, conditions, parameters) -> position (d,) and its derivative by the parameters (d, p)."""
        ...

    def jacobian(self, postures: ArrayLike, parameters: Any = None, conditions: Any = None) -> Array:
        """(m, d, p) of postures (m, n)."""
        ...


@dataclass(frozen=True)
class DesignProblem:
    """Choose postures within the limits and constraints that maximise the criterion of the information per run.

    model : gives Jacobians;  lower, upper : (n,) joint limits [rad], of prismatic joints [mm]
    constraints : what a posture must satisfy besides the limits, see `doe.problem.constraints`
    kept : (k, n) postures already measured, which count in the information (`prior`); None: none
    choices : (N, n) postures to choose from, None: anything within limits and constraints
    sampled : True if the choices are a random sample that a search makes do with: bounds are then over all postures
    minimum_distance : [rad] two postures of a plan differ by this in some joint at least, in `joint_units`; 0: repeats
        are allowed
    deviations : parameter name -> standard deviation of what is known of it before anything is measured [API unit],
        around the model's values: a normal prior, which needs sigma; parameters without one are free
    fit : how measurements of its plans are to be fitted, see `Plan`
    beyond : mean square [mm^2] of the tip's distance that no plan can lower: errors that a posture does not share
    """

    model: InformationModel
    lower: Array
    upper: Array
    criterion: Criterion = field(default_factory=D)
    constraints: Sequence[Constraint] = ()
    kept: Array = None  # type: ignore[assignment]  # an array from construction on
    choices: Array | None = None
    sampled: bool = False
    minimum_distance: float = ONE_DEGREE
    deviations: Mapping[str, float] = field(default_factory=dict)
    fit: str = ""
    beyond: float = 0.0

    def __post_init__(self) -> None:
        for name, needed, made in (
            ("model", "jacobian", "Model(arm)"),
            ("criterion", "value", "doe.criteria.criterion('A', ...)"),
        ):
            if not callable(getattr(part := getattr(self, name), needed, None)):
                raise InputError(f"{name}: {part!r:.40}, allowed: an object with {needed}(), such as {made}")
        for name in ("lower", "upper"):
            object.__setattr__(self, name, readonly(getattr(self, name), -1))
        kept = np.empty((0, self.joints)) if self.kept is None else np.atleast_2d(np.asarray(self.kept, dtype=float))
        if kept.size and kept.shape[1:] != (self.joints,):
            raise InputError(f"kept: shape {kept.shape}, allowed: (k, {self.joints})")
        object.__setattr__(self, "kept", readonly(kept.reshape(-1, self.joints)))
        object.__setattr__(self, "deviations", dict(self.deviations))
        _ = self.precisions  # raises for deviations that do not fit
        if not (np.isfinite(self.minimum_distance) and self.minimum_distance >= 0.0):
            raise InputError(f"minimum distance: {np.degrees(self.minimum_distance):g} deg, allowed: a number >= 0")
        if len(self.model.joint_types) != self.joints:
            raise InputError(f"joint limits: {self.joints} of {len(self.model.joint_types)} joints, allowed: one each")
        if not np.all(self.lower < self.upper):
            raise InputError("joint limits: lower >= upper, allowed: lower < upper for every joint")

    def __getstate__(self) -> dict[str, Any]:
        """What pickles: the CasADi functions do not, and are rebuilt where they are needed."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def of(cls, model: Model, **changes: Any) -> DesignProblem:
        """The problem of an arm's model within the arm's own joint limits and constraints; of a spatial arm with the
        prior of its machining, see `doe.problem.spatial`, and of one that touches a surface with postures at which it
        does, see `doe.problem.touching`."""
        if not hasattr(model, "arm"):
            raise InputError(f"model: {type(model).__name__}, allowed: a Model, such as Model(arm)")
        placed, measured, deviations = designed(model)
        of_arm: dict[str, Any] = {"constraints": constraints_of(placed), "deviations": deviations}
        free = cls(measured, model.arm.lower, model.arm.upper, **of_arm | changes)
        if not touches(placed) or free.choices is not None:
            return free
        return replace(free, choices=touching_postures(placed, free))

    @property
    def joints(self) -> int:
        """n, joints of a posture."""
        return int(self.lower.size)

    @cached_property
    def joint_units(self) -> Array:
        """(n,) what counts as one radian of each joint, where joints are compared: distances, steps, tolerances.

        1 rad of a revolute joint; of a prismatic one [mm] such that its range counts as one turn.
        """
        prismatic = [joint_type == PRISMATIC for joint_type in self.model.joint_types]
        return np.where(prismatic, (self.upper - self.lower) / (2.0 * np.pi), 1.0)

    def comparable(self, postures: Array) -> Array:
        """(..., n) postures in `joint_units`, in which one tolerance [rad] holds for every joint."""
        return np.asarray(postures / self.joint_units)

    @property
    def spacing(self) -> str:
        """The minimum distance in words."""
        stroke = " (360 deg: the range of a prismatic joint)" if PRISMATIC in self.model.joint_types else ""
        return f"{np.degrees(self.minimum_distance):g} deg{stroke}"

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
        return tuple(p.name for p in self.model.parameters if p.kind == EFFECT and p.name in self.deviations)

    @property
    def fewest_runs(self) -> int:
        """The smallest number of runs with as many equations as unknowns of which nothing is known: m d >= p."""
        missing = self.parameters - len(self.deviations) - self.model.dimension * len(self.kept)
        return max(1, -(-missing // self.model.dimension))

    def scaled_jacobians(self, postures: ArrayLike) -> Array:
        """(..., d, p) dimensionless Jacobians B of (..., n) postures: Jacobian columns over their scales."""
        angles = np.atleast_2d(np.asarray(postures, dtype=float))
        if angles.shape[-1] != self.joints:
            raise InputError(f"postures: shape {angles.shape}, allowed: (..., {self.joints})")
        return self._scaled_jacobians(angles)[0]

    def information(self, postures: ArrayLike, weights: Array | None = None) -> Array:
        """(p, p) information per run M' = S (sum_i w_i J_i^T J_i) S; the mean over runs without weights.

        Postures already measured (`kept`) count as runs; weights are the shares of the new runs only.
        """
        rows = np.atleast_2d(postures)
        shares = np.full(len(rows), 1.0 / len(rows)) if weights is None else weights
        return self.prior.per_new_run(len(rows)).information(self.weighted_information(rows, shares))

    def weighted_information(self, postures: Array, weights: Array) -> Array:
        """(p, p) sum of w_i B_i^T B_i of postures (m, n) with weights (m,), without what is known beforehand."""
        parts = (slice(k, k + PART) for k in range(0, len(postures), PART))  # Jacobians that stay in the cache
        return np.asarray(sum(information_matrix(self.scaled_jacobians(postures[k]), weights[k]) for k in parts))

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
            if not (left := np.flatnonzero(fits)).size:
                break  # most random postures fail the first that fails, and geometry takes time
            fits[left] = np.all(constraint.margin(flat[left]) >= 0.0, axis=1)
        return fits.reshape(np.shape(postures)[:-1])

    @cached_property
    def prior(self) -> PriorInformation:
        """The information of the postures measured already, and of what else is known beforehand."""
        if not len(self.kept) and not self.deviations:
            return PriorInformation()
        measured = information_matrix(self.scaled_jacobians(self.kept))
        return PriorInformation(measured + np.diag(self.precisions), len(self.kept))

    @cached_property
    def precisions(self) -> Array:
        """(p,) information of `deviations`, in scaled parameters and units of sigma; 0: nothing is known."""
        return precisions(self.model.parameters, self.deviations, self.model.sigma)

    @cached_property
    def scaled_jacobian_function(self) -> ca.Function:
        """CasADi q -> B (d, p) at neutral conditions and the model's best known parameter values."""
        q = ca.SX.sym("q", self.joints)
        arguments = (ca.DM(self.model.neutral_conditions), ca.DM(self.model.values))
        jacobian = self.model.jacobian_function(q, *arguments)[1]
        scaled = ca.cse(jacobian @ ca.diag(ca.DM(1.0 / self.model.parameters.scales)))
        return ca.Function("scaled_jacobian", [q], [scaled], ["q"], ["jacobian"])

    @cached_property
    def _scaled_jacobians(self) -> Callable[..., tuple[Array, ...]]:
        return vectorize(self.scaled_jacobian_function)

    @cached_property
    def without_effect(self) -> tuple[str, ...]:
        """Names of free parameters that move the tip at no posture, as thermal growth at the mean temperature."""
        cloud = np.random.default_rng(0).uniform(self.lower, self.upper, (16, self.joints))
        still = ~np.any(self.scaled_jacobians(cloud), axis=(0, 1)) & (self.precisions == 0.0)
        return tuple(name for name, zero in zip(self.model.parameters.names, still, strict=True) if zero)

    @cached_property
    def active_joints(self) -> tuple[int, ...]:
        """Joints (from 0) that change B^T B; the others, such as q_1 of the base model, are free for other purposes."""
        base, other = np.random.default_rng(0).uniform(self.lower, self.upper, (2, 16, self.joints))
        moved = np.where(np.eye(self.joints, dtype=bool)[:, None], other, base)  # (n, 16, n)
        before = information_of_each(self.scaled_jacobians(base))
        changes = np.abs(information_of_each(self.scaled_jacobians(moved)) - before).max(axis=(1, 2, 3))
        return tuple(np.flatnonzero(changes > 1e-9 * np.abs(before).max()).tolist())

    @cached_property
    def searched_joints(self) -> tuple[int, ...]:
        """Joints (from 0) that a solver must choose: the active ones, or all where constraints or a list tie them."""
        tied = bool(self.constraints) or self.choices is not None
        return tuple(range(self.joints)) if tied else self.active_joints


def information_of_each(jacobians: Array) -> Array:
    """(..., p, p) B^T B of every posture by itself, from (..., d, p) B."""
    return np.swapaxes(jacobians, -1, -2) @ jacobians
