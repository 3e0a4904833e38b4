"""What each effect alone is worth beside the base model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.gap.diagnose import diagnose
from identification.gap.result import Trial
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0, 150.0], sigma=0.05)


def backlash(data: Measurements) -> Trial:
    found = diagnose(ARM, data)
    (one,) = (trial for trial in found.trials if trial.effect == "backlash:2")
    assert [c.delta_bic for c in found.candidates[:1]] == [0.0]
    assert "-0.0" not in str(found).split()
    return one


def test_a_row_that_is_left_out_is_not_in_the_trials() -> None:
    """One row that is 3 mm off would drown what every effect gains alone."""
    rng = np.random.default_rng(3)
    model, q = Model(ARM.with_effects(EffectSpec("backlash", 2))), rng.uniform(-2.5, 2.5, (60, 3))
    bare = Measurements(q, np.zeros((60, 2)), np.arange(60.0))
    exact = model.position(q, model.parameters.vector({"backlash:2.b": 6e-4}), bare.conditions)
    data = replace(bare, positions=exact + 0.05 * rng.standard_normal((60, 2)))
    off = data.positions.copy()
    off[11] += [2.5, -1.6]
    whole, spoiled = backlash(data), backlash(replace(data, positions=off))
    assert spoiled.f == pytest.approx(whole.f, rel=0.2)
    assert spoiled.delta_bic == pytest.approx(whole.delta_bic, rel=0.2)
