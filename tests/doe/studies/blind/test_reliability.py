"""What counts as right, and the calibration error, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from doe.studies.blind import cells
from doe.studies.blind.score import calibration, intervals_judged, probability_judged, reliability
from identification.model import Model

TRUTH = {"hidden": [], "place": None}


@pytest.mark.parametrize(
    ("hidden", "said", "right"),
    [
        ({}, {"verdict": "none"}, True),
        ({}, {"verdict": "named", "named": ["backlash:1"]}, False),
        ({"hidden": ["b", "a"]}, {"verdict": "ambiguous", "named": ["a", "b"]}, True),
        ({"hidden": ["b", "a"]}, {"verdict": "named", "named": ["a"]}, False),
        ({"hidden": ["a"]}, {"verdict": "none"}, False),
        ({"hidden": ["a"]}, {"verdict": "unknown", "named": ["a"]}, False),
        ({"outside": "bump"}, {"verdict": "unknown", "named": []}, True),
        ({"outside": "bump"}, {"verdict": "named", "named": ["a"]}, False),
    ],
)
def test_what_is_right(hidden: dict, said: dict, right: bool) -> None:
    row = {**TRUTH, **hidden, **said, "probability": 0.8, "credible_set": ["a", "a + b"]}
    judged = probability_judged(row)
    assert (judged["said"], judged["right"]) == (0.8, right)
    if row["hidden"]:
        assert (judged["in the 90 % set"], judged["size of the 90 % set"]) == (True, 2)


def test_calibration_error_by_hand() -> None:
    """Of four sets said with 0.8 three are right, one said with 0.98 is: 4/5 |0.8 - 0.75| + 1/5 |0.98 - 1|."""
    sets = [{"said": 0.8, "right": k > 0} for k in range(4)] + [{"said": 0.98, "right": True}]
    found = {row["measure"]: row for row in calibration(sets)}
    assert found["calibration error"]["value"] == pytest.approx(0.8 * 0.05 + 0.2 * 0.02)
    middle = found["said less right, 0.7 to 0.95"]
    assert (middle["value"], middle["count"]) == (pytest.approx(0.05), 4)
    assert middle["standard_error"] == pytest.approx(np.sqrt(0.75 * 0.25 / 4))
    assert [row["count"] for row in reliability(sets)] == [4, 1]
    assert reliability([{"said": 1.0, "right": True}])[0]["count"] == 1
    assert list(calibration([{"alarm": True}])) == []


def test_intervals_by_hand() -> None:
    row = {
        "parameters": ["length_error:1", "joint_offset:1", "a.b"],
        "values": [1.0, 0.0, 3.0],
        "interval_of": ["length_error:1", "joint_offset:1", "a.b", "other.x"],
        "low_95": [0.5, 0.5, 2.0, 0.0],
        "high_95": [1.5, 1.5, 4.0, 1.0],
    }
    assert intervals_judged(row, exact=True) == {"intervals, base": 0.5, "intervals, effects": 1.0}
    assert intervals_judged(row, exact=False) == {"intervals, base": 0.5}
    assert intervals_judged({}, exact=True) == {}


def test_true_values_have_the_names_of_the_librarys_parameters() -> None:
    """Of every effect that the study hides."""
    seen = set()
    for number in range(60):
        data = cells.data_set("one, lambda 20, m=50", number)
        model = Model(data.arm.with_effects(*data.specs))
        assert data.values.keys() == set(model.names)
        seen.add(data.effects[0].partition(":")[0])
        position = model.position(
            data.measurements.postures, model.parameters.vector(data.values), data.measurements.conditions
        )
        assert np.std(data.measurements.positions - position) < 1.3 * data.arm.sigma
    assert len(seen) >= 12
