"""A ball bar and a touch probe from the command line: the whole loop, and what is refused, in one line each."""

from __future__ import annotations

import numpy as np
import pytest

from tests.doe.cli.conftest import Folder
from tests.identification.exponentials import TABLE, Exponentials
from tests.identification.touching import sphere, touching

ROWS = "".join(f"[[dh]]\na_mm = {a}\nalpha_deg = {np.degrees(alpha)}\nd_mm = {d}\n" for a, alpha, d in TABLE)
SIX = f"""\
name = "six"
kind = "spatial"

[measurement]
sigma_mm = 0.01

[joint_limits_deg]
lower = [-120, -120, -120, -120, -120, -120]
upper = [120, 120, 120, 120, 120, 120]

{ROWS}
[instrument]
"""
BAR = 'kind = "distance"\ncenter_mm = [600.0, -200.0, 300.0]\n'
TRUTH = """
[tool]
x_mm = 50.0
y_mm = 20.0
z_mm = 80.0

[calibration.values]
"base.x" = 9.0
"joint_offset:2" = 0.2
"translation_x:3" = -0.7
"translation_x:4" = 0.5
"rotation_x:3" = 0.1
"rotation_y:4" = -0.1
"""


def table(postures: np.ndarray, **columns: list[str]) -> str:
    names = [f"q{j}_deg" for j in range(1, 7)]
    rows = zip(*(column.tolist() for column in np.degrees(postures).T), *columns.values(), strict=True)
    return "\n".join([",".join([*names, *columns]), *(",".join(map(str, row)) for row in rows)]) + "\n"


@pytest.fixture
def cell(folder: Folder) -> Folder:
    """With arm.toml of a ball bar, truth.toml, and plan.csv and fresh.csv of 120 random postures each."""
    folder.write("arm.toml", SIX + BAR)
    folder.write("truth.toml", SIX + BAR + TRUTH)
    generator = np.random.default_rng(1)
    for name in ("plan", "fresh"):
        postures = generator.uniform(-2.0, 2.0, (120, 6))
        folder.write(f"{name}.csv", table(postures, run=[str(k + 1) for k in range(120)]))
    return folder


def done(folder: Folder, *words: str) -> dict:
    found = folder.armcal(*words, "--json")
    assert found.code == 0, found.err
    return found.data


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Postures to choose from: hundreds in place of thousands."""
    monkeypatch.setattr("identification.for_design.CHOICES", 150)


def test_the_loop_of_a_ball_bar(cell: Folder) -> None:
    """From a plan to commands: what is left is the noise, the tip is known to that, the center is found."""
    for name, seed in (("plan", "1"), ("fresh", "2")):
        out = f"{name}_data.csv"
        done(cell, "simulate", "arm.toml", f"{name}.csv", "--truth", "truth.toml", "--out", out, "--seed", seed)
    assert (
        cell.read("plan_data.csv").splitlines()[0].startswith("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,distance_mm")
    )
    checked = done(cell, "check", "arm.toml", "plan_data.csv")
    assert checked["ok"]
    found = done(cell, "identify", "arm.toml", "plan_data.csv", "--out", "calibrated.toml")
    assert found["rms_after_mm"] < 0.012 < 0.3 < found["rms_before_mm"]
    assert found["expected_tip_mm"] < 0.02
    names = [row["name"] for row in found["parameters"]]
    assert len(names) == 36
    assert [name for name in names if name.startswith("base")] == ["base.x", "base.y", "base.z"]
    assert not [row for row in found["corrected_values"] if row["name"].startswith("base r")]
    judged = done(cell, "validate", "calibrated.toml", "fresh_data.csv", "--refit", "none")
    assert judged["rms_mm"] < 0.016
    assert {block["kind"] for block in judged["blocks"]} >= {"time", "workspace"}
    cell.write("targets.csv", "x_mm,y_mm,z_mm\n500,300,300\n-400,300,300\n")
    assert done(cell, "compensate", "calibrated.toml", "targets.csv")["reached"] == 2
    said = cell.armcal("report", "arm.toml", "calibrated.toml", "fresh_data.csv", "--out", "page.html")
    assert said.code == 0, said.err


def test_a_bar_that_is_longer_than_its_file_says(cell: Folder) -> None:
    """`check` offers the effect, with which nothing speaks against the data, and `identify` gives the length."""
    cell.write("truth.toml", SIX + BAR + TRUTH + '[[effects]]\nname = "length_offset"\nc_mm = 0.5\n')
    done(cell, "simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", "data.csv")
    (said,) = done(cell, "check", "arm.toml", "data.csv")["problems"]
    assert said.startswith("all distances look 0.")
    assert said.endswith('add [[effects]] name = "length_offset"')
    cell.write("arm.toml", SIX + BAR + '[[effects]]\nname = "length_offset"\n')
    assert done(cell, "check", "arm.toml", "data.csv")["problems"] == []
    found = done(cell, "identify", "arm.toml", "data.csv", "--out", "calibrated.toml")
    (row,) = [row for row in found["parameters"] if row["name"] == "length_offset.c"]
    assert row["low_95"] - row["std"] < 0.5 < row["high_95"] + row["std"]
    cell.write("targets.csv", "x_mm,y_mm,z_mm\n500,300,300\n")
    assert done(cell, "compensate", "calibrated.toml", "targets.csv")["reached"] == 1
    cell.write("tracker.toml", SIX.replace("[instrument]\n", "") + '[[effects]]\nname = "length_offset"\n')
    refused = cell.armcal("check", "tracker.toml", "data.csv")
    assert refused.code == 2
    assert "length_offset needs measured distances, found no [instrument] table, allowed: kind distance" in refused.err


def test_contacts(cell: Folder) -> None:
    """With a ball of 30 mm: joints alone say the arm; a plan cannot be made."""
    generator = np.random.default_rng(5)
    truth, back = Exponentials(generator), [str(k % 2) for k in range(160)]
    q = np.concatenate(
        [touching(truth, sphere(np.array(c), 30.0), 80, generator) for c in ([600.0, -200, 300], [-300.0, 500, 400])]
    )
    cell.write("ball.toml", SIX + 'kind = "sphere"\nradius_mm = 30.0\n')
    cell.write("data.csv", table(q, surface=[f"ball {k}" for k in sorted(back)]))
    found = done(cell, "identify", "ball.toml", "data.csv", "--out", "calibrated.toml")
    assert found["rms_after_mm"] < 0.01
    assert found["rms_before_mm"] > 0.3
    assert done(cell, "check", "ball.toml", "data.csv")["sessions"] == ["ball 0", "ball 1"]
    assert done(cell, "validate", "calibrated.toml", "data.csv")["rms_mm"] < 0.01
    for words in (
        ("design", "ball.toml", "--runs", "30"),
        ("score", "ball.toml", "plan.csv"),
        ("advise", "ball.toml"),
        ("relax", "ball.toml"),
        ("compare", "ball.toml", "--runs", "30"),
        ("simulate", "ball.toml", "plan.csv", "--truth", "ball.toml", "--out", "more.csv"),
    ):
        refused = cell.armcal(*words)
        assert refused.code == 2, (words, refused.out, refused.err)
        assert "instrument: found kind sphere" in refused.err
        assert refused.err.count("\n") == 1


def test_contacts_with_a_ball_that_nobody_measured(cell: Folder) -> None:
    """The radius is left out of the file, found, written, used, and found anew for another ball."""
    generator = np.random.default_rng(5)
    truth, center = Exponentials(generator), np.array([600.0, -200.0, 300.0])
    for name, radius in (("data", 30.0), ("other", 20.0)):
        cell.write(f"{name}.csv", table(touching(truth, sphere(center, radius), 80, generator)))
    cell.write("ball.toml", SIX + 'kind = "sphere"\n')
    assert done(cell, "check", "ball.toml", "data.csv")["rms_fitted_mm"] < 0.01
    found = done(cell, "identify", "ball.toml", "data.csv", "--out", "calibrated.toml")
    (row,) = [row for row in found["parameters"] if row["name"] == "sphere.radius"]
    assert row["unit"] == "mm"
    assert row["value"] == pytest.approx(30.0, abs=3.0 * row["std"])
    (shown,) = [one for one in found["corrected_values"] if one["name"] == "sphere radius"]
    assert shown["corrected"] == row["value"]
    assert "sphere radius [mm]: " in cell.armcal("identify", "ball.toml", "data.csv").out
    assert done(cell, "validate", "calibrated.toml", "data.csv", "--refit", "none")["rms_mm"] < 0.01
    other = done(cell, "validate", "calibrated.toml", "other.csv")
    assert other["rms_mm"] < 0.01 < 0.3 < other["rms_nominal_mm"]
    (radius,) = [one["value"] for one in other["refitted"] if one["name"] == "sphere.radius"]
    assert radius == pytest.approx(20.0 * row["value"] / 30.0, abs=1e-3)  # the size of the arm is as it was found
    refused = cell.armcal("identify", "ball.toml", "data.csv", "--parameters", "minimal")
    assert refused.code == 2
    assert "minimal for contacts with spheres of unknown radius, which leave the size of the arm open" in refused.err
    refused = cell.armcal("design", "ball.toml", "--runs", "30")
    assert refused.code == 2
    assert refused.err.count("\n") == 1


@pytest.mark.usefixtures("few")
def test_a_plan_of_contacts(cell: Folder) -> None:
    """Chosen from postures that touch, with a bound over these; what needs free postures is refused in one line."""
    center = "radius_mm = 30.0\ncenter_mm = [600.0, -200.0, 300.0]\n[tool]\nx_mm = 60.0\nz_mm = 80.0\n"
    cell.write("ball.toml", SIX + 'kind = "sphere"\n' + center)
    found = cell.armcal("design", "ball.toml", "--runs", "30", "--starts", "1", "--out", "best.csv", "--json")
    assert found.code == 0, found.err
    assert "random postures that touch the sphere as the arm is best known, and bounds are over these" in found.err
    scored = done(cell, "score", "ball.toml", "best.csv")
    assert scored["log_det"] == pytest.approx(found.data["log_det"], abs=1e-6)
    assert scored["efficiency"] is None or 0.5 < scored["efficiency"] <= 1.0
    for words in (
        ("compare", "ball.toml", "--runs", "30"),
        ("simulate", "ball.toml", "best.csv", "--truth", "ball.toml", "--out", "more.csv"),
    ):
        refused = cell.armcal(*words)
        assert refused.code == 2
        assert "instrument: found kind sphere" in refused.err
    refused = cell.armcal("relax", "ball.toml", "--runs", "30", "--grid", "5")
    assert refused.code == 2
    assert "--grid: found for contacts" in refused.err


def test_distances_that_show_no_parameter(folder: Folder) -> None:
    """A thousand times the reach, around a single joint (found by the fuzz): said, not a traceback."""
    joint = '<joint name="j" type="revolute"><origin xyz="0.1 0 0.3"/><parent link="a"/><child link="b"/>{}</joint>'
    joint = joint.format('<axis xyz="1 0 0"/><limit lower="-1.7" upper="1.7"/>')
    folder.write("one.urdf", f'<robot name="r"><link name="a"/><link name="b"/>{joint}</robot>')
    arm = 'urdf = "one.urdf"\nbase_link = "a"\ntip_link = "b"\n[tool]\nx_mm = 50.0\n[measurement]\nsigma_mm = 0.1\n'
    folder.write("arm.toml", f'kind = "spatial"\n{arm}[instrument]\nkind = "distance"\ncenter_mm = [0.0, 0.0, 0.0]\n')
    far = [2581152, 2346667, 1622304, 1590233, 1852694, 1564368, 960987, 1697986]
    rows = [f"{q},{length}" for q, length in zip([76, -78, 86, -63, 55, -86, 11, -52], far, strict=True)]
    folder.write("data.csv", "\n".join(["q1_deg,distance_mm", *rows]) + "\n")
    assert folder.armcal("check", "arm.toml", "data.csv").code in (0, 1)
    said = folder.armcal("identify", "arm.toml", "data.csv")
    assert said.code == 1
    assert "not estimable separately" in said.out
    refused = folder.armcal("diagnose", "arm.toml", "data.csv")
    assert refused.code == 2
    assert "no parameter of the arm follows from these rows, allowed: " in refused.err


SOCKET = """\
kind = "socket"
distances_mm = [["A", "B", 360.5]]
[instrument.cups]
A = [480.0, -200.0, 150.0]
B = [480.0, 160.5, 150.0]
C = [250.0, 450.0, 350.0]
D = [350.0, -380.0, 380.0]
[tool]
x_mm = 50.0
y_mm = 20.0
z_mm = 80.0
"""
ECCENTRIC = '[[effects]]\nname = "encoder_eccentricity"\njoint = 3\na_deg = 0.05\nb_deg = 0.04\n'


@pytest.mark.usefixtures("few")
def test_the_loop_of_a_socket(folder: Folder) -> None:
    """Plan, simulated seatings, checks, fit, diagnosis: nothing but joints and the names of cups is measured, and where
    cups and ball are nobody says."""
    truth = TRUTH.partition("[calibration.values]")[2].replace('"base.x" = 9.0\n', "")
    folder.write("arm.toml", SIX + SOCKET)
    folder.write("truth.toml", SIX + SOCKET + "[calibration.values]" + truth + ECCENTRIC)
    folder.write("blank.toml", SIX + 'kind = "socket"\ndistances_mm = [["A", "B", 360.5]]\n')
    for runs, seed, name in (("60", "1", "seats"), ("40", "2", "fresh")):
        few = "--starts", "1", "--seed", seed
        plan = folder.armcal("design", "arm.toml", "--runs", runs, *few, "--out", f"{name}.csv")
        assert plan.code == 0, plan.err
        words = "arm.toml", f"{name}.csv", "--truth", "truth.toml", "--seed", seed, "--out", f"{name}d.csv"
        done = folder.armcal("simulate", *words)
        assert done.code == 0, done.err
    planned = (folder.path / "seats.csv").read_text().splitlines()
    seated = (folder.path / "seatsd.csv").read_text().splitlines()
    assert [line.split(",")[-1] for line in planned] == [line.split(",")[-1] for line in seated]  # the cup of each
    header, first = (folder.path / "seatsd.csv").read_text().splitlines()[:2]
    assert header.split(",")[-1] == "cup"
    assert first.split(",")[-1] in "ABCD"
    assert "mm" not in header
    checked = folder.armcal("check", "blank.toml", "seatsd.csv", "--json")
    assert checked.code == 0, checked.err
    assert sorted(checked.data["markers"]) == [*"ABCD"]
    fit = folder.armcal("identify", "blank.toml", "seatsd.csv", "--json")
    assert fit.code == 0, fit.err
    assert not [entry for entry in fit.data["parameters"] if entry["name"].startswith("base")]
    assert fit.data["expected_tip_mm"] < 1.0  # no tens of millimetres of a turn that nothing shows
    folder.write("misspelt.toml", SIX + 'kind = "socket"\ndistances_mm = [["A", "b", 360.5]]\n')
    sized = folder.armcal("identify", "misspelt.toml", "seatsd.csv", "--json")
    assert "cups without a distance that is known fit an arm of any size" in " ".join(sized.data["warnings"])
    found = folder.armcal(
        "diagnose", "blank.toml", "seatsd.csv", "--holdout", "freshd.csv", "--out", "extended.toml", "--json"
    )
    assert found.code == 0, found.err
    assert found.data["effects"] == ["encoder_eccentricity:3"]
    assert found.data["gap"]["held_out_after_mm"] < 0.04  # 0.017 of noise in three coordinates
    assert "cup" not in (folder.path / "extended.toml").read_text().partition("[calibration]")[2]
    again = folder.armcal("validate", "extended.toml", "freshd.csv", "--json")
    assert again.code == 0, again.err
    assert again.data["rms_mm"] < 0.03 < 0.5 < again.data["rms_nominal_mm"]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            'kind = "socket"\ncenter_mm = [1.0, 2.0, 3.0]\n',
            "instrument.center_mm: found for kind socket, allowed: for distance, plane, sphere",
        ),
        (
            'kind = "plane"\ncups = {A = [1.0, 2.0, 3.0]}\n',
            "instrument.cups: found for kind plane, allowed: for socket",
        ),
        ('kind = "socket"\ncups = {A = [1.0, 2.0]}\n', "allowed: three numbers"),
        (
            'kind = "socket"\ndistances_mm = [["A", 3.0]]\n',
            "instrument.distances_mm[1][2]: found 3.0, allowed: a string",
        ),
        ('kind = "socket"\n[base]\nx_mm = 3.0\n', "base: found with an [instrument] of kind socket, allowed: left out"),
    ],
)
def test_wrong_sockets(folder: Folder, lines: str, said: str) -> None:
    folder.write("arm.toml", SIX + lines)
    folder.write("plan.csv", table(np.zeros((2, 6)), run=["1", "2"]))
    refused = folder.armcal("score", "arm.toml", "plan.csv")
    assert refused.code == 2
    assert said in refused.err
    assert refused.err.count("\n") == 1


def test_sockets_without_cups_have_no_plan(folder: Folder) -> None:
    folder.write("arm.toml", SIX + 'kind = "socket"\n')
    folder.write("plan.csv", table(np.zeros((2, 6)), run=["1", "2"]))
    refused = folder.armcal("design", "arm.toml", "--runs", "60")
    assert refused.code == 2
    assert "kind socket without cups: where it is touched is not known, allowed for plans: with cups" in refused.err
    refused = folder.armcal("simulate", "arm.toml", "plan.csv", "--truth", "arm.toml", "--out", "data.csv")
    assert refused.code == 2
    assert "instrument: found none of cups" in refused.err


def test_the_loop_of_a_bar_beside_a_planar_arm(folder: Folder) -> None:
    """Plan, simulated distances, fit, diagnosis, commands: where the center is nobody says."""
    limits = "[joint_limits_deg]\nlower = [-150, -140, -140]\nupper = [150, 140, 140]\n"
    arm = f"links_mm = [300.0, 250.0, 150.0]\n{limits}[measurement]\nsigma_mm = 0.02\n"
    arm += '[instrument]\nkind = "distance"\n'
    known = "[calibration]\nlength_errors_mm = [1.2, -0.7, 0.4]\njoint_offsets_deg = [0.0, 0.2, -0.3]\n"
    folder.write("arm.toml", f"{arm}center_mm = [400.0, 300.0]\n")
    folder.write("blank.toml", arm)
    folder.write("truth.toml", f"{arm}center_mm = [400.0, 300.0]\n{known}{ECCENTRIC.replace('joint = 3', 'joint = 2')}")
    plan = folder.armcal("design", "arm.toml", "--runs", "60", "--starts", "1", "--out", "seats.csv", "--json")
    assert plan.code == 0, plan.err
    assert plan.data["efficiency"] <= 1.0 + 1e-9
    words = "arm.toml", "seats.csv", "--truth", "truth.toml", "--seed", "1", "--out", "data.csv"
    assert folder.armcal("simulate", *words).code == 0
    assert "distance_mm" in (folder.path / "data.csv").read_text()
    assert folder.armcal("check", "blank.toml", "data.csv").code == 0
    fit = folder.armcal("identify", "blank.toml", "data.csv", "--out", "geometry.toml", "--json")
    assert fit.code == 0, fit.err
    names = [entry["name"] for entry in fit.data["parameters"]]
    assert {"center[1].x", "center[1].y"} < set(names)
    assert "joint_offset:1" not in names
    found = folder.armcal("diagnose", "blank.toml", "data.csv", "--out", "extended.toml", "--json")
    assert found.code == 0, found.err
    assert found.data["effects"] == ["encoder_eccentricity:2"]
    folder.write("targets.csv", "x_mm,y_mm\n300,200\n-100,400\n")
    done = folder.armcal("compensate", "extended.toml", "targets.csv", "--json")
    assert done.code == 0, done.err
    assert done.data["reached"] == 2
