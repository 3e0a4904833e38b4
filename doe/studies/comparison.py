"""Solvers side by side: every solver on every problem, repeated, each run in a separate process.

A row is one run of one solver: its cost, and the quality of its plan by our own evaluation of the stored problem.
`status` says whether the run ended normally; `correct` says whether the plan is what the solver claims.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from doe.criteria import criterion
from doe.jobs.rows import Key, Row, RowTable, short_hash, with_columns
from doe.jobs.running import Workers, call, run_tasks
from doe.problem.problem import DesignProblem
from doe.solvers import Solver, available_solvers, solve
from identification import Arm, InputError, Model, Progress, arm_from_tables, dump_arm, nearest, refuse_contacts, silent

if TYPE_CHECKING:
    from doe.design import Design

Subject = str | DesignProblem  # text of an arm file, or the problem of another model
Task = tuple[Subject, "str | Solver"]
AGREES = 1e-9  # between the solver's value and ours
HIT = 1e-6  # a run has found the best known plan if its loss of efficiency is below this
KILL_FACTOR, KILL_EXTRA = 1.5, 10.0  # a run is killed after 1.5 times its time limit and 10 s more
PROBLEM = ("arm", "arm_hash", "criterion", "runs")
CRITERIA = ("D", "A", "E", "Dstar")  # those that need nothing but the arm
SETTING = ("solver", "starts")
OWN = 0  # in the column `starts`: the solver's own number
COLUMNS: dict[str, Any] = {"parameters": pl.Int64, "correct": pl.Boolean}
COLUMNS |= dict.fromkeys(("value", "bound", "efficiency", "seconds", "peak_memory_mb"), pl.Float64)


@dataclass(frozen=True)
class Comparison:
    """What is compared: problems x solvers x settings x repeats.

    arms : the arms;  runs : numbers of measurements m
    solvers : names as in `armcal design --solver`, or settings objects (see `doe.solvers.solver.Solver`) whose classes
        can be imported where the runs happen; names must be unique
    starts : numbers of starts of one run, None: the solver's default
    repeats : runs of each combination, each with a different seed
    seconds : time limit of one run [s]: given to the solver, and enforced by killing the run
    criteria : names as in `armcal design --criterion`, of those in `CRITERIA`
    problems : name -> problem of another model, compared under each criterion like the arms
    """

    arms: Sequence[Arm]
    runs: Sequence[int]
    solvers: Sequence[str | Solver]
    starts: Sequence[int | None] = (None,)
    repeats: int = 5
    seconds: float = 60.0
    criteria: Sequence[str] = ("D",)
    problems: Mapping[str, DesignProblem] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for arm in self.arms:
            refuse_contacts(arm.chain)
        for solver in self.solvers:
            if isinstance(solver, str) and solver not in available_solvers():
                raise InputError(f"solvers: unknown name {solver!r}, {nearest(solver, available_solvers())}")
        for name in self.criteria:
            if name not in CRITERIA:
                raise InputError(f"criterion: {name!r} in a comparison, {nearest(name, CRITERIA)}")
        if not 0.0 < self.seconds < np.inf:  # it is part of every key, in JSON
            raise InputError(f"seconds: found {self.seconds}, allowed: a finite number > 0")
        if len(self.by_name) < len(self.solvers):
            names = ", ".join(s if isinstance(s, str) else s.name for s in self.solvers)
            raise InputError(f"solvers: {names}, allowed: each name once")

    @property
    def by_name(self) -> dict[str, str | Solver]:
        """Name -> name or settings object."""
        return {solver if isinstance(solver, str) else solver.name: solver for solver in self.solvers}

    @property
    def subjects(self) -> dict[str, tuple[str, Subject]]:
        """Hash -> name, and the arm file's text or the problem."""
        texts = [(arm.name, dump_arm(arm)) for arm in self.arms]
        arms: dict[str, tuple[str, Subject]] = {short_hash(text): (name, text) for name, text in texts}
        return arms | {fingerprint(problem): (name, problem) for name, problem in self.problems.items()}

    @property
    def keys(self) -> list[Key]:
        """One key per run of a solver."""
        names = ("arm", "arm_hash", "criterion", "runs", "solver", "settings", "starts", "limit_s", "repeat")
        subjects = [(name, digest) for digest, (name, _) in self.subjects.items()]
        solvers = [(name, s if isinstance(s, str) else repr(s)) for name, s in self.by_name.items()]
        grid = product(subjects, self.criteria, self.runs, solvers, self.starts, range(self.repeats))
        return [
            dict(zip(names, (*subject, by, runs, *solver, starts or OWN, self.seconds, repeat), strict=True))
            for subject, by, runs, solver, starts, repeat in grid
        ]


def fingerprint(problem: DesignProblem) -> str:
    """The hash of a problem: names of its parameters, and the information of a few postures to six decimals."""
    postures = np.linspace(problem.lower, problem.upper, 7)
    content = [",".join(problem.model.parameters.names).encode(), postures.tobytes()]
    return short_hash(b"".join([*content, np.round(problem.information(postures), 6).tobytes()]))


def compare(
    comparison: Comparison,
    table: RowTable | None = None,
    workers: Workers | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> pl.DataFrame:
    """One row per run: the key's columns, `status`, `outcome` (the solver's own), `value`, `claimed` (the solver's),
    `bound`, `efficiency`, `correct`, `violation`, `seconds`, `peak_memory_mb`, `error`.

    Runs that fail, crash or hang are rows too. Rows depend on the seed, not on the workers; only times do: for
    comparable times use one process fewer than there are cores.
    """
    subjects, solvers = comparison.subjects, comparison.by_name
    rows = RowTable(Path()) if table is None else table

    def payload(key: Key) -> Task:
        return subjects[key["arm_hash"]][1], solvers[key["solver"]]

    return run_tasks(run_of, comparison.keys, rows, workers, seed=seed, payload=payload, progress=progress)


def run_of(key: dict[str, Any], seed: np.random.SeedSequence, task: Task) -> list[Row]:
    """The row of one run, in a new process."""
    number = int(seed.generate_state(1)[0])
    limit = key["limit_s"] * KILL_FACTOR + KILL_EXTRA
    outcome = call(solve_and_evaluate, task, key, number, seconds=limit)
    measured = {"status": outcome.status, "error": outcome.error, "peak_memory_mb": outcome.peak_memory_mb}
    return [{**measured, "seconds": outcome.seconds, **(outcome.value or {})}]


def solve_and_evaluate(task: Task, key: dict[str, Any], seed: int) -> Row:
    """Runs the solver in this process; `seconds` is the search alone."""
    subject, solver = task
    arm = arm_from_tables(tomllib.loads(subject)) if isinstance(subject, str) else subject
    problem = compared_problem(arm, key["criterion"])
    design = solve(problem, key["runs"], solver, seed=seed, starts=key["starts"] or None, seconds=key["limit_s"])
    return evaluated(problem, key["runs"], design)


def compared_problem(subject: Arm | DesignProblem, name: str) -> DesignProblem:
    """What is compared: an arm or another problem, and a criterion of `CRITERIA`."""
    problem = subject if isinstance(subject, DesignProblem) else DesignProblem.of(Model(subject))
    return replace(problem, criterion=criterion(name, units=problem.model.parameters.units))


def evaluated(problem: DesignProblem, runs: int, design: Design) -> Row:
    """A design evaluated on the stored problem, independently of the solver's claims.

    `violation` : how far the worst posture is outside limits and constraints, 0 if all are inside
    """
    postures, bound = design.plan.postures, design.bound
    value = problem.objective(postures)
    outside = [np.max(problem.lower - postures), np.max(postures - problem.upper)]
    outside += [-np.min(constraint.margin(postures)) for constraint in problem.constraints]
    violation = float(max(0.0, *outside))
    # [rad] outside the joint limits, or below zero in a constraint's margin
    correct = len(postures) == runs and design.plan.weights is None and violation <= 1e-9
    correct &= bool(np.isclose(value, design.value, rtol=0.0, atol=AGREES))
    return {
        "outcome": design.status.name,
        "starts_done": design.starts,
        "value": value if np.isfinite(value) else None,
        "claimed": design.value if np.isfinite(design.value) else None,
        "bound": None if bound is None else bound.value,
        "bound_source": None if bound is None else bound.source,
        "efficiency": None if bound is None else problem.criterion.efficiency(value, bound.value, problem.parameters),
        "parameters": problem.parameters,
        "violation": violation,
        "correct": correct and (bound is None or bool(value <= bound.value + AGREES)),
        "seconds": design.seconds,
    }


def summary(rows: pl.DataFrame) -> pl.DataFrame:
    """One row per problem and setting, best value first.

    `hit_rate` : fraction of all runs (failed ones too) that found the best value known of the problem
    `seconds_to_hit` : expected time until a hit when runs are repeated, total seconds / hits [s]; null without a hit
    """
    good, value = pl.col("good"), pl.when(pl.col("good")).then(pl.col("value"))
    hits, first = pl.col("hit").sum(), [False] * len(PROBLEM)
    return (
        with_hits(rows)
        .group_by(*PROBLEM, *SETTING, maintain_order=True)
        .agg(
            pl.len().alias("repeats"),
            (~good).sum().alias("not_correct"),
            value.max().alias("best"),
            value.median().alias("median"),
            pl.when(good).then(pl.col("efficiency")).max().alias("efficiency"),
            pl.col("hit").mean().alias("hit_rate"),
            pl.col("seconds").mean().alias("seconds"),
            pl.when(hits > 0).then(pl.col("seconds").sum() / hits).alias("seconds_to_hit"),
            pl.col("peak_memory_mb").max(),
        )
        .sort(*PROBLEM, pl.col("best").round(8), "seconds", descending=[*first, True, False], nulls_last=True)
    )


def with_hits(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows with `good` (done and correct), `loss` of efficiency against the best value known of the problem, and
    `hit`. Columns that no row has are added, empty.

    For every criterion the ratio of two efficiencies against one bound is the efficiency against the best plan; D
    needs no bound for it.
    """
    rows = with_columns(rows, COLUMNS)
    if "criterion" not in rows.columns:
        rows = rows.with_columns(pl.lit("D").alias("criterion"))
    good = (pl.col("status") == "done") & pl.col("correct").fill_null(value=False) & pl.col("value").is_not_null()
    best = pl.when(good).then(pl.col("value")).max().over(PROBLEM)
    relative = pl.col("efficiency") / pl.when(good).then(pl.col("efficiency")).max().over(PROBLEM)
    d_efficiency = ((pl.col("value") - best) / pl.col("parameters")).exp()
    loss = pl.when(good).then(1.0 - pl.when(pl.col("criterion") == "D").then(d_efficiency).otherwise(relative))
    return rows.with_columns(good.alias("good"), loss.alias("loss"), (loss <= HIT).fill_null(value=False).alias("hit"))
