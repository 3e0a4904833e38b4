"""Spatial arms from the command line: a UR10 as it was measured, and an arm of a URDF file whose truth is known."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doe.cli.plans import with_collisions
from doe.problem.constraints import COLLISIONS
from identification.document import Answer
from identification.estimation import estimate
from identification.files.arm import load_arm
from identification.files.urdf import read_urdf
from identification.kinematics.chain import KinematicChain
from identification.kinematics.corrected import corrected
from identification.kinematics.frames import from_roll_pitch_yaw, pose, rotation_about
from identification.kinematics.parameters import PRISMATIC
from identification.measurements import load_measurements, rms_distance
from identification.model import Model
from tests.doe.cli.conftest import ARM as PLANAR
from tests.doe.cli.conftest import Folder

DATA = Path(__file__).parents[2] / "data"
ARM = """\
name = "six"
kind = "spatial"
urdf = "six_axis.urdf"
base_link = "world"
tip_link = "tool0"

[measurement]
sigma_mm = 0.02
"""
PLACED = """
[base]
x_mm = 2000.0
y_mm = 500.0
z_mm = -100.0
rx_deg = 10.0
rz_deg = 70.0

[tool.top]
x_mm = 60.0
z_mm = 80.0

[tool.side]
y_mm = -90.0
z_mm = 40.0

[calibration.values]
"translation_x:3" = 0.8
"translation_z:2" = -0.5
"rotation_z:4" = 0.05
"rotation_x:2" = -0.1
"joint_offset:3" = 0.2
"joint_offset:1" = 0.3
"""


@pytest.fixture
def spatial(folder: Folder) -> Folder:
    """The arm, its truth, a plan of 40 postures and measurements of both reflectors."""
    shutil.copy(DATA / "spatial/six_axis.urdf", folder.path)
    folder.write("arm.toml", ARM)
    folder.write("truth.toml", ARM + PLACED)
    arm = load_arm(folder.path / "arm.toml")
    postures = np.random.default_rng(1).uniform(arm.lower, arm.upper, (40, 6))
    postures[:, 1:] = np.degrees(postures[:, 1:])
    rows = [",".join(f"{x:.6f}" for x in row) for row in postures]
    folder.write("plan.csv", "\n".join(["q1_mm,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg", *rows]) + "\n")
    folder.simulated()
    return folder


def tip(chain: KinematicChain, q: np.ndarray) -> np.ndarray:
    """(4, 4) pose of the tip in the base, by plain products."""
    found = np.eye(4)
    for joint, x in zip(chain.joints, q, strict=True):
        turned = pose(joint.axis * x) if joint.type == PRISMATIC else pose(rotation=rotation_about(joint.axis, x))
        found = found @ joint.origin @ turned
    return found @ chain.end


def test_from_urdf_and_tracker_to_a_corrected_urdf(spatial: Folder) -> None:
    words = ["identify", "arm.toml", "data.csv", "--out", "calibrated.toml", "--urdf", "corrected.urdf", "--json"]
    done = spatial.armcal(*words)
    assert done.code == 0, done.err
    assert set(done.data) >= {"base", "tools", "geometry", "joint_offsets", "strict_table"}
    assert done.data["rms_after_mm"] < 0.04
    assert set(done.data["tools"]) == {"top", "side"}
    truth = load_arm(spatial.path / "truth.toml")
    arm = load_arm(spatial.path / "calibrated.toml")
    assert arm.chain is not None
    assert truth.chain is not None
    assert arm.calibration is not None
    # the measured points of the calibrated arm, at postures of its own, are those of the true one
    postures = np.random.default_rng(9).uniform(arm.lower, arm.upper, (50, 6))
    left = Model(arm).position(postures) - Model(replace(truth, chain=truth.chain)).position(postures)
    assert rms_distance(left) < 0.05
    # the URDF file is the calibrated chain, to 1e-9 mm, and nothing else of it has changed
    real = corrected(arm.chain, arm.calibration.values)
    written = read_urdf(spatial.path / "corrected.urdf").chain("world", "tool0")
    for q in postures[:10]:
        np.testing.assert_allclose(tip(written, q), tip(real, q), atol=1e-9)
    before, after = (spatial.read(name) for name in ("six_axis.urdf", "corrected.urdf"))
    assert before != after
    assert [line for line in before.splitlines() if "origin" not in line and "axis" not in line] == [
        line for line in after.splitlines() if "origin" not in line and "axis" not in line
    ]
    # geometry and offsets are the corrected chain
    for row, offset, joint in zip(done.data["geometry"], done.data["joint_offsets"], real.joints, strict=True):
        place = [row[f"{axis}_mm"] for axis in "xyz"]
        turn = from_roll_pitch_yaw(*np.radians([row[f"{name}_deg"] for name in ("roll", "pitch", "yaw")]))
        value = offset["value"]
        moved = (
            pose(joint.axis * value)
            if offset["unit"] == "mm"
            else pose(rotation=rotation_about(joint.axis, np.radians(value)))
        )
        np.testing.assert_allclose(pose(place, turn) @ moved, joint.origin, atol=1e-9)


def test_pinocchio_reads_the_corrected_file(spatial: Folder) -> None:
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed: pip install 'armcal[oracle]'")
    spatial.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml", "--urdf", "corrected.urdf")
    arm = load_arm(spatial.path / "calibrated.toml")
    assert arm.chain is not None
    assert arm.calibration is not None
    real = corrected(arm.chain, arm.calibration.values)
    model = pinocchio.buildModelFromUrdf(str(spatial.path / "corrected.urdf"))
    data, frame = model.createData(), model.getFrameId("tool0")
    for q in np.random.default_rng(2).uniform(arm.lower, arm.upper, (10, 6)):
        placed = [q[0] / 1000.0, np.cos(q[1]), np.sin(q[1]), *q[2:]]  # metres; a continuous joint is a unit circle
        pinocchio.framesForwardKinematics(model, data, np.array(placed))
        np.testing.assert_allclose(tip(real, q)[:3, 3], 1000.0 * data.oMf[frame].translation, atol=1e-9)


def test_effects_are_left_out_of_the_urdf_file_and_said(spatial: Folder) -> None:
    spatial.write("arm.toml", ARM + '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 3\n')
    done = spatial.armcal("identify", "arm.toml", "data.csv", "--urdf", "corrected.urdf")
    assert done.code == 0, done.err
    assert "a URDF file has no effects: encoder_eccentricity:3 left out" in done.out


def test_two_sessions_share_the_geometry(spatial: Folder) -> None:
    """Rows of one set-up named as two: the bases agree, the file has the first, and the prediction stays."""
    rows = spatial.read("data.csv").splitlines()
    named = [f"{row},{name}" for row, name in zip(rows, ["session", *"ab" * 40], strict=True)]
    spatial.write("sessions.csv", "\n".join(named) + "\n")
    one = spatial.armcal("identify", "arm.toml", "data.csv", "--json").data
    two = spatial.armcal("identify", "arm.toml", "sessions.csv", "--json", "--out", "calibrated.toml").data
    values = {row["name"]: row for row in two["parameters"]}
    for axis in "xyz":
        there = values[f"session_base.{axis}2"]
        assert abs(there["value"]) < 4.0 * there["std"]
        assert two["base"][f"{axis}_mm"] == pytest.approx(one["base"][f"{axis}_mm"], abs=0.5)
    assert "session_base" not in spatial.read("calibrated.toml").partition("[calibration.provenance]")[0]


def test_validate_where_the_arm_stands_elsewhere(spatial: Folder) -> None:
    """The same arm with its tracker moved and other reflectors: only base and points are found anew."""
    spatial.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    moved = (ARM + PLACED).replace("x_mm = 2000.0", "x_mm = -700.0").replace("rz_deg = 70.0", "rz_deg = -40.0")
    moved = moved.replace("z_mm = 80.0", "z_mm = 120.0").replace("[tool.side]", "[tool.front]")
    spatial.write("moved.toml", moved)
    spatial.armcal("simulate", "arm.toml", "plan.csv", "--truth", "moved.toml", "--out", "other.csv", "--seed", "3")
    found = {
        refit: spatial.armcal("validate", "calibrated.toml", "other.csv", "--refit", refit, "--json").data
        for refit in ("base", "offsets")
    }
    assert found["base"]["rms_mm"] < 0.06 < 0.5 < found["base"]["rms_nominal_mm"]
    assert found["offsets"]["rms_mm"] < 0.06
    refitted = {row["name"]: row["value"] for row in found["base"]["refitted"]}
    # up to what the calibration leaves of joint 1 and of the last one, whose errors base and points take up
    assert refitted["base.x"] == pytest.approx(-700.0, abs=3.0)
    assert refitted["tool[front].y"] == pytest.approx(-90.0, abs=3.0)
    assert len(refitted) == 6 + 2 * 3
    assert len(found["offsets"]["refitted"]) == 6 + 2 * 3 + 4
    placed = spatial.armcal("identify", "calibrated.toml", "other.csv", "--only", "base,tool", "--json").data
    assert placed["rms_nominal_mm"] == pytest.approx(found["base"]["rms_nominal_mm"])
    assert placed["rms_before_mm"] == pytest.approx(placed["rms_after_mm"], rel=1e-4)  # the file has other reflectors
    same = spatial.armcal("validate", "calibrated.toml", "data.csv", "--refit", "none", "--json", "--picture", "x.png")
    assert same.code == 0, same.err
    assert same.data["rms_mm"] < 0.05


def test_a_drawing_in_denavit_hartenberg_numbers_gets_them_corrected(folder: Folder) -> None:
    """Of a real robot: 18 numbers beside base and tool, in 80 columns, the same in JSON."""
    data = Path(__file__).parents[2] / "data" / "ur10"
    rows = (data / "series_C.csv").read_text().splitlines()
    folder.write("some.csv", "\n".join([rows[0], *rows[1::4]]) + "\n")
    folder.write("ur10.toml", (data / "ur10.toml").read_text())
    shown = folder.armcal("identify", "ur10.toml", "some.csv").out
    said = folder.armcal("identify", "ur10.toml", "some.csv", "--json", "--out", "calibrated.toml")
    found = said.data["dh_table"]
    names = [row["name"] for row in found]
    assert len(names) == 18
    assert {name for name in names if name.endswith("beta")} == {"row 2 beta", "row 3 beta"}
    assert not {"row 2 d", "row 3 d"} & {*names}
    table, _, rest = shown.partition("Corrected Denavit-Hartenberg table")[2].partition("base: ")
    assert all(f" {name} " in table for name in names)
    assert "tool 1: x [mm]" in rest
    lengths = {row["name"]: row["corrected"] for row in found}
    assert lengths["row 2 a"] == pytest.approx(-612.8, abs=0.5)  # of all rows -612.82 with 0.11
    folder.write("fit.json", said.out)
    for file in ("calibrated.toml", "fit.json"):
        assert folder.armcal("report", file, "--out", "page.html", "--force").code == 0
        assert all(name in folder.read("page.html") for name in (*names, *said.data["dh_places"]))


def test_commands_for_the_real_arm(spatial: Folder) -> None:
    """Commands for the calibrated arm bring the true one where the drawing would be, as far as noise lets it."""
    spatial.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    done = spatial.armcal("compensate", "calibrated.toml", "plan.csv", "--out", "commands.csv", "--json")
    assert done.code == 0, done.err
    assert done.data["reached"] >= 38  # at the limits of the joints some are out of reach
    assert spatial.read("commands.csv").startswith(
        "q1_mm,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,error_mm,reachable"
    )
    rows = np.genfromtxt(spatial.path / "commands.csv", delimiter=",", skip_header=1, usecols=range(11))
    commands = np.c_[rows[:, :1], np.radians(rows[:, 1:6])]
    reached = rows[:, 9] < 1e-6
    real = Model(load_arm(spatial.path / "truth.toml")).position(commands)
    assert rms_distance((real - rows[:, 6:9])[reached]) < 0.06
    assert np.array_equal(
        ~reached, np.isnan(commands).all(axis=1)
    )  # a controller is not fed with what misses its target
    shown = spatial.armcal("compensate", "calibrated.toml", "plan.csv").out
    assert "q1 [mm]" in shown
    assert "Targets and miss [mm], commands [deg]" in shown


# -- a real robot ------------------------------------------------------------------------------------------------------
FULL = {"A": (0.445, 11_911), "C": (0.495, 2_773)}  # bar of the held-out RMS [mm] with all rows


@pytest.mark.parametrize("series", ["A", "C"])
def test_held_out_halves_of_the_ur10(series: str) -> None:
    """The bar of all rows, times sqrt(1 + p / N) for the N equations of half the sample (a linear fit's prediction
    error) against that of half of all rows, and the standard error of an RMS over the sample's rows."""
    arm = load_arm(DATA / "ur10/ur10.toml")
    with pytest.warns(UserWarning, match="columns are not used: 'rx_deg', 'ry_deg', 'rz_deg'"):
        data = load_measurements(DATA / f"ur10/series_{series}.csv", arm)
    left = []
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(data))
        half, other = (data.rows(np.sort(part)) for part in np.array_split(order, 2))
        found = estimate(Model(arm), half)
        left.append(rms_distance(other.positions - Model(found.calibrated_arm()).position(other.postures)))
    bar, rows = FULL[series]
    p, spread = len(found.parameters), 1.0 / np.sqrt(2.0 * 3.0 * len(data))
    assert np.mean(left) < bar * np.sqrt((1.0 + 2.0 * p / 3.0 / len(data)) / (1.0 + 2.0 * p / 3.0 / rows)) * (
        1 + spread
    )


def test_what_the_ur10_hardly_tells_stays_as_drawn(folder: Folder) -> None:
    """Its target is 0.2 mm off the last axis: without a prior two of 27 parameters would run to centimetres."""
    shutil.copy(DATA / "ur10/ur10.toml", folder.path)
    shutil.copy(DATA / "ur10/series_C.csv", folder.path)
    done = folder.armcal("identify", "ur10.toml", "series_C.csv", "--parameters", "minimal", "--json")
    assert done.code == 0, done.err
    assert "left as drawn, 25 parameters stay: " in done.err
    assert (len(done.data["parameters"]), done.data["status"]) == (25, "converged")
    errors = [row for row in done.data["parameters"] if row["name"].startswith(("translation", "rotation", "joint"))]
    assert max(abs(row["value"]) for row in errors) < 2.0
    assert done.data["rms_after_mm"] < 0.5


def test_every_plan_in_space_says_that_collisions_were_not_looked_at(spatial: Folder) -> None:
    """In JSON, and once in words; no plan in the plane does."""
    words = {
        "design": ("--runs", "14", "--starts", "1", "--solver", "random", "--seconds", "0.2"),
        "score": ("plan.csv", "--seconds", "0.2"),
        "advise": ("--runs", "14:14", "--seconds", "0.2"),
        "relax": ("--candidates", "plan.csv", "--runs", "20", "--no-check"),
    }
    for verb, rest in words.items():
        assert spatial.armcal(verb, "arm.toml", *rest, "--json").data["collisions_checked"] is False
    assert " ".join(spatial.armcal("score", "arm.toml", *words["score"]).out.split()).count(COLLISIONS) == 1
    assert "--candidates" in COLLISIONS
    assert with_collisions(Answer({}, []), load_arm(spatial.path / "arm.toml")).shown == [COLLISIONS]  # what all call
    spatial.armcal("report", "arm.toml", "plan.csv", "--out", "page.html")
    assert COLLISIONS in (spatial.path / "page.html").read_text()
    spatial.write("planar.toml", PLANAR)
    assert "collisions_checked" not in spatial.armcal("design", "planar.toml", "--runs", "20", "--json").data
