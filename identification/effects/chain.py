"""The nominal arm at one posture in CasADi symbols, on which effects may depend: geometry, loads, gravity torques."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from identification.arm import Arm, Gravity
from identification.arrays import Array
from identification.conditions import REMEMBERED, Conditions
from identification.errors import InputError
from identification.kinematics.frames import Frame
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.planar import PlanarGeometry, rotate, symbolic_points
from identification.kinematics.spatial import SpatialChain

ORIENTATION = 10  # columns of a measured orientation: nine, and whether there is none


def geometry_of(arm: Arm) -> PlanarGeometry | SpatialChain:
    """Kinematics of an arm, planar or spatial, with one interface."""
    return PlanarGeometry(arm.lengths) if arm.chain is None else arm.chain


@dataclass(frozen=True)
class Chain:
    """Symbols of an arm at one posture, for effects to use: CasADi SX, lengths in mm, angles in rad.

    `orientations`, `load_moment` and `load_force` are defined for planar arms only.
    """

    geometry: PlanarGeometry | SpatialChain
    lengths: Array  # (n,) nominal link lengths [mm]; in space the distances over which each joint acts
    gravity: Gravity | None
    q: ca.SX  # (n,) commanded joint angles [rad]
    payload: ca.SX  # [kg]
    temperature: ca.SX  # [K] above the mean
    time: ca.SX  # -0.5..0.5 over the session
    session: ca.SX  # number of the session, from 0
    directions: ca.SX  # (n,) +1 or -1
    past: ca.SX | None = None  # (n, 12) turning points before (`past_from_order`) [rad], None: the posture itself
    errors: ca.SX | None = None  # (n,) values of error curves at this posture [rad], None: there are none
    turn: ca.SX | float = 0.0  # rotation of gravity [rad]; in space (3,), about x, y, z of the base
    shift: ca.SX | float = 0.0  # (3,) of the payload from where the file says [mm], in the tip's frame; in space
    marker: ca.SX | None = None  # number of the measured point, from 0
    reference: ca.SX | None = None  # (9,) orientation to compare with, by columns, None: none is measured

    @classmethod
    def of(cls, arm: Arm, q: ca.SX, c: ca.SX) -> Chain:
        """An arm at a posture q (n) under conditions c, the columns of `Conditions.table` with or without the past."""
        n, first = arm.links, Conditions.columns(arm.links)
        past = ca.reshape(c[first:], REMEMBERED, n).T if c.numel() > first else None
        kind = cls if arm.chain is None else SpatialState
        return kind(geometry_of(arm), arm.lengths, arm.gravity, q, c[0], c[1], c[2], c[3], c[4 : 4 + n], past)

    @property
    def previous(self) -> ca.SX:
        """(n,) the posture before [rad]; in the first row the posture itself."""
        return self.q if self.past is None else self.past[:, -1]

    def loaded(self, payload: ca.SX, turn: ca.SX, shift: ca.SX | float) -> Chain:
        """The same arm with another payload [kg], a rotation of gravity [rad] and, in space, a shift of the payload."""
        return replace(self, payload=payload, turn=turn, shift=shift)

    @property
    def links(self) -> int:
        """n, the number of links."""
        return int(self.lengths.size)

    @property
    def dimension(self) -> int:
        """d, number of coordinates of a point."""
        return self.geometry.dimension

    @cached_property
    def orientations(self) -> ca.SX:
        """(n,) nominal absolute link orientations theta_j = q_1 + ... + q_j [rad]."""
        return ca.cumsum(self.q)

    @cached_property
    def _points(self) -> list[ca.SX]:
        """n + 1 points (2,) of base, joints and tip [m] in the nominal posture."""
        return symbolic_points(self.lengths / 1000.0, self.q)

    @cached_property
    def loads(self) -> list[tuple[ca.SX, int, float]]:
        """(mass [kg], link from 0, position as a fraction of that link) of each mass; the payload is at the tip."""
        gravity = self.required_gravity
        masses = [(ca.SX(m), k, float(gravity.center_of_mass[k])) for k, m in enumerate(gravity.link_masses)]
        return [*masses, (self.payload, self.links - 1, 1.0)]

    def load_moment(self, link: int, fraction: float, beyond: int) -> ca.SX:
        """Moment [N m] about a point of `link`, normal to the plane, of all loads on links >= `beyond` (from 0)."""
        ax, ay = self.acceleration[0], self.acceleration[1]
        pivot = self._point(link, fraction)
        moment = ca.SX(0)
        for mass, k, at in self.loads:
            if k >= beyond:
                arm = self._point(k, at) - pivot
                moment += mass * (arm[0] * ay - arm[1] * ax)
        return moment

    def load_force(self, beyond: int) -> ca.SX:
        """(2,) force [N] of all loads on links >= `beyond` (from 0)."""
        total = sum((mass for mass, k, _ in self.loads if k >= beyond), ca.SX(0))
        return total * self.acceleration

    @cached_property
    def torques(self) -> ca.SX:
        """(n,) gravity torques tau_j about joints j [N m] at the posture (identification/README.md, "Effects")."""
        return ca.vertcat(*(self.load_moment(j, 0.0, beyond=j) for j in range(self.links)))

    @cached_property
    def acceleration(self) -> ca.SX:
        """(2,) acceleration of gravity [m/s^2], rotated by `turn`."""
        gravity = ca.SX(ca.DM(self.required_gravity.acceleration))
        return gravity if ca.SX(self.turn).is_zero() else rotate(self.turn, gravity)

    @property
    def required_gravity(self) -> Gravity:
        """The arm's gravity data. Raises `InputError` if there are none."""
        if self.gravity is None:
            raise InputError(
                "gravity: this effect needs gravity torques, add a [gravity] table to the arm file, allowed: with one"
            )
        return self.gravity

    def _point(self, link: int, fraction: float) -> ca.SX:
        """(2,) point at a fraction of a link [m] in the nominal posture."""
        start, end = self._points[link : link + 2]
        return start + fraction * (end - start)


class SpatialState(Chain):
    """Symbols of a spatial arm at one posture."""

    @cached_property
    def frames(self) -> list[Frame]:
        """n + 2 nominal frames of base, joints and tip in the frame of the base [mm]."""
        return self.chain.frames(self.q, {})

    @cached_property
    def chain(self) -> SpatialChain:
        """The geometry with its base at the origin."""
        assert isinstance(self.geometry, SpatialChain)
        return replace(self.geometry, base=np.eye(4))

    @cached_property
    def acceleration(self) -> ca.SX:
        """(3,) acceleration of gravity [m/s^2] in the frame of the base, rotated by `turn`."""
        turn, gravity = ca.SX(self.turn), ca.SX(ca.DM(self.required_gravity.acceleration))
        if turn.is_zero():
            return gravity
        frame = Frame.world()
        for axis in range(3):
            frame = frame.turned(axis, turn[axis])
        return ca.mtimes(frame.axes, gravity)

    @cached_property
    def loads(self) -> list[tuple[ca.SX, int, ca.SX]]:  # type: ignore[override]
        """(mass [kg], link, place (3,) [mm]) of every mass: of a link on the line from its joint's frame to the next,
        as far along as the file says; the payload where the file says, else at the first measured point."""
        gravity, chain = self.required_gravity, self.chain
        at = next(iter(chain.tools.values())) if gravity.payload_at is None else gravity.payload_at
        masses = [(self.payload, self.links - 1, self.frames[-1].point(ca.SX(ca.DM(at)) + self.shift))]
        for k, (mass, share) in enumerate(zip(gravity.link_masses, gravity.center_of_mass, strict=True)):
            masses.append((ca.SX(mass), k, self.frames[k + 1].point(ca.SX(ca.DM(share * chain.link_vectors[k])))))
        return masses

    @cached_property
    def torques(self) -> ca.SX:
        """(n,) gravity torques about revolute joints [N m], forces along prismatic ones [N]."""
        by_joint = []
        for j, joint in enumerate(self.chain.joints):
            load = self.moment(j) if joint.type == REVOLUTE else self.weight(j)
            by_joint.append(ca.dot(ca.DM(joint.axis), load))
        return ca.vertcat(*by_joint)

    def moment(self, joint: int) -> ca.SX:
        """(3,) moment [N m] of all loads beyond a joint, from 0, about the origin of its frame, in the frame's axes."""
        frame = self.frames[joint + 1]
        arms = [mass * (place - frame.origin) / 1000.0 for mass, k, place in self.loads if k >= joint]
        return ca.mtimes(frame.axes.T, ca.cross(sum(arms, ca.SX.zeros(3)), self.acceleration))

    def weight(self, joint: int) -> ca.SX:
        """(3,) force [N] of all loads beyond a joint, from 0, in the axes of its frame."""
        mass = sum((mass for mass, k, _ in self.loads if k >= joint), ca.SX(0))
        return ca.mtimes(self.frames[joint + 1].axes.T, mass * self.acceleration)


def condition_width(links: int, remembers: bool, extra: tuple[str, ...]) -> int:
    """Number of columns of the conditions of a model."""
    return orientation_columns(links, remembers, extra).stop + (links + 1) * ("errors" in extra)


def orientation_columns(links: int, remembers: bool, extra: tuple[str, ...]) -> slice:
    """Columns of a measured orientation among those of the conditions; empty without one."""
    start = Conditions.columns(links, remembers) + ("marker" in extra)
    return slice(start, start + ORIENTATION * ("orientation" in extra))


def chain_at(arm: Arm, q: ca.SX, c: ca.SX, remembers: bool, extra: tuple[str, ...]) -> Chain:
    """The nominal chain at the symbols of a posture and its conditions.

    extra : further columns of the conditions, in order: `marker`; `orientation` as measured (nine elements, column by
        column, and 1 where there is none); `errors`, values of error curves,
        and the share of their geometry that is off
    """
    width, measured = Conditions.columns(arm.links, remembers), orientation_columns(arm.links, remembers, extra)
    chain = Chain.of(arm, q, c[:width])
    if "marker" in extra:
        chain = replace(chain, marker=c[width])
    if "orientation" in extra:
        chain = replace(chain, reference=c[measured.start : measured.stop - 1])
    return replace(chain, errors=c[measured.stop : measured.stop + arm.links]) if "errors" in extra else chain
