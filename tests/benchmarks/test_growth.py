"""How costs grow with sizes: `pytest -m benchmark -s tests/benchmarks/test_growth.py`.

Each size runs in a process of its own on one thread: processor time of the second of two runs, the first compiles and
imports; peak memory with the interpreter and all imports. An exponent is the slope of log time over log size, fitted
to the last three sizes. Asserted are exponents and values, never times, and never more than half a power above what
the algebra says: that much a busy machine's caches make.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from doe.bounds.column_generation import column_generation, relax
from doe.jobs import call
from doe.problem.postures import PostureList
from doe.solvers import solve
from identification.arm import Arm
from identification.estimation import estimate, estimate_batch
from identification.gap.diagnose import diagnose
from identification.kinematics.chain import DHRow, chain_of
from identification.measurements import Measurements
from identification.model import Model
from tests.doe.arms import ECCENTRICITY, FOUR, problem
from tests.doe.six_axis import SIX_AXIS, six_axis

pytestmark = pytest.mark.benchmark
LIMIT = 900.0  # [s]
LAST = 3  # sizes of the fit


def planar(links: int) -> Arm:
    return Arm(np.linspace(260.0, 100.0, links), np.full(links, -1.5), np.full(links, 1.5), 0.1)


def spatial(joints: int) -> Arm:
    rows = [DHRow(200.0 * (k % 2), np.pi / 2.0 * (-1.0) ** k, 150.0) for k in range(joints)]
    return Arm(chain_of(rows), sigma=0.05)


def measured(arm: Arm, rows: int) -> tuple[Model, Measurements]:
    """Random postures of an arm as it is drawn, and noise."""
    model, generator = Model(arm), np.random.default_rng(0)
    postures = generator.uniform(arm.lower, arm.upper, (rows, arm.links))
    positions = model.position(postures)
    return model, Measurements(postures, positions + 0.1 * generator.standard_normal(positions.shape))


# -- what is timed: a size -> a value that shows whether the answer is right ---------------------------------------
def exact_plan(runs: int) -> float:
    """Efficiency."""
    design = solve(problem(FOUR, ECCENTRICITY), runs, starts=1, seconds=LIMIT)
    return design.efficiency or 0.0


def exact_plan_in_space(runs: int) -> float:
    design = solve(six_axis(), runs, starts=1, seconds=LIMIT)
    return design.efficiency or 0.0


def exact_plan_of_links(links: int) -> float:
    """By the search, though theory knows such plans."""
    design = solve(problem(planar(links)), 30, "exchange", starts=1, seconds=LIMIT)
    return design.efficiency or 0.0


def jacobians_of_joints(joints: int) -> float:
    """Of 2,000 postures: share of finite numbers."""
    arm = spatial(joints)
    postures = np.random.default_rng(0).uniform(-3.0, 3.0, (2000, joints))
    return float(np.mean(np.isfinite(Model(arm).jacobian(postures))))


def grid(levels: int) -> float:
    """1 less the gap, of a planar grid of levels^4 candidates."""
    return 1.0 - relax(problem(FOUR), levels).gap


def list_in_space(candidates: int) -> float:
    arm = six_axis()
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (candidates, 6))
    return 1.0 - column_generation(arm, PostureList(postures), runs=30).gap


def fit_in_space(rows: int) -> float:
    """Scatter of the residuals per noise."""
    return float(estimate(*measured(SIX_AXIS, rows), sigma="estimated").sigma or 0.0) / 0.1


def replications(count: int) -> float:
    """Share of fits that converged."""
    model, data = measured(FOUR.with_effects(ECCENTRICITY), 20)
    noise = 0.1 * np.random.default_rng(1).standard_normal((count, *data.positions.shape))
    return float(np.mean(estimate_batch(model, data, data.positions + noise).converged))


def diagnosis(rows: int) -> float:
    """1 where nothing is named, which is the truth."""
    return float(diagnose(FOUR, measured(FOUR, rows)[1]).verdict == "none")


def seconds_and_value(task: Callable[[int], float], size: int) -> tuple[float, float]:
    """Processor time [s] of the second run, and its value."""
    task(size)
    began = time.process_time()
    value = task(size)
    return time.process_time() - began, value


class Growth(NamedTuple):
    """exponent : largest that is allowed;  least : value;  candidates : what a size counts, None: itself"""

    task: Callable[[int], float]
    sizes: tuple[int, ...]
    exponent: float
    least: float
    count: Callable[[int], int] = int


GROWTHS = (
    Growth(exact_plan, (25, 50, 100, 200, 400), 2.0, 0.98),
    Growth(exact_plan_in_space, (20, 40, 100, 200, 400), 2.0, 0.9),
    Growth(exact_plan_of_links, (2, 4, 6, 8, 12), 3.5, 0.9),
    Growth(jacobians_of_joints, (2, 4, 6, 8, 12), 2.5, 1.0),
    Growth(grid, (6, 10, 18, 32, 56), 1.5, 1.0 - 1e-6, lambda levels: levels**4),
    Growth(list_in_space, (1_000, 10_000, 100_000, 1_000_000), 1.5, 1.0 - 1e-4),
    Growth(fit_in_space, (100, 1_000, 10_000, 100_000), 1.5, 0.9),
    Growth(replications, (100, 1_000, 10_000, 100_000), 1.5, 1.0),
    Growth(diagnosis, (50, 100, 200, 400, 800), 1.5, 1.0),
)


@pytest.mark.parametrize("growth", GROWTHS, ids=lambda growth: growth.task.__name__)
def test_growth(growth: Growth) -> None:
    spent, values = [], []
    print(f"\n{growth.task.__name__.replace('_', ' ')}")
    for size in growth.sizes:
        outcome = call(seconds_and_value, growth.task, size, seconds=LIMIT)
        assert outcome.status == "done", outcome.error
        seconds, value = outcome.value
        spent.append(seconds)
        values.append(value)
        print(f"  {growth.count(size):>10,} {seconds:9.3f} s {outcome.peak_memory_mb or 0.0:6.0f} MB   {value:.7g}")
    counts = np.array([growth.count(size) for size in growth.sizes], dtype=float)
    exponent = float(np.polyfit(np.log(counts[-LAST:]), np.log(spent[-LAST:]), 1)[0])
    print(f"  exponent {exponent:.2f}, at most {growth.exponent:g}")
    assert min(values) >= growth.least
    assert exponent <= growth.exponent
