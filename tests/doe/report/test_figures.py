"""Pictures of spatial arms: the outlines lie where the constraints are, and a figure has two views and the joints."""

from __future__ import annotations

import numpy as np

from doe.report.figures import outlines, plan_figure
from tests.doe.problem.test_spatial_constraints import ARM, PILLAR, POSTURES, SIGHT, SPHERE


def test_outlines_lie_on_what_they_show() -> None:
    lines = [line for line, _ in outlines(ARM)]
    assert {line.shape[1] for line in lines} == {3}
    balls = [line for line in lines if np.allclose(np.linalg.norm(line - SPHERE.center, axis=1), SPHERE.radius)]
    assert len(balls) == 3
    start, along = np.array(PILLAR.start), np.subtract(PILLAR.end, PILLAR.start)
    away = [np.linalg.norm(np.cross(line - start, along), axis=1) / np.linalg.norm(along) for line in lines]
    assert sum(np.allclose(each, PILLAR.radius) for each in away) == 2 + 5
    tracker = np.array(SIGHT.tracker)
    axis = np.subtract(SIGHT.toward, tracker) / np.linalg.norm(np.subtract(SIGHT.toward, tracker))
    rim = [line - tracker for line in lines if np.allclose(np.linalg.norm(line - tracker, axis=1), 3000.0)]
    assert len(rim) == 1
    np.testing.assert_allclose(rim[0] @ axis, 3000.0 * np.cos(SIGHT.half_angle))


def test_a_plan_is_seen_from_two_sides() -> None:
    figure = plan_figure(ARM, POSTURES[:5])
    views = [axes for axes in figure.axes if axes.name == "3d"]
    assert len(views) == 2
    assert len(figure.axes) == 3
    skeletons = [line for line in views[0].lines if len(line.get_xdata()) == 8]
    assert len(skeletons) == 5
