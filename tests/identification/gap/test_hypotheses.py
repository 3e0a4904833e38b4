"""Hypotheses and their columns, against differences of models that have the effect."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec, Gravity
from identification.gap.fit import At, Rows
from identification.gap.hypotheses import hypotheses
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm(
    [300.0, 200.0, 150.0],
    gravity=Gravity([0.0, -9.81], [4.0, 3.0, 1.0], [0.5, 0.5, 0.5], 2.0),
    effects=(EffectSpec("encoder_eccentricity", 1),),
)
RNG = np.random.default_rng(3)
MEASURED = Measurements(RNG.uniform(-2.0, 2.0, (12, 3)), np.zeros((12, 2)), temperature=RNG.uniform(15.0, 25.0, 12))
ROWS = Rows.of(MEASURED)
LIBRARY = hypotheses(ARM, frozenset({"temperature"}))
VALUES = {"length_error:2": 1.0, "joint_offset:1": 0.02, "joint_offset:3": -0.01, "encoder_eccentricity:1.a": 0.003}
COLUMNS = LIBRARY.columns(At(LIBRARY.base, LIBRARY.base.parameters.vector(VALUES), ROWS))


@pytest.mark.parametrize(
    "label",
    [
        "transmission_ripple:2[k=7]",
        "transmission_ripple:3[k=64]",
        "joint_compliance:2",
        "joint_compliance",
        "joint_coupling:3",
        "backlash:1",
        "thermal_growth",
        "axes_skew",
        "base_rotation_drift",
    ],
)
def test_columns_are_derivatives_by_the_effects_parameters(label: str) -> None:
    """Central differences with steps that move the tip by a hundredth of a mm: error 1e-9 of the column at most.

    The library's columns are at a value of zero, where a model that has the effect is evaluated on both sides.
    """
    ((k, member),) = [(k, h) for k, h in enumerate(LIBRARY.members) if h.label == label]
    model = Model(ARM.with_effects(*ARM.effects, member.spec))
    start, own = model.parameters.vector(VALUES), [p.name for p in model.effects[-1].parameters]
    groups = [[name] for name in own]
    assert COLUMNS[k].shape == (12, 2, len(groups))
    for column, names in enumerate(groups):
        steps = model.parameters.vector(dict.fromkeys(names, 1.0))
        h = 0.01 / model.parameters[model.parameters.index(names[0])].scale
        ends = [model.position(ROWS.postures, start + sign * h * steps, ROWS.conditions) for sign in (-1.0, 1.0)]
        expected = (ends[1] - ends[0]) / (2.0 * h)
        np.testing.assert_allclose(COLUMNS[k][:, :, column], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_every_effect_at_every_joint_but_those_of_the_arm() -> None:
    labels = [h.label for h in LIBRARY.members]
    assert len(set(labels)) == len(labels)
    assert "encoder_eccentricity:1" not in labels
    assert LIBRARY.skipped["encoder_eccentricity:1"] == "already in the arm's model"
    assert {"encoder_eccentricity:2", "encoder_eccentricity:3"} < set(labels)
    assert "joint_coupling:1" not in labels  # there is no joint before the first
    assert set(LIBRARY.aliases) == {"measurement_scale", "tool_offset", "base_rotation"}


def test_weights_of_a_scan_make_one_effect() -> None:
    ripples = [h for h in LIBRARY.members if h.key == "transmission_ripple:2"]
    assert len(ripples) == 64 - 3 + 1
    assert sum(h.weight for h in ripples) == pytest.approx(1.0 / np.sqrt(3.0))
    (drift,) = [h for h in LIBRARY.members if h.key == "base_drift"]
    assert drift.weight == 1.0


def test_effects_without_their_data_are_skipped_with_the_reason() -> None:
    bare = hypotheses(Arm([300.0, 200.0]), frozenset())
    assert bare.skipped["thermal_growth"] == "needs temperature"
    assert bare.skipped["link_bending"] == "needs gravity"
    assert "length_offset" not in bare.skipped  # nothing that these data lack: they are of another instrument
