"""Residuals as errors of joints: their sign, their size, and the curve between two models."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from doe.report.gap_figures import workspace_arrows
from doe.report.page import svg
from doe.report.signed_residuals import (
    Compared,
    draw_errors,
    fitted_curve,
    fitted_curves,
    joint_error,
    joint_errors,
    kth_distances,
    signed_figures,
)
from identification.arm import Arm, Calibration, EffectSpec
from identification.model import Model

LENGTHS = np.array([300.0, 200.0])


def tip(q: np.ndarray) -> np.ndarray:
    """(m, 2) of two links in a plane, by hand."""
    angles = np.cumsum(q, axis=1)
    return np.stack([np.cos(angles) @ LENGTHS, np.sin(angles) @ LENGTHS], axis=1)


def test_a_joint_that_turns_too_far_has_a_positive_error_of_that_size() -> None:
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (40, 2))
    small = 1e-6
    levers = np.stack([(tip(q + small * unit) - tip(q - small * unit)) / (2.0 * small) for unit in np.eye(2)], axis=2)
    wrong = 1e-4 * np.sin(q[:, 1])
    measured = tip(q + wrong[:, None] * [0.0, 1.0])  # the real joint 2 is turned farther than is read
    # the second link's lever is always 200 mm long; the tip moves along the arc by error * 200 to first order
    np.testing.assert_allclose(joint_errors(levers, measured - tip(q))[:, 1], wrong, atol=1e-8)
    short = np.zeros((1, 2, 1))
    np.testing.assert_array_equal(joint_errors(np.concatenate([short, np.ones((1, 2, 1))]), np.ones((2, 2)))[0], 0.0)


def test_the_curve_is_the_change_where_there_are_rows_and_nothing_elsewhere() -> None:
    generator = np.random.default_rng(2)
    q = np.concatenate([generator.uniform(-3.0, 0.0, 400), generator.uniform(2.0, 3.0, 200)])
    lever = generator.normal(size=(600, 2))
    change = lever * (1e-3 * np.sin(4.0 * q))[:, None]
    grid, found = fitted_curve(q, lever, change)
    seen = np.isfinite(found)
    gap = (grid > 0.61) & (grid < 1.39)  # farther than a tenth of the range, 0.6, from every row
    assert not seen[gap].any()
    inside = (grid < -0.05) | (grid > 2.05)
    assert seen[inside].all()
    # a line through ten rows, some 0.04 rad to each side, misses by f'' h^2 / 2 = 16e-3 * 0.04^2 / 2, a few times that
    np.testing.assert_allclose(found[inside], 1e-3 * np.sin(4.0 * grid[inside]), atol=8e-5)
    one_angle = fitted_curve(np.full(5, 0.3), np.ones((5, 2)), np.full((5, 2), 2e-3))[1]
    np.testing.assert_allclose(one_angle[0], 2e-3)


def test_curves_of_several_joints_are_told_apart() -> None:
    q = np.random.default_rng(6).uniform(-2.0, 2.0, (1500, 2))
    lever = np.stack([np.stack([-tip(q)[:, 1], tip(q)[:, 0]], axis=1), np.zeros((1500, 2))], axis=2)
    lever[:, :, 1] = 200.0 * np.stack([-np.sin(q.sum(axis=1)), np.cos(q.sum(axis=1))], axis=1)
    real = {0: 1e-3 * np.sin(5.0 * q[:, 0]), 1: 2e-3 * np.cos(4.0 * q[:, 1])}
    change = sum(lever[:, :, j] * error[:, None] for j, error in real.items())
    found = fitted_curves(q, lever, np.asarray(change), [0, 1])
    for j, error in real.items():
        # a line through ten rows misses by f'' h^2 / 2 = 32e-3 * 0.014^2 / 2 and what the other joint's rows scatter
        assert np.sqrt(np.mean((found[j][2] - error) ** 2)) < 1e-4
    alone = fitted_curves(q, lever, np.asarray(change), [1])[1][2]
    assert np.sqrt(np.mean((alone - real[1]) ** 2)) > 2e-4


def test_the_nearest_rows_are_those_of_a_search_among_all() -> None:
    generator = np.random.default_rng(3)
    q, grid = generator.normal(size=30), np.linspace(-3.0, 3.0, 50)
    for k in (1, 3, 10):
        expected = np.sort(np.abs(q - grid[:, None]), axis=1)[:, k - 1]
        np.testing.assert_allclose(kth_distances(q, grid, k), expected)


def test_one_picture_for_each_joint_with_a_curve_where_something_was_found() -> None:
    q = np.random.default_rng(4).uniform(-1.0, 1.0, (30, 2))
    before, after = np.random.default_rng(5).normal(size=(2, 30, 2))
    arm = Arm(LENGTHS)
    first, second = (f.axes[0] for f in signed_figures(Compared(arm, q, before, after, notes={2: "backlash:2"})))
    assert (second.get_title(), second.get_xlabel()) == ("backlash:2", "joint 2 [deg]")
    lengths = [[len(line.get_xdata()) for line in axes.lines] for axes in (first, second)]
    assert 721 not in lengths[0]
    assert 721 in lengths[1]


def test_between_a_few_rows_the_line_is_what_the_effect_does() -> None:
    """A gear ripple of nine periods a turn, seen in fourteen rows: no smoother of rows shows it."""
    q = np.random.default_rng(7).uniform(-1.5, 1.5, (14, 2))
    effects = (EffectSpec("transmission_ripple", 2, {"k": 9.0}),)
    values = {"transmission_ripple:2.a": 1e-3}
    real = Model(Arm(LENGTHS, effects=effects, calibration=Calibration(values)))
    levers = real.joint_levers(q)
    change = real.position(q) - tip(q)
    grid, error, at_rows = fitted_curves(q, levers, change, [1], real)[1]
    wave = joint_error(real, 1, q)
    assert np.ptp(wave) > 1.5e-3
    np.testing.assert_allclose(error[np.isfinite(error)], wave[np.isfinite(error)], atol=2e-6)
    np.testing.assert_allclose(at_rows, np.interp(q[:, 1], grid, wave), atol=2e-6)
    sine, cosine = np.sin(9.0 * grid), np.cos(9.0 * grid)
    part = np.linalg.lstsq(np.column_stack([sine, cosine]), wave, rcond=None)[0]
    assert np.hypot(*part) == pytest.approx(1e-3, rel=1e-3)
    jagged = fitted_curves(q, levers, change, [1])[1][1]
    assert np.nanstd(jagged - wave) > 1e-4


def test_the_base_is_drawn_where_the_arm_stands() -> None:
    place = {"base_offset.x0": 1200.0, "base_offset.y0": -300.0}
    stands = Arm(LENGTHS, effects=(EffectSpec("base_offset"),), calibration=Calibration(place))
    for arm, expected in ((stands, (1200.0, -300.0)), (Arm(LENGTHS), (0.0, 0.0))):
        points, residuals = np.random.default_rng(8).normal(size=(2, 5, 2))
        axes = workspace_arrows(arm, points, ((residuals, "before"), (residuals, "after"))).axes
        assert [tuple(np.ravel(axis.lines[0].get_xydata())) for axis in axes] == [expected] * 2


def test_no_label_leaves_a_small_picture() -> None:
    """The numbers beside the ticks decide how much room these have, and so how many there are; whatever the scale."""
    for size in np.linspace(0.02, 0.09, 8):
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes = figure.subplots()
        draw_errors(axes, np.linspace(0.0, 100.0, 30), [np.full(30, size), np.full(30, -size)], ("before", "after"))
        axes.set_ylabel("error [deg]")
        svg(figure)
        label = axes.yaxis.label.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        assert label.x0 > -2.0  # pixels of the font's own margin
