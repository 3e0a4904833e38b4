"""Rigid transformations in space: (4, 4) homogeneous matrices in numpy, and elementary motions in CasADi.

Rotations by roll, pitch and yaw (r, p, y) are those of URDF: Rz(y) Ry(p) Rx(r), about fixed axes; files speak of
rotations about own axes, x, then y, then z.

Measured orientations are rotation matrices of what files say. The difference of two is a rotation vector: the axis of
the rotation from one to the other, as long as its angle [rad]. A fit counts it in millimetres,
`Tracker.angle_scale` [mm/rad] for each radian.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from identification.arrays import Array, readonly
from identification.kinematics.parameters import AXES

X, Y, Z = np.eye(3)


def pose(translation: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None) -> Array:
    """(4, 4) from a translation (3,) and a rotation matrix (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, 3] = translation
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    return matrix


def as_poses(places: Mapping[str, Array]) -> dict[str, Array]:
    """Name -> pose (4, 4), of which a place (3,) is not turned."""
    return {name: readonly(pose(at) if np.ndim(at) == 1 else at) for name, at in places.items()}


def turned(vectors: ArrayLike) -> Array:
    """(..., 3, 3) rotations by rotation vectors (..., 3) [rad] (Rodrigues)."""
    vectors = np.asarray(vectors, dtype=float)
    angles, half = np.linalg.norm(vectors, axis=-1)[..., None], np.zeros((*vectors.shape, 3))
    half[..., [2, 0, 1], [1, 2, 0]] = vectors / np.maximum(angles, np.finfo(float).tiny)
    cross, (sine, cosine) = half - np.swapaxes(half, -1, -2), (f(angles)[..., None] for f in (np.sin, np.cos))
    return np.asarray(np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross)


def rotation_about(axis: ArrayLike, angle: float) -> Array:
    """(3, 3) rotation by an angle [rad] about a unit vector (3,)."""
    return turned(np.asarray(axis, dtype=float) * angle)


def rotation_to_z(axis: Array) -> Array:
    """(3, 3) rotation that turns the z axis into a unit vector (3,)."""
    cross = np.array([-axis[1], axis[0], 0.0])  # z x axis
    if (sine := float(np.linalg.norm(cross))) > 0.0:
        return rotation_about(cross / sine, float(np.arctan2(sine, axis[2])))
    return np.diag([1.0, axis[2], axis[2]])


def from_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3) Rz(yaw) Ry(pitch) Rx(roll)."""
    return rotation_about(Z, yaw) @ rotation_about(Y, pitch) @ rotation_about(X, roll)


def roll_pitch_yaw(rotation: Array, near: ArrayLike | None = None) -> Array:
    """(..., 3) angles [rad] with `from_roll_pitch_yaw` of them the rotations (..., 3, 3).

    near : (3,) angles [rad]: of the equal ones of one rotation the nearest to these; None: pitch within 90 deg, and a
        yaw of zero where only the sum or difference of roll and yaw counts (gimbal lock)
    """
    lock = 1e-12  # cosine of the pitch below which roll and yaw turn about one axis
    matrix = np.moveaxis(rotation, (-2, -1), (0, 1))
    level = np.hypot(matrix[0, 0], matrix[1, 0])
    pitch = np.arctan2(-matrix[2, 0], level)
    yaw = np.where(level >= lock, np.arctan2(matrix[1, 0], matrix[0, 0]), 0.0)
    sine, cosine = np.sin(yaw), np.cos(yaw)  # roll is what this yaw leaves: near the lock each of the two is uncertain
    across = sine * matrix[0, 2] - cosine * matrix[1, 2], cosine * matrix[1, 1] - sine * matrix[0, 1]
    rpy = np.stack([np.arctan2(*across), pitch, yaw], axis=-1)
    if near is None:
        return rpy
    near, turn = np.asarray(near, dtype=float), 2.0 * np.pi
    if level < lock:  # any roll and yaw with this roll - side * yaw: both go half of the way
        side = float(np.sign(pitch))
        way = rpy[0] - (near[0] - side * near[2])
        way -= turn * round(way / turn)
        rpy = np.array([near[0] + 0.5 * way, pitch, near[2] - 0.5 * side * way])
    equal = rpy, np.array([rpy[0] + np.pi, np.pi - pitch, rpy[2] + np.pi])
    nearest = [angles - turn * np.round((angles - near) / turn) for angles in equal]
    return min(nearest, key=lambda angles: float(np.linalg.norm(angles - near)))


def from_angles(angles: ArrayLike) -> Array:
    """(..., 3, 3) Rx(x) Ry(y) Rz(z) of angles (..., 3) [rad]: turned about its own x, then its own y, then its own z
    axis (intrinsic X-Y-Z)."""
    x, y, z = np.moveaxis(turned(np.asarray(angles, dtype=float)[..., None] * np.eye(3)), -3, 0)
    return np.asarray(x @ y @ z)


def to_angles(rotations: Array) -> Array:
    """(..., 3) angles [rad] of which `from_angles` makes these rotations (..., 3, 3)."""
    return -roll_pitch_yaw(np.swapaxes(rotations, -1, -2))


# (9, 16) rotation matrices, by rows, of the products of the entries of a unit quaternion, the real part first
_entries = np.zeros((3, 3, 4, 4))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _entries[_i, _i] = 2.0 * np.diag(np.eye(4)[0] + np.eye(4)[_i + 1]) - np.eye(4)
    for _at, _sign in (((_i, _j), -1.0), ((_j, _i), 1.0)):
        _entries[(*_at, (_i + 1, _j + 1), (_j + 1, _i + 1))] = 1.0
        _entries[(*_at, (0, _k + 1), (_k + 1, 0))] = _sign
OF_QUATERNION = readonly(_entries.reshape(9, 16))


def from_quaternions(quaternions: Array) -> Array:
    """(m, 3, 3) rotation matrices of quaternions (m, 4), the real part first, of any length."""
    units = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return ((units[:, :, None] * units[:, None]).reshape(-1, 16) @ OF_QUATERNION.T).reshape(-1, 3, 3)


def displacement(values: Mapping[str, float], names: Sequence[str]) -> tuple[Array, Array]:
    """(3,) translation and (3, 3) rotation by six errors of these names (`error_names`), zero where missing."""
    errors = [values.get(name, 0.0) for name in names]
    return np.array(errors[:3]), from_angles(errors[3:])


def point_table(place: Array) -> dict[str, float]:
    """(3,) [mm] as files and JSON have it."""
    return {f"{axis}_mm": float(x) for axis, x in zip(AXES, place, strict=True)}


def pose_table(matrix: Array) -> dict[str, float]:
    """(4, 4) [mm] as files and JSON have it."""
    angles = zip(AXES, np.degrees(to_angles(matrix[:3, :3])), strict=True)
    return point_table(matrix[:3, 3]) | {f"r{axis}_deg": float(f"{angle:.15g}") for axis, angle in angles}


def tool_tables(tools: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Frames (4, 4) [mm] of measured points as files and JSON have them by name, what is not turned as a point."""
    turned = {name: not np.array_equal(at[:3, :3], np.eye(3)) for name, at in tools.items()}
    return {name: pose_table(at) if turned[name] else point_table(at[:3, 3]) for name, at in tools.items()}


def nearest_rotation(matrices: Array) -> Array:
    """(..., d, d) rotations, no mirrors, with the largest sums of products of entries with matrices (..., d, d): the
    best for two clouds of points, of which the matrix is the product (Kabsch 1976); of the mean of some their mean."""
    left, _, right = np.linalg.svd(matrices)
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def rotation_vector(rotation: ca.SX) -> ca.SX:
    """(3,) rotation vector [rad] of a rotation matrix (3, 3) in CasADi, smooth where it is none; of a matrix of zeros
    zero."""
    across = ca.vertcat(*(rotation[(k + 2) % 3, (k + 1) % 3] - rotation[(k + 1) % 3, (k + 2) % 3] for k in range(3)))
    half = across / ca.fmax(1.0 + ca.trace(rotation), 1e-30)  # the axis times the tangent of half the angle
    squared = ca.dot(half, half)
    small = 1e-3  # below which five terms of the arc tangent's series are exact: 1e-3^5
    root = ca.sqrt(ca.fmax(squared, small))
    series = 1.0 - squared * (1.0 / 3.0 - squared * (1.0 / 5.0 - squared * (1.0 / 7.0 - squared / 9.0)))
    return 2.0 * half * ca.if_else(squared < small, series, ca.atan(root) / root)


@dataclass(frozen=True)
class Frame:
    """A frame in CasADi symbols, by its pose in the frame before it, or in the world.

    shift : (3,);  rotation : (3, 3), its columns the x, y and z axes
    about_z : [rad] by which it is turned in the world, None: about other axes, too

    A point goes back through the frames one by one, three numbers each time where frames from the base on have twelve,
    which makes positions and their derivatives (by reverse mode) cost half as much. Where all turns are about z, as in
    the plane, they add up to one angle, and the frame stands in the world: two thirds of that.
    """

    before: Frame | None
    shift: ca.SX
    rotation: ca.SX
    about_z: ca.SX | None = None

    @classmethod
    def world(cls) -> Frame:
        """The frame that everything is measured in."""
        return cls(None, ca.SX(3, 1), ca.SX.eye(3), ca.SX(0))

    @cached_property
    def origin(self) -> ca.SX:
        """(3,) where it is in the world."""
        return self.shift if self.before is None else self.before.origin + ca.mtimes(self.before.axes, self.shift)

    @cached_property
    def axes(self) -> ca.SX:
        """(3, 3), columns: its axes in the world."""
        return self.rotation if self.before is None else ca.mtimes(self.before.axes, self.rotation)

    def point(self, place: ca.SX) -> ca.SX:
        """(3,) position in the world of a point (3,) that is given in this frame."""
        frame: Frame | None = self
        while frame is not None:
            place, frame = frame.shift + ca.mtimes(frame.rotation, place), frame.before
        return place

    def shifted(self, shift: ca.SX) -> Frame:
        """Shifted by a vector (3,) of this frame."""
        if shift.is_zero():
            return self
        if self.about_z is None:
            return Frame(self, shift, ca.SX.eye(3))
        return Frame(None, self.point(shift), self.rotation, self.about_z)

    def moved(self, axis: int, distance: ca.SX | float) -> Frame:
        """Shifted along an own axis."""
        return self.shifted(ca.SX.eye(3)[:, axis] * distance)

    def turned(self, axis: int, angle: ca.SX | float) -> Frame:
        """Turned by an angle [rad] about an own axis."""
        if ca.SX(angle).is_zero():
            return self
        about_z = None if self.about_z is None or axis != 2 else self.about_z + angle
        angle, rotation = angle if about_z is None else about_z, ca.SX.eye(3)
        first, second, cosine, sine = (axis + 1) % 3, (axis + 2) % 3, ca.cos(angle), ca.sin(angle)
        rotation[first, first], rotation[second, first] = cosine, sine
        rotation[first, second], rotation[second, second] = -sine, cosine
        return Frame(self, ca.SX(3, 1), rotation) if about_z is None else Frame(None, self.shift, rotation, about_z)

    def turned_about(self, axes: Sequence[int], angles: Any) -> Frame:
        """Turned by angles [rad] about own axes of these numbers, one after the other."""
        frame = self
        for k, axis in enumerate(axes):
            frame = frame.turned(axis, angles[k])
        return frame

    def displaced(self, values: Mapping[str, Any], names: Sequence[str]) -> Frame:
        """Moved along and turned about own axes by six errors of these names, or turned by the last three, where values
        have them."""
        frame = self
        for k, name in enumerate(names, start=6 - len(names)):
            if name in values:
                frame = frame.moved(k, values[name]) if k < 3 else frame.turned(k - 3, values[name])
        return frame

    def placed(self, matrix: Array) -> Frame:
        """A frame whose pose (4, 4) in this one is constant."""
        shift, rotation = _constants(np.asarray(matrix, dtype=float).tobytes())
        return self.shifted(shift) if rotation is None else Frame(self, shift, rotation)


@lru_cache(maxsize=512)
def _constants(entries: bytes) -> tuple[ca.SX, ca.SX | None]:
    """Shift (3,) and rotation (3, 3), None: none, of a pose (4, 4), in CasADi; models have many of the same."""
    matrix = np.frombuffer(entries).reshape(4, 4)
    placed = ca.sparsify(ca.SX(ca.DM(np.where(np.abs(matrix) < 1e-15, 0.0, matrix))))
    return placed[:3, 3], None if np.array_equal(matrix[:3, :3], np.eye(3)) else placed[:3, :3]
