"""The model of an arm with its effects: position of the tip and exact Jacobian, written once in CasADi.

    position = sum_j (l_j + dl_j) exp(i (theta_j + dtheta_j)),   dtheta_j = dq_1 + ... + dq_j        (paper, eq. 1)

Parameters are the length errors dl_j [mm], the joint offsets dq_j [rad] and those of the effects; of arms in space see
identification/kinematics/chain.py.

A model has two stages. Symbols: chain, effects and instrument make one expression of posture q, conditions c and
parameters p, and its derivatives. Numbers: a compiled function of these runs on arrays of postures. Both cost more than
most uses, and searches ask for hundreds of models, so models that have the same symbols share them: the first of these
(`expressions`) keeps what any of them needed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from identification.arm import DIAGNOSED, Arm, ErrorCurve
from identification.arrays import Array, slices
from identification.effects import ArmState, Effect, build_all
from identification.effects.base import position_and_state, widths
from identification.errors import InputError
from identification.kinematics.chain import ROTATION_ERROR, TRANSLATION_ERROR, PlanarClosedForm
from identification.kinematics.frames import turned
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet
from identification.measurements import Conditions, condition_columns
from identification.vectorized import Evaluate, vectorize

Given = ArrayLike | None
When = Conditions | None
# symbols -> the first model with these, once it is in the list; effort: models set up
_first = lru_cache(maxsize=128)(lambda symbols: list["Model"]())


@dataclass(frozen=True)
class Model:
    """Arm and effects as a function of p parameters.

    held : parameter name -> value [mm, rad] of parameters that are not estimated, besides those that the arm's own
        effects fix
    """

    arm: Arm
    held: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for name in self.held or {}:
            self.all_parameters.index(name)  # raises for an unknown one

    def __getstate__(self) -> dict[str, Any]:
        """What pickles: the CasADi functions do not, and are rebuilt where they are needed."""
        return {"arm": self.arm, "held": self.held}

    # -- parameters ------------------------------------------------------------------------------------------------
    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """The arm's effects on the mean, ready for the chain; `simulate` handles those on scatter and commands."""
        return tuple(e for e in build_all(self.arm.effects, self.arm.chain) if not (e.scatter or e.of_commands))

    @cached_property
    def geometry_parameters(self) -> ParameterSet:
        """Those of the geometry, estimated or known."""
        return self.arm.chain.parameters(self._calibrated | dict(self.held or {}))

    @cached_property
    def all_parameters(self) -> ParameterSet:
        """Every parameter, estimated or known: those of the geometry, then those of the effects."""
        return ParameterSet((*self.geometry_parameters, *(p for effect in self.effects for p in effect.parameters)))

    @cached_property
    def fixed(self) -> Mapping[str, float]:
        """Name -> value of the parameters that are known."""
        values = {name: self._calibrated.get(name, 0.0) for name in self.arm.chain.unestimated} | dict(self.held or {})
        for effect in self.effects:
            values |= {p.name: float(effect.fixed[p.short]) for p in effect.parameters if p.short in effect.fixed}
        return values

    @cached_property
    def parameters(self) -> ParameterSet:
        """(p) the parameters that are estimated, in the order of every parameter vector."""
        return ParameterSet(p for p in self.all_parameters if p.name not in self.fixed)

    @property
    def prior(self) -> dict[str, float]:
        """Name -> standard deviation before the data [API unit] of the errors of a spatial arm's geometry; empty in the
        plane, and for a minimal set, which needs none."""
        if not self.arm.chain.redundant:
            return {}
        sizes = {"mm": self.arm.machining.translation, "rad": self.arm.machining.rotation}
        kinds = (TRANSLATION_ERROR, ROTATION_ERROR, JOINT_OFFSET)
        return {p.name: sizes[p.unit] for p in self.parameters if p.kind in kinds}

    names = property(attrgetter("parameters.names"))  # (p) of the estimated parameters
    # (p,) length per unit of each parameter [mm/unit]; column k of the Jacobian divided by it is about one
    scales = property(attrgetter("parameters.scales"))

    dimension = property(attrgetter("arm.chain.coordinates"))  # d per posture: 2, 3, 6 of a pose, or 1 of a length

    @property
    def dimensions(self) -> tuple[int, ...]:
        """Coordinates that measurements may have: of poses also those of points alone."""
        return tuple(sorted({min(self.arm.dimension, self.dimension), self.dimension}))

    joints = property(attrgetter("arm.links"))  # n, joints of a posture
    joint_types = property(attrgetter("arm.joint_types"))  # (n) `revolute` or `prismatic`
    sigma = property(attrgetter("arm.sigma"))  # standard deviation of a measured coordinate [mm], None: not known
    reach = property(attrgetter("arm.reach"))  # length of the stretched nominal arm [mm]

    @cached_property
    def values(self) -> Array:
        """(p,) best known values: the calibration's where the arm has one, else zero."""
        return self.parameters.vector(self._calibrated)

    @property
    def best_known(self) -> dict[str, float]:
        """Name -> best known value of every parameter, estimated or known."""
        return self.parameters.mapping(self.values) | dict(self.fixed)

    @property
    def _calibrated(self) -> dict[str, float]:
        return {} if self.arm.calibration is None else dict(self.arm.calibration.values)

    @property
    def needs(self) -> frozenset[str]:
        """What the effects need of arm and data: gravity, directions, temperature, time, past."""
        return frozenset().union(*(effect.needs for effect in self.effects))

    def afterwards(self, conditions: Conditions, rows: int) -> Conditions:
        """The conditions of so many rows of a later session: what happened once (`Effect.once`) has come to its end."""
        return conditions.afterwards(rows) if any(effect.once for effect in self.effects) else conditions

    @property
    def complete(self) -> bool:
        """Whether effects have been looked for: the calibration is that of a diagnosis, or has values of effects beside
        the base pose, as a diagnosed model that was identified again."""
        names = {p.name for effect in self.effects if effect.name != "base_offset" for p in effect.parameters}
        return self.arm.provenance.get("source") == DIAGNOSED or not names.isdisjoint(self._calibrated)

    @cached_property
    def closed_form(self) -> PlanarClosedForm | None:
        """Least squares in closed form for lengths and offsets, as if there were no other effects than a base offset;
        None in space, and where a length or an offset is known."""
        chain, parameters = self.arm.chain, self.parameters
        own = [*parameters.length_errors, *parameters.joint_offsets]
        if not chain.as_in_paper or len(own) < 2 * len(chain):
            return None
        base = [k for k, name in enumerate(parameters.names) if name in chain.base_shift]
        indices = np.array(own + base if len(base) == 2 else own)
        alone = len(indices) == len(parameters) and not (self.fixed or any(effect.tabulated for effect in self.effects))
        return PlanarClosedForm(chain.lengths, len(base) == 2, indices, alone)

    # -- symbols ---------------------------------------------------------------------------------------------------
    @cached_property
    def expressions(self) -> "Model":
        """The first model with all that is in these symbols: limits, sigma and the name of an arm, say, are not; of
        effects the class is, as users can redefine one, and what it was made with."""
        effects = ((type(e), e.joint, e.tagged, e.curve, *e.chosen.items()) for e in self.effects)
        names = self.all_parameters.names, self.names, *self.fixed.items()
        alike = _first((self.arm.chain, self.arm.gravity, *effects, names, tuple(self._columns)))
        alike += [] if alike else [self]
        return alike[0]

    @cached_property
    def _columns(self) -> dict[str, slice]:
        """Where each condition stands among the columns of the table."""
        chain = self.arm.chain
        several = max(len(chain.tools), len(chain.instrument.targets)) > 1  # reflectors, or targets
        further = ("past",) * ("past" in self.needs) + ("marker",) * several
        further += ("orientation",) * (chain.angle_scale is not None) + ("errors", "off") * bool(self._curves)
        return condition_columns(self.joints, further)

    @cached_property
    def _curves(self) -> list[tuple[int, ErrorCurve]]:
        """Error curves, each with its joint from 0."""
        return [(effect.joint_index, effect.curve) for effect in self.effects if effect.curve is not None]

    @cached_property
    def _tied(self) -> dict[str, float]:
        """Parameter name -> the part of its value that was fitted with error curves."""
        names = [name for _, curve in self._curves for name in curve.geometry]
        return {name: sum(curve.geometry.get(name, 0.0) for _, curve in self._curves) for name in names}

    @cached_property
    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """SX of postures q (n), conditions c (see `condition_table`), parameters (p) and position (d): of a pose the
        point, and the rotation vector by which the computed orientation is turned against the measured one, times
        `angle_scale` [mm]."""
        if self.expressions is not self:
            return self.expressions.symbols
        width = max(place.stop for place in self._columns.values())
        q, c, p = ca.SX.sym("q", self.arm.links), ca.SX.sym("c", width), ca.SX.sym("p", len(self.parameters))
        return q, c, p, position_and_state(self.chain_at(q, c), self.effects, self.values_at(c, p))[0]

    def chain_at(self, q: ca.SX, c: ca.SX) -> ArmState:
        """The nominal chain at the symbols of a posture and its conditions."""
        return ArmState.of(self.arm, q, c, self._columns)

    def values_at(self, c: ca.SX, p: ca.SX) -> ca.SX:
        """Values of every parameter, where p has those of the estimated ones; where error curves do not hold, without
        the geometry of these."""
        slot = {name: p[k] for k, name in enumerate(self.names)}
        values = {name: slot.get(name, self.fixed.get(name, 0.0)) for name in self.all_parameters.names}
        off = {**self._tied, **self.arm.chain.along_base(self._tied, values)} if self._tied else {}
        return ca.vertcat(*(value - c[-1] * off[name] if name in off else value for name, value in values.items()))

    def _function(self, outputs: list[ca.SX], *more: ca.SX) -> ca.Function:
        """CasADi (q, c, p, more) -> outputs."""
        return ca.Function("model", [*self.symbols[:3], *more], ca.cse(outputs))

    @cached_property
    def _position(self) -> Evaluate:
        return vectorize(ca.Function("position", self.symbols[:3], self.symbols[3:]))

    @cached_property
    def _jacobian(self) -> Evaluate:
        _, _, p, position = self.symbols
        return vectorize(self._function([position, ca.jacobian(position, p)]))

    @cached_property
    def residual_gradient(self) -> Evaluate:
        """Of arrays (q, c, p, measured y): J^T (y - position) (p) by reverse mode, and |y - position|^2."""
        _, _, p, position = self.symbols
        y = ca.SX.sym("y", position.numel())
        left = y - position
        return vectorize(self._function([ca.jtimes(position, p, left, True), ca.sumsqr(left)], y))

    @cached_property
    def posture_jacobian(self) -> Evaluate:
        """Of arrays (q, c, p): position and its derivative with respect to the posture, (d, n)."""
        q, _, _, position = self.symbols
        return vectorize(self._function([position, ca.jacobian(position, q)]))

    @cached_property
    def _place_levers(self) -> Evaluate:
        """Derivative of the position by what is added at all places of the chain, where nothing is; and the state."""
        q, c, p, _ = self.symbols
        added = ca.SX.sym("added", sum(widths(self.arm.chain).values()))
        position, state = position_and_state(self.chain_at(q, c), self.effects, self.values_at(c, p), added)
        outputs = [ca.jacobian(position, added), state]
        return vectorize(self._function(ca.substitute(outputs, [added], [ca.SX.zeros(added.numel())])))

    @cached_property
    def _orientation(self) -> Evaluate:
        """Of arrays (q, marker, values of the geometry): the measured frame's axes for the instrument, (3, 3)."""
        q, marker, names = ca.SX.sym("q", self.joints), ca.SX.sym("marker"), self.geometry_parameters.names
        values = ca.SX.sym("values", len(names))
        chain, named = self.arm.chain, dict(zip(names, ca.vertsplit(values), strict=True))
        axes = chain.measured(chain.frames(q, named)[-1], named, marker).axes
        return vectorize(ca.Function("orientation", [q, marker, values], [ca.cse(axes)]))

    @cached_property
    def geometry(self) -> dict[str, float]:
        """Best known values of `geometry_parameters`."""
        known = self.best_known
        return {name: known[name] for name in self.geometry_parameters.names}

    # -- batches ---------------------------------------------------------------------------------------------------
    def position(self, postures: ArrayLike, parameters: Given = None, conditions: When = None) -> Array:
        """(m, d) tip positions [mm] at (m, n) postures [rad]; (K, m, d) for (K, p) parameter sets."""
        return self.expressions._position(*self._arguments(postures, parameters, conditions))[0][..., 0]

    def linearize(self, postures: ArrayLike, parameters: Given = None, conditions: When = None) -> tuple[Array, Array]:
        """Positions (..., m, d) and Jacobians (..., m, d, p) in one pass."""
        position, jacobian = self.expressions._jacobian(*self._arguments(postures, parameters, conditions))
        return position[..., 0], jacobian

    def jacobian(self, postures: ArrayLike, parameters: Given = None, conditions: When = None) -> Array:
        """(m, d, p) exact derivative of position with respect to parameters; (K, m, d, p) for (K, p) parameter sets."""
        return self.linearize(postures, parameters, conditions)[1]

    def orientations(self, postures: ArrayLike, conditions: When = None) -> Array:
        """(m, 3, 3) orientations of the measured frame for the instrument, as best known, whatever orientations the
        conditions have; raises `InputError` where none is measured."""
        if (scale := self.arm.chain.angle_scale) is None:
            raise InputError("orientations: the arm measures none, allowed: with sigma_mm and sigma_deg in its file")
        arguments = self._arguments(postures, None, conditions)
        nominal = arguments[1][..., self._columns["orientation"]]
        nominal = nominal.reshape(*nominal.shape[:-1], 3, 3)
        return turned(self.expressions._position(*arguments)[0][..., 3:, 0] / scale) @ nominal

    def joint_levers(self, postures: ArrayLike, parameters: Given = None, conditions: When = None) -> Array:
        """(m, d, n) derivative of the positions with respect to each joint's own offset [mm/rad], be that offset
        estimated or not; (K, m, d, n) for (K, p) parameter sets."""
        at_joints = slices(widths(self.arm.chain))["joint_angles"]
        return self.place_levers(postures, parameters, conditions)[0][..., at_joints]

    def place_levers(self, postures: ArrayLike, parameters: Given, conditions: When) -> tuple[Array, Array]:
        """What effects act through: (m, d, P) derivative of the positions by what is added at each place of the chain,
        and (m, S) the state that it may depend on (effects/base.py)."""
        levers, state = self.expressions._place_levers(*self._arguments(postures, parameters, conditions))
        return levers, state[..., 0]

    def points(self, postures: ArrayLike) -> Array:
        """(m, n + 1, d) base, joints and tip [mm] at (m, n) postures [rad], as the geometry is best known; in space
        n + 2 points, the tip's being the first that is measured.

        In the frame of the base, without effects: for constraints and pictures; `position` is what is measured.
        """
        return self.arm.chain.points(self._postures(postures), self.geometry)

    def torques(self, postures: ArrayLike, conditions: When = None) -> Array:
        """(m, n) gravity torques of the nominal arm, `ArmState.torques`. Raises `InputError` without gravity."""
        q, c = self.expressions.symbols[:2]
        torques = ca.Function("torques", [q, c], [ca.cse(ca.densify(self.chain_at(q, c).torques))])
        return vectorize(torques)(*self._arguments(postures, None, conditions)[:2])[0][..., 0]

    def _postures(self, postures: ArrayLike) -> Array:
        q = np.atleast_2d(np.asarray(postures, dtype=float))
        if q.ndim != 2 or q.shape[1] != self.joints:
            raise InputError(f"postures: shape {np.shape(postures)}, allowed: (m, {self.joints})")
        return q

    def _arguments(self, postures: ArrayLike, parameters: Given, conditions: When) -> tuple[Array, Array, Array]:
        q = self._postures(postures)
        p = self.values if parameters is None else np.asarray(parameters, dtype=float)
        if p.shape[-1:] != (len(self.parameters),):
            raise InputError(f"parameters: shape {p.shape}, allowed: (..., {len(self.parameters)})")
        return q, self.condition_table(q, conditions or Conditions()), p[..., None, :]

    def condition_table(self, postures: Array, conditions: Conditions) -> Array:
        """(..., m, C) values of the symbols for conditions (`Conditions.table`); orientations that are not measured are
        those of the arm as best known, and tables are looked up here: as formulas they would be thousands of terms."""
        at = self._columns
        table = conditions.table(at, postures, self.arm.payload)
        if "orientation" in at and conditions.orientation is None:
            marker, values = table[..., at["marker"]] if "marker" in at else np.zeros(1), [*self.geometry.values()]
            axes = self.expressions._orientation(postures, marker, values)[0]
            table[..., at["orientation"]] = axes.reshape(*axes.shape[:-2], 9)
        if "errors" in at:
            # 1, 0, or between. A curve takes up other effects, too, as they are at the postures measured: beyond the
            # angles of one joint the curves of the others are worth no more than its own
            hold = np.ones(postures.shape[:-1])
            for joint, curve in self._curves if self._tied else ():
                hold *= curve.holds(postures[..., joint])
            for joint, curve in self._curves:  # they hold together
                table[..., at["errors"].start + joint] = hold * curve.at(postures[..., joint])
            table[..., at["off"]] = 1.0 - hold[..., None]  # the share of their geometry that is off
        return table
