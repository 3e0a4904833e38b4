"""How fast, each job in a process of its own: `pytest -m benchmark -s tests/benchmarks/test_speed.py [-k NAME]`.

Processor times of one core, the best of some rounds; values and ratios to a rival in the same run are asserted, and
times against bars of an idle machine, longer on a slower one (`YARDSTICK`). `--against=TREE` runs the same jobs in
another checkout, the two in turn, and asserts that none has become slower by more than a tenth.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
YARDSTICK = 0.04  # [s] of a product of two 1,000 x 1,000 matrices on the machine of the bars
SLOWER = 1.1  # than the other checkout
ROUNDS = 3  # of both checkouts in turn
T = TypeVar("T")


class Job(NamedTuple):
    """run : asserts what must hold; returns what is timed [s] and a note;  seconds, megabytes : bars"""

    run: Callable[[], tuple[float, str]]
    seconds: float
    megabytes: float = 2000.0


def timed(call: Callable[[], T], rounds: int = 1) -> tuple[T, float]:
    """What a call gives, and the processor time [s] of its fastest round on one thread."""
    from threadpoolctl import threadpool_limits

    times = []
    with threadpool_limits(1):
        for _ in range(rounds):
            began = time.process_time()
            value = call()
            times.append(time.process_time() - began)
    return value, min(times)


# -- plans -------------------------------------------------------------------------------------------------------------
def best_known(links: int, values: dict[int, float]) -> tuple[float, str]:
    """Plans by default, of m runs as good as the best known: the slowest."""
    from doe import solve
    from tests.doe.arms import FOUR, SIX, problem

    slowest = 0.0
    for runs, value in values.items():
        design, seconds = timed(lambda runs=runs: solve(problem({4: FOUR, 6: SIX}[links]), runs))
        assert design.log_det >= value, f"m = {runs}: {design.log_det:.7f}"
        slowest = max(slowest, seconds)
    return slowest, f"the slowest of {len(values)} numbers of runs, each as good as the best known"


def a_command() -> tuple[float, str]:
    """`armcal design`, imports included."""
    from click.testing import CliRunner

    from doe.cli import main

    runner = CliRunner()
    with runner.isolated_filesystem():
        limits = "[joint_limits_deg]\nlower = [-180, -120, -100, -90]\nupper = [180, 120, 60, 90]\n"
        Path("arm.toml").write_text(f"links_mm = [260, 180, 120, 100]\n{limits}")
        done = runner.invoke(main, ["design", "arm.toml", "--runs", "20", "--json"])
    assert json.loads(done.stdout)["certified_optimal"]
    return time.process_time(), "armcal design, 4 links, m = 20, from the start of Python"


@cache
def six_axes() -> Any:
    """The design problem of a six-axis arm, and the same in view of a tracker."""
    from identification.workspace import LineOfSight, WorkspaceBox
    from tests.doe.six_axis import SIX_AXIS, six_axis

    box = WorkspaceBox((200.0, 1200.0), (-900.0, 900.0), (0.0, 1300.0))
    cone = ((3000.0, 500.0, 800.0), np.radians(30.0), (600.0, 0.0, 600.0), (500.0, 5000.0))
    sight = LineOfSight(*cone, (0.0, 0.0, 1.0), np.radians(50.0))
    return six_axis(), six_axis(replace(SIX_AXIS, constraints=(box, sight)))


def plan_of_six_axes() -> tuple[float, str]:
    from doe import solve

    design, seconds = timed(lambda: solve(six_axes()[0], 30))
    assert design.efficiency > 0.995
    return seconds, f"m = 30: {design.efficiency:.4f} of the bound"


def plan_in_view_of_a_tracker() -> tuple[float, str]:
    """Against the bound for lists of 20,000 allowed random postures."""
    from doe import solve
    from doe.bounds.column_generation import column_generation
    from doe.problem.problem import random_postures

    problem = six_axes()[1]
    design, seconds = timed(lambda: solve(problem, 30))
    postures = np.concatenate([random_postures(problem, 1000, np.random.default_rng(k)) for k in range(20)])
    bound = column_generation(problem, postures, runs=30).bound
    share = problem.criterion.efficiency(design.value, bound.value, problem.parameters)
    assert not design.missed
    assert share > 0.99
    return seconds, f"m = 30, box and line of sight: {share:.4f} of the bound of the list"


# -- weights -----------------------------------------------------------------------------------------------------------
def weights_on_a_million_in_space() -> tuple[float, str]:
    from doe.bounds.column_generation import column_generation

    problem = six_axes()[0]
    postures = np.random.default_rng(0).uniform(problem.lower, problem.upper, (1_000_000, 6))
    design, seconds = timed(lambda: column_generation(problem, postures, runs=30))
    assert design.gap < 1e-4
    return seconds, f"1,000,000 postures in space: gap {design.gap:.1e}"


def weights_over_all_postures_in_space() -> tuple[float, str]:
    from doe.bounds.column_generation import continuous_design

    design, seconds = timed(lambda: continuous_design(six_axes()[0], runs=30, tolerance=1e-3, proof=1e-3))
    return seconds, f"bound {design.bound.value:.4f}, {design.bound.value - design.value:.1e} above the design"


# -- fits: the rival is SciPy with residuals written by hand in plain numpy -----------------------------
LENGTHS = np.array([260.0, 180.0, 120.0, 100.0])
TRUTH = np.r_[1.5, -0.6, -0.4, 0.7, np.radians([0.5, -0.5, 0.7, -0.3])]
SETS, SOME = 10_000, 100  # data sets of 20 rows; of them for the rival


def data_sets(count: int = SETS) -> Any:
    """Model, postures (m, 4) and measured positions (count, m, 2), every data set of the same arm."""
    from identification import Arm, Model

    model, generator = Model(Arm(LENGTHS)), np.random.default_rng(1)
    q = generator.uniform(-2.0, 2.0, (20, 4))
    return model, q, model.position(q, TRUTH) + 0.1 * generator.standard_normal((count, 20, 2))


def residuals(x: np.ndarray, q: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(2m,) of lengths and offsets."""
    theta, lengths = np.cumsum(q + x[4:], axis=1), LENGTHS + x[:4]
    return np.concatenate([np.cos(theta) @ lengths - measured[:, 0], np.sin(theta) @ lengths - measured[:, 1]])


def loop(q: np.ndarray, positions: np.ndarray, method: str = "trf") -> Any:
    """(k, 8) one SciPy fit after the other, and the seconds per fit."""
    from scipy.optimize import least_squares

    def fits() -> list[np.ndarray]:
        return [least_squares(residuals, np.zeros(8), args=(q, data), method=method).x for data in positions]

    each, seconds = timed(fits, 3)
    return np.array(each), seconds / len(positions)


def closed_form_against_scipy() -> tuple[float, str]:
    from identification.estimation import estimate_batch

    model, q, positions = data_sets()
    fits, seconds = timed(lambda: estimate_batch(model, q, positions), 7)
    exact, _ = loop(q, positions[:SOME], "lm")
    _, slow = loop(q, positions[:SOME])
    np.testing.assert_allclose(fits.parameters[:SOME] * model.scales, exact * model.scales, rtol=0, atol=1e-4)
    ratio = slow * SETS / seconds
    assert ratio >= 500.0
    return seconds, f"{SETS / seconds:,.0f} fits/s; SciPy {1 / slow:,.0f}, {ratio:,.0f} times slower (bar 500)"


def batch_in_space() -> tuple[float, str]:
    """200 sets of 30 poses against single fits."""
    from identification import Measurements, Model, estimate
    from identification.estimation import estimate_batch
    from tests.doe.six_axis import SIX_AXIS

    model, generator = Model(SIX_AXIS), np.random.default_rng(0)
    q = generator.uniform(SIX_AXIS.lower, SIX_AXIS.upper, (30, 6))
    positions = model.position(q, 0.3 * generator.standard_normal((200, len(model.names))) / model.scales)
    positions += 0.05 * generator.standard_normal(positions.shape)
    estimate_batch(model, q, positions[:2])  # compiled
    fits, seconds = timed(lambda: estimate_batch(model, q, positions))
    single = timed(lambda: estimate(model, Measurements(q, positions[0]), sigma="given"), 3)[1] * len(positions)
    assert fits.converged.all()
    assert single > 10.0 * seconds
    return (
        seconds,
        f"{len(model.names)} parameters: {200 / seconds:.0f} fits/s; one by one {single / seconds:.0f} x slower",
    )


# -- the rest ----------------------------------------------------------------------------------------------------------
def diagnosis_of_two_hundred_rows() -> tuple[float, str]:
    from doe.studies.blind.cells import CELLS, CellSpec, data_set
    from identification.gap.diagnose import diagnose

    CELLS["speed"] = CellSpec([200], lam=8.0, effects=2, links=(4, 4))
    data = data_set("speed", 1)
    return timed(lambda: diagnose(data.arm, data.measurements), 3)[1], "m = 200, 4 links, the whole library"


def diagnosis_of_a_robot() -> tuple[float, str]:
    from identification import load_measurements
    from identification.gap.diagnose import diagnose
    from tests.identification.gap.test_ur10 import ARM, FILE, SAMPLE

    data = load_measurements(FILE if FILE.exists() else SAMPLE, 3)
    return timed(lambda: diagnose(ARM, data))[1], f"UR10, {len(data):,} rows"


def commands() -> tuple[float, str]:
    """10,000 targets with four constraints and without, half of them where the arm may stand, half anywhere."""
    from doe.problem.constraints import constraints_of
    from identification import Calibration, Model
    from identification.compensate import compensate
    from identification.workspace import KeepOut

    more = KeepOut((700.0, 300.0, 0.0), 120.0, (700.0, 300.0, 900.0)), KeepOut((600, -300, 500), 150.0)
    generator, plain = np.random.default_rng(1), six_axes()[1].model.arm
    names = [name for name in Model(plain).names if not name.startswith(("base", "tool"))]
    sizes = [0.3 if name.startswith("translation") else 1e-3 for name in names]
    errors = dict(zip(names, (sizes * generator.standard_normal(len(names))).tolist(), strict=True))
    arm = replace(plain, constraints=(*plain.constraints, *more), calibration=Calibration({**errors, "base.x": 0.0}))
    constraints, postures = constraints_of(Model(arm)), np.empty((0, 6))
    while len(postures) < 10_000:
        drawn = generator.uniform(arm.lower, arm.upper, (50_000, 6))
        postures = np.concatenate(
            [postures, drawn[np.all([np.all(c.margin(drawn) >= 0.0, axis=1) for c in constraints], axis=0)]]
        )
    postures = postures[:10_000]
    postures[5000:] = generator.uniform(arm.lower, arm.upper, (5000, 6))
    targets = Model(arm).position(postures)[:, :3]
    compensate(arm, targets[:3])  # compiled
    free, quick = timed(lambda: compensate(arm, targets, constraints=()))
    held, seconds = timed(lambda: compensate(arm, targets, constraints=constraints))
    assert free.reached.all()
    assert held.reached[:5000].all()
    assert min(c.margin(held.commands[held.reached]).min() for c in constraints) > -1e-6
    assert seconds < 15.0 * quick
    return seconds, f"10,000 targets, {np.count_nonzero(~held.reached):,} barred; without constraints {quick:.2f} s"


FOUR_LINKS = dict.fromkeys((4, 8, 12, 20), -0.0612353 - 1e-7)
FOUR_LINKS |= {5: -0.28088, 6: -0.29681, 7: -0.19866, 9: -0.13104, 10: -0.14289, 14: -0.10248, 18: -0.08609}
SIX_LINKS = {8: -1.624468, 12: -1.433951, 20: -1.351505, 32: -1.299458}
JOBS = {
    "plans_of_four_links": Job(partial(best_known, 4, FOUR_LINKS), 3.0),
    "plans_of_six_links": Job(partial(best_known, 6, SIX_LINKS), 20.0),
    "a_command": Job(a_command, 2.0, 400.0),
    "plan_of_six_axes": Job(plan_of_six_axes, 5.0),
    "plan_in_view_of_a_tracker": Job(plan_in_view_of_a_tracker, 5.0),
    "weights_on_a_million_in_space": Job(weights_on_a_million_in_space, 15.0),
    "weights_over_all_postures_in_space": Job(weights_over_all_postures_in_space, 20.0),
    "closed_form_against_scipy": Job(closed_form_against_scipy, 0.05),
    "fits_in_space_with_the_prior": Job(batch_in_space, 0.5),
    "diagnosis_of_two_hundred_rows": Job(diagnosis_of_two_hundred_rows, 3.0),
    "diagnosis_of_a_robot": Job(diagnosis_of_a_robot, 60.0),
    "commands": Job(commands, 60.0),
}


# -- the harness -------------------------------------------------------------------------------------------------------
@cache
def scale() -> float:
    """How much slower this machine is than that of the bars, at least 1."""
    a = np.random.default_rng(1).normal(size=(1000, 1000))
    return max(1.0, timed(lambda: a @ a, 5)[1] / YARDSTICK)


def measured(name: str, tree: Path) -> tuple[float, str, float]:
    """Seconds, note and peak memory [MB] of a job with the packages of a checkout."""
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    done = subprocess.run(
        [sys.executable, str(Path(__file__)), name],
        cwd=tree, env=os.environ | threads | {"PYTHONPATH": str(tree)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    seconds, note, megabytes = json.loads(done.stdout.splitlines()[-1])
    return seconds, note, megabytes


@pytest.mark.benchmark
@pytest.mark.parametrize("name", JOBS)
def test_speed(name: str, request: pytest.FixtureRequest) -> None:
    bar, other = JOBS[name], request.config.getoption("--against")
    seconds, note, megabytes = measured(name, ROOT)
    print(f"\n{name}: {seconds:.3g} s (bar {bar.seconds * scale():.3g}), {megabytes:.0f} MB; {note}", end="")
    assert seconds <= bar.seconds * scale()
    assert megabytes <= bar.megabytes
    if other:
        rounds = [(measured(name, Path(other))[0], measured(name, ROOT)[0]) for _ in range(ROUNDS)]
        before, after = np.min(rounds, axis=0)
        print(f"; there {before:.3g} s, here {after:.3g} s: {after / before:.2f}", end="")
        assert after <= SLOWER * before


if __name__ == "__main__":
    seconds, note = JOBS[sys.argv[1]].run()
    status = Path("/proc/self/status").read_text().splitlines()
    peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024.0
    print(json.dumps([seconds, note, peak]))
