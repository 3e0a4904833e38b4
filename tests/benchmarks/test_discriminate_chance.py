"""Real data: how often do postures chosen by `discriminate` settle an ambiguous diagnosis, and what was said?

Random choices of 40 rows of the sample of series C; where the diagnosis of one is ambiguous, 4 further rows are chosen
among all others by `discriminate`, or at random, and the diagnosis is made again. Settled: one of the candidates is
named and the others are gone. Run it with -s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from doe.discrimination.t_optimal import discriminate
from identification.arm import Arm
from identification.gap.diagnose import diagnose
from identification.gap.result import Diagnosis
from identification.measurements import Measurements, load_measurements

DATA = Path(__file__).parents[1] / "data/ur10_planar/measurements.csv"
ARM = Arm(np.array([612.0, 572.3, 115.7]))
ROWS, MORE, CHOICES = 40, 4, 200


def again(data: Measurements, taken: NDArray[np.int64], before: Diagnosis) -> bool:
    """Whether one of the candidates is named with these rows, and the others are gone."""
    mask = np.zeros(len(data), dtype=bool)
    mask[taken] = True
    after = diagnose(ARM, data.rows(mask))
    return after.verdict == "named" and sorted(after.named.keys) in [sorted(c.keys) for c in before.candidates]


@pytest.mark.benchmark
def test_how_often_chosen_postures_settle_it() -> None:
    data = load_measurements(DATA, ARM.links)
    said, chosen, random = [], [], []
    for seed in range(CHOICES):
        order = np.random.default_rng(seed).permutation(len(data))
        first, rest = np.sort(order[:ROWS]), order[ROWS:]
        mask = np.zeros(len(data), dtype=bool)
        mask[first] = True
        found = diagnose(ARM, data.rows(mask))
        if found.verdict != "ambiguous":
            continue
        plan = discriminate(ARM, found, data.rows(mask), MORE, pool=data.postures[rest])
        rows = [int(rest[np.argmin(np.abs(data.postures[rest] - q).sum(axis=1))]) for q in plan.plan.postures]
        said.append(plan.chance)
        chosen.append(again(data, np.r_[first, rows], found))
        random.append(again(data, np.r_[first, rest[:MORE]], found))
        print(f"seed {seed}: said {plan.chance:.2f}, settled {chosen[-1]}, by random rows {random[-1]}", flush=True)
    shares = f"said {np.mean(said):.2f}, settled {np.mean(chosen):.2f}, by random rows {np.mean(random):.2f}"
    print(f"{len(said)} of {CHOICES} choices ambiguous: {shares}")
    assert 0.0 <= np.mean(said) <= 1.0
