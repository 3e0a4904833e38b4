"""Monte Carlo studies: how accurate plans, models and estimators are, by simulation.

A study is a grid of arms x plans x runs x sigma x truths x models; each combination is a cell. Plans come first, then
blocks of replications, both as resumable tables; then cells from blocks. One block: simulate, fit all data sets at
once, and keep a few numbers per parameter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
import polars as pl

from doe.jobs import Columns, Key, Row, canonical, cell_text, parquet, run_tasks, sheet, short_hash
from doe.problem.problem import DesignProblem, random_postures
from doe.solvers import SOLVERS, solve
from identification import Arm, Array, InputError, JobError, Plan, Replications, StudyFile, design_model
from identification.files.io import write_together

CELL = ("arm", "plan", "runs", "sigma_mm", "truth", "model")  # the columns that identify a cell
DFT, RANDOM = "dft", "random"
BLOCK, RANDOM_BLOCK = 10_000, 100  # replications of a task; those that share one random plan
MOST_ROWS = 4_000_000  # of a task: 64 MB of positions
ESTIMATED: Columns = {
    "parameter": ("parameter", ""),
    **{name.replace("_", " "): (name, ".4g") for name in ("mean_error", "std", "expected_std")},
    "95 % intervals hold": ("coverage", ".2%"),
    "unit": ("unit", ""),
}


# -- what is asked for -------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Study:
    """A Monte Carlo study: every combination of arms, plans, and what a study file has besides (`asked`).

    plans : name -> a given plan, whose number of runs is fixed; None: of a solver, "dft" (theta_j = 2 pi i j / m), or
        "random" (a new plan for every hundred replications, uniform over the allowed postures)
    """

    arms: Sequence[Arm]
    plans: Mapping[str, Plan | None]
    asked: StudyFile

    @classmethod
    def of(cls, arms: Sequence[Arm], plans: Sequence[str] | Mapping[str, Plan | None], **others: Any) -> Self:
        """others : as in a study file, `runs`, `sigma_mm`, ... Raises `InputError` for all that can be said before work
        starts."""
        plans = plans if isinstance(plans, Mapping) else dict.fromkeys(plans)
        asked = StudyFile.of({"arms": [arm.name for arm in arms], "plans": [*plans], **others})
        methods = {*SOLVERS, DFT, RANDOM}
        for name, plan in plans.items():
            if plan is None and name not in methods:
                raise InputError.unknown("plans: unknown", name, [*methods, "NAME.csv"])
            if plan is None and not asked.runs:
                raise InputError(f"runs: is missing, allowed: whole numbers >= 1, as plan {name!r} needs them")
        least = []  # runs of each fit; where one can be done, the others are rows that say why there is nothing
        for arm in arms:
            if arm.sigma is None and asked.sigma_mm is None:
                raise InputError(f"sigma_mm: is missing, allowed: numbers > 0 [mm], as arm {arm.name} has none")
            for name, plan in plans.items():
                if plan is not None and plan.links != arm.links:
                    raise InputError(f"plans: {name} has {plan.links} joints, allowed: {arm.links} as arm {arm.name}")
            for what, entries in (("truths", asked.truths), ("models", asked.models)):
                for entry in entries:
                    with InputError.at(f"{what}: {entry.name} with arm {arm.name}"):
                        model = entry.model(arm)
                    least.append(-(-len(model.names) // (model.dimension * len(model.arm.chain.tools))))
        most = max(*asked.runs, *(len(plan) for plan in plans.values() if plan is not None), 0, 0)
        if most < min(least):
            raise InputError(f"runs: found {most}, allowed: at least {min(least)}, an equation for every parameter")
        return cls(arms, plans, asked)

    @classmethod
    def load(cls, path: Path | str, replications: int | None = None) -> Self:
        """The study that a TOML file describes; names of files in it are beside it.

        Its keys: identification/files/README.md, "Study file".  replications : instead of the file's

        Raises `InputError`, one line naming file, key, what was found and what is allowed.
        """
        with InputError.at(path):
            arms, plans, others = StudyFile.read(path, replications)
            return cls.of(arms, plans, **others)

    def tasks(self, made: pl.DataFrame) -> Iterator[tuple[Key, Cell | str]]:
        """Key and payload of every block; a cell that cannot be simulated has one block, whose row says why."""
        rows = {(row["arm"], row["plan"], row["runs"]): row for row in made.iter_rows(named=True)}
        asked = self.asked
        for arm, (name, plan) in product(self.arms, self.plans.items()):
            for runs in asked.runs if plan is None else [len(plan)]:
                row = rows.get((arm.name, name, runs), {})
                postures: Array | str | None = None if name == RANDOM else f"no plan: {row.get('error')}"
                if plan is not None:
                    postures = plan.postures
                elif name == DFT and not design_model(arm).planar:
                    postures = f"plan dft: arm {arm.name} is not that of Table I, allowed: planar arms with positions"
                elif name == DFT and runs < arm.links:
                    few = f"{runs} runs are too few for {arm.links} links"
                    postures = f"plan dft: {few}, allowed: at least {arm.links}"
                elif name == DFT:
                    postures = dft_postures(arm.links, runs)
                    inside = np.all((postures >= arm.lower) & (postures <= arm.upper), axis=1)
                    outside = np.flatnonzero(~(inside & DesignProblem.of(arm).feasible(postures)))
                    if outside.size:
                        postures = f"plan dft: posture {outside[0] + 1} is outside the limits or a constraint"
                elif row.get("status") == "done":
                    postures = Plan.of_displayed(np.array(row["postures_deg"]), arm.joint_types).postures
                for sigma, truth, model in product(asked.sigma_mm or [arm.sigma or 0.0], asked.truths, asked.models):
                    fitted, true = model.of(arm), truth.of(arm)
                    cell = postures if isinstance(postures, str) else (fitted, true, postures, runs, float(sigma))
                    key = dict(zip(CELL, (arm.name, name, runs, sigma, truth.name, model.name), strict=True))
                    key["inputs"] = short_hash(fitted, true, postures)
                    size = RANDOM_BLOCK if name == RANDOM else BLOCK
                    size = max(1, min(size, MOST_ROWS // (runs * max(1, len(arm.chain.tools)))))
                    starts = [0] if isinstance(cell, str) else range(0, asked.replications, size)
                    for number, start in enumerate(starts):
                        yield {**key, "block": number, "replications": min(size, asked.replications - start)}, cell


# -- the run -----------------------------------------------------------------------------------------------------------
def run_study(study: Study, folder: Path | None = None, **how: Any) -> dict[str, pl.DataFrame]:
    """Every cell of the study: `cells` (one row per cell and parameter, see `pooled_rows`), `blocks` (one row per block
    of replications and parameter) and `plans` (one row per plan that a solver made).

    folder : for NAME.parquet of these, created if missing. None: nothing is written
    how : `workers`, `seed`, `resume`, `force` and `progress` of `run_tasks`
    Failures (no plan for so many runs, a plan that cannot identify the model) are rows with `status` and `error`.
    """
    arms = {short_hash(arm): arm for arm in study.arms}
    solvers = [name for name, plan in study.plans.items() if plan is None and name not in (DFT, RANDOM)]
    keys: list[Key] = [
        {"arm": arm.name, "plan": plan, "runs": runs, "limit_s": study.asked.solver_seconds, "inputs": digest}
        for (digest, arm), plan, runs in product(arms.items(), solvers, study.asked.runs)
    ]
    paths = [None if folder is None else folder / f"{name}.parquet" for name in ("plans", "blocks", "cells")]
    plans = run_tasks(make_plan, keys, paths[0], payload=lambda key: arms[key["inputs"]], **how)
    tasks = {canonical(key): (key, cell) for key, cell in study.tasks(plans)}
    asked = [key for key, _ in tasks.values()]
    blocks = run_tasks(replicate, asked, paths[1], payload=lambda key: tasks[canonical(key)][1], **how)
    cells = pooled_rows(blocks)
    if paths[2] is not None and "done" in cells["status"]:
        write_together({paths[2]: parquet(cells)}, force=True)
    return {"cells": cells, "blocks": blocks, "plans": plans}


def make_plan(key: dict[str, Any], seed: np.random.SeedSequence, arm: Arm) -> list[Row]:
    """The plan of a key as one row."""
    number = int(seed.generate_state(1)[0])
    design = solve(DesignProblem.of(arm), key["runs"], key["plan"], seed=number, seconds=key["limit_s"])
    return [{"postures_deg": design.plan.displayed.tolist(), "efficiency": design.efficiency}]


def dft_postures(links: int, runs: int) -> Array:
    """(m, n) theta_j = 2 pi i j / m, so every q_j = 2 pi i / m, in (-pi, pi] (doe/README.md, "Information matrix")."""
    turn = 2.0 * np.pi * np.arange(runs) / runs
    return np.tile(np.where(turn > np.pi, turn - 2.0 * np.pi, turn)[:, None], (1, links))


# what a block of replications needs: the arm as the fit knows it and as it really is, the plan (m, n), None: a random
# one, runs, sigma
Cell = tuple[Arm, Arm, Array | None, int, float]


def pooled_rows(blocks: pl.DataFrame) -> pl.DataFrame:
    """One row per cell and parameter: blocks pooled.

    `fits`, `failed` : numbers of data sets;  `mean_error`, `std` : of the errors, file units
    `expected_std` : eq. 16; of random plans the root mean square over the plans, which `std` must equal
    `coverage` : fraction of 95 % intervals, with the true sigma, that hold the true value
    `rms_mm` : of the fits' residuals per row;  `status`, `error` : of the first block that failed, else done
    """
    types: Any = {"parameter": pl.String, "unit": pl.String}
    types |= dict.fromkeys(("fits", "failed", "covered"), pl.Int64)
    types |= dict.fromkeys(("mean_error", "squares", "expected_std", "rms_mm"), pl.Float64)
    blocks = pl.concat([blocks, pl.DataFrame(schema=types)], how="diagonal_relaxed").cast(types)
    n, done = pl.col("fits").sum(), pl.col("status") == "done"

    def mean(each: pl.Expr) -> pl.Expr:
        return (each * pl.col("fits")).sum() / n

    between = (pl.col("fits") * (pl.col("mean_error") - mean(pl.col("mean_error"))) ** 2).sum()
    return blocks.group_by(*CELL, "inputs", "parameter", "unit", maintain_order=True).agg(
        n.alias("fits"),
        pl.col("failed").sum(),
        pl.when(n > 0).then(mean(pl.col("mean_error"))).alias("mean_error"),
        pl.when(n > 1).then(((pl.col("squares").sum() + between) / (n - 1)).sqrt()).alias("std"),
        pl.when(n > 0).then(mean(pl.col("expected_std") ** 2).sqrt()).alias("expected_std"),
        pl.when(n > 0).then(pl.col("covered").sum() / n).alias("coverage"),
        pl.when(pl.col("rms_mm").is_not_null().any()).then(mean(pl.col("rms_mm") ** 2).sqrt()).alias("rms_mm"),
        pl.when(done.all()).then(pl.lit("done")).otherwise(pl.lit("failed")).alias("status"),
        pl.col("error").cast(pl.String).drop_nulls().first().alias("error"),
    )


def replicate(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, coverage, in
    file units (mm and degrees).

    cell : what to simulate, or the reason why it cannot be simulated (no plan was found)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    fitted, true, plan, runs, sigma = cell
    data_sets, generator = Replications.of(fitted, true), np.random.default_rng(seed)
    model, rows = data_sets.model, runs * data_sets.points
    if (equations := model.dimension * rows) < len(model.names):
        raise JobError(f"{runs} runs are {equations} equations, allowed: at least {len(model.names)}, one per unknown")
    postures = random_postures(DesignProblem.of(model), runs, generator) if plan is None else plan
    errors, rss, stds = data_sets.fits(postures, sigma, generator, key["replications"])
    good = np.isfinite(np.c_[errors, rss]).all(axis=1)
    errors, rss = errors[good], rss[good]
    fits: Row = {"fits": len(errors), "failed": int(np.sum(~good)), "rms_mm": None}
    if len(errors) and model.dimension <= 3:  # the residuals of orientations are no distances
        fits["rms_mm"] = float(np.sqrt(np.mean(rss) / rows))
    block = []
    for (name, unit, factor), error, std in zip(data_sets.reported, errors.T, stds, strict=True):
        row: Row = {"parameter": name, "unit": unit, **fits, "mean_error": None, "squares": None}
        if error.size:
            mean = float(np.mean(error * factor))
            row |= {"mean_error": mean, "squares": float(np.sum((error * factor - mean) ** 2))}
        row["covered"] = int(np.sum(np.abs(error) <= 1.959963984540054 * std))  # two-sided 95 % of the normal
        row["expected_std"] = float(std * factor) if error.size else None
        block.append(row)
    return block


# -- as a document -----------------------------------------------------------------------------------------------------
def monte_carlo_parts(tables: Mapping[str, pl.DataFrame]) -> list[Any]:
    """What kept cells from being simulated, equal sentences once; one table per cell that was, up to twelve, of errors,
    deviations and coverage of each parameter (dashes where no fit succeeded)."""
    cells, done = tables["cells"], tables["blocks"].filter(status="done")
    fits = done.group_by("key").first()["fits"].sum() if "fits" in done.columns else 0
    count = cells.select(CELL).n_unique()
    failed = cells.filter(pl.col("error").is_not_null()).group_by("arm", "error", maintain_order=True)
    kinds = failed.agg(pl.struct(CELL).n_unique().alias("cells")).iter_rows(named=True)
    parts: list[Any] = [f"{count} cells, {fits} fits"]
    parts += [f"{kind['arm']}: {kind['cells']} of {count} cells failed: {kind['error']}" for kind in kinds]
    each = cells.filter(pl.col("error").is_null()).partition_by(*CELL, maintain_order=True)
    for cell in each[:12]:
        first = cell.row(0, named=True)
        title = "{arm}, plan {plan}, {runs} runs, sigma {sigma_mm:g} mm, truth {truth}, model {model}".format(**first)
        lost = f", {first['failed']} failed" if first["failed"] else ""
        title += f": {first['fits']} fits{lost}, RMS {cell_text(first['rms_mm'])} mm"
        parts.append(sheet(cell.iter_rows(named=True), ESTIMATED, title))
    return [*parts, *([f"first 12 of {len(each)} cells that were simulated"] if len(each) > 12 else [])]
