"""The TOML file that describes a study: its keys, what each allows, and the `Study` it becomes.

The description of a field is the end of its error message.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from doe.plan.file import load_plan
from doe.studies.monte_carlo.spatial import simulated
from doe.studies.monte_carlo.specification import MOST_BLOCK, MOST_REPLICATIONS, MOST_RUNS, Fitted, Study, Truth
from identification.arm import Arm, EffectSpec
from identification.errors import InputError, nearest
from identification.files.arm import arm_from_tables, load_arm
from identification.files.arm_text import dump_arm
from identification.files.io import PathLike, named_file, read_toml
from identification.kinematics.counting import JointKinds

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class TruthTable(_Table):
    """`[[truths]]`: what is really there."""

    name: str = Field(description="a text")
    length_errors_mm: list[float] | None = Field(None, description="one number [mm] for each link")
    joint_offsets_deg: list[float] | None = Field(None, description="one angle [deg] for each link")
    effects: list[dict[str, Any]] | None = Field(None, description="tables as [[effects]] of an arm file, with values")
    values: dict[str, float] | None = Field(None, description="a table of numbers [mm, deg], as calibration.values")


class ModelTable(_Table):
    """`[[models]]`: what the fit estimates besides the geometry."""

    name: str = Field(description="a text")
    effects: list[dict[str, Any]] = Field(description="tables as [[effects]] of an arm file")


class StudyFile(_Table):
    """The whole file."""

    arms: list[str] = Field(min_length=1, description="names of arm files, at least one")
    plans: list[str] = Field(min_length=1, description="names of solvers, 'dft', 'random' or plan files, at least one")
    runs: list[Annotated[Count, Field(le=MOST_RUNS)]] = Field(
        default_factory=list, description=f"whole numbers >= 1, at most {MOST_RUNS:,}"
    )
    sigma_mm: list[Positive] | None = Field(
        None, min_length=1, description="numbers > 0 [mm], at least one; left out: the arm's own"
    )
    replications: Annotated[Count, Field(le=MOST_REPLICATIONS)] = Field(
        10_000, description=f"a whole number >= 1, at most {MOST_REPLICATIONS:,}"
    )
    block: Annotated[Count, Field(le=MOST_BLOCK)] = Field(
        10_000, description=f"a whole number >= 1, at most {MOST_BLOCK:,}: replications per task"
    )
    solver_seconds: Positive = Field(60.0, description="a number > 0 [s]")
    truths: list[TruthTable] | None = Field(None, min_length=1, description="tables [[truths]], at least one")
    models: list[ModelTable] | None = Field(None, min_length=1, description="tables [[models]], at least one")


_TABLES: dict[str, type[BaseModel]] = {"": StudyFile, "truths": TruthTable, "models": ModelTable}


def parse_study(tables: dict[str, Any]) -> StudyFile:
    """The tables of a study file, checked. Raises `InputError` naming key, what was found and what is allowed."""
    try:
        return StudyFile.model_validate(tables)
    except ValidationError as error:
        details = error.errors(include_url=False)
        # a misspelt key is both unknown and missing: the first of the two says more
        raise InputError(_sentence(min(details, key=lambda detail: detail["type"] != "extra_forbidden"))) from None


def _sentence(detail: Any) -> str:
    loc = detail["loc"]
    key = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in loc).removeprefix(".")
    fields = _TABLES[str(loc[0]) if len(loc) > 2 and loc[0] in _TABLES else ""].model_fields
    if detail["type"] == "extra_forbidden":
        return f"{key}: unknown key, {nearest(str(loc[-1]), fields)}"
    name = next((str(part) for part in reversed(loc) if part in fields), None)
    allowed = "a table" if name is None else fields[name].description
    found = "is missing" if detail["type"] == "missing" else f"found {_shown(detail['input'])}"
    return f"{key}: {found}, allowed: {allowed}"


def _shown(value: Any) -> str:
    text = "a table" if isinstance(value, dict) else str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def load_study(path: PathLike) -> Study:
    """The study that a TOML file describes; names of files in it are beside it.

    Its keys: identification/files/README.md, "Study file".

    Raises `InputError`, one line naming file, key, what was found and what is allowed.
    """
    tables = read_toml(path)
    folder = Path(path).parent
    try:
        file = parse_study(tables)
        arms = [load_arm(_beside(folder, name, "arms")) for name in file.arms]
        kinds = _kinds_of_plans(arms) if any(name.endswith(".csv") for name in file.plans) else None
        plans = [
            (name, load_plan(_beside(folder, name, "plans"), kinds)) if name.endswith(".csv") else name
            for name in file.plans
        ]
        return Study(
            arms,
            plans,
            file.runs,
            file.sigma_mm or (),
            _truths(file, arms),
            _models(file, arms),
            file.replications,
            file.block,
            file.solver_seconds,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _kinds_of_plans(arms: Sequence[Arm]) -> JointKinds | None:
    """How the columns of plans are counted, None: as the model's joints. Raises `InputError` for arms that differ."""
    if any(arm.counting != arms[0].counting for arm in arms):
        raise InputError("plans: found files for arms with different [joints], allowed: the same in all arms")
    return arms[0].joint_types if arms[0].counting is not None else None


_beside = partial(named_file, whose="the study file")


def _truths(file: StudyFile, arms: Sequence[Arm]) -> Sequence[Truth]:
    if file.truths is None:
        return (Truth(),)
    return [
        Truth(
            table.name,
            table.length_errors_mm,
            None if table.joint_offsets_deg is None else np.radians(table.joint_offsets_deg).tolist(),
            None if table.effects is None else _effects(f"truths[{k}]", table.effects, arms),
            None if table.values is None else _values(f"truths[{k}]", table.values, arms),
        )
        for k, table in enumerate(file.truths, start=1)
    ]


def _values(place: str, entries: Mapping[str, float], arms: Sequence[Arm]) -> dict[str, float]:
    """Errors of a spatial arm's geometry, from file to API units, which every arm must have in common."""
    found: list[dict[str, float]] = []
    for arm in arms:
        if arm.chain is None:
            raise InputError(f"{place}.values: arm {arm.name} is planar, allowed: spatial arms")
        factors = {p.name: p.to_file for p in arm.chain.parameters()}
        for name in entries:
            if name not in factors:
                raise InputError(f"{place}.values: unknown parameter {name!r}, {nearest(name, factors)}")
        found.append({name: value / factors[name] for name, value in entries.items()})
    if any(values != found[0] for values in found):
        raise InputError(f"{place}.values: turning and sliding joints of these arms differ, allowed: a study for each")
    return found[0]


def _models(file: StudyFile, arms: Sequence[Arm]) -> Sequence[Fitted]:
    if file.models is None:
        return (Fitted(),)
    entries = enumerate(file.models, start=1)
    return [Fitted(table.name, _effects(f"models[{k}]", table.effects, arms)) for k, table in entries]


def _effects(place: str, entries: list[dict[str, Any]], arms: Sequence[Arm]) -> tuple[EffectSpec, ...]:
    """Entries as under `[[effects]]` of an arm file, which every arm of the study must be able to have."""
    try:
        found = [arm_from_tables({**_tables(arm), "effects": entries}).effects for arm in arms]
    except InputError as error:
        raise InputError(f"{place}.{error}") from None
    return found[0]


def _tables(arm: Arm) -> dict[str, Any]:
    """Of an arm file of the arm without effects."""
    return tomllib.loads(dump_arm(replace(simulated(arm), effects=(), calibration=None)))
