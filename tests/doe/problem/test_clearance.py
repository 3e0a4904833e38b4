"""Clearance against points sampled along axes, differences, and bodies whose distance is known in closed form."""

from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import DesignProblem, solve
from doe.plan.ascent import PlanAscent
from doe.plan.moves import distance_in_words, said_of_collisions
from doe.problem.clearance import Clearance, from_box, nearest_to_box, shortest
from doe.problem.constraints import Walls, constraints_of
from doe.problem.problem import put_inside, random_postures
from identification import Arm, Array, InputError, Model, design_model
from identification.kinematics.frames import pose
from identification.workspace import Body, Cell, LineOfSight
from tests.doe.six_axis import SIX_AXIS

TRACKER = np.array([2000.0, 300.0, 500.0])
POSTURES = 40


def ball(name: str, joint: int, x: float, y: float, radius: float) -> Body:
    return Body(name, joint, np.array([x, y, 0.0, x, y, 0.0, radius]))


def cell_of(arm: Arm) -> Cell:
    """Links of four crooked capsules each, a table of two boxes, a post, and a floor."""
    generator = np.random.default_rng(1)
    ends = [*(joint.origin for joint in arm.chain.joints[1:]), arm.chain.end]
    bodies = [Body("base", 0, np.array([0.0, 0, 0, 0, 0, 130, 60]))]
    for j, matrix in enumerate(ends, start=1):
        axes = np.r_[np.zeros(3), matrix[:3, 3]] + generator.normal(0.0, 5.0, (4, 6))
        bodies.append(Body(f"link {j}", j, np.column_stack([axes, generator.uniform(40.0, 50.0, 4)])))
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    boxes = [[500.0, 300, 200, *turn.ravel(), 100, 200, 50], [-500.0, 300, 200, *np.eye(3).ravel(), 300, 20, 250]]
    bodies += [Body("table", boxes=np.array(boxes)), Body("post", 0, np.array([300.0, -500, 0, 300, -500, 400, 30]))]
    links = ["base", *(body.name for body in bodies[1:-2])]
    return Cell(tuple(bodies), floor=-50.0, apart=frozenset(map(frozenset, pairwise(links))))


@pytest.fixture(scope="module")
def arm() -> Arm:
    return replace(SIX_AXIS, cell=cell_of(SIX_AXIS))


@pytest.fixture(scope="module")
def clearance(arm: Arm) -> Clearance:
    return Clearance(design_model(Model(arm)), [TRACKER])


@pytest.fixture(scope="module")
def postures(arm: Arm) -> Array:
    return np.random.default_rng(2).uniform(arm.lower, arm.upper, (POSTURES, 6))


def samples(arm: Arm, posture: Array, name: str, count: int = 120) -> list[tuple[Array, float]]:
    """Of each capsule of a body points (count, 3) along its axis, and its radius, from the chain's matrices."""
    frames = design_model(Model(arm)).joint_frames(posture[None])[0]
    shares = np.linspace(0.0, 1.0, count)[:, None]
    if name == Cell.SIGHT:
        return [(TRACKER + shares * (frames[-1, :3, 3] - TRACKER), 0.0)]
    body = next(body for body in arm.cell.bodies if body.name == name)
    frame = frames[body.joint]
    local = [(row[:3] + shares * (row[3:6] - row[:3]), row[6]) for row in body.capsules]
    return [(points @ frame[:3, :3].T + frame[:3, 3], radius) for points, radius in local]


def sampled_distance(arm: Arm, posture: Array, pair: tuple[str, str]) -> float:
    first = samples(arm, posture, pair[0])
    if pair[1] == Cell.FLOOR:
        return min(float(points[:, 2].min()) - radius + 50.0 for points, radius in first)
    if pair[1] != "table":
        second = samples(arm, posture, pair[1])
        gaps = [(p[:, None] - q, r + s) for p, r in first for q, s in second]
        return min(float(np.linalg.norm(gap, axis=2).min()) - radii for gap, radii in gaps)
    table, least = next(body for body in arm.cell.bodies if body.name == "table"), np.inf
    for points, radius in first:
        for box in table.boxes:
            beyond = np.abs((points - box[:3]) @ box[3:12].reshape(3, 3)) - box[12:]
            signed = np.where(beyond.max(axis=1) > 0.0, np.linalg.norm(np.maximum(beyond, 0.0), axis=1), beyond.max(1))
            least = min(least, float(signed.min()) - radius)
    return least


def test_distances_are_those_of_points_sampled_along_the_axes(arm: Arm, clearance: Clearance, postures: Array) -> None:
    apart = clearance.distance(postures[:5])
    for k, pair in enumerate(clearance.pairs):
        sampled = np.array([sampled_distance(arm, posture, pair) for posture in postures[:5]])
        assert np.all(apart[:, k] < sampled + 1e-3), pair
        # the line of sight is sampled every 17 to 30 mm, other axes every 5
        np.testing.assert_allclose(apart[:, k], sampled, atol=15.0 if pair[0] == Cell.SIGHT else 2.5, err_msg=str(pair))


def test_which_pairs_are_looked_at(clearance: Clearance) -> None:
    assert ("link 3", "link 1") in clearance.pairs
    assert ("link 2", "link 1") not in (*clearance.pairs, *clearance.touching)  # a joint connects them
    assert ("table", "post") not in clearance.pairs  # both stand still
    assert not any({Cell.SIGHT, Cell.FLOOR} <= {*pair} for pair in clearance.pairs)


@pytest.mark.parametrize(("place", "touching", "asked"), [(15.0, 8, []), (28.0, 0, 8 * [2.0]), (80.0, 0, 8 * [10.0])])
def test_what_is_always_near_may_stay_near(place: float, touching: int, asked: list[float]) -> None:
    """A ball of radius 10 at a planar arm's elbow and eight behind it, whose distance no joint changes."""
    balls = ball("first", 1, 400.0, 0.0, 10.0), *(ball(f"ball {k}", 2, place, 0.0, 10.0) for k in range(8))
    clearance = Clearance(design_model(Model(Arm(np.array([400.0, 300.0]), cell=Cell(balls, clearance=10.0)))))
    assert len(clearance.touching) == touching
    assert clearance.asked.tolist() == pytest.approx(asked)
    said = " ".join(said_of_collisions([clearance], None)[1])
    assert [f"ball {k} and first" in said for k in range(8)] == 8 * [place < 80.0]


def test_slopes_are_differences_of_margins(clearance: Clearance, postures: Array) -> None:
    step = 1e-6
    slopes = clearance.first(postures)[1]
    moved = [(clearance.margin(postures + step * e) - clearance.margin(postures - step * e)) for e in np.eye(6)]
    differences = np.stack(moved, axis=1) / (2.0 * step)
    # where two pieces are equally near, or an axis runs through the middle of a box, there is no derivative
    assert np.mean(np.abs(slopes - differences).max(axis=1) > 1e-3 * np.abs(differences).max()) < 0.005


def test_bends_are_differences_of_slopes(clearance: Clearance, postures: Array) -> None:
    weights = np.random.default_rng(3).uniform(size=(POSTURES, len(clearance.pairs)))
    joint, step = 4, 1e-5
    bends = clearance.bend(postures, weights)
    np.testing.assert_allclose(bends, np.swapaxes(bends, 1, 2))
    ends = (postures + move * np.eye(6)[joint] for move in (step, -step))
    ahead, behind = (np.einsum("mk,mak->ma", weights, clearance.first(end)[1]) for end in ends)
    wrong = np.abs((ahead - behind) / (2.0 * step) - bends[:, joint]).max(axis=1) > 1e-2 * np.abs(bends).max()
    assert wrong.mean() < 0.1  # kinks, where other pieces become the nearest


def test_walls_of_bodies_alone(arm: Arm, postures: Array) -> None:
    """Without any expression beside them."""
    (clearance,) = constraints_of(Model(arm))
    walls = DesignProblem.of(Model(arm)).walls
    margins, slopes = walls.first(postures)
    np.testing.assert_allclose(margins, clearance.margin(postures))
    np.testing.assert_allclose(slopes, clearance.first(postures)[1])
    weights = np.ones_like(margins)
    np.testing.assert_allclose(walls.bend(postures, weights), clearance.bend(postures, weights))


def test_no_distance_changes_faster_than_the_levers_say(arm: Arm, clearance: Clearance, postures: Array) -> None:
    others = np.random.default_rng(4).uniform(arm.lower, arm.upper, postures.shape)
    for step in (0.05, 1.0, np.eye(6)):
        nearby = postures[:, None] + np.atleast_2d(step) * (others - postures)[:, None]
        for there in np.moveaxis(nearby, 1, 0):
            changes = np.abs(clearance.distance(there) - clearance.distance(postures))
            slower = changes <= np.abs(there - postures) @ clearance.levers().T + 1e-9
            assert np.all(slower[:, ~clearance.of_sight])


def test_a_joint_that_moves_both_bodies_changes_no_distance(clearance: Clearance) -> None:
    """Links 5 and 2 have joints 3 to 5 between them, the stretched arm of which is at least their links."""
    levers = clearance.levers()[clearance.pairs.index(("link 5", "link 2"))]
    assert np.flatnonzero(levers).tolist() == [2, 3, 4]
    assert levers[2] > 572.3


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-100, 100), min_size=12, max_size=12))
def test_shortest_way_between_two_segments(numbers: list[float]) -> None:
    a, b, c, d = np.array(numbers).reshape(4, 3)
    first, second, between = shortest(a, b, c, d)
    np.testing.assert_allclose(between, a + first * (b - a) - c - second * (d - c), atol=1e-9)
    shares = np.linspace(0.0, 1.0, 41)
    grid = (a + shares[:, None] * (b - a))[:, None] - (c + shares[:, None] * (d - c))
    assert np.linalg.norm(between) <= np.linalg.norm(grid, axis=2).min() + 1e-6


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-100, 100), min_size=6, max_size=6), st.lists(st.floats(1, 60), min_size=3, max_size=3))
def test_nearest_point_of_a_segment_to_a_box(numbers: list[float], sizes: list[float]) -> None:
    (a, b), half = np.array(numbers).reshape(2, 3, 1), np.array(sizes)[:, None]
    share, away = nearest_to_box(a, b, half)
    grid = a + np.linspace(0.0, 1.0, 401) * (b - a)
    assert from_box(a + share * (b - a), half)[0] <= from_box(grid, half).min() + 1e-4
    assert np.linalg.norm(away) < 1.0 + 1e-9
    moved = [from_box(grid + step * away, half).min() for step in (0.0, 1e-4)]
    assert moved[1] - moved[0] >= -1e-9


def test_a_planar_arm_and_spheres() -> None:
    """Two links of 400 mm that fold: the tip's ball is 2 * 400 * sin(q / 2) from that of the base."""
    balls = ball("foot", 0, 0.0, 0.0, 30.0), ball("hand", 2, 400.0, 0.0, 20.0)
    arm = Arm(np.array([400.0, 400.0]), cell=Cell(balls, clearance=10.0))
    fold = np.array([0.5, 1.0, 2.0, 3.0])
    postures = np.column_stack([np.full(4, 0.7), fold])
    (clearance,) = constraints_of(Model(arm))
    assert said_of_collisions([clearance], None)[1] == ["Joints whose links have no bodies (not checked): joint 1."]
    np.testing.assert_allclose(Walls([clearance]).values(postures), clearance.margin(postures))
    np.testing.assert_allclose(clearance.margin(postures)[:, 0], 800.0 * np.cos(fold / 2.0) - 60.0, atol=1e-9)


def test_a_plan_climbs_and_keeps_its_distances(arm: Arm) -> None:
    sight = LineOfSight(tuple(TRACKER.tolist()), np.radians(60.0), (0.0, 0.0, 400.0))
    problem = DesignProblem.of(Model(replace(arm, constraints=(sight,))))
    judge = next(each for each in problem.constraints if isinstance(each, Clearance))
    assert any(Cell.SIGHT in pair for pair in judge.pairs)
    start = random_postures(problem, 14, np.random.default_rng(5))
    climbed = PlanAscent(problem)(start, tolerance=1e-3)
    assert problem.objective(climbed) > problem.objective(start) + 1.0
    assert judge.too_near(climbed) == []
    assert np.all(problem.feasible(climbed))
    assert judge.too_near(PlanAscent(replace(problem, constraints=()))(start, tolerance=1e-2))


@pytest.mark.parametrize("tracker", [900.0, 700.0])
def test_what_always_hides_the_arm_bars_all_but_what_the_tracker_is_in(tracker: float) -> None:
    wall = Body("wall", boxes=np.array([[700.0, 0, 0, *np.eye(3).ravel(), 50, 2000, 2000]]))
    sight = LineOfSight((tracker, 0.0), 3.0, (0.0, 0.0))
    problem = DesignProblem.of(Model(Arm(np.array([300.0, 200.0]), cell=Cell((wall,)), constraints=(sight,))))
    with pytest.raises(InputError, match="clearance of line of sight and wall") if tracker == 900.0 else nullcontext():
        random_postures(problem, 5, np.random.default_rng(0))


def test_every_measured_point_is_to_be_seen(arm: Arm, postures: Array) -> None:
    sight, found = LineOfSight(tuple(TRACKER.tolist()), 1.0, (0.0, 0.0, 400.0)), list[list[Array]]()
    for places in ([300.0, -200.0], [300.0], [-200.0]):
        chain = replace(arm.chain, tools={f"{y}": pose((0, y, 9)) for y in places}, settled=frozenset({"tool"}))
        cone, bodies = constraints_of(Model(replace(arm, chain=chain, constraints=(sight,))))
        seen = [Cell.SIGHT in each for each in bodies.pairs]  # type: ignore[union-attr]
        found.append([cone.margin(postures), bodies.distance(postures)[:, seen]])
    (both, nearest), (one, here), (other, there) = found
    np.testing.assert_allclose(both, np.hstack([one, other]))
    np.testing.assert_allclose(nearest, np.minimum(here, there))


def test_a_cell_whose_meshes_are_not_found_bars_nothing() -> None:
    problem = DesignProblem.of(Model(Arm(np.array([400.0, 300.0]), cell=Cell((Body("lost"),)))))
    postures = random_postures(problem, 5, np.random.default_rng(0))
    assert [len(clearance.pairs) for clearance in problem.constraints] == [0]
    np.testing.assert_array_equal(put_inside(problem, postures), postures)
    said = said_of_collisions(problem.constraints, None, postures)[1]  # of no pairs, nothing
    assert said == ["Joints whose links have no bodies (not checked): joint 1, joint 2."]


def test_what_is_said_of_postures(clearance: Clearance, postures: Array) -> None:
    """Every pair that is too near by its run and distance, as counted by hand."""
    margins = clearance.margin(postures)
    said = said_of_collisions([clearance], None, postures)[1]
    near = [line for line in said if line.startswith("  run ")]
    assert len(near) == len(clearance.too_near(postures)) == int(np.sum(margins < -1e-3))
    those = f"at {int(np.any(margins < -1e-3, axis=1).sum())} of {POSTURES} postures"
    assert said[0].startswith(f"Collisions (by covers, which stick out somewhat): {those} bodies are too close")
    free = postures[np.all(margins >= 0.0, axis=1)]
    assert clearance.too_near(free) == []
    for q in (free, np.repeat(free, 2, axis=0)):  # repeats are no further postures
        said = said_of_collisions([clearance], None, q)[1]
        assert f"stay at least 20 mm apart at all {len(free)} postures" in said[0]
    first = clearance.too_near(postures)[0]
    pair = clearance.pairs.index(tuple(first["bodies"]))
    assert first["distance_mm"] == clearance.distance(postures)[first["run"] - 1, pair]
    for distance, words in ((19.998, "are 19.99 mm apart"), (0.001, "are 0.00 mm apart"), (-0.3, "overlap by 0.30 mm")):
        assert distance_in_words({"bodies": ["a", "b"], "distance_mm": distance}) == f"a and b {words}"


def test_two_links_have_no_pair_that_could_touch() -> None:
    """A joint connects them: there is nothing to keep, and a plan all the same."""
    links = [Body(f"link {j}", j, np.array([[0.0, 0, 0, length, 0, 0, 20]])) for j, length in ((1, 300.0), (2, 200.0))]
    cell = Cell(tuple(links), apart=frozenset([frozenset(["link 1", "link 2"])]))
    assert solve(DesignProblem.of(Model(Arm(np.array([300.0, 200.0]), cell=cell))), 6).certified_optimal
