"""Solvers side by side: every solver on every problem, repeated, each run in a separate process.

A row is one run of one solver: its cost, and the quality of its plan by our own evaluation of the stored problem.
`status` says whether the run ended normally; `correct` says whether the plan is what was asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from doe.jobs import Columns, Key, Row, call, run_tasks, sheet, short_hash
from doe.plan.accuracy import criterion_of
from doe.problem.problem import DesignProblem
from doe.solvers import Solver, available_solvers, solve
from doe.solvers.solving import check_runs
from identification import Arm, InputError, require

if TYPE_CHECKING:
    from doe.design import Design

PROBLEM = ("arm", "arm_hash", "criterion", "runs")
CRITERIA = ("D", "A", "E", "Dstar")  # those that need nothing but the arm
SETTING = ("solver", "starts")
COLUMNS: Any = {"parameters": pl.Int64, "correct": pl.Boolean, "bound_cut": pl.Boolean}
COLUMNS |= dict.fromkeys(("value", "bound", "efficiency", "seconds"), pl.Float64)
COMPARED: Columns = {
    "solver": ("label", ""),
    **{name: (name, "z.6g") for name in ("best", "median")},
    "effi-\nciency": ("efficiency", ".5f"),
    "hits": ("hits", ""),
    "time\n[s]": ("seconds", ".2g"),
    "to hit\n[s]": ("seconds_to_hit", ".2g"),
    "failed": ("not_correct", ""),
}


def compare(
    arms: Sequence[Arm],
    runs: Sequence[int],
    solvers: Sequence[str | Solver],
    *,
    starts: Sequence[int | None] = (None,),
    repeats: int = 5,
    seconds: float = 60.0,
    criteria: Sequence[str] = ("D",),
    **how: Any,
) -> pl.DataFrame:
    """Problems x solvers x settings x repeats, one row per run: the key's columns, `status`, `outcome` (the solver's
    own), `value`, `bound`, `bound_cut` (time ended the search for it), `efficiency`, `correct`, `seconds`, `error`.

    runs : numbers of measurements m
    solvers : names as in `armcal design --solver`, or settings objects (see `doe.solvers.solver.Solver`) whose classes
        can be imported where the runs happen; names must be unique
    starts : of one run, None: the solver's default;  repeats : runs of each combination, each with a different seed
    seconds : time limit of one run [s]: given to the solver, and enforced by killing the run
    criteria : names as in `armcal design --criterion`, of those in `CRITERIA`
    how : `path`, `workers`, `seed`, `resume`, `force` and `progress` of `run_tasks`

    Runs that fail, crash or hang are rows too. Rows depend on the seed, not on the workers; only times do: for
    comparable times use one process fewer than there are cores. Raises `InputError`, also for too few runs.
    """
    for arm in arms:
        arm.chain.refuse_contacts()
    named = [solver for solver in solvers if isinstance(solver, str)]
    InputError.check_names("solvers: unknown name", named, available_solvers())
    InputError.check_names("criterion: compare does not offer", criteria, CRITERIA)
    if not 0.0 < seconds < np.inf:  # it is part of every key, in JSON
        raise InputError(f"seconds: found {seconds}, allowed: a finite number > 0")
    by_name = {solver if isinstance(solver, str) else solver.name: solver for solver in solvers}
    require(len(by_name) == len(solvers), f"solvers: {', '.join(by_name)}, allowed: each name once")
    for arm, m in product(arms, runs):
        check_runs(compared_problem(arm, criteria[0]), m)
    by_hash = {short_hash(arm): arm for arm in arms}
    grid = product(
        ({"arm": arm.name, "arm_hash": digest} for digest, arm in by_hash.items()),
        criteria,
        runs,
        ({"solver": name, "settings": s if isinstance(s, str) else repr(s)} for name, s in by_name.items()),
        starts,
        range(repeats),
    )
    keys: list[Key] = [
        {**of_arm, "criterion": name, "runs": m, **setting, "starts": number or 0}  # 0: the solver's own number
        | {"limit_s": seconds, "repeat": repeat}
        for of_arm, name, m, setting, number, repeat in grid
    ]

    return run_tasks(run_of, keys, payload=lambda key: (by_hash[key["arm_hash"]], by_name[key["solver"]]), **how)


def run_of(key: dict[str, Any], seed: np.random.SeedSequence, task: tuple[Arm, str | Solver]) -> list[Row]:
    """The row of one run, in a new process, killed some time after its limit; `seconds` is the search alone."""
    (arm, solver), number = task, int(seed.generate_state(1)[0])
    runs, limit, starts = key["runs"], key["limit_s"], key["starts"] or None

    def evaluated_plan() -> Row:
        problem = compared_problem(arm, key["criterion"])
        return evaluated(runs, solve(problem, runs, solver, seed=number, starts=starts, seconds=limit))

    return [call(evaluated_plan, seconds=1.5 * limit + 10.0)]


def compared_problem(arm: Arm, name: str) -> DesignProblem:
    """Of an arm, with a criterion of `CRITERIA`."""
    problem = DesignProblem.of(arm)
    return replace(problem, criterion=criterion_of(problem, name))


def evaluated(runs: int, design: Design) -> Row:
    """A design by its stored problem, whatever the solver claims: it is correct if all runs are there, inside limits
    and constraints, and not above the bound."""
    bound, value, rounding = design.bound, design.value, 1e-9
    complete = len(design.plan) == runs and design.plan.weights is None
    return {
        "outcome": design.status.name,
        "starts_done": design.starts,
        "value": value if np.isfinite(value) else None,
        "bound": None if bound is None else bound.value,
        "bound_cut": bound is not None and bound.cut,
        "efficiency": design.efficiency,
        "parameters": design.problem.parameters,
        "correct": complete and not design.missed and (bound is None or value <= bound.value + rounding),
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
        )
        .sort(*PROBLEM, pl.col("best").round(8), "seconds", descending=[*first, True, False], nulls_last=True)
    )


def with_hits(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows with `good` (done and correct) and `hit`: the best plan known of the problem was found, to 1e-6 of
    efficiency, for which no bound is needed. Columns that no row has are added, empty."""
    rows = pl.concat([rows, pl.DataFrame(schema=COLUMNS)], how="diagonal_relaxed").cast(COLUMNS)
    good = (pl.col("status") == "done") & pl.col("correct").fill_null(value=False) & pl.col("value").is_not_null()
    best = pl.when(good).then(pl.col("value")).max().over(PROBLEM)
    # D and Dstar, whose groups are all parameters, are logarithms
    size = pl.when(pl.col("criterion").is_in(["A", "E"])).then(best.abs()).otherwise(pl.col("parameters"))
    hit = good & (pl.col("value") >= best - 1e-6 * size).fill_null(value=False)
    return rows.with_columns(good.alias("good"), hit.alias("hit"))


# -- as a document -----------------------------------------------------------------------------------------------------
def comparison_parts(rows: pl.DataFrame) -> list[Any]:
    """One table per problem, the best setting first, and what went wrong, equal sentences once."""
    starts = pl.when(pl.col("starts") > 0).then(pl.format(", starts: {}", "starts")).otherwise(pl.lit(""))
    label = pl.concat_str("solver", starts)  # without its number of starts where it is the solver's own
    hits = pl.format("{}/{}", (pl.col("hit_rate") * pl.col("repeats")).round().cast(int), "repeats")
    parts: list[Any] = []
    for part in summary(rows).with_columns(label=label, hits=hits).partition_by(*PROBLEM, maintain_order=True):
        arm, digest, criterion, m = part.select(PROBLEM).row(0)
        bounded = with_hits(rows).filter(arm_hash=digest, criterion=criterion, runs=m).drop_nulls("bound")
        title = f"{arm}, {criterion}, {m} runs"
        for bound, cut in bounded.select("bound", "bound_cut").sort("bound", "bound_cut").head(1).iter_rows():
            title += f", bound {bound:z.7f}" + ", its search cut by the time limit" * bool(cut)
        parts.append(sheet(part.iter_rows(named=True), COMPARED, title))
    failed = rows.filter(pl.col("status") != "done").with_columns(label=label)
    kinds = failed.group_by("arm", "criterion", "runs", *SETTING, "label", "status", "error", maintain_order=True).len()
    sentence = pl.format(
        "{}, {}, {} runs, {}: {} x {}: {}", "arm", "criterion", "runs", "label", "len", "status", "error"
    )
    lines = kinds.select(sentence).to_series().to_list()
    return [*parts, *lines[:10], *([f"and {len(lines) - 10} more; the rows have them all"] if len(lines) > 10 else [])]
