"""The two implementations of arms and effects agree: products of exponentials in plain numpy, and frames in CasADi."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from doe.studies.blind import cells, simulator
from doe.studies.blind.cells import random_truth
from doe.studies.blind.simulator import RowConditions, TrueArm, session
from identification import Arm, Calibration, Conditions, DHRow, EffectSpec, Gravity, Model, chain_of
from identification.kinematics.frames import from_angles, pose, rotation_about
from identification.measurements import past_from_order

AROUND: tuple[Any, Any] = ({"a": 2e-3, "b": -1e-3},) * 2
IN_PLANE: dict[str, tuple[Any, Any]] = {
    "joint_compliance": ({"c": 2e-5},) * 2,
    "joint_compliance*": ({"c": np.array([1e-5, 2e-5, 3e-5])}, {"c1": 1e-5, "c2": 2e-5, "c3": 3e-5}),
    "encoder_eccentricity": AROUND,
    "encoder_second_harmonic": AROUND,
    "transmission_ripple": ({"a": 2e-3, "b": -1e-3, "k": 7},) * 2,
    "gear_ratio": ({"e": 1e-3},) * 2,
    "joint_coupling": ({"c": 1e-3},) * 2,
    "backlash": ({"b": 1e-3},) * 2,
    "gravity_backlash": ({"b": 1e-3},) * 2,
    "link_bending": ({"flexibility": 3e-5},) * 2,
    "thermal_growth": ({"a": 2e-4},) * 2,
    "base_offset": ({"x0": 1.0, "y0": -2.0},) * 2,
    "base_drift": ({"v": np.array([1.0, -2.0])}, {"vx": 1.0, "vy": -2.0}),
    "base_rotation_drift": ({"w": 2e-3},) * 2,
    "axes_skew": ({"a": 1e-3, "b": -2e-3},) * 2,
    "thermal_transient": ({"a": 3e-4, "tau": 0.2},) * 2,
    "joint_step": ({"b": 1e-3, "at": 0.1},) * 2,
    "link_step": ({"d": 0.3, "at": -0.2},) * 2,
    "base_step": ({"x": 0.2, "y": -0.3, "at": 0.05}, {"x": 0.2, "y": -0.3, "at": 0.05, "side": 1.0}),
    "joint_hysteresis": ({"b": 1e-3, "width_deg": np.degrees(0.9)},) * 2,
    "payload_error": ({"d": 2.0},) * 2,
    "gravity_tilt": ({"angle": 0.1},) * 2,
}


LOADS = ("payload_error", "gravity_tilt")  # show through compliance only
OF_ARM = (*cells.OF_ARM, "thermal_transient", "base_step", *LOADS)


def planar() -> tuple[TrueArm, RowConditions]:
    """Under gravity that is not along an axis, and with another payload in each row."""
    rng = np.random.default_rng(1)
    truth = replace(random_truth(rng, 3), gravity=np.array([1.5, -9.6, 0.0]))
    return truth, replace(session(truth, rng.uniform(-np.pi, np.pi, (40, 3)), rng), payload=rng.uniform(0.0, 10.0, 40))


def agree(truth: TrueArm, run: RowConditions, names: list[str], *known: EffectSpec) -> None:
    """Each effect at joint 2 if it is one of a joint: to 1e-9 mm, rounding of sums of some 1000 mm."""
    joints = [None if name in OF_ARM else 2 for name in names]
    specs = [EffectSpec(name.rstrip("*"), j, IN_PLANE[name][1]) for name, j in zip(names, joints, strict=True)]
    drawn = [(name.rstrip("*"), j, IN_PLANE[name][0]) for name, j in zip(names, joints, strict=True)]
    truth = replace(truth, effects=drawn)
    arm = Arm(
        truth.lengths,
        gravity=Gravity(truth.gravity[:2], truth.masses, np.full(3, truth.center), truth.payload),
        effects=(*known, *specs),
        calibration=Calibration.of(truth.links[:, 0] - truth.lengths, truth.offsets),
    )
    conditions = Conditions(run.payload, run.warm, run.t, run.s, past=past_from_order(run.q))
    expected = simulator.position(truth, run)
    np.testing.assert_allclose(Model(arm).position(run.q, None, conditions), expected, atol=1e-9)
    assert np.abs(expected - simulator.position(replace(truth, effects=[]), run)).max() > 0.01


@pytest.mark.parametrize("name", IN_PLANE)
def test_two_implementations_agree_in_the_plane(name: str) -> None:
    truth, run = planar()
    if name not in LOADS:
        agree(truth, run, [name])
        return
    c = 1e-5 * np.arange(1.0, 4.0)
    known = EffectSpec("joint_compliance", None, {f"c{j}": value for j, value in enumerate(c, 1)})
    agree(replace(truth, modelled=[("joint_compliance", None, {"c": c})]), run, [name], known)


def test_all_effects_together_agree_in_the_plane() -> None:
    agree(*planar(), [name for name in IN_PLANE if name not in (*LOADS, "joint_compliance*")])


def test_a_leaning_axis_seen_in_the_plane() -> None:
    """The chain in space against the effect's first order, whose error is of the size of the fourth power of the lean:
    0.03^4 of 660 mm. The scale that comes with it is one of the lengths beyond the joint."""
    rng, square, beta = np.random.default_rng(3), 9e-4, 0.7
    q, lengths = rng.uniform(-np.pi, np.pi, (20, 4)), np.array([260.0, 180.0, 120.0, 100.0])
    shorter = lengths * np.where(np.arange(4) >= 2, 1.0 - square / 4.0, 1.0)
    factor = square / 4.0 * np.exp(2j * beta)
    arm = Arm(shorter, effects=(EffectSpec("axis_tilt", 3, {"a": factor.real, "b": factor.imag}),))
    zero = np.zeros(4)
    rest = {"masses": zero, "payload": 0.0, "lower": zero, "upper": zero, "sigma": 1.0}
    truth = TrueArm.planar(lengths, zero, zero, **rest)
    run = session(truth, q, rng)
    straight = simulator.position(truth, run)
    lean = {"square": square, "beta": beta}
    leaning = simulator.position(replace(truth, effects=[("axis_tilt", 3, lean)]), run)
    np.testing.assert_allclose(Model(arm).position(q), leaning, atol=660.0 * square**2)
    column = simulator.column(truth, run, ("axis_tilt", 3, lean | {"square": 1.0}))
    np.testing.assert_allclose(square * column, (leaning - straight).ravel(), atol=660.0 * square**2)
    assert np.abs(leaning - straight).max() > 0.05


def test_what_simulates_loads_nothing_of_the_model_that_is_judged() -> None:
    """In a fresh interpreter, so that indirect imports count: the arm's description is set up, no model."""
    code = "import sys, doe.studies.blind.cells; print(*sorted(sys.modules))"
    loaded = {*subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()}
    assert "doe.studies.blind.simulator" in loaded
    judged = ("effects", "model", "estimation", "gap", "inspection", "validate", "simulate")
    assert not [name for name in loaded if name.startswith(tuple(f"identification.{module}" for module in judged))]
    ours = {name for name in loaded if name.partition(".")[0] == "doe" and not name.startswith("doe.studies")}
    assert ours <= {"doe"}


# -- in space ----------------------------------------------------------------------------------------------------------
HALF = np.pi / 2
TABLE = np.array([(120.0, -HALF, 400.0), (500.0, 0.0, 0.0), (90.0, -HALF, 30.0), (0.0, HALF, 450.0), (0.0, 0.2, 90.0)])
TOOLS = np.array([[30.0, -20.0, 60.0], [-40.0, 10.0, 50.0]])
MASSES = np.array([20.0, 15.0, 10.0, 5.0, 2.0])
SIMPLE = ("encoder_eccentricity", "encoder_second_harmonic")
# ours, theirs, and how well they agree: turns about x, then y, then z against one about a vector are of second order
VALUES: dict[str, tuple[dict, dict, float]] = {
    "joint_compliance:3": ({"c": 2e-5}, {"c": 2e-5}, 1e-9),
    "joint_compliance": ({f"c{j}": 1e-5 * j for j in range(1, 6)}, {"c": 1e-5 * np.arange(1.0, 6.0)}, 1e-9),
    "bearing_compliance:2": ({"c": 1e-6}, {"c": 1e-6}, 1e-5),
    "bearing_compliance:4": ({"c": 1e-6}, {"c": 1e-6}, 1e-5),
    "gravity_backlash:2": ({"b": 1e-3}, {"b": 1e-3}, 1e-9),
    "axis_runout:3": ({"a": 0.2, "b": -0.1}, {"a": 0.2, "b": -0.1}, 1e-9),
    "axis_runout:5": ({"a": 0.2, "b": -0.1}, {"a": 0.2, "b": -0.1}, 1e-9),
    **{f"{name}:4": ({"a": 2e-3, "b": -1e-3}, {"a": 2e-3, "b": -1e-3}, 1e-9) for name in SIMPLE},
    "transmission_ripple:2": ({"a": 2e-3, "b": -1e-3, "k": 7}, {"a": 2e-3, "b": -1e-3, "k": 7}, 1e-9),
    "gear_ratio:1": ({"e": 1e-3}, {"e": 1e-3}, 1e-9),
    "joint_coupling:5": ({"c": 1e-3}, {"c": 1e-3}, 1e-9),
    "backlash:3": ({"b": 1e-3}, {"b": 1e-3}, 1e-9),
    "thermal_growth": ({"a": 2e-4}, {"a": 2e-4}, 1e-9),
    "base_drift": ({"vx": 1.0, "vy": -2.0, "vz": 0.5}, {"v": np.array([1.0, -2.0, 0.5])}, 1e-9),
    "base_rotation_drift": ({"wx": 1e-4, "wy": -2e-4, "wz": 1e-4}, {"w": np.array([1e-4, -2e-4, 1e-4])}, 1e-4),
}


def truth_and_session() -> tuple[TrueArm, RowConditions]:
    """An arm as drawn, 30 postures of it."""
    generator = np.random.default_rng(1)
    base = pose((300.0, -200.0, 900.0), from_angles((0.3, -0.2, 2.0)))
    limit = np.full(5, 2.0)
    loads = {"masses": MASSES, "payload": 4.0, "lower": -limit, "upper": limit, "sigma": 0.05}
    truth = TrueArm.built(
        TABLE, np.random.default_rng(0), 0.0, 0.0, offsets=np.zeros(5), base=base, tools=TOOLS, **loads
    )
    return truth, session(truth, generator.uniform(-2.0, 2.0, (30, 5)), generator)


def model_of(truth: TrueArm, *specs: EffectSpec) -> Model:
    """The program's model of the same arm, base and tools known."""
    chain = chain_of([DHRow(a, alpha, d) for a, alpha, d in truth.table.tolist()])
    tools = dict(zip("12", truth.tools, strict=True))
    chain = replace(chain, base=truth.base, tools=tools, settled=frozenset({"base", "tool"}))
    gravity = Gravity(truth.gravity, truth.masses, np.full(truth.n, truth.center), truth.payload, truth.load)
    return Model(Arm(chain, gravity=gravity, effects=specs))


def difference(truth: TrueArm, run: RowConditions, *specs: EffectSpec, drawn: TrueArm | None = None) -> float:
    """Largest distance [mm] of a coordinate, of both measured points;  drawn : what the model knows of the arm."""
    run = replace(run, marker=np.arange(len(run.q)) % 2)
    conditions = Conditions(run.payload, run.warm, run.t, run.s, marker=1.0 * run.marker)
    ours = model_of(drawn or truth, *specs).position(run.q, conditions=conditions)
    return float(np.abs(ours - simulator.position(truth, run)).max())


@pytest.mark.parametrize("key", VALUES)
def test_two_implementations_agree(key: str) -> None:
    """Every effect moves the tip by more than 0.01 mm; the second order of 1e-4 rad at 1000 mm is 1e-5 mm."""
    name, _, joint = key.partition(":")
    number, (ours, theirs, tolerance) = int(joint) if joint else None, VALUES[key]
    truth, run = truth_and_session()
    hidden = replace(truth, effects=[(name, number, theirs)])
    assert difference(hidden, run, EffectSpec(name, number, ours)) < tolerance
    assert difference(hidden, run) > 0.01


def test_loads_that_are_wrong() -> None:
    """A heavier tool and a leaning base show through every effect of gravity."""
    truth, run = truth_and_session()
    c = ("joint_compliance", None, {"c": np.full(5, 2e-5)})
    known = EffectSpec("joint_compliance", None, {f"c{j}": 2e-5 for j in range(1, 6)})
    heavy = replace(truth, effects=[c, ("payload_error", None, {"d": 3.0})])
    assert difference(heavy, run, known, EffectSpec("payload_error", None, {"d": 3.0})) < 1e-9
    assert difference(heavy, run, known) > 0.01
    lean = replace(truth, effects=[c, ("gravity_tilt", None, {"x": 2e-3, "y": -3e-3})])
    # turns about x, then y, against one about a vector: 3e-6 rad of gravity, which moves the tip by 1 mm
    assert difference(lean, run, known, EffectSpec("gravity_tilt", None, {"x": 2e-3, "y": -3e-3})) < 1e-5
    assert difference(lean, run, known) > 1e-3


def test_a_payload_that_hangs_elsewhere() -> None:
    """Where the arm file says, or away from there; whichever point is measured."""
    truth, run = truth_and_session()
    for name, value in (("joint_compliance", 2e-5), ("bearing_compliance", 1e-6), ("gravity_backlash", 1e-3)):
        short = "b" if name == "gravity_backlash" else "c"
        known = EffectSpec(name, 4, {short: value})
        away = replace(truth, effects=[(name, 4, {short: value})], load=np.array([250.0, -40.0, 80.0]))
        assert difference(away, run, known) < 1e-5
        beside = replace(away, load=None)  # the model's payload is at the first point
        shift = dict(zip("xyz", (away.load - truth.tools[0]).tolist(), strict=True))  # type: ignore[operator]
        assert difference(away, run, known, EffectSpec("payload_place", None, shift), drawn=beside) < 1e-5
        assert difference(away, run, known, drawn=beside) > 1e-3


def test_effects_outside_the_library() -> None:
    """An error of an angle is the arm at that angle; an axis that wobbles turns what lies beyond about the origin of
    its frame, whose place is that of a chain of Denavit-Hartenberg rows in plain numpy."""
    truth, run = truth_and_session()
    here, joint = simulator.position(truth, run), 3
    q = run.q[:, joint - 1]
    errors = {
        "bump": ({"h": 1e-3, "at": 0.5, "width": 0.4}, 1e-3 * np.exp(-0.5 * ((q - 0.5) / 0.4) ** 2)),
        "cubic": ({"c": 1e-3}, 1e-3 * q**3),
        "cable_pull": ({"c": 1e-3}, 1e-3 * q * run.q[:, joint]),
    }
    for name, (values, error) in errors.items():
        moved = run.q.copy()
        moved[:, joint - 1] += error
        hidden = replace(truth, effects=[(name, joint, values)])
        expected = simulator.position(truth, replace(run, q=moved))
        np.testing.assert_allclose(simulator.position(hidden, run), expected, atol=1e-9)
    found = simulator.position(replace(truth, effects=[("axis_wobble", joint, {"c": 1e-5})]), run) - here
    for row, posture in enumerate(run.q):
        frame = truth.base
        for j, (a, alpha, d) in enumerate(TABLE[: joint - 1]):
            about, link = pose(rotation=rotation_about([0.0, 0.0, 1.0], posture[j])), pose((a, 0.0, d))
            frame = frame @ about @ link @ pose(rotation=rotation_about([1.0, 0.0, 0.0], alpha))
        axes = (frame @ pose(rotation=rotation_about([0.0, 0.0, 1.0], posture[joint - 1])))[:3, :3]
        tilt = 1e-5 * axes[:, :2] @ [np.cos(2.0 * q[row]), np.sin(2.0 * q[row])]
        expected = np.cross(tilt, here[row] - frame[:3, 3])
        np.testing.assert_allclose(found[row], expected, atol=1e-6)  # second order: 1e-10 of 1e3 mm
    assert np.abs(found).max() > 1e-3


def test_what_the_geometry_can_be_wrong_about() -> None:
    """The base Jacobian contains the derivative by every parameter of the model's geometry, by finite differences."""
    truth, run = truth_and_session()
    chain = replace(
        chain_of([DHRow(*row) for row in truth.table.tolist()]), base=truth.base, tools={"1": truth.tools[0]}
    )
    model = Model(Arm(chain))
    steps = 1e-4 / model.scales
    columns = [
        (model.position(run.q, model.values + step) - model.position(run.q, model.values - step)).ravel() / 2e-4
        for step in np.diag(steps)
    ]
    space = simulator.base_jacobian(replace(truth, tools=truth.tools[:1]), run)
    for column in columns:
        left = column - space @ np.linalg.lstsq(space, column, rcond=1e-10)[0]
        assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(column)  # of differences: (1e-4)^2 and 1e-13 / 1e-4
