"""The blind study in reduced form: alert and fail thresholds around GAP.md's bars.

A cell of COUNT data sets has a standard error of sqrt(p (1 - p) / COUNT); the fail threshold lies about four of them
beyond what the full study measured, so that chance alone fails less than once in ten thousand runs; the seeds are
fixed anyway.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from identification.gap.blind_study import BlindStudy, Cell, Outcome, blind_study
from tests.identification.gap.blind import case

COUNT = 20


def run(cell: str, count: int = COUNT) -> Cell:
    return blind_study(case, [cell], count, draws=199).cells[0]


def check(what: str, value: float, alert: float, fail: float) -> None:
    """Fail below `fail`, warn below `alert` (a warning is not an error here: it is for people)."""
    assert value >= fail, f"{what}: {value:.3f}, at least {fail} asked"
    if value < alert:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn(f"{what}: {value:.3f} is below {alert}", stacklevel=2)


@pytest.mark.parametrize("cell", ["none m=50", "none, joint noise", "none, reach noise"])
def test_false_alarms_are_rare(cell: str) -> None:
    quiet = 1.0 - run(cell).share("alarm")[0]
    check(cell, quiet, alert=0.84, fail=0.70)


def test_single_effects_are_named() -> None:
    found = run("one, lambda 8, no family", 30)
    check("exact", found.share("exact")[0], alert=0.86, fail=0.70)
    check("class", found.share("same_class")[0], alert=0.90, fail=0.80)
    check("in the set", found.share("contained")[0], alert=0.90, fail=0.78)
    assert found.gap_ratio <= 1.05


def test_two_effects_are_named() -> None:
    found = run("two, lambda 8, no family")
    check("exact", found.share("exact")[0], alert=0.75, fail=0.50)
    check("class", found.share("same_class")[0], alert=0.84, fail=0.65)


def test_effects_outside_the_library_are_flagged_and_placed() -> None:
    check("placed", run("outside, lambda 7").share("placed")[0], alert=0.89, fail=0.75)


def test_outliers_do_not_fool_the_naming() -> None:
    found = run("three outliers, lambda 8")
    check("class", found.share("same_class")[0], alert=0.89, fail=0.75)


def test_bookkeeping_by_hand() -> None:
    def made(exact: bool, size: int, named: str) -> Outcome:
        return Outcome(("backlash:1",), (named,), True, exact, exact, exact, size, 1, False, 1.0)

    cell = Cell("x", (made(True, 1, "backlash:1"), made(False, 3, "gear_ratio:1"), made(True, 2, "backlash:1")))
    assert cell.share("exact")[0] == pytest.approx(2 / 3)
    assert cell.share("exact")[1] == pytest.approx(np.sqrt(2 / 9 / 3))
    assert cell.mean("size") == 2.0
    study = BlindStudy((cell,))
    assert study.confusion() == {("backlash", "backlash"): 2, ("backlash", "gear_ratio"): 1}
    assert study.to_json()["cells"][0]["gap_ratio"] == 1.0


def test_the_same_seed_gives_the_same_case() -> None:
    one, other = case("two, lambda 8", 3), case("two, lambda 8", 3)
    np.testing.assert_array_equal(one.measurements.positions, other.measurements.positions)
    assert one.effects == other.effects
