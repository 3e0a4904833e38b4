"""Constraints of space against brute force: points along links from products of exponentials."""

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from doe.problem.constraints import LINK_RADIUS, _distance, constraints_of
from identification import Array, Model
from identification.instruments import Distance
from identification.workspace import KeepOut, LineOfSight, WorkspaceBox
from tests.doe.six_axis import CHAIN, REFLECTOR, SIX_AXIS
from tests.identification.kinematics.test_spatial import places_by_exponentials, tip_by_exponentials

BOX = WorkspaceBox((-900.0, 1000.0), (-1000.0, 900.0), (50.0, 1200.0))
SPHERE = KeepOut((500.0, 300.0, 400.0), 250.0)
PILLAR = KeepOut((-500.0, 400.0, 100.0), 230.0, (-450.0, 500.0, 800.0))
FACING = (0.0, 0.6, 0.8)
SIGHT = LineOfSight(
    (2500.0, -600.0, 700.0), np.radians(20.0), (0.0, 0.0, 500.0), (2000.0, 3000.0), FACING, np.radians(70.0)
)
ARM = replace(SIX_AXIS, constraints=(BOX, SPHERE, PILLAR, SIGHT))
MADE = constraints_of(Model(ARM))
POSTURES = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (600, 6))
SHARES = np.linspace(0.0, 1.0, 401)[:, None]


def links(posture: Array) -> list[Array]:
    """Per link, points along it: from joint to joint (the first two are both at the base), and to the reflector."""
    places = [frame[:3, 3] for frame in places_by_exponentials(CHAIN, posture, {})[:-1]]
    places.append(tip_by_exponentials(CHAIN, posture, {}, REFLECTOR))
    return [a + SHARES * (b - a) for a, b in pairwise(places)]


def test_the_box_is_of_space_whatever_is_read() -> None:
    """A length is one number, the tip has three coordinates: the margins are those of an arm with a tracker."""
    bar = replace(ARM, chain=replace(ARM.chain, instrument=Distance()), constraints=(BOX,))
    margins = constraints_of(Model(bar))[0].margin(POSTURES[:50])
    np.testing.assert_allclose(margins, MADE[0].margin(POSTURES[:50]), atol=1e-9)


def test_constraints_hold_for_every_reflector() -> None:
    """The worst margin of two reflectors is that of an arm with the one or with the other."""
    tools = {"1": REFLECTOR, "2": np.array([-80.0, 30.0, 150.0])}
    chains = (replace(CHAIN, tools={name: tools[name] for name in names}) for names in ("1", "2", "12"))
    for kinds in zip(*(constraints_of(Model(replace(ARM, chain=chain))) for chain in chains), strict=True):
        one, other, both = (each.margin(POSTURES[:200]).min(axis=1) for each in kinds)
        np.testing.assert_allclose(both, np.minimum(one, other), rtol=0, atol=1e-8)


def test_the_box_has_a_floor_and_a_ceiling() -> None:
    for posture, margin in zip(POSTURES[:50], MADE[0].margin(POSTURES[:50]), strict=True):
        x, y, z = links(posture)[-1][-1]
        expected = [x + 900, 1000 - x, y + 1000, 900 - y, z - 50, 1200 - z]
        np.testing.assert_allclose(sorted(margin), sorted(expected), atol=1e-8)


def test_spheres_see_every_link() -> None:
    for posture, margin in zip(POSTURES[:50], MADE[1].margin(POSTURES[:50]), strict=True):
        nearest = [np.linalg.norm(points - SPHERE.start, axis=1).min() - SPHERE.radius for points in links(posture)]
        np.testing.assert_allclose(margin, nearest, atol=0.8)  # points are up to 1.6 mm apart


def test_cylinders_see_every_link() -> None:
    """Points are in the cylinder or the half balls on its ends."""
    inside, start, along = 0, np.array(PILLAR.start), np.subtract(PILLAR.end, PILLAR.start)
    for posture, margin in zip(POSTURES, MADE[2].margin(POSTURES), strict=True):
        for points, own in zip(links(posture), margin, strict=True):
            height = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
            hit = bool((np.linalg.norm(points - start - height[:, None] * along, axis=1) < PILLAR.radius).any())
            assert hit == (own < 0) or abs(own) < 0.8
            inside += hit
    assert inside > 50


def seen(posture: Array) -> list[float]:
    """Signed figures of each condition: cone, range, acceptance, clearance of every link but the last."""
    tracker, every = np.array(SIGHT.tracker), links(posture)
    view = every[-1][-1] - tracker
    distance, unit = np.linalg.norm(view), view / np.linalg.norm(view)
    axis = np.subtract(SIGHT.toward, tracker) / np.linalg.norm(np.subtract(SIGHT.toward, tracker))
    looks = places_by_exponentials(CHAIN, posture, {})[-1][:3, :3] @ np.array(FACING)
    reach = SIGHT.reach or (0.0, np.inf)
    found = [SIGHT.half_angle - np.arccos(unit @ axis), distance - reach[0], reach[1] - distance]
    found.append(SIGHT.acceptance - np.arccos(-unit @ looks))
    beam = tracker + np.linspace(0.0, 1.0, 401)[:, None] * view
    for points in every[:-1]:
        found.append(np.linalg.norm(points[::8, None] - beam, axis=2).min() - LINK_RADIUS * Model(ARM).reach)
    return found


def test_line_of_sight() -> None:
    margins = MADE[3].margin(POSTURES[:60])
    for posture, margin in zip(POSTURES, margins, strict=False):
        expected = np.array(seen(posture))
        np.testing.assert_allclose(margin[1:3], expected[1:3], atol=1e-8)
        np.testing.assert_array_equal(margin[[0, 3]] > 0, expected[[0, 3]] > 0)
        np.testing.assert_allclose(margin[4:], expected[4:], atol=9.0)  # points are up to 12 mm apart
    assert (margins > 0).any(axis=0).all()
    assert (margins < 0).any(axis=0)[:4].all()
    assert (margins[:, 4:] < 0).any()


def test_distance_of_segments_is_a_bounded_least_squares_problem() -> None:
    """min |a + s (b - a) - c - t (d - c)| over 0 <= s, t <= 1, by scipy; of parallel, crossing, empty segments too."""
    ends = np.random.default_rng(3).normal(size=(4, 80, 3)) * 500.0
    ends[3, :10] = ends[2, :10] + 0.3 * (ends[1, :10] - ends[0, :10])  # parallel
    ends[3, 10:15], ends[1, 13:18] = ends[2, 10:15], ends[0, 13:18]  # points
    ends[2, 20:25] = 2.0 * (0.3 * ends[0, 20:25] + 0.7 * ends[1, 20:25]) - ends[3, 20:25]  # crossing
    points = [ca.SX.sym(name, 3) for name in "abcd"]
    found = np.asarray(ca.Function("distance", points, [_distance(*points)])(*(end.T for end in ends))).ravel()
    for a, b, c, d, own in zip(*ends, found, strict=True):
        best = lsq_linear(np.column_stack([b - a, c - d]), c - a, (0.0, 1.0), method="bvls", tol=1e-15)
        assert own == pytest.approx(np.sqrt(2.0 * best.cost), abs=1e-5)
    assert (found[20:25] < 1e-6).all()
