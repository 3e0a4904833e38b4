"""Models made of another one: what they pass on, and their Jacobians against those of the model they are made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.problem.bayesian import EnsembleModel
from doe.problem.derived_model import DerivedModel
from doe.problem.spatial import EveryPoint
from identification.arm import Arm
from identification.conditions import Conditions
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.model import Model

CHAIN = chain_of([DHRow(0.0, np.pi / 2, 200.0), DHRow(-300.0, 0.0, 0.0), DHRow(-250.0, 0.1, 40.0)])
TOOLS = {"a": np.array([50.0, 0.0, 20.0]), "b": np.array([-40.0, 30.0, 10.0])}
MODEL = Model(Arm(replace(CHAIN, tools=TOOLS), sigma=0.05))
POSTURES = np.random.default_rng(0).uniform(-2.0, 2.0, (4, 3))


def passed_on(found: DerivedModel) -> None:
    assert found.joint_types == MODEL.joint_types
    assert found.sigma == MODEL.sigma
    np.testing.assert_array_equal(found.neutral_conditions, MODEL.neutral_conditions)


def test_every_point_stacks_the_points() -> None:
    found = EveryPoint(MODEL)
    passed_on(found)
    np.testing.assert_array_equal(found.values, MODEL.values)
    each = [MODEL.jacobian(POSTURES, None, Conditions(marker=np.full(4, float(k)))) for k in range(2)]
    np.testing.assert_allclose(found.jacobian(POSTURES), np.concatenate(each, axis=1), atol=1e-9)
    assert found.dimension == 6


def test_an_ensemble_has_a_block_for_each_draw() -> None:
    draws = 1e-3 * np.random.default_rng(1).standard_normal((2, len(MODEL.names)))
    found = EnsembleModel(MODEL, draws)
    passed_on(found)
    jacobian, p = found.jacobian(POSTURES), len(MODEL.names)
    for k, draw in enumerate(draws):
        own = jacobian[:, 3 * k : 3 * k + 3, p * k : p * (k + 1)]
        np.testing.assert_allclose(own, MODEL.jacobian(POSTURES, draw), atol=1e-9)
    assert not jacobian[:, :3, p:].any()
    assert not jacobian[:, 3:, :p].any()
