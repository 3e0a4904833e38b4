"""Running a study: plans first, then blocks of replications, both as resumable tables; then cells from blocks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.jobs.row_table import Key
from doe.jobs.tasks import Job
from doe.jobs.workers import Workers
from doe.studies.monte_carlo.plans import made_postures, make_plan, plan_keys, plans_of, short_hash
from doe.studies.monte_carlo.replications import Cell, replicate
from doe.studies.monte_carlo.specification import CELL, Study
from doe.studies.monte_carlo.summary import pooled
from identification.errors import JobError
from identification.files.arm_text import dump_arm
from identification.files.io import PathLike
from identification.progress import Progress, silent

if TYPE_CHECKING:
    import polars

PLANS, BLOCKS, CELLS = "plans.parquet", "blocks.parquet", "cells.parquet"


@dataclass(frozen=True)
class StudyResult:
    """What a study found.

    cells : one row per cell and parameter, see `pooled`;  blocks : one row per block of replications and parameter
    plans : one row per plan that a solver made
    """

    cells: polars.DataFrame
    blocks: polars.DataFrame
    plans: polars.DataFrame

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

    folder : where plans.parquet, blocks.parquet and cells.parquet go; it is made. None: nothing is written
    resume : go on with an interrupted or extended study in `folder`;  force : replace what is there
    Failures (no plan for so many runs, a plan that cannot identify the model) are rows with `status` and `error`.
    """
    job = Job(folder, workers, seed, resume, force, progress)
    arms = {short_hash(text): text for text in map(dump_arm, study.arms)}
    plans = job.run(make_plan, list(plan_keys(study)), PLANS, payload=lambda key: arms[key["inputs"]])
    tasks = dict(_tasks(study, made_postures(plans)))
    blocks = job.run(replicate, [dict(key) for key in tasks], BLOCKS, payload=lambda key: tasks[_frozen(key)])
    cells = pooled(blocks)
    if folder is not None:
        cells.write_parquet(Path(folder) / CELLS)
    return StudyResult(cells, blocks, plans)


def _tasks(study: Study, made: Mapping[Any, np.ndarray | str]) -> Iterator[tuple[Any, Cell | str]]:
    """Frozen key and payload of every block."""
    for arm in study.arms:
        for name, runs, postures in plans_of(study, arm, made):
            for sigma, truth, model in product(study.sigma or [arm.sigma or 0.0], study.truths, study.models):
                texts = dump_arm(model.of(arm)), dump_arm(truth.of(arm))
                degrees = None if postures is None or isinstance(postures, str) else np.degrees(postures)
                plan = None if degrees is None else tuple(map(tuple, degrees.tolist()))
                cell = postures if isinstance(postures, str) else Cell(*texts, plan, runs, float(sigma))
                key = dict(zip(CELL, (arm.name, name, runs, sigma, truth.name, model.name), strict=True))
                key["inputs"] = short_hash(repr((texts, plan)))
                for number, size in enumerate(_sizes(study, cell)):
                    yield _frozen({**key, "block": number, "replications": size}), cell


def _sizes(study: Study, cell: Cell | str) -> list[int]:
    """Replications of each block; of a cell that cannot be done one task, whose row says why."""
    if isinstance(cell, str):
        return [study.replications]
    whole, rest = divmod(study.replications, study.block)
    return [study.block] * whole + [rest] * (rest > 0)


def _frozen(key: Key) -> tuple[tuple[str, Any], ...]:
    return tuple(key.items())


def require_some(result: StudyResult) -> None:
    """Raises `JobError` with the first reason if not one cell could be done."""
    if "done" not in set(result.blocks["status"]):
        reason = re.sub(r"\b[A-Z]\w*Error: ", "", result.blocks["error"][0])  # the kinds are no news to people
        raise JobError(f"no cell could be done: {reason}")
