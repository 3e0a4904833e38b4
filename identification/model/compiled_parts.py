"""Parts of spatial models that are compiled once for each arm: its geometry, and each effect by itself.

Setting up the geometry of six axes takes longer than most fits of it, and `diagnose` needs hundreds of sets of effects.
`composition.py` says how a model follows from its parts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, Gravity
from identification.arrays import Array
from identification.effects import Effect
from identification.effects.chain import chain_at, condition_width
from identification.effects.places import contributions, in_state, position_and_state, state_size, widths
from identification.kinematics.spatial import DIMENSION, SpatialChain
from identification.vectorize import Evaluate, vectorize

LOADED = slice(0, 1 + 2 * DIMENSION)  # of the state, and of all places: payload, turn of gravity, shift of the payload
Outputs = tuple[np.ndarray, ...]  # of `CompiledEffect.evaluate`


class Symbols:
    """CasADi symbols of posture q (n), conditions c and state, and the nominal chain, with and without loads.

    remembers : the conditions include the past;  extra : their further columns, see `chain_at`
    """

    def __init__(self, arm: Arm, remembers: bool, extra: tuple[str, ...] = ()) -> None:
        n, self.arm, self.remembers = arm.links, arm, remembers
        self.q, self.state = ca.SX.sym("q", n), ca.SX.sym("state", state_size(arm.chain))
        self.c = ca.SX.sym("c", condition_width(n, remembers, extra))
        self.chain = chain_at(arm, self.q, self.c, remembers, extra)
        self.loaded = in_state(self.chain, self.state)

    def added(self, effect: Effect) -> tuple[ca.SX, ca.SX]:
        """(P,) contributions of an effect at all places, and the symbols of its parameters."""
        v = ca.SX.sym("v", len(effect.parameters))
        return contributions(effect, self.chain, self.loaded, v, self.state), v


@dataclass(frozen=True)
class CompiledEffect:
    """An effect compiled to a function of arrays (q, c, v, s).

    rows : (R,) indices of the places where it adds something
    loads, measures : whether these include loads, and the instrument
    reads : whether it depends on loads or the tip; the rest of the state, link lengths, stays the same
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
    def of(cls, at: Symbols, effect: Effect) -> CompiledEffect:
        """Compile an effect."""
        every, v = at.added(effect)
        rows = np.flatnonzero([not every[k].is_zero() for k in range(every.numel())])
        added = every[rows.tolist()]
        outputs = ca.cse([ca.densify(added), ca.jacobian(added, v), ca.jacobian(added, at.state)])
        function = ca.Function("effect", [at.q, at.c, v, at.state], outputs)
        loads, measures = rows < LOADED.stop, rows >= every.numel() - DIMENSION
        reads = outputs[2][:, LOADED].nnz() + outputs[2][:, -DIMENSION:].nnz() > 0
        inputs = ca.vertcat(at.c, v, at.state)
        varies = ca.depends_on(outputs[1], inputs) or not ca.substitute(added, v, 0 * v).is_zero()
        slopes = None if varies else vectorize(ca.Function("slopes", [at.q], [outputs[1]]))
        return cls(rows, bool(loads.any()), bool(measures.any()), reads, vectorize(function), slopes)

    def added(self, q: Array, c: Array, v: Array, state: Array) -> Outputs:
        """What `evaluate` returns."""
        if self.slopes is None:
            return self.evaluate(q, c, v, state)
        slopes = self._last[0][1] if self._last and self._last[0][0] is q else self.slopes(q)[0]
        self._last[:] = [] if q.flags.writeable else [(q, slopes)]  # else it may be another at the next call
        return slopes @ v[..., None], slopes, np.zeros((len(self.rows), state.shape[-1]))


class CompiledArm:
    """Compiled parts shared by all models of one spatial arm: its geometry, and each effect."""

    def __init__(self, chain: SpatialChain, gravity: Gravity | None, remembers: bool, extra: tuple[str, ...]) -> None:
        self.at = Symbols(Arm(chain, gravity=gravity), remembers, extra)
        self.sizes = widths(chain)
        ends = np.cumsum(list(self.sizes.values())).tolist()
        self.places = {
            place: slice(end - size, end) for (place, size), end in zip(self.sizes.items(), ends, strict=True)
        }
        self.count = sum(self.sizes.values())
        self.lengths = np.array(ca.DM(chain.link_lengths(ca.SX(0)))).ravel()
        self.of_lengths = slice(LOADED.stop, LOADED.stop + len(chain))  # of the state
        self.of_tip = slice(LOADED.stop + len(chain), LOADED.stop + len(chain) + DIMENSION)
        self._effects: dict[object, CompiledEffect] = {}
        self._geometries: dict[object, Evaluate] = {}

    def of(self, effect: Effect) -> CompiledEffect:
        """The part of an effect, compiled at the first call."""
        key = type(effect), effect.joint, *effect.chosen.items()
        if key not in self._effects:
            self._effects[key] = CompiledEffect.of(self.at, effect)
        return self._effects[key]

    def geometry(self, constants: tuple[float | None, ...], places: tuple[str, ...], derivatives: bool) -> Evaluate:
        """Function of arrays (q, c, g, a) that returns the tip and, if asked for, its derivatives by g and by a.

        constants : each value of the geometry, None: it is an element of g
        places : whose contributions are the elements of a; the others add nothing
        """
        if (key := (constants, places, derivatives)) not in self._geometries:
            self._geometries[key] = self._compiled(*key)
        return self._geometries[key]

    def _compiled(self, constants: tuple[float | None, ...], places: tuple[str, ...], derivatives: bool) -> Evaluate:
        g = ca.SX.sym("g", sum(value is None for value in constants))
        a = ca.SX.sym("a", sum(self.sizes[place] for place in places))
        free, added, start = iter(ca.vertsplit(g) if g.numel() else ()), ca.SX.zeros(self.count), 0
        values = ca.vertcat(*(next(free) if value is None else value for value in constants))
        for place in places:
            added[self.places[place]] = a[start : (start := start + self.sizes[place])]
        tip = position_and_state(self.at.chain, (), ca.SX(values), added)[0]
        outputs = [tip, ca.jacobian(tip, g), ca.jacobian(tip, a)] if derivatives else [tip]
        return vectorize(ca.Function("geometry", [self.at.q, self.at.c, g, a], ca.cse(outputs)))


@lru_cache(maxsize=8)
def compiled_arm(chain: SpatialChain, gravity: Gravity | None, remembers: bool, extra: tuple[str, ...]) -> CompiledArm:
    """The parts of an arm, cached for equal arms."""
    return CompiledArm(chain, gravity, remembers, extra)
