"""Residuals as errors of joints: their sign, their size, and the curve between two models."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from doe.report.page import svg
from identification import Arm, Calibration, Compared, Conditions, EffectSpec, Model
from identification.documents.pictures import AFTER, BEFORE, dots, joint_errors, share_of, signed_figures
from identification.error_curve import ErrorCurve

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


def model_with(effect: EffectSpec, **values: float) -> Model:
    """Two links with one effect of these values [rad]."""
    found = {f"{effect.key}.{name}": value for name, value in values.items()}
    return Model(Arm(LENGTHS, effects=(effect,), calibration=Calibration(found)))


def points_and_line(axes: Axes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(m, 2) points before, (m, 2) after, and the black ones, (0, 2) without any."""
    black = [line.get_xydata() for line in axes.lines if line.get_color() == "k" and len(line.get_xdata())]
    before, after = (
        next(a for a in axes.lines if a.get_color() == color and a.get_marker() == ".") for color in (BEFORE, AFTER)
    )
    return before.get_xydata(), after.get_xydata(), black[0] if black else np.empty((0, 2))


def test_the_line_is_the_effect_of_the_model_and_the_points_before_lack_it() -> None:
    """A gear ripple of nine periods a turn in fourteen rows: no smoother of rows shows it. Whatever the earlier model
    leaves, here what wrong lengths do, the red points are on the wave where the blue ones are on zero."""
    q = np.random.default_rng(7).uniform(-1.5, 1.5, (14, 2))
    real = model_with(EffectSpec("transmission_ripple", 2, {"k": 9.0}), a=1e-3)
    nothing = np.zeros((14, 2))
    plain = Compared(real.arm, q, nothing, nothing)
    grid, wave, _, smooth = share_of(real, real.effects[0], plain, real.joint_levers(q)[:, :, 1])
    assert smooth
    basis = np.column_stack([np.sin(9.0 * grid), np.cos(9.0 * grid)])
    part = np.linalg.lstsq(basis, wave, rcond=None)[0]
    assert np.hypot(*part) == pytest.approx(1e-3, rel=1e-3)
    np.testing.assert_allclose(basis @ part, wave, atol=2e-6)  # to first order
    before = np.random.default_rng(5).normal(size=(14, 2))
    rows = Compared(real.arm, q, before, np.zeros((14, 2)), model=real, named=[real.effects[0].label])
    first, second = (f.axes[0] for f in signed_figures(rows))
    assert (second.get_title(), second.get_xlabel()) == ("transmission_ripple:2[k=9]", "joint 2 [deg]")
    red, blue, line = points_and_line(second)
    np.testing.assert_allclose(line, np.degrees(np.column_stack([grid, wave])))
    expected = np.column_stack([np.sin(9.0 * q[:, 1]), np.cos(9.0 * q[:, 1])]) @ part  # at the angles themselves
    np.testing.assert_allclose(np.radians(red[:, 1]), expected, atol=2e-6)
    np.testing.assert_array_equal(blue[:, 1], 0.0)
    red, _, line = points_and_line(first)  # nothing is named there: the earlier model, no line
    np.testing.assert_allclose(np.radians(red[:, 1]), joint_errors(real.joint_levers(q), before)[:, 0])
    assert len(line) == 0
    read = str(rows.pictures("the drawing", "the model").draw()[0])
    assert "Line, or the smallest dots: what these effects add" in read
    assert "black" not in read.lower().split()  # on a dark page the line is white


def test_an_error_curve_is_off_beyond_its_angles() -> None:
    curve = ErrorCurve(-1.0, 1.0, np.array([0.0, 1e-3, -1e-3, 2e-3, 0.0]))
    arm = Arm(LENGTHS, effects=(EffectSpec("joint_error_curve", 2, curve=curve),), calibration=Calibration({}))
    angles = np.concatenate([np.linspace(-0.9, 0.9, 40), np.linspace(2.2, 3.0, 20)])
    q, nothing = np.column_stack([np.zeros(60), angles]), np.zeros((60, 2))
    rows = Compared(arm, q, nothing, nothing, model=Model(arm), named=["joint_error_curve:2"])
    axes = signed_figures(rows)[1].axes[0]
    red, _, line = points_and_line(axes)
    np.testing.assert_allclose(np.radians(red[:40, 1]), curve.at(angles[:40]), atol=1e-12)
    np.testing.assert_array_equal(red[40:, 1], 0.0)
    np.testing.assert_array_equal(line[line[:, 0] > 130.0, 1], 0.0)
    assert axes.get_title() == "joint_error_curve:2"


def test_no_label_leaves_a_small_picture() -> None:
    """The numbers beside the ticks decide how much room these have, and so how many there are; whatever the scale."""
    for size in (0.02, 0.05, 0.09):
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes = figure.subplots()
        dots(axes, np.linspace(0.0, 100.0, 30), [(np.full(30, size), "before"), (np.full(30, -size), "after")])
        axes.set_ylabel("error [deg]")
        svg(figure)
        label = axes.yaxis.label.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        assert label.x0 > -2.0  # pixels of the font's own margin


def test_a_small_picture_names_a_few_effects_and_counts_the_others() -> None:
    waves = tuple(EffectSpec("transmission_ripple", 2, {"k": float(k)}) for k in range(3, 9))
    arm = Arm(LENGTHS, effects=waves, calibration=Calibration({}))
    q, nothing = np.random.default_rng(3).uniform(-1.5, 1.5, (14, 2)), np.zeros((14, 2))
    rows = Compared(arm, q, nothing, nothing, model=Model(arm), named=[e.label for e in Model(arm).effects])
    lines = signed_figures(rows)[1].axes[0].get_title().splitlines()
    assert (len(lines), lines[-1]) == (4, "and 3 more")


def test_an_effect_that_is_no_function_of_the_angle_is_drawn_at_the_rows() -> None:
    """Backlash: b this way or that way, by the side from which the joint came."""
    q = np.random.default_rng(9).uniform(-1.0, 1.0, (30, 2))
    sides = np.sign(np.random.default_rng(10).normal(size=(30, 2)))
    model = model_with(EffectSpec("backlash", 2), b=2e-3)
    nothing = np.zeros((30, 2))
    rows = Compared(model.arm, q, nothing, nothing, Conditions(directions=sides), model, ["backlash:2"])
    red, _, black = points_and_line(signed_figures(rows)[1].axes[0])
    np.testing.assert_allclose(np.radians(red[:, 1]), 2e-3 * sides[:, 1], rtol=1e-3)
    np.testing.assert_allclose(black, red)
