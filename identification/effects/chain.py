"""The nominal arm at one posture in CasADi symbols, on which effects may depend, and what they add at places along it.

    loads -> joint angles -> links -> tool -> base -> instrument

A contribution acts on the tip through the lever of its place, the derivative of the position with respect to what is
added there. Levers depend on the fitted model only, so they serve all effects that might be missing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm, Gravity
from identification.arrays import slices
from identification.effects.base import Effect
from identification.errors import InputError
from identification.kinematics.chain import KinematicChain, in_space
from identification.kinematics.frames import Frame
from identification.kinematics.parameters import LENGTH_ERROR, REVOLUTE
from identification.measurements import REMEMBERED

OF_LOAD = ("payload", "gravity_turn", "payload_shift")  # places that are also of `Chain`
BY_JOINT = ("joint_angles", "extensions", "joint_turns", "joint_shifts")


@dataclass(frozen=True)
class Chain:
    """Symbols of an arm at one posture, for effects to use: CasADi SX, lengths in mm, angles in rad."""

    geometry: KinematicChain
    gravity: Gravity | None
    q: ca.SX  # (n,) commanded joint angles [rad]
    gravity_turn: ca.SX  # [rad] about the axes of the base that a frame may turn about
    payload_shift: ca.SX  # (d,) of the payload from where the file says [mm], in the tip's frame
    payload: ca.SX  # [kg]
    temperature: ca.SX  # [K] above the mean
    time: ca.SX  # -0.5..0.5 over the session
    session: ca.SX  # number of the session, from 0
    directions: ca.SX  # (n,) +1 or -1
    past: ca.SX | None = None  # (n, 12) turning points before (`past_from_order`) [rad], None: the posture itself
    marker: ca.SX | None = None  # number of the measured point, from 0
    orientation: ca.SX | None = None  # (9,) to compare with, by rows, None: none is measured
    errors: ca.SX | None = None  # (n,) values of error curves at this posture [rad], None: there are none
    off: ca.SX | None = None  # the share of their geometry that does not hold

    @classmethod
    def of(cls, arm: Arm, q: ca.SX, c: ca.SX, columns: Mapping[str, slice]) -> Chain:
        """An arm at a posture q (n) under conditions c in these columns (`condition_columns`)."""
        at = {name: c[place] for name, place in columns.items()}
        if "past" in at:
            at["past"] = ca.reshape(at["past"], REMEMBERED, arm.links).T
        turned, shifted = ca.SX.zeros(len(arm.chain.turning)), ca.SX.zeros(arm.dimension)
        return cls(arm.chain, arm.gravity, q, turned, shifted, **at)

    # (n,) the posture before [rad]; in the first row the posture itself
    previous = property(lambda self: self.q if self.past is None else self.past[:, -1])
    links = property(lambda self: len(self.geometry))  # n, the number of links
    lengths = property(attrgetter("geometry.lengths"))  # (n,) of the links, nominal [mm]

    @cached_property
    def frames(self) -> list[Frame]:
        """n + 2 nominal frames of base, joints and tip in the frame of the base [mm]."""
        return replace(self.geometry, base=np.eye(4)).frames(self.q, {})

    @property
    def required_gravity(self) -> Gravity:
        """The arm's gravity data. Raises `InputError` if there are none."""
        if self.gravity is None:
            needs = "this effect needs gravity torques, add a [gravity] table to the arm file, allowed: with one"
            raise InputError(f"gravity: {needs}")
        return self.gravity

    @cached_property
    def acceleration(self) -> ca.SX:
        """(3,) acceleration of gravity [m/s^2] in the frame of the base, rotated by `gravity_turn`."""
        gravity = in_space(ca.SX(ca.DM(self.required_gravity.acceleration)))
        if self.gravity_turn.is_zero():
            return gravity
        return ca.mtimes(Frame.world().turned_about(self.geometry.turning, self.gravity_turn).axes, gravity)

    @cached_property
    def loads(self) -> list[tuple[ca.SX, int, ca.SX]]:
        """(mass [kg], link, place (3,) [mm]) of every mass: of a link on the line from its joint's frame to the next,
        as far along as the file says; the payload where the file says, else at the first measured point."""
        gravity, chain = self.required_gravity, self.geometry
        at = ca.SX(ca.DM(next(iter(chain.tools.values())) if gravity.payload_at is None else gravity.payload_at))
        masses = [(self.payload, self.links - 1, self.frames[-1].point(at + in_space(self.payload_shift)))]
        for k, (mass, share) in enumerate(zip(gravity.link_masses, gravity.center_of_mass, strict=True)):
            along = ca.SX(ca.DM(share * chain.link_poses[k + 1][:3, 3]))
            masses.append((ca.SX(mass), k, self.frames[k + 1].point(along)))
        return masses

    @cached_property
    def torques(self) -> ca.SX:
        """(n,) gravity torques about revolute joints [N m], forces along prismatic ones [N] (identification/README.md,
        "Effects")."""
        joints = enumerate(self.geometry.joints)
        loads = ((joint, self.moment(j) if joint.type == REVOLUTE else self.weight(j, j)) for j, joint in joints)
        return ca.vertcat(*(ca.dot(ca.DM(joint.axis), load) for joint, load in loads))

    def moment(self, joint: int) -> ca.SX:
        """(3,) moment [N m] of all loads beyond a joint, from 0, about the origin of its frame, in the frame's axes."""
        frame = self.frames[joint + 1]
        arms = [mass * (place - frame.origin) / 1000.0 for mass, k, place in self.loads if k >= joint]
        return ca.mtimes(frame.axes.T, ca.cross(sum(arms, ca.SX.zeros(3)), self.acceleration))

    def weight(self, beyond: int, joint: int) -> ca.SX:
        """(3,) force [N] of all loads on links >= `beyond`, from 0, in the axes of a joint's frame."""
        mass = sum((mass for mass, k, _ in self.loads if k >= beyond), ca.SX(0))
        return ca.mtimes(self.frames[joint + 1].axes.T, mass * self.acceleration)


def widths(chain: KinematicChain) -> dict[str, int]:
    """Place -> its number of elements, in the order of vectors over all places."""
    n, d, turns = len(chain), chain.dimension, len(chain.turning)
    loads = dict(zip(OF_LOAD, (1, turns, d), strict=True))
    joints = {"joint_angles": n, "extensions": n, "joint_turns": turns * n, "joint_shifts": d * n}
    return {**loads, **joints, "tool": d, "base_rotation": turns, "base_translation": d, "instrument": d}


def state_slices(chain: KinematicChain) -> dict[str, slice]:
    """Where the parts of the state stand, on which effects depend besides posture and conditions: payload [kg],
    rotation of gravity [rad], in space shift of the payload [mm], link lengths (n) [mm] without extensions, and the tip
    (d) [mm] before the instrument."""
    sizes = widths(chain)
    return slices({place: sizes[place] for place in OF_LOAD} | {"lengths": len(chain), "tip": chain.dimension})


def position_and_state(
    chain: Chain, effects: Sequence[Effect], values: ca.SX, added: ca.SX | None = None
) -> tuple[ca.SX, ca.SX]:
    """(d,) measured position [mm] (identification/README.md, "Effects"), with three further elements where orientations
    are measured, see `Model.symbols`; and the state (`state_slices`).

    values : those of the geometry, then the parameters of the effects in order
    added : further contributions at all places, in the order of `widths`
    """
    drawn, sizes = chain.geometry, widths(chain.geometry)
    counts = [len(effect.parameters) for effect in effects]
    geometry, *parts = ca.vertsplit(values, [*accumulate([0, values.numel() - sum(counts), *counts])])
    added = ca.SX.zeros(sum(sizes.values())) if added is None else added
    additions = {place: added[where] for place, where in slices(sizes).items()}

    def add(places: Collection[str], chain: Chain, lengths: ca.SX | None = None, tip: ca.SX | None = None) -> None:
        for effect, part in zip(effects, parts, strict=True):
            for place in (place for place in places if hasattr(effect, place)):
                additions[place] += contribution(effect, place, chain, part, lengths, tip)

    add(OF_LOAD, chain)
    additions["payload"] += chain.payload
    loads: dict[str, Any] = {place: additions[place] for place in OF_LOAD}
    named = dict(zip(drawn.parameters().names, ca.vertsplit(geometry), strict=True))
    errors = (named.get(f"{LENGTH_ERROR}:{j}", 0.0) for j in range(1, len(drawn) + 1))
    lengths = ca.DM(drawn.lengths) + ca.vertcat(*errors)
    add([place for place in sizes if place not in (*OF_LOAD, "instrument")], replace(chain, **loads), lengths)
    tip, turned = drawn.tip(chain.q + additions["joint_angles"], named, additions, chain.marker, chain.orientation)
    add(["instrument"], chain, tip=tip)
    settings = ca.vertcat(ca.SX(0, 1), *(named[p.name] for p in drawn.instrument.parameters))
    target = ca.SX(0) if chain.marker is None else chain.marker
    reading = drawn.instrument.reading(tip + additions["instrument"], settings, target)
    return ca.vertcat(reading, turned), ca.vertcat(*loads.values(), lengths, tip)


def contribution(
    effect: Effect, place: str, chain: Chain, values: ca.SX, lengths: ca.SX | None = None, tip: ca.SX | None = None
) -> ca.SX:
    """What an effect adds at a place at which it has a formula, for all elements of the place."""
    size = widths(effect.chain)[place]
    lengthened = (lengths,) if place == "extensions" else ()
    value = ca.SX(getattr(effect, place)(tip if place == "instrument" else chain, values, *lengthened))
    values, one = ca.SX.zeros(size), value.numel()
    if effect.joint is None or place not in BY_JOINT or one * len(effect.chain) != size:
        return values + value
    values[one * effect.joint_index : one * (effect.joint_index + 1)] = value
    return values
