"""Moves in a plane of two joints with discs, squares and pockets that are known in closed form, and of an arm with
bodies; every move sampled a hundred times finer than it was proven, and all orders of few postures."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.plan.moves import Room, Route, approaches, route
from identification import Array


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
    alone = [room.free(a[None], b[None])[0] for a, b in zip(starts, ends, strict=True)]
    assert together.tolist() == alone


def test_a_move_along_a_wall_is_not_proven_and_ends_all_the_same() -> None:
    """It touches the disc, at one place; nothing can be proven of it."""
    assert not discs((0.0, 0.0, 0.5)).free(np.array([[-1.0, 0.5]]), np.array([[1.0, 0.5]]))[0]


def test_nothing_in_the_way_and_no_move() -> None:
    assert discs().free(np.zeros((3, 2)), np.ones((3, 2))).all()
    here = np.array([[0.7, 0.0]])
    assert discs((0.0, 0.0, 0.5)).free(here, here).all()
    assert not discs((0.0, 0.0, 0.5)).free(0.5 * here, 0.5 * here).any()


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
def whole_way(postures: Array, found: Route) -> Array:
    np.testing.assert_array_equal([way[-1] for way in found.ways], postures[found.rows])
    return np.concatenate(found.ways)


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
    assert sorted(found.rows) == list(range(6))
    assert sampled(room, way) >= 0.0
    assert found.unreached == []
    assert min(lengths.values()) - 1e-9 <= room.length(way) <= min(straight, default=np.inf) + 1e-9
    if straight and min(straight) == min(lengths.values()):
        assert len(way) == 6


def test_an_order_that_is_kept_goes_round() -> None:
    room = discs((0.0, 0.0, 0.5))
    postures = np.array([[-1.0, 0.0], [1.0, 0.1], [-1.0, 0.2], [1.0, 0.3]])
    found = route(postures, room, keep_order=True)
    assert found.rows.tolist() == [0, 1, 2, 3]
    assert [len(way) > 1 for way in found.ways] == [False, True, True, True]
    assert sampled(room, whole_way(postures, found)) >= 0.0


def test_one_posture_that_cannot_be_reached_is_named() -> None:
    angles = np.radians(np.arange(0.0, 360.0, 10.0))
    room = discs(*((float(np.cos(a)), float(np.sin(a)), 0.15) for a in angles))
    postures = np.array([[1.5, 1.5], [-1.5, 1.5], [0.0, 0.0], [-1.5, -1.5], [1.5, -1.5]])
    for keep_order in (False, True):
        assert route(postures, room, keep_order=keep_order).unreached == [2]
    assert route(postures[:1], room).rows.tolist() == [0]


# -- the side from which a posture is reached --------------------------------------------------------------------------
def test_every_joint_comes_from_its_side() -> None:
    generator = np.random.default_rng(2)
    room = discs((0.0, 0.0, 0.6), (1.2, -1.0, 0.4))
    postures = generator.uniform(-1.9, 1.9, (40, 2))
    postures = postures[np.all(room.margin(postures) >= 0.0, axis=1)][:12]
    senses = np.where(generator.random(postures.shape) < 0.5, -1.0, 1.0)
    entries = approaches(postures, senses, room, generator)
    found = route(postures, room, entries)
    assert sampled(room, whole_way(postures, found)) >= 0.0
    steps = postures[found.rows] - np.array([way[-2] for way in found.ways])
    assert np.all(np.sign(steps) == senses[found.rows])
    assert np.abs(steps).max() < np.radians(10.0)


def test_no_side_is_left_at_a_limit_or_against_a_disc() -> None:
    postures = np.array([[-2.0, 1.0], [1.0, -1.0], [0.0, 0.0]])
    room = discs((-0.5, -0.5, 0.7))  # 7 mm below the last
    up = approaches(postures, np.ones((3, 2)), room, np.random.default_rng(0))
    assert np.isnan(up[:, 0]).tolist() == [True, False, True]
    down = approaches(postures, -np.ones((3, 2)), room, np.random.default_rng(0))
    assert np.isnan(down[:, 0]).tolist() == [False, False, False]
