"""The chain from commanded joint angles to the measured position, and the places along it where effects add something.

    loads -> joint angles -> links -> tool -> base -> instrument

What an effect adds at its place acts on the tip through the derivative of the position with respect to that place, the
lever; levers depend on the fitted model only, so they serve all effects that might be missing at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate

import casadi as ca

from identification.effects.base import Effect
from identification.effects.chain import Chain
from identification.kinematics.planar import rotate, symbolic_chain

OF_JOINT = ("joint_angles", "extensions", "deflections", "slopes")  # one number for each joint
PLACES: Mapping[str, int] = {"payload": 1, "gravity_turn": 1, **dict.fromkeys(OF_JOINT, 0)} | {
    "tool": 2,
    "base_rotation": 1,
    "base_translation": 2,
    "instrument": 2,
}
Parts = list[tuple[Effect, ca.SX]]  # effects with the values of their own parameters


def widths(links: int) -> dict[str, int]:
    """Numbers at each place, in the order of the vectors of all places."""
    return {place: width or links for place, width in PLACES.items()}


def split(vector: ca.SX, links: int) -> dict[str, ca.SX]:
    """Place -> its part of a vector of all places."""
    sizes = widths(links)
    ends = list(accumulate(sizes.values()))
    return {place: vector[end - size : end] for (place, size), end in zip(sizes.items(), ends, strict=True)}


def state_size(links: int) -> int:
    """Length of the state, see `position_and_state`."""
    return links + 4


def measured_position(chain: Chain, effects: Sequence[Effect], values: ca.SX) -> ca.SX:
    """(2,) measured position [mm]: joints -> links -> mounting -> instrument (identification/README.md, "Effects").

    values : length errors (n), joint offsets (n), then the parameters of the effects in order
    """
    return position_and_state(chain, effects, values)[0]


def position_and_state(
    chain: Chain, effects: Sequence[Effect], values: ca.SX, added: ca.SX | None = None
) -> tuple[ca.SX, ca.SX]:
    """(2,) measured position [mm], and the state that what effects add depends on besides posture and conditions.

    added : all places in order, see `widths`, in addition to what the effects add
    The state is payload [kg], turn of gravity [rad], link lengths (n) before extensions, and the tip (2) [mm] before
    the instrument.
    """
    n, parts = chain.links, _with_values(effects, values[2 * chain.links :])
    more = split(ca.SX.zeros(sum(widths(n).values())) if added is None else added, n)
    payload = chain.payload + more["payload"] + sum(e.payload(chain, v) for e, v in parts)
    turn = more["gravity_turn"] + sum(e.gravity_turn(chain, v) for e, v in parts)
    chain = chain.loaded(payload, turn)
    angles = chain.q + values[n : 2 * n] + more["joint_angles"] + sum(e.joint_angles(chain, v) for e, v in parts)
    plain: ca.SX = ca.SX(ca.DM(chain.lengths)) + values[:n]
    lengths = plain + more["extensions"] + sum((e.extensions(chain, v, plain) for e, v in parts), ca.SX.zeros(n))
    bent = [e.bending(chain, v) for e, v in parts]
    deflections, slopes = (more[name] + sum(b[k] for b in bent) for k, name in enumerate(("deflections", "slopes")))
    points, theta = symbolic_chain(lengths, angles, deflections, slopes)
    tip = points[-1] + rotate(theta, more["tool"] + sum(e.tool(chain, v) for e, v in parts))
    tip = rotate(more["base_rotation"] + sum(e.base_rotation(chain, v) for e, v in parts), tip)
    tip += more["base_translation"] + sum(e.base_translation(chain, v) for e, v in parts)
    measured = tip + more["instrument"] + sum(e.instrument(tip, v) for e, v in parts)
    return measured, ca.vertcat(payload, turn, plain, tip)


def contributions(effect: Effect, chain: Chain, values: ca.SX, state: ca.SX) -> ca.SX:
    """What an effect adds at all places, in order, in a chain whose other effects leave it in this state."""
    n = chain.links
    loaded = chain.loaded(state[0], state[1])
    deflections, slopes = effect.bending(loaded, values)
    found = {
        "payload": effect.payload(chain, values),
        "gravity_turn": effect.gravity_turn(chain, values),
        "joint_angles": effect.joint_angles(loaded, values),
        "extensions": effect.extensions(loaded, values, state[2 : n + 2]),
        "deflections": deflections,
        "slopes": slopes,
        "tool": effect.tool(loaded, values),
        "base_rotation": effect.base_rotation(loaded, values),
        "base_translation": effect.base_translation(loaded, values),
        "instrument": effect.instrument(state[n + 2 :], values),
    }
    return ca.vertcat(*(ca.SX.zeros(size) + found[place] for place, size in widths(n).items()))


def _with_values(effects: Sequence[Effect], values: ca.SX) -> Parts:
    """Every effect with the values of its own parameters."""
    parts, start = [], 0
    for effect in effects:
        parts.append((effect, values[start : start + len(effect.parameters)]))
        start += len(effect.parameters)
    return parts
