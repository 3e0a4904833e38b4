"""The whole loop: plan, certificate, measurements, identification, what is still missing, commands for the real arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from doe.design import Design
from doe.plan.plan import Plan, plan_text
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification import Arm, Array, Measurements, Model, Progress, load_arm, load_measurements, silent, with_effects
from identification.document import Answer
from identification.files.io import write_together
from identification.workflow import Written, compensate_files, diagnose_files, identify_files


@dataclass(frozen=True)
class Scenario:
    """An arm, and what its simulation hides.

    title : in words;  files : name -> text of what is there first, `arm.toml` among it
    real : postures (m, n) -> (m, d) positions without noise [mm], of an arm that the fits do not know
    hidden : parameter name -> value [file units]; what is not in it is zero
    every_parameter : the fit's parameters are those of `real`; False: only those of effects
    runs : of the plan;  effort : of the search, arguments of `solve`
    """

    title: str
    files: Mapping[str, str]
    real: Callable[[Array], Array]
    hidden: Mapping[str, float]
    every_parameter: bool
    runs: int
    effort: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Demo:
    """Everything the demo made, for tables, pictures and the page."""

    scenario: Scenario
    arm: Arm
    problem: DesignProblem
    design: Design
    data: Measurements
    fresh: Measurements  # random postures that no fit has seen
    identified: Answer
    diagnosed: Answer
    extended: Answer  # the named effect identified, from the drawing
    compensated: Answer
    files: tuple[str, ...]

    @property
    def diagnosis(self) -> Any:
        """What is missing, a `Diagnosis`."""
        return self.diagnosed.result

    @property
    def noise(self) -> float:
        """RMS distance that a perfect model would leave [mm]: sqrt(d) sigma."""
        return float(np.sqrt(self.arm.dimension) * (self.arm.sigma or 0.0))

    @property
    def drawing_gap(self) -> float:
        """RMS distance between the drawing, where the identification lets it stand, and the fresh measurements [mm]."""
        return rms(self.identified.result.model.position(self.fresh.postures) - self.fresh.positions)

    def gap(self, fitted: Answer) -> float:
        """RMS distance [mm] between a fitted model and the fresh measurements."""
        return rms(self.predicted(fitted) - self.fresh.positions)

    @property
    def model_error(self) -> float:
        """RMS distance [mm] between the final model and the hidden arm, without noise, at the fresh postures."""
        return rms(self.predicted(self.extended) - self.scenario.real(self.fresh.postures))

    @property
    def target_errors(self) -> tuple[float, float]:
        """RMS distance [mm] by which the hidden arm misses its targets, sent there as drawn and with the commands."""
        sent = self.compensated.result
        near = sent.reached
        drawn, corrected = (
            rms(self.scenario.real(q[near]) - sent.targets[near]) for q in (sent.nominal, sent.commands)
        )
        return drawn, corrected

    @property
    def checked(self) -> list[dict[str, Any]]:
        """Rows of `identify` of the parameters whose hidden value is known, with that value as `hidden`."""
        hidden, effects = self.scenario.hidden, [f"{label}." for label in self.diagnosis.effects]
        rows = self.extended.data["parameters"]
        return [
            row | {"hidden": hidden.get(row["name"], 0.0)}
            for row in rows
            if self.scenario.every_parameter or any(row["name"].startswith(label) for label in effects)
        ]

    def predicted(self, fitted: Answer) -> Array:
        """(m, d) positions [mm] of a fitted model at the fresh postures."""
        fit = fitted.result
        return np.asarray(fit.model.position(self.fresh.postures, fit.parameters, self.fresh.conditions))

    def to_json(self, directory: Path) -> dict[str, Any]:
        """The JSON object of `armcal demo`."""
        return {
            "directory": directory,
            "design": self.design.to_json(),
            "identify": self.identified.data,
            "diagnose": self.diagnosed.data,
            "fresh_gap_mm": {
                "drawing": self.drawing_gap,
                "identified": self.gap(self.identified),
                "extended": self.gap(self.extended),
                "noise": self.noise,
            },
            "hidden": {
                "parameters": self.checked,
                "model_error_mm": self.model_error,
                "targets_reached": int(self.compensated.result.reached.sum()),
                "targets_as_drawn_mm": self.target_errors[0],
                "targets_corrected_mm": self.target_errors[1],
            },
            "files": list(self.files),
        }


def rms(residuals: Array) -> float:
    """Root mean square over rows (m, d) of the distance [mm]."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


STEPS = ("arm files", "plan", "measurements", "identification", "diagnosis", "identification again", "commands", "page")


def run_demo(
    directory: Path, scenario: Scenario, seed: int = 0, progress: Progress = silent, force: bool = True
) -> Demo:
    """Make the files and results of the demo in a directory that exists; files there are replaced with `force`."""
    files: list[str] = []
    steps = iter(enumerate(STEPS))

    def begin() -> None:
        number, name = next(steps)
        progress(number, len(STEPS), name)

    def write(name: str, text: str) -> None:
        write_together({directory / name: text}, force=force)
        files.append(name)

    def to_write(name: str) -> Written:
        files.append(name)
        return Written(directory / name)

    def measured(name: str, postures: Array) -> Measurements:
        """Simulated measurements as the commands read them from the file, rounding included."""
        exact = scenario.real(postures)
        noise = (arm.sigma or 0.0) * generator.standard_normal(exact.shape)
        write(name, Measurements(postures, exact + noise).to_frame(joint_types=arm.joint_types).write_csv())
        return load_measurements(directory / name, arm)

    begin()
    for name, text in scenario.files.items():
        write(name, text)
    arm = load_arm(directory / "arm.toml")
    begin()
    problem = DesignProblem.of(Model(arm))
    design = solve(problem, scenario.runs, seed=seed, **scenario.effort)
    write("plan.csv", plan_text(design.plan))
    begin()
    generator = np.random.default_rng(seed)
    data = measured("data.csv", design.plan.postures)
    fresh = measured("fresh.csv", random_postures(problem, 200, generator))
    begin()
    path, rows = directory / "arm.toml", directory / "data.csv"
    urdf = None if arm.chain.planar else to_write("corrected.urdf")
    identified = identify_files(path, rows, out=to_write("calibrated.toml"), urdf=urdf, force=force)
    begin()
    diagnosed = diagnose_files(path, (rows,), holdout=directory / "fresh.csv", seed=seed)
    begin()
    write("extended.toml", with_effects(scenario.files["arm.toml"], diagnosed.result.named.specs, directory))
    named = Written(directory / "extended.toml")
    extended = identify_files(named, rows, out=named, force=True)
    begin()
    targets = random_postures(problem, 50, generator)  # where the nominal arm would be there the real one is to go
    write("targets.csv", plan_text(Plan(targets), arm.joint_types))
    compensated = compensate_files(named, directory / "targets.csv", out=to_write("commands.csv"), force=force)
    begin()
    answers = identified, diagnosed, extended, compensated
    return Demo(scenario, arm, problem, design, data, fresh, *answers, tuple(files))
