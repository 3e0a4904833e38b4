"""The whole loop on a simulated arm: plan, certificate, measurements, identification, what is still missing, commands
for the real arm; the paper's 4-link arm, or a six-axis arm before a laser tracker. And its page and picture."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from doe.design import Design
from doe.plan.moves import drive
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.report.design import design_verdict, plan_section
from doe.report.figures import AFTER, BEFORE, LIMIT, certificate_figure, draw_arm
from doe.solvers import solve
from doe.studies.blind.simulator import TrueArm, position, session, shift, turn
from identification import Arm, Array, Measurements, Plan, Progress, design_model, load_arm, rms_distance, with_effects
from identification.document import Answer, Document, Pictures, Section, Sheet, number
from identification.files.io import write_together
from identification.workflow import VERBS, Written

PLANAR_ARM, TRUTH, SIX_AXES, URDF = (
    Path(__file__).with_name(name).read_text()
    for name in ("planar_arm.toml", "planar_truth.toml", "six_axes.toml", "robot.urdf")
)
# axes at home as robot.urdf has them, stretched out along x: point [mm] and direction of each, then the flange
POINTS = np.array(
    [[0, 0, 130], [0, 190, 130], [610, 60, 130], [1180, 60, 130], [1180, 170, 130], [1180, 170, 20]], dtype=float
)
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 1, 0]], dtype=float)
FLANGE = np.array([1180.0, 260.0, 20.0])
LIMITS = np.radians([180.0, 180.0, 150.0, 180.0, 180.0, 180.0])
REFLECTOR = FLANGE + np.array([55.0, 60.0, -50.0])  # [mm] at home
HIDDEN_JOINT, HIDDEN_WAVE = 2, {"a": 0.03, "b": -0.025}  # encoder off centre: joint from 1; cosine, sine [deg]
SEED = 2026  # of the errors of the real arm


@dataclass(frozen=True)
class Scenario:
    """An arm, and what its simulation hides."""

    title: str
    files: Mapping[str, str]  # name -> text of what is there first, `arm.toml` among it
    real: Callable[[Array], Array]  # postures (m, n) -> (m, d) exact positions [mm], of an arm that fits do not know
    hidden: Mapping[str, float]  # parameter name -> value [file units]; what is not in it is zero
    runs: int  # of the plan
    effort: Mapping[str, Any] = field(default_factory=dict)  # of the search, arguments of `solve`


def planar() -> Scenario:
    """The paper's arm, with the paper's errors and an encoder that sits off centre."""
    truth = f"{PLANAR_ARM}\n{TRUTH}"
    model = design_model(load_arm(tomllib.loads(truth)))
    hidden = {p.name: model.best_known[p.name] * p.to_file for p in model.all_parameters}
    files = {"arm.toml": PLANAR_ARM, "truth.toml": truth}
    return Scenario("the paper's 4-link arm", files, model.position, hidden, runs=20)


def spatial() -> Scenario:
    """The scenario of the six-axis demo, whose lines in space are a little off and whose encoder is off centre: no arm
    file can say so, since the fitted model has other parameters."""
    generator = np.random.default_rng(SEED)
    points = POINTS + 0.4 * generator.standard_normal(POINTS.shape)  # [mm], as machined
    axes = AXES + 1.5e-3 * generator.standard_normal(AXES.shape)  # [rad]
    offsets = 4e-3 * generator.standard_normal(len(POINTS))  # of the joints' zeros [rad]
    base = np.eye(4)
    base[:3, :3] = turn(np.array([0.0, 0.0, np.radians(160.0)]))
    base = base @ shift(np.array([-2590.0, -410.0, -495.0]))  # about where arm.toml has the tracker
    zero, wave = np.zeros((6, 3)), {name: float(np.radians(value)) for name, value in HIDDEN_WAVE.items()}
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    weightless = TrueArm(zero, axes, points, offsets, base, REFLECTOR[None], zero[:, 0], 0.0, -LIMITS, LIMITS, 0.05)
    real, dice = (
        replace(weightless, effects=[("encoder_eccentricity", HIDDEN_JOINT, wave)]),
        np.random.default_rng(SEED),
    )
    hidden = {f"encoder_eccentricity:{HIDDEN_JOINT}.{key}": value for key, value in HIDDEN_WAVE.items()}
    files, title = {"robot.urdf": URDF, "arm.toml": SIX_AXES}, "a six-axis arm before a laser tracker"
    return Scenario(title, files, lambda q: position(real, session(real, q, dice)), hidden, 36, {"starts": 1})


# -- the loop ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Demo:
    """What the demo made, of which its page and its picture are."""

    title: str
    arm: Arm
    design: Design
    moves: Plan  # the design's plan with way-points, if the arm has bodies
    fresh: Measurements  # random postures that no fit has seen
    identified: Answer
    diagnosed: Answer
    validated: Answer  # of the named effect refitted, at `fresh`
    left: tuple[Array, Array]  # (200, d) [mm] of `fresh`, measured less what `identified` and the refit say
    data: dict[str, Any]  # the JSON object of `armcal demo`


def run_demo(
    directory: Path, scenario: Scenario, seed: int = 0, progress: Progress = Progress(), force: bool = True
) -> Demo:
    """Make the files and results of the demo in a directory that exists; files there are replaced with `force`."""
    files: list[str] = []

    def write(name: str, text: str) -> None:
        write_together({directory / name: text}, force=force)
        files.append(name)

    def to_write(name: str) -> Written:
        files.append(name)
        return Written(directory / name)

    def measured(name: str, postures: Array) -> Measurements:
        """Simulated measurements, which commands read from the file."""
        exact = scenario.real(postures)
        positions = exact + (arm.sigma or 0.0) * generator.standard_normal(exact.shape)
        columns = dict(zip(("x_mm", "y_mm", "z_mm"), positions.T, strict=False))
        write(name, Plan(postures).text(arm.joint_types, columns))
        return Measurements(postures, positions)

    progress(0, 8, "arm files")
    for name, text in scenario.files.items():
        write(name, text)
    arm = load_arm(directory / "arm.toml")
    progress(1, 8, "plan")
    problem = DesignProblem.of(arm)
    design = solve(problem, scenario.runs, seed=seed, **scenario.effort)
    driven = drive(problem, design.plan, seed=seed)
    design, moves = replace(design, plan=driven.plan), driven.moves
    write("plan.csv", moves.text())
    progress(2, 8, "measurements")
    generator = np.random.default_rng(seed)
    measured("data.csv", design.plan.postures)
    fresh = measured("fresh.csv", random_postures(problem, 200, generator))
    progress(3, 8, "identification")
    identify, diagnose, validate, compensate = (
        VERBS[name][0] for name in ("identify", "diagnose", "validate", "compensate")
    )
    path, rows = directory / "arm.toml", directory / "data.csv"
    urdf = to_write("corrected.urdf") if "robot.urdf" in scenario.files else None
    identified = identify(path, rows, out=to_write("calibrated.toml"), urdf=urdf, force=force)
    progress(4, 8, "diagnosis")
    diagnosed = diagnose(path, (rows,), holdout=directory / "fresh.csv", seed=seed)
    progress(5, 8, "identification again")
    write("extended.toml", with_effects(path.read_text(), diagnosed.result.named.specs, directory))
    named = Written(directory / "extended.toml")
    extended = identify(named, rows, out=named, force=True)
    progress(6, 8, "commands")
    targets = random_postures(problem, 50, generator)  # where the nominal arm would be there the real one is to go
    write("targets.csv", Plan(targets).text(arm.joint_types))
    sent = compensate(named, directory / "targets.csv", out=to_write("commands.csv"), force=force).result
    progress(7, 8, "page")
    before, after = (
        fresh.positions - fit.model.position(fresh.postures, fit.parameters, fresh.conditions)
        for fit in (identified.result, extended.result)
    )
    near, effects = sent.reached, [f"{label}." for label in diagnosed.result.effects]
    data = {
        "directory": directory,
        "design": design.to_json(),
        "identify": identified.data,
        "diagnose": diagnosed.data,
        "fresh_gap_mm": {
            "drawing": rms_distance(identified.result.model.position(fresh.postures) - fresh.positions),
            "identified": rms_distance(before),
            "extended": rms_distance(after),
            "noise": float(np.sqrt(arm.dimension) * (arm.sigma or 0.0)),
        },
        "hidden": {
            "parameters": [
                row | {"hidden": scenario.hidden.get(row["name"], 0.0)}
                for row in extended.data["parameters"]
                if row["name"] in scenario.hidden or any(row["name"].startswith(label) for label in effects)
            ],
            "model_error_mm": rms_distance(fresh.positions - after - scenario.real(fresh.postures)),
            "targets_reached": int(near.sum()),
            "targets_as_drawn_mm": rms_distance(scenario.real(targets[near]) - sent.targets[near]),
            "targets_corrected_mm": rms_distance(scenario.real(sent.commands[near]) - sent.targets[near]),
        },
        "files": files,
    }
    validated = validate(named, directory / "fresh.csv")
    return Demo(scenario.title, arm, design, moves, fresh, identified, diagnosed, validated, (before, after), data)


# -- its page ----------------------------------------------------------------------------------------------------------
def demo_document(demo: Demo) -> Document:
    """The diagnosis, what was hidden, the plan, and its certificate."""
    arm, design, diagnosis, test = demo.arm, demo.design, demo.diagnosed.result, demo.diagnosed.result.confirmation
    gaps, hidden = demo.data["fresh_gap_mm"], demo.data["hidden"]
    # estimates with intervals beside the hidden truth; the last model and its commands against the hidden arm
    values = [
        [
            row["name"],
            *(f"{row[key]:.4g}" for key in ("value", "low_95", "high_95")),
            number(row["hidden"]),
            row["unit"],
        ]
        for row in hidden["parameters"]
    ]
    misses = {
        "last model: position of the tip at the fresh postures": "model_error_mm",
        f"hidden arm sent to {hidden['targets_reached']} targets by the drawing": "targets_as_drawn_mm",
        "... with the corrected commands": "targets_corrected_mm",
    }
    truth: list[Any] = [
        "The named effect refitted (sigma from the arm file), beside what was hidden: fits saw the measurements only.",
        Sheet(("parameter", "value", "low 95 %", "high 95 %", "truth", "unit"), values),
        Sheet(
            ("checked against the hidden arm, without noise", "RMS [mm]"),
            [[name, number(hidden[key])] for name, key in misses.items()],
        ),
    ]
    within = " and the tracker's view" if arm.constraints else ""
    chosen = f"Chosen within the joint limits{within}. {design_verdict(design)}"
    diagnosed = diagnosis.document(nominal=demo.identified.data["rms_drawing_mm"])
    certificate = (
        "Equivalence theorem: a plan is D-optimal when the largest d(q) over all postures is p (dashed). The line is "
        "the largest d found at each angle of a joint; dots are the plan's postures."
    )
    sections = [
        *diagnosed.parts,
        Section("Against the truth", truth),
        plan_section(arm, demo.moves, lead=chosen, tests={"fresh.csv": demo.validated.result}),
        Section(
            "The certificate",
            [Pictures(lambda: [certificate, certificate_figure(design.problem, design.plan.postures)])],
        ),
    ]
    actions = [
        ("Do the same with the files there, step by step:", "armcal identify arm.toml data.csv --out mine.toml"),
        ("Start with a robot of your own:", "armcal init --urdf robot.urdf --out cell"),
    ]
    average = f", {test.after_mm:.3f} mm where the diagnosis averages over all that may be missing" if test else ""
    last = f"with {' + '.join(diagnosis.effects)}" if diagnosis.effects else "nothing named"
    summary = (
        f"A plan of {len(design.plan)} runs ({how_good(design)}). The RMS error on 200 fresh postures falls "
        f"from {gaps['drawing']:.2f} mm (nominal) to {gaps['identified']:.3f} mm (calibrated) and "
        f"{gaps['extended']:.3f} mm ({last} alone{average}); "
        f"measurement noise alone gives {gaps['noise']:.3f} mm. "
        f"Commands corrected with this model miss their targets by {hidden['targets_corrected_mm']:.3f} mm, "
        f"uncorrected ones by {hidden['targets_as_drawn_mm']:.2f} mm."
    )
    return Document(f"armcal demo: {demo.title}", [*diagnosed.verdict, summary], sections, actions)


def how_good(design: Design) -> str:
    """How sure the plan is, or its efficiency."""
    return design.optimality_in_words if design.certified_optimal else f"efficiency {design.efficiency:.4f}"


def overview_figure(demo: Demo) -> Figure:
    """Plan, gap step by step, and residuals against the joint at fault."""
    figure = Figure(figsize=(12.0, 3.9), layout="constrained")
    diagnosis = demo.diagnosed.result
    places = figure.add_gridspec(1, 3, width_ratios=[1.0, 0.95, 1.25])
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
    postures = demo.fresh.postures
    levers = design_model(demo.arm).joint_levers(postures, conditions=demo.fresh.conditions)[..., joint - 1]
    squares = np.sum(levers**2, axis=1)
    clear = squares > 0.1 * squares.max()  # of shorter levers residuals say little
    for left, color, name in zip(demo.left, (BEFORE, AFTER), ("identified", "effect added"), strict=True):
        errors = np.degrees(np.sum(levers * left, axis=1) / squares)[clear]
        axes.plot(np.degrees(postures[clear, joint - 1]), errors, ".", color=color, ms=4, label=name)
    axes.set(xlabel=f"joint {joint} [deg]", ylabel="joint angle error [deg]")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title(f"3. diagnosis:\n{' + '.join(diagnosis.effects) or diagnosis.verdict}", fontsize=10)
    return figure
