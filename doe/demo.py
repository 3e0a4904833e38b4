"""The whole loop on the paper's 4-link arm: plan, certificate, measurements, identification, what is still missing."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from doe.design import Design
from doe.plan.file import plan_text
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification.arm import Arm
from identification.arrays import Array
from identification.estimation import Identification, estimate
from identification.files.arm import load_arm
from identification.files.arm_text import with_calibration, with_effects
from identification.files.io import write_whole
from identification.files.measurement import load_measurements, measurement_text
from identification.gap.diagnose import diagnose
from identification.gap.holdout import rms_distance
from identification.gap.result import Diagnosis
from identification.measurements import Measurements
from identification.model import Model
from identification.progress import Progress, silent
from identification.simulate import simulate

ARM = """\
# The 4-link arm of Klimchik, Wu, Caro, Pashkevich, with joint limits
name = "paper-4-link"
links_mm = [260.0, 180.0, 120.0, 100.0]

[joint_limits_deg]
lower = [-180.0, -120.0, -100.0, -90.0]
upper = [180.0, 120.0, 60.0, 90.0]

[measurement]
sigma_mm = 0.1
"""

TRUTH = """
# What the demo hides: the paper's errors (Section VI), and an encoder that sits off centre on joint 1
[calibration]
length_errors_mm = [1.5, -0.6, -0.4, 0.7]
joint_offsets_deg = [0.5, -0.5, 0.7, -0.3]

[[effects]]
name = "encoder_eccentricity"
joint = 1
a_deg = 0.06
b_deg = -0.04
"""

RUNS = 20


@dataclass(frozen=True)
class Demo:
    """Everything the demo made, for tables, pictures and the page."""

    arm: Arm
    truth: dict[str, float]  # parameter name -> hidden value, file units
    problem: DesignProblem
    design: Design
    data: Measurements
    fresh: Measurements  # random postures that no fit has seen
    base: Identification
    diagnosis: Diagnosis
    extended: Identification

    @property
    def noise(self) -> float:
        """RMS distance that a perfect model would leave [mm]: sqrt(2) sigma."""
        return float(np.sqrt(2.0) * (self.arm.sigma or 0.0))

    @property
    def residuals(self) -> tuple[Array, Array]:
        """(m, 2) residuals of the drawing and of the final model on the data [mm]."""
        return self.base.residuals_before, self.extended.residuals_after

    @property
    def drawing_gap(self) -> float:
        """RMS distance between the drawing and the fresh measurements [mm]."""
        return rms_distance(Model(self.arm).position(self.fresh.postures) - self.fresh.positions)

    def gap(self, found: Identification) -> float:
        """RMS distance [mm] between a fitted model and the fresh measurements."""
        predicted = found.model.position(self.fresh.postures, found.parameters, self.fresh.conditions)
        return rms_distance(predicted - self.fresh.positions)


def true_values(truth: Arm) -> dict[str, float]:
    """Every parameter of the truth in file units; effects it does not have are zero."""
    model = Model(truth)
    values = model.best_known
    known = {p.name: values[p.name] * p.to_file for p in model.all_parameters}
    return defaultdict(float, known)


def run_demo(directory: Path, seed: int = 0, progress: Progress = silent) -> Demo:
    """Make the files and results of the demo in a directory that exists."""
    steps = ("arm files", "plan", "measurements", "identification", "diagnosis", "identification again", "page")

    def step(done: int) -> None:
        progress(done, len(steps), steps[done])

    step(0)
    write_whole(directory / "arm.toml", ARM, force=True)
    write_whole(directory / "truth.toml", ARM + TRUTH, force=True)
    arm, truth = load_arm(directory / "arm.toml"), load_arm(directory / "truth.toml")
    step(1)
    problem = DesignProblem.of(Model(arm))
    design = solve(problem, RUNS, seed=seed)
    write_whole(directory / "plan.csv", plan_text(design.plan), force=True)
    step(2)
    generator = np.random.default_rng(seed)
    data = _measured(directory / "data.csv", truth, design.plan.postures, generator)
    elsewhere = generator.uniform(arm.lower, arm.upper, (200, arm.links))
    fresh = _measured(directory / "fresh.csv", truth, elsewhere, generator)
    step(3)
    base = estimate(Model(arm), data)
    step(4)
    diagnosis = diagnose(arm, data, holdout=fresh, seed=seed)
    step(5)
    extended = estimate(Model(arm.with_effects(*arm.effects, *diagnosis.named.specs)), data)  # from the drawing
    write_whole(directory / "calibrated.toml", with_calibration(ARM, base.calibration()), force=True)
    with_effect = with_effects(ARM, diagnosis.named.specs)
    write_whole(directory / "extended.toml", with_calibration(with_effect, extended.calibration()), force=True)
    step(6)
    return Demo(arm, true_values(truth), problem, design, data, fresh, base, diagnosis, extended)


def _measured(path: Path, truth: Arm, postures: Array, generator: np.random.Generator) -> Measurements:
    """Simulated measurements as the commands read them from the file, rounding included."""
    write_whole(path, measurement_text(simulate(truth, postures, generator)), force=True)
    return load_measurements(path, truth.links)
