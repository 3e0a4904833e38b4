"""The TOML file that describes a study."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doe.plan.file import load_plan
from doe.studies.monte_carlo.schema import StudyFile, parse_study
from doe.studies.monte_carlo.specification import Fitted, Study, Truth
from identification.arm import Arm, EffectSpec
from identification.errors import InputError
from identification.files.arm import arm_from_tables, load_arm
from identification.files.io import PathLike, read_toml


def load_study(path: PathLike) -> Study:
    """The study that a TOML file describes; names of files in it are beside it.

    Its keys: identification/files/README.md, "Study file".

    Raises `InputError`, one line naming file, key, what was found and what is allowed.
    """
    tables = read_toml(path)
    folder = Path(path).parent
    try:
        file = parse_study(tables)
        arms = [load_arm(folder / name) for name in file.arms]
        plans = [(name, load_plan(folder / name)) if name.endswith(".csv") else name for name in file.plans]
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


def _truths(file: StudyFile, arms: Sequence[Arm]) -> Sequence[Truth]:
    if file.truths is None:
        return (Truth(),)
    return [
        Truth(
            table.name,
            table.length_errors_mm,
            None if table.joint_offsets_deg is None else np.radians(table.joint_offsets_deg).tolist(),
            None if table.effects is None else _effects(f"truths[{k}]", table.effects, arms),
        )
        for k, table in enumerate(file.truths, start=1)
    ]


def _models(file: StudyFile, arms: Sequence[Arm]) -> Sequence[Fitted]:
    if file.models is None:
        return (Fitted(),)
    entries = enumerate(file.models, start=1)
    return [Fitted(table.name, _effects(f"models[{k}]", table.effects, arms)) for k, table in entries]


def _effects(place: str, entries: list[dict[str, Any]], arms: Sequence[Arm]) -> tuple[EffectSpec, ...]:
    """Entries as under `[[effects]]` of an arm file, which every arm of the study must be able to have."""
    try:
        found = [arm_from_tables({"links_mm": arm.lengths.tolist(), "effects": entries}).effects for arm in arms]
    except InputError as error:
        raise InputError(f"{place}.{error}") from None
    return found[0]
