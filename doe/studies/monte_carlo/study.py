"""Running a study: plans first, then blocks of replications, both as resumable tables; then cells from blocks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.row_table import Key, parquet, short_hash, with_columns
from doe.jobs.tasks import Job
from doe.jobs.workers import Workers
from doe.studies.monte_carlo.plans import made_postures, make_plan, plan_keys, plans_of
from doe.studies.monte_carlo.replications import Cell, replicate
from doe.studies.monte_carlo.spatial import in_file_units
from doe.studies.monte_carlo.specification import CELL, RANDOM, Study
from identification.errors import JobError
from identification.files.arm_text import dump_arm
from identification.files.io import PathLike, write_whole
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
    with Job.open(folder, (PLANS, BLOCKS), workers, **options) as job:
        plans = job.run(make_plan, list(plan_keys(study)), PLANS, payload=lambda key: arms[key["inputs"]])
        tasks = dict(_tasks(study, made_postures(study, plans)))
        blocks = job.run(replicate, [dict(key) for key in tasks], BLOCKS, payload=lambda key: tasks[_frozen(key)])
        cells = pooled_rows(blocks)
        if folder is not None:
            write_whole(Path(folder) / CELLS, parquet(cells), force=True)
    return StudyResult(cells, blocks, plans)


def _tasks(study: Study, made: Mapping[Any, np.ndarray | str]) -> Iterator[tuple[Any, Cell | str]]:
    """Frozen key and payload of every block."""
    for arm in study.arms:
        for name, runs, postures in plans_of(study, arm, made):
            for sigma, truth, model in product(study.sigma or [arm.sigma or 0.0], study.truths, study.models):
                texts = dump_arm(model.of(arm)), dump_arm(truth.of(arm))
                degrees = in_file_units(postures, arm.joint_types) if isinstance(postures, np.ndarray) else None
                plan = None if degrees is None else tuple(map(tuple, degrees.tolist()))
                cell = postures if isinstance(postures, str) else Cell(*texts, plan, runs, float(sigma))
                key = dict(zip(CELL, (arm.name, name, runs, sigma, truth.name, model.name), strict=True))
                key["inputs"] = short_hash(repr((texts, plan)))
                for number, size in enumerate(_sizes(study, cell)):
                    yield _frozen({**key, "block": number, "replications": size}), cell


def _sizes(study: Study, cell: Cell | str) -> list[int]:
    """Replications of each block; a cell that cannot be simulated has one block, whose row says why."""
    if isinstance(cell, str):
        return [study.replications]
    whole, rest = divmod(study.replications, study.block)
    return [study.block] * whole + [rest] * (rest > 0)


def _frozen(key: Key) -> tuple[tuple[str, Any], ...]:
    return tuple(key.items())


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
    some = pl.col("status") == "done"
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
        pl.when(some.all()).then(pl.lit("done")).otherwise(pl.lit("failed")).alias("status"),
        pl.col("error").cast(pl.String).drop_nulls().first().alias("error"),
    )
