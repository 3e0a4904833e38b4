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
from identification.arm import Arm
from identification.arrays import Array
from identification.compensate import compensate
from identification.compensate.compensation import Compensation
from identification.estimation import Identification, estimate
from identification.files.arm import corrected_urdf, load_arm
from identification.files.arm_text import with_calibration, with_effects
from identification.files.io import write_together
from identification.files.measurement import commands_text, load_measurements, measurement_text
from identification.gap.diagnose import diagnose
from identification.gap.result import Diagnosis
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.progress import Progress, silent
from identification.validate import drawing_residuals
from identification.validate.validation import judged

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

    def gap(self, fitted: Identification) -> float:
        """RMS distance [mm] between a fitted model and the fresh measurements."""
        return rms_distance(self.predicted(fitted) - self.fresh.positions)

    @property
    def model_error(self) -> float:
        """RMS distance [mm] between the final model and the hidden arm, without noise, at the fresh postures."""
        return rms_distance(self.predicted(self.extended) - self.scenario.real(self.fresh.postures))

    @property
    def target_errors(self) -> tuple[float, float]:
        """RMS distance [mm] by which the hidden arm misses its targets, sent there as drawn and with the commands."""
        sent, near = self.compensation, self.compensation.reached
        misses = (self.scenario.real(q[near]) - sent.targets[near] for q in (sent.nominal, sent.commands))
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

    def predicted(self, fitted: Identification) -> Array:
        """(m, d) positions [mm] of a fitted model at the fresh postures."""
        return fitted.model.position(self.fresh.postures, fitted.parameters, self.fresh.conditions)

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

    def measured(name: str, postures: Array) -> Measurements:
        """Simulated measurements as the commands read them from the file, rounding included."""
        exact = scenario.real(postures)
        noise = (arm.sigma or 0.0) * generator.standard_normal(exact.shape)
        write(name, measurement_text(Measurements(postures, exact + noise)))
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
    fresh = measured("fresh.csv", random_postures(problem, FRESH, generator))
    begin()
    base = estimate(Model(arm), data)
    begin()
    diagnosis = judged(diagnose(arm, data, holdout=fresh, seed=seed), arm, data, fresh)
    begin()
    extended = estimate(Model(arm.with_effects(*arm.effects, *diagnosis.named.specs)), data)  # from the drawing
    text = scenario.files["arm.toml"]
    write("calibrated.toml", with_calibration(text, base.calibration(), directory))
    with_effect = with_effects(text, diagnosis.named.specs, directory)
    write("extended.toml", with_calibration(with_effect, extended.calibration(), directory))
    if base.geometry is not None:  # of an arm from a URDF file: corrected, without effects
        write("corrected.urdf", corrected_urdf(directory / "arm.toml", base.geometry.real))
    begin()
    targets = random_postures(problem, TARGETS, generator)  # where the nominal arm would be there the real one is to go
    compensation = compensate(extended.calibrated_arm(), postures=targets)
    write("targets.csv", plan_text(Plan(targets)))
    write("commands.csv", commands_text(compensation.safe_commands, compensation.targets, compensation.errors))
    begin()
    results = base, diagnosis, extended, compensation
    return Demo(scenario, arm, problem, design, data, fresh, *results, tuple(files))
