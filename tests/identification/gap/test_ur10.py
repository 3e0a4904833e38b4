"""Real data: the planar cut of a UR10, read from ../shared, skipped where that is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.gap.diagnose import diagnose
from identification.measurements import Measurements

FILE = Path(__file__).parents[4] / "shared" / "data" / "ur10_planar" / "measurements.csv"
pytestmark = pytest.mark.skipif(not FILE.exists(), reason="no ../shared/data")

ARM = Arm([612.0, 572.3, 115.7], effects=(EffectSpec("base_offset"),), name="ur10")


def load() -> Measurements:
    table = np.genfromtxt(FILE, delimiter=",", names=True)
    q = np.radians(np.column_stack([table[f"q{j}_deg"] for j in (1, 2, 3)]))
    xy = np.column_stack([table["x_mm"], table["y_mm"]])
    return Measurements(q, xy, table["order"], temperature=table["temperature_C"])


def test_every_fifth_row_is_explained_better_and_it_replicates_on_the_others() -> None:
    data = load()
    fifth = np.arange(len(data)) % 5 == 0
    found = diagnose(ARM, data.rows(fifth), data.rows(np.random.default_rng(1).permutation(np.flatnonzero(~fifth))))
    assert found.effects  # an effect is named, ripple above all
    assert any(name.startswith("transmission_ripple") for name in found.effects)
    # independent fit of GAP.md: 0.413 mm with lengths, offsets and base offset
    assert found.gap.held_out_before == pytest.approx(0.413, abs=0.02)
    assert found.gap.held_out_after < found.gap.held_out_before - 0.03


@pytest.mark.slow
def test_halves_agree() -> None:
    data = load()
    even = np.arange(len(data)) % 2 == 0
    first, second = (diagnose(ARM, data.rows(rows)) for rows in (even, ~even))
    assert set(first.effects) & set(second.effects)
