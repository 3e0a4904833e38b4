"""The nominal arm at one posture in CasADi symbols, on which effects may depend: geometry, loads, gravity torques."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import casadi as ca
import numpy as np

from identification.arm import Arm, Gravity
from identification.arrays import Array
from identification.conditions import REMEMBERED
from identification.errors import InputError
from identification.kinematics.chain import KinematicChain, in_space, turned_about
from identification.kinematics.frames import Frame
from identification.kinematics.parameters import REVOLUTE


def condition_slices(links: int, extra: Collection[str] = ()) -> dict[str, slice]:
    """Where each condition of a model stands among its columns: those of `Conditions.table`, and of these in order what
    the model has besides.

    extra : `past` of the joints, if an effect has a memory; `marker`, where there are several; `orientation`, what was
        measured, column by column, and 1 where there is none; `errors` of the joints by their curves, and the share of
        the curves' geometry that is off
    """
    sizes = {"payload": 1, "temperature": 1, "time": 1, "session": 1, "directions": links}
    sizes |= {"past": links * REMEMBERED} if "past" in extra else {}
    sizes |= {"marker": 1} if "marker" in extra else {}
    sizes |= {"reference": 9, "missing": 1} if "orientation" in extra else {}
    sizes |= {"errors": links, "off": 1} if "errors" in extra else {}
    ends = accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


@dataclass(frozen=True)
class Chain:
    """Symbols of an arm at one posture, for effects to use: CasADi SX, lengths in mm, angles in rad."""

    geometry: KinematicChain
    gravity: Gravity | None
    q: ca.SX  # (n,) commanded joint angles [rad]
    payload: ca.SX  # [kg]
    temperature: ca.SX  # [K] above the mean
    time: ca.SX  # -0.5..0.5 over the session
    session: ca.SX  # number of the session, from 0
    directions: ca.SX  # (n,) +1 or -1
    past: ca.SX | None = None  # (n, 12) turning points before (`past_from_order`) [rad], None: the posture itself
    errors: ca.SX | None = None  # (n,) values of error curves at this posture [rad], None: there are none
    turn: ca.SX | None = None  # rotation of gravity [rad] about the axes of the base that a frame may turn about
    shift: ca.SX | None = None  # of the payload from where the file says [mm], in the tip's frame; in space
    marker: ca.SX | None = None  # number of the measured point, from 0
    reference: ca.SX | None = None  # (9,) orientation to compare with, by columns, None: none is measured

    @classmethod
    def of(cls, arm: Arm, q: ca.SX, c: ca.SX, extra: Collection[str] = ()) -> Chain:
        """An arm at a posture q (n) under conditions c, whose columns are those of `condition_slices`."""
        at = {name: c[place] for name, place in condition_slices(arm.links, extra).items()}
        past = ca.reshape(at["past"], REMEMBERED, arm.links).T if "past" in at else None
        plain = [at[name] for name in ("payload", "temperature", "time", "session", "directions")]
        further = replace(cls(arm.chain, arm.gravity, q, *plain), past=past, errors=at.get("errors"))
        return replace(further, marker=at.get("marker"), reference=at.get("reference"))

    @property
    def previous(self) -> ca.SX:
        """(n,) the posture before [rad]; in the first row the posture itself."""
        return self.q if self.past is None else self.past[:, -1]

    def loaded(self, payload: ca.SX, turn: ca.SX, shift: ca.SX) -> Chain:
        """The same arm with another payload [kg], a rotation of gravity [rad] and, in space, a shift of the payload."""
        return replace(self, payload=payload, turn=turn, shift=shift)

    @property
    def links(self) -> int:
        """n, the number of links."""
        return len(self.geometry)

    @property
    def dimension(self) -> int:
        """d, number of coordinates of a point."""
        return self.geometry.dimension

    @property
    def lengths(self) -> Array:
        """(n,) nominal link lengths [mm]."""
        return self.geometry.lengths

    @cached_property
    def frames(self) -> list[Frame]:
        """n + 2 nominal frames of base, joints and tip in the frame of the base [mm]."""
        return replace(self.geometry, base=np.eye(4)).frames(self.q, {})

    @property
    def required_gravity(self) -> Gravity:
        """The arm's gravity data. Raises `InputError` if there are none."""
        if self.gravity is None:
            raise InputError(
                "gravity: this effect needs gravity torques, add a [gravity] table to the arm file, allowed: with one"
            )
        return self.gravity

    @cached_property
    def acceleration(self) -> ca.SX:
        """(3,) acceleration of gravity [m/s^2] in the frame of the base, rotated by `turn`."""
        gravity = in_space(ca.SX(ca.DM(self.required_gravity.acceleration)))
        if self.turn is None or self.turn.is_zero():
            return gravity
        return ca.mtimes(turned_about(Frame.world(), self.geometry.turning, self.turn).axes, gravity)

    @cached_property
    def loads(self) -> list[tuple[ca.SX, int, ca.SX]]:
        """(mass [kg], link, place (3,) [mm]) of every mass: of a link on the line from its joint's frame to the next,
        as far along as the file says; the payload where the file says, else at the first measured point."""
        gravity, chain = self.required_gravity, self.geometry
        at = ca.SX(ca.DM(next(iter(chain.tools.values())) if gravity.payload_at is None else gravity.payload_at))
        hangs = at if self.shift is None else at + in_space(self.shift)
        masses = [(self.payload, self.links - 1, self.frames[-1].point(hangs))]
        for k, (mass, share) in enumerate(zip(gravity.link_masses, gravity.center_of_mass, strict=True)):
            masses.append((ca.SX(mass), k, self.frames[k + 1].point(ca.SX(ca.DM(share * chain.link_vectors[k])))))
        return masses

    @cached_property
    def torques(self) -> ca.SX:
        """(n,) gravity torques about revolute joints [N m], forces along prismatic ones [N] (identification/README.md,
        "Effects")."""
        by_joint = []
        for j, joint in enumerate(self.geometry.joints):
            load = self.moment(j) if joint.type == REVOLUTE else self.weight(j, j)
            by_joint.append(ca.dot(ca.DM(joint.axis), load))
        return ca.vertcat(*by_joint)

    def moment(self, joint: int) -> ca.SX:
        """(3,) moment [N m] of all loads beyond a joint, from 0, about the origin of its frame, in the frame's axes."""
        frame = self.frames[joint + 1]
        arms = [mass * (place - frame.origin) / 1000.0 for mass, k, place in self.loads if k >= joint]
        return ca.mtimes(frame.axes.T, ca.cross(sum(arms, ca.SX.zeros(3)), self.acceleration))

    def weight(self, beyond: int, joint: int) -> ca.SX:
        """(3,) force [N] of all loads on links >= `beyond`, from 0, in the axes of a joint's frame."""
        mass = sum((mass for mass, k, _ in self.loads if k >= beyond), ca.SX(0))
        return ca.mtimes(self.frames[joint + 1].axes.T, mass * self.acceleration)
