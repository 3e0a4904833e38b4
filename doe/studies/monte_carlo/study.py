"""Running a study: plans first, then blocks of replications, both as resumable tables; then cells from blocks."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.row_table import Key, Row, canonical, parquet, short_hash, with_columns
from doe.jobs.tasks import Job
from doe.jobs.workers import Workers
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from doe.studies.monte_carlo.replications import Cell, in_api_units, in_file_units, replicate
from doe.studies.monte_carlo.specification import CELL, DFT, RANDOM, Study
from identification.arm import Arm
from identification.arrays import Array
from identification.errors import JobError
from identification.files.arm import arm_from_tables
from identification.files.arm_text import dump_arm
from identification.files.io import PathLike, write_whole
from identification.model import Model
from identification.progress import Progress, silent

PLANS, BLOCKS, CELLS = "plans.parquet", "blocks.parquet", "cells.parquet"


@dataclass(frozen=True)
class StudyResult:
    """What a study found.

    cells : one row per cell and parameter, see `pooled_rows`;  blocks : one row per block of replications and parameter
    plans : one row per plan that a solver made
    """

    cells: pl.DataFrame
    blocks: pl.DataFrame
    plans: pl.DataFrame

    def __str__(self) -> str:
        done = self.blocks.filter(self.blocks["status"] == "done")
        fits = done.group_by("key").first()["fits"].sum() if "fits" in done.columns else 0
        return f"{self.cells.select(CELL).n_unique()} cells, {fits} fits, {len(self.blocks) - len(done)} failures"

    __repr__ = __str__


def run_study(
    study: Study,
    folder: PathLike | None = None,
    workers: Workers | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> StudyResult:
    """Every cell of the study.

    folder : for plans.parquet, blocks.parquet and cells.parquet, created if missing. None: nothing is written
    resume : go on with an interrupted or extended study in `folder`;  force : replace what is there
    Failures (no plan for so many runs, a plan that cannot identify the model) are rows with `status` and `error`.
    """
    options: dict[str, Any] = {"seed": seed, "resume": resume, "force": force, "progress": progress}
    arms = {short_hash(text): text for text in map(dump_arm, study.arms)}
    solvers = [plan for plan in study.plans if isinstance(plan, str) and plan not in (DFT, RANDOM)]
    keys: list[Key] = [
        {"arm": arm.name, "plan": plan, "runs": runs, "limit_s": study.solver_seconds, "inputs": digest}
        for (arm, digest), plan, runs in product(zip(study.arms, arms, strict=True), solvers, study.runs)
    ]
    with Job.open(folder, (PLANS, BLOCKS), workers, **options) as job:
        plans = job.run(make_plan, keys, PLANS, payload=lambda key: arms[key["inputs"]])
        tasks = {canonical(key): (key, cell) for key, cell in _tasks(study, plans)}
        blocks = job.run(replicate, [key for key, _ in tasks.values()], BLOCKS, lambda key: tasks[canonical(key)][1])
        cells = pooled_rows(blocks)
        if folder is not None:
            write_whole(Path(folder) / CELLS, parquet(cells), force=True)
    return StudyResult(cells, blocks, plans)


# -- plans -------------------------------------------------------------------------------------------------------------
def make_plan(key: dict[str, Any], seed: np.random.SeedSequence, text: str) -> list[Row]:
    """The plan of a key as one row, for the arm of an arm file's text."""
    problem = DesignProblem.of(Model(arm_from_tables(tomllib.loads(text))))
    number = int(seed.generate_state(1)[0])
    design = solve(problem, key["runs"], key["plan"], seed=number, seconds=key["limit_s"])
    postures = in_file_units(design.plan.postures, problem.model.joint_types)
    return [{"postures_deg": postures.tolist(), "efficiency": design.efficiency}]


def dft_postures(links: int, runs: int) -> Array:
    """(m, n) theta_j = 2 pi i j / m, so every q_j = 2 pi i / m, in (-pi, pi] (doe/README.md, "Information matrix")."""
    turn = 2.0 * np.pi * np.arange(runs) / runs
    return np.tile(np.where(turn > np.pi, turn - 2.0 * np.pi, turn)[:, None], (1, links))


def _dft(arm: Arm, runs: int) -> Array | str:
    """The plan, or why there is none."""
    if not arm.chain.planar:
        return f"plan dft: arm {arm.name} is spatial, allowed: planar arms"
    if runs < arm.links:
        return f"plan dft: {runs} runs are too few for {arm.links} links, allowed: at least {arm.links}"
    postures = dft_postures(arm.links, runs)
    outside = np.flatnonzero(np.any((postures < arm.lower) | (postures > arm.upper), axis=0))
    if outside.size:
        return f"plan dft: joint {outside[0] + 1} would leave its limits"
    outside = np.flatnonzero(~DesignProblem.of(Model(arm)).feasible(postures))
    return f"plan dft: posture {outside[0] + 1} would violate a constraint" if outside.size else postures


def _plans_of(study: Study, arm: Arm, made: pl.DataFrame) -> Iterator[tuple[str, int, Array | str | None]]:
    """Name, number of runs and postures (None: random, a text: why there is none) of an arm's plans."""
    rows = {(row["arm"], row["plan"], row["runs"]): row for row in made.iter_rows(named=True)}
    for plan in study.plans:
        if not isinstance(plan, str):
            yield plan[0], len(plan[1]), plan[1].postures
            continue
        for runs in study.runs:
            if plan == RANDOM:
                yield plan, runs, None
            elif plan == DFT:
                yield plan, runs, _dft(arm, runs)
            elif (row := rows[arm.name, plan, runs])["status"] == "done":
                yield plan, runs, in_api_units(np.array(row["postures_deg"]), arm.joint_types)
            else:
                yield plan, runs, f"no plan: {row['error']}"


# -- blocks ------------------------------------------------------------------------------------------------------------
def _tasks(study: Study, made: pl.DataFrame) -> Iterator[tuple[Key, Cell | str]]:
    """Key and payload of every block; a cell that cannot be simulated has one block, whose row says why."""
    whole, rest = divmod(study.replications, study.block)
    blocks = [study.block] * whole + [rest] * (rest > 0)
    for arm in study.arms:
        for name, runs, postures in _plans_of(study, arm, made):
            for sigma, truth, model in product(study.sigma or [arm.sigma or 0.0], study.truths, study.models):
                texts = dump_arm(model.of(arm)), dump_arm(truth.of(arm))
                degrees = in_file_units(postures, arm.joint_types) if isinstance(postures, np.ndarray) else None
                plan = None if degrees is None else tuple(map(tuple, degrees.tolist()))
                cell = postures if isinstance(postures, str) else Cell(*texts, plan, runs, float(sigma))
                key = dict(zip(CELL, (arm.name, name, runs, sigma, truth.name, model.name), strict=True))
                key["inputs"] = short_hash(repr((texts, plan)))
                for number, size in enumerate([study.replications] if isinstance(cell, str) else blocks):
                    yield {**key, "block": number, "replications": size}, cell


def require_some(result: StudyResult) -> None:
    """Raises `JobError` with the first reason if no cell could be simulated."""
    if "done" not in set(result.blocks["status"]):
        reason = re.sub(r"\b[A-Z]\w*Error: ", "", result.blocks["error"][0])  # users need no exception types
        raise JobError(f"no cell could be done: {reason}")


def discard(folder: Path, new: bool) -> None:
    """Removes the tables of a study without a result, and the folder where it was made for them."""
    for name in (PLANS, BLOCKS, CELLS):
        (folder / name).unlink(missing_ok=True)
    if new:
        folder.rmdir()


def pooled_rows(blocks: pl.DataFrame) -> pl.DataFrame:
    """One row per cell and parameter: blocks pooled.

    `fits`, `failed` : numbers of data sets;  `mean_error`, `std`, `rms` : of the errors, file units
    `mean_error_se`, `std_se` : their standard errors; the deviation's for normal errors, so null for random plans
    `expected_std` : eq. 16; of random plans the root mean square over the plans, which `std` must equal
    `coverage` : fraction of 95 % intervals, with the true sigma and each data set's own plan, that hold the true value
    `rms_mm` : of the fits' residuals per row;  `status`, `error` : of the first block that failed, else done
    """
    types: dict[str, Any] = {"parameter": pl.String, "unit": pl.String}
    types |= dict.fromkeys(("fits", "failed", "covered"), pl.Int64)
    types |= dict.fromkeys(("mean_error", "squares", "expected_std", "rms_mm"), pl.Float64)
    blocks = with_columns(blocks, types)
    n = pl.col("fits").sum()
    mean = (pl.col("mean_error") * pl.col("fits")).sum() / n
    about = pl.col("squares").sum() + (pl.col("fits") * (pl.col("mean_error") - mean) ** 2).sum()
    std = (about / (n - 1)).sqrt()
    of_fits = (pl.col("rms_mm") ** 2 * pl.col("fits")).sum()
    expected = ((pl.col("expected_std") ** 2 * pl.col("fits")).sum() / n).sqrt()
    done = pl.col("status") == "done"
    return blocks.group_by(*CELL, "inputs", "parameter", "unit", maintain_order=True).agg(
        n.alias("fits"),
        pl.col("failed").sum(),
        pl.when(n > 0).then(mean).alias("mean_error"),
        pl.when(n > 1).then(std).alias("std"),
        pl.when(n > 0).then((about / n + mean**2).sqrt()).alias("rms"),
        pl.when(n > 1).then(std / n.sqrt()).alias("mean_error_se"),
        pl.when((n > 1) & (pl.col("plan").first() != RANDOM)).then(std / (2.0 * (n - 1)).sqrt()).alias("std_se"),
        pl.when(n > 0).then(expected).alias("expected_std"),
        pl.when(n > 0).then(pl.col("covered").sum() / n).alias("coverage"),
        pl.when(pl.col("rms_mm").is_not_null().any()).then((of_fits / n).sqrt()).alias("rms_mm"),
        pl.when(done.all()).then(pl.lit("done")).otherwise(pl.lit("failed")).alias("status"),
        pl.col("error").cast(pl.String).drop_nulls().first().alias("error"),
    )
