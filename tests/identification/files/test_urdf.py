"""URDF files: what is read (see also tests/identification/kinematics/test_spatial.py), written back, and refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from identification import Array
from identification.files.urdf import read_urdf
from identification.kinematics.frames import from_roll_pitch_yaw, pose
from tests.refusals import refused

XACRO = '<xacro:arm xmlns:xacro="http://www.ros.org/wiki/xacro"/>'
URDF = Path(__file__).parents[2] / "data" / "spatial" / "six_axis.urdf"
ENDS = ("world", "tool0")
HALF = np.pi / 2.0


def corrected(seed: int) -> list[Array]:
    """Origins of the moving joints, each a little off."""
    generator = np.random.default_rng(seed)
    errors = (pose(generator.normal(size=3), from_roll_pitch_yaw(*generator.normal(size=3) * 0.01)) for _ in range(9))
    return [joint.origin @ error for joint, error in zip(read_urdf(URDF).chain(*ENDS).joints, errors, strict=False)]


def test_a_chain_is_read() -> None:
    chain = read_urdf(URDF).chain(*ENDS)
    assert [joint.name for joint in chain.joints] == ["slide", "pan", "lift", "elbow", "tilted", "roll"]
    assert (chain.joints[0].lower, chain.joints[0].upper) == (-400.0, 600.0)  # mm
    assert (chain.joints[1].lower, chain.joints[1].upper) == (-np.pi, np.pi)
    np.testing.assert_allclose(chain.end[:3, 3], [115.7, 20.0, 0.0])


@pytest.mark.parametrize("lacking", ["", '<origin xyz="0 0 0.12"/>'])
def test_corrected_origins_come_back_and_nothing_else_changes(tmp_path: Path, lacking: str) -> None:
    """A joint without an origin gets one."""
    path, origins = tmp_path / "a.urdf", corrected(1)
    path.write_text(plain := URDF.read_text().replace(lacking, ""))
    text = read_urdf(path).with_origins(*ENDS, origins)
    path.write_text(text)
    for joint, origin in zip(read_urdf(path).chain(*ENDS).joints, origins, strict=True):
        np.testing.assert_allclose(joint.origin, origin, atol=1e-9)
    removed = re.compile(r"</?origin[^>]*>")
    text = text.replace(" />", "/>")
    assert removed.sub("", text) == removed.sub("", plain)
    assert '<origin xyz="9 9 9"/>' in text  # of a transmission, not of a joint
    assert '<origin rpy="0.1 -0.2 0.3" xyz="0.01 0.02 0.03"/>' in text  # of a fixed joint


@pytest.mark.parametrize("drawn", [(-HALF, HALF, 0.7), (0.1, 2.0, -0.4), (-HALF, 0.0, 4.0)])
def test_angles_are_the_nearest_to_those_drawn(tmp_path: Path, drawn: tuple[float, float, float]) -> None:
    """In gimbal lock, too, where those of an origin that stays are its own, and of angles beyond the common ones."""
    path, number = tmp_path / "robot.urdf", r'(<joint name="pan".*?rpy=")([^"]*)'
    path.write_text(re.sub(number, rf"\g<1>{drawn[0]!r} {drawn[1]!r} {drawn[2]!r}", URDF.read_text(), flags=re.DOTALL))
    urdf = read_urdf(path)
    origins = [joint.origin for joint in urdf.chain(*ENDS).joints]
    for more in (0.0, 1e-3):
        origins[1] = origins[1] @ pose(rotation=from_roll_pitch_yaw(more, 0.0, 0.0))
        (found,) = re.findall(number, urdf.with_origins(*ENDS, origins), flags=re.DOTALL)
        np.testing.assert_allclose(np.array(found[1].split(), dtype=float), drawn, rtol=0, atol=more + 1e-9)


def test_blank_lines_and_comments_stay(tmp_path: Path) -> None:
    """XML allows nothing before its declaration; other readers of URDF files do not mind."""
    text = URDF.read_text().replace("?>", "?>\n<!-- ours -->", 1).replace("</robot>", "<!-- end --></robot>")
    (tmp_path / "a.urdf").write_text("\n" + text)
    read = read_urdf(tmp_path / "a.urdf")
    assert [joint.name for joint in read.chain(*ENDS).joints][:2] == ["slide", "pan"]
    written = read.with_origins(*ENDS, corrected(3))
    assert written.startswith('\n<?xml version="1.0"?>\n<!-- ours -->')
    assert "<!-- end --></robot>" in written


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("<?xml", "<!DOCTYPE robot [<!ENTITY a 'b'>]><?xml", "found <!DOCTYPE, allowed: XML without document types"),
        ("</robot>", "", "not XML: no element found.*allowed: a URDF file"),
        ('"lift" type="revolute"', '"lift" type="floating"', "'lift' of the chain is of type 'floating'.*base link"),
        ('xyz="1 0 0"/>', 'xyz="1 0 0"/><mimic joint="pan"/>', "'roll' of the chain mimics another.*tip link"),
        ('<axis xyz="0 1 0"/>\n    <limit', '<axis xyz="0 0 0"/>\n    <limit', "axis 0 0 0, allowed: a direction"),
        ('lower="-0.4" ', "", "'slide': limit, lower or upper is missing, allowed: both for a prismatic joint"),
        ('lower="-2.8"', 'lower="2.9"', "'elbow': limits 2.9 to 2.8, allowed: lower < upper"),
        ('xyz="0 0 0.12"', 'xyz="0 0 nan"', "'slide': origin xyz has '0 0 nan', allowed: 3 numbers"),
        ('xyz="0 0 0.12"', 'xyz="0 0.12"', "'slide': origin xyz has '0 0.12', allowed: 3 numbers"),
        ('<child link="hand"/>', '<child link="wrist"/>', "link 'wrist' has two parent joints, allowed: one"),
        ('name="roll"', 'name="lift"', "joint 'lift' is there 2 times, allowed: once"),
        ('<parent link="wrist"/>', "", "joint 'roll' has no parent link, allowed: one"),
        ('<parent link="wrist"/>', '<parent link="tool0"/>', "link 'tool0' is not below 'world', allowed: a tip"),
        ("</robot>", f"{XACRO}</robot>", "found <xacro:arm>.*xacro bad.urdf > robot.urdf"),
        (URDF.read_text(), '<robot name="x"/>', "bad.urdf: there is no <link>, allowed: at least 1"),
        ('name="tool0"', 'name="tool"', "there is no link 'tool0', did you mean 'tool'"),
        ('<link name="hand"', '<link name="arm"', "there is no link 'hand', allowed: arm, base_link"),
    ],
)
def test_bad_files_are_one_line(tmp_path: Path, old: str, new: str, found: str) -> None:
    text = URDF.read_text()
    assert old in text
    path = tmp_path / "bad.urdf"
    path.write_text(text.replace(old, new, 1))
    assert refused(lambda: read_urdf(path).chain(*ENDS), names=found.split(".*")).startswith(f"{path}: ")
