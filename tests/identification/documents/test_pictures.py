"""Residuals as errors of joints: their sign, and their size."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from identification import Arm
from identification.documents.pictures import AFTER, BEFORE, dots, joint_errors, signed_figures

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


def test_a_picture_of_each_joint_has_what_both_models_leave() -> None:
    """Of the rows of a gear ripple in joint 2 the earlier model lacks it, the later one has it."""
    q = np.random.default_rng(7).uniform(-1.5, 1.5, (40, 2))
    wave = 1e-6 * np.sin(9.0 * q[:, 1])
    left = tip(q + wave[:, None] * [0.0, 1.0]) - tip(q)
    read, *figures = signed_figures(Arm(LENGTHS), q, [(left, "the drawing"), (np.zeros_like(left), "the model")], None)
    assert str(read).endswith("Red: the drawing. Blue: the model.")
    first, second = (figure.axes[0] for figure in figures if isinstance(figure, Figure))
    assert (first.get_xlabel(), second.get_xlabel()) == ("joint 1 [deg]", "joint 2 [deg]")
    red, blue = (
        next(line for line in second.lines if line.get_color() == color and line.get_marker() == ".").get_xydata()
        for color in (BEFORE, AFTER)
    )
    np.testing.assert_allclose(red, np.degrees(np.column_stack([q[:, 1], wave])), atol=1e-9)
    np.testing.assert_allclose(blue[:, 1], 0.0, atol=1e-12)


def test_no_label_leaves_a_small_picture() -> None:
    """The numbers beside the ticks decide how much room these have, and so how many there are; whatever the scale."""
    for size in (0.02, 0.05, 0.09):
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes = figure.subplots()
        dots(axes, np.linspace(0.0, 100.0, 30), [(np.full(30, size), "before"), (np.full(30, -size), "after")])
        axes.set_ylabel("error [deg]")
        figure.draw_without_rendering()
        label = axes.yaxis.label.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        assert label.x0 > -2.0  # pixels of the font's own margin
