"""Waves of gears beyond the orders that are tried at first."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.effects import Scope, Setting, library
from identification.files.arm import load_arm
from identification.files.arm_text import dump_arm
from identification.gap.diagnose import diagnose
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.outside.further_orders import with_orders
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0], sigma=0.05)
RIPPLE = "transmission_ripple"


def measured(order: float) -> Measurements:
    rng = np.random.default_rng(4)
    q = rng.uniform(-np.pi, np.pi, (60, 2))
    truth = Model(ARM.with_effects(EffectSpec(RIPPLE, 2, {"k": order, "a": 4e-4, "b": -4e-4})))
    return Measurements(q, truth.position(q) + 0.05 * rng.normal(size=(60, 2)))


def test_a_wave_of_a_strain_wave_gear_is_looked_up() -> None:
    found = diagnose(ARM, measured(202.0), draws=399)
    assert found.verdict == "named"
    assert [(s.name, s.joint) for s in found.named.specs] == [(RIPPLE, 2)]
    assert found.named.specs[0].values["k"] == pytest.approx(202.0, abs=0.125)


def test_orders_around_one_are_added_once() -> None:
    known = hypotheses(ARM, frozenset())
    wider = with_orders(known, 2, 101.5)
    added = wider.members[len(known.members) :]
    assert [h.spec.values["k"] for h in added] == [101.375, 101.5, 101.625]
    assert sum(h.weight for h in added) < 0.01
    assert len(with_orders(wider, 2, 101.5).members) == len(wider.members)


def test_gear_ratios_of_the_arm_file_are_tried_at_first(tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "arm.toml").write_text("links_mm = [300, 200]\ngear_ratio = [0, 101]\n")
    arm = load_arm(tmp_path / "arm.toml")
    assert "gear_ratio = [0.0, 101.0]" in dump_arm(arm)
    setting = Setting.of(library()[RIPPLE].settings["k"])
    assert setting.scan(Scope(arm, 2)) == [*map(float, range(3, 65)), 101.0, 202.0, 303.0, 404.0]
    assert setting.scan(Scope(arm, 1)) == [float(k) for k in range(3, 65)]
