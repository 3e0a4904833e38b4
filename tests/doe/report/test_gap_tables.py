"""What a person reads of a diagnosis: settings beside estimates, units, and what rows need before they are appended."""

from __future__ import annotations

from types import MappingProxyType, SimpleNamespace

import numpy as np

from doe.report.gap_tables import estimate_sheet, p_value
from doe.report.next_postures import missing_payload
from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.gap.candidate import Candidate, Estimate
from identification.measurements import Measurements

NOTHING = Calibration.of(np.zeros(2), np.zeros(2), MappingProxyType({}), (), np.zeros((0, 0)), MappingProxyType({}))


RIPPLE = "transmission_ripple:2"


def candidate(named: dict[str, EffectSpec], *parameters: str) -> Candidate:
    estimates = tuple(Estimate(name, "deg", 0.03, 0.01, 0.01, 0.05) for name in parameters)
    return Candidate(tuple(named), tuple(named.values()), (), 0.0, 10.0, 0.001, estimates, NOTHING)


def test_the_number_of_periods_is_part_of_the_name_of_the_effect() -> None:
    six, seven = (EffectSpec("transmission_ripple", 2, MappingProxyType({"k": k})) for k in (6.0, 7.0))
    play, figures = {"backlash:1": EffectSpec("backlash", 1)}, ["0.0300", "0.0100", "0.0500", "deg"]

    one = candidate({f"{RIPPLE}[k=6]": six}, f"{RIPPLE}.a")
    assert (one.title, one.keys) == (f"{RIPPLE}[k=6]", (RIPPLE,))
    assert one.to_json()["settings"] == {f"{RIPPLE}.k": 6.0}
    assert estimate_sheet(one.to_json()).rows == [[f"{RIPPLE}[k=6].a", *figures]]

    beside = candidate(play | {f"{RIPPLE}[k=6]": six}, "backlash:1.b", f"{RIPPLE}.a")
    assert beside.title == f"backlash:1 + {RIPPLE}[k=6]"
    assert estimate_sheet(beside.to_json()).rows == [["backlash:1.b", *figures], [f"{RIPPLE}[k=6].a", *figures]]

    # two at one joint: parameters and settings carry the label, too
    two = candidate({f"{RIPPLE}[k=6]": six, f"{RIPPLE}[k=7]": seven}, f"{RIPPLE}[k=6].a", f"{RIPPLE}[k=7].a")
    assert two.to_json()["settings"] == {f"{RIPPLE}[k=6].k": 6.0, f"{RIPPLE}[k=7].k": 7.0}
    assert estimate_sheet(two.to_json()).rows == [[f"{RIPPLE}[k=6].a", *figures], [f"{RIPPLE}[k=7].a", *figures]]


def test_estimates_say_their_unit_and_small_probabilities_are_no_zero() -> None:
    assert str(Estimate("backlash:3.b", "deg", 0.03, 0.01, 0.01, 0.05)) == "b = 0.03 +- 0.02 deg"
    assert str(Estimate("gear_ratio:1.e", "1", 0.5, 0.1, 0.3, 0.7)) == "e = 0.5 +- 0.2"
    assert [p_value(p) for p in (0.0, 1e-9, 0.0123)] == ["< 1e-300", "1e-09", "0.012"]


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
