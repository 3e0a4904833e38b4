"""`armcal init` as a user runs it: what it writes is read by the other verbs, and says what is made up."""

import json
import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from doe import DesignProblem
from doe.cli.verbs import with_collisions
from identification import Calibration, InputError, Model, load_arm, load_measurements
from identification.arm import LENGTH_RANGE
from identification.document import Answer
from identification.files.arm import arm_from_tables
from identification.files.csv import read_table
from identification.files.first_files import dh_files, planar_files, urdf_files
from identification.files.urdf import read_urdf
from identification.workflow import arm_files
from tests.doe.cli.conftest import Folder
from tests.identification.files.test_bodies import FACES, binary
from tests.small_arm import MASSES, urdf

URDF = Path(__file__).parents[2] / "data/spatial/six_axis.urdf"
GRIPPER = """<robot name="two fingers"><link name="base"/>
<link name="arm"><inertial><mass value="2.5"/></inertial></link>
<link name="hand"><inertial><mass value="0.5"/></inertial></link><link name="tcp"/>
<link name="left"/><link name="right"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2"/></joint>
<joint name="mount" type="fixed"><parent link="arm"/><child link="hand"/><origin xyz="0.3 0 0"/></joint>
<joint name="middle" type="fixed"><parent link="hand"/><child link="tcp"/></joint>
<joint name="finger" type="prismatic"><parent link="hand"/><child link="left"/><limit lower="0" upper="0.1"/></joint>
<joint name="other" type="prismatic"><parent link="hand"/><child link="right"/><limit lower="0" upper="0.1"/>
<mimic joint="finger"/></joint></robot>"""


@pytest.mark.parametrize(
    ("words", "joints"),
    [("", 3), ("--links 4", 4), ("--links 612,572.3,115.7", 3), ("--dh 6", 6), ("--dh 8", 8), (f"--urdf {URDF}", 6)],
)
def test_what_is_written_is_read_and_its_first_step_is_printed(folder: Folder, words: str, joints: int) -> None:
    done = folder.said(f"init {words} --out new/cell")
    home = folder.path / "new/cell"
    assert {Path(name).name for name in done["files"]} == {path.name for path in home.iterdir()}
    arm = load_arm(home / "arm.toml")
    assert arm.links == joints
    assert np.isfinite(Model(arm).position(np.zeros((1, joints)))).all()
    header = home.joinpath("measurements.csv").read_text().strip().split(",")
    assert [name[:2] for name in header if name.startswith("q")] == [f"q{j}" for j in range(1, joints + 1)]
    with pytest.raises(InputError, match="there are no rows"):
        read_table(home / "measurements.csv")
    steps, command = (home / "README.md").read_text(), done["next"][-1].partition(": ")[2]
    assert command == next(line for line in steps.splitlines() if line.startswith("armcal design"))
    assert "new/cell/arm.toml" in done["next"][1]  # what is made up comes before
    if "--urdf" in words:
        assert home.joinpath(URDF.name).read_bytes() == URDF.read_bytes()
        folder.said(f"init --urdf {home / URDF.name} --out {home} --force")  # the file is where it belongs already


def test_joints_of_several_turns_are_planned_within_one(tmp_path: Path) -> None:
    """Two turns about -30 deg, as a URDF file may have them; a joint of less than one keeps its limits."""
    low, high = np.radians([-390.0, 330.0])
    wide = GRIPPER.replace('lower="-1" upper="2"', f'lower="{low}" upper="{high}"')
    for text, limits in ((wide, [-210.0, 150.0]), (GRIPPER, np.degrees([-1.0, 2.0]))):
        (tmp_path / "two.urdf").write_text(text)
        for name, content in urdf_files(tmp_path / "two.urdf").items():
            (tmp_path / name).write_text(content)
        arm = load_arm(tmp_path / "arm.toml")
        np.testing.assert_allclose(np.degrees([arm.lower[0], arm.upper[0]]), limits, atol=1e-9)


@pytest.mark.parametrize("kind", ["distance", "sphere", "plane", "socket"])
@pytest.mark.parametrize("words", ["--dh 4", f"--urdf {URDF}"], ids=["dh", "urdf"])
def test_files_of_an_instrument_of_lengths(folder: Folder, words: str, kind: str) -> None:
    """The arm file measures such lengths, rows below the header are read, and the next step is one that works."""
    done = folder.said(f"init {words} --instrument {kind} --out cell")
    home = folder.path / "cell"
    arm = load_arm(home / "arm.toml")
    assert arm.chain.instrument.kind == kind
    header = (home / "measurements.csv").read_text()
    cells = {"order": "1", "distance_mm": "500", "surface": "left", "cup": "left"}
    folder.write("data.csv", header + ",".join(cells.get(name, "20") for name in header.strip().split(",")) + "\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of columns that are not used
        measured = load_measurements(folder.path / "data.csv", arm)
    readings = {"distance": [500.0], "sphere": [0.0], "plane": [0.0], "socket": [0.0, 0.0, 0.0]}
    assert measured.positions.tolist() == [readings[kind]]
    steps = (home / "README.md").read_text()
    column = {"distance": "distance_mm", "socket": "cup"}.get(kind, "surface")
    assert f"| `{column}` |" in steps
    assert "armcal design arm.toml --runs" in steps  # of a touch, too, where the file says about where
    assert done["next"][-1].partition(": ")[2].startswith(f"armcal {'design' if kind == 'distance' else 'check'}")
    schema = json.loads((home / "arm.schema.json").read_text())
    validator(schema).validate(tomllib.loads((home / "arm.toml").read_text()))


@pytest.mark.parametrize("instrument", ["", "distance", "sphere", "plane", "socket"])
def test_what_is_commented_out_can_be_put_in(folder: Folder, instrument: str) -> None:
    text = re.sub(r"(?m)^# (?=\[|\w+ = )", "", dh_files(6, instrument)["arm.toml"])
    if not instrument:  # a base that is known stands beside no unknown one
        assert "[base]" in text
    arm = load_arm(folder.write("arm.toml", text))
    assert len(arm.constraints) == (0 if instrument in ("sphere", "plane", "socket") else 2)
    assert arm.gravity is not None


def validator(schema: dict[str, Any]) -> Any:
    """Of files by a JSON schema."""
    import jsonschema  # deferred: it takes more than a second to load, in every process that collects tests

    return jsonschema.validators.validator_for(schema)(schema)


def test_the_schema_accepts_the_arm_and_refuses_a_misspelt_key() -> None:
    for files in (planar_files("3"), dh_files(6), urdf_files(URDF)):
        tables, schema = tomllib.loads(files["arm.toml"]), json.loads(files["arm.schema.json"])
        validator(schema).validate(tables)
        assert not validator(schema).is_valid({**tables, "link_mm": [1.0]})


@settings(max_examples=8, deadline=None)
@given(st.lists(st.floats(*LENGTH_RANGE), min_size=1, max_size=12))
@example([13.0])
@example([0.00001, 612.34567891234, 1e9])
def test_lengths_are_read_back_as_they_were_given_and_made_up_ones_are_marked(lengths: list[float]) -> None:
    text = planar_files(",".join(map(repr, lengths)))["arm.toml"]
    assert arm_from_tables(tomllib.loads(text)).lengths.tolist() == lengths
    assert re.search(r"^links_mm = .*\]$", text, flags=re.M)
    assert "links_mm = [600.0, 480.0, 384.0]  # EXAMPLE" in planar_files("3")["arm.toml"]


def test_ends_that_cannot_be_measured_are_not_taken(folder: Folder) -> None:
    hand = folder.write("hand.urdf", GRIPPER)
    text = urdf_files(hand)["arm.toml"]
    assert 'tip_link = "tcp"' in text
    assert "link_masses_kg = [3.0]" in text  # arm and hand move together
    assert "lower = [-57.2958]" in text
    hand.write_text(GRIPPER.replace('"tcp"', '"camera"'))
    assert 'tip_link = "left"' in urdf_files(hand)["arm.toml"]  # two joints; `right` mimics
    assert read_urdf(hand).ends == ("camera", "left", "right")
    longer = '<link name="pen"/><joint name="up" type="continuous"><parent link="right"/><child link="pen"/></joint>'
    hand.write_text(hand.read_text().replace("</robot>", longer + "</robot>"))
    with pytest.warns(UserWarning, match=r"the tip is 'left', not 'pen', which has more joints: .*'other' of the"):
        assert 'tip_link = "left"' in urdf_files(hand)["arm.toml"]


def test_centers_of_mass_are_those_of_the_urdf_file(folder: Folder) -> None:
    """2.5 kg at 60 and 100 mm, 0.5 kg of which nothing is said at half of the 300 mm, and a finger of 1 kg beside the
    end."""
    place = '<inertial><mass value="{}"/><origin xyz="{}"/></inertial>'
    text = GRIPPER.replace('<inertial><mass value="2.5"/></inertial>', place.format(2.5, "0.06 0.1 0"))
    text = text.replace('<link name="left"/>', f'<link name="left">{place.format(1.0, "0 0.1 0")}</link>')
    written = urdf_files(folder.write("hand.urdf", text), tip="tcp")["arm.toml"]
    assert "link_masses_kg = [4.0]" in written
    along, beside = (2.5 * 60.0 + 0.5 * 150.0 + 1.0 * 300.0) / 4.0, (2.5 * 100.0 + 1.0 * 100.0) / 4.0
    assert f"center_of_mass_mm = [[{along}, {beside}, 0.0]]" in written


@pytest.mark.parametrize("masses", [True, False])
def test_gravity_is_on_where_the_urdf_file_has_masses(folder: Folder, masses: bool) -> None:
    folder.write("robot.urdf", urdf(masses=masses))
    done = folder.armcal("init --urdf robot.urdf --out cell")
    gravity = load_arm(folder.path / "cell/arm.toml").gravity
    assert ("with an upright base" in done.out) is masses
    assert ("taken to stand upright" in folder.read("cell/arm.toml")) is masses
    assert (gravity is not None) is masses
    if gravity is not None:
        assert (gravity.link_masses.tolist(), gravity.acceleration.tolist()) == (MASSES.tolist(), [0.0, 0.0, -9.81])


def test_meshes_of_bodies_are_copied(folder: Folder) -> None:
    """To where the copy of the URDF file finds them, without the package that they came from; and not onto themselves.
    What is not found is said."""
    links = {"arm": "package://robot/meshes/a.stl", "hand": "../meshes/b.stl", "left": "package://other/c.dae"}
    text = GRIPPER
    for link, name in links.items():
        mesh = f'<collision><geometry><mesh filename="{name}"/></geometry></collision></link>'
        text = re.sub(rf'<link name="{link}"(/>|>(.*?)</link>)', rf'<link name="{link}">\2{mesh}', text, count=1)
    for place in ("package/meshes/a.stl", "package/meshes/b.stl", "given/other/c.stl", "package/urdf/r.urdf"):
        path = folder.path / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(binary(0.1 * FACES))
    folder.write("package/package.xml", "<package><name>robot</name></package>")
    folder.write("package/urdf/r.urdf", text)
    said = folder.said("init --urdf package/urdf/r.urdf --tip-link tcp --out cell")
    assert said["files"][-2:] == ["cell/robot/meshes/a.stl", "cell/meshes/b.stl"]
    lost = "1 meshes are not found as .stl or .obj, the first of them package://other/c.dae"
    assert [line for line in said["next"] if line.startswith(lost)]
    arm = load_arm(folder.path / "cell/arm.toml")
    cell = arm.cell
    assert cell is not None
    with pytest.warns(UserWarning, match=r"meshes of left are not found"):
        assert [body.name for body in cell.bodies] == ["arm", "hand"]
    with pytest.warns(UserWarning, match="beside the last axis is assumed"):
        problem = DesignProblem.of(Model(arm))
    answer = with_collisions(Answer({}), problem)
    assert answer.data["collisions_checked"] is False
    assert answer.document.parts[-1] == "Links whose meshes were not found (not checked): left."
    (folder.path / "far").mkdir()  # where a calibrated arm is written, they are, too
    copies = arm_files(folder.path / "cell/arm.toml", [], Calibration({}), folder.path / "far/new.toml", "arm")
    names = ["far/new.toml", "far/r.urdf", "far/robot/meshes/a.stl", "far/meshes/b.stl"]
    assert [*copies] == [folder.path / name for name in names]
    folder.said("init --urdf cell/r.urdf --tip-link tcp --out cell --force")
    again = folder.said("init --urdf package/urdf/r.urdf --package-dir given --tip-link tcp --out new")
    assert (folder.path / "new/other/c.stl").read_bytes() == binary(0.1 * FACES)
    assert not [line for line in again["next"] if "not found" in line]
