"""What the demo shows: in the terminal, as JSON, and as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.text import Text

from doe.demo.run import Demo
from doe.design import optimality_in_words
from doe.report.gap_sections import gap_sections
from doe.report.gap_tables import as_table, candidate_sheet
from doe.report.origin import Origin, origin_section
from doe.report.page import Action, Section, Sheet, page
from doe.report.pictures import certificate_figure
from doe.report.plan_steps import plan_section
from doe.report.signed_residuals import Compared, caption, signed_figures
from doe.report.terminal import number, to_significant_digits, unit_or_dash
from doe.report.verdict import design_verdict, diagnosis_verdict
from identification.gap.words import findings, headline
from identification.model import Model

ACTIONS = (
    Action("Do the same with these files, step by step:", "armcal identify arm.toml data.csv --out mine.toml"),
    Action("Make a page of any of them:", "armcal report arm.toml plan.csv extended.toml fresh.csv --out page.html"),
    Action("Start with a robot of your own:", "armcal init --urdf robot.urdf --out cell"),
)


def gap_steps_sheet(demo: Demo) -> Sheet:
    """How the gap closes, step by step, on the data and on fresh random postures that no step has seen."""
    start = demo.base.rms_before
    drawing = demo.drawing_gap
    return Sheet(
        ["RMS error [mm]", "on the data", "on 200 fresh postures"],
        [
            ["nominal (from the drawing)", number(start), number(drawing)],
            ["geometry identified", number(demo.base.rms_after), number(demo.gap(demo.base))],
            [last_model(demo), number(demo.extended.rms_after), number(demo.gap(demo.extended))],
        ],
    )


def last_model(demo: Demo) -> str:
    """The last row's name."""
    return f"with {' + '.join(demo.diagnosis.effects)}" if demo.diagnosis.effects else "nothing named"


def parameter_sheet(demo: Demo) -> Sheet:
    """Estimates with intervals beside the hidden truth."""
    rows = []
    for row in demo.checked:
        std = row["std"]
        figures = [to_significant_digits(row[key], std) for key in ("value", "low_95", "high_95")]
        rows.append([row["name"], *figures, number(row["hidden"]), unit_or_dash(row["unit"])])
    return Sheet(["parameter", "value", "low 95 %", "high 95 %", "truth", "unit"], rows)


def truth_sheet(demo: Demo) -> Sheet:
    """The last model and its commands against the hidden arm itself, without noise."""
    drawn, corrected = demo.target_errors
    reached = int(demo.compensation.reached.sum())
    rows = [
        ["last model: where the tip is, at the fresh postures", number(demo.model_error)],
        [f"hidden arm from {reached} targets, sent there as drawn", number(drawn)],
        ["... sent there with the corrected commands", number(corrected)],
    ]
    return Sheet(["checked against the hidden arm, without noise", "RMS [mm]"], rows)


def demo_summary(demo: Demo) -> str:
    """The whole loop in one sentence."""
    design = demo.design
    bound = None if design.bound is None else design.bound.as_dict()
    sure = optimality_in_words(design.optimality, bound) if design.certified_optimal else None
    optimal = sure or f"efficiency {design.efficiency:.4f}"
    return (
        f"A plan of {len(demo.design.plan)} runs ({optimal}). The RMS error on 200 fresh postures falls from "
        f"{demo.drawing_gap:.2f} mm (nominal) to {demo.gap(demo.base):.3f} mm (calibrated) and "
        f"{demo.gap(demo.extended):.3f} mm ({last_model(demo)}); measurement noise alone gives {demo.noise:.3f} mm. "
        f"Commands corrected with this model miss their targets by {demo.target_errors[1]:.3f} mm, uncorrected ones by "
        f"{demo.target_errors[0]:.2f} mm."
    )


def demo_data(demo: Demo, directory: Path) -> dict[str, Any]:
    """The JSON object of `armcal demo`."""
    return {
        "directory": directory,
        "design": demo.design.to_json(),
        "identify": demo.base.to_json() | {"rms_drawing_mm": demo.drawing_left},
        "diagnose": demo.diagnosis.to_json(),
        "fresh_gap_mm": {
            "drawing": demo.drawing_gap,
            "identified": demo.gap(demo.base),
            "extended": demo.gap(demo.extended),
            "noise": demo.noise,
        },
        "hidden": {
            "parameters": demo.checked,
            "model_error_mm": demo.model_error,
            "targets_reached": int(demo.compensation.reached.sum()),
            "targets_as_drawn_mm": demo.target_errors[0],
            "targets_corrected_mm": demo.target_errors[1],
        },
        "files": list(demo.files),
    }


def demo_tables(demo: Demo, directory: Path) -> list[Any]:
    """What a newcomer sees after the first command."""
    return [
        Text(demo_summary(demo), style="bold"),
        as_table(gap_steps_sheet(demo)),
        *map(Text, (headline(demo.diagnosis), *findings(demo.diagnosis))),
        as_table(candidate_sheet(demo.diagnosis.to_json())),
        as_table(parameter_sheet(demo), "Refitted with the named effect (sigma from the arm file)"),
        as_table(truth_sheet(demo)),
        Text(f"Files in {directory}: {', '.join(demo.files)}"),
        Text(f"Look at {directory / 'report.html'} in a browser."),
    ]


def demo_page(demo: Demo, origin: Origin) -> str:
    """report.html: plan, certificate, identification, gap, and what was hidden."""
    verdict = [*diagnosis_verdict(demo.diagnosis.to_json()), demo_summary(demo)]
    sections = [*found_sections(demo), *plan_sections(demo), origin_section(origin)]
    return page(f"armcal demo: {demo.scenario.title}", verdict, sections, ACTIONS)


def plan_sections(demo: Demo) -> list[Section]:
    """Where to measure, and how good that is."""
    within = " and the tracker's view" if demo.arm.constraints else ""
    lead = f"Chosen within the joint limits{within}. {design_verdict(demo.design.to_json())}"
    certificate = (
        "Equivalence theorem: a plan is D-optimal when the largest d(q) over all postures is p (dashed). The line is "
        "the largest d found at each angle of a joint; dots are the plan's postures."
    )
    postures, effort = demo.design.plan.postures, (4096, 61) if demo.arm.chain is None else (128, 25)
    return [
        plan_section(demo.arm, demo.design.plan, lead=lead),
        Section("The certificate", certificate, (), [certificate_figure(demo.problem, postures, *effort)]),
    ]


def found_sections(demo: Demo) -> list[Section]:
    """The estimates, and how they compare with the hidden truth."""
    named = demo.diagnosis.effects
    identified = (
        "From simulated measurements of an arm whose true errors the fit does not know. Below: the 200 fresh postures. "
        + caption("the geometry identified", f"the model {last_model(demo)}" if named else "the same model", named)
    )
    hidden = "What was hidden, as the simulation has it: the fits and the commands saw the measurements only."
    before, after = (demo.fresh.positions - demo.predicted(found) for found in (demo.base, demo.extended))
    arm, fresh = demo.extended.calibrated_arm(), demo.fresh
    compared = Compared(arm, fresh.postures, before, after, fresh.conditions, Model(arm), named)
    return [
        Section("Identification", identified, [gap_steps_sheet(demo)], signed_figures(compared)),
        *gap_sections(demo.diagnosis, demo.drawing_left),
        Section("Against the truth", hidden, [parameter_sheet(demo), truth_sheet(demo)]),
    ]
