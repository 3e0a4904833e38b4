"""What the demo simulates: the paper's 4-link arm, and a six-axis arm before a laser tracker."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from doe.demo.run import Scenario
from doe.studies.blind.simulator import TrueArm, position, session, shift, turn
from identification import Array, Model, arm_from_tables

FOLDER = Path(__file__).parent
PLANAR_ARM = (FOLDER / "planar_arm.toml").read_text()
PLANAR_TRUTH = f"{PLANAR_ARM}\n{(FOLDER / 'planar_truth.toml').read_text()}"
ARM = (FOLDER / "six_axes.toml").read_text()
URDF = (FOLDER / "robot.urdf").read_text()


def planar() -> Scenario:
    """The paper's arm, with the paper's errors and an encoder that sits off centre."""
    model = Model(arm_from_tables(tomllib.loads(PLANAR_TRUTH)))
    values = model.best_known
    hidden = {p.name: values[p.name] * p.to_file for p in model.all_parameters}
    files = {"arm.toml": PLANAR_ARM, "truth.toml": PLANAR_TRUTH}
    return Scenario("the paper's 4-link arm", files, model.position, hidden, every_parameter=True, runs=20)


# -- six axes ----------------------------------------------------------------------------------------------------------
# axes at home as robot.urdf has them, stretched out along x: point [mm] and direction of each, then the flange
POINTS = np.array(
    [[0, 0, 130], [0, 190, 130], [610, 60, 130], [1180, 60, 130], [1180, 170, 130], [1180, 170, 20]], dtype=float
)
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 1, 0]], dtype=float)
FLANGE = np.array([1180.0, 260.0, 20.0])
NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
LIMITS = np.radians([180.0, 180.0, 150.0, 180.0, 180.0, 180.0])

REFLECTOR = FLANGE + np.array([55.0, 60.0, -50.0])  # [mm] at home
HIDDEN_JOINT, HIDDEN_WAVE = 2, (0.03, -0.025)  # encoder off centre: joint from 1; cosine, sine [deg]
SEED = 2026  # of the errors of the real arm


def hidden_arm() -> TrueArm:
    """The real arm, its lines in space a little off and its encoder off centre: errors that the fits do not know."""
    generator = np.random.default_rng(SEED)
    points = POINTS + 0.4 * generator.standard_normal(POINTS.shape)  # [mm], as machined
    axes = AXES + 1.5e-3 * generator.standard_normal(AXES.shape)  # [rad]
    offsets = 4e-3 * generator.standard_normal(len(POINTS))  # of the joints' zeros [rad]
    base = np.eye(4)
    base[:3, :3] = turn(np.array([0.0, 0.0, np.radians(160.0)]))
    base = base @ shift(np.array([-2590.0, -410.0, -495.0]))  # about where arm.toml has the tracker
    zero, wave = np.zeros((6, 3)), dict(zip("ab", np.radians(HIDDEN_WAVE).tolist(), strict=True))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    weightless = TrueArm(zero, axes, points, offsets, base, REFLECTOR[None], zero[:, 0], 0.0, -LIMITS, LIMITS, 0.05)
    return replace(weightless, effects=[("encoder_eccentricity", HIDDEN_JOINT, wave)])


def hidden_text(real: TrueArm) -> str:
    """What is hidden, to look at: no arm file can say it, since the fitted model has other parameters."""
    lines = [
        "# What the demo hides. Joints as lines in space at home, in the frame of the base; drawn beside them.",
        "",
    ]
    for j, name in enumerate(NAMES):
        lines += [
            "[[joint]]",
            f'name = "{name}"',
            f"point_mm = {np.round(real.points[j], 4).tolist()}  # drawn {POINTS[j].tolist()}",
            f"axis = {np.round(real.axes[j], 6).tolist()}  # drawn {AXES[j].tolist()}",
            f"offset_deg = {np.degrees(real.offsets[j]):.5f}",
            "",
        ]
    lines += ["[encoder_eccentricity]", f"joint = {HIDDEN_JOINT}"]
    lines += [f"{key}_deg = {value}" for key, value in zip("ab", HIDDEN_WAVE, strict=True)]
    lines += ["", "[reflector]", f"at_home_mm = {REFLECTOR.tolist()}"]
    return "\n".join([*lines, "", "[base]", f"in_the_tracker_mm = {np.round(real.base[:3, 3], 4).tolist()}\n"])


def spatial(runs: int = 36) -> Scenario:
    """The scenario of the six-axis demo."""
    real, generator = hidden_arm(), np.random.default_rng(SEED)
    files = {"robot.urdf": URDF, "arm.toml": ARM, "hidden.toml": hidden_text(real)}
    hidden = {f"encoder_eccentricity:{HIDDEN_JOINT}.{key}": value for key, value in zip("ab", HIDDEN_WAVE, strict=True)}

    def positions(postures: Array) -> Array:
        return position(real, session(real, postures, generator))

    title = "a six-axis arm before a laser tracker"
    return Scenario(title, files, positions, hidden, every_parameter=False, runs=runs, effort={"starts": 1})
