"""The whole loop on a simulated arm: plan, certificate, measurements, identification, what is still missing, commands
for the real arm; the paper's 4-link arm, or a six-axis arm before a laser tracker. And its page and picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from doe.design import Design
from doe.plan.moves import drive
from doe.problem.problem import DesignProblem, random_postures
from doe.report.figures import AFTER, BEFORE, LIMIT, certificate_figure, draw_arm
from doe.report.plan import plan_section
from doe.solvers import solve
from identification import Arm, Plan, Progress, design_model, load_arm, rms_distance
from identification.document import Answer, Document, Pictures, Section, Sheet, number
from identification.files.io import write_together
from identification.workflow import VERBS, Written


# -- the loop ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Demo:
    """What the demo made, of which its page and its picture are.

    moves : the design's plan with way-points, if the arm has bodies
    tests : `calibrated` and `extended`, the names of arm files -> their `Validation` at postures that no fit has seen
    data : the JSON object of `armcal demo`
    """

    title: str
    arm: Arm
    design: Design
    moves: Plan
    identified: Answer
    diagnosed: Answer
    tests: Mapping[str, Any]
    data: dict[str, Any]


def run_demo(
    directory: Path, *, spatial: bool = False, seed: int = 0, progress: Progress = Progress(), **effort: Any
) -> Demo:
    """Make the files and results of the demo in a directory that exists; files there are replaced.

    effort : of the search for the plan, arguments of `solve`
    """
    title, folder, runs = "the paper's 4-link arm", "planar", 20
    if spatial:
        title, folder, runs = "a six-axis arm before a laser tracker", "six_axes", 36
        effort = {"starts": 1, **effort}
    verbs, files = {name: verb for name, (verb, _) in VERBS.items()}, list[str]()

    def file(name: str) -> Written:
        """The path of a file that is made."""
        files.append(name)
        return Written(directory / name)

    def write(name: str, text: str) -> None:
        write_together({file(name): text}, force=True)

    progress(0, 8, "arm files")
    first = {each.name: each.read_text() for each in sorted(Path(__file__).with_name(folder).iterdir())}
    # truth.toml beside this file is what there is more in it than in arm.toml
    for name, text in (first | {"truth.toml": f"{first['arm.toml']}\n{first['truth.toml']}"}).items():
        write(name, text)
    path, truth, rows, fresh = (directory / name for name in ("arm.toml", "truth.toml", "data.csv", "fresh.csv"))
    arm, real = load_arm(path), design_model(load_arm(truth))
    progress(1, 8, "plan")
    problem, generator = DesignProblem.of(arm), np.random.default_rng(seed)
    design = solve(problem, runs, seed=seed, **effort)
    driven = drive(problem, design.plan, seed=seed)
    design = design.driven(driven)
    write("plan.csv", driven.moves.text())
    write("fresh_plan.csv", Plan(random_postures(problem, 200, generator), joint_types=arm.joint_types).text())
    progress(2, 8, "measurements")
    for k, (plan, name) in enumerate((("plan.csv", "data.csv"), ("fresh_plan.csv", "fresh.csv")), start=1):
        verbs["simulate"](path, directory / plan, truth=truth, out=file(name), force=True, seed=seed + k)
    progress(3, 8, "identification")
    urdf = file("corrected.urdf") if "robot.urdf" in first else None
    identified = verbs["identify"](path, rows, out=file("calibrated.toml"), urdf=urdf, force=True)
    progress(4, 8, "diagnosis")
    named = file("extended.toml")
    diagnosed = verbs["diagnose"](path, (rows,), holdout=fresh, named_only=True, out=named, force=True, seed=seed)
    progress(5, 8, "identification again")
    extended = verbs["identify"](named, rows, out=named, force=True)
    progress(6, 8, "commands")
    targets = random_postures(problem, 50, generator)  # where the nominal arm would be there the real one is to go
    write("targets.csv", Plan(targets, joint_types=arm.joint_types).text())
    sent = verbs["compensate"](named, directory / "targets.csv", out=file("commands.csv"), force=True).result
    progress(7, 8, "page")
    tests = {name: verbs["validate"](directory / f"{name}.toml", fresh).result for name in ("calibrated", "extended")}
    test, near = tests["extended"], sent.reached
    # where a prior holds the geometry, others of its parameters describe the same arm
    compared = {p.name for p in extended.result.model.parameters if p.of_effect or not problem.deviations}
    hidden = {p.name: real.best_known[p.name] * p.to_file for p in real.all_parameters}
    data = {
        "directory": directory,
        "design": design.to_json(),
        "identify": identified.data,
        "diagnose": diagnosed.data,
        "fresh_gap_mm": {
            "drawing": test.nominal.rms,
            "identified": tests["calibrated"].model.rms,
            "extended": test.model.rms,
            "noise": float(np.sqrt(arm.dimension) * (arm.sigma or 0.0)),
        },
        "hidden": {
            "parameters": [
                row | {"hidden": hidden.get(row["name"], 0.0)}
                for row in extended.data["parameters"]
                if row["name"] in compared
            ],
            "model_error_mm": rms_distance(
                test.measurements.positions - test.residuals - real.position(test.measurements.postures)
            ),
            "targets_reached": int(near.sum()),
            "targets_as_drawn_mm": rms_distance(real.position(targets[near]) - sent.targets[near]),
            "targets_corrected_mm": rms_distance(real.position(sent.commands[near]) - sent.targets[near]),
        },
        "files": files,
    }
    return Demo(title, arm, design, driven.moves, identified, diagnosed, tests, data)


# -- its page ----------------------------------------------------------------------------------------------------------
def demo_document(demo: Demo) -> Document:
    """The diagnosis, what was hidden, the plan, and its certificate."""
    arm, design, diagnosis = demo.arm, demo.design, demo.diagnosed.result
    gaps, hidden = demo.data["fresh_gap_mm"], demo.data["hidden"]
    # estimates with intervals beside the hidden truth
    keys = ("value", "low_95", "high_95")
    values = [
        [row["name"], *(f"{row[key]:.4g}" for key in keys), number(row["hidden"]), row["unit"]]
        for row in hidden["parameters"]
    ]
    truth: list[Any] = [
        "The named effect, refitted (sigma from the arm file), beside the hidden truth: fits saw measurements only. "
        f"Without noise the last model is off by {number(hidden['model_error_mm'])} mm RMS at the fresh postures.",
        Sheet(("parameter", "value", "low 95 %", "high 95 %", "truth", "unit"), values),
    ]
    within = " and the tracker's view" if arm.constraints else ""
    chosen = f"Chosen within the joint limits{within}. {design.verdict}"
    diagnosed = diagnosis.document(nominal=demo.identified.data["rms_drawing_mm"])
    certificate = (
        "Equivalence theorem: a plan is D-optimal when the largest d(q) over all postures is p (dashed). The line is "
        "the largest d found at each angle of a joint; dots are the plan's postures."
    )
    sections = [
        *diagnosed.parts,
        Section("Against the truth", truth),
        plan_section(arm, demo.moves, lead=chosen, tests={"fresh.csv": demo.tests["extended"]}),
        Section(
            "The certificate",
            [Pictures(lambda: [certificate, certificate_figure(design.problem, design.plan.postures)])],
        ),
    ]
    actions = [
        ("Do the same with the files there, step by step:", "armcal identify arm.toml data.csv --out mine.toml"),
        ("Start with a robot of your own:", "armcal init --urdf robot.urdf --out cell"),
    ]
    last = f"with {' + '.join(diagnosis.effects)}" if diagnosis.effects else "nothing named"
    summary = (
        f"A plan of {len(design.plan)} runs ({how_good(design)}). The RMS error on 200 fresh postures falls "
        f"from {gaps['drawing']:.2f} mm (drawing) to {gaps['identified']:.3f} mm (calibrated) and "
        f"{gaps['extended']:.3f} mm ({last} alone), the base refitted; "
        f"measurement noise alone gives {gaps['noise']:.3f} mm. "
        f"Commands corrected with this model miss {hidden['targets_reached']} targets by "
        f"{hidden['targets_corrected_mm']:.3f} mm RMS, uncorrected ones by {hidden['targets_as_drawn_mm']:.2f} mm."
    )
    return Document(f"armcal demo: {demo.title}", [*diagnosed.verdict, summary], sections, actions)


def how_good(design: Design) -> str:
    """How sure the plan is, or its efficiency."""
    return design.optimality_in_words if design.certified_optimal else f"efficiency {design.efficiency:.4f}"


def overview_figure(demo: Demo) -> Figure:
    """Plan, gap step by step, and residuals against the joint at fault."""
    figure = Figure(figsize=(12.0, 3.9), layout="constrained")
    diagnosis = demo.diagnosed.result
    places = figure.add_gridspec(1, 3, width_ratios=[1.0, 0.95, 1.25], wspace=0.08)
    postures, axes = demo.design.plan.postures, figure.add_subplot(places[0], projection=demo.arm.chain.projection)
    draw_arm(axes, demo.arm, postures)
    within = "in the tracker's view" if demo.arm.constraints else "within the limits"
    axes.set_title(f"1. plan: {len(postures)} postures {within},\n{how_good(demo.design)}", fontsize=10)

    # RMS on fresh random postures: drawing, identified, with the effect that the diagnosis names
    axes = figure.add_subplot(places[1])
    *heights, noise = (demo.data["fresh_gap_mm"][name] for name in ("drawing", "identified", "extended", "noise"))
    names = ["drawing", "identified", "effect\nadded"]
    axes.plot(names, heights, color="0.8", lw=1, zorder=1)
    axes.scatter(names, heights, color=[LIMIT, BEFORE, AFTER], s=90, zorder=2)
    for name, height in zip(names, heights, strict=True):
        axes.annotate(f"{height:.2f} mm", (name, height), (0, 9), textcoords="offset points", ha="center", fontsize=10)
    axes.axhline(noise, color="k", ls="--", lw=1, zorder=0)
    axes.set(yscale="log", xlim=(-0.5, 2.5), ylim=(0.57 * noise, 2.4 * heights[0]), ylabel="RMS distance [mm]")
    axes.text(-0.42, noise * 1.07, f"noise {noise:.2f} mm", fontsize=9)
    axes.set_title("2. gap between model and reality,\non 200 postures no fit has seen", fontsize=10)

    # residuals turned into the joint angle error they mean, against the joint that the diagnosis names
    axes = figure.add_subplot(places[2])
    joint = next((spec.joint for spec in diagnosis.named.specs if spec.joint), 1)
    fresh = demo.tests["extended"].measurements
    levers = design_model(demo.arm).joint_levers(fresh.postures, conditions=fresh.conditions)[..., joint - 1]
    squares = np.sum(levers**2, axis=1)
    clear = squares > 0.1 * squares.max()  # of shorter levers residuals say little
    for test, color, name in zip(demo.tests.values(), (BEFORE, AFTER), ("identified", "effect added"), strict=True):
        errors = np.degrees(np.sum(levers * test.residuals, axis=1) / squares)[clear]
        axes.plot(np.degrees(fresh.postures[clear, joint - 1]), errors, ".", color=color, ms=4, label=name)
    axes.set(xlabel=f"joint {joint} [deg]", ylabel="joint angle error [deg]")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title(f"3. diagnosis:\n{' + '.join(diagnosis.effects) or diagnosis.verdict}", fontsize=10)
    return figure
