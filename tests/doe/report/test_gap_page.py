"""What a person reads of a diagnosis: settings beside estimates, units, and what rows need before they are appended."""

from __future__ import annotations

from types import MappingProxyType, SimpleNamespace

import numpy as np

from doe.report.gap_page import estimate_text, setting_texts
from doe.report.next_postures import missing_payload
from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.gap.result import Candidate, Estimate
from identification.measurements import Measurements

NOTHING = Calibration.of(np.zeros(2), np.zeros(2), MappingProxyType({}), (), np.zeros((0, 0)), MappingProxyType({}))


def candidate(*named: tuple[str, EffectSpec]) -> Candidate:
    keys, specs = zip(*named, strict=True)
    return Candidate(keys, specs, keys, 0.0, 10.0, 0.001, (), NOTHING)


def test_the_number_of_periods_is_shown_once() -> None:
    six, seven = (EffectSpec("transmission_ripple", 2, MappingProxyType({"k": k})) for k in (6.0, 7.0))
    slope = ("gear_ratio:1", EffectSpec("gear_ratio", 1))
    assert setting_texts(candidate(("transmission_ripple:2", six))) == ["k = 6"]
    assert setting_texts(candidate(("transmission_ripple:2", six), slope)) == ["transmission_ripple:2.k = 6"]
    two = candidate(("transmission_ripple:2[k=6]", six), ("transmission_ripple:2[k=7]", seven))
    assert setting_texts(two) == []
    assert setting_texts(candidate(slope)) == []


def test_estimates_say_their_unit_unless_it_is_one() -> None:
    angle = Estimate("backlash:3.b", "deg", 0.03, 0.01, 0.01, 0.05)
    assert estimate_text(angle) == "b = 0.03 [0.01, 0.05] deg"
    assert estimate_text(angle, full=True) == "backlash:3.b = 0.03 [0.01, 0.05] deg"
    assert estimate_text(Estimate("gear_ratio:1.e", "1", 0.5, 0.1, 0.3, 0.7)) == "e = 0.5 [0.3, 0.7]"


def test_rows_without_payload_are_completed_before_others_are_appended() -> None:
    gravity = Gravity(np.array([0.0, -9.81]), np.array([5.0, 3.0]), np.full(2, 0.5), 7.5)
    arm, data = Arm([200.0, 100.0], gravity=gravity), Measurements(np.zeros((3, 2)), np.zeros((3, 2)))
    chosen, none = (SimpleNamespace(payload=payload) for payload in (np.array([5.0]), None))
    (note,) = missing_payload(arm, data, chosen)  # type: ignore[arg-type]
    assert "payload_kg" in note
    assert "7.5" in note
    assert missing_payload(arm, data, none) == []  # type: ignore[arg-type]
    weighed = Measurements(np.zeros((3, 2)), np.zeros((3, 2)), payload=np.ones(3))
    assert missing_payload(arm, weighed, chosen) == []  # type: ignore[arg-type]
