"""Arm files of spatial arms: geometry from URDF and Denavit-Hartenberg tables, calibrations, bad input in one line."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.arm import Machining
from identification.errors import InputError
from identification.files.arm import load_arm
from identification.files.urdf import read_urdf
from identification.kinematics.chain import BASE, TOOL, DHRow
from identification.kinematics.frames import pose
from identification.model import Model
from identification.workspace import KeepOutCircle, KeepOutCylinder, LineOfSight, WorkspaceBox
from tests.identification.kinematics.test_spatial import printed

DATA = Path(__file__).parents[2] / "data"
URDF = DATA / "spatial" / "six_axis.urdf"
BY_URDF = """\
# bought in spring
name = "six"
kind = "spatial"
urdf = "six_axis.urdf"
base_link = "world"  # bolted down
tip_link = "tool0"
gear_ratio = [1.0, 100.0, 100.0, 50.0, 50.0, 0.0]

[joint_limits_mm]
lower = [-300.0]
upper = [500.0]

[base]
x_mm = 1000.0
y_mm = -200.0
z_mm = 50.0
rx_deg = 10.0
ry_deg = -20.0
rz_deg = 130.0

[tool.left]
x_mm = 60.0
y_mm = 20.0
z_mm = 50.0

[tool.right]
x_mm = -70.0

[machining]
rotation_deg = 0.2

[measurement]
sigma_mm = 0.05
sigma_deg = 0.01

[gravity]
acceleration_m_s2 = [0.0, 0.0, -9.81]
link_masses_kg = [10.0, 8.0, 6.0, 2.0, 1.0, 0.5]
payload_kg = 2.0
payload_at_mm = [10.0, -20.0, 80.0]

[[constraints]]
kind = "workspace_box"
x_mm = [-400.0, 600.0]
y_mm = [0.0, 650.0]
z_mm = [100.0, 2000.0]

[[constraints]]
kind = "keep_out_sphere"
center_mm = [350.0, 200.0, 100.0]
radius_mm = 60.0

[[constraints]]
kind = "keep_out_cylinder"
start_mm = [350.0, 200.0, 0.0]
end_mm = [350.0, 200.0, 900.0]
radius_mm = 60.0

[[constraints]]
kind = "line_of_sight"
tracker_mm = [1500.0, 300.0, 1000.0]
half_angle_deg = 25.0
toward_mm = [0.0, 200.0, 500.0]
range_mm = [500.0, 5000.0]
facing = [0.0, 0.0, 1.0]
acceptance_deg = 30.0

[[effects]]
name = "gear_ratio"
joint = 2
e = 0.0005
"""
BY_TABLE = """\
kind = "spatial"

[[dh]]
a_mm = 10.0
alpha_deg = 90.0
d_mm = 127.3

[[dh]]
a_mm = -612.0
alpha_deg = 0.0
d_mm = 0.0
offset_deg = 30.0

[[dh]]
a_mm = 0.0
alpha_deg = 90.0
d_mm = 160.0
joint = "prismatic"

[joint_limits_mm]
lower = [-50.0]
upper = [150.0]
"""


def saved(folder: Path, text: str) -> Path:
    """An arm file with the URDF file beside it."""
    shutil.copy(URDF, folder)
    (folder / "arm.toml").write_text(text)
    return folder / "arm.toml"


def test_arm_of_a_urdf_file(tmp_path: Path) -> None:
    arm = load_arm(saved(tmp_path, BY_URDF))
    nominal = read_urdf(URDF).chain("world", "tool0")
    chain = arm.chain
    assert [joint.name for joint in chain.joints] == [joint.name for joint in nominal.joints]
    for joint, other in zip(chain.joints, nominal.joints, strict=True):
        np.testing.assert_array_equal(joint.origin, other.origin)
    assert (arm.name, arm.links, arm.dimension, arm.sigma) == ("six", 6, 3, 0.05)
    assert (arm.lower[0], arm.upper[0]) == (-300.0, 500.0)
    np.testing.assert_array_equal(arm.upper[1:], [joint.upper for joint in nominal.joints[1:]])
    turn = Rotation.from_euler("XYZ", (10.0, -20.0, 130.0), degrees=True).as_matrix()  # capitals: own axes
    np.testing.assert_allclose(chain.base, pose((1000.0, -200.0, 50.0), turn), atol=1e-12)
    assert chain.settled == {BASE, TOOL}
    assert {name: place.tolist() for name, place in chain.tools.items()} == {
        "left": [60.0, 20.0, 50.0],
        "right": [-70.0, 0.0, 0.0],
    }
    assert arm.machining == Machining(1.0, np.radians(0.2))
    assert arm.gear_ratios[5] == 0.0
    assert arm.gravity.acceleration.tolist() == [0.0, 0.0, -9.81]
    assert arm.gravity.payload_at.tolist() == [10.0, -20.0, 80.0]
    assert arm.effects[0].values == {"e": 0.0005}
    assert arm.constraints == (
        WorkspaceBox((-400.0, 600.0), (0.0, 650.0), (100.0, 2000.0)),
        KeepOutCircle((350.0, 200.0, 100.0), 60.0),
        KeepOutCylinder((350.0, 200.0, 0.0), (350.0, 200.0, 900.0), 60.0),
        LineOfSight(
            (1500.0, 300.0, 1000.0),
            np.radians(25.0),
            (0.0, 200.0, 500.0),
            (500.0, 5000.0),
            (0.0, 0.0, 1.0),
            np.radians(30.0),
        ),
    )


def test_limits_of_the_arm_file_stand_in_for_those_of_the_urdf(tmp_path: Path) -> None:
    path = saved(tmp_path, BY_URDF)
    (tmp_path / "six_axis.urdf").write_text(re.sub(r'lower="-0.4" upper="0.6"', "", URDF.read_text()))
    assert load_arm(path).upper[0] == 500.0
    path.write_text(re.sub(r"\[joint_limits_mm\]\nlower.*\nupper.*\n", "", BY_URDF))
    with pytest.raises(InputError, match=r"joint 'slide': limit, lower or upper is missing, allowed: both"):
        load_arm(path)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_arm_of_a_table(tmp_path: Path, convention: str) -> None:
    """The tip is the product of the matrices as the convention prints them."""
    arm = load_arm(saved(tmp_path, BY_TABLE.replace("d_mm = 127.3", f'd_mm = 127.3\nconvention = "{convention}"')))
    rows = [
        DHRow(10.0, np.pi / 2, 127.3),
        DHRow(-612.0, 0.0, 0.0, np.radians(30.0)),
        DHRow(0.0, np.pi / 2, 160.0, type="prismatic"),
    ]
    q = np.array([0.3, -1.1, 70.0])
    tip = np.linalg.multi_dot([printed(row, x, convention) for row, x in zip(rows, q, strict=True)])
    np.testing.assert_allclose(Model(arm).position(q[None])[0], tip[:3, 3], atol=1e-10)
    assert (arm.lower[2], arm.upper[2], arm.upper[0]) == (-50.0, 150.0, np.pi)
    assert arm.chain.settled == frozenset()


# -- bad input ---------------------------------------------------------------------------------------------------------
BAD = [  # values that are of the right type: what to replace, by what, and what is named
    (BY_URDF, 'urdf = "six_axis.urdf"\n', "", "urdf, dh: neither is there"),
    (BY_URDF, '"six_axis.urdf"', '"../six_axis.urdf"', "urdf: '../six_axis.urdf' is outside"),
    (BY_URDF, '"six_axis.urdf"', '"none.urdf"', "none.urdf: no such file"),
    (BY_URDF, '"tool0"', '"tool1"', "did you mean 'tool0'?"),
    (BY_URDF, 'kind = "spatial"', 'kind = "space"', "kind: found 'space'"),
    (BY_URDF, "lower = [-300.0]", "lower = [900.0]", "joint_limits_mm: joint 1"),
    (BY_URDF, "z_mm = [100.0, 2000.0]", "", "constraints[1].z_mm: is missing, allowed: a value for it [mm]"),
    (BY_URDF, '"keep_out_sphere"', '"keep_out_circle"', "constraints[2].kind: found 'keep_out_circle'"),
    (BY_URDF, "end_mm = [350.0, 200.0, 900.0]", "end_mm = [350.0, 200.0, 0.0]", "constraints[3].end_mm: found"),
    (BY_URDF, "facing = [0.0, 0.0, 1.0]", "", "constraints[4].acceptance_deg: found without facing"),
    (BY_URDF, 'name = "gear_ratio"', 'name = "link_thermal"', "'link_thermal'"),
    (BY_TABLE, "[joint_limits_mm]\nlower = [-50.0]\nupper = [150.0]", "", "dh[3]: a prismatic joint without limits"),
    (
        BY_TABLE,
        "d_mm = 127.3",
        'd_mm = 127.3\nconvention = "modified"\n[[dh]]\na_mm=1.0\nd_mm=1.0\nalpha_deg=1.0\nconvention = "standard"',
        "dh: found conventions modified and standard",
    ),
    (
        BY_TABLE,
        "upper = [150.0]",
        "upper = [150.0]\n[base]\n[calibration.values]\n[calibration.base]\nx_mm = 1.0",
        "calibration.base: found beside [base]",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "old", "new", "named"), BAD, ids=[named[:40] for *_, named in BAD])
def test_bad_input_is_one_line(tmp_path: Path, text: str, old: str, new: str, named: str) -> None:
    assert old in text
    path = saved(tmp_path, text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        load_arm(path)
    assert named in str(error.value)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_examples_of_the_page_load(tmp_path: Path) -> None:
    page = Path(__file__).parents[3] / "identification/files/README.md"
    section = page.read_text().split("### Spatial arms")[1].split("\n## ")[0]
    blocks = re.findall(r"^```toml\n(.*?)^```", section, re.DOTALL | re.MULTILINE)
    by_urdf, by_table, by_cell, by_lengths, joints = blocks
    shutil.copy(URDF, tmp_path / "robot.urdf")
    arm = load_arm(saved(tmp_path, by_urdf))
    assert (arm.links, len(arm.constraints), list(arm.chain.tools)) == (6, 2, ["top"])
    chain = load_arm(saved(tmp_path, by_table)).chain
    assert (len(chain), chain.settled) == (2, {BASE})
    assert load_arm(saved(tmp_path, f"links_mm = [4, 3, 2, 1]\n{joints}")).counting is not None
    (tmp_path / "robot.srdf").write_text('<robot name="six"/>')
    assert load_arm(saved(tmp_path, f"{by_urdf}\n{by_cell}")).cell is not None
    bar = load_arm(saved(tmp_path, f"{by_urdf}\n{by_lengths}")).chain
    assert bar.coordinates == 1
