"""Capsules and boxes contain what they cover, and little more."""

import numpy as np
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from identification import Array
from identification.cover import boxes_around, capsules_around, from_capsules, objective
from identification.files.bodies import Shape
from identification.kinematics.frames import from_roll_pitch_yaw, pose

PLACE = pose((100.0, -50.0, 30.0), from_roll_pitch_yaw(0.3, -1.0, 2.0))
BOX = Shape("box", np.eye(4), np.array([120.0, 60.0, 40.0])).triangles()
CYLINDER = Shape("cylinder", np.eye(4), np.array([50.0, 400.0])).triangles()
ANGLE = np.concatenate(
    [
        Shape("box", pose(), np.array([640.0, 100.0, 100.0])).triangles(),
        Shape("box", pose(), np.array([100.0, 100.0, 300.0])).triangles() + np.array([-270.0, 0.0, 200.0]),
    ]
)


def samples(triangles: Array, count: int) -> Array:
    """Points of the surface."""
    random = np.random.default_rng(5)
    faces = triangles[random.integers(len(triangles), size=count)]
    return np.asarray(np.einsum("ni,nij->nj", random.dirichlet(np.ones(3), size=count), faces))


def outside_boxes(boxes: Array, points: Array) -> Array:
    """How far points stick out of all boxes, along their axes."""
    turns = boxes[:, 3:12].reshape(-1, 3, 3)
    inside = np.einsum("kij,nki->nkj", turns, points[:, None] - boxes[:, :3])
    return np.asarray((np.abs(inside) - boxes[:, 12:]).max(axis=2).min(axis=1))


corners = st.floats(-300.0, 300.0, allow_subnormal=False)


@given(st.integers(1, 8).flatmap(lambda count: arrays(float, (count, 3, 3), elements=corners)))
@settings(max_examples=5, phases=[Phase.explicit, Phase.reuse, Phase.generate])
def test_any_faces_are_contained(triangles: Array) -> None:
    """Flat, thin, far apart, of no area."""
    points = samples(triangles, 1000)
    assert from_capsules(capsules_around(triangles, most=3), points)[0].min(axis=1).max() < 1e-6
    assert outside_boxes(boxes_around(triangles), points).max() < 1e-6


def test_a_solid_is_contained_inside_too() -> None:
    """Not the surface alone: a grid of points of the box and of the cylinder."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 12)] * 3), axis=-1).reshape(-1, 3)
    in_box = grid * [60.0, 30.0, 20.0]
    in_cylinder = grid[np.hypot(*grid.T[:2]) <= 1.0] * [50.0, 50.0, 200.0]
    for triangles, points in ((BOX, in_box), (CYLINDER, in_cylinder)):
        assert from_capsules(capsules_around(triangles, most=4), points)[0].min(axis=1).max() < 1e-6
        assert outside_boxes(boxes_around(triangles), points).max() < 1e-6


def test_a_box_is_itself() -> None:
    found = boxes_around(BOX, PLACE)
    np.testing.assert_allclose(found, [[*PLACE[:3, 3], *PLACE[:3, :3].ravel(), 60.0, 30.0, 20.0]], atol=1e-9)


def test_an_angle_is_few_boxes() -> None:
    """They have its volume, and at most that of a cell (640 mm / 64) along the cut between them."""
    found = boxes_around(ANGLE)
    assert len(found) <= 3
    assert 640e4 + 300e4 - 1.0 <= np.sum(np.prod(2.0 * found[:, 12:], axis=1)) <= 640e4 + 300e4 + 64e4


def test_capsules_follow_a_bend() -> None:
    """The volume of the cover, by sampling, is larger than that of the body, and smaller than that of its convex hull,
    which no single convex piece can be."""
    capsules = capsules_around(ANGLE)
    points = np.random.default_rng(2).uniform([-400.0, -130.0, -130.0], [400.0, 130.0, 430.0], (50_000, 3))
    volume = np.mean(from_capsules(capsules, points)[0].min(axis=1) <= 0.0) * 800.0 * 260.0 * 560.0
    assert 640e4 + 300e4 < volume < ConvexHull(ANGLE.reshape(-1, 3)).volume


def test_a_ball_is_one_capsule() -> None:
    turn, up = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 33), np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17))
    ball = 80.0 * np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], axis=-1)
    a, b, c, d = ball[:-1, :-1], ball[:-1, 1:], ball[1:, :-1], ball[1:, 1:]
    faces = np.concatenate([np.stack([a, b, c], axis=2), np.stack([b, d, c], axis=2)]).reshape(-1, 3, 3)
    ((*_, radius),) = found = capsules_around(faces)
    assert 80.0 <= radius < 84.0
    assert np.linalg.norm(found[0, :3] - found[0, 3:6]) < 8.0


def test_slopes_of_the_fit() -> None:
    """Against central differences, of three capsules."""
    random = np.random.default_rng(0)
    flat = 50.0 * random.normal(size=21)
    flat[6::7] = np.abs(flat[6::7])
    surface, around = 80.0 * random.normal(size=(50, 3)), 80.0 * random.normal(size=(70, 3))
    both = [[objective(flat + step, surface, around, 3.0)[0] for step in (e, -e)] for e in 1e-5 * np.eye(21)]
    slopes = np.array([(plus - minus) / 2e-5 for plus, minus in both])
    np.testing.assert_allclose(objective(flat, surface, around, 3.0)[1], slopes, rtol=1e-5, atol=1e-5)
