"""The TOML file that describes a study: its keys, what each allows, and the `Study` it becomes.

The description of a field is the end of its error message.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from doe.plan.file import load_plan
from doe.studies.monte_carlo.specification import (
    MOST_BLOCK,
    MOST_REPLICATIONS,
    MOST_RUNS,
    Fitted,
    Study,
    Truth,
    simulated,
)
from identification.arm import Arm, EffectSpec
from identification.errors import InputError, nearest
from identification.files.arm import arm_from_tables, load_arm
from identification.files.arm_text import dump_arm
from identification.files.io import PathLike, named_file, read_toml
from identification.files.schema import StrictTable, validated

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


def parse_study(tables: dict[str, Any]) -> StudyFile:
    """The tables of a study file, checked. Raises `InputError` naming key, what was found and what is allowed."""
    return validated(StudyFile, tables)


def load_study(path: PathLike) -> Study:
    """The study that a TOML file describes; names of files in it are beside it.

    Its keys: identification/files/README.md, "Study file".

    Raises `InputError`, one line naming file, key, what was found and what is allowed.
    """
    tables = read_toml(path)
    try:
        file = parse_study(tables)

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
        truths: Sequence[Truth] = (Truth(),)
        if file.truths is not None:
            truths = [_truth(f"truths[{k}]", table, arms) for k, table in enumerate(file.truths, start=1)]
        grid = arms, plans, file.runs, file.sigma_mm or (), truths, models
        return Study(*grid, file.replications, file.block, file.solver_seconds)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _truth(place: str, table: TruthTable, arms: Sequence[Arm]) -> Truth:
    offsets = None if table.joint_offsets_deg is None else np.radians(table.joint_offsets_deg).tolist()
    effects = None if table.effects is None else _effects(place, table.effects, arms)
    values = None if table.values is None else _values(f"{place}.values", table.values, arms)
    return Truth(table.name, table.length_errors_mm, offsets, effects, values)


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
