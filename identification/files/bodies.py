"""Bodies of the arm and its cell: shapes of an arm file and of a URDF file -> `Body`.

Shapes are read and covered by capsules and boxes when the bodies are first asked for: most commands never do. A mesh is
read from the folder of the arm file or below, from the package of its URDF file, or from folders that the user names,
and from nowhere else, by no link either; nothing that it names, materials and textures, is read.

STL (3D Systems, 1989): binary with a header of 80 bytes, a count, and 50 bytes a triangle, or text with `vertex x y z`
lines, three a triangle. OBJ (Wavefront): `v x y z` lines and `f a b c ..` lines of vertices counted from 1, or from the
end, -1 the last.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from identification.arrays import SHOWN, Array, ByValue
from identification.errors import InputError, require
from identification.files.io import PathLike, decode, read_bytes
from identification.files.urdf import METER, Urdf, xml_root
from identification.kinematics.frames import pose, rotation_to_z
from identification.workspace import CUBE, Body, Z, hull, ring, rounded

SIZES = {  # of a `<collision>` -> how many numbers each has
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
    "mesh": {"scale": 3},
}
ROUND = ("sphere", "capsule")  # what a capsule is exactly
PACKAGE = re.compile(r"(?:package|model)://([^/]+)/(.+)")


def _stl(content: bytes) -> Array:
    record, header = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]), 84
    count = int.from_bytes(content[header - 4 : header], "little")
    if len(content) == header + count * record.itemsize or not content.lstrip().startswith(b"solid"):
        return np.frombuffer(content, record, count, header)["corners"].astype(float)  # ValueError: cut off
    return np.array(re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", content), dtype=float).reshape(-1, 3, 3)


def _obj(content: bytes) -> Array:
    places = np.array(re.findall(rb"^\s*v\s+(\S+)\s+(\S+)\s+(\S+)", content, re.MULTILINE), dtype=float).reshape(-1, 3)
    triangles, seen = [], 0  # vertices before the face
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
    """(t, 3, 3) corners of the triangles of a file, in its unit. Raises `InputError` for a file that is missing,
    unreadable, of another type, damaged or without triangles."""
    if (suffix := PurePath(path).suffix.lower()) not in READERS:
        raise InputError(f"{path}: a mesh of type {suffix or 'unknown'}, allowed: {', '.join(READERS)}")
    allowed = f"allowed: a whole {suffix[1:].upper()} file"
    try:
        triangles = READERS[suffix](read_bytes(path))
    except (ValueError, IndexError):
        raise InputError(f"{path}: a damaged mesh, {allowed}") from None
    require(len(triangles), f"{path}: a mesh without triangles, {allowed}")
    require(np.all(np.isfinite(triangles)), f"{path}: a mesh with corners that are not finite numbers, {allowed}")
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
        """(t, 3, 3) [mm] of the surface in its own frame, if it is not round, of a cylinder that of a prism around it.
        Raises `InputError` for a mesh that cannot be read."""
        if self.kind == "mesh":
            return read_mesh(self.file) * self.size
        if self.kind == "box":
            return hull(0.5 * self.size * CUBE)
        rim, up = self.size[0] / np.cos(np.pi / 48) * ring(Z), 0.5 * self.size[1] * Z  # 48 sides
        return hull(np.concatenate([rim + up, rim - up]))


def collisions(urdf: Urdf, link: str) -> list[Shape]:
    """The `<collision>` elements of a link, in its frame, with the names of files as they are written."""
    solids, where = [], f"link {link!r}: collision"
    for element in urdf.links[link].findall("collision"):
        shapes, sizes = element.findall("geometry/*"), []
        found = " and ".join(f"<{shape.tag}>" for shape in shapes) or "nothing"
        known = [shape.tag in SIZES for shape in shapes] == [True]
        require(known, f"{urdf.path}: {where} of {found}, allowed: one of {', '.join(SIZES)}")
        shape, file = shapes[0], shapes[0].get("filename", "")
        for key, count in SIZES[shape.tag].items():
            sizes.append(urdf.numbers(shape, where, key, (1.0, 1.0, 1.0) if key == "scale" else None, count))
            right = np.all(sizes[-1] if key == "scale" else sizes[-1] > 0.0)
            require(right, f"{urdf.path}: {where} {key} has {shape.get(key)!r}, allowed: {count} numbers > 0")
        nameless = shape.tag == "mesh" and not file
        require(not nameless, f"{urdf.path}: {where} of a mesh without filename, allowed: the name of a file")
        solids.append(Shape(shape.tag, urdf.origin(element, where), np.concatenate(sizes) * METER, file))
    return solids


# -- read and covered, when they are first asked for -------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class ShapedBodies(ByValue, Sequence[Body]):
    """The bodies of an arm file and of its URDF file, which are read when they are first asked for.

    given : of the arm file, the body, the joint that it moves with and its shape; those of one name are one body
    urdf : the URDF file, None: it has none, or they are not wanted
    ends : links at base and tip
    folders : that meshes may be read from, that of the URDF file first
    reach : [mm] of the arm
    """

    given: tuple[tuple[str, int, Shape], ...]
    urdf: Urdf | None
    ends: tuple[str, str]
    folders: tuple[str, ...]
    reach: float

    def __len__(self) -> int:
        return len(self._read[0])

    def __getitem__(self, index: Any) -> Any:
        return self._read[0][index]

    unseen = property(lambda self: self._read[1])  # links whose meshes are not found

    @cached_property
    def _read(self) -> tuple[list[Body], tuple[str, ...]]:
        """Bodies, by capsules if they move, by boxes if they stand still; capsules do as well in half the time for an
        arm's foot that is no plate. Raises `InputError` for a mesh that cannot be read, or whose unit must be another.
        """
        from identification.cover import boxes_around, capsules_around

        parts, missing = dict[tuple[str, int], list[Shape]](), dict[str, str]()
        if (urdf := self.urdf) is not None:
            links = urdf.links_on(*self.ends)
            for link, (joint, place, _) in links.items():
                for shape in collisions(urdf, link):
                    file = mesh_file(shape.file, self.folders) if shape.kind == "mesh" else ""
                    if file is None:
                        missing[link] = shape.file
                    else:
                        placed = replace(shape, place=place @ shape.place, file=str(file))
                        parts.setdefault((link, joint), []).append(placed)
            if missing:
                names = ", ".join(missing) if len(missing) <= SHOWN else f"{len(missing)} links"
                state = f"meshes of {names} are not found ({next(iter(missing.values()))}): collisions are not checked"
                ways = "beside the arm file or below, or in a folder of --package-dir"
                types = f"{' or '.join(READERS)} files of the same name, "
                warnings.warn(f"{urdf.path}: {state}, allowed: {types}{ways}", UserWarning, stacklevel=2)
            if loose := [name for name, _ in parts if links[name][2]]:
                state = "placed with the joints outside the arm's chain at zero"
                warnings.warn(f"{urdf.path}: {', '.join(loose)}: {state}", UserWarning, stacklevel=2)
            for name in {name for name, _ in parts} & {name for name, _, _ in self.given}:
                taken = f"the name {name!r} is that of a link of {urdf.path}"
                raise InputError(f"cell.bodies: {taken}, allowed: another name")
        for name, joint, shape in self.given:
            parts.setdefault((name, joint), []).append(shape)
        bodies = list[Body]()
        for (name, joint), shapes in parts.items():
            capsules, boxes = [shape.capsule for shape in shapes if shape.kind in ROUND], list[Array]()
            drawn = [*map(rounded, capsules)]
            solids = [(shape, shape.triangles()) for shape in shapes if shape.kind not in ROUND]
            for shape, own in solids:
                long = float(np.ptp(own, axis=(0, 1)).max())
                if shape.kind == "mesh" and not 1e-3 * self.reach < long < 20.0 * self.reach:
                    unit = "millimetres as metres" if long > self.reach else "metres as millimetres"
                    state = f"{long:.4g} mm long beside an arm that reaches {self.reach:.4g} mm, like {unit}"
                    raise InputError(f"{shape.file}: body {name} is {state}, allowed: another unit or scale")
                if shape.kind == "mesh" and long < 0.02 * self.reach and np.all(np.abs(shape.size) < METER):
                    # a thousand times as long it would be a body, too
                    state = f"{shape.file}: body {name} is {long:.4g} mm long; if its numbers are metres, write"
                    warnings.warn(f'{state} unit = "m", in a URDF file scale="1 1 1"', UserWarning, stacklevel=2)
            if solids:
                drawn.append(np.concatenate([own @ s.place[:3, :3].T + s.place[:3, 3] for s, own in solids]))
                size = np.ptp(drawn[-1], axis=(0, 1))
                if joint or (name == self.ends[0] and size.min() > 0.3 * size.max()):
                    capsules += [*capsules_around(drawn[-1])]
                else:
                    boxes += [box for s, own in solids for box in boxes_around(own, s.place)]
            bodies.append(Body(name, joint, np.array(capsules), np.array(boxes), np.concatenate(drawn)))
        return bodies, tuple(missing)


def mesh_file(name: str, folders: Sequence[PathLike]) -> Path | None:
    """The file that a URDF file names, or one of the same name that can be read; None: in none of the folders;
    folders : in which it may be, that of the URDF file first, whose package (`package.xml`) is another"""
    beside, words = Path(folders[0]), PACKAGE.fullmatch(name)
    package = next((above for above in (beside / "x").resolve().parents if (above / "package.xml").is_file()), beside)
    roots, places = [*map(Path, folders), package], [] if words else [beside / name.removeprefix("file://")]
    places += [root / each for each in (name_beside(name), words and words[2]) if each for root in roots]
    for path in places:
        for file in [path] if path.suffix.lower() in READERS else map(path.with_suffix, READERS):
            inside = map(Path(os.path.realpath(file)).is_relative_to, map(os.path.realpath, roots))
            if any(inside) and os.path.isfile(file):
                return file
    return None


def name_beside(name: str) -> str | None:
    """Under which a mesh that a URDF file names so is found beside a copy of it; None: under none."""
    words = PACKAGE.fullmatch(name)
    inner = "/".join(words.groups()) if words else re.sub(r"^(\.\.?/+)+", "", name)
    return None if inner.startswith(("/", "file:")) or ".." in inner.split("/") else inner


def pairs_apart(path: PathLike) -> frozenset[frozenset[str]]:
    """Pairs of links that a SRDF file disables collisions of. Raises `InputError` for what is no such file."""
    root = xml_root(decode(path, read_bytes(path)), path, "an SRDF file")
    pairs = [(each.get("link1"), each.get("link2")) for each in root.iter("disable_collisions")]
    if root.tag != "robot" or any(None in pair for pair in pairs):
        raise InputError(f"{path}: found <{root.tag}>, allowed: an SRDF file, <robot> with pairs of link1 and link2")
    return frozenset(frozenset(map(str, pair)) for pair in pairs)
