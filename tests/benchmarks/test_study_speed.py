"""Speed of Monte Carlo studies. Times are of whole studies: simulation, fits, tables.

Ratios against one general least-squares fit at a time, in the same run, so that the machine cancels out; the seconds of
the table are for people.
"""

from __future__ import annotations

import resource
import time

import numpy as np
import pytest
from scipy.optimize import least_squares

from doe.jobs import SERIAL, processes
from doe.plan.plan import Plan
from doe.studies.monte_carlo import Study, run_study
from doe.studies.paper import LENGTHS, paper_arm, paper_truth

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
    effects = [
        {"name": "encoder_eccentricity", "joint": 2, "a_deg": 0.03, "b_deg": -0.012},
        {"name": "base_offset", "x0_mm": 0.3, "y0_mm": -0.2},
    ]
    plan = Plan(np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 4)))
    fitted = [{key: e[key] for key in ("name", "joint") if key in e} for e in effects]
    models = {"truths": [truth | {"effects": effects}], "models": [{"name": "both", "effects": fitted}]}

    def table_3(count: int) -> Study:
        return Study.of([arm], ["dft"], runs=[20], truths=[truth], replications=count)

    two = Study.of([arm], {"plan": plan}, replications=100_000, **models)
    at_random = Study.of([arm], ["random"], runs=[20], replications=100_000, **models)
    run_study(table_3(10))  # imports
    baseline = seconds_per_general_fit()
    print(f"\none general fit at a time: {1 / baseline:,.0f} fits/s")
    for name, study, workers, bar, ratio in (
        ("Table III, 4 links, 20 points, 10,000", table_3(10_000), SERIAL, 0.5, 20.0),
        ("closed form, 1,000,000", table_3(1_000_000), SERIAL, 5.0, 60.0),
        ("two effects, 100,000, two cores", two, processes(2), 20.0, 2.0),
        # new plans cost a Jacobian of their own, twice: for the fit and for the deviation that eq. 16 expects
        ("the same on 100,000 random plans", at_random, processes(2), 20.0, 0.5),
    ):
        began = time.perf_counter()
        result = run_study(study, None, workers)
        seconds = time.perf_counter() - began
        gain = study.asked.replications * baseline / seconds
        print(f"{name:40s} {seconds:7.2f} s (bar {bar:g} s), {gain:6.0f} x one at a time (bar {ratio:g} x)")
        assert result.cells["fits"][0] == study.asked.replications
        assert gain >= ratio
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"peak memory {peak:.0f} MB (bar 2,000 MB)")
    assert peak < 2_000.0
