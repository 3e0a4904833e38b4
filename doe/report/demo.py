"""What the demo shows: in the terminal, as JSON, as a page, and in one picture."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from doe.demo.run import Demo
from doe.design import optimality_in_words
from doe.report.design import design_verdict, plan_section
from doe.report.figures import AFTER, BEFORE, LIMIT, certificate_figure, draw_arm, draw_side
from identification import Model
from identification.document import (
    Action,
    Document,
    Pictures,
    Section,
    Sheet,
    number,
)
from identification.documents.pictures import Compared


def demo_document(demo: Demo) -> Document:
    """Plan, certificate, identification, gap, and what was hidden."""
    diagnosed = demo.diagnosis.document(nominal=demo.identified.data["rms_drawing_mm"])
    lead = (
        "The named effect refitted (sigma from the arm file), beside what was hidden: fits saw the measurements only."
    )
    truth = Section("Against the truth", [lead, *truth_tables(demo)])
    sections = [identified_section(demo), *diagnosed.parts, truth]
    actions = [
        Action("Do the same with these files, step by step:", "armcal identify arm.toml data.csv --out mine.toml"),
        Action(
            "Make a page of any of them:", "armcal report arm.toml plan.csv extended.toml fresh.csv --out page.html"
        ),
        Action("Start with a robot of your own:", "armcal init --urdf robot.urdf --out cell"),
    ]
    within = " and the tracker's view" if demo.arm.constraints else ""
    chosen = f"Chosen within the joint limits{within}. {design_verdict(demo.design.to_json())}"
    certificate = (
        "Equivalence theorem: a plan is D-optimal when the largest d(q) over all postures is p (dashed). The line is "
        "the largest d found at each angle of a joint; dots are the plan's postures."
    )
    postures, effort = demo.design.plan.postures, (4096, 61) if demo.arm.chain.planar else (128, 25)
    picture = Pictures(lambda: [certificate, certificate_figure(demo.problem, postures, *effort)])
    sections += [plan_section(demo.arm, demo.design.plan, lead=chosen), Section("The certificate", [picture])]
    verdict = [*diagnosed.verdict, demo_summary(demo)]
    return Document(f"armcal demo: {demo.scenario.title}", verdict, sections, actions)


def last_model(demo: Demo) -> str:
    """The model that the diagnosis leads to."""
    return f"with {' + '.join(demo.diagnosis.effects)}" if demo.diagnosis.effects else "nothing named"


def optimality(demo: Demo, digits: int) -> str:
    """How sure the plan is, or its efficiency."""
    bound = None if demo.design.bound is None else demo.design.bound.as_dict()
    sure = optimality_in_words(demo.design.optimality, bound) if demo.design.certified_optimal else None
    return sure or f"efficiency {demo.design.efficiency:.{digits}f}"


def demo_summary(demo: Demo) -> str:
    """The whole loop in a few sentences."""
    drawn, corrected = demo.target_errors
    test = demo.diagnosis.confirmation
    average = f", {test.after:.3f} mm where the diagnosis averages over all that may be missing" if test else ""
    return (
        f"A plan of {len(demo.design.plan)} runs ({optimality(demo, 4)}). The RMS error on 200 fresh postures falls "
        f"from {demo.drawing_gap:.2f} mm (nominal) to {demo.gap(demo.identified):.3f} mm (calibrated) and "
        f"{demo.gap(demo.extended):.3f} mm ({last_model(demo)} alone{average}); "
        f"measurement noise alone gives {demo.noise:.3f} mm. "
        f"Commands corrected with this model miss their targets by {corrected:.3f} mm, uncorrected ones by "
        f"{drawn:.2f} mm."
    )


def identified_section(demo: Demo) -> Section:
    """How the gap closes, step by step, on the data and on fresh random postures that no step has seen."""
    named, arm, fresh = demo.diagnosis.effects, demo.extended.result.calibrated_arm(), demo.fresh
    base, extended = demo.identified.data, demo.extended.data
    errors = {
        "nominal (from the drawing)": (base["rms_before_mm"], demo.drawing_gap),
        "geometry identified": (base["rms_after_mm"], demo.gap(demo.identified)),
        last_model(demo): (extended["rms_after_mm"], demo.gap(demo.extended)),
    }
    rows = [[name, *map(number, figures)] for name, figures in errors.items()]
    before, after = (fresh.positions - demo.predicted(fit) for fit in (demo.identified, demo.extended))
    compared = Compared(arm, fresh.postures, before, after, fresh.conditions, Model(arm), named)
    model = f"the model {last_model(demo)}" if named else "the same model"
    signed = compared.pictures("the geometry identified", model)
    lead = "From simulated measurements of an arm whose true errors the fit does not know."
    table = Sheet(("RMS error [mm]", "on the data", "on 200 fresh postures"), rows)
    return Section("Identification", [table, lead, signed])


def truth_tables(demo: Demo) -> list[Sheet]:
    """Estimates with intervals beside the hidden truth; the last model and its commands against the hidden arm."""
    rows = []
    for row in demo.checked:
        figures = [f"{row[key]:.4g}" for key in ("value", "low_95", "high_95")]
        rows.append([row["name"], *figures, number(row["hidden"]), row["unit"]])
    drawn, corrected = demo.target_errors
    reached = int(demo.compensated.result.reached.sum())
    errors = {
        "last model: where the tip is, at the fresh postures": demo.model_error,
        f"hidden arm from {reached} targets, sent there as drawn": drawn,
        "... sent there with the corrected commands": corrected,
    }
    misses = [[name, number(error)] for name, error in errors.items()]
    return [
        Sheet(("parameter", "value", "low 95 %", "high 95 %", "truth", "unit"), rows),
        Sheet(("checked against the hidden arm, without noise", "RMS [mm]"), misses),
    ]


# -- the picture -------------------------------------------------------------------------------------------------------
def overview_figure(demo: Demo) -> Figure:
    """Plan, gap step by step, and residuals against the joint at fault."""
    figure, space = Figure(figsize=(12.0, 3.9), layout="constrained"), not demo.arm.chain.planar
    places = figure.add_gridspec(1, 3, width_ratios=[1.0, 0.95, 1.25])
    postures, axes = demo.design.plan.postures, figure.add_subplot(places[0], projection="3d" if space else None)
    if space:
        draw_side(axes, demo.arm, postures, zoom=1.1)
        axes.set(zlabel="")  # it would stand in the next picture
    else:
        draw_arm(axes, demo.arm, postures)
    within = "in the tracker's view" if space else "within the limits"
    axes.set_title(f"1. plan: {len(postures)} postures {within},\n{optimality(demo, 3)}", fontsize=10)
    draw_gap(figure.add_subplot(places[1]), demo)
    draw_cause(figure.add_subplot(places[2]), demo)
    return figure


def draw_gap(axes: Axes, demo: Demo) -> None:
    """RMS on fresh random postures: drawing, identified, with the effect that the diagnosis names."""
    heights = [demo.drawing_gap, demo.gap(demo.identified), demo.gap(demo.extended)]
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
    fresh, q = demo.fresh, np.degrees(demo.fresh.postures[:, joint - 1])
    before, after = (fresh.positions - demo.predicted(fit) for fit in (demo.identified, demo.extended))
    errors = Compared(demo.arm, fresh.postures, before, after, fresh.conditions).errors
    for each, color, name in zip(errors, (BEFORE, AFTER), ("identified", "effect added"), strict=True):
        axes.plot(q, np.degrees(each[:, joint - 1]), ".", color=color, ms=4, label=name)
    axes.set(xlabel=f"joint {joint} [deg]", ylabel="joint angle error [deg]")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title(f"3. diagnosis:\n{' + '.join(demo.diagnosis.effects) or demo.diagnosis.verdict}", fontsize=10)
