"""`armcal design` with moves: ways round what is in the way, the side of approach, and who reads what it writes."""

import csv
import re
import warnings

import numpy as np
import pytest

from doe.plan.moves import room_of
from doe.problem.constraints import constraints_of
from identification import Model, Plan, design_model, load_arm, load_measurements
from tests.doe.cli.conftest import ARM, Folder, table
from tests.doe.plan.test_plan import sampled
from tests.doe.program.test_program import read_fanuc

POSTS = """
[cell]
clearance_mm = 10.0

[[cell.bodies]]
name = "post"
kind = "sphere"
center_mm = [330.0, 260.0]
radius_mm = 40.0

[[cell.bodies]]
name = "other post"
kind = "sphere"
center_mm = [-330.0, 260.0]
radius_mm = 40.0
"""
DESIGN = "design arm.toml --runs 10 --candidates list.csv"  # whose bound takes no search


@pytest.fixture(autouse=True)
def candidates(folder: Folder) -> None:
    folder.plan(400, 8, "list.csv")


@pytest.fixture
def cell(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> Folder:
    """With posts; and without bounds, which take most of the time and of which nothing is asked here."""
    for place in ("doe.solvers.solving.best_known_bound", "doe.design.best_known_bound"):
        monkeypatch.setattr(place, lambda *_: None)
    folder.write("arm.toml", ARM.replace("links_mm", "link_width_mm = 30.0\nlinks_mm") + POSTS)
    return folder


def rows_of(folder: Folder, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader(folder.read(name).splitlines()))


def test_candidates_that_are_left_out_are_counted(folder: Folder) -> None:
    folder.write("list.csv", folder.read("list.csv") + "401,0,0,0,3000\n")
    done = folder.armcal("relax arm.toml --candidates list.csv --no-check")
    assert (done.code, "list.csv: 1 of 401 postures violate the limits" in " ".join(done.err.split())) == (0, True)


def test_a_plan_among_posts(cell: Folder) -> None:
    """Every move is free by a fine sample; program agrees, and says of another order what collides."""
    data = cell.said(f"{DESIGN} --out plan.csv --force")
    moves, rows = data["moves"], rows_of(cell, "plan.csv")
    assert [row["kind"] for row in rows] == [row["kind"] for row in moves["rows"]]
    assert [row["run"] for row in rows if row["kind"] == "measure"] == [str(k) for k in range(1, 11)]
    assert moves["vias"] == sum(row["kind"] == "via" for row in rows)
    joints = [[float(row[f"q{j}_deg"]) for j in range(1, 5)] for row in rows]
    np.testing.assert_allclose(joints, [row["joints"] for row in moves["rows"]], atol=1e-9)
    measured = [q for q, row in zip(joints, rows, strict=True) if row["kind"] == "measure"]
    np.testing.assert_allclose(data["postures_deg"], measured, atol=1e-9)
    assert data["travel_deg"]["order"] == "travel"
    assert data["travel_deg"]["after"] == pytest.approx(np.abs(np.diff(joints, axis=0)).max(axis=1).sum())
    assert data["travel_deg"]["after"] >= moves["shortest_deg"] - 1e-9
    arm = load_arm("arm.toml")
    room = room_of(design_model(arm), constraints_of(arm))
    assert sampled(room, np.radians(joints), 1500) >= 0.0
    done = cell.armcal("program arm.toml plan.csv --robot kuka --out plan.src")
    assert (done.code, done.err) == (0, "")
    # the same postures without way-points, in an order that was not looked at
    other = table({f"q{j}_deg": column for j, column in enumerate(np.array(sorted(measured)).T, start=1)})
    cell.write("other.csv", other)
    way = Plan.load("other.csv", 4).postures
    collide = [k + 2 for k in range(9) if sampled(room, way[k : k + 2]) < 0.0]
    assert collide
    done = cell.armcal("program arm.toml other.csv --robot kuka --out other.src")
    assert done.code == 0
    assert f"to row {collide[0]}: " in done.out
    said = cell.said("program arm.toml other.csv --robot kuka --out other.src --force")["not_free"]
    assert {*collide} <= {move["row"] for move in said}
    assert said == cell.said("score arm.toml other.csv --seconds 0.1")["moves"]["not_free"]
    checked = cell.said("check arm.toml other.csv")
    assert (checked["moves"]["not_free"], checked["ok"]) == (said, False)
    assert cell.said("check arm.toml plan.csv")["ok"]
    comments = [line for line in cell.read("other.src").splitlines() if re.match("; (run|via)", line)]
    for move in said:
        assert comments[move["row"] - 1] == f"; run {move['row']}, may collide: {' and '.join(move['bodies'])}"
        assert move["distance_mm"] < 10.0


def test_every_joint_from_one_side(folder: Folder) -> None:
    """Without bodies: a way-point before each run, the sign of the last motion in its file and in what is simulated."""
    data = folder.said(f"{DESIGN} --approach negative --out plan.csv --force")
    rows, sign = rows_of(folder, "plan.csv"), -1
    assert [row["kind"] for row in rows] == ["via", "measure"] * 10
    joints = np.array([[float(row[f"q{j}_deg"]) for j in range(1, 5)] for row in rows])
    assert np.all(sign * (joints[1::2] - joints[::2]) > 0.5)
    assert [row[f"direction{j}"] for row in rows[1::2] for j in range(1, 5)] == [str(sign)] * 40
    assert data["moves"]["approach"] == "negative"
    folder.said("simulate arm.toml plan.csv --truth truth.toml --out data.csv")
    assert [row["direction2"] for row in rows_of(folder, "data.csv")] == [str(sign)] * 10


@pytest.mark.parametrize("bodies", ["", POSTS])
def test_way_points_keep_the_limits_of_joints_that_are_counted_together(folder: Folder, bodies: str) -> None:
    """With bodies and without; where nothing is known of any, also the walls, as `program` demands."""
    box = '\n[[constraints]]\nkind = "workspace_box"\nx_mm = [-400.0, 400.0]\ny_mm = [-50.0, 600.0]\n'
    arm = ARM.replace("links_mm", "link_width_mm = 30.0\nlinks_mm") if bodies else ARM
    folder.write("arm.toml", arm + "\n[joints]\ncoupled_to = [0, 0, 2, 0]\n" + box + bodies)
    drawn = np.random.default_rng(0).uniform([-180.0, -120.0, -100.0, -90.0], [180.0, 120.0, 60.0, 90.0], (600, 4))
    drawn[::2, 2] = np.clip(drawn[::2, 2] * 4.0, -97.0, 59.5)  # many near limits
    lines = [",".join(map(str, row)) for row in drawn.round(3).tolist()]
    folder.write("list.csv", "\n".join(["q1_deg,q2_deg,q3_deg,q4_deg", *lines, ""]))
    folder.said(f"{DESIGN} --approach positive --out plan.csv --force")
    columns = np.array([[float(row[f"q{j}_deg"]) for j in range(1, 5)] for row in rows_of(folder, "plan.csv")])
    assert len(columns) >= 15
    assert np.all((columns[:, 2] >= -100.0 - 1e-6) & (columns[:, 2] <= 60.0 + 1e-6))
    turned = np.radians(np.cumsum(columns, axis=1) - columns[:, 1:2] * [0.0, 0.0, 1.0, 1.0])
    tips = np.stack([np.cos(turned), np.sin(turned)]) @ [260.0, 180.0, 120.0, 100.0]
    slack = 10.0 if bodies else 1e-6
    assert np.all(np.abs(tips[0]) <= 400.0 + slack)
    assert np.all((tips[1] >= -50.0 - slack) & (tips[1] <= 600.0 + slack))
    folder.said("program arm.toml plan.csv --robot abb --out plan.mod")


def test_another_clearance(cell: Folder) -> None:
    """`--clearance-mm` prevails over `[cell]`, also to nothing; a plan for more room keeps it."""
    cell.said(f"{DESIGN} --clearance-mm 60 --out wide.csv")
    narrower = cell.armcal(*f"{DESIGN} --clearance-mm 9 --out narrow.csv".split())
    assert "9 is less than clearance_mm = 10 in [cell], which check, score and program use" in narrower.err
    cell.write("wide.toml", cell.read("arm.toml").replace("clearance_mm = 10.0", "clearance_mm = 60.0"))
    constraints = constraints_of(Model(load_arm("wide.toml")))
    wide, narrow = (
        min(each.margin(Plan.load(name, 4).postures).min() for each in constraints)
        for name in ("wide.csv", "narrow.csv")
    )
    assert narrow < 0.0 <= wide
    cell.write("bare.toml", ARM)
    bare = DESIGN.replace("arm.toml", "bare.toml")
    cell.refused(f"{bare} --clearance-mm 5", "--clearance-mm: found for an arm without bodies")
    for wrong in ("-1", "nan", "inf"):
        cell.refused(f"{DESIGN} --clearance-mm {wrong}", f"--clearance-mm: found {wrong}, allowed: a number >= 0")


def test_the_page_says_which_plans_may_collide_on_the_way(cell: Folder) -> None:
    cell.said(f"{DESIGN} --order given --out given.csv")
    cell.said("report arm.toml given.csv --out free.html")
    rows = [row for row in rows_of(cell, "given.csv") if row["kind"] == "measure"]
    joints = {key: [row[key] for row in rows] for key in ("run", "q1_deg", "q2_deg", "q3_deg", "q4_deg")}
    cell.write("bare.csv", table(joints))
    cell.said("report arm.toml bare.csv --out bare.html")
    colliding = len(cell.said("score arm.toml bare.csv --seconds 0.1")["moves"]["not_free"])
    assert "may collide on the way" not in cell.read("free.html")
    assert colliding
    assert f"Moves: {colliding} of {len(rows) - 1} may collide on the way" in cell.read("bare.html")


# -- programs ----------------------------------------------------------------------------------------------------------
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


def test_a_rail_is_said_to_be_an_axis_of_the_robot(folder: Folder) -> None:
    kinds = "revolute", "prismatic", "revolute"
    rows = "".join(f'[[dh]]\na_mm = 300.0\nalpha_deg = 90.0\nd_mm = 0.0\njoint = "{kind}"\n' for kind in kinds)
    folder.write("rail.toml", f'kind = "spatial"\n{rows}[joint_limits_mm]\nlower = [0.0]\nupper = [900.0]\n')
    folder.write("plan.csv", "run,q1_deg,q2_mm,q3_deg\n1,5,800,9\n")
    said = "Joint 2 slides and is axis 2 of the program: a rail that is an external axis needs --template"
    for robot in ("abb", "kuka", "fanuc", "ros"):
        done = folder.armcal(f"program rail.toml plan.csv --robot {robot} --out p.src --force")
        assert (said in done.flat) == (robot != "ros")


def test_sides_that_are_asked_for_and_not_driven_from_are_named(folder: Folder) -> None:
    names = [f"{name}{j}{unit}" for name, unit in (("q", "_deg"), ("direction", "")) for j in range(1, 5)]
    rows = [*4 * [0], *4 * [1]], [*4 * [5], 1, 1, -1, 1], [*4 * [9], *4 * [1]]
    folder.write("plan.csv", "\n".join(",".join(map(str, row)) for row in (names, *rows)))
    done = folder.armcal("program arm.toml plan.csv --robot kuka --out 7.src")
    assert "7.src: a KUKA needs a file with the name of the program: armcal_7.src" in done.out
    done = folder.armcal("program arm.toml plan.csv --robot kuka --out p.src")
    assert "Without way-points, joints approach run 2 from other sides than direction1.. of plan.csv says" in done.flat


def test_what_the_command_refuses(folder: Folder) -> None:
    folder.refused("program arm.toml plan.csv --robot kuka --out p.src --template gone.j2", "gone.j2: cannot be read")
    (folder.path / "mine.j2").write_bytes(b"\xff")
    folder.refused("program arm.toml plan.csv --robot kuka --out p.src --template mine.j2", "mine.j2: is not UTF-8")
    folder.write("weights.csv", "q1_deg,q2_deg,q3_deg,q4_deg,weight\n0,0,0,0,0.5\n9,9,9,9,0.5\n")
    folder.refused("program arm.toml weights.csv --robot kuka --out p.src", "found weights")
    folder.refused("simulate arm.toml weights.csv --truth arm.toml --out data.csv", "found weights")


def test_a_row_that_breaks_a_constraint_and_a_way_point_that_is_not_seen(folder: Folder) -> None:
    """A way-point may be out of sight, but not inside an obstacle."""
    arm = "links_mm = [300.0, 200.0]\n[[constraints]]\n"
    sight = 'kind = "line_of_sight"\ntracker_mm = [2000.0, 0.0]\nhalf_angle_deg = 8.0\ntoward_mm = [0.0, 0.0]\n'
    circle = 'kind = "keep_out_circle"\ncenter_mm = [0.0, 400.0]\nradius_mm = 60.0\n'
    folder.write("plan.csv", "run,kind,q1_deg,q2_deg\n1,measure,10,5\n,via,90,0\n2,measure,-10,-5\n")
    folder.write("arm.toml", arm + sight)
    assert folder.said("program arm.toml plan.csv --robot kuka --out plan.src")["vias"] == 1
    folder.write("hidden.csv", "run,q1_deg,q2_deg,payload_kg,temperature_C\n1,10,5,0,20\n2,90,0,3,25\n")
    assert [folder.said(f"check arm.toml {name}.csv")["outside_limits"] for name in ("plan", "hidden")] == [[], [2]]
    assert "run 2: line_of_sight\n" in folder.armcal("check arm.toml hidden.csv").out
    folder.write("arm.toml", arm + circle)
    folder.refused("program arm.toml plan.csv --robot kuka --out a.src", "plan.csv: row 2: breaks", "keep_out_circle")
    post = '[[cell.bodies]]\nname = "post"\nkind = "sphere"\ncenter_mm = [0.0, 400.0]\nradius_mm = 60.0\n'
    folder.write("arm.toml", f"link_width_mm = 20.0\nlinks_mm = [300.0, 200.0]\n{post}")
    folder.refused("program arm.toml plan.csv --robot kuka --out a.src", "row 2: breaks", "of link 2 and post, allowed")


def test_way_points_change_nothing_in_a_plan_or_in_measurements(folder: Folder) -> None:
    """Plans, measurements and kept postures are read as without them, and nothing is said of them."""
    folder.simulated()
    for name in ("plan", "data"):
        # with the column `kind`, and before each row a way-point, of which all but the joints is empty
        header, *rows = folder.read(f"{name}.csv").splitlines()
        via = ",".join("7.5" if column.startswith("q") else "" for column in header.split(","))
        table = [f"{header},kind", *(f"{via},via\n{row},measure" for row in rows), ""]
        folder.write(f"{name}_vias.csv", "\n".join(table))
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
    assert (one.postures.tolist(), one.positions.tolist()) == (other.postures.tolist(), other.positions.tolist())
    done = folder.armcal("simulate arm.toml plan_vias.csv --truth truth.toml --out again.csv")
    assert (done.code, done.err) == (0, "")
    assert folder.read("again.csv") == folder.read("data.csv")
