"""`armcal program`: from a plan to a program, what it says of it, and what it refuses."""

from __future__ import annotations

import warnings

import numpy as np

from identification import Plan, load_measurements
from tests.doe.cli.conftest import Folder
from tests.doe.program.test_program import read_fanuc


def test_from_the_command_line(folder: Folder) -> None:
    postures = np.random.default_rng(5).uniform(-50.0, 50.0, (4, 4)).round(3)
    firsts = ("1,measure,", ",via,", "2,measure,", "3,measure,")
    rows = "".join(f"{first}{','.join(map(str, q))}\n" for first, q in zip(firsts, postures, strict=True))
    folder.write("plan.csv", "run,kind,q1_deg,q2_deg,q3_deg,q4_deg\n" + rows)
    done = folder.armcal("program arm.toml plan.csv --robot fanuc --speed 15 --settle 3 --out cell_7.ls")
    assert (done.code, done.err) == (0, "")
    text = folder.read("cell_7.ls")
    assert text.startswith("/PROG  CELL_7\n")
    np.testing.assert_allclose(read_fanuc(text)[0], postures, rtol=0.0, atol=1e-9)
    assert "3 runs and 1 way-point," in done.flat
    for value in postures.ravel():  # the dry run
        assert f"{value:.3f}" in done.out
    data = folder.said("program arm.toml plan.csv --robot kuka --out cell_7.src")
    assert [move["kind"] for move in data["moves"]] == ["measure", "via", "measure", "measure"]
    assert [move["run"] for move in data["moves"]] == [1, None, 2, 3]
    np.testing.assert_allclose([move["joints"] for move in data["moves"]], postures, rtol=0.0, atol=1e-9)


def test_what_the_command_refuses(folder: Folder) -> None:
    folder.refused("program arm.toml plan.csv --robot ur --out p.script", "--robot ur: 4 joints, allowed: 6")
    folder.refused("program arm.toml plan.csv --robot kuka --out p.src --settle 1e3", "--settle: 1000 s")
    folder.refused("program arm.toml plan.csv --robot kuka --out p.src --template gone.j2", "gone.j2: cannot be read")
    folder.write("mine.j2", "{{ nothing }}")
    folder.refused("program arm.toml plan.csv --robot kuka --out p.src --template mine.j2", "mine.j2: 'nothing' is")
    folder.write("weights.csv", "q1_deg,q2_deg,q3_deg,q4_deg,weight\n0,0,0,0,0.5\n9,9,9,9,0.5\n")
    folder.refused("program arm.toml weights.csv --robot kuka --out p.src", "found weights")


def test_a_row_that_breaks_a_constraint_and_a_way_point_that_is_not_seen(folder: Folder) -> None:
    """A way-point may be out of sight, but not inside an obstacle."""
    arm = "links_mm = [300.0, 200.0]\n[[constraints]]\n"
    sight = 'kind = "line_of_sight"\ntracker_mm = [2000.0, 0.0]\nhalf_angle_deg = 8.0\ntoward_mm = [0.0, 0.0]\n'
    circle = 'kind = "keep_out_circle"\ncenter_mm = [0.0, 400.0]\nradius_mm = 60.0\n'
    folder.write("plan.csv", "run,kind,q1_deg,q2_deg\n1,measure,10,5\n,via,90,0\n2,measure,-10,-5\n")
    folder.write("arm.toml", arm + sight)
    assert folder.said("program arm.toml plan.csv --robot kuka --out plan.src")["vias"] == 1
    folder.write("arm.toml", arm + circle)
    folder.refused("program arm.toml plan.csv --robot kuka --out new.src", "plan.csv: row 2: breaks", "keep_out_circle")


def with_vias(text: str, generator: np.random.Generator) -> str:
    """A table with the column `kind`, and before each row a way-point, of which all but the joints is empty."""
    header, *rows = text.splitlines()
    columns = header.split(",")
    lines = [f"{header},kind"]
    for row in rows:
        angles = generator.uniform(-50.0, 50.0, 4).round(3)
        cells = [f"{next_angle}" for next_angle in angles]
        lines.append(",".join([cells.pop(0) if name.startswith("q") else "" for name in columns]) + ",via")
        lines.append(f"{row},measure")
    return "\n".join(lines) + "\n"


def test_way_points_change_nothing_in_a_plan_or_in_measurements(folder: Folder) -> None:
    """Plans, measurements and kept postures are read as without them, and nothing is said of them."""
    generator = np.random.default_rng(8)
    folder.simulated()
    for name in ("plan", "data"):
        folder.write(f"{name}_vias.csv", with_vias(folder.read(f"{name}.csv"), generator))
        for carried_out in (False, True):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore" if (name, carried_out) == ("data", False) else "error")
                files = [Plan.load(f"{each}.csv", 4, carried_out=carried_out) for each in (name, f"{name}_vias")]
            np.testing.assert_array_equal(files[0].postures, files[1].postures)
            assert [file.via for file in files] == [None, None]
    whole = Plan.load("plan_vias.csv", 4, vias=True)
    assert [*whole.via] == [True, False] * 12
    np.testing.assert_array_equal(whole.postures[1::2], files[0].postures)
    one, other = (load_measurements(name, 4) for name in ("data.csv", "data_vias.csv"))
    assert one.postures.tolist() == other.postures.tolist()
    assert one.positions.tolist() == other.positions.tolist()
    done = folder.armcal("simulate arm.toml plan_vias.csv --truth truth.toml --out again.csv")
    assert (done.code, done.err) == (0, "")
    assert folder.read("again.csv") == folder.read("data.csv")


def test_only_way_points_and_rows_that_are_neither(folder: Folder) -> None:
    folder.write("plan.csv", "kind,q1_deg,q2_deg,q3_deg,q4_deg\nvia,0,0,0,0\n")
    folder.refused("score arm.toml plan.csv", "plan.csv: column kind: found only via, allowed: at least 1 row measure")
    folder.write("plan.csv", "kind,q1_deg,q2_deg,q3_deg,q4_deg\nvia,0,0,0,0\nmesure,0,0,0,0\n")
    folder.refused("score arm.toml plan.csv", "row 2 (line 3), column kind: found 'mesure', allowed: measure or via")
