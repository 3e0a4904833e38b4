"""Bodies of the arm and its cell: shapes of an arm file and of a URDF file -> `Body`.

Shapes are read and covered by capsules and boxes when the bodies are first asked for: most commands never do. A mesh is
read from the folder of the arm file or below, from the package of its URDF file, or from folders that the user names,
and from nowhere else, by no link either.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from identification.arrays import SHOWN, ByValue
from identification.errors import InputError
from identification.files.io import PathLike, decode, read_bytes
from identification.files.meshes import READERS, Shape
from identification.files.urdf import parse_urdf, xml_root
from identification.workspace import Body

PACKAGE = re.compile(r"(?:package|model)://([^/]+)/(.+)")


def covered(name: str, joint: int, shapes: Sequence[Shape], reach: float, foot: bool = False) -> Body:
    """The body of its shapes, covered: by capsules if it moves, by boxes if it stands still.

    reach : [mm] of the arm;  foot : it is the arm's own, for which capsules do as well in half the time, if it is no
        plate. Raises `InputError` for a mesh that cannot be read, or whose unit must be another
    """
    from identification.cover import boxes_around, capsules_around

    triangles = [shape.triangles() for shape in shapes]
    for shape, own in zip(shapes, triangles, strict=True):
        long = float(np.ptp(own, axis=(0, 1)).max()) if shape.kind == "mesh" else reach
        if not 1e-3 * reach < long < 20.0 * reach:
            unit = "millimetres as metres" if long > reach else "metres as millimetres"
            state = f"body {name} is {long:.4g} mm long beside an arm that reaches {reach:.4g} mm, like {unit}"
            raise InputError(f"{shape.file}: {state}, allowed: another unit or scale")
    drawn = [own @ s.place[:3, :3].T + s.place[:3, 3] for s, own in zip(shapes, triangles, strict=True)]
    capsules = np.reshape([shape.capsule for shape in shapes if shape.kind in ("sphere", "capsule")], (-1, 7))
    rest, boxes = [k for k, own in enumerate(triangles) if len(own)], np.empty((0, 15))
    if rest:
        solid = np.concatenate([drawn[k] for k in rest])
        size = np.ptp(solid, axis=(0, 1))
        if joint or (foot and size.min() > 0.3 * size.max()):
            capsules = np.concatenate([capsules, capsules_around(solid)])
        else:
            boxes = np.concatenate([boxes_around(triangles[k], shapes[k].place) for k in rest])
    return Body(name, joint, capsules, boxes, np.concatenate(drawn))


@dataclass(frozen=True, eq=False)
class ShapedBodies(ByValue, Sequence[Body]):
    """The bodies of an arm file and of its URDF file, which are read when they are first asked for.

    given : of the arm file, the body, the joint that it moves with and its shape; those of one name are one body
    urdf : text of the URDF file, "": it has none, or they are not wanted;  path : its name
    ends : links at base and tip
    folders : that meshes may be read from, that of the URDF file first
    reach : [mm] of the arm
    """

    given: tuple[tuple[str, int, Shape], ...]
    urdf: str
    path: str
    ends: tuple[str, str]
    folders: tuple[str, ...]
    reach: float

    @cached_property
    def _bodies(self) -> tuple[Body, ...]:
        drawn, _ = self._of_urdf
        for name in {name for name, _, _ in drawn} & {name for name, _, _ in self.given}:
            raise InputError(f"cell.bodies: the name {name!r} is that of a link of {self.path}, allowed: another name")
        parts = dict[tuple[str, int], list[Shape]]()
        for name, joint, shape in (*drawn, *self.given):
            parts.setdefault((name, joint), []).append(shape)
        return tuple(covered(*key, shapes, self.reach, key[0] == self.ends[0]) for key, shapes in parts.items())

    def __len__(self) -> int:
        return len(self._bodies)

    def __getitem__(self, index: Any) -> Any:
        return self._bodies[index]

    @property
    def unseen(self) -> tuple[str, ...]:
        """Links whose meshes are not found."""
        return self._of_urdf[1]

    @cached_property
    def _of_urdf(self) -> tuple[list[tuple[str, int, Shape]], tuple[str, ...]]:
        if not self.urdf:
            return [], ()
        urdf, shapes, missing, loose = parse_urdf(self.urdf, self.path), [], dict[str, str](), dict[str, None]()
        for link, (joint, place, aside) in urdf.links_on(*self.ends).items():
            for shape in urdf.collisions(link):
                file = mesh_file(shape.file, self.folders) if shape.kind == "mesh" else ""
                if file is None:
                    missing[link] = shape.file
                    continue
                shapes.append((link, joint, replace(shape, place=place @ shape.place, file=str(file))))
                loose |= {link: None} if aside else {}
        if missing:
            links = ", ".join(missing) if len(missing) <= SHOWN else f"{len(missing)} links"
            state = f"meshes of {links} are not found ({next(iter(missing.values()))}): collisions are not looked at"
            ways = "beside the arm file or below, or in a folder of --package-dir"
            types = f"{' or '.join(READERS)} files of the same name, "
            warnings.warn(f"{self.path}: {state}, allowed: {types}{ways}", UserWarning, stacklevel=2)
        if loose:
            drawn = "drawn where joints that are not the arm's stand at zero"
            warnings.warn(f"{self.path}: {', '.join(loose)}: {drawn}", UserWarning, stacklevel=2)
        return shapes, tuple(missing)


def mesh_file(name: str, folders: Sequence[PathLike]) -> Path | None:
    """The file that a URDF file names, or one of the same name that can be read; None: in none of the folders.

    folders : in which it may be, that of the URDF file first; the package that this is in (`package.xml`) is another
    """
    beside, words = Path(folders[0]), PACKAGE.fullmatch(name)
    package = next((above for above in (beside / "x").resolve().parents if (above / "package.xml").is_file()), None)
    roots = [*map(Path, folders), *([] if package is None else [package])]
    places = [] if words else [(root, beside / name.removeprefix("file://")) for root in roots]
    inside = [name_beside(name), words[2] if words else None]
    places += [(root, root / each) for each in inside if each is not None for root in roots]
    for root, path in places:
        readable = path.suffix.lower() in READERS
        for file in [path] if readable else map(path.with_suffix, READERS):
            if Path(os.path.realpath(file)).is_relative_to(os.path.realpath(root)) and file.is_file():
                return file
    return None


def name_beside(name: str) -> str | None:
    """Under which a mesh that a URDF file names so is found beside a copy of it; None: under none."""
    words = PACKAGE.fullmatch(name)
    inner = "/".join(words.groups()) if words else re.sub(r"^(\.\.?/+)+", "", name)
    absolute = inner.startswith(("/", "file:")) or ".." in inner.split("/")
    return None if absolute else inner


def pairs_apart(path: PathLike) -> frozenset[frozenset[str]]:
    """Pairs of links that a SRDF file disables collisions of. Raises `InputError` for what is no such file."""
    root = xml_root(decode(path, read_bytes(path)), path, "an SRDF file")
    pairs = [(each.get("link1"), each.get("link2")) for each in root.iter("disable_collisions")]
    if root.tag != "robot" or any(None in pair for pair in pairs):
        raise InputError(f"{path}: found <{root.tag}>, allowed: an SRDF file, <robot> with pairs of link1 and link2")
    return frozenset(frozenset(map(str, pair)) for pair in pairs)
