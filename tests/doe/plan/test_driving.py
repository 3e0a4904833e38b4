"""Plans of arms with bodies as they are driven: moves sampled a hundred times finer than they were proven."""

from dataclasses import replace
from itertools import pairwise, permutations
from pathlib import Path

import numpy as np
import pytest

from doe import DesignProblem, score
from doe.plan.moves import MOVING, drive, one_turn, room_of, unproven, with_approach
from doe.problem.clearance import Clearance
from doe.problem.constraints import constraints_of
from identification import Arm, ArmModel, Array, EffectSpec, Model, Plan, Status
from identification.kinematics.counting import Counting
from identification.workspace import Cell, LineOfSight, WorkspaceBox
from tests.doe.problem.test_clearance import ball, cell_of
from tests.doe.six_axis import SIX_AXIS


def test_a_wall_may_be_left_and_reached_again() -> None:
    """Both postures are on the side of the box, 300 mm from the base, and bodies are nowhere near."""
    balls = ball("ball", 2, 200.0, 0.0, 5.0), ball("post", 0, 900.0, 0.0, 5.0)
    box = WorkspaceBox((-600.0, 300.0), (-600.0, 600.0))
    arm = Arm(np.array([300.0, 200.0]), cell=Cell(balls), constraints=(box,))
    room = room_of(ArmModel(arm), constraints_of(arm))
    out = np.arccos(200.0 / 300.0 - 1.0 / 3.0)  # the tip is 300 cos q1 + 200 cos (q1 + q2)
    ends = np.array([[out, -out], [-out, out]])
    folded = np.array([[np.pi / 2, np.pi / 2 - 0.01]])
    np.testing.assert_allclose(300.0 * np.cos(ends[:, 0]) + 200.0 * np.cos(ends.sum(axis=1)), 300.0)
    assert room.free(ends[:1], folded).all()
    assert not room.free(ends[:1], ends[1:]).any()  # the stretched arm reaches 500 mm
    (move,) = unproven(constraints_of(arm), ends)
    assert (move["row"], move["bodies"], move["distance_mm"]) == (2, ["workspace_box"], pytest.approx(-200.0, abs=0.01))
    bare = replace(arm, cell=None)  # nothing is known without bodies
    assert room_of(ArmModel(bare), constraints_of(bare)).free(ends[:1], ends[1:]).all()


# -- plans -------------------------------------------------------------------------------------------------------------
def ring(clearance: float = 20.0) -> DesignProblem:
    """Two links of 300 and 200 mm and a ball at the tip, which gets between two posts with its elbow on one side only:
    all around is free, and a pocket between joint limits and posts is cut off."""
    posts = ball("above", 0, 0.0, 500.0, 60.0), ball("below", 0, 0.0, -500.0, 60.0)
    limits = np.radians([170.0, 20.0])
    cell = Cell((*posts, ball("hand", 2, 200.0, 0.0, 30.0)), clearance=clearance)
    arm = Arm(np.array([300.0, 200.0]), lower=-limits, upper=limits, sigma=0.1, cell=cell)
    return DesignProblem.of(Model(arm))


def inside(problem: DesignProblem, way: Array) -> bool:
    """Whether every move of a way keeps half of its clearance, by a fine sample."""
    clearance = next(each for each in problem.constraints if isinstance(each, Clearance))
    shares = np.linspace(0.0, 1.0, 500)[:, None]
    points = np.concatenate([a + shares * (b - a) for a, b in pairwise(way)])
    return bool(np.all((clearance.distance(points) >= MOVING * clearance.asked - 2e-3)[:, ~clearance.of_sight]))


def test_postures_behind_a_post_are_replaced_by_the_best_that_are_not() -> None:
    """The stretched arm sweeps past no post: of three sectors the one with most postures stays."""
    problem = ring()
    q1 = np.radians([-60.0, -30.0, 0.0, 30.0, 60.0, 150.0])
    postures = np.column_stack([q1, np.radians([5.0, -5.0, 10.0, -10.0, 0.0, 0.0])])
    found = drive(problem, Plan(postures))
    assert found.data["moves"]["replaced"] == 1
    assert np.all(np.abs(found.plan.postures[:, 0]) < np.pi / 2)
    apart = np.degrees(np.abs(found.plan.postures[:, None] - found.plan.postures).max(axis=2))
    shortest = min(sum(apart[a, b] for a, b in pairwise(order)) for order in permutations(range(6)))
    assert found.data["moves"]["shortest_deg"] == pytest.approx(shortest)  # of what is measured, not of what was given
    assert len({*map(tuple, found.plan.postures)} & {*map(tuple, postures)}) == 5
    assert inside(problem, found.moves.postures)
    best = replace(score(problem, Plan(postures)), status=Status.bound_reached)
    assert best.driven(found).status is Status.replaced  # no longer that of the search
    assert best.driven(drive(problem, Plan(postures[:5]))).status is Status.bound_reached
    (new,) = {*map(tuple, found.plan.postures)} - {*map(tuple, postures)}
    others = problem.feasible(drawn := np.random.default_rng(1).uniform(problem.lower, problem.upper, (300, 2)))
    drawn = drawn[others & (np.abs(drawn[:, 0]) < np.pi / 2)]
    values = [problem.objective(np.vstack([postures[:5], each])) for each in drawn]
    assert problem.objective(np.vstack([postures[:5], new])) > np.quantile(values, 0.9)


def test_what_no_way_leads_to_is_kept_and_named() -> None:
    """Nothing else may be chosen: the plan stays, its moves and what they come near to are said."""
    problem = ring()
    problem = replace(problem, choices=np.radians([[150.0, 0.0], [160.0, 5.0]]))
    postures = np.radians([[-60.0, 5.0], [0.0, -5.0], [150.0, 0.0]])
    driven = drive(problem, Plan(postures))
    assert sorted(driven.plan.postures.tolist()) == sorted(postures.tolist())
    (move,) = driven.data["moves"]["not_free"]
    assert move["bodies"] == ["hand", "above"]
    assert move["distance_mm"] < 10.0
    assert driven.lines[-2:] == [
        "Moves: 1 may collide on the way:",
        f"  to row {move['row']}: hand and above, smallest distance {move['distance_mm']:.0f} mm",
    ]


def test_runs_without_a_free_approach_are_named() -> None:
    """The first is just above the post, with a millimetre of room, which 0.6 deg from below take up; from above all are
    approached."""
    problem = ring(clearance=2.0)
    near = 90.0 + np.degrees(2.0 * np.arcsin((90.0 + 2.01) / 2.0 / 500.0))
    postures = np.radians([[near, 0.0], [120.0, 5.0], [140.0, -5.0]])
    problem = replace(problem, choices=postures)
    below, above = (drive(problem, Plan(postures), "given", approach) for approach in ("positive", "negative"))
    np.testing.assert_array_equal(below.plan.postures, postures)
    assert (below.data["moves"]["no_approach"], below.moves.via.tolist()) == ([1], [False, True, False, True, False])
    assert "no collision-free path from that side was found to run 1" in below.lines
    assert above.data["moves"]["no_approach"] == []
    assert all(inside(problem, each.moves.postures) for each in (below, above))


@pytest.mark.parametrize(
    ("approach", "room"),
    [("positive", [[3, 0], [0, 3]]), ("negative", [[0, 3], [3, 0]]), ("alternate", [[3, 3], [3, 3]])],
)
def test_joints_come_from_the_side_that_is_asked_for(approach: str, room: list[list[float]]) -> None:
    """With room there below and above, and no more; without bodies and with them, as the model counts and as the
    controller does: the other joint the other way round and from where the first is."""
    counts = Counting((1, -1), (0, 1), (0.0, 0.0)).matrix
    signs = np.array([1, -1])
    for problem in (ring(), replace(ring(), constraints=())):
        asked = with_approach(problem, approach, counts)
        np.testing.assert_allclose(np.degrees([asked.lower - problem.lower, problem.upper - asked.upper]), room)
        postures = np.random.default_rng(2).uniform(asked.lower, asked.upper, (40, 2))
        postures = postures[problem.feasible(postures) & (np.abs(postures[:, 0]) < 1.0)][:6]
        postures[0] = asked.lower * [0.3, 1.0]
        postures[1] = asked.upper * [0.3, 1.0]
        found = drive(problem, Plan(postures), None, approach, counts)
        assert found.data["moves"]["replaced"] == 0
        moves = np.diff(found.moves.postures, axis=0)[~found.moves.via[1:]]
        come = np.sign(moves) * signs
        np.testing.assert_array_equal(found.plan.conditions["directions"], np.sign(moves))
        shown = np.stack([moves[:, 0], -(moves[:, 1] + moves[:, 0])], axis=1)
        np.testing.assert_array_equal(np.sign(shown), come)
        assert np.degrees(np.abs(shown)).min() > 0.3
        assert np.all(come == come[:, :1])
        rows = [int(np.flatnonzero((postures == q).all(axis=1))[0]) for q in found.plan.postures]
        wanted = {"positive": [1] * 6, "negative": [-1] * 6, "alternate": [1 - 2 * (row % 2) for row in rows]}
        assert come[:, 0].tolist() == wanted[approach]
        assert any("plan and bound leave room for this at the limits" in line for line in found.lines)
        if problem.constraints:
            assert inside(problem, found.moves.postures)
        else:
            assert rows == list(range(6))


@pytest.mark.parametrize(("effects", "listed"), [((), False), ((), True), ((EffectSpec("gear_ratio", 1),), False)])
def test_joints_are_turned_into_one_turn(effects: tuple[EffectSpec, ...], listed: bool) -> None:
    """Where limits leave two, and neither the criterion nor a list of postures tells them apart: the turn ends at
    a post, which the stretched arm does not get past. An error that grows with the angle does tell."""
    balls = (ball("post", 0, 450.0, 0.0, 60.0), ball("hand", 2, 200.0, 0.0, 30.0))
    limits = np.radians([360.0, 100.0])
    arm = Arm(np.array([300.0, 200.0]), lower=-limits, upper=limits, sigma=0.1, cell=Cell(balls), effects=effects)
    problem = DesignProblem.of(Model(arm))
    drawn = np.random.default_rng(4).uniform(problem.lower, problem.upper, (60, 2))
    postures = drawn[problem.feasible(drawn)][:20]
    if listed:
        problem = replace(problem, choices=postures)
    turned = one_turn(problem, room_of(problem.model, problem.constraints), postures)(postures)
    turns = (turned - postures) / (2.0 * np.pi)
    if effects or listed:
        np.testing.assert_array_equal(turns, 0.0)
        return
    np.testing.assert_allclose(turns, turns.round(), atol=1e-12)
    assert np.any(turns[:, 0])
    assert not np.any(turns[:, 1])
    around = np.mod(turned[:, 0].min() - 1e-9, 2.0 * np.pi)  # near where the turn ends: by the post, which is at 0
    assert min(around, 2.0 * np.pi - around) < np.radians(50.0)
    assert np.ptp(turned[:, 0]) <= 2.0 * np.pi
    assert problem.objective(turned) == pytest.approx(problem.objective(postures))
    whole = drive(problem, Plan(postures))
    assert whole.data["travel_deg"]["saved"] > 0.3
    assert inside(problem, whole.moves.postures)


def test_orders_that_are_asked_for() -> None:
    """Moves keep half of the clearance; they are sampled a hundred times finer than they were looked at."""
    sight = LineOfSight((2000.0, 300.0, 500.0), np.radians(60.0), (0.0, 0.0, 400.0))
    box, cell = WorkspaceBox((-1200.0, 1200.0), (-1200.0, 1200.0), (0.0, 2000.0)), cell_of(SIX_AXIS)
    few = tuple(body for body in cell.bodies if body.name != "table")  # boxes take time
    limits, cell = np.full(6, np.pi), replace(cell, bodies=few)
    arm = replace(SIX_AXIS, lower=-limits, upper=limits, cell=cell, constraints=(sight, box))
    drawn = np.random.default_rng(6).uniform(-limits, limits, (800, 6))
    drawn[:, 1] = -np.abs(drawn[:, 1])  # through the floor no way leads to the others
    for problem, some in ((DesignProblem.of(Model(arm)), drawn), (ring(), 0.3 * drawn[:, :2])):
        postures = some[problem.feasible(some)][:5]
        kept, short = (drive(problem, Plan(postures), order, seed=3) for order in ("given", "travel"))
        np.testing.assert_array_equal(kept.plan.postures, postures)
        before, there = ([each.data["travel_deg"][key] for each in (kept, short)] for key in ("before", "after"))
        assert short.data["moves"]["shortest_deg"] <= there[1] <= there[0]
        assert before[0] <= there[0]
        assert all(inside(problem, found.moves.postures) for found in (kept, short))
    mixed, again = (drive(problem, Plan(postures), order, seed=3) for order in ("random", "travel"))
    np.testing.assert_array_equal(mixed.plan.postures, postures[np.random.default_rng(3).permutation(5)])
    np.testing.assert_array_equal(again.moves.postures, short.moves.postures)


# -- the file ----------------------------------------------------------------------------------------------------------
def test_a_plan_file_with_way_points(tmp_path: Path) -> None:
    """Runs are numbered without them; directions are those of the motion that the file describes."""
    postures = np.radians([[0.0, 0.0], [10.0, -5.0], [7.0, -8.0], [12.0, -8.0]])
    plan = Plan(postures, via=np.array([False, False, True, False]), fit="library-prior")
    text = plan.text(further={"cup": ["a", "bb", "c"]})
    assert text.splitlines() == [
        "# fit: library-prior",
        "run,kind,q1_deg,q2_deg,direction1,direction2,cup",
        "1,measure,0.0,0.0,1,1,a",
        "2,measure,10.0,-5.0,1,-1,bb",
        ',via,7.0,-8.0,,,""',
        "3,measure,12.0,-8.0,1,-1,c",
    ]
    (tmp_path / "plan.csv").write_text(text)
    np.testing.assert_allclose(Plan.load(tmp_path / "plan.csv", 2).postures, postures[[0, 1, 3]], atol=1e-14)
    whole = Plan.load(tmp_path / "plan.csv", 2, vias=True)
    np.testing.assert_allclose(whole.postures, postures, atol=1e-14)
    assert [*(whole.via if whole.via is not None else [])] == [False, False, True, False]
    straight = Plan(postures, via=np.zeros(4, dtype=bool)).text()
    assert straight.splitlines()[:2] == ["run,kind,q1_deg,q2_deg", "1,measure,0.0,0.0"]


def test_a_search_that_time_ends_names_the_moves_that_are_not_free() -> None:
    """Nothing of the plan is lost: its postures stay, in an order that is as good as is seen at once."""
    problem = ring()
    plan = Plan(np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2)) * problem.upper)
    driven, whole = (drive(problem, plan, stop=lambda each=each: each) for each in (True, False))
    assert sorted(map(tuple, driven.plan.postures.tolist())) == sorted(map(tuple, plan.postures.tolist()))
    assert driven.data["moves"]["not_free"]
    assert not whole.data["moves"]["not_free"]
