"""What a study asks for: a grid of arms x plans x runs x sigma x truths x models; each combination is a cell.

The TOML file that describes a study: its keys, what each allows, and the `Study` it becomes.

The description of a field is the end of its error message.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from doe.plan.plan import Plan, load_plan
from doe.solvers import SOLVERS
from identification import (
    GEOMETRY,
    Arm,
    Calibration,
    EffectSpec,
    InputError,
    Model,
    arm_from_tables,
    dump_arm,
    library,
    load_arm,
    nearest,
    readonly,
    with_points,
    without_prior,
)
from identification.files.io import named_file, read_toml
from identification.files.schema import StrictTable, validated

CELL = ("arm", "plan", "runs", "sigma_mm", "truth", "model")  # the columns that identify a cell
DFT, RANDOM = "dft", "random"
MOST_RUNS, MOST_REPLICATIONS, MOST_BLOCK = 100_000, 1_000_000_000, 1_000_000  # of a cell, a cell, and a task
MOST_TASKS = 100_000  # of a cell: each is a row of a table


def simulated(arm: Arm) -> Arm:
    """The arm with its measured points in place; a planar arm as it is."""
    return arm if arm.chain.planar else replace(arm, chain=with_points(arm.chain))


def points(model: Model) -> int:
    """Number of measured points, each a row at every posture."""
    return len(model.arm.chain.tools)


@dataclass(frozen=True)
class Truth:
    """What is really there. None: as in the arm's own calibration and effects.

    length_errors : (n,) [mm];  joint_offsets : (n,) [rad], of planar arms
    values : parameter name -> error [API units], of spatial arms;  effects : with values
    """

    name: str = "arm"
    length_errors: Sequence[float] | None = None
    joint_offsets: Sequence[float] | None = None
    effects: tuple[EffectSpec, ...] | None = None
    values: Mapping[str, float] | None = None

    def of(self, arm: Arm) -> Arm:
        """The true arm. Raises `InputError` for errors that the arm does not have, and if they are not one for each
        link."""
        calibration = self._planar(arm) if arm.chain.planar else self._spatial(arm)
        if self.effects is None:
            effects = {} if arm.calibration is None else arm.calibration.effects
            return replace(arm, calibration=replace(calibration, values={**calibration.values, **effects}))
        return replace(arm, effects=self.effects, calibration=calibration)

    def _planar(self, arm: Arm) -> Calibration:
        if self.values is not None:
            raise InputError("values: found for a planar arm, allowed: length_errors_mm and joint_offsets_deg")
        before = arm.calibration or Calibration.of(np.zeros(arm.links), np.zeros(arm.links))
        lengths = before.length_errors if self.length_errors is None else readonly(self.length_errors)
        offsets = before.joint_offsets if self.joint_offsets is None else readonly(self.joint_offsets)
        for name, values in (("length_errors_mm", lengths), ("joint_offsets_deg", offsets)):
            if values.size != arm.links:
                raise InputError(f"{name}: found {values.size} values for {arm.links} links, allowed: {arm.links}")
        return Calibration.of(lengths, offsets)

    def _spatial(self, arm: Arm) -> Calibration:
        for name, errors in (("length_errors_mm", self.length_errors), ("joint_offsets_deg", self.joint_offsets)):
            if errors is not None:
                raise InputError(f'{name}: found for a spatial arm, allowed: values = {{"translation_x:2" = 0.5}}')
        before = {} if arm.calibration is None else arm.calibration.values
        geometry = {name: value for name, value in before.items() if GEOMETRY.fullmatch(name)}
        values = geometry if self.values is None else self.values
        allowed = arm.chain.parameters().names if not arm.chain.planar else ()
        for name in values:
            if name not in allowed:
                raise InputError(f"values: unknown parameter {name!r}, {nearest(name, allowed)}")
        return Calibration(values)


@dataclass(frozen=True)
class Fitted:
    """What the fit estimates besides the geometry. None: the arm's own effects."""

    name: str = "arm"
    effects: tuple[EffectSpec, ...] | None = None

    def of(self, arm: Arm) -> Arm:
        """The arm as the fit knows it: nominal."""
        return replace(arm, effects=arm.effects if self.effects is None else self.effects, calibration=None)


@dataclass(frozen=True)
class Study:
    """A Monte Carlo study.

    arms : nominal arms;  runs : numbers of measurements m
    plans : solver names, "dft" (theta_j = 2 pi i j / m), "random" (a new plan for each replication, uniform
        over the allowed postures), or given plans, whose number of runs is fixed
    sigma : standard deviations of the measurement [mm], empty: each arm's own
    truths, models : what is simulated, and what is fitted
    replications : simulated data sets of each cell, done `block` at a time
    solver_seconds : time limit of a solver [s]
    """

    arms: Sequence[Arm]
    plans: Sequence[str | tuple[str, Plan]]
    runs: Sequence[int] = ()
    sigma: Sequence[float] = ()
    truths: Sequence[Truth] = (Truth(),)
    models: Sequence[Fitted] = (Fitted(),)
    replications: int = 10_000
    block: int = 10_000
    solver_seconds: float = 60.0

    def __post_init__(self) -> None:
        """The same limits as in a file, for those who write Python, and all that can be said before work starts."""
        object.__setattr__(self, "arms", [simulated(arm) for arm in self.arms])
        self._check_plans()
        for what, entries in (("truths", self.truths), ("models", self.models), ("arms", self.arms)):
            names = [entry.name for entry in entries]
            if len(set(names)) < len(names):
                raise InputError(f"{what}: name {max(names, key=names.count)!r} is given twice, allowed: once")
        counts = [("replications", self.replications, MOST_REPLICATIONS), ("block", self.block, MOST_BLOCK)]
        for name, value, most in [*counts, *(("runs", runs, MOST_RUNS) for runs in self.runs)]:
            if not (isinstance(value, int | np.integer) and 1 <= value <= most):
                raise InputError(f"{name}: found {value!r}, allowed: a whole number >= 1, at most {most:,}")
        for sigma in self.sigma:
            if not 0.0 < sigma < np.inf:
                raise InputError(f"sigma_mm: found {sigma!r}, allowed: numbers > 0 [mm]")
        if self.replications / self.block > MOST_TASKS:
            least = f"at least {-(-self.replications // MOST_TASKS)} for {self.replications} replications"
            raise InputError(f"block: found {self.block}, allowed: {least}")
        for arm in self.arms:
            if arm.sigma is None and not self.sigma:
                raise InputError(f"sigma_mm: is missing, allowed: numbers > 0 [mm], as arm {arm.name} has none")
            for truth in self.truths:
                _check_entry("truths", truth, arm)
            for fitted in self.models:
                _check_entry("models", fitted, arm)
            for plan in self.plans:
                if not isinstance(plan, str) and plan[1].links != arm.links:
                    allowed = f"{arm.links} as arm {arm.name}"
                    raise InputError(f"plans: {plan[0]} has {plan[1].links} joints, allowed: {allowed}")
        self._check_runs()

    def _check_plans(self) -> None:
        allowed = {*SOLVERS, DFT, RANDOM}
        for plan in self.plans:
            if isinstance(plan, str) and plan not in allowed:
                raise InputError(f"plans: unknown {plan!r}, {nearest(plan, allowed)}, or NAME.csv")
            if isinstance(plan, str) and not self.runs:
                raise InputError(f"runs: is missing, allowed: whole numbers >= 1, as plan {plan!r} needs them")

    def _check_runs(self) -> None:
        """One cell must have as many equations as unknowns; the others are rows that say why there is nothing."""
        sizes = [size for plan in self.plans for size in (self.runs if isinstance(plan, str) else [len(plan[1])])]
        fitted = [Model(without_prior(entry.of(arm))) for arm in self.arms for entry in self.models]
        needs = [(len(model.names), model.dimension * points(model)) for model in fitted]
        unknowns, each = min(needs, key=lambda pair: pair[0] / pair[1], default=(0, 1))
        if sizes and each * max(sizes) < unknowns:
            allowed = f"at least {-(-unknowns // each)} for {unknowns} parameters"
            raise InputError(f"runs: found {max(sizes)}, allowed: {allowed}")


def _check_entry(what: str, entry: Truth | Fitted, arm: Arm) -> None:
    """Whether this arm can have a truth or a model. Raises `InputError`."""
    place = f"{what}: {entry.name} with arm {arm.name}"
    try:
        model = Model(entry.of(arm))
        _ = model.symbols  # raises for an effect that needs what the arm does not have
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    asked = [spec for spec in model.arm.effects if entry.effects is not None or spec.values]  # those without: not there
    scatters = next((spec for spec in asked if library()[spec.name].scatter), None)
    if what == "truths" and scatters is not None:
        no = f"{scatters.key}, which changes the scatter, is not simulated here"
        raise InputError(f"{place}: {no}, allowed: other effects")
    if "temperature" in model.needs:
        raise InputError(f"{what}: {entry.name} needs temperatures, allowed: effects without them")


# -- files -------------------------------------------------------------------------------------------------------------
Count = Annotated[int, Field(ge=1)]


class TruthTable(StrictTable):
    """`[[truths]]`: what is really there."""

    name: str = Field(description="a text")
    length_errors_mm: list[float] | None = Field(None, description="one number [mm] for each link")
    joint_offsets_deg: list[float] | None = Field(None, description="one angle [deg] for each link")
    effects: list[dict[str, Any]] | None = Field(None, description="tables as [[effects]] of an arm file, with values")
    values: dict[str, float] | None = Field(None, description="a table of numbers [mm, deg], as calibration.values")


class ModelTable(StrictTable):
    """`[[models]]`: what the fit estimates besides the geometry."""

    name: str = Field(description="a text")
    effects: list[dict[str, Any]] = Field(description="tables as [[effects]] of an arm file")


class StudyFile(StrictTable):
    """The whole file."""

    arms: list[str] = Field(min_length=1, description="names of arm files, at least one")
    plans: list[str] = Field(min_length=1, description="names of solvers, 'dft', 'random' or plan files, at least one")
    runs: list[Annotated[Count, Field(le=MOST_RUNS)]] = Field(
        default_factory=list, description=f"whole numbers >= 1, at most {MOST_RUNS:,}"
    )
    sigma_mm: list[Annotated[float, Field(gt=0)]] | None = Field(
        None, min_length=1, description="numbers > 0 [mm], at least one; left out: the arm's own"
    )
    replications: Annotated[Count, Field(le=MOST_REPLICATIONS)] = Field(
        10_000, description=f"a whole number >= 1, at most {MOST_REPLICATIONS:,}"
    )
    block: Annotated[Count, Field(le=MOST_BLOCK)] = Field(
        10_000, description=f"a whole number >= 1, at most {MOST_BLOCK:,}: replications per task"
    )
    solver_seconds: Annotated[float, Field(gt=0)] = Field(60.0, description="a number > 0 [s]")
    truths: list[TruthTable] | None = Field(None, min_length=1, description="tables [[truths]], at least one")
    models: list[ModelTable] | None = Field(None, min_length=1, description="tables [[models]], at least one")


def load_study(path: Path | str) -> Study:
    """The study that a TOML file describes; names of files in it are beside it.

    Its keys: identification/files/README.md, "Study file".

    Raises `InputError`, one line naming file, key, what was found and what is allowed.
    """
    tables = read_toml(path)
    try:
        file = validated(StudyFile, tables)

        def beside(name: str, key: str) -> Path:
            return named_file(Path(path).parent, name, key, whose="the study file")

        arms = [load_arm(beside(name, "arms")) for name in file.arms]
        files = [name for name in file.plans if name.endswith(".csv")]
        if files and any(arm.counting != arms[0].counting for arm in arms):
            raise InputError("plans: found files for arms with different [joints], allowed: the same in all arms")
        kinds = arms[0].joint_types if arms[0].counting is not None else None
        plans = [(name, load_plan(beside(name, "plans"), kinds)) if name in files else name for name in file.plans]
        models: Sequence[Fitted] = (Fitted(),)
        if file.models is not None:
            entries = enumerate(file.models, start=1)
            models = [Fitted(table.name, _effects(f"models[{k}]", table.effects, arms)) for k, table in entries]
        truths = [Truth()]
        if file.truths is not None:
            truths = []
            for k, table in enumerate(file.truths, start=1):
                offsets = None if table.joint_offsets_deg is None else np.radians(table.joint_offsets_deg).tolist()
                effects = None if table.effects is None else _effects(f"truths[{k}]", table.effects, arms)
                values = None if table.values is None else _values(f"truths[{k}].values", table.values, arms)
                truths.append(Truth(table.name, table.length_errors_mm, offsets, effects, values))
        grid = arms, plans, file.runs, file.sigma_mm or (), truths, models
        return Study(*grid, file.replications, file.block, file.solver_seconds)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _values(place: str, entries: Mapping[str, float], arms: Sequence[Arm]) -> dict[str, float]:
    """Errors of a spatial arm's geometry, from file to API units, which every arm must have in common."""
    converted: list[dict[str, float]] = []
    for arm in arms:
        if arm.chain.planar:
            raise InputError(f"{place}: arm {arm.name} is planar, allowed: spatial arms")
        factors = {p.name: p.to_file for p in arm.chain.parameters()}
        for name in entries:
            if name not in factors:
                raise InputError(f"{place}: unknown parameter {name!r}, {nearest(name, factors)}")
        converted.append({name: value / factors[name] for name, value in entries.items()})
    if any(values != converted[0] for values in converted):
        raise InputError(f"{place}: turning and sliding joints of these arms differ, allowed: a study for each")
    return converted[0]


def _effects(place: str, entries: list[dict[str, Any]], arms: Sequence[Arm]) -> tuple[EffectSpec, ...]:
    """Entries as under `[[effects]]` of an arm file, which every arm of the study must be able to have."""
    effects: list[tuple[EffectSpec, ...]] = []
    for arm in arms:
        bare = tomllib.loads(dump_arm(replace(simulated(arm), effects=(), calibration=None)))
        try:
            effects.append(arm_from_tables({**bare, "effects": entries}).effects)
        except InputError as error:
            raise InputError(f"{place}.{error}") from None
    return effects[0]
