"""The whole loop: plan, certificate, measurements, identification, what is still missing, commands for the real arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from doe.design import Design
from doe.plan.file import plan_text
from doe.plan.plan import Plan
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification.arm import Arm
from identification.arrays import Array
from identification.compensate import compensate
from identification.compensate.compensation import Compensation
from identification.estimation import Identification, estimate
from identification.files.arm import load_arm
from identification.files.arm_text import with_calibration, with_effects
from identification.files.io import write_whole
from identification.files.measurement import load_measurements, measurement_text
from identification.files.target import commands_text
from identification.gap.diagnose import diagnose
from identification.gap.result import Diagnosis
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.progress import Progress, silent
from identification.validate import drawing_residuals
from identification.validate.judgement import judged

FRESH, TARGETS = 200, 50  # postures


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
    base: Identification
    diagnosis: Diagnosis
    extended: Identification
    compensation: Compensation
    files: tuple[str, ...]

    @property
    def noise(self) -> float:
        """RMS distance that a perfect model would leave [mm]: sqrt(d) sigma."""
        return float(np.sqrt(self.arm.dimension) * (self.arm.sigma or 0.0))

    @property
    def residuals(self) -> tuple[Array, Array]:
        """(m, d) residuals of the drawing and of the final model on the data [mm]."""
        return self.base.residuals_before, self.extended.residuals_after

    @property
    def drawing_gap(self) -> float:
        """RMS distance between the drawing, where the identification lets it stand, and the fresh measurements [mm]."""
        return rms_distance(self.base.model.position(self.fresh.postures) - self.fresh.positions)

    @property
    def drawing_left(self) -> float:
        """RMS distance [mm] between the drawing, where it stands fitted, and the measurements."""
        return rms_distance(drawing_residuals(self.arm, self.data))

    def gap(self, found: Identification) -> float:
        """RMS distance [mm] between a fitted model and the fresh measurements."""
        return rms_distance(self.predicted(found) - self.fresh.positions)

    @property
    def model_error(self) -> float:
        """RMS distance [mm] between the final model and the hidden arm, without noise, at the fresh postures."""
        return rms_distance(self.predicted(self.extended) - self.scenario.real(self.fresh.postures))

    @property
    def target_errors(self) -> tuple[float, float]:
        """RMS distance [mm] by which the hidden arm misses its targets, sent there as drawn and with the commands."""
        found, near = self.compensation, self.compensation.reached
        misses = (self.scenario.real(q[near]) - found.targets[near] for q in (found.nominal, found.commands))
        drawn, corrected = map(rms_distance, misses)
        return drawn, corrected

    @property
    def checked(self) -> list[dict[str, Any]]:
        """Rows of `identify` of the parameters whose hidden value is known, with that value as `hidden`."""
        hidden, effects = self.scenario.hidden, [f"{label}." for label in self.diagnosis.effects]
        rows = self.extended.to_json()["parameters"]
        return [
            row | {"hidden": hidden.get(row["name"], 0.0)}
            for row in rows
            if self.scenario.every_parameter or any(row["name"].startswith(label) for label in effects)
        ]

    def predicted(self, found: Identification) -> Array:
        """(m, d) positions [mm] of a fitted model at the fresh postures."""
        return found.model.position(self.fresh.postures, found.parameters, self.fresh.conditions)

    def to_json(self, directory: Path) -> dict[str, Any]:
        """The JSON object of `armcal demo`."""
        return {
            "directory": directory,
            "design": self.design.to_json(),
            "identify": self.base.to_json() | {"rms_drawing_mm": self.drawing_left},
            "diagnose": self.diagnosis.to_json(),
            "fresh_gap_mm": {
                "drawing": self.drawing_gap,
                "identified": self.gap(self.base),
                "extended": self.gap(self.extended),
                "noise": self.noise,
            },
            "hidden": {
                "parameters": self.checked,
                "model_error_mm": self.model_error,
                "targets_reached": int(self.compensation.reached.sum()),
                "targets_as_drawn_mm": self.target_errors[0],
                "targets_corrected_mm": self.target_errors[1],
            },
            "files": list(self.files),
        }


def run_demo(
    directory: Path, scenario: Scenario, seed: int = 0, progress: Progress = silent, force: bool = True
) -> Demo:
    """Make the files and results of the demo in a directory that exists; files there are replaced with `force`."""
    return Run(directory, scenario, seed, progress, force).demo()


STEPS = ("arm files", "plan", "measurements", "identification", "diagnosis", "identification again", "commands", "page")


@dataclass
class Run:
    """One run of the demo, and the files that it wrote."""

    directory: Path
    scenario: Scenario
    seed: int
    progress: Progress
    force: bool
    files: list[str] = field(default_factory=list)

    def demo(self) -> Demo:
        """Run every step and collect the results."""
        self.step("arm files")
        for name, text in self.scenario.files.items():
            self.write(name, text)
        arm = load_arm(self.directory / "arm.toml")
        self.step("plan")
        problem = DesignProblem.of(Model(arm))
        design = solve(problem, self.scenario.runs, seed=self.seed, **self.scenario.effort)
        self.write("plan.csv", plan_text(design.plan))
        self.step("measurements")
        generator = np.random.default_rng(self.seed)
        data = self.measured("data.csv", arm, design.plan.postures, generator)
        fresh = self.measured("fresh.csv", arm, random_postures(problem, FRESH, generator), generator)
        self.step("identification")
        base = estimate(Model(arm), data)
        self.step("diagnosis")
        diagnosis = judged(diagnose(arm, data, holdout=fresh, seed=self.seed), arm, data, fresh)
        self.step("identification again")
        extended = estimate(Model(arm.with_effects(*arm.effects, *diagnosis.named.specs)), data)  # from the drawing
        self.arm_files(base, diagnosis, extended)
        self.step("commands")
        compensation = self.commands(extended, random_postures(problem, TARGETS, generator))
        self.step("page")
        found = base, diagnosis, extended, compensation
        return Demo(self.scenario, arm, problem, design, data, fresh, *found, tuple(self.files))

    def step(self, name: str) -> None:
        """Report progress: the step that begins."""
        self.progress(STEPS.index(name), len(STEPS), name)

    def write(self, name: str, text: str) -> None:
        """Write a file of the demo."""
        write_whole(self.directory / name, text, force=self.force)
        self.files.append(name)

    def measured(self, name: str, arm: Arm, postures: Array, generator: np.random.Generator) -> Measurements:
        """Simulated measurements as the commands read them from the file, rounding included."""
        exact = self.scenario.real(postures)
        noise = (arm.sigma or 0.0) * generator.standard_normal(exact.shape)
        self.write(name, measurement_text(Measurements(postures, exact + noise)))
        return load_measurements(self.directory / name, arm)

    def arm_files(self, base: Identification, diagnosis: Diagnosis, extended: Identification) -> None:
        """Write both calibrated arm files and, for an arm from a URDF file, the corrected URDF (without effects)."""
        from identification.files.arm_chain import corrected_urdf

        text = self.scenario.files["arm.toml"]
        self.write("calibrated.toml", with_calibration(text, base.calibration(), self.directory))
        with_effect = with_effects(text, diagnosis.named.specs, self.directory)
        self.write("extended.toml", with_calibration(with_effect, extended.calibration(), self.directory))
        if base.geometry is not None:
            self.write("corrected.urdf", corrected_urdf(self.directory / "arm.toml", base.geometry.real))

    def commands(self, extended: Identification, postures: Array) -> Compensation:
        """Commands that take the real arm to the positions where the nominal arm would be at these postures."""
        found = compensate(extended.calibrated_arm(), postures=postures)
        self.write("targets.csv", plan_text(Plan(postures)))
        self.write("commands.csv", commands_text(found.safe_commands, found.targets, found.errors))
        return found
