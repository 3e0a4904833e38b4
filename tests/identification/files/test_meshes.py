"""Meshes: STL and OBJ files in every form, and what is none in one line."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from identification import Array, InputError
from identification.files.meshes import read_mesh

FACES = np.array([[[0, 0, 0], [1, 0, 0], [0, 1.5, 0]], [[0, 0, 0], [0, 1.5, 0], [0, 0, -2]]], dtype=float)


def binary(faces: Array) -> bytes:
    records = [struct.pack("<12fH", *np.zeros(3), *face.ravel(), 0) for face in faces]
    return b"solid made by a program that begins so".ljust(80) + struct.pack("<I", len(faces)) + b"".join(records)


def text(faces: Array) -> bytes:
    facets = [
        "facet normal 0 0 1\n outer loop\n"
        + "".join(f"  vertex {x:e} {y:g} {z:g}\n" for x, y, z in face)
        + " endloop\nendfacet\n"
        for face in faces
    ]
    return f"solid part\n{''.join(facets)}endsolid part\n".encode()


POINTS = b"# made\nmtllib /etc/passwd\nv 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 0 1.5 0\nv 0 0 -2\nvn 0 0 1\n"
FILES = {
    "binary.stl": binary(FACES),
    "text.STL": text(FACES),
    "faces.obj": POINTS + b"usemtl x\nf 1 2 3\nf 1 3 4\n",
    "numbered.obj": POINTS + b"f 1/1/1 2//1 3/2\nf -4 \\\n-2 -1\n",
}


def test_triangles_are_read(tmp_path: Path) -> None:
    """Faces of more corners are cut from their first one."""
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
        np.testing.assert_array_equal(read_mesh(tmp_path / name), FACES)
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4\n")
    a, b, c = np.moveaxis(read_mesh(tmp_path / "square.obj"), 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).tolist() == [4.0, 4.0]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("part.dae", b"<COLLADA/>", "a mesh of type .dae, allowed: .stl, .obj"),
        ("part", b"solid", "a mesh of type unknown"),
        ("part.stl", b"", "the file is empty"),
        ("none.stl", None, "no such file"),
        ("part.stl", binary(FACES)[:-1], "a mesh without triangles"),  # it begins like a text
        ("part.stl", b"\1" + binary(FACES)[1:-1], "a damaged mesh, allowed: a whole STL file"),
        ("part.stl", b"\1\2", "a damaged mesh"),
        ("part.stl", text(FACES).replace(b"1.5", b"1,5"), "a damaged mesh"),
        ("part.stl", text(FACES).replace(b"1.5", b"nan"), "no finite numbers"),
        ("part.stl", text(FACES).replace(b"  vertex 0", b"  0", 1), "a damaged mesh"),
        ("part.obj", b"v 0 0 0\n", "a mesh without triangles"),
        ("part.obj", POINTS + b"f 1 2 5\n", "a damaged mesh, allowed: a whole OBJ file"),
        ("part.obj", POINTS + b"f 1 2 -5\n", "a damaged mesh"),
        ("part.obj", POINTS + b"f 1 2 0\n", "a damaged mesh"),
        ("part.obj", POINTS + b"f a b c\n", "a damaged mesh"),
    ],
)
def test_what_is_no_mesh_gets_one_line(tmp_path: Path, name: str, content: bytes | None, said: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_mesh(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
