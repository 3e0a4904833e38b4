"""The demo in one picture: where to measure, how good that is, what the measurements say, what was missing."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from doe.demo.run import Demo
from doe.design import optimality_in_words
from doe.report.pictures import AFTER, BEFORE, LIMIT, draw_arm, run_colors
from doe.report.spatial_pictures import draw_side


def overview_figure(demo: Demo) -> Figure:
    """Plan, gap step by step, and residuals against the joint at fault."""
    figure = Figure(figsize=(12.0, 3.9), layout="constrained")
    places = figure.add_gridspec(1, 3, width_ratios=[1.0, 0.95, 1.25])
    draw_plan(figure, places[0], demo)
    draw_gap(figure.add_subplot(places[1]), demo)
    draw_cause(figure.add_subplot(places[2]), demo)
    return figure


def draw_plan(figure: Figure, place: SubplotSpec, demo: Demo) -> None:
    """The postures, in the plane or in space, and how good the plan is."""
    postures, space = demo.design.plan.postures, demo.arm.chain is not None
    axes = figure.add_subplot(place, projection="3d" if space else None)
    if space:
        draw_side(axes, demo.arm, postures, run_colors(len(postures)), zoom=1.1)
        axes.set(zlabel="")  # it would stand in the next picture
    else:
        draw_arm(axes, demo.arm, postures)
    design = demo.design
    bound = None if design.bound is None else design.bound.as_dict()
    sure = optimality_in_words(design.optimality, bound) if design.certified_optimal else None
    optimal = sure or f"efficiency {design.efficiency:.3f}"
    within = "in the tracker's view" if space else "within the limits"
    axes.set_title(f"1. plan: {len(postures)} postures {within},\n{optimal}", fontsize=10)


def draw_gap(axes: Axes, demo: Demo) -> None:
    """RMS on fresh random postures: drawing, identified, with the effect that the diagnosis names."""
    heights = [demo.drawing_gap, demo.gap(demo.base), demo.gap(demo.extended)]
    names = ["drawing", "identified", "effect\nadded"]
    axes.plot(names, heights, color="0.8", lw=1, zorder=1)
    axes.scatter(names, heights, color=[LIMIT, BEFORE, AFTER], s=90, zorder=2)
    for name, height in zip(names, heights, strict=True):
        axes.annotate(f"{height:.2f} mm", (name, height), (0, 9), textcoords="offset points", ha="center", fontsize=10)
    axes.axhline(demo.noise, color="k", ls="--", lw=1, zorder=0)
    axes.set(yscale="log", xlim=(-0.5, 2.5), ylim=(0.57 * demo.noise, 2.4 * heights[0]), ylabel="RMS distance [mm]")
    axes.text(-0.42, demo.noise * 1.07, f"noise {demo.noise:.2f} mm", fontsize=9)
    axes.set_title("2. gap between model and reality,\non 200 postures no fit has seen", fontsize=10)


def draw_cause(axes: Axes, demo: Demo) -> None:
    """Residuals turned into the joint angle error they mean, against the joint that the diagnosis names."""
    joint = next((spec.joint for spec in demo.diagnosis.named.specs if spec.joint), 1)
    q = demo.fresh.postures[:, joint - 1]
    for found, color, name in ((demo.base, BEFORE, "identified"), (demo.extended, AFTER, "effect added")):
        predicted = found.model.position(demo.fresh.postures, found.parameters, demo.fresh.conditions)
        axes.plot(np.degrees(q), np.degrees(angle_errors(demo, joint, predicted)), ".", color=color, ms=4, label=name)
    axes.set(xlabel=f"joint {joint} [deg]", ylabel="joint angle error [deg]")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title(f"3. diagnosis:\n{' + '.join(demo.diagnosis.effects) or demo.diagnosis.verdict}", fontsize=10)


def angle_errors(demo: Demo, joint: int, predicted: np.ndarray) -> np.ndarray:
    """(m,) angle [rad] of `joint` that explains most of each residual: least squares along d tip / d q_joint."""
    residuals = demo.fresh.positions - predicted
    lever = demo.extended.model.joint_levers(demo.fresh.postures)[:, :, joint - 1]
    squares = np.sum(lever**2, axis=1)
    clear = np.maximum(squares, 0.3**2 * squares.max())  # a folded arm says little
    return np.sum(residuals * lever, axis=1) / clear
