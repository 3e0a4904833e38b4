"""Assemble the measured position from geometry and effects, which add contributions at places along the chain.

    loads -> joint angles -> links -> tool -> base -> instrument

A contribution acts on the tip through the lever of its place, the derivative of the position with respect to what is
added there. Levers depend on the fitted model only, so they serve all effects that might be missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import casadi as ca

from identification.effects.base import Effect
from identification.effects.chain import Chain
from identification.kinematics.chain import KinematicChain

OF_LOAD = ("payload", "gravity_turn", "payload_shift")


def widths(chain: KinematicChain) -> dict[str, int]:
    """Place -> its number of elements, in the order of vectors over all places."""
    n, d, turns = len(chain), chain.dimension, len(chain.turning)
    return {
        "payload": 1,
        "gravity_turn": turns,
        "payload_shift": d,
        "joint_angles": n,
        "extensions": n,
        **chain.bends,
        "tool": d,
        "base_rotation": turns,
        "base_translation": d,
        "instrument": d,
    }


def by_place(vector: ca.SX, chain: KinematicChain) -> dict[str, ca.SX]:
    """Place -> its elements of a vector over all places."""
    sizes = widths(chain)
    ends = list(accumulate(sizes.values()))
    return {place: vector[end - size : end] for (place, size), end in zip(sizes.items(), ends, strict=True)}


def state_size(chain: KinematicChain) -> int:
    """Number of elements of the state, see `position_and_state`."""
    return load_size(chain) + len(chain) + chain.dimension


def load_size(chain: KinematicChain) -> int:
    """Number of elements of the loads, which come first in the state and among all places: `OF_LOAD`."""
    return sum(size for place, size in widths(chain).items() if place in OF_LOAD)


def measured_position(chain: Chain, effects: Sequence[Effect], values: ca.SX) -> ca.SX:
    """(d,) measured position [mm] (identification/README.md, "Effects"), with three further elements where orientations
    are measured, see `Expressions.symbols`.

    values : those of the geometry, then the parameters of the effects in order
    """
    return position_and_state(chain, effects, values)[0]


def position_and_state(
    chain: Chain, effects: Sequence[Effect], values: ca.SX, added: ca.SX | None = None
) -> tuple[ca.SX, ca.SX]:
    """(d,) measured position [mm], and the state on which effects depend besides posture and conditions.

    added : further contributions at all places, in the order of `widths`

    The state consists of payload [kg], rotation of gravity [rad], in space shift of the payload [mm], link lengths (n)
    [mm] without extensions, and the tip (d) [mm] before the instrument.
    """
    start = values.numel() - sum(len(effect.parameters) for effect in effects)
    geometry, parts = values[:start], []  # each effect with the values of its own parameters
    for effect in effects:
        parts.append((effect, values[start : start + len(effect.parameters)]))
        start += len(effect.parameters)
    sizes = widths(chain.geometry)
    additions = by_place(ca.SX.zeros(sum(sizes.values())) if added is None else added, chain.geometry)
    added_loads = ca.vertcat(*(additions[place] for place in OF_LOAD))
    loads = sum((_loads(e, chain, v) for e, v in parts), added_loads)
    loads[0] += chain.payload
    chain, plain = in_state(chain, loads), chain.geometry.link_lengths(geometry)
    for effect, v in parts:
        for place, value in _inside(effect, chain, v, plain).items():
            additions[place] += value
    real = chain.q + additions["joint_angles"]
    tip, turned = chain.geometry.tip(real, geometry, additions, chain.marker, chain.reference)
    measured = tip + additions["instrument"] + sum(e.instrument(tip, v) for e, v in parts)
    instrument = chain.geometry.instrument
    own = geometry[geometry.numel() - len(instrument.parameters) :]
    target = ca.SX(0) if chain.marker is None else chain.marker
    return ca.vertcat(instrument.reading(measured, own, target), turned), ca.vertcat(loads, plain, tip)


def _loads(effect: Effect, chain: Chain, values: ca.SX) -> ca.SX:
    """What an effect adds to the loads, as numbers in the order of `OF_LOAD`."""
    at_place = {
        "payload": effect.payload(chain, values),
        "gravity_turn": effect.gravity_turn(chain, values),
        "payload_shift": effect.payload_shift(chain, values),
    }
    sizes = widths(chain.geometry)
    return ca.vertcat(*(ca.SX.zeros(sizes[place]) + at_place[place] for place in OF_LOAD))


def _inside(effect: Effect, chain: Chain, values: ca.SX, lengths: ca.SX) -> dict[str, ca.SX | float]:
    """Place -> contribution of an effect between loads and instrument, in a loaded chain."""
    deflections, slopes = effect.bending(chain, values)
    turns, shifts = effect.frame_errors(chain, values)
    bends = {"deflections": deflections, "slopes": slopes, "joint_turns": turns, "joint_shifts": shifts}
    return {
        **{place: bends[place] for place in chain.geometry.bends},
        "joint_angles": effect.joint_angles(chain, values),
        "extensions": effect.extensions(chain, values, lengths),
        "tool": effect.tool(chain, values),
        "base_rotation": effect.base_rotation(chain, values),
        "base_translation": effect.base_translation(chain, values),
    }


def in_state(chain: Chain, state: ca.SX) -> Chain:
    """The chain with the loads of a state, see `position_and_state`."""
    turn = 1 + len(chain.geometry.turning)
    return chain.loaded(state[0], state[1:turn], state[turn : load_size(chain.geometry)])


def contributions(effect: Effect, chain: Chain, loaded: Chain, values: ca.SX, state: ca.SX) -> ca.SX:
    """(P,) contributions of an effect at all places, given the state of the chain.

    loaded : the chain `in_state`, shared by all effects as its torques are expensive to set up
    """
    loads, tip = load_size(chain.geometry), load_size(chain.geometry) + chain.links
    at_place = _inside(effect, loaded, values, state[loads:tip])
    at_place["instrument"] = effect.instrument(state[tip:], values)
    places = {place: size for place, size in widths(chain.geometry).items() if place not in OF_LOAD}
    added = (ca.SX.zeros(size) + at_place[place] for place, size in places.items())
    return ca.vertcat(_loads(effect, chain, values), *added)
