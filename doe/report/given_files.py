"""The files of a campaign, whichever are given: arms, plans, measurements, and output of commands with --json."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from doe.plan.file import load_plan
from doe.plan.plan import Plan
from identification.arm import Arm
from identification.errors import InputError
from identification.files.arm import load_arm
from identification.files.csv import Table, read_table
from identification.files.io import read_text
from identification.files.measurement import load_measurements
from identification.measurements import Measurements
from identification.validate.reuse import same_drawing

# a command -> keys that its JSON object alone has
KEYS = {
    "diagnose": ("verdict", "candidates", "gap", "trials"),
    "validate": ("refit", "rows", "rms_nominal_mm"),
    "identify": ("parameters", "rms_before_mm", "rms_after_mm"),
    "design": ("criterion", "runs", "efficiency", "certified_optimal"),
}
ALLOWED = (
    "arm files (.toml), plans, measurements and joint commands (.csv), what design, score, identify, diagnose or "
    "validate --json said"
)


@dataclass(frozen=True)
class Given:
    """Name -> content of the files of each kind, in the order given.

    said : command -> name -> its JSON object;  kinds : of every file, in words
    """

    arms: dict[str, Arm] = field(default_factory=dict)
    plans: dict[str, tuple[Plan, Table]] = field(default_factory=dict)
    measurements: dict[str, Measurements] = field(default_factory=dict)
    commands: dict[str, Table] = field(default_factory=dict)
    said: dict[str, dict[str, Mapping[str, Any]]] = field(default_factory=lambda: {command: {} for command in KEYS})
    kinds: dict[str, str] = field(default_factory=dict)

    @property
    def calibrated(self) -> dict[str, Arm]:
        """The arms that have a calibration."""
        return {name: arm for name, arm in self.arms.items() if arm.calibration is not None}


def read_given(paths: Sequence[Path]) -> Given:
    """Every file by its kind; tables are those of the first arm.

    Raises `InputError` for a file of another kind, one given twice, and a table without an arm file.
    """
    found = Given()
    for path in sorted(paths, key=lambda path: path.suffix.lower() != ".toml"):  # tables are read by the arm
        name = str(path)
        if name in found.kinds:
            raise InputError(f"{name}: is given twice, allowed: each file once")
        found.kinds[name] = _read(path, name, found)
    return found


def _read(path: Path, name: str, found: Given) -> str:
    """Read a file into `found` and return its kind."""
    ending = path.suffix.lower()
    if ending == ".toml":
        found.arms[name] = arm = load_arm(path)
        first, other = next(iter(found.arms.items()))
        if not same_drawing(other, arm):
            raise InputError(f"{name}: another arm than that of {first}, allowed: files of one arm")
        return "arm with a calibration" if found.arms[name].calibration is not None else "arm"
    if ending == ".json":
        command, data = said_by(path)
        found.said[command][name] = data
        return f"armcal {command} --json"
    if ending not in (".csv", ".tsv", ".txt"):
        raise InputError(f"{name}: ending {path.suffix!r}, allowed: {ALLOWED}")
    if not found.arms:
        raise InputError(f"{name}: a table without its arm, allowed: the arm file (.toml) beside it")
    arm = next(iter(found.arms.values()))
    table = read_table(path)
    if all(column in table for column in ("error_mm", "reachable")):
        found.commands[name] = table
        return "joint commands"
    contact = arm.chain is not None and arm.chain.instrument.contact  # its plans no command writes
    if contact or any(f"{name}_{unit}" in table for name in ("x", "distance") for unit in ("mm", "m")):
        found.measurements[name] = load_measurements(path, arm)
        return "measurements"
    found.plans[name] = load_plan(path, arm.joint_types), table
    return "plan"


def said_by(path: Path) -> tuple[str, Mapping[str, Any]]:
    """The command that wrote a JSON file, and its object. Raises `InputError` for any other file."""
    try:
        data = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {error}, allowed: what a command said with --json") from None
    if isinstance(data, dict):
        for command, keys in KEYS.items():
            if all(key in data for key in keys):
                return command, data
    raise InputError(f"{path}: JSON of no command that is known here, allowed: {ALLOWED}")
