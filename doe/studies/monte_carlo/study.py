"""Running a study: plans first, then blocks of replications, both as resumable tables; then cells from blocks."""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.jobs.row_table import Key, Row, RowTable, canonical
from doe.jobs.tasks import run
from doe.jobs.workers import Workers
from doe.problem.problem import DesignProblem
from doe.studies.monte_carlo.cells import DFT, RANDOM, Study
from doe.studies.monte_carlo.fits import Cell, block
from identification.arm import Arm
from identification.errors import JobError
from identification.files.arm import arm_from_tables, dump_arm
from identification.files.io import PathLike
from identification.model import Model
from identification.progress import Progress, silent

if TYPE_CHECKING:
    import polars

CELL = ("arm", "plan", "runs", "sigma_mm", "truth", "model")
PLANS, BLOCKS, CELLS = "plans.parquet", "blocks.parquet", "cells.parquet"


@dataclass(frozen=True)
class StudyResult:
    """What a study found.

    cells : one row per cell and parameter, see `cells`;  blocks : one row per block of replications and parameter
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
    with RowTable.within(folder, PLANS, resume=resume, force=force) as table:
        wanted = list(_plan_keys(study))
        arms = {_hash(text): text for text in map(dump_arm, study.arms)}
        plans = run(
            make_plan, wanted, table, workers, seed=seed, payload=lambda key: arms[key["inputs"]], progress=progress
        )
        made = {key: _postures(rows[0]) for key, rows in table.rows.items()}
    with RowTable.within(folder, BLOCKS, resume=resume, force=force) as table:
        tasks = dict(_tasks(study, {(k["arm"], k["plan"], k["runs"]): made[canonical(k)] for k in wanted}))
        keys = [dict(key) for key in tasks]
        blocks = run(block, keys, table, workers, seed=seed, payload=lambda key: tasks[_frozen(key)], progress=progress)
    found = cells(blocks)
    if folder is not None:
        found.write_parquet(Path(folder) / CELLS)
    return StudyResult(found, blocks, plans)


# -- plans -------------------------------------------------------------------------------------------------------------
def _plan_keys(study: Study) -> Iterator[Key]:
    """One key per plan that a solver has to make."""
    solvers = [plan for plan in study.plans if isinstance(plan, str) and plan not in (DFT, RANDOM)]
    for arm, plan, runs in product(study.arms, solvers, study.runs):
        yield {
            "arm": arm.name,
            "plan": plan,
            "runs": runs,
            "limit_s": study.solver_seconds,
            "inputs": _hash(dump_arm(arm)),
        }


def make_plan(key: dict[str, Any], seed: np.random.SeedSequence, text: str) -> list[Row]:
    """The plan of a key as one row, for the arm of an arm file's text."""
    from doe.solvers import solve

    problem = DesignProblem.of(Model(arm_from_tables(tomllib.loads(text))))
    number = int(seed.generate_state(1)[0])
    design = solve(problem, key["runs"], key["plan"], seed=number, seconds=key["limit_s"])
    return [{"postures_deg": np.degrees(design.plan.postures).tolist(), "efficiency": design.efficiency}]


def dft_postures(links: int, runs: int) -> np.ndarray:
    """(m, n) theta_j = 2 pi i j / m, so every q_j = 2 pi i / m, in (-pi, pi] (doe/README.md, "Information matrix")."""
    turn = 2.0 * np.pi * np.arange(runs) / runs
    return np.tile(np.where(turn > np.pi, turn - 2.0 * np.pi, turn)[:, None], (1, links))


def _dft(arm: Arm, runs: int) -> np.ndarray | str:
    postures = dft_postures(arm.links, runs)
    if runs < arm.links:
        return f"plan dft: {runs} runs cannot tell {arm.links} links apart, allowed: at least {arm.links}"
    outside = np.flatnonzero(np.any((postures < arm.lower) | (postures > arm.upper), axis=0))
    if outside.size:
        return f"plan dft: joint {outside[0] + 1} would leave its limits"
    lost = np.flatnonzero(~DesignProblem.of(Model(arm)).feasible(postures))
    return f"plan dft: posture {lost[0] + 1} would violate a constraint" if lost.size else postures


def _postures(row: Row) -> np.ndarray | str:
    if row["status"] != "done":
        return f"no plan: {row['error']}"
    return np.radians(row["postures_deg"])


# -- blocks ------------------------------------------------------------------------------------------------------------
def _tasks(study: Study, made: Mapping[Any, np.ndarray | str]) -> Iterator[tuple[Any, Cell | str]]:
    """Frozen key and payload of every block."""
    for arm in study.arms:
        for name, runs, postures in _plans(study, arm, made):
            for sigma, truth, model in product(study.sigma or [arm.sigma or 0.0], study.truths, study.models):
                texts = dump_arm(model.of(arm)), dump_arm(truth.of(arm))
                degrees = None if postures is None or isinstance(postures, str) else np.degrees(postures)
                plan = None if degrees is None else tuple(map(tuple, degrees.tolist()))
                cell = postures if isinstance(postures, str) else Cell(*texts, plan, runs, float(sigma))
                key = dict(zip(CELL, (arm.name, name, runs, sigma, truth.name, model.name), strict=True))
                key["inputs"] = _hash(repr((texts, plan)))
                for number, size in enumerate(_sizes(study, cell)):
                    yield _frozen({**key, "block": number, "replications": size}), cell


def _plans(
    study: Study, arm: Arm, made: Mapping[Any, np.ndarray | str]
) -> Iterator[tuple[str, int, np.ndarray | str | None]]:
    """Name, number of runs and postures (None: random, a text: why there is none) of an arm's plans."""
    for plan in study.plans:
        if not isinstance(plan, str):
            yield plan[0], len(plan[1]), plan[1].postures
            continue
        for runs in study.runs:
            if plan == RANDOM:
                yield plan, runs, None
            else:
                yield plan, runs, _dft(arm, runs) if plan == DFT else made[arm.name, plan, runs]


def _sizes(study: Study, cell: Cell | str) -> list[int]:
    """Replications of each block; one empty-handed task says why a cell cannot be done."""
    if isinstance(cell, str):
        return [study.replications]
    whole, rest = divmod(study.replications, study.block)
    return [study.block] * whole + [rest] * (rest > 0)


def _frozen(key: Key) -> tuple[tuple[str, Any], ...]:
    return tuple(key.items())


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


# -- cells -------------------------------------------------------------------------------------------------------------
def cells(blocks: polars.DataFrame) -> polars.DataFrame:
    """One row per cell and parameter: blocks pooled.

    `fits`, `failed` : numbers of data sets;  `mean_error`, `std`, `rms` : of the errors, file units
    `mean_error_se`, `std_se` : their standard errors; the deviation's for normal errors, so null for random plans
    `expected_std` : eq. 16; of random plans the root mean square over the plans, which `std` must equal
    `coverage` : share of 95 % intervals, with the true sigma and each data set's own plan, that hold the true value
    `rms_mm` : of the fits' residuals per row;  `status`, `error` : of the first block that failed, else done
    """
    import polars as pl

    columns = {"parameter": pl.String, "unit": pl.String, "fits": pl.Int64, "failed": pl.Int64, "covered": pl.Int64}
    columns |= dict.fromkeys(("mean_error", "squares", "expected_std", "rms_mm"), pl.Float64)
    for name, dtype in columns.items():
        column = pl.col(name).cast(dtype) if name in blocks.columns else pl.lit(None, dtype)
        blocks = blocks.with_columns(column.alias(name))
    n = pl.col("fits").sum()
    mean = (pl.col("mean_error") * pl.col("fits")).sum() / n
    about = pl.col("squares").sum() + (pl.col("fits") * (pl.col("mean_error") - mean) ** 2).sum()
    std = (about / (n - 1)).sqrt()
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
        pl.when(n > 0).then(((pl.col("rms_mm") ** 2 * pl.col("fits")).sum() / n).sqrt()).alias("rms_mm"),
        pl.when(some.all()).then(pl.lit("done")).otherwise(pl.lit("failed")).alias("status"),
        pl.col("error").cast(pl.String).drop_nulls().first().alias("error"),
    )


def require_some(result: StudyResult) -> None:
    """Raises `JobError` with the first reason if not one cell could be done."""
    if "done" not in set(result.blocks["status"]):
        reason = re.sub(r"\b[A-Z]\w*Error: ", "", result.blocks["error"][0])  # the kinds are no news to people
        raise JobError(f"no cell could be done: {reason}")
