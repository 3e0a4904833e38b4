"""Minimal sets against the numbers of the literature, and against the rank of all parameters by singular values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm
from identification.estimation import estimate
from identification.kinematics.chain import DHRow, KinematicChain, chain_of
from identification.kinematics.parameters import PRISMATIC
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.model.minimal import independent, minimal, practical
from identification.model.placed import placed_model

HALF = np.pi / 2.0
UR10 = [(0.0, HALF, 127.3), (-612.0, 0.0, 0.0), (-572.3, 0.0, 0.0), (0.0, HALF, 163.9), (0.0, -HALF, 115.7)]
SIX = chain_of([DHRow(*row) for row in [*UR10, (0.0, 0.0, 92.2)]])
OFF_AXIS, ON_AXIS = {"1": np.array([60.0, 20.0, 30.0])}, {"1": np.array([0.0, 0.0, 30.0])}
THREE = {
    name: np.array(place) for name, place in zip("abc", ([60.0, 20, 30], [-40.0, 50, 30], [0.0, -70, 90]), strict=True)
}
SLIDING = replace(DHRow(0.0, HALF, 0.0), type=PRISMATIC, limits=(100.0, 600.0))


@pytest.mark.parametrize(
    ("chain", "count"),
    [
        (replace(SIX, tools=OFF_AXIS), 27),
        (replace(SIX, tools=ON_AXIS), 25),  # the last joint's offset and one more turn the point about itself
        (replace(SIX, tools=THREE), 33),
        (replace(SIX, tools=OFF_AXIS, angle_scale=300.0), 30),  # 4 for each axis, 6 of the frame
        (chain_of([DHRow(0.0, HALF, 300.0), SLIDING, DHRow(80.0, 0.3, 50.0), DHRow(0.0, 0.0, 90.0)]), None),
    ],
    ids=["reflector", "on the last axis", "three reflectors", "a pose", "a sliding joint"],
)
def test_as_many_as_can_be_told_apart(chain: KinematicChain, count: int | None) -> None:
    """The rank of all parameters' Jacobian, by singular values, is that of the minimal set; nothing is lost."""
    model = Model(Arm(chain))
    found = minimal(model)
    generator = np.random.default_rng(5)
    postures = generator.uniform(model.arm.lower, model.arm.upper, (200, len(chain)))
    marker = Conditions(marker=np.arange(200.0) % len(chain.tools))
    everything, kept = (
        (m.jacobian(postures, None, marker) / m.scales).reshape(-1, len(m.names)) for m in (model, found)
    )
    every_value, kept_value = (np.linalg.svd(rows, compute_uv=False) for rows in (everything, kept))
    rank = int(np.sum(every_value > 1e-9 * every_value[0]))
    assert len(found.names) == rank == int(np.sum(kept_value > 1e-9 * kept_value[0]))
    assert count is None or rank == count
    assert found.prior == {}


def test_a_fit_predicts_as_that_of_all() -> None:
    """Errors of parameters that are left out move the points as those that are kept, to first order: what is left is of
    the square of the errors, some (0.3 mm)^2 over a lever of 100 mm, 1e-3 mm."""
    chain = replace(SIX, tools=OFF_AXIS, settled=frozenset({"base"}))
    truth, generator = Model(Arm(chain)), np.random.default_rng(6)
    values = 0.3 / truth.scales * generator.standard_normal(len(truth.names))
    postures = generator.uniform(-2.0, 2.0, (60, 6))
    data = Measurements(postures, truth.position(postures, values))
    found = estimate(minimal(placed_model(Model(Arm(replace(chain, tools=ON_AXIS))), data)), data)
    fresh = generator.uniform(-2.0, 2.0, (50, 6))
    np.testing.assert_allclose(found.model.position(fresh, found.parameters), truth.position(fresh, values), atol=2e-3)


def test_columns_that_others_span() -> None:
    assert independent(np.array([[1.0, 2.0, 0.0, 1.0], [0.0, 0.0, 3.0, 1.0], [0.0, 0.0, 0.0, 1e-9]])) == [0, 2]


def test_what_measurements_hardly_tell_is_left_out() -> None:
    """A reflector 0.2 mm off the last axis tells that axis's own errors by a few micrometres: as on the axis."""
    nearly = replace(SIX, tools={"1": np.array([0.2, 0.0, 30.0])})
    data = Measurements(np.random.default_rng(1).uniform(-2.0, 2.0, (80, 6)), np.zeros((80, 3)))
    data = replace(data, positions=Model(Arm(nearly)).position(data.postures))
    found = practical(Arm(SIX), data)
    assert len(Model(found).names) == 25
    assert len(minimal(placed_model(Model(Arm(SIX)), data)).names) == 27
    assert practical(found, data) is found
    planar = Arm([300.0, 200.0])
    assert practical(planar, data) is planar
