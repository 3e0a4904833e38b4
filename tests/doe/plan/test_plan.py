"""Plan files: rows in the order of measurement, weights of approximate designs, exact round trips."""

from dataclasses import replace
from itertools import combinations, pairwise, permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from doe import solve
from doe.plan.moves import Room, approaches, route, shortest_path
from doe.plan.spacing import separated, spread_free_joints, too_near, with_additions
from identification import Arm, Array, Plan
from identification.kinematics.counting import Counting, JointKinds
from tests.doe.arms import FOUR, OFFSET, problem
from tests.refusals import refused


def load(tmp_path: Path, text: str, links: int | None = None) -> Plan:
    (tmp_path / "plan.csv").write_text(text)
    return Plan.load(tmp_path / "plan.csv", links)


def test_postures_as_they_are_displayed(tmp_path: Path) -> None:
    """In the units of files and as the controller counts, also of a plan that was read."""
    types = JointKinds(("revolute", "prismatic"), Counting((-1, 1), (0, 0), (np.pi / 2.0, 0.0)))
    plan, columns = Plan(np.array([[np.pi, 250.0]]), joint_types=types), [[-90.0, 250.0]]
    (tmp_path / "plan.csv").write_text(plan.text())
    for each in (plan, Plan.of_displayed(np.array(columns), types), Plan.load(tmp_path / "plan.csv", types)):
        np.testing.assert_allclose(each.displayed, columns, atol=1e-12)
        np.testing.assert_allclose(each.postures, plan.postures)
        assert {**each.to_json(), "postures": []} == {"postures": [], "joint_units": ["deg", "mm"]}


def test_text_is_as_documented() -> None:
    assert Plan(np.radians([[30, -60], [90, 0]])).text() == "run,q1_deg,q2_deg\n1,30.0,-60.0\n2,90.0,0.0\n"
    assert Plan([[0.0], [np.pi]], [0.25, 0.75]).text() == "run,q1_deg,weight\n1,0.0,0.25\n2,180.0,0.75\n"


def test_reading(tmp_path: Path) -> None:
    plan = load(tmp_path, "run,q1_deg,q2_deg\n1,30,-60\n2,400,0\n", links=2)
    np.testing.assert_allclose(plan.postures, np.radians([[30, -60], [400, 0]]))  # nothing is clipped
    assert plan.weights is None
    plan = load(tmp_path, "q1_rad,weight\n3,0\n1.5,1\n")
    np.testing.assert_array_equal(plan.postures, [[3], [1.5]])
    np.testing.assert_array_equal(plan.weights, [0, 1])


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("run,q1_deg\n", ["no rows"]),
        ("run,weight\n1,1\n", ["'q1_deg' is missing"]),
        ("run,q1_deg\n1,1\n2,nan\n", ["row 2 (line 3), column q1_deg", "found 'nan'", "allowed: a finite angle"]),
        ("q1_deg,weight\n1,1.5\n2,-0.5\n", ["row 2 (line 3), column weight", "found '-0.5'", "allowed: a number >= 0"]),
        ("q1_deg,weight\n1,0.5\n2,0.4\n", ["column weight", "found a sum of 0.9", "allowed: 1 (within 1e-06)"]),
        ("q1_deg,weight\n1,0.5\n2,0.500002\n", ["column weight", "found a sum of 1.000002", "allowed: 1"]),
        ("q1_deg;weight\n1,5;0,5\n2;0,4\n", ["column weight", "found a sum of 0.9"]),
        ("kind,q1_deg\nvia,0\n", ["column kind: found only via, allowed: at least 1 row measure"]),
        ("kind,q1_deg\nvia,0\nmesure,0\n", ["row 2 (line 3), column kind: found 'mesure', allowed: measure or via"]),
    ],
)
def test_bad_input_gets_one_line(tmp_path: Path, text: str, parts: list[str]) -> None:
    refused(load, tmp_path, text, names=["plan.csv: ", *parts])


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Exact and approximate plans."""
    m, n = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    weights = draw(st.none() | arrays(float, m, elements=st.floats(0.0, 1.0)))
    if weights is not None and weights.sum() > 0.1:
        weights = weights / weights.sum()
    elif weights is not None:
        weights = np.eye(m)[0]
    return Plan(draw(arrays(float, (m, n), elements=st.floats(-10, 10))), weights)


@given(plans())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, plan: Plan) -> None:
    path = tmp_path_factory.mktemp("plan") / "plan.csv"
    path.write_text(plan.text())
    again = Plan.load(path, plan.links)
    np.testing.assert_allclose(again.postures, plan.postures, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(again.shares, plan.shares)
    assert (again.weights is None) == (plan.weights is None)


# -- order of measurement ----------------------------------------------------------------------------------------------
def costs(postures: np.ndarray) -> np.ndarray:
    return np.abs(postures[:, None] - postures).max(axis=-1)


def by_hand(postures: np.ndarray) -> float:
    return float(sum(max(abs(a - b) for a, b in zip(p, q, strict=True)) for p, q in pairwise(postures)))


@pytest.mark.parametrize("seed", range(5))
def test_shortest_of_all_permutations(seed: int) -> None:
    postures = np.random.default_rng(seed).uniform(-2, 2, (7, 3))
    best = min(by_hand(postures[list(p)]) for p in permutations(range(7)))
    path = shortest_path(costs(postures))
    assert sorted(path) == list(range(7))
    assert by_hand(postures[path]) == pytest.approx(best)


def test_long_plans_have_no_exchange_left_and_gain() -> None:
    postures = np.random.default_rng(3).uniform(-2, 2, (60, 4))
    found = postures[shortest_path(costs(postures))]
    assert by_hand(found) < 0.7 * by_hand(postures)
    for i, k in combinations(range(1, 60), 2):
        assert by_hand(np.vstack([found[:i], found[i:k][::-1], found[k:]])) >= by_hand(found) - 1e-9


# -- postures apart ----------------------------------------------------------------------------------------------------
NARROW = Arm([200.0, 150.0], np.radians([-40, -50]), np.radians([40, 60]))
CORNERS = np.array([[a, b] for a in (NARROW.lower[0], NARROW.upper[0]) for b in (NARROW.lower[1], NARROW.upper[1])])


def smallest_gap(postures: np.ndarray) -> float:
    """[rad] least difference of two postures, each in the joint where it is greatest."""
    return min(np.abs(postures[k + 1 :] - postures[k]).max(axis=1).min() for k in range(len(postures) - 1))


def test_repeats_are_moved_apart_at_little_loss() -> None:
    case, plan = problem(NARROW, OFFSET), np.vstack([CORNERS, CORNERS])
    assert len(too_near(case, plan)) == 4
    apart = separated(case, plan)
    assert smallest_gap(apart) >= np.radians(1.0) * (1 - 1e-9)
    assert np.all((apart >= case.lower) & (apart <= case.upper))
    assert case.objective(plan) > case.objective(apart) > case.objective(plan) - 0.1
    np.testing.assert_array_equal(separated(case, apart), apart)


@pytest.mark.parametrize("solver", ["exchange", "ipopt"])
def test_plans_have_repeats_only_when_asked_for(solver: str) -> None:
    """On two joints, eight runs want the four corners twice."""
    apart = solve(problem(NARROW, OFFSET), 8, solver, starts=10)
    assert smallest_gap(apart.plan.postures) >= np.radians(1.0) * (1 - 1e-9)
    assert solve(problem(NARROW, OFFSET, minimum_distance=0.0), 8, solver, starts=10).value > apart.value
    wide = solve(problem(NARROW, OFFSET, minimum_distance=np.radians(25.0)), 8, solver, starts=10)
    assert smallest_gap(wide.plan.postures) >= np.radians(25.0) * (1 - 1e-9)
    assert wide.value < apart.value


def test_a_free_joint_has_no_more_places_than_fit_at_the_minimum_distance() -> None:
    """Joint 1 turns by 3.5 deg: three alike postures may stay, the others are moved in the joints that matter."""
    arm = Arm(FOUR.lengths, np.r_[0.0, FOUR.lower[1:]], np.r_[np.radians(3.5), FOUR.upper[1:]])
    case = problem(arm)
    spread = spread_free_joints(case, np.tile((arm.lower + arm.upper) / 2, (5, 1)), np.random.default_rng(0))
    assert too_near(case, spread).tolist() == [3, 4]
    apart = separated(case, spread)
    assert smallest_gap(apart) >= np.radians(1.0) * (1 - 1e-9)
    assert np.all((apart >= arm.lower) & (apart <= arm.upper))


def test_measured_postures_are_not_repeated() -> None:
    design = solve(problem(NARROW, OFFSET, kept=CORNERS), 4, starts=10)
    assert smallest_gap(np.vstack([design.plan.postures, CORNERS])) >= np.radians(1.0) * (1 - 1e-9)


@pytest.mark.parametrize("rows", [150, 400])
def test_repeats_are_those_of_all_pairs(rows: int) -> None:
    case = problem(NARROW, OFFSET, kept=np.zeros((3, 2)))
    plan = np.random.default_rng(0).uniform(case.lower, case.upper, (rows, 2))
    plan[5] = 0.0
    every = np.concatenate([case.kept, plan])
    near = [k for k in range(rows) if np.abs(every[: 3 + k] - plan[k]).max(axis=1).min() < np.radians(1.0)]
    assert too_near(case, plan).tolist() == near


# -- additions ---------------------------------------------------------------------------------------------------------
def whole_information(lengths: Array, postures: Array) -> Array:
    """(2n, 2n) sum of B^T B: a link moves the tip by exp(i theta), a joint all links from it on across themselves."""
    links = np.exp(1j * np.cumsum(postures, axis=1))
    levers = 1j * np.cumsum((links * lengths)[:, ::-1], axis=1)[:, ::-1] / lengths
    columns = np.concatenate([links, levers], axis=1)
    return (columns.conj().T @ columns).real


def test_the_posture_that_adds_most() -> None:
    """log det gains log det(I + B M^-1 B^T): no posture of a fine grid gains more."""
    case = problem(FOUR)
    generator = np.random.default_rng(1)
    plan = generator.uniform(FOUR.lower, FOUR.upper, (6, 4))
    longer = with_additions(case, plan, 1, generator)
    assert np.array_equal(longer[:6], plan)
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 25) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True))))
    places = np.column_stack([np.zeros(25**3), grid.reshape(3, -1).T])
    now = np.linalg.slogdet(whole_information(np.array(FOUR.lengths), longer))[1]
    best = max(
        np.linalg.slogdet(whole_information(np.array(FOUR.lengths), np.vstack([plan, one])))[1] for one in places[::3]
    )
    assert now >= best - 1e-3


def test_of_a_list_each_posture_once() -> None:
    choices = np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (8, 4))
    case = problem(FOUR, choices=choices)
    generator = np.random.default_rng(0)
    assert len(np.unique(with_additions(case, choices[:6], 2, generator), axis=0)) == 8
    assert with_additions(case, choices[:6], 3, generator) is None
    assert with_additions(replace(case, minimum_distance=0.0), choices[:6], 3, generator) is not None


# -- moves -------------------------------------------------------------------------------------------------------------
def discs(*places: tuple[float, float, float]) -> Room:
    """Discs (x, y, radius) in the plane of the joints, where 1 rad is 100 mm."""
    centers, radii = np.split(np.array(places).reshape(-1, 3), [2], axis=1)

    def margin(postures: Array) -> Array:
        return 100.0 * (np.linalg.norm(postures[:, None] - centers, axis=2) - radii[:, 0])

    # by Cauchy and Schwarz a distance changes by at most the way, and that is at most |dq_1| + |dq_2|
    return Room(margin, np.full((len(places), 2), 100.0), np.full(2, -2.0), np.full(2, 2.0), np.ones(2))


def sampled(room: Room, way: Array, count: int = 4000) -> float:
    """Least margin at so many postures of each straight move of a way (v, n)."""
    shares = np.linspace(0.0, 1.0, count)[:, None]
    return min(float(room.margin(a + shares * (b - a)).min(initial=np.inf)) for a, b in pairwise(way))


def distance_to_segment(point: Array, a: Array, b: Array) -> float:
    share = np.clip((point - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(a + share * (b - a) - point))


coordinate = st.floats(-2.0, 2.0)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=2), coordinate, coordinate, st.floats(0.05, 1))
def test_a_move_is_free_where_it_misses_the_disc(ends: list[tuple[float, float]], x: float, y: float, r: float) -> None:
    """Never where the segment meets the disc, always where it is half a millimetre away (1 rad is 100 mm)."""
    a, b = np.array(ends)
    room = discs((x, y, r))
    gap = 100.0 * (distance_to_segment(np.array([x, y]), a, b) - r)
    proven = bool(room.free(a[None], b[None])[0])
    assert not (proven and gap < -1e-9)
    assert proven or gap < 0.5


def test_many_moves_at_once_are_each_as_alone() -> None:
    generator = np.random.default_rng(0)
    room = discs((0.0, 0.0, 0.5), (1.0, 1.0, 0.4), (-1.0, 0.3, 0.3))
    starts, ends = generator.uniform(-2.0, 2.0, (2, 80, 2))
    together, seen = room.free(starts, ends), room.free(starts, ends, levels=3)
    assert 10 < together.sum() <= seen.sum() < 70  # what is seen to collide is not free
    assert not np.any(together & ~seen)
    assert together.tolist() == [room.free(a[None], b[None])[0] for a, b in zip(starts, ends, strict=True)]


def test_a_move_along_a_wall_is_not_proven_and_ends_all_the_same() -> None:
    """It touches the disc, at one place; nothing can be proven of it."""
    assert not discs((0.0, 0.0, 0.5)).free(np.array([[-1.0, 0.5]]), np.array([[1.0, 0.5]]))[0]


# -- ways round --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(5))
def test_a_way_round_a_disc_is_near_the_shortest(seed: int) -> None:
    """The joint that goes 3 rad need not turn back: no way is shorter, and one by way of (0, 1.3) is as long."""
    room, ends = discs((0.0, 0.0, 0.8)), np.array([[-1.5, 0.0], [1.5, 0.0]])
    way = whole_way(ends, route(ends, room, seed=seed))
    assert sampled(room, way) >= 0.0
    assert room.length(way) < 1.15 * 3.0


def test_a_way_out_of_a_pocket() -> None:
    """A ring of discs with one gap, of 0.35 rad, around the end: several way-points, through the gap."""
    angles = np.radians(np.arange(30.0, 331.0, 10.0))
    room = discs(*((float(np.cos(a)), float(np.sin(a)), 0.15) for a in angles))
    ends = np.array([[-1.8, 0.0], [0.0, 0.0]])
    way = whole_way(ends, route(ends, room, seed=1))
    assert sampled(room, way) >= 0.0
    crossing = [a + s * (b - a) for a, b in pairwise(way) for s in np.linspace(0.0, 1.0, 500)]
    ring = min(crossing, key=lambda q: abs(np.linalg.norm(q) - 1.0))
    assert abs(np.degrees(np.arctan2(ring[1], ring[0]))) < 30.0


# -- orders ------------------------------------------------------------------------------------------------------------
def whole_way(postures: Array, found: tuple[Array, list[Array], list[int]]) -> Array:
    np.testing.assert_array_equal([way[-1] for way in found[1]], postures[found[0]])
    return np.concatenate(found[1])


@pytest.mark.parametrize("seed", range(6))
def test_no_permutation_that_is_free_is_shorter_than_the_order(seed: int) -> None:
    """Of six postures; where the shortest of all is free, it is that."""
    generator = np.random.default_rng(seed)
    room = discs((0.0, 0.0, 0.6), (1.2, -1.0, 0.4), (-1.1, 1.0, 0.4))
    postures = generator.uniform(-2.0, 2.0, (60, 2))
    postures = postures[np.all(room.margin(postures) >= 0.0, axis=1)][:6]
    gap = {
        (i, k): min(
            100.0 * (distance_to_segment(np.array(place[:2]), postures[i], postures[k]) - place[2])
            for place in ((0.0, 0.0, 0.6), (1.2, -1.0, 0.4), (-1.1, 1.0, 0.4))
        )
        for i, k in permutations(range(6), 2)
    }
    assert not any(0.0 <= each < 0.5 for each in gap.values())  # none so near that it is left open
    lengths = {
        order: sum(np.abs(postures[i] - postures[k]).max() for i, k in pairwise(order))
        for order in permutations(range(6))
    }
    straight = [length for order, length in lengths.items() if all(gap[pair] > 0.0 for pair in pairwise(order))]
    found = route(postures, room)
    way = whole_way(postures, found)
    assert sorted(found[0]) == list(range(6))
    assert sampled(room, way) >= 0.0
    assert found[2] == []
    assert min(lengths.values()) - 1e-9 <= room.length(way) <= min(straight, default=np.inf) + 1e-9
    if straight and min(straight) == min(lengths.values()):
        assert len(way) == 6


def test_an_order_that_is_kept_goes_round() -> None:
    room = discs((0.0, 0.0, 0.5))
    postures = np.array([[-1.0, 0.0], [1.0, 0.1], [-1.0, 0.2], [1.0, 0.3]])
    found = route(postures, room, keep_order=True)
    assert found[0].tolist() == [0, 1, 2, 3]
    assert [len(way) > 1 for way in found[1]] == [False, True, True, True]
    assert sampled(room, whole_way(postures, found)) >= 0.0


def test_one_posture_that_cannot_be_reached_is_named() -> None:
    angles = np.radians(np.arange(0.0, 360.0, 10.0))
    room = discs(*((float(np.cos(a)), float(np.sin(a)), 0.15) for a in angles))
    postures = np.array([[1.5, 1.5], [-1.5, 1.5], [0.0, 0.0], [-1.5, -1.5], [1.5, -1.5]])
    for keep_order in (False, True):
        assert route(postures, room, keep_order=keep_order)[2] == [2]
    assert route(postures[:1], room)[0].tolist() == [0]


# -- the side from which a posture is reached --------------------------------------------------------------------------
def test_every_joint_comes_from_its_side() -> None:
    generator = np.random.default_rng(2)
    room = discs((0.0, 0.0, 0.6), (1.2, -1.0, 0.4))
    postures = generator.uniform(-1.9, 1.9, (40, 2))
    postures = postures[np.all(room.margin(postures) >= 0.0, axis=1)][:12]
    senses = np.where(generator.random(postures.shape) < 0.5, -1.0, 1.0)
    found = route(postures, room, approaches(postures, senses, np.eye(2), room, generator))
    assert sampled(room, whole_way(postures, found)) >= 0.0
    steps = postures[found[0]] - np.array([way[-2] for way in found[1]])
    assert np.all(np.sign(steps) == senses[found[0]])
    assert np.abs(steps).max() < np.radians(10.0)


def test_no_side_is_left_at_a_limit_or_against_a_disc() -> None:
    postures = np.array([[-2.0, 1.0], [1.0, -1.0], [0.0, 0.0]])
    room = discs((-0.5, -0.5, 0.7))  # 7 mm below the last
    up = approaches(postures, np.ones((3, 2)), np.eye(2), room, np.random.default_rng(0))
    assert np.isnan(up[:, 0]).tolist() == [True, False, True]
    down = approaches(postures, -np.ones((3, 2)), np.eye(2), room, np.random.default_rng(0))
    assert np.isnan(down[:, 0]).tolist() == [False, False, False]
