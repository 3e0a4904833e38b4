"""Pictures of spatial arms: the outlines lie where the constraints are, and a figure has two views and the joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpl_toolkits.mplot3d import art3d

from doe.report.figures import outlines, plan_figure
from doe.report.scene import scene, side
from identification import Model, design_model
from identification.bodies import Body, Cell
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


def test_the_bodies_of_a_cell_are_drawn_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the arm at the first posture and of the cell, seen from where the page shows them; the floor below."""
    start, end, radius = np.array([0.0, 0.0, 100.0]), np.array([0.0, 0.0, 400.0]), 50.0
    link = Body("link", 2, np.array([[*start, *end, radius]]))
    wall = Body("wall", 0, boxes=np.array([[700.0, 0.0, 300.0, *np.eye(3).ravel(), 20.0, 400.0, 300.0]]))
    arm = replace(ARM, cell=Cell((link, wall), floor=-100.0))
    drawn = []

    class Kept(art3d.Poly3DCollection):
        def __init__(self, polygons: Any, **style: Any) -> None:
            drawn.append(np.reshape(polygons, (-1, 3)))
            super().__init__(polygons, **style)

    monkeypatch.setattr(art3d, "Poly3DCollection", Kept)
    view, _ = (axes for axes in plan_figure(arm, POSTURES[:5]).axes if axes.name == "3d")
    corners = drawn[0]
    frame = design_model(Model(arm)).joint_frames(POSTURES[:1])[0, 1]
    local = (corners - frame[:3, 3]) @ frame[:3, :3]
    axial = np.clip(local[:, 2], start[2], end[2])
    away = np.linalg.norm(local - axial[:, None] * np.eye(3)[2], axis=1)
    on_link = np.isclose(away, radius, atol=1.0)
    on_wall = np.isclose(np.abs(corners - [700.0, 0.0, 300.0]), [20.0, 400.0, 300.0], atol=1.0)
    assert (on_link | on_wall.all(axis=1)).all()
    assert on_link.sum() > 100
    assert on_wall.all(axis=1).sum() >= 6
    assert any(np.allclose(line.get_data_3d()[2], -100.0) for line in view.lines)  # the edge of the floor
    assert view.get_zlim()[0] <= -100.0
    assert (view.elev, view.azim) == side(arm)


def test_a_floor_without_bodies_is_drawn() -> None:
    arm = replace(ARM, cell=Cell((Body("nothing"),), floor=-50.0))
    views = [axes for axes in plan_figure(arm, POSTURES[:2]).axes if axes.name == "3d"]
    assert all(view.get_zlim()[0] <= -50.0 for view in views)
    assert scene(design_model(Model(arm)), POSTURES[:2], [], {})["bodies"] == []
