"""What do the intervals of `identify` hold where the arm sags and its model does not?

    .venv/bin/pytest -m benchmark -s tests/benchmarks/test_bias_of_intervals.py

A palletizer of four axes with compliance in all joints (0.5 mm and more at the tip, sigma 0.08 mm), identified by
geometry alone. Each interval is held against two values: the *true* one, which very many rows without noise and without
the compliance give (in the same gauge, which the prior of the machining fixes), and the *best* one, which very many
rows with it give.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind.cells import CellSpec, arm_of
from doe.studies.blind.simulator import TrueArm, measure, session, shift, turn
from identification.estimation import Identification, estimate
from identification.model import Model

SETS, MANY = 4, 1000
SAG = 1e-6  # [rad/(N m)]


def palletizer(rng: np.random.Generator) -> TrueArm:
    """Axes 2 mrad and 0.5 mm off, encoders 5 mrad."""
    half = np.pi / 2.0
    table = np.array([(280.0, -half, 540.0), (900.0, 0.0, 0.0), (950.0, 0.0, 0.0), (180.0, half, 0.0)])
    lower, upper = np.radians([(-160.0, -130.0, -60.0, -110.0), (160.0, -10.0, 70.0, 110.0)])
    base = shift(rng.uniform(-1500.0, 1500.0, 3))
    base[:3, :3] = turn(rng.normal(0.0, 1.0, 3))
    tool, masses = np.array([[100.0, 0.0, -150.0]]) + rng.normal(0.0, 5.0, (1, 3)), np.array([150.0, 80.0, 60.0, 15.0])
    loads = {"masses": masses, "payload": 40.0, "lower": lower, "upper": upper, "sigma": 0.08}
    return TrueArm.built(table, rng, 2e-3, 0.5, offsets=rng.normal(0.0, 5e-3, 4), base=base, tools=tool, **loads)


def fitted(truth: TrueArm, model: Model, m: int, rng: np.random.Generator) -> Identification:
    """From random postures."""
    run = session(truth, rng.uniform(truth.lower, truth.upper, (m, truth.n)), rng)
    return estimate(model, measure(truth, run, rng))


@pytest.mark.benchmark
@pytest.mark.parametrize("m", [30, 150])
def test_intervals_hold_the_best_fit_and_not_the_truth(m: int) -> None:
    held, kinds = np.zeros((2, 0), dtype=bool), set[str]()
    for seed in range(SETS):
        rng = np.random.default_rng([8, seed])
        stiff = palletizer(rng)
        soft = replace(stiff, effects=[("joint_compliance", None, {"c": SAG * rng.uniform(0.5, 1.5, stiff.n)})])
        model = Model(arm_of(CellSpec(m, space=True), stiff, rng))
        found = fitted(soft, model, m, rng)
        kinds.add(found.uncertainty.kind)
        own = [k for k, name in enumerate(found.names) if ":" in name]  # of the joints, not of base and tool
        low, high = found.intervals[own].T
        values = [fitted(replace(truth, sigma=0.0), model, MANY, rng).parameters[own] for truth in (stiff, soft)]
        held = np.hstack([held, [(low <= value) & (value <= high) for value in values]])
    shares = f"the true values in {held[0].mean():.3f}, the best in {held[1].mean():.3f}"
    print(f"\n{m} rows: {shares} of {held.shape[1]}, intervals {kinds}")
    assert held[1].mean() > 0.9
