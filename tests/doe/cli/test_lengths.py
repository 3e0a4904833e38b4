"""A ball bar and touch probes from the command line: the whole loop, and what is refused, in one line each."""

import numpy as np
import pytest

from identification import Plan
from tests.doe.cli.conftest import Folder
from tests.identification.exponentials import TABLE

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
TOOL = "[tool]\nx_mm = 50.0\ny_mm = 20.0\nz_mm = 80.0\n"
VALUES = """
[calibration.values]
"joint_offset:2" = 0.2
"translation_x:3" = -0.7
"translation_x:4" = 0.5
"rotation_x:3" = 0.1
"rotation_y:4" = -0.1
"""
TRUTH = TOOL + VALUES + '"base.x" = 9.0\n'
ECCENTRIC = '[[effects]]\nname = "encoder_eccentricity"\njoint = 3\na_deg = 0.05\nb_deg = 0.04\n'


@pytest.fixture
def cell(folder: Folder) -> Folder:
    """With arm.toml of a ball bar, truth.toml, and plan.csv and fresh.csv of 120 random postures each."""
    folder.write("arm.toml", SIX + BAR)
    folder.write("truth.toml", SIX + BAR + TRUTH)
    generator = np.random.default_rng(1)
    for name in ("plan", "fresh"):
        folder.write(f"{name}.csv", Plan(generator.uniform(-2.0, 2.0, (120, 6))).text())
    return folder


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Postures to choose from: hundreds in place of thousands."""
    monkeypatch.setattr("identification.for_design.CHOICES", 150)


def test_the_loop_of_a_ball_bar(cell: Folder) -> None:
    """From a plan to commands: what is left is the noise, the tip is known to that, the center is found."""
    for name, seed in (("plan", 1), ("fresh", 2)):
        cell.simulated(f"{name}_data.csv", seed, plan=f"{name}.csv")
    assert cell.read("plan_data.csv").startswith("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,distance_mm")
    assert cell.said("check arm.toml plan_data.csv")["ok"]
    found = cell.said("identify arm.toml plan_data.csv --out calibrated.toml")
    assert found["rms_after_mm"] < 0.012 < 0.3 < found["rms_before_mm"]
    assert found["expected_tip_mm"] < 0.02
    names = [row["name"] for row in found["parameters"]]
    assert len(names) == 36
    assert [name for name in names if name.startswith("base")] == ["base.x", "base.y", "base.z"]
    assert not [row for row in found["corrected_values"] if row["name"].startswith("base r")]
    assert cell.said("validate calibrated.toml fresh_data.csv --refit none")["rms_mm"] < 0.016
    cell.write("targets.csv", "x_mm,y_mm,z_mm\n500,300,300\n-400,300,300\n")
    assert cell.said("compensate calibrated.toml targets.csv")["reached"] == 2
    cell.said("report arm.toml calibrated.toml fresh_data.csv --out page.html")


# -- contacts ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("few")
def test_a_plan_of_contacts(cell: Folder) -> None:
    """Chosen from postures that touch, with a bound over these; what needs free postures is refused in one line."""
    place = "radius_mm = 30.0\ncenter_mm = [600.0, -200.0, 300.0]\n[tool]\nx_mm = 60.0\nz_mm = 80.0\n"
    cell.write("ball.toml", SIX + 'kind = "sphere"\n' + place)
    found = cell.armcal("design ball.toml --runs 30 --starts 1 --out best.csv --json")
    assert found.code == 0, found.err
    assert "random postures that touch the sphere by the best known model, and bounds hold for these" in found.err
    scored = cell.said("score ball.toml best.csv")
    assert scored["log_det"] == pytest.approx(found.data["log_det"], abs=1e-6)
    assert scored["efficiency"] is None or 0.5 < scored["efficiency"] <= 1.0
    assert "outside_limits" in cell.said("check ball.toml best.csv")
    cell.write("touched.csv", "".join(line.partition(",")[2] for line in cell.read("best.csv").splitlines(True)))
    assert cell.said("check ball.toml touched.csv")["rows"] == 30  # joints at contacts without their run
    assert "ends in contact" in cell.armcal("program ball.toml best.csv --robot ur --out best.script").out
    cell.refused("compare ball.toml --runs 30", "instrument: found kind sphere")
    cell.refused("simulate ball.toml best.csv --truth ball.toml --out m.csv", "instrument: found kind sphere")
    cell.refused("relax ball.toml --runs 30 --grid 5", "--grid: found with a list of postures")
    assert "arm.toml: no [tool]: " in cell.armcal("simulate arm.toml best.csv --truth arm.toml --out m.csv").err


# -- sockets -----------------------------------------------------------------------------------------------------------
SOCKET = f"""\
kind = "socket"
distances_mm = [["A", "B", 360.5]]
[instrument.cups]
A = [480.0, -200.0, 150.0]
B = [480.0, 160.5, 150.0]
C = [250.0, 450.0, 350.0]
D = [350.0, -380.0, 380.0]
{TOOL}"""


@pytest.mark.usefixtures("few")
def test_the_loop_of_a_socket(folder: Folder) -> None:
    """Plan, simulated seatings, checks, fit, diagnosis: nothing but joints and the names of cups is measured, and where
    cups and ball are nobody says."""
    folder.write("arm.toml", SIX + SOCKET)
    folder.write("truth.toml", SIX + SOCKET + VALUES + ECCENTRIC)
    folder.write("blank.toml", SIX + 'kind = "socket"\ndistances_mm = [["A", "B", 360.5]]\n')
    done = folder.armcal("design arm.toml --runs 100 --starts 1 --out seats.csv")
    assert done.code == 0, done.err
    (row,) = (line.split() for line in done.out.splitlines() if line.split()[:1] == ["1"] and len(line.split()) > 7)
    head, *lines = folder.read("seats.csv").splitlines(True)
    assert row[7] == lines[0].strip().split(",")[-1]  # the cup stands in the table
    for name, seed, some in (("seats", 1, lines[:60]), ("fresh", 2, lines[60:])):
        folder.write(f"{name}.csv", "".join([head, *some]))
        folder.simulated(f"{name}d.csv", seed, plan=f"{name}.csv")
    planned, (header, *rows) = (folder.read(name).splitlines() for name in ("seats.csv", "seatsd.csv"))
    cups = [line.split(",")[-1] for line in rows]
    assert [line.split(",")[-1] for line in planned] == ["cup", *cups]  # the cup of each
    assert (header.split(",")[-1], {*cups} <= {*"ABCD"}, "mm" in header) == ("cup", True, False)
    folder.said("relax arm.toml --runs 40 --no-check --out weights.csv")
    assert ",cup,weight" in folder.read("weights.csv").splitlines()[0]
    checked = folder.said("check blank.toml seatsd.csv")
    assert (sorted(checked["markers"]), "cup" in checked["given"]) == ([*"ABCD"], True)
    assert not {"marker", "session"} & {*checked["given"]}  # columns of the file, by their names
    fit = folder.said("identify blank.toml seatsd.csv")
    assert not [entry for entry in fit["parameters"] if entry["name"].startswith("base")]
    assert fit["expected_tip_mm"] < 1.0  # no tens of millimetres of a turn that nothing shows
    found = folder.said("diagnose blank.toml seatsd.csv --holdout freshd.csv --out extended.toml")
    assert found["effects"] == ["encoder_eccentricity:3"]
    assert found["gap"]["held_out_after_mm"] < 0.04  # 0.017 of noise in three coordinates
    assert "cup" not in folder.read("extended.toml").partition("[calibration]")[2]
    folder.refused("validate extended.toml freshd.csv --refit none", "no calibrated file says where each cup is")
    again = folder.said("validate extended.toml freshd.csv")
    assert again["rms_mm"] < 0.03 < 0.5 < again["rms_nominal_mm"]
    folder.said("report arm.toml extended.toml freshd.csv --out page.html")
