"""Bodies of arm files and of URDF files: where they are, what is read, and from where nothing is."""

import pickle
import re
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Array, InputError, load_arm
from identification.files.bodies import mesh_file, read_mesh
from identification.workspace import Body
from tests.identification.files.test_arm import CELL, DATA, PLAIN, PLANAR_CELL
from tests.refusals import refused

TREE = (DATA / "arms/tree.urdf").read_text()
MESH = '<mesh filename="NAME"/>'
ARM = 'kind = "spatial"\nurdf = "r.urdf"\nbase_link = "base"\ntip_link = "tip"\n'


def arm_of(folder: Path, mesh: str = "<sphere radius='0.001'/>", text: str = ARM) -> Arm:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.urdf").write_text(TREE.replace("MESH", mesh))
    (folder / "arm.toml").write_text(text)
    return load_arm(folder / "arm.toml")


def said_of(arm: Arm) -> tuple[dict[str, Body], list[str]]:
    """Bodies by name, and what is warned of while they are read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = {body.name: body for body in arm.cell.bodies}
    return found, [str(warning.message) for warning in caught]


def bodies(arm: Arm) -> dict[str, Body]:
    return said_of(arm)[0]


# -- URDF --------------------------------------------------------------------------------------------------------------
def test_links_are_where_their_joints_put_them(tmp_path: Path) -> None:
    """Places by hand: the base stands at (0, 1, 0) of the table, turned by 90 degrees; the tip hangs at (0.4, 0, 0.1)
    of the moving link, turned by 90 degrees, and the finger there, too, its joint at zero."""
    found, said = said_of(arm_of(tmp_path))
    assert said == [f"{tmp_path / 'r.urdf'}: finger: placed with the joints outside the arm's chain at zero"]
    joints = {name: body.joint for name, body in found.items()}
    assert joints == {"table": 0, **dict.fromkeys(("upper", "bracket", "tip", "finger", "part"), 1)}
    table = found["table"].boxes
    # the middle of the table is (0, -1, -0.1) from the base, seen along axes that are turned by 90 degrees
    np.testing.assert_allclose(table[:, :3], [[-1000.0, 0.0, -100.0]], atol=1e-9)
    np.testing.assert_allclose(table[0, 3:12].reshape(3, 3), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(table[0, 12:], [500.0, 1000.0, 100.0], atol=1e-9)
    for name, capsule in (
        ("bracket", [0, 0, 100, 0, 0, 100, 10]),
        ("tip", [400, 0, 50, 400, 0, 150, 20]),
        ("finger", [400, 0, 100, 400, 0, 100, 10]),
    ):
        np.testing.assert_allclose(found[name].capsules, [capsule], atol=1e-9)


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Meshes are not covered, which takes longer than all else."""
    monkeypatch.setattr("identification.cover.capsules_around", lambda _: np.empty((0, 7)))


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize("scale", ["", ' scale="100 100 -50"'])
def test_meshes_in_metres(tmp_path: Path, scale: str) -> None:
    (tmp_path / "part.stl").write_bytes(binary(FACES * (0.1 if not scale else 1e-3)))
    drawn = bodies(arm_of(tmp_path, MESH.replace("NAME", "part.stl").replace("/>", f"{scale}/>")))["part"]
    factor = np.array([100.0, 100.0, -50.0] if scale else [100.0, 100.0, 100.0])
    np.testing.assert_allclose(drawn.triangles, FACES * factor, rtol=1e-6)


PLACES = {  # what the URDF file names -> where the file is, beside the URDF file in work/cell
    "part.stl": "work/cell/part.stl",
    "meshes/part.stl": "work/cell/meshes/part.stl",
    "../meshes/part.stl": "work/meshes/part.stl",  # of its package
    "package://robot/meshes/part.stl": "work/cell/robot/meshes/part.stl",
    "package://robot/part.stl": "work/cell/part.stl",
    "package://work/meshes/part.stl": "work/meshes/part.stl",
    "package://named/meshes/part.stl": "work/meshes/part.stl",
    "package://robot/x/part.stl": "given/robot/x/part.stl",
    "model://robot/x/part.stl": "given/x/part.stl",
}
OUTSIDE = {
    "package://other/part.stl": "other/part.stl",
    "../../other/part.stl": "other/part.stl",
    "package://robot/../../other/part.stl": "other/part.stl",
    "/ABSOLUTE/other/part.stl": "other/part.stl",
    "file:///ABSOLUTE/other/part.stl": "other/part.stl",
    "part.dae": "work/cell/part.dae",
    "package://robot": "work/cell/robot",
    f"{'a' * 300}.stl": "other/part.stl",
}


def mesh_found(tmp_path: Path, name: str, place: str) -> Path | None:
    """The file that a URDF file in `work/cell` means by a name, where there is one in the place."""
    for folder in ("work/cell", "given", Path(place).parent):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_bytes(binary(0.1 * FACES))
    (tmp_path / "work/package.xml").write_text("<package><name>named</name></package>")
    return mesh_file(name.replace("/ABSOLUTE", str(tmp_path)), [tmp_path / "work/cell", tmp_path / "given"])


@pytest.mark.parametrize(("name", "place"), (PLACES | OUTSIDE).items())
def test_meshes_are_found_in_the_given_folders_and_nowhere_else(tmp_path: Path, name: str, place: str) -> None:
    found = mesh_found(tmp_path, name, place)
    assert found is None if name in OUTSIDE else found.samefile(tmp_path / place)


def test_a_link_does_not_lead_out(tmp_path: Path) -> None:
    """The mesh is not read, and a warning says so."""
    assert mesh_found(tmp_path, "part.stl", "other/part.stl") is None
    (tmp_path / "work/cell/part.stl").symlink_to(tmp_path / "other/part.stl")
    found, (said, _) = said_of(arm_of(tmp_path / "work/cell", MESH.replace("NAME", "part.stl")))
    assert re.search(r"r.urdf: meshes of part are not found \(.*\): collisions are not checked, allowed: ", said)
    assert {"part", "upper"} & {*found} == {"upper"}


@pytest.mark.parametrize(
    ("mesh", "said"),
    [
        (MESH.replace("NAME", "part.stl"), "part.stl: body part is 2e+06 mm long .* like millimetres as metres"),
        ('<mesh filename="part.stl" scale="1e-9 1e-9 1e-9"/>', "like metres as millimetres"),
        ('<mesh filename="part.stl" scale="1 1"/>', "link 'part': collision scale has '1 1', allowed: 3 numbers"),
        ("<mesh/>", "link 'part': collision of a mesh without filename"),
        ("<box size='1 1 0'/>", "link 'part': collision size has '1 1 0', allowed: 3 numbers > 0"),
        ("<sphere radius='big'/>", "link 'part': collision radius has 'big'"),
        ("<cylinder radius='1'/>", "link 'part': collision length has None"),
        ("<cone/>", "link 'part': collision of <cone>, allowed: one of box, sphere, cylinder, capsule, mesh"),
        ("", "link 'part': collision of nothing"),
    ],
)
def test_bad_collisions_get_one_line_when_they_are_asked_for(tmp_path: Path, mesh: str, said: str) -> None:
    (tmp_path / "part.stl").write_bytes(binary(1000.0 * FACES))
    refused(bodies, arm_of(tmp_path, mesh), names=said.split(".*"))


def test_bodies_of_the_urdf_file_can_be_left_out(tmp_path: Path) -> None:
    cell = arm_of(tmp_path, text=f"{ARM}[cell]\nbodies_of_urdf = false\nfloor_z_mm = -500.0\n").cell
    assert (len(cell.bodies), cell.floor, cell.clearance) == (0, -500.0, 20.0)


def test_srdf(tmp_path: Path) -> None:
    (tmp_path / "r.srdf").write_text('<robot><disable_collisions link1="a" link2="b" reason="Never"/></robot>')
    arm = arm_of(tmp_path, text=f'{ARM}[cell]\nsrdf = "r.srdf"\n')
    # and what joints connect, the table and the link by way of the base, which has no body
    neighbours = ["upper bracket", "bracket tip", "tip finger", "upper part", "table upper"]
    assert arm.cell.apart == {frozenset("ab"), *(frozenset(pair.split()) for pair in neighbours)}
    (tmp_path / "r.srdf").write_text('<robot><disable_collisions link1="a"/></robot>')
    with pytest.raises(InputError, match=r"r.srdf: found <robot>, allowed: an SRDF file"):
        load_arm(tmp_path / "arm.toml")


# -- arm files ---------------------------------------------------------------------------------------------------------
WIDE = f"link_width_mm = 40.0\n{PLAIN}"


def loaded(tmp_path: Path, text: str) -> Arm:
    (tmp_path / "arm.toml").write_text(text)
    return load_arm(tmp_path / "arm.toml")


def test_pairs_that_are_not_looked_at(tmp_path: Path) -> None:
    """Links beside each other, and what the file says."""
    arm = loaded(tmp_path, f'{WIDE}[cell]\napart = [["link 1", "floor"]]\n')
    assert arm.cell.apart == {frozenset(("link 1", "link 2")), frozenset(("link 1", "floor"))}


def test_bodies_of_a_planar_arm(tmp_path: Path) -> None:
    found = bodies(arm := loaded(tmp_path, WIDE + PLANAR_CELL))
    assert arm.cell.clearance == 5.0
    assert {name: body.joint for name, body in found.items()} == {"link 1": 1, "link 2": 2, "wall": 0, "tool": 2}
    np.testing.assert_allclose(found["link 1"].capsules, [[0, 0, 0, 260, 0, 0, 20]], atol=1e-12)
    tool = [[180, 0, 0, 200, 10, 0, 8], [210, 0, 0, 210, 0, 0, 9]]
    np.testing.assert_allclose(found["tool"].capsules, tool, atol=1e-12)
    (wall,) = found["wall"].boxes
    seen = [*wall[:3], *wall[3:12].reshape(3, 3)[:2, 0], *wall[12:14]]
    np.testing.assert_allclose(seen, [400, 0, 0, np.cos(np.pi / 6), 0.5, 10, 150], atol=1e-9)


def test_every_part_of_a_body_is_drawn(tmp_path: Path) -> None:
    """A box around the joint, and a ball beside it, of which no point is farther than 130 mm."""
    part = '[[cell.bodies]]\nname = "tool"\njoint = 2\n'
    parts = 'kind = "box"\nsize_mm = [40.0, 40.0]\n', 'kind = "sphere"\ncenter_mm = [100.0, 0.0]\nradius_mm = 30.0\n'
    corners = bodies(loaded(tmp_path, PLAIN + "".join(part + each for each in parts)))["tool"].looks()
    np.testing.assert_allclose([corners.min(axis=(0, 1))[0], corners.max(axis=(0, 1))[0]], [-20.0, 130.0], atol=0.3)


def test_bodies_of_an_arm_in_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they are; and an arm with bodies travels to other processes, whose meshes are read when they are asked for,
    not by commands that do not ask."""
    (tmp_path / "part.stl").write_bytes(binary(0.1 * FACES))
    with monkeypatch.context() as patch:
        patch.setattr("identification.files.bodies.read_mesh", pytest.fail)
        arm = arm_of(tmp_path, text=ARM + CELL)
        again = pickle.loads(pickle.dumps(arm))
    assert (again, hash(again)) == (arm, hash(arm))
    pieces = bodies(arm)
    np.testing.assert_allclose(pieces["holder"].triangles[0], [[50, 0, 0], [50, 100, 0], [-100, 0, 0]], atol=1e-4)
    assert (pieces["cylinder 1"].joint, len(pieces["cylinder 1"].boxes) > 1) == (0, True)
    (tmp_path / "part.stl").write_bytes(binary(2.0 * FACES))  # of a table in metres
    for unit, large in ((CELL, True), (CELL.replace('unit = "m"\n', ""), False)):
        (said,) = said_of(arm_of(tmp_path, text=ARM + unit))[1][1:] or [""]
        assert ("part.stl: body holder is 4 mm long; if its numbers are metres" in said) is not large
    arm = arm_of(tmp_path, text=ARM + CELL.replace('"holder"', '"upper"'))
    with pytest.raises(InputError, match=r"cell.bodies: the name 'upper' is that of a link of .*r.urdf"):
        bodies(arm)


ROW = 'kind = "spatial"\n[[dh]]\na_mm = 1.0\nalpha_deg = 0.0\nd_mm = 0.0\n'


@pytest.mark.parametrize(
    ("head", "cell", "old", "new", "said"),
    [
        *(
            (PLAIN, PLANAR_CELL, *each)
            for each in (
                ('"tool"\njoint = 2', '"tool"\njoint = 1', "cell.bodies[3].joint: found 2 for another part of 'tool'"),
                ('"box"', '"cone"', "cell.bodies[1].kind: found 'cone' for a planar arm"),
                ('"box"', '"cylinder"', "cell.bodies[1].kind: found 'cylinder' for a planar arm"),
                ("[cell]\n", "[cell]\nfloor_z_mm = 0.0\n", "cell.floor_z_mm: found in the file of a planar arm"),
            )
        ),
        *(
            (ARM, CELL, *each)
            for each in (
                ('"part.stl"', '"../part.stl"', "cell.bodies[2].file: '../part.stl' is outside the folder"),
                ("[cell]\n", '[cell]\nsrdf = "/etc/passwd"\n', "cell.srdf: '/etc/passwd' is outside the folder"),
                ("100.0]", "0.0]", "cell.bodies[1].end_mm: found [0.0, 0.0, 0.0], allowed: another point"),
                ('"m"', '"inch"', "cell.bodies[2].unit: found 'inch'"),
                ('[["wall"', '[["wal"', "cell.apart: unknown body 'wal', did you mean 'wall'?"),
            )
        ),
        (ROW, '[cell]\nsrdf = "r.srdf"\n', "", "", "cell.srdf: found without urdf, allowed: with urdf"),
    ],
)
def test_bad_tables_get_one_line(tmp_path: Path, head: str, cell: str, old: str, new: str, said: str) -> None:
    assert old in cell
    refused(lambda: arm_of(tmp_path, text=head + cell.replace(old, new, 1)), names=[said])


# -- meshes ------------------------------------------------------------------------------------------------------------
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
        ("part.stl", text(FACES).replace(b"1.5", b"nan"), "not finite numbers"),
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
    refused(read_mesh, tmp_path / name, names=[f"{tmp_path / name}: ", said])
