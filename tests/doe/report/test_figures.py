"""Pictures of spatial arms: the outlines lie where the constraints are, and a figure has two views and the joints."""

from __future__ import annotations

import numpy as np

from doe.report.figures import outlines, plan_figure
from identification.arm import Arm, Calibration, EffectSpec
from identification.documents.pictures import workspace_arrows
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


def test_of_very_many_postures_some_are_drawn() -> None:
    """The first and the last among them, and the title says so; every angle stands beside them."""
    planar = Arm([300.0, 200.0])
    postures = np.linspace([-1.0, 0.5], [1.0, 1.5], 4000)
    plane, joints = plan_figure(planar, postures).axes
    assert plane.get_title() == "500 of 4000 postures"
    figures = [line for line in plane.lines if len(line.get_xdata()) == 3]
    assert len(figures) == 500
    for line, q in ((figures[0], postures[0]), (figures[-1], postures[-1])):
        tip = 300.0 * np.exp(1j * q[0]) + 200.0 * np.exp(1j * (q[0] + q[1]))
        np.testing.assert_allclose([line.get_xdata()[-1], line.get_ydata()[-1]], [tip.real, tip.imag])
    assert sum(len(shown.get_offsets()) for shown in joints.collections) == 2 * 4000


def test_the_base_is_drawn_where_the_arm_stands() -> None:
    place = {"base_offset.x0": 1200.0, "base_offset.y0": -300.0}
    stands = Arm([300.0, 200.0], effects=(EffectSpec("base_offset"),), calibration=Calibration(place))
    for arm, expected in ((stands, (1200.0, -300.0)), (Arm([300.0, 200.0]), (0.0, 0.0))):
        points, residuals = np.random.default_rng(8).normal(size=(2, 5, 2))
        axes = workspace_arrows(arm, points, ((residuals, "before"), (residuals, "after"))).axes
        assert [tuple(np.ravel(axis.lines[0].get_xydata())) for axis in axes] == [expected] * 2
