"""The held-out gap of the named model against its rivals: the true model, the whole library, a Gaussian process."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Array
from identification.gap.blind_study import Case
from identification.gap.diagnose import diagnose
from identification.gap.fit import Fit, fit, links_start
from identification.gap.hypotheses import hypotheses
from identification.gap.whitening import Rows
from identification.model import Model
from tests.identification.gap.blind import case


def gap(residual: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def fitted(model: Model, rows: Rows) -> Fit:
    return fit(model, rows, links_start(model, rows))


def missed(found: Fit, rows: Rows) -> Array:
    return rows.positions - found.model.position(rows.postures, found.values, rows.conditions)


def whole_library(data: Case) -> Model:
    """Every effect at once, ripples and the single joints of families left out."""
    library = hypotheses(data.arm, data.measurements.given)
    return Model(data.arm.with_effects(*(h.spec for h in library.unscanned if h.key[:17] != "joint_compliance:")))


def gaussian_process(postures: Array, residual: Array, fresh: Array) -> Array:
    """Mean prediction at fresh postures: squared exponential on (cos q, sin q), length and noise by likelihood."""

    def distance(a: Array, b: Array) -> Array:
        return np.sum(2.0 - 2.0 * np.cos(a[:, None, :] - b[None, :, :]), axis=2)

    near, far = distance(postures, postures), distance(fresh, postures)
    m, best = len(postures), (np.inf, np.zeros((len(fresh), 2)))
    for length in np.geomspace(0.5, 8.0, 9):
        for noise in np.geomspace(0.02, 50.0, 12):
            kernel = np.exp(-0.5 * near / length**2) + noise * np.eye(m)
            solved = np.linalg.solve(kernel, residual)
            variance = np.sum(residual * solved) / (2 * m)
            cost = 2 * m * np.log(variance) + 2 * np.linalg.slogdet(kernel)[1]
            if cost < best[0]:
                best = (cost, np.exp(-0.5 * far / length**2) @ solved)
    return best[1]


def compared(cell: str, count: int) -> dict[str, float]:
    """Mean held-out gap in units of the noise floor, by method."""
    figures: dict[str, list[float]] = {name: [] for name in ("base", "named", "true", "library", "process")}
    for seed in range(1000, 1000 + count):
        data = case(cell, seed)
        assert data.holdout is not None
        rows, fresh = Rows.of(data.measurements), Rows.of(data.holdout)
        floor = np.sqrt(2.0) * data.arm.sigma
        base = fitted(Model(data.arm), rows)
        found = diagnose(data.arm, data.measurements, data.holdout, draws=199)
        guess = gaussian_process(rows.postures, missed(base, rows), fresh.postures)
        figures["base"].append(gap(missed(base, fresh)) / floor)
        figures["named"].append(found.gap.held_out_after / floor)
        figures["true"].append(gap(missed(fitted(Model(data.arm.with_effects(*data.specs)), rows), fresh)) / floor)
        figures["library"].append(gap(missed(fitted(whole_library(data), rows), fresh)) / floor)
        figures["process"].append(gap(missed(base, fresh) - guess) / floor)
    return {name: float(np.mean(values)) for name, values in figures.items()}


@pytest.mark.parametrize(
    ("cell", "count"),
    [("one, lambda 8, m=50", 12), pytest.param("one, lambda 8, m=50", 150, marks=pytest.mark.slow)],
)
def test_named_model_is_nearly_as_good_as_the_true_one_and_better_than_the_rivals(cell: str, count: int) -> None:
    mean = compared(cell, count)
    assert mean["named"] <= 1.05 * mean["true"]
    assert mean["named"] < mean["base"]
    assert mean["named"] < mean["library"]
    assert mean["named"] < mean["process"]
