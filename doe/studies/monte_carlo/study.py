"""Running a study: plans first, then blocks of replications, both as resumable tables; then cells from blocks.

One block of replications: simulate, fit all data sets at once, and keep a few numbers per parameter.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from doe.jobs.rows import Key, Row, canonical, parquet, short_hash, with_columns
from doe.jobs.running import Job, Workers
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from doe.studies.monte_carlo.specification import CELL, DFT, RANDOM, Study, points
from identification import (
    JOINT_OFFSET,
    PRISMATIC,
    REVOLUTE,
    Arm,
    Array,
    Conditions,
    JobError,
    Measurements,
    Model,
    Progress,
    arm_from_tables,
    dump_arm,
    estimate_batch,
    estimate_each,
    silent,
    without_prior,
)
from identification.estimation.estimate import sessions
from identification.files.io import write_together
from identification.information import covariances, spectrum
from identification.kinematics.counting import in_columns, in_joints
from identification.kinematics.parameters import orientation_transform

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
    folder: Path | str | None = None,
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
            write_together({Path(folder) / CELLS: parquet(cells)}, force=True)
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


# -- replications ------------------------------------------------------------------------------------------------------
MOST_ROWS = 4_000_000  # of one plan at a time: 64 MB of positions


def in_file_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """Postures [rad, mm] as files have them, in degrees, of prismatic joints in millimetres."""
    columns = in_columns(postures, joint_types)
    return np.where(np.array(joint_types) == REVOLUTE, np.degrees(columns), columns)


def in_api_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """The reverse of `in_file_units`."""
    return in_joints(np.where(np.array(joint_types) == PRISMATIC, postures, np.radians(postures)), joint_types)


def rows_of(truth: Model, postures: Array, remembers: bool = False) -> tuple[Array, Conditions]:
    """(..., m P, n) a posture for each row of plans (..., m, n), and conditions of the rows in their order, with the
    orientations of the true arm.

    remembers : with the past of the joints
    """
    count = points(truth)
    rows = np.repeat(postures, count, axis=-2)
    conditions = sessions(rows, remembers or truth.remembers)
    if count > 1:
        conditions = replace(conditions, marker=np.broadcast_to(np.arange(rows.shape[-2]) % count, rows.shape[:-1]))
    if truth.arm.chain.angle_scale is None:
        return rows, conditions
    return rows, replace(conditions, orientation=truth.orientations(rows, conditions))


def plan_of(truth: Model, postures: Array) -> Measurements:
    """A plan (m, n) as measurements without positions: rows of `rows_of`."""
    rows, conditions = rows_of(truth, postures)
    chain, named = truth.arm.chain, {}
    if conditions.marker is not None:
        names = tuple(chain.tools)
        named = {"marker": np.array(names)[conditions.marker], "marker_names": names}
    return Measurements(rows, np.zeros((len(rows), truth.dimension)), orientations=conditions.orientation, **named)


def true_values(model: Model, truth: Model) -> Array:
    """(p,) values of the fitted parameters that are true: those of the truth, zero for those that it does not have;
    of a spatial arm's geometry those that mean the same."""
    values = model.parameters.mapping(model.parameters.vector(truth.best_known))
    if not model.arm.chain.planar:
        drawn, real = (Model(replace(each.arm, effects=())) for each in (model, truth))
        # three equations of each for some forty parameters
        postures = np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (100, model.joints))
        plan = plan_of(real, postures)
        same = estimate_batch(drawn, plan, real.position(plan.postures, conditions=plan.conditions)[None])
        values |= drawn.parameters.mapping(same.parameters[0])
    return model.parameters.vector(values)


class Cell(NamedTuple):
    """What a block of replications needs, in plain types that travel to workers.

    arm, truth : texts of arm files: as the fit knows it, and as it really is
    postures_deg : (m, n) the plan, of prismatic joints in mm; None: a new random plan for each replication
    """

    arm: str
    truth: str
    postures_deg: tuple[tuple[float, ...], ...] | None
    runs: int
    sigma: float


@lru_cache(maxsize=4)
def prepared(arm: str, truth: str) -> tuple[Model, Model, Array, Array]:
    """What is fitted (of a spatial arm a minimal set of parameters), what is simulated, (p,) true values of the fitted
    parameters, and (p + n, p) from them to those that are reported: themselves, and in the plane the orientation
    offsets. Kept, so that all blocks of a cell on one worker use one model."""
    fitted, simulated = (arm_from_tables(tomllib.loads(text)) for text in (arm, truth))
    model, true_model = Model(without_prior(fitted)), Model(simulated)
    transform = np.eye(len(model.names))
    if model.arm.chain.planar:
        transform = np.vstack([transform, orientation_transform(model.parameters)])
    return model, true_model, true_values(model, true_model), transform


def fits_of(cell: Cell, generator: np.random.Generator, total: int) -> tuple[Array, Array, Array]:
    """Parameters (K, p) of fits of K data sets, not numbers where one failed, sums of squares (K,) [mm^2], and
    deviations (K, p + n) by eq. 16 at the true values, of one plan (1, p + n), API units."""
    model, truth, values, transform = prepared(cell.arm, cell.truth)

    def deviations(matrices: Array) -> Array:
        return np.asarray(np.sqrt(np.sum((transform @ matrices) * transform, axis=-1)))

    rows = cell.runs * points(model)
    parts: list[Any] = []
    if cell.postures_deg is not None:
        plan = plan_of(truth, in_api_units(np.array(cell.postures_deg), model.joint_types))
        exact = truth.position(plan.postures, conditions=plan.conditions)
        jacobian = model.jacobian(plan.postures, values, plan.conditions)
        expected = deviations(cell.sigma**2 * spectrum(jacobian, model.scales).covariance)[None]
        for count in _sizes(total, MOST_ROWS // rows):
            positions = cell.sigma * generator.standard_normal((count, rows, model.dimension))
            positions += exact
            fits = estimate_batch(model, plan, positions)
            parts.append((np.where(fits.converged[:, None], fits.parameters, np.nan), np.array(fits.rss)))
        parameters, rss = map(np.concatenate, zip(*parts, strict=True))
        return parameters, rss, expected
    problem = DesignProblem.of(model)
    for count in _sizes(total, 20_000 // rows):  # rows whose arrays stay in the processor's cache
        postures = random_postures(problem, count * cell.runs, generator).reshape(count, cell.runs, -1)
        noise = cell.sigma * generator.standard_normal((count, rows, model.dimension))
        every, conditions = rows_of(truth, postures, model.remembers)
        each = estimate_each(model, every, truth.position(every, conditions=conditions) + noise, conditions)
        matrices = covariances(model.jacobian(every, values, conditions), model.scales, cell.sigma)
        parts.append((each.parameters, each.rss, deviations(matrices)))
    parameters, rss, expected = map(np.concatenate, zip(*parts, strict=True))
    return parameters, rss, expected


def _sizes(total: int, most: int) -> Iterator[int]:
    """Numbers of data sets that go through memory together."""
    size = max(1, most)
    yield from (min(size, total - start) for start in range(0, total, size))


def replicate(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, coverage, in
    file units (mm and degrees).

    cell : what to simulate, or the reason why it cannot be simulated (no plan was found)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    model, _, values, transform = prepared(cell.arm, cell.truth)
    unknowns, rows = len(values), cell.runs * points(model)
    if (equations := model.dimension * rows) < unknowns:
        raise JobError(f"{cell.runs} runs are {equations} equations, allowed: at least {unknowns}, one per unknown")
    parameters, rss, stds = fits_of(cell, np.random.default_rng(seed), key["replications"])
    good = np.isfinite(np.c_[parameters, rss]).all(axis=1) & np.isfinite(stds).all(axis=1)
    errors = (parameters[good] - values) @ transform.T
    turns = [*model.parameters.indices(JOINT_OFFSET).tolist(), *range(unknowns, len(transform))]
    errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
    stds = stds if len(stds) == 1 else stds[good]
    distances = model.dimension <= 3  # the residuals of orientations are none
    rms = float(np.sqrt(np.mean(rss[good]) / rows)) if len(errors) and distances else None
    fits = {"fits": len(errors), "failed": int(np.sum(~good)), "rms_mm": rms}
    reported = [(p.name, p.file_unit, p.to_file) for p in model.parameters]
    orientations = range(1, len(transform) - unknowns + 1)
    reported += [(f"orientation_offset:{j}", "deg", 180.0 / np.pi) for j in orientations]
    return [
        {"parameter": name, "unit": unit, **fits, **_figures(errors[:, k] * factor, stds[:, k] * factor)}
        for k, (name, unit, factor) in enumerate(reported)
    ]


def _figures(error: Array, std: Array) -> Row:
    """What a block keeps of the errors (K,) of one parameter and their expected deviations (K,) or (1,)."""
    if error.size == 0:
        return {"mean_error": None, "squares": None, "covered": 0, "expected_std": None}
    mean = float(np.mean(error))
    return {
        "mean_error": mean,
        "squares": float(np.sum((error - mean) ** 2)),
        "covered": int(np.sum(np.abs(error) <= 1.959963984540054 * std)),  # two-sided 95 % of the normal distribution
        "expected_std": float(std[0]) if std.size == 1 else float(np.sqrt(np.mean(std**2))),
    }
