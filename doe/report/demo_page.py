"""What the demo shows: in the terminal, as JSON, and as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.text import Text

from doe.demo import Demo
from doe.report.gap_page import as_table, candidate_sheet, gap_sections
from doe.report.page import Section, Sheet, page
from doe.report.pictures import certificate_figure, plan_figure, residual_figure
from doe.report.terminal import number, significant
from identification.gap.summary import findings, headline


def gap_sheet(demo: Demo) -> Sheet:
    """How the gap closes, step by step, on the data and on fresh random postures that no step has seen."""
    start = demo.base.rms_before
    drawing = demo.drawing_gap
    return Sheet(
        ["RMS error [mm]", "on the data", "on 200 fresh postures"],
        [
            ["nominal (from the drawing)", number(start), number(drawing)],
            ["lengths and offsets identified", number(demo.base.rms_after), number(demo.gap(demo.base))],
            [last_model(demo), number(demo.extended.rms_after), number(demo.gap(demo.extended))],
        ],
    )


def last_model(demo: Demo) -> str:
    """The last row's name."""
    return f"with {' + '.join(demo.diagnosis.effects)}" if demo.diagnosis.effects else "nothing named"


def parameter_sheet(demo: Demo) -> Sheet:
    """Estimates with intervals beside the hidden truth."""
    rows = []
    for row in demo.extended.to_json()["parameters"]:
        std = row["std"]
        figures = [significant(row[key], std) for key in ("value", "low_95", "high_95")]
        rows.append([row["name"], *figures, number(demo.truth[row["name"]]), row["unit"]])
    return Sheet(["parameter", "value", "low 95 %", "high 95 %", "truth", "unit"], rows)


def demo_summary(demo: Demo) -> str:
    """The whole loop in one sentence."""
    optimal = "certified optimal" if demo.design.certified_optimal else f"efficiency {demo.design.efficiency:.4f}"
    return (
        f"A {optimal} plan of {len(demo.design.plan)} runs. The RMS error on 200 fresh postures falls from "
        f"{demo.drawing_gap:.2f} mm (nominal) to {demo.gap(demo.base):.3f} mm (calibrated) and "
        f"{demo.gap(demo.extended):.3f} mm ({last_model(demo)}); measurement noise alone gives {demo.noise:.3f} mm."
    )


def demo_data(demo: Demo, directory: Path) -> dict[str, Any]:
    """The JSON object of `armcal demo`."""
    return {
        "directory": directory,
        "design": demo.design.to_json(),
        "identify": demo.base.to_json(),
        "diagnose": demo.diagnosis.to_json(),
        "fresh_gap_mm": {
            "drawing": demo.drawing_gap,
            "identified": demo.gap(demo.base),
            "extended": demo.gap(demo.extended),
            "noise": demo.noise,
        },
    }


def demo_tables(demo: Demo, directory: Path) -> list[Any]:
    """What a newcomer sees after the first command."""
    return [
        Text(demo_summary(demo), style="bold"),
        as_table(gap_sheet(demo)),
        *map(Text, (headline(demo.diagnosis), *findings(demo.diagnosis))),
        as_table(candidate_sheet(demo.diagnosis)),
        as_table(parameter_sheet(demo), "Refitted with the named effect (sigma from the arm file)"),
        Text(
            f"Files in {directory}: arm.toml, plan.csv, data.csv, fresh.csv, truth.toml, calibrated.toml, extended.toml"
        ),
        Text(f"Look at {directory / 'report.html'} in a browser."),
    ]


def demo_page(demo: Demo) -> str:
    """report.html: plan, certificate, identification, gap."""
    sections = [
        Section(
            "The plan",
            f"{len(demo.design.plan)} postures chosen within the joint limits (grey). {demo.design}",
            (),
            [plan_figure(demo.arm, demo.design.plan.postures)],
        ),
        Section(
            "The certificate",
            "Equivalence theorem: a plan is D-optimal when the largest d(q) over all postures is p (dashed). The line "
            "is the largest d found at each angle of a joint; black points are the plan's postures.",
            (),
            [certificate_figure(demo.problem, demo.design.plan.postures)],
        ),
        Section(
            "Identification",
            "From simulated measurements of an arm whose true errors the fit does not know.",
            [parameter_sheet(demo), gap_sheet(demo)],
            [residual_figure(demo.arm, demo.data.postures, demo.data.positions, *demo.residuals)],
        ),
        *gap_sections(demo.diagnosis),
    ]
    return page("armcal demo: the paper's 4-link arm", demo_summary(demo), sections)
