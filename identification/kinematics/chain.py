"""A chain of revolute and prismatic joints, in space or in a plane, with the errors that a calibration may find.

    tip = error_0 * base * prod_j [origin_j * error_j * motion_j(q_j + offset_j)] * end * (tool + its error)

`origin_j` is the nominal pose of joint j's frame in the frame of the joint before (as in URDF). `error_j` are six local
corrections in the frame of joint j before it moves: translations along x, y, z, then rotations about x, y, z. `base` is
the pose of the arm's base in the frame of the instrument; its errors are a shift along the axes of the instrument and
rotations about its own axes. `tool` is a measured point in the frame at the end of the chain; where orientations are
measured a frame, its errors a shift of the point and rotations about its own axes.

A planar arm (`planar_chain`) is a chain whose joints turn about z, with links along x, and whose free errors are those
of the plane: the lengths of its links and the zeros of its joints. Link j then points along theta_j = q_1 + ... + q_j,
and the tip is sum_j (l_j + dl_j) exp(i (theta_j + dtheta_j)), dtheta_j = dq_1 + ... + dq_j (paper, eq. 1).

Denavit-Hartenberg tables as chains of joints, in the standard and in the modified convention.

    standard (Denavit and Hartenberg 1955)    A_j = Rz(theta_j) Tz(d_j) Tx(a_j) Rx(alpha_j)
    modified (Craig 1986)                     A_j = Rx(alpha_j) Tx(a_j) Rz(theta_j) Tz(d_j)

with theta_j = q_j + offset_j for a revolute joint, d_j + q_j in the place of d_j for a prismatic one.

Chains with their errors composed into them say where base, tools and joints really are: as a table of the joints, their
offsets, and a Denavit-Hartenberg table. Between axes that the drawing has parallel the common normal stands anywhere,
and the strict table explodes. There d stays as drawn, the next origin is where the next axis meets the plane of that d,
and a turn beta about the new y axis follows alpha (S. A. Hayati, "Robot arm geometric link parameter estimation", CDC
1983):

    Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)

What is before the first axis is the base, what is behind the last axis the tip: there the table stays as drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import accumulate, product
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError, require
from identification.instruments import TRACKER, Instrument
from identification.kinematics.counting import Counting
from identification.kinematics.frames import (
    Frame,
    X,
    Y,
    Z,
    as_poses,
    displacement,
    point_table,
    pose,
    pose_table,
    roll_pitch_yaw,
    rotation_about,
    rotation_to_z,
    rotation_vector,
    tool_tables,
)
from identification.kinematics.parameters import (
    JOINT_OFFSET,
    LENGTH_ERROR,
    PRISMATIC,
    REVOLUTE,
    Parameter,
    ParameterSet,
    error_names,
)
from identification.vectorized import vectorize

DIMENSION = 3  # of space
UNNAMED = "1"  # measured point, as an arm file has it that names none
SLIDING = {"rad": "mm", "rad/(N m)": "mm/N"}  # units of joints that turn -> of those that slide
TRANSLATION_ERROR, ROTATION_ERROR, BASE, TOOL = "translation_error", "rotation_error", "base", "tool"
Values = Mapping[str, ca.SX | float]  # parameter name -> value [mm, rad]; what is not there is zero
Numbers = Mapping[str, float]
NOTHING: Mapping[str, Any] = MappingProxyType({})
Solver = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class Joint(ByValue):
    """One joint that moves."""

    name: str
    origin: Array  # (4, 4) pose of its frame in that of the joint before [mm]
    axis: Array  # (3,) direction in its own frame
    type: str = REVOLUTE
    lower: float = -np.pi  # [rad, mm]
    upper: float = np.pi

    def __post_init__(self) -> None:
        kinds, length = (REVOLUTE, PRISMATIC), float(np.linalg.norm(self.axis))
        require(self.type in kinds, f"joint {self.name}: type {self.type!r}, allowed: {' or '.join(kinds)}")
        require(length > 0.0, f"joint {self.name}: axis {np.asarray(self.axis).tolist()}, allowed: not zero")
        object.__setattr__(self, "axis", np.asarray(self.axis, dtype=float) / length)
        super().__post_init__()

    def moved(self, frame: Frame, q: ca.SX) -> Frame:
        """The joint's frame after it moved by q [rad, mm]: turned so that its own z axis is the joint's, which is one
        symbolic rotation instead of Rodrigues' formula."""
        to_z = rotation_to_z(self.axis)
        turned = frame.placed(pose(rotation=to_z))
        turned = turned.turned(2, q) if self.type == REVOLUTE else turned.moved(2, q)
        return turned.placed(pose(rotation=to_z.T))

    def motion(self, q: float) -> Array:
        """(4, 4) its motion by q [rad, mm]."""
        return pose(rotation=rotation_about(self.axis, q)) if self.type == REVOLUTE else pose(self.axis * q)


@dataclass(frozen=True, eq=False)
class KinematicChain(ByValue):
    """Joints from base to tip."""

    joints: tuple[Joint, ...]
    end: Array  # (4, 4) pose of the tip's frame in that of the last joint [mm]
    base: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) pose of the base [mm]
    # name of each measured point -> (4, 4) pose of its frame in that of the tip [mm]; (3,) a place: turned as the tip
    tools: Mapping[str, Array] = field(default_factory=lambda: {UNNAMED: np.eye(4)})
    settled: frozenset[str] = frozenset()  # those of `base` and `tool` that are given, and not to be found
    fixed: frozenset[str] = frozenset()  # names of parameters that are not estimated (model/placed.py)
    instrument: Instrument = TRACKER  # what is measured of a point
    rows: tuple[DHRow, ...] = ()  # of the Denavit-Hartenberg table that it is drawn by; empty: by none
    convention: str = "standard"  # of that

    kind: ClassVar[str] = "spatial"  # the word in arm files
    # kinds of its parameters that files list over the joints -> the key of the list; others stand there by their names
    lists: ClassVar[Mapping[str, str]] = NOTHING
    axes: ClassVar[str] = "xyz"  # of the frames, along which positions are measured
    turning: ClassVar[tuple[int, ...]] = (0, 1, 2)  # numbers of the axes that a frame may turn about
    turn_names: ClassVar[tuple[str, ...]] = ("wx", "wy", "wz")  # of the parts of a rotation
    base_shift: ClassVar[tuple[str, ...]] = error_names(BASE)[:3]  # names of the parameters that move the base
    drawn: ClassVar[frozenset[str]] = frozenset()  # those of `base` and `tool` that are always where the drawing is
    point_column: ClassVar[str] = "marker"  # of files, which point or frame on the tip is measured; empty: the tip
    first_point: ClassVar[int] = 0  # of its `points`, as frames count
    projection: ClassVar[str | None] = "3d"  # of the axes (matplotlib) that it is drawn in

    def __post_init__(self) -> None:
        object.__setattr__(self, "tools", as_poses(self.tools))
        super().__post_init__()

    def __len__(self) -> int:
        return len(self.joints)

    def refuse_contacts(self) -> None:
        """Raises `InputError` where a probe touches a surface and postures have to be free."""
        reason = f"kind {self.instrument.kind}: where it is touched follows from the arm"
        require(not self.instrument.contact, f"instrument: found {reason}, allowed here: distance, or no [instrument]")

    dimension = property(lambda self: len(self.axes))  # d, coordinates of a position: 3 in space, 2 in the plane
    angle_scale = property(attrgetter("instrument.angle_scale"))  # [mm/rad], `Tracker`
    joint_types = property(lambda self: tuple(joint.type for joint in self.joints))  # (n) `revolute` or `prismatic`

    # whether it has more free errors than measurements can show, so that a fit needs a prior of them
    redundant = property(lambda self: not self.fixed)
    unestimated = property(attrgetter("fixed"))  # names of those of its parameters that never are
    # names of the parameters that say where it stands, where these are of no kind `base`, and the effects that add some
    standing = standing_effects = property(lambda self: tuple[str, ...]())
    as_in_paper = False  # whether its readings are eq. 1 of the paper: of these are Table I and the planar theorem

    @property
    def coordinates(self) -> int:
        """Numbers that are measured of a posture: those that the instrument reads, d of a point, or 6 of a pose."""
        if self.angle_scale is not None:
            return 2 * DIMENSION
        return self.dimension if self.instrument.reads_positions else self.instrument.dimension

    @property
    def size_is_open(self) -> tuple[str, str]:
        """What is read so of an arm twice as large, and what would tell its size better (`Instrument`); nothing where a
        joint that slides across an axis that turns tells the size, as a length that is read."""
        frame, slides, turns = np.eye(3), list[Array](), list[Array]()
        for joint in self.joints:
            frame = frame @ joint.origin[:3, :3]
            (turns if joint.type == REVOLUTE else slides).append(frame @ joint.axis)
        across = any(np.linalg.norm(np.cross(*pair)) > 1e-9 for pair in product(slides, turns))
        return ("", "") if across else self.instrument.size_is_open

    @cached_property
    def link_poses(self) -> tuple[Array, ...]:
        """(n + 1) poses (4, 4) of each joint's frame in that of the joint before, and of the tip's [mm]."""
        return *(joint.origin for joint in self.joints), self.end

    @cached_property
    def lengths(self) -> Array:
        """(n,) nominal lengths [mm] of the straight lines from each joint's frame to the next, the last to the tip."""
        return readonly([np.linalg.norm(matrix[:3, 3]) for matrix in self.link_poses[1:]])

    @cached_property
    def reach(self) -> float:
        """Largest distance [mm] between base and tip that the parts of the chain could add up to; or that of a measured
        point, if it is farther from the tip, and of axes that all meet in one point some distance."""
        slides = [max(abs(joint.lower), abs(joint.upper)) for joint in self.joints if joint.type == PRISMATIC]
        parts = [np.linalg.norm(self.link_poses[0][:3, 3]), *self.lengths.tolist(), *slides]
        return float(max(sum(parts), *(np.linalg.norm(place[:3, 3]) for place in self.tools.values()), 0.0)) or 100.0

    @cached_property
    def levers(self) -> Array:
        """(n,) distances [mm] over which each joint acts, in order of magnitude: from joint to tip as parts could add
        up, not below a tenth of the reach; in the plane the length of its link (paper)."""
        return np.maximum(np.cumsum(self.lengths[::-1])[::-1], self.reach / 10.0)

    # -- parameters ----------------------------------------------------------------------------------------------------
    @cached_property
    def every_parameter(self) -> ParameterSet:
        """All of the geometry: base (6), tools (3 each, 6 where orientations are measured), for each joint its offset
        and six errors, in the plane lengths of links and offsets of joints, and last those of the instrument itself."""
        parameters = _six(BASE, self.reach, (BASE, BASE))
        for name, place in self.tools.items():
            # no measured point is farther from where it is drawn or found first
            far = 3.0 * (self.reach + float(np.linalg.norm(place[:3, 3])))
            of_tool = _six(f"tool[{name}]", self.angle_scale or 1.0, (TOOL, TOOL), far)
            parameters += of_tool[: DIMENSION if self.angle_scale is None else 2 * DIMENSION]
        for j, (joint, lever) in enumerate(zip(self.joints, self.levers.tolist(), strict=True), start=1):
            unit, scale = ("rad", lever) if joint.type == REVOLUTE else ("mm", 1.0)
            parameters.append(Parameter(f"{JOINT_OFFSET}:{j}", unit, scale=scale, kind=JOINT_OFFSET, joint=j))
            parameters += _six(j, lever, (TRANSLATION_ERROR, ROTATION_ERROR))
        return ParameterSet([*parameters, *self.instrument.parameters])

    def parameters(self, best: Mapping[str, float] = NOTHING) -> ParameterSet:
        """What there is to find: `every_parameter` but for

        the base and tools that are given; errors along or about a joint's own axis, which are its offset; those of
        joint 1 where the base is to be found, which are errors of the base; the place of the first measured point where
        no joint turns, which then is a shift of the base; what no reading of the instrument shows

        best : best known values, which matter in the plane
        """
        stands = BASE in self.settled
        hidden = {
            error_names(j)[k + DIMENSION * (joint.type == REVOLUTE)]
            for j, joint in enumerate(self.joints, start=1)
            for k in np.flatnonzero(np.abs(joint.axis) >= 1.0 - 1e-12)  # but for rounding; none of one between the axes
        }
        hidden |= frozenset() if stands else self.instrument.hidden(self.base)
        hidden |= {self._turning_with_targets} if self.instrument.own_targets else frozenset()
        where = error_names(f"tool[{next(iter(self.tools))}]")[:DIMENSION]
        hidden |= frozenset() if stands or REVOLUTE in self.joint_types else {*where}
        return ParameterSet(
            p
            for p in self.every_parameter
            if (p.kind.partition("_")[0] not in self.settled or p in self.instrument.parameters)
            and (p.name not in hidden and (p.joint != 1 or stands))
        )

    @cached_property
    def _turning_with_targets(self) -> str:
        """Name of the error of joint 2 that turns all beyond joint 1 about the axis of that, or most nearly does:
        targets in the frame of the base turn with it, so that no reading shows it. Empty: there is none."""
        if len(self) < 2 or self.joints[0].type != REVOLUTE:
            return ""
        axis, following = self.joints[0].axis, self.joints[1]
        turn, shift = following.origin[:3, :3].T, following.origin[:3, 3]
        moved = np.abs(np.r_[turn @ np.cross(axis, shift), turn @ axis * self.levers[0]])  # [mm]
        if following.type == REVOLUTE:  # its offset stands for the turn about its own axis
            moved[3:] *= 1.0 - np.abs(following.axis)
        return error_names(2)[int(np.argmax(np.roll(moved, 3))) - 3]  # of equal ones a turn

    def along_base(self, shift: Mapping[str, float], values: Values, back: bool = False) -> dict[str, Any]:
        """A shift of the base along its own axes as one along those of the instrument, or `back`, by the names of its
        parameters; empty where there is none;  values : of parameters, where the base is turned by them"""
        if set(self.base_shift).isdisjoint(shift):
            return {}
        axes, along = self._base_axes(values), in_space(ca.DM([shift.get(name, 0.0) for name in self.base_shift]))
        turned = ca.mtimes(axes.T if back else axes, along)
        return {name: turned[k] for k, name in enumerate(self.base_shift)}

    def _base_axes(self, values: Values) -> Any:
        """(3, 3) axes of the base in the frame of the instrument."""
        return ca.DM(self.base[:3, :3])

    # -- symbols -------------------------------------------------------------------------------------------------------
    def frames(self, q: ca.SX, values: Values, added: Mapping[str, ca.SX] = NOTHING) -> list[Frame]:
        """n + 2 frames in CasADi symbols: base, each joint after it moved, tip.

        q : (n,) positions of the joints [rad, mm];  values : parameter name -> value, zero where missing
        added : what effects add at each place of the chain (identification/effects/base.py)
        """
        names, d, turns = error_names(BASE), self.dimension, len(self.turning)
        shift = ca.vertcat(*(values.get(name, 0.0) for name in names[:3]))
        frame = Frame.world().shifted(shift + in_space(added.get("base_translation", ca.SX(0, 1)))).placed(self.base)
        frame = frame.displaced(values, names[3:])
        frame = frame.turned_about(self.turning, added["base_rotation"]) if added else frame
        placed, frame = [frame], frame.placed(self.joints[0].origin)
        for j, (joint, behind, length) in enumerate(zip(self.joints, self.link_poses[1:], self.lengths, strict=True)):
            frame = frame.displaced(values, error_names(j + 1))
            frame = joint.moved(frame, q[j] + values.get(f"{JOINT_OFFSET}:{j + 1}", 0.0))
            longer = ca.SX(values.get(f"{LENGTH_ERROR}:{j + 1}", 0.0))
            if added:
                frame = frame.turned_about(self.turning, added["joint_turns"][turns * j : turns * (j + 1)])
                frame = frame.shifted(in_space(added["joint_shifts"][d * j : d * (j + 1)]))
                longer += added["extensions"][j]
            placed.append(frame)
            link = ca.SX(ca.DM(behind[:3, 3]))  # along which it may be longer
            frame = frame.shifted(link + link * longer / length if length else link)
            frame = frame.placed(pose(rotation=behind[:3, :3]))
        return [*placed, frame]

    def measured(self, tip: Frame, values: Values, marker: ca.SX | None = None, added: ca.SX | float = 0.0) -> Frame:
        """The frame of a measured point, where the tip's frame is there: its origin is the point;  marker : its number
        from 0, None: the first;  added : (3,) to the place of each"""
        places, axes = [], []
        for name, place in self.tools.items():
            names = error_names(f"tool[{name}]")
            drawn = Frame.world().placed(place)
            places.append(drawn.shift + ca.vertcat(*(values.get(error, 0.0) for error in names[:3])))
            axes.append(drawn.displaced(values, names[3:]).axes)
        chosen, turned = places[0], axes[0]
        for k in range(1, len(places) if marker is not None else 0):
            chosen, turned = ca.if_else(marker == k, places[k], chosen), ca.if_else(marker == k, axes[k], turned)
        return Frame(tip, chosen + added, turned)

    def tip(
        self, q: ca.SX, values: Values, added: Mapping[str, ca.SX], marker: ca.SX | None, reference: ca.SX | None
    ) -> tuple[ca.SX, ca.SX]:
        """(d,) measured point [mm] at real joint positions (n,) but for their offsets, before the instrument, and (3,)
        how far the measured frame is turned against its reference [mm], (0,) where only points are measured.

        values, added : as of `frames`;  marker : as of `measured`
        reference : (9,) orientation to compare with, by rows
        """
        frame = self.measured(self.frames(q, values, added)[-1], values, marker, in_space(added["tool"]))
        point = frame.point(ca.SX(3, 1))[: self.dimension]
        if self.angle_scale is None or reference is None:
            return point, ca.SX(0, 1)
        return point, self.angle_scale * rotation_vector(ca.mtimes(frame.axes, ca.reshape(reference, 3, 3)))

    def in_base(self, q: ca.SX, values: Values) -> list[Frame]:
        """`frames` and that of the first measured point in the frame of the base, as if nothing were wrong with it."""
        at_home = replace(self, base=np.eye(4))
        frames = at_home.frames(q, {name: value for name, value in values.items() if not name.startswith("base.")})
        return [*frames, self.measured(frames[-1], values)]

    # -- numbers: errors of the geometry by name -----------------------------------------------------------------------
    def points(self, postures: Array, values: Numbers) -> Array:
        """(..., n + 2, d) base, joints and the first measured point [mm] at postures (..., n), in the frame of the
        base; n + 1 of a planar arm, whose joint 1 is the base."""
        return np.delete(self.frames_at(values)(postures)[..., self.first_point :, : self.dimension, 3], -2, axis=-2)

    def tip_frames(self, postures: Array, values: Numbers = NOTHING) -> Array:
        """(m, 4, 4) poses of the tip in the base at postures (m, n)."""
        return self.frames_at(values)(postures)[..., -2, :, :]

    def frames_at(self, values: Numbers) -> Callable[[Array], Array]:
        """What gives the frames (..., n + 3, 4, 4) [mm] at postures (..., n), in that of the base: base, each joint
        after it moved, tip, and the first measured point or frame."""
        return _frames_at(self, tuple(values.items()))

    # -- with its errors -----------------------------------------------------------------------------------------------
    def corrected(self, values: Numbers) -> Self:
        """The chain whose nominal geometry is this one's with its errors."""
        joints = []
        for j, joint in enumerate(self.joints, start=1):
            zero = joint.motion(values.get(f"{JOINT_OFFSET}:{j}", 0.0))
            joints.append(replace(joint, origin=joint.origin @ pose(*displacement(values, error_names(j))) @ zero))
        return replace(self.standing_in(values), joints=tuple(joints))

    def standing_in(self, values: Numbers, back: bool = False) -> Self:
        """The chain with base and measured points or frames where their errors bring them, or `back` from there; its
        joints as they are."""

        def moved(frame: str, at: Array) -> Array:
            shift, turn = displacement(values, error_names(frame))
            return pose(at[:3, 3] + (-shift if back else shift), at[:3, :3] @ (turn.T if back else turn))

        tools = {name: moved(f"tool[{name}]", at) for name, at in self.tools.items()}
        return replace(self, base=moved(BASE, self.base), tools=tools)

    def drawn_as(self, other: KinematicChain) -> bool:
        """Whether its errors mean the same as those of another: equal lengths, joints and frames."""
        alike = type(self) is type(other) and self.joint_types == other.joint_types
        if not alike or not np.allclose(self.lengths, other.lengths):
            return False
        pairs = zip(self.joints, other.joints, strict=True)
        return all(np.allclose(one.origin, two.origin) and np.allclose(one.axis, two.axis) for one, two in pairs)

    def one_unnamed(self, names: Collection[str]) -> Self:
        """The chain with one measured point, to be found, where it has several and rows name none of them."""
        return self if names or len(self.tools) == 1 else replace(self, tools={UNNAMED: np.eye(4)})

    def unit_at(self, joint: int, unit: str) -> tuple[str, float]:
        """Unit of what is added to the position of a joint (from 1), as of one that turns, and how many of it move the
        tip as one does there: sliding ones have lengths for angles and forces for torques."""
        slides = self.joints[joint - 1].type == PRISMATIC and unit in SLIDING
        return (SLIDING[unit], float(self.levers[joint - 1])) if slides else (unit, 1.0)

    def corrected_links(self, drawn: Sequence[Link]) -> tuple[tuple[Link, ...], Array, Array]:
        """The n - 1 links of n revolute joints about their z axes, their errors in them (`corrected`), nearest to those
        drawn; the pose (4, 4) of the first axis's frame in that of the base, and of the tip's in that of the last axis.

        By the common normal of two axes; where they are drawn parallel by where the second axis meets the plane of d as
        drawn."""
        *places, tip = np.array(list(accumulate([joint.origin for joint in self.joints] + [self.end], np.matmul)))
        first = frame = places[0]
        links = list[Link]()
        for link, following in zip(drawn, places[1:], strict=True):
            z, w, away, d = frame[:3, 2], following[:3, 2], following[:3, 3] - frame[:3, 3], link.d
            parallel = link.beta is not None
            away = away - d * z if parallel else away
            away = away - w * float(away @ z) / float(w @ z) if parallel else away
            normal = away if parallel else np.cross(z, w)
            normal = normal / np.linalg.norm(normal)
            normal = normal if normal @ (frame[:3, :3] @ rotation_about(Z, link.theta) @ X) >= 0.0 else -normal
            x, y, _ = frame[:3, :3].T @ normal
            theta, alpha = np.arctan2(y, x), float(np.arctan2(-np.cross(z, normal) @ w, z @ w))
            beta = float(np.arcsin(np.clip(normal @ w, -1.0, 1.0))) if parallel else None
            d = d if parallel else float(np.cross(away, w) @ normal / np.sin(alpha))
            turns = (float(np.unwrap([drawn, angle])[1]) for drawn, angle in ((link.theta, theta), (link.alpha, alpha)))
            between = Link(next(turns), d, float(away @ normal), next(turns), beta)
            if not links:  # where the first frame stands on its axis is free: theta and d as drawn
                frame = frame @ pose((0.0, 0.0, between.d - link.d), rotation_about(Z, between.theta - link.theta))
                between, first = between._replace(theta=link.theta, d=link.d), frame
            tilt = rotation_about(X, between.alpha) @ rotation_about(Y, between.beta or 0.0)
            frame = frame @ pose(rotation=rotation_about(Z, between.theta)) @ pose((between.a, 0.0, between.d), tilt)
            links.append(between)
        return tuple(links), first, np.linalg.inv(frame) @ tip


@lru_cache(maxsize=32)  # compiled once, used in every search
def _frames_at(chain: KinematicChain, values: tuple[tuple[str, float], ...]) -> Callable[[Array], Array]:
    q = ca.SX.sym("q", len(chain))
    placed = [ca.horzcat(frame.axes, frame.origin) for frame in chain.in_base(q, dict(values))]
    evaluate = vectorize(ca.Function("frames", [q], [ca.cse(ca.densify(ca.vertcat(*placed)))]))

    def at(postures: Array) -> Array:
        frames = np.zeros((*postures.shape[:-1], len(placed), 4, 4))
        frames[..., 3, 3] = 1.0
        frames[..., :3, :] = evaluate(postures)[0].reshape(*frames.shape[:-2], 3, 4)
        return frames

    return at


def _six(frame: str | int, lever: float, kinds: tuple[str, str], farthest: float = np.inf) -> list[Parameter]:
    names, joint = error_names(frame), frame if isinstance(frame, int) else None
    translations = [Parameter(name, "mm", -farthest, farthest, kind=kinds[0], joint=joint) for name in names[:3]]
    return translations + [Parameter(name, "rad", scale=lever, kind=kinds[1], joint=joint) for name in names[3:]]


@dataclass(frozen=True, eq=False)
class PlanarChain(KinematicChain):
    """A chain that moves in a plane: its free errors are link lengths and joint zeros, and its base and tip are where
    the drawing has them; where the base stands is an effect, and how it is turned the offset of joint 1."""

    kind = "planar"
    lists = MappingProxyType({LENGTH_ERROR: "length_errors_mm", JOINT_OFFSET: "joint_offsets_deg"})
    axes = "xy"
    turning = (2,)
    turn_names = ("w",)
    base_shift = ("base_offset.x0", "base_offset.y0")
    drawn = frozenset({BASE, TOOL})
    point_column = ""
    first_point = 1
    projection = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.angle_scale is None, "orientations: found for a planar arm, allowed: for a spatial one")

    redundant = property(lambda self: False)
    # what no reading shows, too
    unestimated = property(lambda self: self.fixed | self.instrument.hidden(self.base))
    standing = property(lambda self: (*self.base_shift, f"{JOINT_OFFSET}:1") if self.as_in_paper else ())
    standing_effects = property(lambda self: ("base_offset",) if self.as_in_paper else ())
    as_in_paper = property(attrgetter("instrument.reads_positions"))
    levers = property(attrgetter("lengths"))
    every_parameter = property(lambda self: self.parameters())

    def parameters(self, best: Mapping[str, float] = NOTHING) -> ParameterSet:
        """Length errors, joint offsets and those of the instrument;  best : best known values, by which the offsets are
        scaled as far as anything is left of a link"""
        numbers = range(1, len(self) + 1)
        lengths = self.lengths + [best.get(f"{LENGTH_ERROR}:{j}", 0.0) for j in numbers]
        errors = [Parameter(f"{LENGTH_ERROR}:{j}", "mm", kind=LENGTH_ERROR, joint=j) for j in numbers]
        offsets = [
            Parameter(f"{JOINT_OFFSET}:{j}", "rad", scale=s, kind=JOINT_OFFSET, joint=j)
            for j, s in enumerate(np.where(lengths == 0.0, self.lengths, np.abs(lengths)).tolist(), start=1)
        ]
        return ParameterSet([*errors, *offsets, *self.instrument.parameters])

    def _base_axes(self, values: Values) -> Any:
        return Frame.world().turned(2, values.get(f"{JOINT_OFFSET}:1", 0.0)).axes


def planar_chain(lengths: ArrayLike) -> KinematicChain:
    """The planar arm of links (n,) [mm] behind revolute joints."""
    links = np.ravel(np.asarray(lengths, dtype=float))
    before = (pose((length, 0.0, 0.0)) for length in (0.0, *links[:-1]))
    joints = (Joint(f"joint_{j}", origin, Z) for j, origin in enumerate(before, start=1))
    return PlanarChain(tuple(joints), pose((links[-1], 0.0, 0.0)), settled=PlanarChain.drawn)


def in_space(vector: Any) -> Any:
    """(3,) a vector (d,) along the first axes."""
    return ca.vertcat(vector, ca.SX.zeros(DIMENSION - vector.numel())) if vector.numel() < DIMENSION else vector


STANDARD, MODIFIED = "standard", "modified"


@dataclass(frozen=True)
class DHRow:
    """One joint: a, d [mm], alpha, offset [rad]; lower and upper limits [rad, mm], None: -pi to pi."""

    a: float
    alpha: float
    d: float
    offset: float = 0.0
    type: str = REVOLUTE
    limits: tuple[float, float] | None = None


def chain_of(rows: Sequence[DHRow], convention: str = STANDARD) -> KinematicChain:
    """The chain of a table; every joint moves about or along its own z axis.

    Raises `InputError` for another convention, no rows, and prismatic joints without limits.
    """
    require(convention in (STANDARD, MODIFIED), f"dh: convention {convention!r}, allowed: {STANDARD} or {MODIFIED}")
    joints, before = [], np.eye(4)
    for j, row in enumerate(rows, start=1):
        link = pose((row.a, 0.0, 0.0), rotation_about(X, row.alpha))  # Tx Rx = Rx Tx
        rise, turn = pose((0.0, 0.0, row.d)), pose(rotation=rotation_about(Z, row.offset))
        before, after = (before @ turn, rise @ link) if convention == STANDARD else (before @ link @ turn, rise)
        if row.limits is None and row.type != REVOLUTE:
            allowed = "lower and upper in [joint_limits_mm]"
            raise InputError(f"dh[{j}]: a prismatic joint without limits, allowed: {allowed}")
        joints.append(Joint(f"joint_{j}", before, Z, row.type, *(row.limits or (-np.pi, np.pi))))
        before = after
    require(bool(joints), "dh: no rows, allowed: one for each joint")
    return KinematicChain(tuple(joints), before, rows=tuple(rows), convention=convention)


@dataclass(frozen=True, eq=False)
class PlanarClosedForm:
    """Length errors, joint offsets and, if `offset`, the base's offset of a planar chain (identification/README.md,
    "Closed form"): the paper says there is none, but eq. 1 is linear in u_j.

    With u_j = (l_j + dl_j) exp(i dtheta_j) the tip is sum_j exp(i theta_j) u_j (+ x0 + i y0): a complex linear
    least-squares problem. Its solution is the exact global minimiser of eq. 3, then dl_j = |u_j| - l_j and
    dtheta_j = arg u_j. Of combinations that the postures do not determine, the nominal arm's values stay.

    lengths : (n,) nominal [mm]
    indices : (q,) where the q parameters stand among those of the model
    exact : the model has no other parameters, so that the closed form is its least-squares solution; else a start
    """

    lengths: Array
    offset: bool
    indices: NDArray[np.intp]
    exact: bool

    def solver(self, postures: Array, weights: Array, tolerance: float) -> Solver:
        """Function of positions (K, m, 2) [mm] -> (K, q) parameters and (K,) weighted sums of squares.

        postures : (m, n) [rad] for all data sets;  weights : (m,) of the rows
        tolerance : singular values below this share of the largest are zero; the columns have equal lengths
        """
        columns, root = np.exp(1j * np.cumsum(postures, axis=1)), np.sqrt(weights)  # exp(i theta_j)
        n, nominal = len(self.lengths), np.r_[self.lengths, np.zeros(int(self.offset))].astype(complex)
        if self.offset:
            columns = np.column_stack([columns, np.ones(len(columns))])
        back = np.asarray(np.linalg.pinv(root[:, None] * columns, rcond=tolerance)) * root
        back, forth = (np.ascontiguousarray(a.T) for a in (back, columns))

        def solve(positions: Array) -> tuple[Array, Array]:
            # x + iy, without a copy where memory allows; of differences to the nominal arm squares lose no digits
            rest = np.ascontiguousarray(positions, dtype=float).view(np.complex128)[..., 0] - columns @ nominal
            change = rest @ back
            squares = ((rest - change @ forth) * root).view(np.float64)
            unknowns = nominal + change
            u, shift = unknowns[..., :n], unknowns[..., n:]
            # dq_j = arg u_j - arg u_(j-1) as one argument, so that it needs no wrapping
            turned = np.concatenate([u[..., :1], u[..., 1:] * np.conj(u[..., :-1])], axis=-1)
            parts = [np.abs(u) - self.lengths, np.angle(turned), shift.real, shift.imag]
            return np.concatenate(parts, axis=-1), np.einsum("ki,ki->k", squares, squares)

        return solve


# -- a chain with its errors -------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class CorrectedGeometry:
    """A chain, as nominal, with the errors that were found: parameter name -> value [mm, rad]."""

    chain: KinematicChain
    values: Mapping[str, float]

    @cached_property
    def real(self) -> KinematicChain:
        """The chain whose nominal geometry is the corrected one."""
        return self.chain.corrected(self.values)

    @property
    def places(self) -> dict[str, Any]:
        """`base` and `tools` of a `Calibration`: those that were to be found, of points only their places."""
        tools = {} if TOOL in self.chain.settled else dict(self.real.tools)
        tools = {n: pose(at[:3, 3]) if self.chain.angle_scale is None else at for n, at in tools.items()}
        return {"base": None if BASE in self.chain.settled else self.real.base, "tools": tools}

    def to_json(self, counting: Counting) -> dict[str, Any]:
        """Keys of `identify` for spatial arms (identification/files/README.md, "JSON keys");  counting : of the
        controller"""
        every = [self.values.get(f"{JOINT_OFFSET}:{j}", 0.0) for j in range(1, len(self.chain) + 1)]
        offsets, added = [], (counting.matrix @ every).tolist()
        for j, (kind, value) in enumerate(zip(self.chain.joint_types, added, strict=True), start=1):
            # what the joint adds to a command, and what a controller has to add to its own, as it counts
            value, unit = (float(np.degrees(value)), "deg") if kind == REVOLUTE else (value, "mm")
            offsets.append({"joint": j, "unit": unit, "value": value, "command": 0.0 - value})
        return {**self.tables(), "joint_offsets": offsets}

    def tables(self) -> dict[str, Any]:
        """The keys `base`, `tools` and `geometry` of these."""
        rows = []
        for j, joint in enumerate(self.chain.joints, start=1):
            origin = self.origin(j)  # its angles the nearest to those drawn of all that make the same rotation
            turn = roll_pitch_yaw(origin[:3, :3], near=roll_pitch_yaw(joint.origin[:3, :3]))
            angles = zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees(turn).tolist(), strict=True)
            rows.append({"joint": j, "name": joint.name, **point_table(origin[:3, 3]), **dict(angles)})
        base, tools = self.places.values()
        base = None if base is None else pose_table(base)
        return {"base": base, "tools": tool_tables(tools), "geometry": rows}

    def origin(self, j: int) -> Array:
        """(4, 4) pose of the frame of a joint, counted from 1, in that of the joint before, its offset apart [mm]."""
        offset = self.values.get(f"{JOINT_OFFSET}:{j}", 0.0)
        return self.real.joints[j - 1].origin @ self.chain.joints[j - 1].motion(-offset)


class Link(NamedTuple):
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta) from the axis of a joint to the next [rad, mm]; beta None: axes are not
    parallel."""

    theta: float
    d: float
    a: float
    alpha: float
    beta: float | None = None


def drawn_links(rows: Sequence[DHRow], convention: str = STANDARD) -> tuple[Link, ...]:
    """The links between the axes of a table; raises `InputError` for prismatic joints, whose axes have no place, and
    for successive axes that are one."""
    turn = all(row.type == REVOLUTE for row in rows)
    require(turn, "dh: found prismatic joints, allowed: a table of revolute joints")
    behind = rows[:-1] if convention == STANDARD else rows[1:]  # whose a and alpha lead to the next axis
    links = tuple(  # beta where the drawing has axes parallel
        Link(row.offset, row.d, after.a, after.alpha, 0.0 if abs(np.sin(after.alpha)) < 1e-6 else None)
        for row, after in zip(rows, behind, strict=False)
    )
    apart = all(link.beta is None or link.a for link in links)
    require(apart, "dh: found successive joints with one axis, allowed: different axes")
    return links
