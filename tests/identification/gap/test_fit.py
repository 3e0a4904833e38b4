"""Bounded, weighted, tied least squares against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from identification.arm import Arm, EffectSpec, Gravity
from identification.gap.fit import Rows, fit
from identification.measurements import Measurements
from identification.model import Model

GRAVITY = Gravity(np.array([0.0, -9.81]), np.array([8.0, 5.0, 3.0]), np.full(3, 0.5), 6.0)


def _rows(arm: Arm, values: dict[str, float], seed: int) -> Rows:
    rng = np.random.default_rng(seed)
    model = Model(arm)
    q = rng.uniform(-np.pi, np.pi, (40, 3))
    exact = model.position(q, np.array([values.get(name, 0.0) for name in model.names]))
    sigma = rng.uniform(0.05, 0.2, 40)
    return Rows.of(Measurements(q, exact + sigma[:, None] * rng.normal(size=(40, 2)), sigma=sigma))


@pytest.mark.parametrize("flexibility", [2e-4, -2e-4])
def test_agrees_with_scipy_within_bounds(flexibility: float) -> None:
    arm = Arm([300.0, 200.0, 150.0], gravity=GRAVITY, effects=(EffectSpec("link_bending"), EffectSpec("base_offset")))
    values = {"link_bending.flexibility": flexibility, "joint_offset:2": 0.03, "length_error:1": 2.0}
    rows = _rows(arm, values, 1)
    model = Model(arm)
    found = fit(model, rows)
    lower = np.array([p.lower for p in model.parameters])

    def residual(scaled: np.ndarray) -> np.ndarray:
        position = model.position(rows.postures, scaled / model.scales, rows.conditions)
        return rows.whiten(rows.positions - position)

    start = np.clip(np.zeros(len(lower)), lower * model.scales, np.inf) + 1e-9
    other = least_squares(residual, start, bounds=(lower * model.scales, np.inf), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert found.squares == pytest.approx(2.0 * other.cost, rel=1e-6)
    at_bound = flexibility < 0.0
    assert (found.by_name["link_bending.flexibility"] == 0.0) == at_bound
    assert bool(found.free.all()) != at_bound


def test_rank_counts_only_what_the_data_determine() -> None:
    arm = Arm([300.0, 200.0])
    q = np.column_stack([np.linspace(-2, 2, 15), np.zeros(15)])  # joint 2 never moves
    model = Model(arm)
    rows = Rows.of(Measurements(q, model.position(q) + 0.1 * np.random.default_rng(3).normal(size=(15, 2))))
    found = fit(model, rows)
    assert found.rank == 2
    assert found.freedom == 28
