"""The next postures of an ambiguous diagnosis: as tables, as JSON, and as a plan file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from doe.discrimination.t_optimal import NextPostures
from doe.report.terminal import table
from identification.arm import Arm
from identification.files.measurement_columns import csv_text, posture_columns
from identification.gap.result import Diagnosis
from identification.measurements import Measurements


def next_columns(found: NextPostures) -> dict[str, NDArray[np.generic]]:
    """Columns of the plan file: run, angles, and payload and directions where they matter."""
    columns: dict[str, NDArray[np.generic]] = {"run": np.arange(1, len(found.plan) + 1)}
    columns |= posture_columns(found.plan.postures, found.joint_types or None)
    if found.payload is not None:
        columns["payload_kg"] = found.payload
    if found.directions is not None:
        columns |= {f"direction{j + 1}": column for j, column in enumerate(found.directions.T)}
    return columns


def missing_payload(arm: Arm, measurements: Measurements, found: NextPostures) -> list[str]:
    """What to do before the rows can be appended: data without a payload column mean the arm's own payload."""
    if found.payload is None or measurements.payload is not None or arm.gravity is None:
        return []
    return [f"note: the measured rows need a column payload_kg too: {arm.gravity.payload:g} in each of them"]


def next_text(found: NextPostures) -> str:
    """The plan file; with the measured positions added it is a measurement file."""
    return csv_text(next_columns(found))


def next_data(diagnosis: Diagnosis, found: NextPostures) -> dict[str, Any]:
    """The JSON object of `armcal discriminate`."""
    return {
        "verdict": diagnosis.verdict,
        "candidates": [list(candidate.effects) for candidate in diagnosis.candidates],
        "postures_deg": np.column_stack(list(posture_columns(found.plan.postures, found.joint_types or None).values())),
        "payload_kg": found.payload,
        "directions": found.directions,
        "chance": found.chance,
        "status": found.status.name,
        "pairs": [{"candidate": a, "rival": b, "lambda": size} for (a, b), size in found.pairs.items()],
    }


def next_tables(diagnosis: Diagnosis, found: NextPostures) -> list[Any]:
    """The rivals, the chance, the postures."""
    columns = next_columns(found)
    rows = ([f"{value:g}" for value in row] for row in zip(*columns.values(), strict=True))
    return [Text(diagnosis.sentence), Text(str(found), style="bold"), table(list(columns), rows, "Next postures")]
