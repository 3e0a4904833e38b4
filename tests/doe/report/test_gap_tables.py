"""What a person reads of a diagnosis: settings beside estimates, units, and what rows need before they are appended."""

from __future__ import annotations

from types import MappingProxyType, SimpleNamespace

import numpy as np

from doe.report.gap_sections import doubted
from doe.report.gap_tables import (
    curve_shape_sheet,
    estimate_sheet,
    largest_excluded_sheet,
    order_sheet,
    p_value,
)
from doe.report.next_postures import missing_payload
from doe.report.page import Section, Sheet
from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.gap.result import Candidate, Estimate
from identification.measurements import Measurements

NOTHING = Calibration.of(np.zeros(2), np.zeros(2), MappingProxyType({}), (), np.zeros((0, 0)), MappingProxyType({}))


RIPPLE = "transmission_ripple:2"


def candidate(named: dict[str, EffectSpec], *parameters: str) -> Candidate:
    estimates = tuple(Estimate(name, "deg", 0.03, 0.01, 0.01, 0.05) for name in parameters)
    return Candidate(tuple(named), (), tuple(named.values()), NOTHING, estimates)


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


def test_sizes_that_are_excluded_are_grouped_by_kind_the_largest_at_the_tip_first() -> None:
    sizes = {
        "backlash:1": (0.02, "deg", 0.05),
        "backlash:2": (0.003, "deg", 0.02),
        "backlash:4": (0.04, "deg", 0.04),
        "base_drift": (0.2, "mm/session", 0.06),
        "gear_ratio:1": (None, "1", None),
        "gear_ratio:2": (1e-4, "1", 0.01),
        "transmission_ripple:1[any k]": (0.11, "mm", 0.11),
        "transmission_ripple:1": (0.01, "deg", 0.03),
    }
    keys = ("value", "unit", "tip_mm")
    excluded = {name: dict(zip(keys, size, strict=True)) for name, size in sizes.items()}
    assert largest_excluded_sheet({"excluded": excluded}).rows == [
        ["gear_ratio", "1, 2", "0.0001 to invisible", "any"],
        ["transmission_ripple[any k]", "1", "0.11 mm", "0.110"],
        ["base_drift", "–", "0.2 mm/session", "0.060"],
        ["backlash", "1, 2, 4", "0.003 to 0.04 deg", "0.050"],
        ["transmission_ripple", "1", "0.01 deg", "0.030"],
    ]


def test_shapes_of_curves_and_orders_of_waves_are_tables() -> None:
    waves = [{"order": order, "share": share} for order, share in ((11.0, 0.5), (14.0, 0.25), (2.0, 0.125))]
    curve = {"joint": 2, "angle_deg": [-10.0, 0.0, 10.0], "error_deg": [0.03] * 3, "std_deg": [0.01] * 3}
    said = "waves: 11 per turn, 0.02 deg; 14 per turn, 0.01 deg; 2 per turn, 0.01 deg (88 %) over -10 to 10 deg"
    curves = [curve | {"shape": said, "waves": waves}, curve | {"shape": "smooth curve over 1 to 2 deg", "waves": []}]
    assert [row[-1] for row in curve_shape_sheet({"curves": curves}).rows] == ["waves 11, 14, 2 (88 %)", "smooth curve"]
    shapes = [{"effect": f"{RIPPLE}[k=6]", "joint": 2, "range_deg": [-10.0, 50.0], "orders": [1, 12]}]
    assert order_sheet({"shapes": shapes}).rows == [[f"{RIPPLE}[k=6]", "60", "1 to 12"]]


def test_values_that_rows_speak_against_are_closed_and_said_to_be_so() -> None:
    doubtful = doubted(Section("Corrected values", "Zeros: add.", [Sheet(["", "corrected"], [["zero", "1"]])]))
    assert (doubtful.title, doubtful.folded) == ("Corrected values, not confirmed", True)
    assert doubtful.sheets[0].rows == [["zero", "1"]]
