"""A model in CasADi symbols, and the functions of it that run on arrays of postures."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.effects import Chain, Effect, measured_position
from identification.effects.chain import by_place, condition_slices, position_and_state, widths
from identification.error_curve import ErrorCurve, all_hold
from identification.errors import InputError
from identification.kinematics.frames import turned
from identification.kinematics.parameters import ParameterSet
from identification.vectorize import Evaluate, vectorize

KEPT = 128  # effort: models set up


@dataclass(frozen=True, eq=False)
class Expressions:
    """Position of the tip and its derivatives as expressions of posture q, conditions c and parameters p.

    Equal ones have the same symbols: limits, sigma and the name of an arm, say, are not in them.

    every, estimated : all parameters, and those of the vector p;  fixed : name -> value of the others
    extra : further columns of the conditions, see `condition_slices`
    best : name -> best known value of the geometry's parameters
    """

    arm: Arm
    effects: tuple[Effect, ...]
    every: ParameterSet
    estimated: ParameterSet
    fixed: Mapping[str, float]
    extra: tuple[str, ...]
    best: Mapping[str, float]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Expressions) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self) -> Hashable:
        """All that is in the symbols; of effects the class, as users can redefine one, and what it was made with."""
        arm, oriented = self.arm, "orientation" in self.extra
        effects = ((type(e), e.joint, e.tagged, e.curve, *e.chosen.items()) for e in self.effects)
        names = self.every.names, self.estimated.names, *self.fixed.items()
        best = tuple(self.best.items()) if oriented else ()
        return arm.chain, arm.gravity, *effects, names, self.extra, best

    @cached_property
    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """SX of postures q (n), conditions c, parameters (p) and position (d): of a pose the point, and the rotation
        vector by which the computed orientation is turned against the measured one, times `angle_scale` [mm]."""
        width = max(place.stop for place in self.places.values())
        q, c, p = ca.SX.sym("q", self.arm.links), ca.SX.sym("c", width), ca.SX.sym("p", len(self.estimated))
        return q, c, p, measured_position(self.chain(q, c), self.effects, self.values(c, p))

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where each condition stands among the columns."""
        return condition_slices(self.arm.links, self.extra)

    def values(self, c: ca.SX, p: ca.SX) -> ca.SX:
        """Values of `every` parameter, where p has those of the estimated ones; where error curves do not hold, without
        the geometry of these."""
        slot = {name: p[k] for k, name in enumerate(self.estimated.names)}
        values = {name: slot.get(name, self.fixed.get(name, 0.0)) for name in self.every.names}
        if not self.tied:
            return ca.vertcat(*values.values())
        off = {**self.tied, **self.arm.chain.along_base(self.tied, values)}
        return ca.vertcat(*(value - c[-1] * off.get(name, 0.0) for name, value in values.items()))

    @cached_property
    def curves(self) -> list[tuple[int, ErrorCurve]]:
        """Error curves, each with its joint from 0."""
        return [(effect.joint_index, effect.curve) for effect in self.effects if effect.curve is not None]

    @cached_property
    def tied(self) -> dict[str, float]:
        """Parameter name -> the part of its value that was fitted with error curves."""
        fitted = dict.fromkeys((name for _, curve in self.curves for name in curve.geometry), 0.0)
        for _, curve in self.curves:
            fitted |= {name: fitted[name] + value for name, value in curve.geometry.items()}
        return fitted

    def chain(self, q: ca.SX, c: ca.SX) -> Chain:
        """The nominal chain at the symbols of a posture and its conditions."""
        chain = Chain.of(self.arm, q, c, self.extra)
        if chain.reference is None:
            return chain
        best = self.arm.chain.orientation(q, self.best, chain.marker)
        return replace(chain, reference=chain.reference + c[self.places["missing"]] * best)

    def table(self, postures: Array, conditions: Conditions) -> Array:
        """(..., m, C) values of the symbols for conditions, in the columns of `condition_slices`."""
        payload = 0.0 if self.arm.gravity is None else self.arm.gravity.payload
        shape, past = postures.shape[:-1], postures if "past" in self.extra else None
        columns = [conditions.table(shape, self.arm.links, payload, past)]
        unsaid = self.arm.chain.instrument.unsaid
        marker = np.broadcast_to(unsaid if conditions.marker is None else conditions.marker, shape)[..., None]
        if "marker" in self.extra:
            columns.append(marker)
        if "orientation" in self.extra:
            columns.append(self._reference(postures, marker, conditions.orientation))
        if "errors" in self.extra:  # tables are looked up here: as formulas they would be thousands of terms
            columns.append(self._curve_errors(postures))
        return np.concatenate(columns, axis=-1)

    def _curve_errors(self, postures: Array) -> Array:
        """(..., m, n + 1) errors of the joints [rad] by their curves, and the share of their geometry that is off."""
        errors = np.zeros((*postures.shape[:-1], postures.shape[-1] + 1))
        for joint, curve in self.curves:
            errors[..., joint] = curve.at(postures[..., joint])
        if self.tied:  # they hold together
            hold = all_hold(self.curves, postures)
            errors *= hold[..., None]
            errors[..., -1] = 1.0 - hold
        return errors

    @property
    def neutral(self) -> Array:
        """(C,) a row of the table where nothing is said."""
        row = self.table(np.zeros((1, self.arm.links)), Conditions())[0]
        for name in {"reference", "missing", "errors", "off"} & set(self.places):
            row[self.places[name]] = float(name == "missing")
        return row

    @cached_property
    def position_function(self) -> ca.Function:
        """CasADi (q, c, p) -> position (d) [mm]."""
        q, c, p, position = self.symbols
        return ca.Function("position", [q, c, p], [ca.cse(position)], ["q", "c", "p"], ["position"])

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """CasADi (q, c, p) -> position (d) [mm] and its exact derivative with respect to the parameters (d, p)."""
        q, c, p, position = self.symbols
        outputs = ca.cse([position, ca.jacobian(position, p)])
        return ca.Function("jacobian", [q, c, p], outputs, ["q", "c", "p"], ["position", "jacobian"])

    @cached_property
    def residual_gradient(self) -> Evaluate:
        """Of arrays (q, c, p, measured y): J^T (y - position) (p) by reverse mode, and |y - position|^2."""
        q, c, p, position = self.symbols
        y = ca.SX.sym("y", position.numel())
        outputs = ca.cse([ca.jtimes(position, p, y - position, True), ca.sumsqr(y - position)])
        return vectorize(ca.Function("gradient", [q, c, p, y], outputs))

    @cached_property
    def position(self) -> Evaluate:
        """Of arrays (q, c, p): the position."""
        return vectorize(self.position_function)

    @cached_property
    def jacobian(self) -> Evaluate:
        """Of arrays (q, c, p): position and Jacobian."""
        return vectorize(self.jacobian_function)

    @cached_property
    def posture_jacobian(self) -> Evaluate:
        """Of arrays (q, c, p): position and its derivative with respect to the posture, (d, n)."""
        q, c, p, position = self.symbols
        return vectorize(ca.Function("kinematics", [q, c, p], ca.cse([position, ca.jacobian(position, q)])))

    @cached_property
    def joint_levers(self) -> Evaluate:
        """Of arrays (q, c, p): the derivative with respect to an angle added at each joint, (d, n)."""
        added, position, _ = self._with_added
        turns = by_place(added, self.arm.chain)["joint_angles"]
        return self._at_zero("levers", [ca.jacobian(position, turns)])

    @cached_property
    def place_levers(self) -> Evaluate:
        """Of arrays (q, c, p): the derivative with respect to what is added at each place, (d, P), and the state."""
        added, position, state = self._with_added
        return self._at_zero("place_levers", [ca.jacobian(position, added), state])

    @cached_property
    def _with_added(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """What is added at all places, the position with it, and the state."""
        q, c, p, _ = self.symbols
        added = ca.SX.sym("added", sum(widths(self.arm.chain).values()))
        return added, *position_and_state(self.chain(q, c), self.effects, self.values(c, p), added)

    def _at_zero(self, name: str, expressions: list[ca.SX]) -> Evaluate:
        """The expressions where nothing is added."""
        added = self._with_added[0]
        bare = ca.substitute(expressions, [added], [ca.SX.zeros(added.numel())])
        return vectorize(ca.Function(name, list(self.symbols[:3]), ca.cse(bare)))

    def orientations(self, q: Array, c: Array, p: Array) -> Array:
        """(m, 3, 3) orientations of the measured frame for the instrument; raises `InputError` where none is measured.

        c : of conditions without measured orientations
        """
        chain = self.arm.chain
        if chain.angle_scale is None:
            raise InputError("orientations: the arm measures none, allowed: with sigma_mm and sigma_deg in its file")
        columns = c[..., self.places["reference"]]
        nominal = np.swapaxes(columns.reshape(*columns.shape[:-1], 3, 3), -1, -2)
        return turned(self.position(q, c, p)[0][..., 3:, 0] / chain.angle_scale) @ nominal

    def _reference(self, postures: Array, marker: Array, orientation: Array | None) -> Array:
        """(..., m, 10) columns of measured orientations (m, 3, 3), None: those of the arm as best known."""
        reference = np.zeros((*postures.shape[:-1], 10))
        if orientation is not None:
            reference[..., :-1] = np.swapaxes(orientation, -1, -2).reshape(*orientation.shape[:-2], 9)
        else:
            reference[..., :-1] = self._best_orientation(postures, marker)[0][..., 0]
        return reference

    @cached_property
    def _best_orientation(self) -> Evaluate:
        """Of arrays (q, marker): the orientation of the arm as best known, (9,) by columns."""
        q, marker = ca.SX.sym("q", self.arm.links), ca.SX.sym("marker")
        orientation = self.arm.chain.orientation(q, self.best, marker if "marker" in self.extra else None)
        return vectorize(ca.Function("orientation", [q, marker], [ca.cse(ca.densify(orientation))]))

    def on_chain(self, expression: Callable[[Chain], ca.SX]) -> Evaluate:
        """Of arrays (q, c): an expression of the nominal chain."""
        q, c = self.symbols[:2]
        return vectorize(ca.Function("expression", [q, c], [ca.cse(ca.densify(expression(self.chain(q, c))))]))


@lru_cache(maxsize=KEPT)
def shared(expressions: Expressions) -> Expressions:
    """The first of equal ones, whose functions are compiled already."""
    return expressions
