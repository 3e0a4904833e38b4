"""Monte Carlo studies: how accurate plans, models and estimators are, by simulation.

A study is a grid of arms x plans x runs x sigma x truths x models; each combination is a cell. Plans come first, then
blocks of replications, both as resumable tables; then cells from blocks. One block: simulate, fit all data sets at
once, and keep a few numbers per parameter.

A spatial arm's errors can be distinguished only in part. A minimal set of them is fitted, without a prior, and compared
with the values of this set that put the measured points where all of the simulated errors together do. Every measured
point, or frame, is measured at every posture.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import polars as pl
from pydantic import Field

from doe.jobs import Key, Row, Workers, canonical, parquet, run_tasks, short_hash, tables, with_columns
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers import SOLVERS, solve
from identification import (
    PRISMATIC,
    REVOLUTE,
    Arm,
    Array,
    Calibration,
    Conditions,
    InputError,
    JobError,
    Measurements,
    Model,
    Plan,
    Progress,
    arm_from_tables,
    dump_arm,
    estimate_batch,
    estimate_each,
    library,
    load_arm,
    load_plan,
    nearest,
    silent,
    with_points,
    without_prior,
)
from identification.files.io import named_file, read_toml, write_together
from identification.files.schema import StrictTable, validated
from identification.information import covariances, spectrum
from identification.kinematics.counting import in_columns, in_joints

CELL = ("arm", "plan", "runs", "sigma_mm", "truth", "model")  # the columns that identify a cell
DFT, RANDOM = "dft", "random"
PLANS, BLOCKS, CELLS = "plans.parquet", "blocks.parquet", "cells.parquet"
MOST_ROWS = 4_000_000  # of one plan at a time: 64 MB of positions


# -- what is asked for -------------------------------------------------------------------------------------------------
class ModelTable(StrictTable):
    """`[[models]]`: what the fit estimates besides the geometry."""

    name: str
    effects: list[dict[str, Any]] | None = None  # as [[effects]] of an arm file; left out: the arm's own

    def of(self, arm: Arm) -> Arm:
        """The arm as the fit knows it: nominal."""
        return replace(self._described(arm, None), calibration=None)

    def _described(self, arm: Arm, calibration: dict[str, Any] | None) -> Arm:
        """The arm with these effects and this calibration, as its file would say it."""
        bare = replace(arm, effects=arm.effects if self.effects is None else (), calibration=None)
        more = {"effects": self.effects, "calibration": calibration}
        tables = tomllib.loads(dump_arm(bare)) | {key: value for key, value in more.items() if value is not None}
        described = arm_from_tables(tables)
        return replace(arm, effects=described.effects, calibration=described.calibration)


class TruthTable(ModelTable):
    """`[[truths]]`: what is really there; what is left out is as in the arm's own calibration and effects."""

    length_errors_mm: list[float] | None = None
    joint_offsets_deg: list[float] | None = None
    values: dict[str, float] | None = None  # as calibration.values of a spatial arm

    def of(self, arm: Arm) -> Arm:
        """The true arm. Raises `InputError` for errors and effects that the arm cannot have."""
        own = tomllib.loads(dump_arm(arm)).get("calibration", {})
        errors: dict[str, Any] = {"values": {}}
        if arm.chain.planar:
            errors = {"length_errors_mm": [0.0] * arm.links, "joint_offsets_deg": [0.0] * arm.links}
        kept = ("base", "tools", *errors, *(("effects",) if self.effects is None else ()))
        given = self.model_dump(exclude={"name", "effects"}, exclude_none=True)
        true = self._described(arm, errors | {key: own[key] for key in kept if key in own} | given)
        assert true.calibration is not None
        return replace(true, calibration=Calibration(true.calibration.values))


NotEmpty = Field(min_length=1)


class StudyFile(StrictTable):
    """The whole file: names of arm files; names of solvers, "dft", "random" or plan files; runs and sigma, left out: of
    the plan files, and of the arms; replications of a cell, `block` of them in a task."""

    arms: Annotated[list[str], NotEmpty]
    plans: Annotated[list[str], NotEmpty]
    runs: list[Annotated[int, Field(ge=1, le=100_000)]] = Field(default=[])
    sigma_mm: Annotated[list[Annotated[float, Field(gt=0)]], NotEmpty] | None = None
    replications: Annotated[int, Field(ge=1, le=1_000_000_000)] = 10_000
    block: Annotated[int, Field(ge=1, le=1_000_000)] = 10_000
    solver_seconds: Annotated[float, Field(gt=0)] = 60.0
    truths: list[TruthTable] = Field(default=[TruthTable(name="arm")], min_length=1)
    models: list[ModelTable] = Field(default=[ModelTable(name="arm")], min_length=1)


@dataclass(frozen=True)
class Study:
    """A Monte Carlo study: every combination of arms, plans, and what a study file has besides (`asked`).

    plans : name -> a given plan, whose number of runs is fixed; None: of a solver, "dft" (theta_j = 2 pi i j / m), or
        "random" (a new plan for each replication, uniform over the allowed postures)
    """

    arms: Sequence[Arm]
    plans: Mapping[str, Plan | None]
    asked: StudyFile

    @classmethod
    def of(cls, arms: Sequence[Arm], plans: Sequence[str] | Mapping[str, Plan | None], **others: Any) -> Study:
        """others : as in a study file, `runs`, `sigma_mm`, ... Raises `InputError` for all that can be said before work
        starts."""
        plans = plans if isinstance(plans, Mapping) else dict.fromkeys(plans)
        asked = validated(StudyFile, {"arms": [arm.name for arm in arms], "plans": [*plans], **others})
        spatial = [arm if arm.chain.planar else replace(arm, chain=with_points(arm.chain)) for arm in arms]
        for what in ("arms", "truths", "models"):
            names = [getattr(entry, "name", entry) for entry in getattr(asked, what)]
            if len(set(names)) < len(names):
                raise InputError(f"{what}: name {max(names, key=names.count)!r} is given twice, allowed: once")
        if asked.replications / asked.block > (most_tasks := 100_000):  # of a cell: each is a row of a table
            least = f"at least {-(-asked.replications // most_tasks)} for {asked.replications} replications"
            raise InputError(f"block: found {asked.block}, allowed: {least}")
        known = {*SOLVERS, DFT, RANDOM}
        for name, plan in plans.items():
            if plan is None and name not in known:
                raise InputError(f"plans: unknown {name!r}, {nearest(name, known)}, or NAME.csv")
            if plan is None and not asked.runs:
                raise InputError(f"runs: is missing, allowed: whole numbers >= 1, as plan {name!r} needs them")
        needs = []  # runs of each fit; where one can be done, the others are rows that say why there is nothing
        for arm in spatial:
            if arm.sigma is None and asked.sigma_mm is None:
                raise InputError(f"sigma_mm: is missing, allowed: numbers > 0 [mm], as arm {arm.name} has none")
            for name, plan in plans.items():
                if plan is not None and plan.links != arm.links:
                    raise InputError(f"plans: {name} has {plan.links} joints, allowed: {arm.links} as arm {arm.name}")
            for what, entry in [*(("truths", one) for one in asked.truths), *(("models", one) for one in asked.models)]:
                try:
                    model = _checked(entry, arm)
                except InputError as error:
                    raise InputError(f"{what}: {entry.name} with arm {arm.name}: {error}") from None
                if what == "models":
                    needs.append(-(-len(model.names) // (model.dimension * points(model))))
        most = max(runs for plan in plans.values() for runs in (asked.runs if plan is None else [len(plan)]))
        if most < min(needs):
            raise InputError(f"runs: found {most}, allowed: at least {min(needs)}, an equation for every parameter")
        return cls(spatial, plans, asked)


def _checked(entry: ModelTable, arm: Arm) -> Model:
    """What is fitted. Raises `InputError` where the arm cannot have the entry, or it cannot be simulated."""
    described = entry.of(arm)
    model = Model(without_prior(described))
    _ = model.symbols  # raises for an effect that needs what the arm does not have
    for spec in described.effects if isinstance(entry, TruthTable) else ():
        if library()[spec.name].scatter and (entry.effects is not None or spec.values):
            raise InputError(f"{spec.key}, which changes the scatter, is not simulated, allowed: other effects")
    if "temperature" in model.needs:
        raise InputError("needs temperatures, allowed: effects without them")
    return model


def points(model: Model) -> int:
    """Number of measured points, each a row at every posture."""
    return len(model.arm.chain.tools)


def load_study(path: Path | str, replications: int | None = None) -> Study:
    """The study that a TOML file describes; names of files in it are beside it.

    Its keys: identification/files/README.md, "Study file".  replications : instead of the file's

    Raises `InputError`, one line naming file, key, what was found and what is allowed.
    """
    content = read_toml(path) | ({} if replications is None else {"replications": replications})
    try:
        file = validated(StudyFile, content)

        def beside(name: str, key: str) -> Path:
            return named_file(Path(path).parent, name, key, whose="the study file")

        arms = [load_arm(beside(name, "arms")) for name in file.arms]
        given = [name for name in file.plans if name.endswith(".csv")]
        if given and any(arm.counting != arms[0].counting for arm in arms):
            raise InputError("plans: found files for arms with different [joints], allowed: the same in all arms")
        kinds = arms[0].joint_types if arms[0].counting is not None else None
        plans = {name: load_plan(beside(name, "plans"), kinds) if name in given else None for name in file.plans}
        return Study.of(arms, plans, **{key: value for key, value in content.items() if key not in ("arms", "plans")})
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


# -- the run -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class StudyResult:
    """What a study found."""

    cells: pl.DataFrame  # one row per cell and parameter, see `pooled_rows`
    blocks: pl.DataFrame  # one row per block of replications and parameter
    plans: pl.DataFrame  # one row per plan that a solver made

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
    arms = {short_hash(text): text for text in map(dump_arm, study.arms)}
    solvers = [name for name, plan in study.plans.items() if plan is None and name not in (DFT, RANDOM)]
    keys: list[Key] = [
        {"arm": arm.name, "plan": plan, "runs": runs, "limit_s": study.asked.solver_seconds, "inputs": digest}
        for (arm, digest), plan, runs in product(zip(study.arms, arms, strict=True), solvers, study.asked.runs)
    ]
    run = partial(run_tasks, workers=workers, seed=seed, progress=progress)
    with tables(folder, PLANS, BLOCKS, resume=resume, force=force) as (of_plans, of_blocks):
        plans = run(make_plan, keys, of_plans, payload=lambda key: arms[key["inputs"]])
        tasks = {canonical(key): (key, cell) for key, cell in _tasks(study, plans)}
        asked = [key for key, _ in tasks.values()]
        blocks = run(replicate, asked, of_blocks, payload=lambda key: tasks[canonical(key)][1])
        cells = pooled_rows(blocks)
        if folder is not None:
            write_together({Path(folder) / CELLS: parquet(cells)}, force=True)
    return StudyResult(cells, blocks, plans)


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
    inside = np.all((postures >= arm.lower) & (postures <= arm.upper), axis=1)
    outside = np.flatnonzero(~(inside & DesignProblem.of(Model(arm)).feasible(postures)))
    return f"plan dft: posture {outside[0] + 1} is outside the limits or a constraint" if outside.size else postures


def in_file_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """Postures [rad, mm] as files have them, in degrees, of prismatic joints in millimetres."""
    columns = in_columns(postures, joint_types)
    return np.where(np.array(joint_types) == REVOLUTE, np.degrees(columns), columns)


def in_api_units(postures: Array, joint_types: tuple[str, ...]) -> Array:
    """The reverse of `in_file_units`."""
    return in_joints(np.where(np.array(joint_types) == PRISMATIC, postures, np.radians(postures)), joint_types)


# what a block of replications needs: arm files' texts of the arm as the fit knows it and as it really is, the plan
# (m, n), None: a new random plan for each replication, runs, sigma
Cell = tuple[str, str, Array | None, int, float]


def _tasks(study: Study, made: pl.DataFrame) -> Iterator[tuple[Key, Cell | str]]:
    """Key and payload of every block; a cell that cannot be simulated has one block, whose row says why."""
    rows = {(row["arm"], row["plan"], row["runs"]): row for row in made.iter_rows(named=True)}
    asked = study.asked
    whole, rest = divmod(asked.replications, asked.block)
    blocks = [asked.block] * whole + [rest] * (rest > 0)
    for arm, (name, plan) in product(study.arms, study.plans.items()):
        for runs in asked.runs if plan is None else [len(plan)]:
            row = rows.get((arm.name, name, runs), {})
            if plan is not None:
                postures: Array | str | None = plan.postures
            elif name == DFT:
                postures = _dft(arm, runs)
            elif row.get("status") == "done":
                postures = in_api_units(np.array(row["postures_deg"]), arm.joint_types)
            else:
                postures = None if name == RANDOM else f"no plan: {row['error']}"
            for sigma, truth, model in product(asked.sigma_mm or [arm.sigma or 0.0], asked.truths, asked.models):
                texts, degrees = (dump_arm(model.of(arm)), dump_arm(truth.of(arm))), None
                if isinstance(postures, np.ndarray):
                    degrees = tuple(map(tuple, in_file_units(postures, arm.joint_types).tolist()))
                cell = postures if isinstance(postures, str) else (*texts, postures, runs, float(sigma))
                key = dict(zip(CELL, (arm.name, name, runs, sigma, truth.name, model.name), strict=True))
                key["inputs"] = short_hash(repr((texts, degrees)))
                for number, size in enumerate([asked.replications] if isinstance(cell, str) else blocks):
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
def rows_of(truth: Model, postures: Array, remembers: bool = False) -> tuple[Array, Conditions]:
    """(..., m P, n) a posture for each row of plans (..., m, n), and conditions of the rows in their order, with the
    orientations of the true arm.

    remembers : with the past of the joints
    """
    count = points(truth)
    rows = np.repeat(postures, count, axis=-2)
    conditions = Conditions.in_order(rows, remembers or truth.remembers)
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


@lru_cache(maxsize=4)
def prepared(arm: str, truth: str) -> tuple[Model, Model, Array, Array]:
    """What is fitted (of a spatial arm a minimal set of parameters), what is simulated, (p,) true values of the fitted
    parameters, and (p + n, p) from them to those that are reported: themselves, and in the plane the orientation
    offsets. Kept, so that all blocks of a cell on one worker use one model."""
    fitted, real = (arm_from_tables(tomllib.loads(text)) for text in (arm, truth))
    model, true_model = Model(without_prior(fitted)), Model(real)
    transform = np.eye(len(model.names))
    if model.arm.chain.planar:
        transform = np.vstack([transform, model.parameters.to_orientations])
    return model, true_model, true_values(model, true_model), transform


def fits_of(cell: Cell, generator: np.random.Generator, total: int) -> tuple[Array, Array, Array]:
    """Parameters (K, p) of fits of K data sets, not numbers where one failed, sums of squares (K,) [mm^2], and
    deviations (K, p + n) by eq. 16 at the true values, of one plan (1, p + n), API units."""
    arm, true_arm, given, runs, sigma = cell
    model, truth, values, transform = prepared(arm, true_arm)
    rows, problem = runs * points(model), DesignProblem.of(model)
    # data sets that go through memory together: of random plans rows whose arrays stay in the processor's cache
    size = max(1, (20_000 if given is None else MOST_ROWS) // rows)
    parts: list[Any] = []
    if given is not None:
        plan = plan_of(truth, given)
        exact = truth.position(plan.postures, conditions=plan.conditions)
        jacobian = model.jacobian(plan.postures, values, plan.conditions)
        matrices = sigma**2 * spectrum(jacobian, model.scales).covariance[None]
    for count in (min(size, total - start) for start in range(0, total, size)):
        if given is not None:
            positions = sigma * generator.standard_normal((count, rows, model.dimension))
            positions += exact
            fits = estimate_batch(model, plan, positions)
            parts.append((np.where(fits.converged[:, None], fits.parameters, np.nan), np.array(fits.rss)))
            continue
        postures = random_postures(problem, count * runs, generator).reshape(count, runs, -1)
        noise = sigma * generator.standard_normal((count, rows, model.dimension))
        every, conditions = rows_of(truth, postures, model.remembers)
        fits = estimate_each(model, every, truth.position(every, conditions=conditions) + noise, conditions)
        matrices = covariances(model.jacobian(every, values, conditions), model.scales, sigma)
        parts.append((fits.parameters, fits.rss, matrices))
    parameters, rss, *of_each = map(np.concatenate, zip(*parts, strict=True))
    [matrices] = of_each or [matrices]
    return parameters, rss, np.sqrt(np.sum((transform @ matrices) * transform, axis=-1))


def replicate(key: dict[str, Any], seed: np.random.SeedSequence, cell: Cell | str) -> list[Row]:
    """Rows of one block: per reported parameter the number of fits, mean error, sum of squares about it, coverage, in
    file units (mm and degrees).

    cell : what to simulate, or the reason why it cannot be simulated (no plan was found)
    """
    if isinstance(cell, str):
        raise JobError(cell)
    model, _, values, transform = prepared(*cell[:2])
    unknowns, runs = len(values), cell[3]
    rows = runs * points(model)
    if (equations := model.dimension * rows) < unknowns:
        raise JobError(f"{runs} runs are {equations} equations, allowed: at least {unknowns}, one per unknown")
    parameters, rss, stds = fits_of(cell, np.random.default_rng(seed), key["replications"])
    good = np.isfinite(np.c_[parameters, rss]).all(axis=1) & np.isfinite(stds).all(axis=1)
    errors = (parameters[good] - values) @ transform.T
    turns = [*model.parameters.joint_offsets.tolist(), *range(unknowns, len(transform))]
    errors[:, turns] = (errors[:, turns] + np.pi) % (2.0 * np.pi) - np.pi  # known up to a whole turn
    stds = stds if len(stds) == 1 else stds[good]
    distances = model.dimension <= 3  # the residuals of orientations are none
    rms = float(np.sqrt(np.mean(rss[good]) / rows)) if len(errors) and distances else None
    fits: Row = {"fits": len(errors), "failed": int(np.sum(~good)), "rms_mm": rms}
    reported = [(p.name, p.file_unit, p.to_file) for p in model.parameters]
    reported += [(f"orientation_offset:{j}", "deg", 180.0 / np.pi) for j in range(1, len(transform) - unknowns + 1)]
    block = []
    for (name, unit, factor), error, std in zip(reported, errors.T, stds.T, strict=True):
        row: Row = {"parameter": name, "unit": unit, **fits, "mean_error": None, "squares": None}
        if error.size:
            mean = float(np.mean(error * factor))
            row |= {"mean_error": mean, "squares": float(np.sum((error * factor - mean) ** 2))}
        row["covered"] = int(np.sum(np.abs(error) <= 1.959963984540054 * std))  # two-sided 95 % of the normal
        row["expected_std"] = float(np.sqrt(np.mean((std * factor) ** 2))) if error.size else None
        block.append(row)
    return block
