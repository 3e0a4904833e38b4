"""The model of an arm with its effects: position of the tip and exact Jacobian, written once in CasADi.

    position = sum_j (l_j + dl_j) exp(i (theta_j + dtheta_j)),   dtheta_j = dq_1 + ... + dq_j        (paper, eq. 1)

Parameters are the length errors dl_j [mm], the joint offsets dq_j [rad] and those of the effects. The derivative with
respect to the ORIENTATION offset dtheta_k touches link k only (eq. 8); that with respect to the joint offset dq_k sums
over links k..n, which is what eq. 4 prints. For arms in space see identification/kinematics/chain.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.conditions import Conditions
from identification.effects import Chain, Effect, build_all
from identification.errors import InputError
from identification.kinematics.chain import ROTATION_ERROR, TRANSLATION_ERROR
from identification.kinematics.closed_form import PlanarClosedForm
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet
from identification.model.expressions import Expressions, shared


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
        return tuple(effect for effect, _ in self._built if not (effect.scatter or effect.of_commands))

    @cached_property
    def _built(self) -> tuple[tuple[Effect, EffectSpec], ...]:
        effects = build_all(self.arm.effects, self.arm.chain)
        return tuple(zip(effects, self.arm.effects, strict=True))

    @cached_property
    def geometry_parameters(self) -> ParameterSet:
        """Those of the geometry, estimated or known."""
        return self.arm.chain.parameters(self._calibrated() | dict(self.held or {}))

    @cached_property
    def all_parameters(self) -> ParameterSet:
        """Every parameter, estimated or known: those of the geometry, then those of the effects."""
        return ParameterSet.of((*self.geometry_parameters, *(p for effect in self.effects for p in effect.parameters)))

    @cached_property
    def fixed(self) -> Mapping[str, float]:
        """Name -> value of the parameters that are known."""
        values = {name: self._calibrated().get(name, 0.0) for name in self.arm.chain.held} | dict(self.held or {})
        for effect, spec in self._built:
            if not (effect.scatter or effect.of_commands):
                values |= {p.name: float(spec.values[p.short]) for p in effect.parameters if p.short in spec.values}
        return values

    @cached_property
    def parameters(self) -> ParameterSet:
        """(p) the parameters that are estimated, in the order of every parameter vector."""
        return ParameterSet.of(p for p in self.all_parameters if p.name not in self.fixed)

    @property
    def prior(self) -> dict[str, float]:
        """Name -> standard deviation before the data [API unit] of the errors of a spatial arm's geometry; empty in the
        plane, and for a minimal set, which needs none."""
        if not self.arm.chain.redundant:
            return {}
        sizes = {"mm": self.arm.machining.translation, "rad": self.arm.machining.rotation}
        kinds = (TRANSLATION_ERROR, ROTATION_ERROR, JOINT_OFFSET)
        return {p.name: sizes[p.unit] for p in self.parameters if p.kind in kinds}

    @property
    def names(self) -> tuple[str, ...]:
        """(p) names of the estimated parameters."""
        return self.parameters.names

    @property
    def dimension(self) -> int:
        """d, measured coordinates per posture: 2, 3, 6 of a pose, or 1 of a length."""
        return self.arm.chain.coordinates

    @property
    def joints(self) -> int:
        """n, joints of a posture."""
        return self.arm.links

    @property
    def joint_types(self) -> tuple[str, ...]:
        """(n) `revolute` or `prismatic`."""
        return self.arm.joint_types

    @property
    def sigma(self) -> float | None:
        """Standard deviation of a measured coordinate [mm], None: the arm does not say."""
        return self.arm.sigma

    @property
    def reach(self) -> float:
        """Length of the stretched nominal arm [mm]."""
        return self.arm.reach

    @property
    def scales(self) -> Array:
        """(p,) length per unit of each parameter [mm/unit]; column k of the Jacobian divided by it is about one."""
        return self.parameters.scales

    @cached_property
    def values(self) -> Array:
        """(p,) best known values: the calibration's where the arm has one, else zero."""
        return self.parameters.vector(self._calibrated())

    @property
    def best_known(self) -> dict[str, float]:
        """Name -> best known value of every parameter, estimated or known."""
        return self.parameters.mapping(self.values) | dict(self.fixed)

    def _calibrated(self) -> dict[str, float]:
        return {} if self.arm.calibration is None else dict(self.arm.calibration.values)

    @property
    def needs(self) -> frozenset[str]:
        """What the effects need of arm and data: gravity, directions, temperature, time, past."""
        return frozenset().union(*(effect.needs for effect in self.effects))

    @property
    def remembers(self) -> bool:
        """True if an effect depends on the postures measured before."""
        return "past" in self.needs

    @property
    def linear_in_links(self) -> bool:
        """True if the tip is a complex linear function of l_j exp(i dtheta_j): nothing known, at most a base offset."""
        return self.closed_form is not None and self.closed_form.exact

    @cached_property
    def closed_form(self) -> PlanarClosedForm | None:
        """Least squares in closed form for lengths and offsets, as if there were no other effects than a base offset.

        None in space, and where a length or an offset is known.
        """
        others = bool(self.fixed) or any(effect.tabulated for effect in self.effects)
        return self.arm.chain.closed_form(self.parameters, others)

    # -- symbols ---------------------------------------------------------------------------------------------------
    @cached_property
    def expressions(self) -> Expressions:
        """The model in CasADi symbols, shared with models that have the same."""
        curved = any(effect.curve is not None for effect in self.effects)
        chain = self.arm.chain
        several = max(len(chain.tools), len(chain.instrument.targets)) > 1  # reflectors, or targets
        oriented = chain.angle_scale is not None
        extra = {"past": self.remembers, "marker": several, "orientation": oriented, "errors": curved}
        has = tuple(name for name, there_is in extra.items() if there_is)
        parts = (self.effects, self.all_parameters, self.parameters, self.fixed, has, self.best_known)
        return shared(Expressions(self.arm, *parts))

    @property
    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """SX of postures q (n), conditions c (see `condition_table`), parameters (p) and position (d)."""
        return self.expressions.symbols

    @property
    def position_function(self) -> ca.Function:
        """CasADi (q, c, p) -> position (d) [mm]."""
        return self.expressions.position_function

    @property
    def jacobian_function(self) -> ca.Function:
        """CasADi (q, c, p) -> position (d) [mm] and its exact derivative with respect to the parameters (d, p)."""
        return self.expressions.jacobian_function

    def symbolic_points(self, q: ca.SX) -> list[ca.SX]:
        """Points (d,) of base, joints and tip [mm] at a posture (n,) [rad], as `points` gives them."""
        return self.arm.chain.symbolic_points(q, self._geometry_values)

    @cached_property
    def _geometry_values(self) -> Array:
        """Best known values of `geometry_parameters`."""
        return self.geometry_parameters.vector(self.best_known)

    @property
    def dimensions(self) -> tuple[int, ...]:
        """Coordinates that measurements may have: of poses also those of points alone."""
        return tuple(sorted({min(self.arm.dimension, self.dimension), self.dimension}))

    # -- batches ---------------------------------------------------------------------------------------------------
    def position(
        self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Conditions | None = None
    ) -> Array:
        """(m, d) tip positions [mm] at (m, n) postures [rad]; (K, m, d) for (K, p) parameter sets.

        Postures (K, m, n), with conditions (K, m), are K plans, each with its own parameter set or all with one.
        """
        return self.expressions.position(*self._arguments(postures, parameters, conditions))[0][..., 0]

    def orientations(self, postures: ArrayLike, conditions: Conditions | None = None) -> Array:
        """(m, 3, 3) orientations of the measured frame for the instrument, as best known."""
        return self.expressions.orientations(*self._arguments(postures, None, conditions))

    def jacobian(
        self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Conditions | None = None
    ) -> Array:
        """(m, d, p) exact derivative of position with respect to parameters; (K, m, d, p) for (K, p) parameter sets."""
        return self.linearize(postures, parameters, conditions)[1]

    def linearize(
        self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Conditions | None = None
    ) -> tuple[Array, Array]:
        """Positions (..., m, d) and Jacobians (..., m, d, p) in one pass."""
        position, jacobian = self.expressions.jacobian(*self._arguments(postures, parameters, conditions))
        return position[..., 0], jacobian

    def joint_levers(
        self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Conditions | None = None
    ) -> Array:
        """(m, d, n) derivative of the positions with respect to each joint's own offset [mm/rad], be that offset
        estimated or not; (K, m, d, n) for (K, p) parameter sets."""
        offsets = self.parameters.indices(JOINT_OFFSET)
        if len(offsets) == self.joints:  # compiled already: they are columns of the Jacobian
            return self.jacobian(postures, parameters, conditions)[..., offsets]
        return self.expressions.joint_levers(*self._arguments(postures, parameters, conditions))[0]

    def place_levers(
        self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Conditions | None = None
    ) -> tuple[Array, Array]:
        """What effects act through: (m, d, P) derivative of the positions by what is added at each place of the chain,
        and (m, S) the state that it may depend on (effects/chain.py)."""
        levers, state = self.expressions.place_levers(*self._arguments(postures, parameters, conditions))
        return levers, state[..., 0]

    def points(self, postures: ArrayLike) -> Array:
        """(m, n + 1, d) base, joints and tip [mm] at (m, n) postures [rad], as the geometry is best known; in space
        n + 2 points, the tip's being the first that is measured.

        In the frame of the base, without effects: for constraints and pictures; `position` is what is measured.
        """
        return self.arm.chain.points(self._postures(postures), self._geometry_values)

    def on_chain(self, expression: Callable[[Chain], ca.SX]) -> Callable[[ArrayLike, Conditions | None], Array]:
        """Numpy function of (m, n) postures and conditions that gives an expression of the nominal chain, (m, rows)."""
        evaluate = self.expressions.on_chain(expression)
        return lambda postures, conditions: evaluate(*self._arguments(postures, None, conditions)[:2])[0][..., 0]

    @property
    def neutral_conditions(self) -> Array:
        """(4+n,) conditions where nothing is said: the arm's payload, mean temperature, the middle of session 1,
        approach +1; with a memory, of zero angles; of several markers the first; no orientation measured."""
        return self.expressions.neutral

    def _postures(self, postures: ArrayLike) -> Array:
        q = np.atleast_2d(np.asarray(postures, dtype=float))
        if q.ndim not in (2, 3) or q.shape[-1] != self.joints:
            raise InputError(f"postures: shape {np.shape(postures)}, allowed: (m, {self.joints})")
        return q

    def _arguments(
        self, postures: ArrayLike, parameters: ArrayLike | None, conditions: Conditions | None
    ) -> tuple[Array, Array, Array]:
        q = self._postures(postures)
        p = self.values if parameters is None else np.asarray(parameters, dtype=float)
        if p.shape[-1:] != (len(self.parameters),):
            raise InputError(f"parameters: shape {p.shape}, allowed: (..., {len(self.parameters)})")
        return q, self.condition_table(q, conditions or Conditions()), p[..., None, :]

    def condition_table(self, postures: Array, conditions: Conditions) -> Array:
        """(..., m, 4 + n) values of the symbols for conditions, see `Expressions.table`."""
        return self.expressions.table(postures, conditions)
