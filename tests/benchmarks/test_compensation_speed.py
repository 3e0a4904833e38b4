"""Commands for 10,000 targets of a six-axis arm: `pytest -m benchmark -s tests/benchmarks/test_compensation_speed.py`.

Processor times of one core. Bars are ratios in one run: with four constraints beside without any, where the arm may
stand at all targets, and where something bars nearly half of them.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from doe.problem.constraints import constraints_of
from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.compensate import Compensation, compensate
from identification.model import Model
from identification.threads import single_thread
from identification.workspace import KeepOutCircle, KeepOutCylinder, LineOfSight, WorkspaceBox
from tests.doe.six_axis import SIX_AXIS

pytestmark = pytest.mark.benchmark

BOX = WorkspaceBox((200.0, 1200.0), (-900.0, 900.0), (0.0, 1300.0))
POST = KeepOutCylinder((700.0, 300.0, 0.0), (700.0, 300.0, 900.0), 120.0)
BALL = KeepOutCircle((600.0, -300.0, 500.0), 150.0)
SIGHT = LineOfSight(
    (3000.0, 500.0, 800.0), np.radians(30.0), (600.0, 0.0, 600.0), (500.0, 5000.0), (0.0, 0.0, 1.0), np.radians(50.0)
)
TARGETS, POSES = 10_000, 4_000
BARS = {"allowed": 5.0, "half anywhere": 15.0}


def calibrated(generator: np.random.Generator) -> Arm:
    """The arm with errors of its geometry: 0.3 mm and 1 mrad."""
    arm = replace(SIX_AXIS, constraints=(BOX, POST, BALL, SIGHT))
    names = [name for name in Model(arm).names if not name.startswith(("base", "tool"))]
    sizes = [0.3 if name.startswith("translation") else 1e-3 for name in names]
    values = dict(zip(names, (sizes * generator.standard_normal(len(names))).tolist(), strict=True))
    return replace(arm, calibration=Calibration({**values, "base.x": 0.0}))


def allowed(arm: Arm, count: int, generator: np.random.Generator) -> Array:
    """(count, n) random postures where the arm may stand."""
    found = np.empty((0, arm.links))
    while len(found) < count:
        drawn = generator.uniform(arm.lower, arm.upper, (50_000, arm.links))
        fits = [np.all(each.margin(drawn) >= 0.0, axis=1) for each in constraints_of(Model(arm))]
        found = np.concatenate([found, drawn[np.all(fits, axis=0)]])
    return found[:count]


def timed(arm: Arm, targets: Array, *, held: bool) -> tuple[Compensation, float]:
    """Commands with the arm's constraints or without, and the processor time [s]."""
    constraints = constraints_of(Model(arm)) if held else ()
    with single_thread():
        began = time.process_time()
        return compensate(arm, targets, constraints=constraints), time.process_time() - began


def test_constraints_cost_a_few_times_what_commands_without_them_do() -> None:
    generator = np.random.default_rng(1)
    arm = calibrated(generator)
    anywhere = generator.uniform(arm.lower, arm.upper, (TARGETS // 2, arm.links))
    inside = allowed(arm, TARGETS, generator)
    cases = {"allowed": inside, "half anywhere": np.concatenate([inside[: TARGETS // 2], anywhere])}
    compensate(arm, Model(arm).position(inside[:3])[:, :3])  # compiled
    for name, postures in cases.items():
        targets = Model(arm).position(postures)[:, :3]
        free, plain = timed(arm, targets, held=False)
        found, seconds = timed(arm, targets, held=True)
        barred = np.count_nonzero(~found.reached)
        print(
            f"\n{name}: {TARGETS:,} targets, {barred:,} barred: {seconds:.2f} s of processor time, {plain:.2f} s free"
        )
        assert free.reached.all()
        assert found.reached[: TARGETS // 2].all()
        margins = [each.margin(found.commands[found.reached]).min() for each in constraints_of(Model(arm))]
        assert min(margins) > -1e-6
        assert seconds / plain < BARS[name]


def test_poses_that_are_missed_at_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """4,000 poses of random postures, which can all be reached, with and without the second look at those missed."""
    chain = replace(SIX_AXIS.chain, tools={"1": np.array([0.0, 0.0, 100.0])}, angle_scale=1000.0)
    arm = replace(Arm(chain), calibration=Calibration({"base.x": 0.0}))
    drawn = [np.random.default_rng(seed).uniform(-np.pi, np.pi, (POSES // 2, 6)) for seed in (7, 11)]
    places = [(Model(arm).position(q)[:, :3], Model(arm).orientations(q)) for q in drawn]
    missed = [sum(int(np.count_nonzero(~compensate(arm, at, orientations=axes).reached)) for at, axes in places)]
    monkeypatch.setattr("identification.compensate._Search.again", lambda *_: None)
    missed += [sum(int(np.count_nonzero(~compensate(arm, at, orientations=axes).reached)) for at, axes in places)]
    print(f"\n{POSES:,} poses: {missed[0]} called out of reach, {missed[1]} without a second look")
    assert missed[0] < missed[1]
