"""The paper's 4-link arm, with the paper's errors and an encoder that sits off centre."""

from __future__ import annotations

import tomllib

from doe.demo.run import Scenario
from identification.files.arm import arm_from_tables
from identification.model import Model

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


def planar() -> Scenario:
    """The scenario of the planar demo."""
    model = Model(arm_from_tables(tomllib.loads(ARM + TRUTH)))
    values = model.best_known
    hidden = {p.name: values[p.name] * p.to_file for p in model.all_parameters}
    files = {"arm.toml": ARM, "truth.toml": ARM + TRUTH}
    return Scenario("the paper's 4-link arm", files, model.position, hidden, every_parameter=True, runs=RUNS)
