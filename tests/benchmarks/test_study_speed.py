"""Speed of Monte Carlo studies. Times are of whole studies: simulation, fits, tables.

Ratios against one general least-squares fit at a time, in the same run, so that the machine cancels out; the seconds of
the table are for people.
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from doe.jobs.running import processes, serial
from doe.plan.plan import Plan
from doe.studies.monte_carlo import Fitted, Study, run_study
from doe.studies.paper.study import LENGTHS
from doe.studies.paper.tables import paper_arm, paper_truth
from identification.arm import EffectSpec

pytestmark = pytest.mark.benchmark
LOOP = 100  # fits of the baseline


def seconds_per_general_fit() -> float:
    """scipy's least_squares on eq. 1 with the exact Jacobian of orientations and lengths, one data set at a time."""
    generator = np.random.default_rng(0)
    turn = np.exp(2j * np.pi * np.outer(np.arange(20), np.arange(1, 5)) / 20)
    measured = turn @ np.array(LENGTHS) + 0.1 * generator.standard_normal((LOOP, 20))

    def residuals(x: np.ndarray, data: np.ndarray) -> np.ndarray:
        return (turn @ (x[4:] * np.exp(1j * x[:4])) - data).view(float)

    def jacobian(x: np.ndarray, data: np.ndarray) -> np.ndarray:
        by_length = turn * np.exp(1j * x[:4])
        columns = np.hstack([1j * by_length * x[4:], by_length])
        return np.ascontiguousarray(columns.T).view(float).T

    start = np.r_[np.zeros(4), LENGTHS]
    began = time.perf_counter()
    for data in measured.astype(complex):
        least_squares(residuals, start, jacobian, args=(data,), method="lm", x_scale="jac")
    return (time.perf_counter() - began) / LOOP


def test_studies_are_fast() -> None:
    arm, truth = paper_arm(), paper_truth()
    table_3 = Study([arm], ["dft"], [20], truths=[truth], replications=10_000)
    effects = (
        EffectSpec("encoder_eccentricity", 2, {"a": 5e-4, "b": -2e-4}),
        EffectSpec("base_offset", None, {"x0": 0.3, "y0": -0.2}),
    )
    plan = Plan(np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 4)))
    fitted = Fitted("both", tuple(EffectSpec(e.name, e.joint) for e in effects))
    two = Study(
        [arm], [("plan", plan)], truths=[replace(truth, effects=effects)], models=[fitted], replications=100_000
    )
    run_study(replace(table_3, replications=10))  # imports
    baseline = seconds_per_general_fit()
    print(f"\none general fit at a time: {1 / baseline:,.0f} fits/s")
    for name, study, workers, bar, ratio in (
        ("Table III, 4 links, 20 points, 10,000", table_3, serial(), 0.5, 20.0),
        ("closed form, 1,000,000", replace(table_3, replications=1_000_000), serial(), 5.0, 60.0),
        ("two effects, 100,000, two cores", two, processes(2), 20.0, 2.0),
        # new plans cost a Jacobian of their own, twice: for the fit and for the deviation that eq. 16 expects
        ("the same on 100,000 random plans", replace(two, plans=["random"], runs=[20]), processes(2), 20.0, 0.5),
    ):
        began = time.perf_counter()
        result = run_study(study, None, workers)
        seconds = time.perf_counter() - began
        gain = study.replications * baseline / seconds
        print(f"{name:40s} {seconds:7.2f} s (bar {bar:g} s), {gain:6.0f} x one at a time (bar {ratio:g} x)")
        assert result.cells["fits"][0] == study.replications
        assert gain >= ratio
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"peak memory {peak:.0f} MB (bar 2,000 MB)")
    assert peak < 2_000.0
