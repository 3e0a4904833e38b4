"""Bodies of arm files and of URDF files: where they are, what is read, and from where nothing is."""

from __future__ import annotations

import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from identification import Arm, InputError, load_arm, with_effects
from identification.bodies import Body, Cell
from identification.files.bodies import mesh_file
from identification.files.urdf import parse_urdf
from tests.identification.files.test_arm import PLAIN
from tests.identification.files.test_meshes import FACES, binary

TREE = """<robot name="r">
<link name="world"/><link name="table"><collision><origin xyz="0 0 -0.1"/><geometry><box size="1 2 0.2"/></geometry>
</collision></link>
<link name="base"/><link name="upper"><collision><origin xyz="0.1 0 0" rpy="0 1.5707963267948966 0"/>
<geometry><cylinder radius="0.05" length="0.2"/></geometry></collision>
<collision><origin xyz="0 0 0"/><geometry><sphere radius="0.05"/></geometry></collision>
<collision><origin xyz="0.2 0 0"/><geometry><sphere radius="0.05"/></geometry></collision></link>
<link name="bracket"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
<link name="tip"><collision><geometry><capsule radius="0.02" length="0.1"/></geometry></collision></link>
<link name="finger"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
<link name="part"><collision><geometry>MESH</geometry></collision></link>
<joint name="a" type="fixed"><parent link="world"/><child link="table"/><origin xyz="0 0 0.5"/></joint>
<joint name="b" type="fixed"><parent link="table"/><child link="base"/>
<origin xyz="0 1 0" rpy="0 0 1.5707963267948966"/></joint>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2"/></joint>
<joint name="c" type="fixed"><parent link="upper"/><child link="bracket"/><origin xyz="0 0 0.1"/></joint>
<joint name="d" type="fixed"><parent link="bracket"/><child link="tip"/>
<origin xyz="0.4 0 0" rpy="0 0 1.5707963267948966"/></joint>
<joint name="grip" type="prismatic"><parent link="tip"/><child link="finger"/><axis xyz="0 2 0"/>
<limit lower="0.02" upper="0.04"/></joint>
<joint name="e" type="fixed"><parent link="upper"/><child link="part"/></joint></robot>"""
MESH = '<mesh filename="NAME"/>'
ARM = 'kind = "spatial"\nurdf = "r.urdf"\nbase_link = "base"\ntip_link = "tip"\n'


def arm_of(folder: Path, mesh: str = "<sphere radius='0.001'/>", text: str = ARM, dirs: tuple[Path, ...] = ()) -> Arm:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.urdf").write_text(TREE.replace("MESH", mesh))
    (folder / "arm.toml").write_text(text)
    return load_arm(folder / "arm.toml", dirs)


def said_of(arm: Arm) -> tuple[dict[str, Body], list[str]]:
    """Bodies by name, and what is warned of while they are read."""
    assert arm.cell is not None
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
    arm = arm_of(tmp_path)
    found, said = said_of(arm)
    assert said == [f"{tmp_path / 'r.urdf'}: finger: drawn where joints that are not the arm's stand at zero"]
    assert {name: body.joint for name, body in found.items()} == {
        "table": 0,
        "upper": 1,
        "bracket": 1,
        "tip": 1,
        "finger": 1,
        "part": 1,
    }
    table = found["table"].boxes
    # the middle of the table is (0, -1, -0.1) from the base, seen along axes that are turned by 90 degrees
    np.testing.assert_allclose(table[:, :3], [[-1000.0, 0.0, -100.0]], atol=1e-9)
    np.testing.assert_allclose(table[0, 3:12].reshape(3, 3), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(table[0, 12:], [500.0, 1000.0, 100.0], atol=1e-9)
    np.testing.assert_allclose(found["bracket"].capsules, [[0, 0, 100, 0, 0, 100, 10]], atol=1e-9)
    np.testing.assert_allclose(found["tip"].capsules, [[400, 0, 50, 400, 0, 150, 20]], atol=1e-9)
    np.testing.assert_allclose(found["finger"].capsules, [[400, 0, 100, 400, 0, 100, 10]], atol=1e-9)


def test_links_are_where_pinocchio_puts_them(tmp_path: Path) -> None:
    """Of bodies that move with the turning joint, and of the table in the world, in which the base stands as above."""
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed: pip install 'armcal[oracle]'")
    text = TREE.replace("MESH", "<box size='1 2 3'/>").replace('xyz="0.2 0 0"', 'xyz="0.2 0.1 0"')
    text = text.replace("<capsule", "<cylinder").replace("<limit", "<limit effort='1' velocity='1'")
    model = pinocchio.buildModelFromXML(text)
    (tmp_path / "r.urdf").write_text(text)
    geometry = pinocchio.buildGeomFromUrdf(model, str(tmp_path / "r.urdf"), pinocchio.GeometryType.COLLISION)
    urdf = parse_urdf(text, "r.urdf")
    places = urdf.links_on("base", "tip")
    base = pinocchio.SE3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, 1.0, 0.5]))
    seen = 0
    for each in geometry.geometryObjects:
        link, number = each.name.rsplit("_", 1)
        if each.parentJoint <= 1:
            joint, place, _ = places[link]
            found = place @ urdf.collisions(link)[int(number)][3]
            expected = (base.inverse() * each.placement if joint == 0 else each.placement).homogeneous
            expected[:3, 3] *= 1000.0
            assert joint == each.parentJoint
            np.testing.assert_allclose(found, expected, atol=1e-9)
            seen += 1
    assert seen == 7


def test_a_cylinder_with_spheres_at_its_ends_is_a_capsule(tmp_path: Path) -> None:
    (capsule,) = bodies(arm_of(tmp_path))["upper"].capsules
    np.testing.assert_allclose(capsule, [0, 0, 0, 200, 0, 0, 50], atol=1e-9)


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
}


def mesh_found(tmp_path: Path, name: str, place: str) -> Path | None:
    """The file that a URDF file in `work/cell` means by a name, where there is one in the place."""
    for folder in ("work/cell", "given", Path(place).parent):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_bytes(binary(0.1 * FACES))
    (tmp_path / "work/package.xml").write_text("<package><name>named</name></package>")
    return mesh_file(name.replace("/ABSOLUTE", str(tmp_path)), [tmp_path / "work/cell", tmp_path / "given"])


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(("name", "place"), PLACES.items())
def test_meshes_are_found_in_the_given_folders(tmp_path: Path, name: str, place: str) -> None:
    found = mesh_found(tmp_path, name, place)
    assert found is not None
    assert found.samefile(tmp_path / place)


@pytest.mark.parametrize(("name", "place"), OUTSIDE.items())
def test_nothing_else_is_read(tmp_path: Path, name: str, place: str) -> None:
    assert mesh_found(tmp_path, name, place) is None


def test_a_link_does_not_lead_out(tmp_path: Path) -> None:
    """The mesh is not read, and a warning says so."""
    assert mesh_found(tmp_path, "part.stl", "other/part.stl") is None
    (tmp_path / "work/cell/part.stl").symlink_to(tmp_path / "other/part.stl")
    found, (said, _) = said_of(arm_of(tmp_path / "work/cell", MESH.replace("NAME", "part.stl")))
    assert re.search(r"r.urdf: meshes of part are not found \(.*\): collisions are not looked at, allowed: ", said)
    assert "part" not in found
    assert "upper" in found


@pytest.mark.parametrize(
    ("mesh", "said"),
    [
        (MESH.replace("NAME", "part.stl"), r"part.stl: body part is 2e\+06 mm long .* like millimetres as metres"),
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
    arm = arm_of(tmp_path, mesh)
    with pytest.raises(InputError, match=said) as caught:
        bodies(arm)
    assert "\n" not in str(caught.value)


def test_bodies_of_the_urdf_file_can_be_left_out(tmp_path: Path) -> None:
    arm = arm_of(tmp_path, text=f"{ARM}[cell]\nbodies_of_urdf = false\nfloor_z_mm = -500.0\n")
    assert arm.cell is not None
    assert not arm.cell.bodies
    assert arm.cell.floor == -500.0
    assert arm.cell.clearance == 20.0


def test_srdf(tmp_path: Path) -> None:
    (tmp_path / "r.srdf").write_text('<robot><disable_collisions link1="a" link2="b" reason="Never"/></robot>')
    arm = arm_of(tmp_path, text=f'{ARM}[cell]\nsrdf = "r.srdf"\n')
    assert arm.cell is not None
    # and what joints connect, the table and the link by way of the base, which has no body
    neighbours = ["upper bracket", "bracket tip", "tip finger", "upper part", "table upper"]
    assert arm.cell.apart == {frozenset("ab"), *(frozenset(pair.split()) for pair in neighbours)}
    (tmp_path / "r.srdf").write_text('<robot><disable_collisions link1="a"/></robot>')
    with pytest.raises(InputError, match=r"r.srdf: found <robot>, allowed: an SRDF file"):
        load_arm(tmp_path / "arm.toml")


# -- arm files ---------------------------------------------------------------------------------------------------------
CELL = """
[cell]
clearance_mm = 5.0

[[cell.bodies]]
kind = "box"
name = "wall"
size_mm = [20.0, 300.0]
x_mm = 400.0
rz_deg = 30.0

[[cell.bodies]]
kind = "capsule"
name = "tool"
joint = 2
start_mm = [180.0, 0.0]
end_mm = [200.0, 10.0]
radius_mm = 8.0

[[cell.bodies]]
kind = "sphere"
name = "tool"
joint = 2
center_mm = [210.0, 0.0]
radius_mm = 9.0
"""


def loaded(tmp_path: Path, text: str) -> Arm:
    (tmp_path / "arm.toml").write_text(text)
    return load_arm(tmp_path / "arm.toml")


def test_pairs_that_are_not_looked_at(tmp_path: Path) -> None:
    """Links beside each other, and what the file says."""
    arm = loaded(tmp_path, f'link_width_mm = 40.0\n{PLAIN}[cell]\napart = [["link 1", "table"]]\n')
    assert arm.cell is not None
    assert arm.cell.apart == {frozenset(("link 1", "link 2")), frozenset(("link 1", "table"))}


def test_bodies_of_a_planar_arm(tmp_path: Path) -> None:
    found = bodies(arm := loaded(tmp_path, f"link_width_mm = 40.0\n{PLAIN}{CELL}"))
    assert arm.cell is not None
    assert arm.cell.clearance == 5.0
    assert {name: body.joint for name, body in found.items()} == {"link 1": 1, "link 2": 2, "wall": 0, "tool": 2}
    np.testing.assert_allclose(found["link 1"].capsules, [[0, 0, 0, 260, 0, 0, 20]], atol=1e-12)
    np.testing.assert_allclose(
        found["tool"].capsules, [[180, 0, 0, 200, 10, 0, 8], [210, 0, 0, 210, 0, 0, 9]], atol=1e-12
    )
    ((x, y, z, *turn, long, wide, _),) = found["wall"].boxes
    assert (x, y, z) == pytest.approx((400.0, 0.0, 0.0))
    np.testing.assert_allclose(np.reshape(turn, (3, 3))[:, 0], [np.cos(np.pi / 6), 0.5, 0.0], atol=1e-12)
    assert (long, wide) == pytest.approx((10.0, 150.0))


SPATIAL = """
[cell]
floor_z_mm = -10.0

[[cell.bodies]]
kind = "cylinder"
start_mm = [0.0, 0.0, 0.0]
end_mm = [0.0, 0.0, 100.0]
radius_mm = 30.0

[[cell.bodies]]
kind = "mesh"
name = "holder"
joint = 1
file = "part.stl"
unit = "m"
x_mm = 50.0
rz_deg = 90.0
"""


def test_meshes_and_cylinders_of_an_arm_file(tmp_path: Path) -> None:
    """Where they are; and an arm with bodies travels to other processes."""
    (tmp_path / "part.stl").write_bytes(binary(0.1 * FACES))
    arm = arm_of(tmp_path, text=ARM + SPATIAL)
    pieces = bodies(arm)
    np.testing.assert_allclose(pieces["holder"].triangles[0], [[50, 0, 0], [50, 100, 0], [-100, 0, 0]], atol=1e-4)
    assert (pieces["cylinder 1"].joint, len(pieces["cylinder 1"].boxes) > 1) == (0, True)
    again = pickle.loads(pickle.dumps(arm))
    assert again == arm
    assert hash(again) == hash(arm)


def test_other_tables_are_written_around_the_cell() -> None:
    text = f"{PLAIN}{CELL}"
    assert with_effects(text, []) == text


def test_meshes_are_read_when_bodies_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by commands that do not ask."""
    (tmp_path / "part.stl").write_bytes(binary(0.1 * FACES))
    monkeypatch.setattr("identification.files.bodies.read_mesh", pytest.fail)
    arm = arm_of(tmp_path, MESH.replace("NAME", "part.stl"))
    assert arm.cell is not None
    assert isinstance(arm.cell, Cell)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CELL.replace("joint = 2", "joint = 3"), "cell.bodies[2].joint: found 3, allowed: 1 to 2, or left out"),
        (CELL.replace("joint = 2", "joint = 1", 1), "cell.bodies[3].joint: found 2 for another part of 'tool'"),
        (CELL.replace('"box"', '"cone"'), "cell.bodies[1].kind: found 'cone' for a planar arm"),
        (CELL.replace('"box"', '"cylinder"'), "cell.bodies[1].kind: found 'cylinder' for a planar arm"),
        (CELL.replace('kind = "box"\n', ""), "cell.bodies[1].kind: is missing"),
        (CELL.replace("300.0]", "300.0, 1.0]"), "cell.bodies[1].size_mm: found [20.0, 300.0, 1.0], allowed: two"),
        (CELL.replace("radius_mm = 8.0\n", ""), "cell.bodies[2].radius_mm: is missing, allowed: a value for it [mm]"),
        (CELL.replace("clearance_mm = 5", "clearance_mm = -5"), "cell.clearance_mm: found -5"),
        ("[cell]\nfloor_z_mm = 0.0", "cell.floor_z_mm: found in the file of a planar arm"),
    ],
)
def test_bad_tables_get_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "arm.toml").write_text(PLAIN + text)
    with pytest.raises(InputError, match=re.escape(said)):
        load_arm(tmp_path / "arm.toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SPATIAL.replace('"part.stl"', '"../part.stl"'), "cell.bodies[2].file: '../part.stl' is outside the folder"),
        ('[cell]\nsrdf = "/etc/passwd"', "cell.srdf: '/etc/passwd' is outside the folder"),
        (SPATIAL.replace("100.0]", "0.0]"), "cell.bodies[1].end_mm: found [0.0, 0.0, 0.0], allowed: another point"),
        (SPATIAL.replace('"m"', '"inch"'), "cell.bodies[2].unit: found 'inch'"),
    ],
)
def test_bad_tables_of_spatial_arms_get_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        arm_of(tmp_path, text=ARM + text)


def test_a_body_has_not_the_name_of_a_link(tmp_path: Path) -> None:
    arm = arm_of(tmp_path, text=ARM + SPATIAL.replace('"holder"', '"upper"'))
    with pytest.raises(InputError, match=r"cell.bodies: the name 'upper' is that of a link of .*r.urdf"):
        bodies(arm)


def test_keys_of_urdf_files_need_one() -> None:
    from identification.files.arm import arm_from_tables

    row = {"a_mm": 1.0, "alpha_deg": 0.0, "d_mm": 0.0}
    with pytest.raises(InputError, match=re.escape("cell.srdf: found without urdf, allowed: with urdf")):
        arm_from_tables({"kind": "spatial", "dh": [row], "cell": {"srdf": "r.srdf"}})
