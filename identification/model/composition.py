"""Spatial models assembled from parts that are compiled once: the geometry, and each effect by itself.

    reading = R(T(q, g, a) + i, w),   (a, i) = sum_e A_e(q, c, v_e, s)

R is what the instrument reads, with values w of its own. g are the values of the geometry, a and i what the effects e
with values v_e add at the places of the chain before the instrument and at it (effects/places.py), and s the state on
which they depend: loads, which effects may change, link lengths, and the tip before the instrument. Derivatives follow
exactly by the chain rule. The parts are shared by all models of an arm (compiled_parts.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.effects import Effect
from identification.effects.places import OF_FRAME
from identification.instruments import TRACKER, Instrument
from identification.kinematics.spatial import DIMENSION
from identification.model.compiled_parts import LOADED, CompiledArm, CompiledEffect, Outputs

INSTRUMENT = "instrument"
INSIDE = ("joint_angles", "extensions", *OF_FRAME, "tool", "base_rotation", "base_translation")  # of the geometry
POINT = slice(DIMENSION)  # of the position


class At(NamedTuple):
    """A model evaluated at some postures.

    position : (..., d) [mm];  by_geometry : (..., d, g) derivative with respect to the values of the geometry, then of
        the instrument
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
    values : of all parameters, those of the geometry first, then those of the instrument, None for the free ones
    tied : the part of each value that belongs to error curves, off where these do not hold; empty: none
    instrument : what is read of the position, which the parts compute
    target : column of c that says of which target, None: there is one
    """

    shared: CompiledArm
    effects: tuple[Effect, ...]
    values: tuple[float | None, ...]
    tied: tuple[float, ...] = ()
    instrument: Instrument = TRACKER
    target: slice | None = None

    def position(self, q: Array, c: Array, p: Array) -> tuple[Array]:
        """(..., d, 1) positions."""
        return (self._at(q, c, p, self._used, derivatives=False).position[..., None],)

    def jacobian(self, q: Array, c: Array, p: Array) -> tuple[Array, Array]:
        """(..., d, 1) positions, and (..., d, p) derivatives with respect to p."""
        at = self._at(q, c, p, self._used)
        varying = zip(self._geometry_values, self._constants, strict=True)
        free_columns = [value is None for value, constant in varying if constant is None]
        columns = [at.by_geometry[..., [*free_columns, *(value is None for value in self._instrument_values)]]]
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
    def _parts(self) -> list[CompiledEffect]:
        return [self.shared.of(effect) for effect in self.effects]

    @cached_property
    def _geometry_values(self) -> tuple[float | None, ...]:
        of_effects = sum(len(effect.parameters) for effect in self.effects)
        return self.values[: len(self.values) - len(self.instrument.parameters) - of_effects]

    @cached_property
    def _instrument_values(self) -> tuple[float | None, ...]:
        start = len(self._geometry_values)
        return self.values[start : start + len(self.instrument.parameters)]

    @cached_property
    def _constants(self) -> tuple[float | None, ...]:
        """Values of the geometry as they are compiled, None where they are free or depend on the posture."""
        tied = self.tied[: len(self._geometry_values)] or np.zeros(len(self._geometry_values)).tolist()
        return tuple(None if part else value for value, part in zip(self._geometry_values, tied, strict=True))

    @cached_property
    def _own(self) -> list[tuple[float | None, ...]]:
        """For each effect its elements of `values`."""
        start = len(self._geometry_values) + len(self._instrument_values)
        ends = np.cumsum([start, *(len(effect.parameters) for effect in self.effects)]).tolist()
        return [self.values[start:end] for start, end in pairwise(ends)]

    @cached_property
    def _used(self) -> tuple[str, ...]:
        """Places before the instrument at which any effect adds something."""
        rows = {int(row) for part in self._parts for row in part.rows}
        return tuple(place for place in INSIDE if rows & set(range(*self.shared.places[place].indices(1 << 30))))

    def _split(self, c: Array, p: Array) -> tuple[Array, Array, list[Array]]:
        """(..., g) values of the geometry that are no constants, and (..., size) all values of the instrument and of
        each effect."""
        free = np.array([value is None for value in self.values], dtype=bool)
        every = np.empty((*p.shape[:-1], len(free)))
        every[..., free] = p
        every[..., ~free] = [value for value in self.values if value is not None]
        if self.tied:
            every = every - c[..., -1:] * np.array(self.tied)
        ends = np.cumsum([len(self._constants), len(self._instrument_values), *map(len, self._own)])
        geometry, of_instrument, *of_effects = np.split(every, ends[:-1], axis=-1)
        return geometry[..., [value is None for value in self._constants]], of_instrument, of_effects

    def _at(self, q: Array, c: Array, p: Array, used: tuple[str, ...], derivatives: bool = True) -> At:
        """Evaluate the model, with levers of the places used: loads first, then the geometry, then the instrument."""
        shared, (g, own, values) = self.shared, self._split(c, p)
        batch = np.broadcast_shapes(q.shape[:-1], c.shape[:-1], p.shape[:-1])
        state = np.zeros((*batch, shared.at.state.numel()))
        state[..., 0], state[..., shared.of_lengths] = c[..., 0], shared.lengths
        added = self._added(q, c, values, state)
        if any(part.loads for part in self._parts):
            state[..., LOADED] += self._total(added, batch)[..., LOADED]
            added = self._added(q, c, values, state)
        total = self._total(added, batch)
        a = np.concatenate([np.zeros((*batch, 0)), *(total[..., shared.places[place]] for place in used)], axis=-1)
        computed = shared.geometry(self._constants, used, derivatives)(q, c, g, a)
        position = computed[0][..., 0]
        state[..., shared.of_tip] = position[..., POINT]
        if any(part.measures for part in self._parts):
            added = self._added(q, c, values, state)
            position[..., POINT] += self._total(added, batch)[..., shared.places[INSTRUMENT]]
        reads = not self.instrument.reads_positions
        if reads:
            target = np.zeros(1) if self.target is None else c[..., self.target]
            position, by_point, by_own = self.instrument.linearized(position, own, target)
        if not derivatives:
            return At(position, np.zeros(0), np.zeros(0), state, added)
        by_geometry, levers = self._derivatives(computed[1], computed[2], added, used)
        if reads:
            by_geometry, levers = np.concatenate([by_point @ by_geometry, by_own], axis=-1), by_point @ levers
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
        # components first in memory, as what is computed of them
        levers = np.moveaxis(np.zeros((by_a.shape[-2], shared.count, *by_a.shape[:-2])), (0, 1), (-2, -1))
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
