"""Spatial models assembled from parts that are compiled once: the geometry, and each effect by itself.

    position = T(q, g, a) + i,   (a, i) = sum_e A_e(q, c, v_e, s)

Here g are the values of the geometry, a and i what the effects e with values v_e add at the places of the chain before
the instrument and at it (effects/places.py), and s the state on which they depend: loads, which effects may change,
link lengths, and the tip before the instrument. Derivatives follow exactly by the chain rule. Setting up the geometry
of six axes takes longer than most fits of it, and `diagnose` needs hundreds of sets of effects.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, Gravity
from identification.arrays import Array
from identification.effects import Effect
from identification.effects.chain import chain_at, condition_width
from identification.effects.places import (
    OF_FRAME,
    contributions,
    in_state,
    load_size,
    position_and_state,
    state_size,
    widths,
)
from identification.kinematics.instrument import WHOLE, Instrument
from identification.kinematics.spatial import DIMENSION, SpatialChain
from identification.vectorize import Evaluate, vectorize

INSTRUMENT = "instrument"
INSIDE = ("joint_angles", "extensions", *OF_FRAME, "tool", "base_rotation", "base_translation")  # of the geometry
POINT = slice(DIMENSION)  # of the position
LOADED = slice(0, load_size(DIMENSION))  # of the state, and of all places
Outputs = tuple[np.ndarray, ...]  # of `Part.evaluate`


class Symbols:
    """CasADi symbols of posture q (n), conditions c and state, and the nominal chain, with and without loads.

    remembers : the conditions include the past;  extra : their further columns, see `chain_at`
    """

    def __init__(self, arm: Arm, remembers: bool, extra: tuple[str, ...] = ()) -> None:
        n, self.arm, self.remembers = arm.links, arm, remembers
        self.q, self.state = ca.SX.sym("q", n), ca.SX.sym("state", state_size(n, arm.dimension))
        self.c = ca.SX.sym("c", condition_width(n, remembers, extra))
        self.chain = chain_at(arm, self.q, self.c, remembers, extra)
        self.loaded = in_state(self.chain, self.state)

    def added(self, effect: Effect) -> tuple[ca.SX, ca.SX]:
        """(P,) contributions of an effect at all places, and the symbols of its parameters."""
        v = ca.SX.sym("v", len(effect.parameters))
        return contributions(effect, self.chain, self.loaded, v, self.state), v


@dataclass(frozen=True)
class Part:
    """An effect compiled to a function of arrays (q, c, v, s).

    rows : (R,) indices of the places where it adds something
    loads, measures : whether these include loads, and the instrument;  reads : whether it depends on the state
    evaluate : gives its contributions (R, 1) and their derivatives by its values (R, size) and by the state (R, S)
    slopes : of postures alone the derivatives (R, size) that, times the values, are the contributions; None: not so
    """

    rows: NDArray[np.int64]
    loads: bool
    measures: bool
    reads: bool
    evaluate: Evaluate
    slopes: Evaluate | None
    _last: list[tuple[Array, Array]] = field(default_factory=list)

    @classmethod
    def of(cls, at: Symbols, effect: Effect) -> Part:
        """Compile an effect."""
        every, v = at.added(effect)
        rows = np.flatnonzero([not every[k].is_zero() for k in range(every.numel())])
        added = every[rows.tolist()]
        outputs = ca.cse([ca.densify(added), ca.jacobian(added, v), ca.jacobian(added, at.state)])
        function = ca.Function("effect", [at.q, at.c, v, at.state], outputs)
        loads, measures, reads = rows < LOADED.stop, rows >= every.numel() - DIMENSION, outputs[2].nnz() > 0
        varies = reads or ca.depends_on(outputs[1], ca.vertcat(at.c, v)) or not ca.substitute(added, v, 0 * v).is_zero()
        slopes = None if varies else vectorize(ca.Function("slopes", [at.q], [outputs[1]]))
        return cls(rows, bool(loads.any()), bool(measures.any()), reads, vectorize(function), slopes)

    def added(self, q: Array, c: Array, v: Array, state: Array) -> Outputs:
        """What `evaluate` returns."""
        if self.slopes is None:
            return self.evaluate(q, c, v, state)
        slopes = self._last[0][1] if self._last and self._last[0][0] is q else self.slopes(q)[0]
        self._last[:] = [] if q.flags.writeable else [(q, slopes)]  # else it may be another at the next call
        return slopes @ v[..., None], slopes, np.zeros((len(self.rows), state.shape[-1]))


class Parts:
    """Compiled parts shared by all models of one spatial arm: its geometry, and each effect."""

    def __init__(self, chain: SpatialChain, gravity: Gravity | None, remembers: bool, extra: tuple[str, ...]) -> None:
        self.at = Symbols(Arm.of_chain(chain, gravity=gravity), remembers, extra)
        self.sizes = widths(len(chain), DIMENSION)
        ends = np.cumsum(list(self.sizes.values())).tolist()
        self.places = {
            place: slice(end - size, end) for (place, size), end in zip(self.sizes.items(), ends, strict=True)
        }
        self.count = sum(self.sizes.values())
        self.lengths = np.array(ca.DM(chain.link_lengths(ca.SX(0)))).ravel()
        self.of_lengths = slice(LOADED.stop, LOADED.stop + len(chain))  # of the state
        self.of_tip = slice(LOADED.stop + len(chain), LOADED.stop + len(chain) + DIMENSION)
        self._effects: dict[object, Part] = {}
        self._geometries: dict[object, Evaluate] = {}

    def of(self, effect: Effect) -> Part:
        """The part of an effect, compiled at the first call."""
        key = type(effect), effect.joint, *effect.chosen.items()
        if key not in self._effects:
            self._effects[key] = Part.of(self.at, effect)
        return self._effects[key]

    def geometry(self, known: tuple[float | None, ...], places: tuple[str, ...], derivatives: bool) -> Evaluate:
        """Function of arrays (q, c, g, a) that returns the tip and, if asked for, its derivatives by g and by a.

        known : each value of the geometry, None: it is an element of g
        places : whose contributions are the elements of a; the others add nothing
        """
        if (key := (known, places, derivatives)) not in self._geometries:
            self._geometries[key] = self._compiled(*key)
        return self._geometries[key]

    def _compiled(self, known: tuple[float | None, ...], places: tuple[str, ...], derivatives: bool) -> Evaluate:
        g = ca.SX.sym("g", sum(value is None for value in known))
        a = ca.SX.sym("a", sum(self.sizes[place] for place in places))
        free, added, start = iter(ca.vertsplit(g) if g.numel() else ()), ca.SX.zeros(self.count), 0
        values = ca.vertcat(*(next(free) if value is None else value for value in known))
        for place in places:
            added[self.places[place]] = a[start : (start := start + self.sizes[place])]
        tip = position_and_state(self.at.chain, (), ca.SX(values), added)[0]
        outputs = [tip, ca.jacobian(tip, g), ca.jacobian(tip, a)] if derivatives else [tip]
        return vectorize(ca.Function("geometry", [self.at.q, self.at.c, g, a], ca.cse(outputs)))


@lru_cache(maxsize=8)
def parts(chain: SpatialChain, gravity: Gravity | None, remembers: bool, extra: tuple[str, ...]) -> Parts:
    """The parts of an arm, cached for equal arms."""
    return Parts(chain, gravity, remembers, extra)


class At(NamedTuple):
    """A model evaluated at some postures.

    position : (..., d) [mm];  by_geometry : (..., d, g) derivative with respect to the values of the geometry
    levers : (..., d, P) derivative with respect to what is added at each place;  state : (..., S)
    added : outputs of each effect's part
    """

    position: Array
    by_geometry: Array
    levers: Array
    state: Array
    added: list[Outputs]


@dataclass(frozen=True)
class Composition:
    """A spatial arm with effects as functions of arrays (q, c, p), with the interface of `Expressions`.

    q : (..., n) postures [rad];  c : (..., C) conditions;  p : (..., p) free parameters [API units]
    values : of all parameters, those of the geometry first, None for the free ones
    tied : the part of each value that belongs to error curves, off where these do not hold; empty: none
    instrument : what is read of the position, which the parts compute
    """

    shared: Parts
    effects: tuple[Effect, ...]
    values: tuple[float | None, ...]
    tied: tuple[float, ...] = ()
    instrument: Instrument = WHOLE

    def position(self, q: Array, c: Array, p: Array) -> tuple[Array]:
        """(..., d, 1) positions."""
        return (self._at(q, c, p, self._used, derivatives=False).position[..., None],)

    def jacobian(self, q: Array, c: Array, p: Array) -> tuple[Array, Array]:
        """(..., d, 1) positions, and (..., d, p) derivatives with respect to p."""
        at = self._at(q, c, p, self._used)
        varying = zip(self._geometry_values, self._constants, strict=True)
        columns = [at.by_geometry[..., [value is None for value, constant in varying if constant is None]]]
        for part, values, (_, slopes, _) in zip(self._parts, self._own, at.added, strict=True):
            free, levers = [k for k, value in enumerate(values) if value is None], at.levers[..., part.rows]
            product = np.multiply if len(part.rows) == 1 else np.matmul  # many small products take three times as long
            columns.append(product(levers, slopes[..., free]))
        return at.position[..., None], np.concatenate(columns, axis=-1)

    def place_levers(self, q: Array, c: Array, p: Array) -> tuple[Array, Array]:
        """(..., d, P) derivatives with respect to what is added at each place, and the state (..., S, 1)."""
        at = self._at(q, c, p, INSIDE)
        return at.levers, at.state[..., None]

    def joint_levers(self, q: Array, c: Array, p: Array) -> tuple[Array]:
        """(..., d, n) derivatives with respect to an angle added at each joint."""
        used = tuple(place for place in INSIDE if place == "joint_angles" or place in self._used)
        return (self._at(q, c, p, used).levers[..., self.shared.places["joint_angles"]],)

    @cached_property
    def _parts(self) -> list[Part]:
        return [self.shared.of(effect) for effect in self.effects]

    @cached_property
    def _geometry_values(self) -> tuple[float | None, ...]:
        return self.values[: len(self.values) - sum(len(effect.parameters) for effect in self.effects)]

    @cached_property
    def _constants(self) -> tuple[float | None, ...]:
        """Values of the geometry as they are compiled, None where they are free or depend on the posture."""
        tied = self.tied[: len(self._geometry_values)] or np.zeros(len(self._geometry_values)).tolist()
        return tuple(None if part else value for value, part in zip(self._geometry_values, tied, strict=True))

    @cached_property
    def _own(self) -> list[tuple[float | None, ...]]:
        """For each effect its elements of `values`."""
        ends = np.cumsum([len(self._geometry_values), *(len(effect.parameters) for effect in self.effects)]).tolist()
        return [self.values[start:end] for start, end in pairwise(ends)]

    @cached_property
    def _used(self) -> tuple[str, ...]:
        """Places before the instrument at which any effect adds something."""
        rows = {int(row) for part in self._parts for row in part.rows}
        return tuple(place for place in INSIDE if rows & set(range(*self.shared.places[place].indices(1 << 30))))

    def _split(self, c: Array, p: Array) -> tuple[Array, list[Array]]:
        """(..., g) values of the geometry that are no constants, and (..., size) all values of each effect."""
        free = np.array([value is None for value in self.values], dtype=bool)
        every = np.empty((*p.shape[:-1], len(free)))
        every[..., free] = p
        every[..., ~free] = [value for value in self.values if value is not None]
        if self.tied:
            every = every - c[..., -1:] * np.array(self.tied)
        ends = np.cumsum([len(self._constants), *map(len, self._own)])
        geometry, *own = np.split(every, ends[:-1], axis=-1)
        return geometry[..., [value is None for value in self._constants]], own

    def _at(self, q: Array, c: Array, p: Array, used: tuple[str, ...], derivatives: bool = True) -> At:
        """Evaluate the model, with levers of the places used: loads first, then the geometry, then the instrument."""
        shared, (g, values) = self.shared, self._split(c, p)
        batch = np.broadcast_shapes(q.shape[:-1], c.shape[:-1], p.shape[:-1])
        state = np.zeros((*batch, shared.at.state.numel()))
        state[..., 0], state[..., shared.of_lengths] = c[..., 0], shared.lengths
        added = self._added(q, c, values, state)
        if any(part.loads for part in self._parts):
            state[..., LOADED] += self._total(added, batch)[..., LOADED]
            added = self._added(q, c, values, state)
        total = self._total(added, batch)
        a = np.concatenate([np.zeros((*batch, 0)), *(total[..., shared.places[place]] for place in used)], axis=-1)
        found = shared.geometry(self._constants, used, derivatives)(q, c, g, a)
        position = found[0][..., 0]
        state[..., shared.of_tip] = position[..., POINT]
        if any(part.measures for part in self._parts):
            added = self._added(q, c, values, state)
            position[..., POINT] += self._total(added, batch)[..., shared.places[INSTRUMENT]]
        if not derivatives:
            position = position if self.instrument.whole else self.instrument.linearized(position)[0]
            return At(position, np.zeros(0), np.zeros(0), state, added)
        by_geometry, levers = self._derivatives(found[1], found[2], added, used)
        if not self.instrument.whole:
            position, slopes = self.instrument.linearized(position)
            by_geometry, levers = slopes @ by_geometry, slopes @ levers
        return At(position, by_geometry, levers, state, added)

    def _added(self, q: Array, c: Array, values: list[Array], state: Array) -> list[Outputs]:
        """Outputs of each effect's part."""
        return [part.added(q, c, v, state) for part, v in zip(self._parts, values, strict=True)]

    def _total(self, added: list[Outputs], batch: tuple[int, ...]) -> Array:
        """(..., P) sum of the contributions of all effects."""
        total = np.zeros((*batch, self.shared.count))
        for part, (contribution, *_) in zip(self._parts, added, strict=True):
            total[..., part.rows] += contribution[..., 0]
        return total

    def _derivatives(
        self, by_g: Array, by_a: Array, added: list[Outputs], used: tuple[str, ...]
    ) -> tuple[Array, Array]:
        """Derivatives of the position with respect to the geometry's values and to what is added at all places."""
        shared, start = self.shared, 0
        levers = np.zeros((*by_a.shape[:-1], shared.count))
        for place in used:
            levers[..., shared.places[place]] = by_a[..., start : (start := start + shared.sizes[place])]
        if any(part.reads for part in self._parts):
            loads, first = np.zeros(levers[..., LOADED].shape), shared.places[INSTRUMENT].start
            turned = np.tile(np.eye(DIMENSION), (*by_a.shape[:-2], 1, 1))
            for part, (_, _, slopes) in zip(self._parts, added, strict=True):
                loads += levers[..., part.rows] @ slopes[..., LOADED]
                last = part.rows >= first
                turned[..., part.rows[last] - first, :] += slopes[..., last, shared.of_tip]
            levers[..., LOADED] = loads
            for moved in (by_g, levers) if any(part.measures for part in self._parts) else ():
                moved[..., POINT, :] = turned @ moved[..., POINT, :]
        levers[..., shared.places[INSTRUMENT]] = np.eye(levers.shape[-2], DIMENSION)
        return by_g, levers
