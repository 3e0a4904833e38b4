"""A small spatial arm as an information model: d = 3, revolute and prismatic joints, errors of every joint's placement.

Independent of the planar model: frames are composed here, in CasADi for the program and in numpy for the oracle, which
takes its derivatives by finite differences.

    frame_j = frame_(j-1) * translation(offset_j) * error_j * motion_j(q_j),   tip = frame_n * (tip + its error)

The error of a revolute joint's axis is a translation and a rotation along the two directions across it, that of a
prismatic joint's a rotation across it, that of the tip a translation. Four, two and three parameters are all that
positions of the tip can tell: the others only move a frame along, or turn it about, its own axis (Everett, Driels and
Mooring 1987: 4 R + 2 P + 3 for positions). Effects are a scale error and an eccentric encoder of a joint: q becomes
q + scale q + encoder_cos cos q + encoder_sin sin q.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.kinematics.parameters import Parameter, ParameterSet
from identification.vectorize import vectorize

AXES = "xyz"
STEP = 1e-5  # [mm, rad] of central differences: error of order STEP^2 = 1e-10 relative, rounding 1e-16 / STEP


@dataclass(frozen=True)
class Joint:
    """axis : x, y or z;  offset : [mm] from the joint before;  type : revolute or prismatic."""

    axis: str
    offset: tuple[float, float, float]
    lower: float
    upper: float
    type: str = "revolute"


def degrees(axis: str, offset: tuple[float, float, float], low: float, high: float) -> Joint:
    """A revolute joint with limits in degrees."""
    return Joint(axis, offset, float(np.radians(low)), float(np.radians(high)))


SMALL_CHAIN = (
    degrees("z", (0.0, 0.0, 300.0), -150.0, 150.0),
    degrees("y", (0.0, 40.0, 0.0), -70.0, 80.0),
    Joint("x", (200.0, 0.0, 0.0), 0.0, 400.0, "prismatic"),
    degrees("z", (150.0, 0.0, 30.0), -120.0, 110.0),
)
SMALL = (
    *("translation_x:2", "translation_z:2", "rotation_x:2", "rotation_z:2", "rotation_y:3", "rotation_z:3"),
    *("translation_x:4", "translation_y:4", "rotation_x:4", "rotation_y:4", "tool.x", "tool.z"),
)
LARGE_CHAIN = (
    degrees("z", (0.0, 0.0, 300.0), -170.0, 170.0),
    degrees("y", (60.0, 0.0, 0.0), -100.0, 100.0),
    degrees("y", (0.0, 0.0, 350.0), -140.0, 60.0),
    Joint("x", (120.0, 0.0, 0.0), 0.0, 250.0, "prismatic"),
    degrees("x", (180.0, 0.0, 20.0), -180.0, 180.0),
    degrees("y", (90.0, 0.0, 0.0), -110.0, 110.0),
    degrees("z", (70.0, 0.0, 0.0), -150.0, 150.0),
)


@dataclass(frozen=True)
class SpatialModel:
    """Errors `names` of a chain of joints are estimated; the other errors are zero.

    known : (p,) best known values of them, empty: zero
    """

    chain: tuple[Joint, ...] = SMALL_CHAIN
    names: tuple[str, ...] = SMALL
    tip: tuple[float, float, float] = (120.0, 35.0, 50.0)
    sigma: float | None = 0.1
    known: tuple[float, ...] = ()
    dimension: int = 3
    space: int = 3
    closed_form: None = None
    prior = MappingProxyType[str, float]({})
    effects: tuple[()] = ()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    # -- what the interfaces ask for ---------------------------------------------------------------------------------
    @cached_property
    def parameters(self) -> ParameterSet:
        return ParameterSet(self._parameter(name) for name in self.names)

    @staticmethod
    def _parameter(name: str) -> Parameter:
        word, _, place = name.partition(":")
        joint = int(place) if place else None
        if word.startswith("rotation"):
            return Parameter(name, "rad", scale=300.0, kind="rotation_error", joint=joint)
        if word == "scale":
            return Parameter(name, "1", scale=200.0, joint=joint)
        if word.startswith("encoder"):
            return Parameter(name, "rad", scale=300.0, joint=joint)
        return Parameter(name, "mm", kind="translation_error", joint=joint)

    @property
    def joints(self) -> int:
        return len(self.chain)

    @property
    def joint_types(self) -> tuple[str, ...]:
        return tuple(joint.type for joint in self.chain)

    @property
    def lower(self) -> Array:
        return np.array([joint.lower for joint in self.chain])

    @property
    def upper(self) -> Array:
        return np.array([joint.upper for joint in self.chain])

    @property
    def reach(self) -> float:
        return float(sum(np.linalg.norm(j.offset) for j in self.chain) + np.linalg.norm(self.tip))

    @property
    def scales(self) -> Array:
        return self.parameters.scales

    @property
    def values(self) -> Array:
        return np.array(self.known) if self.known else np.zeros(len(self.names))

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        return self._symbolic(q, p)[-1]

    @property
    def _size(self) -> int:
        return len(self.names)

    def symbolic_points(self, q: ca.SX) -> list[ca.SX]:
        return self._symbolic(q, ca.SX(ca.DM(self.values)))

    @cached_property
    def _compiled(self) -> Any:
        q, p = ca.SX.sym("q", self.joints), ca.SX.sym("p", self._size)
        position = self._symbolic(q, p)[-1]
        return vectorize(ca.Function("spatial", [q, p], ca.cse([position, ca.jacobian(position, p)])))

    def linearize(
        self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Any = None
    ) -> tuple[Array, Array]:
        values = self.values if parameters is None else np.asarray(parameters, dtype=float)
        position, jacobian = self._compiled(postures, values[..., None, :])
        return position[..., 0], jacobian

    def position(self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Any = None) -> Array:
        return self.linearize(postures, parameters)[0]

    def jacobian(self, postures: ArrayLike, parameters: ArrayLike | None = None, conditions: Any = None) -> Array:
        return self.linearize(postures, parameters)[1]

    def points(self, postures: ArrayLike) -> Array:
        return chain_points(self, np.asarray(postures), self.values)

    # -- the chain in CasADi -----------------------------------------------------------------------------------------
    def _symbolic(self, q: ca.SX, p: ca.SX) -> list[ca.SX]:
        error = {name: p[k] for k, name in enumerate(self.names)}
        place, frame = ca.SX.zeros(3), ca.SX.eye(3)
        points = [place]
        for j, joint in enumerate(self.chain):
            shift = [error.get(f"translation_{axis}:{j + 1}", 0.0) for axis in AXES]
            place = place + frame @ (ca.DM(joint.offset) + ca.vertcat(*shift))
            for axis in AXES:
                frame = frame @ symbolic_turn(axis, error.get(f"rotation_{axis}:{j + 1}", 0.0))
            scale, cosine, sine = (
                error.get(f"{name}:{j + 1}", 0.0) for name in ("scale", "encoder_cos", "encoder_sin")
            )
            motion = q[j] * (1.0 + scale) + cosine * ca.cos(q[j]) + sine * ca.sin(q[j])
            if joint.type == "revolute":
                frame = frame @ symbolic_turn(joint.axis, motion)
            else:
                place = place + motion * frame[:, AXES.index(joint.axis)]
            points.append(place)
        shift = [error.get(f"tool.{axis}", 0.0) for axis in AXES]
        return [*points, place + frame @ (ca.DM(self.tip) + ca.vertcat(*shift))]


def symbolic_turn(axis: str, angle: Any) -> ca.SX:
    """(3, 3) rotation about an axis."""
    if isinstance(angle, float):
        return ca.SX.eye(3)
    cosine, sine, one = ca.cos(angle), ca.sin(angle), AXES.index(axis)
    two, three = (one + 1) % 3, (one + 2) % 3
    matrix = ca.SX.eye(3)
    matrix[two, two], matrix[two, three] = cosine, -sine
    matrix[three, two], matrix[three, three] = sine, cosine
    return matrix


# -- the oracle: the same chain in numpy, derivatives by finite differences ------------------------------------------
CROSS = {axis: np.cross(np.eye(3), unit) for axis, unit in zip(AXES, np.eye(3), strict=True)}  # @ v = axis x v


def turn(axis: str, angles: ArrayLike) -> Array:
    """(..., 3, 3) rotations about an axis by angles (...): Rodrigues' formula."""
    sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
    cross = CROSS[axis]
    return np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross


def chain_points(model: SpatialModel, postures: Array, values: Array) -> Array:
    """(m, n + 2, 3) base, places of the joints, tip [mm] of postures (m, n)."""
    error = dict(zip(model.names, np.asarray(values).tolist(), strict=True))
    place, frame = np.zeros((len(postures), 3)), np.eye(3)
    points = [place]
    for j, (joint, q) in enumerate(zip(model.chain, postures.T, strict=True)):
        place = place + frame @ (np.array(joint.offset) + [error.get(f"translation_{a}:{j + 1}", 0.0) for a in AXES])
        for axis in AXES:
            if angle := error.get(f"rotation_{axis}:{j + 1}"):
                frame = frame @ turn(axis, angle)
        scale, cosine, sine = (error.get(f"{name}:{j + 1}", 0.0) for name in ("scale", "encoder_cos", "encoder_sin"))
        motion = q + scale * q + cosine * np.cos(q) + sine * np.sin(q)
        if joint.type == "revolute":
            frame = frame @ turn(joint.axis, motion)
        else:
            place = place + motion[:, None] * frame[..., AXES.index(joint.axis)]
        points.append(place)
    tip = np.array(model.tip) + [error.get(f"tool.{a}", 0.0) for a in AXES]
    return np.stack([*points, place + frame @ tip], axis=1)


def tip_positions(model: SpatialModel, postures: Array, values: Array | None = None) -> Array:
    """(m, 3) positions of the tip [mm]."""
    return chain_points(model, postures, model.values if values is None else values)[:, -1]


def difference_jacobian(model: SpatialModel, postures: Array, values: Array | None = None) -> Array:
    """(m, 3, p) central differences of the positions by the parameters."""
    centre = np.array(model.values if values is None else values, dtype=float)
    columns = []
    for k in range(len(model.names)):
        ends = [tip_positions(model, postures, centre + sign * STEP * np.eye(len(centre))[k]) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    return np.stack(columns, axis=-1)


def difference_information(model: SpatialModel, postures: Array, weights: Array | None = None) -> Array:
    """(p, p) scaled information per run of (m, n) postures, by finite differences."""
    blocks = difference_jacobian(model, postures) / model.parameters.scales
    shares = np.full(len(postures), 1.0 / len(postures)) if weights is None else weights
    return np.asarray(np.einsum("m,mdp,mdq->pq", shares, blocks, blocks))


# -- problems --------------------------------------------------------------------------------------------------------
def all_errors(chain: tuple[Joint, ...]) -> tuple[str, ...]:
    """Every error of a chain that positions of the tip can tell."""
    names: list[str] = []
    for j, joint in enumerate(chain, start=1):
        across = [axis for axis in AXES if axis != joint.axis]
        names += [f"translation_{axis}:{j}" for axis in across] if joint.type == "revolute" else [f"scale:{j}"]
        names += [f"rotation_{axis}:{j}" for axis in across]
    return (*names, *(f"tool.{axis}" for axis in AXES))


LARGE_MODEL = SpatialModel(LARGE_CHAIN, all_errors(LARGE_CHAIN), (95.0, 20.0, 60.0))  # 6 R + 1 P: 24 + 2 + 1 + 3 = 30


def spatial(model: SpatialModel | None = None, **changes: Any) -> DesignProblem:
    """The design problem of the small arm (p = 12, four joints), or of another model."""
    chosen = model or SpatialModel()
    return DesignProblem(chosen, chosen.lower, chosen.upper, **changes)


def random_postures(model: SpatialModel, count: int, seed: int) -> Array:
    """(count, n) uniform within the limits."""
    return np.random.default_rng(seed).uniform(model.lower, model.upper, (count, model.joints))
