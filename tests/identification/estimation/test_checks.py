"""Spatial arms: what a fit needs, and that it starts from nothing and is held by the prior of machining."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arm import Arm, Machining
from identification.estimation import estimate
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.kinematics.frames import from_roll_pitch_yaw, pose
from identification.kinematics.spatial import SpatialChain
from identification.measurements import Measurements
from identification.model import Model

ROWS = [
    (0.0, np.pi / 2, 350.0),
    (-400.0, 0.0, 0.0),
    (-350.0, 0.0, 0.0),
    (0.0, np.pi / 2, 110.0),
    (0.0, -np.pi / 2, 90.0),
]
CHAIN = chain_of([DHRow(*row) for row in [*ROWS, (0.0, 0.0, 80.0)]])
SIGMA = 0.05


def measured(model: Model, values: np.ndarray, rows: int, seed: int) -> Measurements:
    generator = np.random.default_rng(seed)
    postures = generator.uniform(-2.5, 2.5, (rows, 6))
    noise = SIGMA * generator.standard_normal((rows, 3))
    return Measurements(postures, model.position(postures, values) + noise)


def true_chain() -> SpatialChain:
    base = pose((2000.0, 300.0, -400.0), from_roll_pitch_yaw(0.2, -0.1, 2.0))
    return replace(CHAIN, base=base, tools={"1": np.array([40.0, -90.0, 60.0])})


def test_a_spatial_arm_from_nothing() -> None:
    """A linear model with the right prior: of the free parameters of machining size, fresh points are predicted to
    about sigma sqrt(p / rows), and no correction runs far beyond the prior."""
    generator = np.random.default_rng(0)
    truth = Model(Arm(true_chain()))
    sizes = np.array([truth.prior.get(name, 0.0) for name in truth.names])
    values = 0.5 * sizes * generator.standard_normal(len(sizes))
    found = estimate(Model(Arm(CHAIN, sigma=SIGMA)), measured(truth, values, 80, 1))
    fresh = generator.uniform(-2.5, 2.5, (200, 6))
    error = found.model.position(fresh, found.parameters) - truth.position(fresh, values)
    expected = SIGMA * np.sqrt(39 / 80)  # of a distance: 39 parameters from 80 rows, less where the prior knows more
    # its square is chi2 of up to 39 degrees of freedom over 39: beyond 2 once in 5,000, twice it is no chance
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 2.0 * expected
    found_values = np.array([found.parameters[k] for k, name in enumerate(found.names) if name in truth.prior])
    assert np.all(np.abs(found_values) < 4.0 * sizes[sizes > 0.0])  # 4 standard deviations of the prior
    assert found.not_identifiable == ()
    assert 0.7 < float(found.scatter or 0.0) / SIGMA < 1.4  # of some 200 degrees of freedom: 6 standard deviations


def test_machining_decides_how_far_corrections_go() -> None:
    truth = Model(Arm(true_chain()))
    data = measured(truth, np.zeros(len(truth.names)), 60, 2)
    tight = Machining(1e-6, 1e-9)
    found = estimate(Model(Arm(CHAIN, sigma=SIGMA, machining=tight)), data)
    held = [k for k, name in enumerate(found.names) if name in found.model.prior]
    assert np.abs(found.parameters[held]).max() < 1e-5
    assert Model(Arm(replace(CHAIN, fixed=frozenset({"translation_x:2"})))).prior == {}
