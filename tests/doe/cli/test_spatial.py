"""Spatial arms from the command line: a UR10 as it was measured, and an arm of a URDF file whose truth is known."""

import shutil
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from doe import DesignProblem
from doe.cli.verbs import with_collisions
from doe.plan.moves import COLLISIONS
from identification import Model, Plan, design_model, estimate, load_arm, load_measurements, rms_distance
from identification.document import Answer
from identification.files.urdf import read_urdf
from identification.kinematics.frames import from_roll_pitch_yaw, pose, rotation_about
from tests.doe.cli.conftest import ARM as PLANAR
from tests.doe.cli.conftest import Folder, table
from tests.identification.kinematics.test_spatial import places_by_exponentials

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
JOINTS = ["q1_mm", *(f"q{j}_deg" for j in range(2, 7))]
IDENTIFY = "identify arm.toml data.csv --out calibrated.toml"


@pytest.fixture
def spatial(folder: Folder) -> Folder:
    """The arm, its truth, a plan of 40 postures and measurements of both reflectors."""
    shutil.copy(DATA / "spatial/six_axis.urdf", folder.path)
    folder.write("arm.toml", ARM)
    folder.write("truth.toml", ARM + PLACED)
    arm = load_arm(folder.path / "arm.toml")
    postures = np.random.default_rng(1).uniform(arm.lower, arm.upper, (40, 6))
    postures[:, 1:] = np.degrees(postures[:, 1:])
    folder.write("plan.csv", table(dict(zip(JOINTS, postures.round(6).T, strict=True))))
    folder.simulated()
    return folder


def test_from_urdf_and_tracker_to_a_corrected_urdf(spatial: Folder) -> None:
    found = spatial.said(f"{IDENTIFY} --urdf corrected.urdf")
    assert set(found) >= {"base", "tools", "geometry", "joint_offsets"}
    assert found["rms_after_mm"] < 0.04
    assert set(found["tools"]) == {"top", "side"}
    truth, arm = (load_arm(spatial.path / f"{name}.toml") for name in ("truth", "calibrated"))
    assert arm.calibration is not None
    # the measured points of the calibrated arm, at postures of its own, are those of the true one
    postures = np.random.default_rng(9).uniform(arm.lower, arm.upper, (50, 6))
    assert rms_distance(Model(arm).position(postures) - Model(truth).position(postures)) < 0.05
    # the URDF file is the calibrated chain, to 1e-9 mm, for pinocchio too, and nothing else of it has changed
    real = replace(arm.chain.corrected(arm.calibration.values), base=np.eye(4))
    written = read_urdf(spatial.path / "corrected.urdf").chain("world", "tool0")
    for q in postures[:10]:
        np.testing.assert_allclose(*(places_by_exponentials(each, q, {})[-1] for each in (written, real)), atol=1e-9)
    if find_spec("pinocchio"):
        pinocchio = import_module("pinocchio")
        model = pinocchio.buildModelFromUrdf(str(spatial.path / "corrected.urdf"))
        data, frame = model.createData(), model.getFrameId("tool0")
        for q in postures[:10]:
            placed = [q[0] / 1000.0, np.cos(q[1]), np.sin(q[1]), *q[2:]]  # metres; a continuous joint is a unit circle
            pinocchio.framesForwardKinematics(model, data, np.array(placed))
            tip = places_by_exponentials(real, q, {})[-1]
            np.testing.assert_allclose(tip[:3, 3], 1000.0 * data.oMf[frame].translation, atol=1e-9)
    before, after = (
        spatial.read(name).replace(" />", "/>").splitlines() for name in ("six_axis.urdf", "corrected.urdf")
    )
    assert before != after
    same = [[line for line in lines if "origin" not in line and "axis" not in line] for lines in (before, after)]
    assert same[0] == same[1]
    # geometry and offsets are the corrected chain
    for row, offset, joint in zip(found["geometry"], found["joint_offsets"], real.joints, strict=True):
        place = [row[f"{axis}_mm"] for axis in "xyz"]
        turn = from_roll_pitch_yaw(*np.radians([row[f"{name}_deg"] for name in ("roll", "pitch", "yaw")]))
        value = offset["value"] if offset["unit"] == "mm" else np.radians(offset["value"])
        motion = (
            pose(joint.axis * value) if offset["unit"] == "mm" else pose(rotation=rotation_about(joint.axis, value))
        )
        np.testing.assert_allclose(pose(place, turn) @ motion, joint.origin, atol=1e-9)


def test_a_kept_run_counts_once_with_the_reflectors_read(spatial: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a plan all; of measurements by generalized least squares of their rows, one of four of which is missing."""
    monkeypatch.setattr("doe.solvers.solving.best_known_bound", lambda *_: None)  # which takes time
    drawn = "design truth.toml --runs 3 --solver random --seconds 0.01 --keep"
    head, *lines = spatial.read("data.csv").splitlines()
    spatial.write("some.csv", "\n".join([head, *(line for k, line in enumerate(lines) if k % 4 != 1)]))
    plan, data, some = (spatial.said(f"{drawn} {name}.csv") for name in ("plan", "data", "some"))
    expected = plan["std"]["parameters"].items()
    assert data["std"]["parameters"] == {name: [pytest.approx(std, rel=1e-6), unit] for name, (std, unit) in expected}
    arm = load_arm(spatial.path / "truth.toml")
    problem, rows = DesignProblem.of(arm), load_measurements(spatial.path / "some.csv", arm)
    scales = problem.model.parameters.scales
    new = np.array(some["postures"])
    new[:, 1:] = np.radians(new[:, 1:])
    read = Model(arm).jacobian(rows.postures, None, rows.conditions) / scales
    of_rows = sum(np.einsum("kdp,kdq->pq", j, j) for j in (read, problem.scaled_jacobians(new)))
    deviations = 0.02 * np.sqrt(np.diag(np.linalg.inv(np.diag(problem.precisions) + of_rows))) / scales
    for parameter, deviation in zip(problem.model.parameters, deviations, strict=True):
        std, _ = some["std"]["parameters"][parameter.name]
        assert std == pytest.approx(deviation * parameter.to_file, rel=1e-6)
    spatial.write("other.csv", spatial.read("data.csv").replace(",top\n", ",bottom\n"))
    spatial.refused(f"{drawn} other.csv", "bottom")
    assert "20 of 60 rows are not of" in spatial.armcal(f"{drawn.replace('truth', 'arm')} some.csv").err
    spatial.write("pose.toml", spatial.read("truth.toml").replace("= 0.02", "= 0.02\nsigma_deg = 0.01"))
    of_poses = load_arm(spatial.path / "pose.toml")  # of which plans read two frames, and these rows the points of some
    some, whole = (
        Plan.load(spatial.path / f"{name}.csv", of_poses.joint_types, carried_out=True) for name in ("some", "plan")
    )
    excess = design_model(of_poses).measured_already(some)[1]
    read = np.stack([np.ones(40), np.arange(40) % 2], axis=1)[:, :, None] * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert sorted(np.isfinite(excess).tolist()) == sorted((read.reshape(40, 12) > 0.0).tolist())
    assert np.all(design_model(of_poses).measured_already(whole)[1] == 0.0)


@pytest.mark.parametrize("words", ["--urdf six_axis.urdf --force", "--out new/c.toml --urdf new/six_axis.urdf"])
def test_the_drawing_of_an_arm_file_is_not_corrected_in_its_place(spatial: Folder, words: str) -> None:
    """What is in [calibration] would come on top of what the drawing has already."""
    (spatial.path / "new").mkdir()
    before = spatial.read("six_axis.urdf")
    spatial.refused(f"identify arm.toml data.csv {words}", "--urdf", "corrected twice")
    assert (spatial.read("six_axis.urdf"), [*(spatial.path / "new").iterdir()]) == (before, [])


def test_what_an_arm_file_names_goes_with_it(spatial: Folder) -> None:
    spatial.write("part.obj", "v 0 0 0\nv 90 0 0\nv 0 90 0\nv 0 0 90\nf 1 2 3\nf 1 2 4\n")
    spatial.write("a.srdf", "<robot/>")
    spatial.write("arm.toml", ARM + '[cell]\nsrdf = "a.srdf"\n[[cell.bodies]]\nkind = "mesh"\nfile = "part.obj"\n')
    (spatial.path / "new").mkdir()
    spatial.said("identify arm.toml data.csv --out new/calibrated.toml")
    cell = load_arm(spatial.path / "new/calibrated.toml").cell
    assert cell is not None
    assert "mesh 1" in [body.name for body in cell.bodies]


def test_effects_are_left_out_of_the_urdf_file_and_said(spatial: Folder) -> None:
    spatial.write("arm.toml", ARM + '\n[[effects]]\nname = "encoder_eccentricity"\njoint = 3\n')
    done = spatial.armcal("identify arm.toml data.csv --urdf corrected.urdf")
    assert done.code == 0, done.err
    assert "a URDF file has no effects: encoder_eccentricity:3 left out" in done.out


def test_validate_where_the_arm_stands_elsewhere(spatial: Folder) -> None:
    """The same arm with its tracker moved and other reflectors: only base and points are found anew."""
    spatial.said(IDENTIFY)
    elsewhere = (ARM + PLACED).replace("x_mm = 2000.0", "x_mm = -700.0").replace("rz_deg = 70.0", "rz_deg = -40.0")
    spatial.write("moved.toml", elsewhere.replace("z_mm = 80.0", "z_mm = 120.0").replace("[tool.side]", "[tool.front]"))
    spatial.simulated("other.csv", 3, "moved.toml")
    base, offsets = (
        spatial.said(f"validate calibrated.toml other.csv --refit {refit}") for refit in ("base", "offsets")
    )
    assert base["rms_mm"] < 0.06 < 0.5 < base["rms_nominal_mm"]
    assert offsets["rms_mm"] < 0.06
    refitted = {row["name"]: row["value"] for row in base["refitted"]}
    # up to what the calibration leaves of joint 1 and of the last one, whose errors base and points take up
    assert (refitted["base.x"], refitted["tool[front].y"]) == pytest.approx((-700.0, -90.0), abs=3.0)
    assert (len(refitted), len(offsets["refitted"])) == (6 + 2 * 3, 6 + 2 * 3 + 4)
    placed = spatial.said("identify calibrated.toml other.csv --only base,tool")
    assert placed["rms_drawing_mm"] == pytest.approx(base["rms_nominal_mm"])
    assert placed["rms_before_mm"] == pytest.approx(placed["rms_after_mm"], rel=1e-4)  # the file has other reflectors
    assert spatial.said("validate calibrated.toml data.csv --refit none")["rms_mm"] < 0.05


@pytest.mark.parametrize("name", ["top", "side"])
def test_a_reflector_that_is_not_measured_again_stays(spatial: Folder, name: str) -> None:
    """Where it is, what it may be off by, and which of them commands are of; a new one is not held where nothing is."""
    spatial.said(IDENTIFY)
    header, *rows = spatial.read("data.csv").splitlines()
    some = "\n".join([header, *(row for row in rows if f",{name}" in row)])
    for file, text in (("again.csv", some), ("new.csv", some.replace(f",{name}", ",new"))):
        spatial.write(file, f"{text}\n")
    spatial.refused("identify calibrated.toml new.csv --only joint_offset:3,base", "tool new", "with tool")
    for file, words in (("again.csv", "tool"), ("new.csv", "tool"), ("new.csv", "tool[new]")):
        fit = f"identify calibrated.toml {file} --only joint_offset:3,base,{words} --out out.toml --force"
        found = {row["name"] for row in spatial.said(fit)["parameters"]}
        measured = file.removesuffix(".csv").replace("again", name)
        assert {each.split(".")[0] for each in found} == {"joint_offset:3", "base", f"tool[{measured}]"}
        before, after = (load_arm(spatial.path / f"{one}.toml").calibration for one in ("calibrated", "out"))
        assert [*after.tools][:2] == [*before.tools] == ["top", "side"]
        for other in {"top", "side"} - {measured}:
            np.testing.assert_allclose(after.tools[other], before.tools[other], atol=1e-9)
            assert f"tool[{other}].x" in after.parameter_names


def test_a_drawing_in_denavit_hartenberg_numbers_gets_them_corrected(folder: Folder) -> None:
    """Of a real robot: 18 numbers beside base and tool, in 80 columns, the same in JSON."""
    rows = (DATA / "ur10/series_C.csv").read_text().splitlines()
    folder.write("some.csv", "\n".join([rows[0], *rows[1::4]]) + "\n")
    folder.write("ur10.toml", (DATA / "ur10/ur10.toml").read_text())
    shown = folder.armcal("identify ur10.toml some.csv").out
    said = folder.said("identify ur10.toml some.csv --out calibrated.toml")
    lengths = {row["name"]: row["corrected"] for row in said["dh_table"]}
    assert len(lengths) == 18
    assert {name for name in lengths if name.endswith("beta")} == {"row 2 beta", "row 3 beta"}
    assert not {"row 2 d", "row 3 d"} & {*lengths}
    corrections, _, rest = shown.partition("Corrected Denavit-Hartenberg table")[2].partition("base: ")
    assert all(f" {name} " in corrections for name in lengths)
    assert "tool 1: x [mm]" in rest
    folder.write("geared.toml", f'{folder.read("ur10.toml")}\n[[effects]]\nname = "gear_ratio"\njoint = 3\n')
    assert " gear_ratio:3." in folder.armcal("identify geared.toml some.csv").out  # for which the table has no place
    assert lengths["row 2 a"] == pytest.approx(-612.8, abs=0.5)  # of all rows -612.82 with 0.11
    folder.said("report calibrated.toml --out page.html")
    assert all(name in folder.read("page.html") for name in (*lengths, *said["dh_places"]))


def test_commands_for_the_real_arm(spatial: Folder) -> None:
    """Commands for the calibrated arm bring the true one where the drawing would be, as far as noise lets it."""
    spatial.said(IDENTIFY)
    found = spatial.said("compensate calibrated.toml plan.csv --out commands.csv")
    assert found["collisions_checked"] is False
    assert found["reached"] >= 38  # at the limits of the joints some are out of reach
    rows = pl.read_csv(spatial.path / "commands.csv")
    assert rows.columns[:11] == [*JOINTS, "x_mm", "y_mm", "z_mm", "error_mm", "reachable"]
    commands = rows.select(JOINTS).to_numpy().astype(float)
    commands[:, 1:] = np.radians(commands[:, 1:])
    reached = rows["error_mm"].to_numpy() < 1e-6
    left = (
        Model(load_arm(spatial.path / "truth.toml")).position(commands) - rows.select("x_mm", "y_mm", "z_mm").to_numpy()
    )
    assert rms_distance(left[reached]) < 0.06
    assert np.array_equal(~reached, np.isnan(commands).all(axis=1))  # no controller is fed with what misses its target
    shown = spatial.armcal("compensate calibrated.toml plan.csv").out
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
    fewer = np.sqrt((1.0 + 2.0 * p / 3.0 / len(data)) / (1.0 + 2.0 * p / 3.0 / rows))
    assert np.mean(left) < bar * fewer * (1 + spread)


def test_weights_and_the_plan_beside_them_are_of_as_many_runs(spatial: Folder) -> None:
    """What a prior is worth per run depends on the runs; without one they are as many as the parameters."""
    spatial.write(
        "one.toml", 'kind = "spatial"\n[tool]\nx_mm = 10.0\n[[dh]]\na_mm = 300.0\nalpha_deg = 0.0\nd_mm = 100.0\n'
    )
    assert spatial.said("relax one.toml --grid 9")["cross_check"][-1]["space"] == "6 runs"
    checked = spatial.armcal("relax arm.toml --candidates plan.csv --seconds 1 --json").data
    assert checked["cross_check"][-1]["space"] == f"{checked['runs']} runs"
    assert ", 25 runs, " in spatial.armcal("relax arm.toml --candidates plan.csv --runs 25 --no-check").flat


def test_every_plan_in_space_says_that_collisions_were_not_looked_at(spatial: Folder) -> None:
    """In JSON, and once in words; no plan in the plane does."""
    weights = "relax arm.toml --candidates plan.csv --runs 20 --no-check"
    assert spatial.said(weights)["collisions_checked"] is False
    assert spatial.armcal(weights).flat.count(COLLISIONS) == 1
    write = "program arm.toml plan.csv --robot ros --out p --force"
    for verb in ("check arm.toml plan.csv", "check arm.toml data.csv", write):
        assert spatial.said(verb)["collisions_checked"] is False
        assert COLLISIONS in spatial.armcal(verb).flat
    with pytest.warns(UserWarning, match="beside the last axis is assumed"):
        problem = DesignProblem.of(Model(load_arm(spatial.path / "arm.toml")))
    assert with_collisions(Answer({}), problem).document.parts == [COLLISIONS]  # what all call
    spatial.write("floor.toml", spatial.read("arm.toml") + "[cell]\nfloor_z_mm = 0.0\n")
    assert f"{COLLISIONS} The floor of [cell] was not" in spatial.armcal("check floor.toml plan.csv").flat
    spatial.said("report arm.toml plan.csv --out page.html")
    assert COLLISIONS in spatial.read("page.html")
    spatial.write("planar.toml", PLANAR)
    assert "collisions_checked" not in spatial.said("design planar.toml --runs 20")
