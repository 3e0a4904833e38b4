"""Several effects of one name at one joint, told apart by their settings: gear ripples of different k."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Calibration, EffectSpec, InputError, Measurements, Model, estimate, readonly
from identification.files.arm import load_arm, with_calibration, with_effects
from identification.gap.blocks import hypotheses

RIPPLE = "transmission_ripple"
LENGTHS = [300.0, 200.0, 100.0]


def ripple(joint: int, k: int, **values: float) -> EffectSpec:
    return EffectSpec(RIPPLE, joint, {"k": float(k), **values})


ARM = Arm(LENGTHS, effects=(ripple(1, 20), ripple(2, 18), ripple(1, 29)))
PLACES = (f"{RIPPLE}:1[k=20]", f"{RIPPLE}:2", f"{RIPPLE}:1[k=29]")  # the setting is said only where it must be


def test_names_say_the_setting_only_where_they_must_and_all_are_estimated() -> None:
    assert Model(ARM).names[6:] == tuple(f"{place}.{short}" for place in PLACES for short in "ab")
    assert [p.short for p in Model(ARM).parameters[6:]] == ["a", "b"] * 3
    alone = Model(ARM.with_effects(ripple(1, 20), EffectSpec("encoder_eccentricity", 1)))
    assert alone.names[6:8] == (f"{RIPPLE}:1.a", f"{RIPPLE}:1.b")
    with pytest.raises(InputError, match=r"transmission_ripple:1\[k=20\] is given 2 times, allowed: once"):
        _ = Model(ARM.with_effects(ripple(1, 20), ripple(1, 20))).effects
    values = {(1, 20): (1e-3, 2e-3), (2, 18): (-2e-3, 0.0), (1, 29): (0.0, 3e-3)}
    truth = ARM.with_effects(*(ripple(j, k, a=a, b=b) for (j, k), (a, b) in values.items()))
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (40, 3))
    fitted = estimate(Model(ARM), Measurements(q, Model(truth).position(q)))
    np.testing.assert_allclose(fitted.parameters[6:], np.ravel([*values.values()]), atol=1e-10)
    fixed = Model(ARM.with_effects(ripple(1, 20, a=1e-3), ripple(1, 29)))
    assert dict(fixed.fixed) == {f"{PLACES[0]}.a": 1e-3}
    assert fixed.names[6:] == (f"{PLACES[0]}.b", f"{PLACES[2]}.a", f"{PLACES[2]}.b")


def test_files_hold_them_all(tmp_path: Path) -> None:
    names, zeros = Model(ARM).names, readonly(np.zeros(3))
    values = dict(zip(names[6:], np.linspace(0.001, 0.006, 6), strict=True))
    arm = replace(ARM, calibration=Calibration.of(zeros, zeros, values, names, readonly(np.diag(np.arange(1.0, 13.0)))))
    text = with_calibration(with_effects(f"links_mm = {LENGTHS}\n", ARM.effects), arm.calibration)
    (tmp_path / "arm.toml").write_text(text)
    again = load_arm(tmp_path / "arm.toml")
    assert again.effects == arm.effects
    assert again.calibration is not None
    assert again.calibration.parameter_names == names
    assert dict(again.calibration.effects) == pytest.approx(values, rel=1e-14)
    np.testing.assert_allclose(again.calibration.covariance, arm.calibration.covariance, rtol=1e-14)
    assert f'"{PLACES[2]}.b_deg" = ' in text
    assert f'"{PLACES[1]}.a_deg" = ' in text


def test_only_the_same_setting_is_not_tried_again() -> None:
    tried = {(h.spec.joint, h.spec.values["k"]) for h in hypotheses(ARM, frozenset()).members if h.spec.name == RIPPLE}
    every = {(j, float(k)) for j in (1, 2, 3) for k in range(3, 65)}
    assert tried == every - {(1, 20.0), (1, 29.0), (2, 18.0)}
    alone = hypotheses(Arm(LENGTHS, effects=(EffectSpec("base_offset"),)), frozenset())
    assert alone.skipped["base_offset"] == "already in the arm's model"
