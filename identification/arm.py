"""The arm: nominal geometry, how it is measured, what is known about it. Plain data, in millimetres and radians.

Joints and links are counted from 1 for people (`Effect.joint`, names) and from 0 in arrays.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array, ByValue, readonly
from identification.document import Document, Sheet, html
from identification.errors import InputError, require
from identification.kinematics import parameters
from identification.kinematics.chain import NOTHING, KinematicChain, planar_chain
from identification.kinematics.counting import Counting, JointKinds, range_of, turned_into
from identification.kinematics.frames import as_poses
from identification.kinematics.parameters import GEOMETRY, JOINT_OFFSET, LENGTH_ERROR, MAX_LINKS, REVOLUTE
from identification.workspace import Cell, ColumnLimits, WorkspaceConstraint

# what files may say: beyond these, squares overflow and sines of angles are noise
LARGEST = 1e9  # of any magnitude [mm, kg, m/s^2]
LARGEST_ANGLE = 1e6  # [deg]
LENGTH_RANGE = (1e-6, LARGEST)  # [mm] of a link
SIGMA_RANGE = (1e-9, LARGEST)  # [mm]

FEWEST = 4  # nodes of an error curve
SESSIONS, SERVO = "session_base", "servo_error"  # effects
OVERSHOOT = np.radians(0.01)  # what an angle that was read back differs from the one commanded
DIAGNOSED = "armcal diagnose"  # `source` of the calibrations that it writes
FREEDOM = "interval_dof"  # key of a calibration's provenance


@dataclass(frozen=True, eq=False)
class Gravity(ByValue):
    """Loads of an arm that moves in a vertical plane or in space; gravity torques need it."""

    acceleration: Array  # (d,) [m/s^2] in the base frame
    link_masses: Array  # (n,) [kg]
    center_of_mass: Array  # (n,) fraction of the link from its joint, or (n, 3) [mm] in the frame of that
    payload: float = 0.0  # [kg] at the tip
    payload_at: Array | None = None  # (3,) its center of mass in the tip's frame [mm]; None: at the measured point


@dataclass(frozen=True)
class Machining:
    """Standard deviations of the geometric errors of a spatial arm: the prior of its corrections."""

    translation: float = 1.0  # [mm]
    rotation: float = np.radians(0.5)  # [rad]


@dataclass(frozen=True, eq=False)
class ErrorCurve(ByValue):
    """A smooth function of one joint angle, by its values at equally spaced nodes: a cubic spline that ends at zero.

    It is a sum of cubic B-splines, one centered on each node (C. de Boor, "A Practical Guide to Splines", 1978). Beyond
    the first and the last node nothing is known: there the function goes smoothly to zero within two node spacings. A
    joint that was turned once around is where it was: encoder and gear repeat themselves there.

    start, stop : angle [rad] of the first and the last node;  values : (K,) of the function at the nodes [rad]
    geometry : parameter name -> the part of its value [mm, rad] that belongs to the curve, fitted together with it;
        shifts of the base along its own axes. Empty: not known
    """

    start: float
    stop: float
    values: Array
    geometry: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not -np.inf < self.start < self.stop < np.inf:
            problem = f"{np.degrees(self.start):g} to {np.degrees(self.stop):g}"
            raise InputError(f"from_deg, to_deg: found {problem}, allowed: finite angles, the lower one first")
        if len(self.values) < FEWEST or not np.all(np.isfinite(self.values)):
            problem = f"{len(self.values)} values"
            raise InputError(f"values_deg: found {problem}, allowed: {FEWEST} or more finite numbers")

    @classmethod
    def through(
        cls, start: float, stop: float, angles: Array, values: Array, count: int, geometry: Mapping[str, float]
    ) -> ErrorCurve:
        """The curve with so many nodes through values (a,) at angles (a,) [rad]; where none are near, the one whose
        steps from node to node are smallest, as those of a random walk are."""
        # numerical: a thousandth of the weight of a value; less than that changes no wave of eight nodes or more
        steps = np.sqrt(1e-3) * np.diff(np.eye(count), axis=0)
        target = np.concatenate([values, np.zeros(count - 1)])
        table = splines(np.concatenate([angles, np.linspace(start, stop, count)]), start, stop, count).toarray()
        at_nodes = table[-count:] @ np.linalg.lstsq(np.concatenate([table[:-count], steps]), target)[0]
        return cls(start, stop, np.radians(np.round(np.degrees(at_nodes), 7)), geometry)

    @property
    def spacing(self) -> float:
        """Angle from node to node [rad]."""
        return (self.stop - self.start) / (len(self.values) - 1)

    @cached_property
    def coefficients(self) -> Array:
        """(K,) of the B-splines."""
        nodes = np.linspace(self.start, self.stop, len(self.values))
        return readonly(np.linalg.solve(splines(nodes, self.start, self.stop, len(nodes)).toarray(), self.values))

    def at(self, angles: ArrayLike) -> Array:
        """The function at angles [rad] of any shape; an angle beyond the ends is looked up whole turns away."""
        q = np.asarray(angles, dtype=float)
        edge = 2.0 * self.spacing  # within which the function goes to zero
        beyond = (q < self.start - edge) | (q > self.stop + edge)
        q = np.where(beyond, self.start + np.mod(q - self.start, 2.0 * np.pi), q)
        return np.reshape(splines(q.ravel(), self.start, self.stop, len(self.values)) @ self.coefficients, q.shape)

    def holds(self, angles: ArrayLike) -> Array:
        """1 at angles [rad] between the ends, whole turns aside, and 0 beyond; smooth within two node spacings."""
        q, turn = np.asarray(angles, dtype=float), 2.0 * np.pi
        above, below = np.mod(q - self.stop, turn), np.mod(self.start - q, turn)
        inside = np.mod(q - self.start, turn) <= self.stop - self.start
        beyond = np.where(inside | (self.stop - self.start >= turn), 0.0, np.minimum(above, below))
        left = 1.0 - np.minimum(beyond / (2.0 * self.spacing), 1.0)
        return np.asarray(left**2 * (3.0 - 2.0 * left))


def splines(angles: Array, start: float, stop: float, count: int) -> Any:
    """(m, count) sparse table of the values at angles (m,) of cubic B-splines, one centered on each of the nodes."""
    from scipy.interpolate import BSpline

    in_nodes = np.clip((angles - start) * (count - 1) / (stop - start), -2.0, count + 1.0)
    return BSpline.design_matrix(in_nodes, np.arange(-5.0, count + 5.0), 3)[:, 3:-3]  # none is centered beyond the ends


@dataclass(frozen=True, eq=False)
class EffectSpec(ByValue):
    """An effect that is part of the arm's model. `values` are known and stay fixed; the others are estimated.

    An arm may have several of one name at one joint if their settings differ (gear ripples of k = 20 and k = 29).
    curve : the function that a `joint_error_curve` adds
    """

    name: str
    joint: int | None = None  # from 1
    values: Mapping[str, float] = field(default_factory=dict)  # parameter -> value, API units
    curve: ErrorCurve | None = None

    @property
    def key(self) -> str:
        """`name` or `name:joint`: what and where. Effects that share it are distinguished by `Effect.key`."""
        return self.name if self.joint is None else f"{self.name}:{self.joint}"


@dataclass(frozen=True, eq=False)
class Calibration(ByValue):
    """What an identification found; written by `armcal identify --out`.

    values : parameter name -> value [API units]: `length_error:1`, `joint_offset:1`, `effect:joint.parameter`, ...
    parameter_names : (p) order of the covariance;  covariance : (p, p) [API units]
    base, tools : of a spatial arm, where they were estimated: (4, 4) pose of the base [mm] and name -> (4, 4) that of
        each measured point [mm], or (3,) its place, with the values that correct them
    """

    values: Mapping[str, float]
    parameter_names: tuple[str, ...] = ()
    covariance: Array | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    base: Array | None = None
    tools: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tools", as_poses(self.tools))
        object.__setattr__(self, "values", {name: float(value) for name, value in self.values.items()})
        super().__post_init__()

    @classmethod
    def of(
        cls,
        length_errors: ArrayLike,
        joint_offsets: ArrayLike,
        effects: Mapping[str, float] = NOTHING,
        parameter_names: tuple[str, ...] = (),
        covariance: Array | None = None,
        provenance: Mapping[str, Any] = NOTHING,
    ) -> Calibration:
        """From (n,) length errors [mm] and (n,) joint offsets [rad] of a planar arm, and values of its effects. Raises
        `InputError` if the two differ in number."""
        errors, offsets = np.ravel(length_errors), np.ravel(joint_offsets)
        counted = f"calibration: found {len(errors)} length errors and {len(offsets)} joint offsets"
        require(len(errors) == len(offsets), f"{counted}, allowed: one of each for every joint")
        lists = {LENGTH_ERROR: errors.tolist(), JOINT_OFFSET: offsets.tolist()}
        values = {f"{kind}:{j}": x for kind, each in lists.items() for j, x in enumerate(each, start=1)}
        return cls(values | dict(effects), parameter_names, covariance, provenance)

    @property
    def length_errors(self) -> Array:
        """(n,) [mm]."""
        return parameters.by_joint(self.values, LENGTH_ERROR)

    @property
    def joint_offsets(self) -> Array:
        """(n,) [rad]."""
        return parameters.by_joint(self.values, JOINT_OFFSET)

    @property
    def scatter(self) -> float | None:
        """Residual standard deviation of one coordinate in its identification [mm], None: it does not say."""
        scatter = self.provenance.get("scatter_mm")
        return scatter if isinstance(scatter, float) and SIGMA_RANGE[0] <= scatter <= SIGMA_RANGE[1] else None

    @property
    def freedom(self) -> Array:
        """(p,) degrees of freedom of the variances of its `parameter_names`; infinite where it does not say."""
        kept = self.provenance.get(FREEDOM)
        stated = [kept.get(name) if isinstance(kept, Mapping) else kept for name in self.parameter_names]
        return np.array([x if isinstance(x, int | float) and x > 0.0 else np.inf for x in stated], dtype=float)

    def about(self, names: Iterable[str]) -> Calibration:
        """All values, with the covariance of these parameters only."""
        chosen = set(names)
        kept = [k for k, name in enumerate(self.parameter_names) if name in chosen]
        covariance = None if self.covariance is None else self.covariance[np.ix_(kept, kept)]
        return replace(self, parameter_names=tuple(self.parameter_names[k] for k in kept), covariance=covariance)

    @property
    def effects(self) -> dict[str, float]:
        """Values of the effects' parameters."""
        return {name: value for name, value in self.values.items() if not GEOMETRY.fullmatch(name)}


def check_limits(lower: Array, upper: Array, joint_types: Sequence[str]) -> None:
    """Raises `InputError` where a lower limit (n,) is not below the upper one [rad, mm]."""
    for j in np.flatnonzero(lower >= upper).tolist():
        unit, factor = ("deg", 180.0 / np.pi) if joint_types[j] == REVOLUTE else ("mm", 1.0)
        order = f"joint {j + 1} has lower {lower[j] * factor:g} >= upper {upper[j] * factor:g}"
        raise InputError(f"joint_limits_{unit}: {order}, allowed: lower < upper")


@dataclass(frozen=True, eq=False, repr=False)
class Arm(ByValue):
    """An arm of n joints."""

    chain: KinematicChain  # its geometry; n lengths of links [mm] stand for the planar arm of these links
    # (n,) joint limits [rad, mm]; None: those of the chain, -pi..pi of a planar arm. Warns of what looks like degrees
    lower: Array = None  # type: ignore[assignment]
    upper: Array = None  # type: ignore[assignment]
    sigma: float | None = None  # standard deviation of one measured coordinate [mm]; None: estimated from the data
    name: str = "arm"
    gravity: Gravity | None = None
    constraints: tuple[WorkspaceConstraint, ...] = ()
    effects: tuple[EffectSpec, ...] = ()
    calibration: Calibration | None = None
    gear_ratios: Array | None = None  # (n,) turns of each motor per turn of its joint, 0: not known; None: of no joint
    machining: Machining = Machining()  # what that geometry may be off by
    # of the controller's columns, commands and limits; None: as the model counts
    counting: Counting = None  # type: ignore[assignment]
    cell: Cell | None = None  # bodies that must not touch; None: nothing is known of any

    def __post_init__(self) -> None:
        chain: Any = self.chain
        if not isinstance(chain, KinematicChain):
            links = readonly(chain, -1)
            require(1 <= links.size <= MAX_LINKS, f"links_mm: {links.size} links, allowed: 1 to {MAX_LINKS}")
            require(bool(np.all(np.isfinite(links) & (links > 0))), f"links_mm: {links.tolist()}, allowed: lengths > 0")
            chain = planar_chain(links)
        n, turning = len(chain), np.array(chain.joint_types) == REVOLUTE
        require(1 <= n <= MAX_LINKS, f"links_mm: {n} links, allowed: 1 to {MAX_LINKS}")
        limits = {}
        for name in ("lower", "upper"):
            given = getattr(self, name)
            limits[name] = readonly([getattr(joint, name) for joint in chain.joints] if given is None else given, -1)
            size = limits[name].size
            require(size == n, f"joint_limits_deg.{name}: {size} values for {n} links, allowed: {n}")
            require(bool(np.all(np.isfinite(limits[name]))), f"joint_limits_deg.{name}: values must be finite")
        lower, upper = limits.values()
        check_limits(lower, upper, chain.joint_types)
        farther = np.where(-lower > upper, lower, upper) * turning
        worst = int(np.argmax(np.abs(farther)))
        if abs(farther[worst]) > 10.0 * np.pi + 1e-6:  # [rad] no arm turns a joint farther; degrees do
            limit = f"limit {farther[worst]:g} of joint {worst + 1} is {abs(farther[worst]) / (2.0 * np.pi):.0f} turns"
            message = f"Arm: {limit} and looks like degrees; lower and upper are in radians"
            warnings.warn(message, UserWarning, stacklevel=3)
        if self.sigma is not None:
            require(np.isfinite(self.sigma) and self.sigma > 0, f"sigma_mm: {self.sigma}, allowed: > 0")
        ratios = None if self.gear_ratios is None else readonly(self.gear_ratios, -1)
        if ratios is not None:
            good = ratios.size == n and bool(np.all(np.isfinite(ratios) & (ratios >= 0.0)))
            require(good, f"gear_ratio: found {ratios.tolist()}, allowed: {n} numbers >= 0, one for each joint")
        counting = self.counting or Counting.usual(n)
        counting.check(chain.joint_types)
        for field_name, value in ({"chain": chain, "gear_ratios": ratios, "counting": counting} | limits).items():
            object.__setattr__(self, field_name, value)

    def __repr__(self) -> str:
        """In one line: its fields are pages of matrices."""
        more = [*(spec.key for spec in self.effects), *(["calibrated"] if self.calibration else [])]
        return f"Arm({', '.join([self.name, f'{self.links} joints, reach {self.reach:.6g} mm', *more])})"

    @cached_property
    def links(self) -> int:
        """n, the number of links (and joints)."""
        return len(self.chain)

    @property
    def lengths(self) -> Array:
        """(n,) nominal lengths [mm] of the links."""
        return self.chain.lengths

    @property
    def dimension(self) -> int:
        """d, coordinates of a measured position: 2 in the plane, 3 in space."""
        return self.chain.dimension

    @property
    def joint_types(self) -> JointKinds:
        """(n) `revolute` or `prismatic`, with how the controller counts them."""
        return JointKinds(self.chain.joint_types, self.counting)

    @property
    def column_limits(self) -> tuple[Array, Array]:
        """(n,) lower and upper limits of what the controller shows [rad, mm]; NaN of joints that it counts together
        with others and for which there are no `ColumnLimits`."""
        counting = self.counting
        limits = np.sort(counting.columns(np.stack([self.lower, self.upper])), axis=0)
        limits[:, list(counting.coupled)] = np.nan
        for tied in (each for each in self.constraints if isinstance(each, ColumnLimits)):
            j = tied.joint - 1
            limits[:, j] = np.sort(counting.sign[j] * np.array([tied.lower, tied.upper]) + counting.zero[j])
        return limits[0], limits[1]

    @property
    def provenance(self) -> Mapping[str, Any]:
        """What its calibration records about its data."""
        return {} if self.calibration is None else self.calibration.provenance

    def require_calibrated(self, file: str | None = None) -> None:
        """Raises `InputError` where it has neither a calibration nor known effect values;  file : that it is from"""
        lacks = "calibration: the arm has none" if file is None else f"{file}: has no [calibration]"
        has = self.calibration is not None or any(spec.values for spec in self.effects)
        require(has, f"{lacks}, allowed: an arm file written by `armcal identify --out`")

    def outside(self, postures: Array) -> NDArray[np.bool_] | None:
        """(m, n) True where a joint is outside the angles of the identification, whole turns aside; None: not known."""
        if (limits := range_of(self.provenance, self.joint_types)) is None:  # (2, n) [rad, mm]
            return None
        (lower, upper), read = limits, np.radians(1e-6)  # what the digits of a file take from an angle
        q = turned_into(postures, lower, upper, self.joint_types, read)
        room = read * np.maximum(1.0, np.abs(limits))  # a file has nine digits: of a slide's millimetres fewer decimals
        return (q < lower - room[0]) | (q > upper + room[1])

    @property
    def limited(self) -> NDArray[np.bool_]:
        """(n,) joints whose limits are given."""
        return np.asarray((np.abs(self.lower + np.pi) > OVERSHOOT) | (np.abs(self.upper - np.pi) > OVERSHOOT))

    def beyond_limits(self, postures: Array) -> NDArray[np.bool_]:
        """(m, n) True where a joint lies outside its limits, one that is counted together with others outside those of
        the controller; limits left out do not count."""
        beyond = self.limited & ((postures < self.lower - OVERSHOOT) | (postures > self.upper + OVERSHOOT))
        for tied in (each for each in self.constraints if isinstance(each, ColumnLimits)):
            column = postures @ np.array(tied.coefficients)
            beyond[:, tied.joint - 1] = (column < tied.lower - OVERSHOOT) | (column > tied.upper + OVERSHOOT)
        return beyond

    def servo_shift(self, directions: Array) -> Array:
        """(k, n) what is read beyond a command [rad, mm], for directions of approach (k, n)."""
        shift = np.zeros(directions.shape)
        for spec in self.effects:
            if spec.name == SERVO and spec.joint is not None:
                sign = directions[:, spec.joint - 1]
                shift[:, spec.joint - 1] = spec.values.get("b", 0.0) + spec.values.get("h", 0.0) * sign
        return shift

    @property
    def payload(self) -> float:
        """[kg] at the tip, 0 if not given."""
        return 0.0 if self.gravity is None else self.gravity.payload

    @property
    def reach(self) -> float:
        """Length of the stretched nominal arm [mm]."""
        return self.chain.reach

    def with_effects(self, *effects: EffectSpec) -> Arm:
        """The same arm with these effects instead of its own."""
        return replace(self, effects=tuple(effects))

    def with_base(self, anew: bool = False) -> Arm:
        """The arm with the effects that say where it stands, its own where it has them;  anew : their values are to be
        estimated"""
        kept = [spec for spec in self.effects if not anew or spec.name not in self.chain.standing_effects]
        missing = {*self.chain.standing_effects} - {spec.name for spec in kept}
        return self.with_effects(*kept, *(EffectSpec(name) for name in self.chain.standing_effects if name in missing))

    def _repr_html_(self) -> str:
        """A line about the arm and a table of its joints, for notebooks."""
        effects = ", ".join(spec.key for spec in self.effects) or "none"
        summary = f"{self.name}: reach {self.reach:.6g} mm, effects {effects}"
        rows, columns = [], (self.joint_types, self.lengths, self.lower, self.upper)
        for j, (kind, length, *limits) in enumerate(zip(*columns, strict=True), start=1):
            low, high = (f"{np.degrees(x):.6g} deg" if kind == REVOLUTE else f"{x:g} mm" for x in limits)
            rows.append((str(j), kind, f"{length:.6g}", low, high))
        return html(Document(parts=[summary, Sheet(("joint", "type", "length [mm]", "lower", "upper"), rows)]))
