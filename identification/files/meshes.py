"""Shapes of bodies, and triangles of STL and OBJ files; nothing that these name, materials and textures, is read.

STL (3D Systems, 1989): binary with a header of 80 bytes, a count, and 50 bytes a triangle, or text with `vertex x y z`
lines, three a triangle. OBJ (Wavefront): `v x y z` lines and `f a b c ..` lines of vertices counted from 1, or from the
end, -1 the last.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePath

import numpy as np

from identification.arrays import Array, ByValue
from identification.errors import InputError
from identification.files.io import PathLike, read_bytes
from identification.kinematics.frames import pose, rotation_to_z
from identification.workspace import brick, revolved


def _stl(content: bytes) -> Array:
    record, header = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]), 84
    count = int.from_bytes(content[header - 4 : header], "little")
    if len(content) == header + count * record.itemsize or not content.lstrip().startswith(b"solid"):
        return np.frombuffer(content, record, count, header)["corners"].astype(float)  # ValueError: cut off
    numbers = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
    return np.array(numbers, dtype=float).reshape(-1, 3, 3)


def _obj(content: bytes) -> Array:
    places = np.array(re.findall(rb"^\s*v\s+(\S+)\s+(\S+)\s+(\S+)", content, re.MULTILINE), dtype=float).reshape(-1, 3)
    triangles = []
    seen = 0  # vertices before the face
    for line in re.findall(rb"^\s*(v\s|f\s.*)", content.replace(b"\\\n", b" "), re.MULTILINE):
        if line.startswith(b"v"):
            seen += 1
        else:
            corners = [int(word.partition(b"/")[0]) for word in line.split()[1:]]
            corners = [corner - 1 if corner > 0 else seen + corner for corner in corners]
            if min(corners) < 0:
                raise IndexError
            triangles += [(corners[0], *pair) for pair in pairwise(corners[1:])]
    return places[np.array(triangles, dtype=int).reshape(-1, 3)]


READERS: dict[str, Callable[[bytes], Array]] = {".stl": _stl, ".obj": _obj}


def read_mesh(path: PathLike) -> Array:
    """(t, 3, 3) corners of the triangles of a file, in its unit.

    Raises `InputError` for a file that is missing, unreadable, of another type, damaged or without triangles.
    """
    if (suffix := PurePath(path).suffix.lower()) not in READERS:
        raise InputError(f"{path}: a mesh of type {suffix or 'unknown'}, allowed: {', '.join(READERS)}")
    allowed = f"allowed: a whole {suffix[1:].upper()} file"
    try:
        triangles = READERS[suffix](read_bytes(path))
    except (ValueError, IndexError):
        raise InputError(f"{path}: a damaged mesh, {allowed}") from None
    if not len(triangles):
        raise InputError(f"{path}: a mesh without triangles, {allowed}")
    if not np.all(np.isfinite(triangles)):
        raise InputError(f"{path}: a mesh with corners that are no finite numbers, {allowed}")
    return triangles


@dataclass(frozen=True, eq=False)
class Shape(ByValue):
    """Of a body that is read from a file.

    kind : box, sphere, cylinder, capsule or mesh
    place : (4, 4) [mm] pose of its center, of a mesh of its origin, in the frame of the joint; z is the axis of a
        cylinder or capsule
    size : [mm] edges (3) of a box, radius (1) of a sphere, radius and length (2) between the centers of the ends of a
        cylinder or capsule, of a mesh the millimetres (3) of its unit
    file : of a mesh
    """

    kind: str
    place: Array
    size: Array
    file: str = ""

    @classmethod
    def between(cls, kind: str, start: Sequence[float], end: Sequence[float], radius: float) -> Shape:
        """A sphere, cylinder or capsule of two ends (3,) or (2,), in the plane z = 0 of a planar arm."""
        a, b = (np.r_[point, 0.0][:3] for point in (start, end))
        length = float(np.linalg.norm(b - a))
        place = pose(0.5 * (a + b), rotation_to_z((b - a) / length) if length else None)
        return cls(kind, place, np.array([radius, length]))

    @property
    def capsule(self) -> Array:
        """(7,) of a sphere or capsule."""
        half = self.place[:3, 2] * 0.5 * self.size[1:].sum()
        return np.r_[self.place[:3, 3] - half, self.place[:3, 3] + half, self.size[0]]

    def triangles(self) -> Array:
        """(t, 3, 3) [mm] of the surface in its own frame, of a cylinder that of a prism around it; of what a capsule
        is exactly, none. Raises `InputError` for a mesh that cannot be read."""
        if self.kind == "mesh":
            return read_mesh(self.file) * self.size
        if self.kind == "box":
            return brick(0.5 * self.size)
        if self.kind == "cylinder":
            sides, (radius, length) = 32, self.size
            across, half = radius / np.cos(np.pi / sides), 0.5 * length
            return revolved(across * np.array([0.0, 1.0, 1.0, 0.0]), half * np.array([1.0, 1.0, -1.0, -1.0]), sides)
        return np.empty((0, 3, 3))
