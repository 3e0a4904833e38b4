"""Running the blind study.

A simulator that shares no code with the models (plain numpy) draws arm, plan, noise and hidden effects and
hands over what a user has: arm and measurements. What it hid is written to a separate table by separate tasks; the
diagnoses are made and stored without it, and the two tables are joined only for scoring.

Tasks are batches of data sets: keyed, resumable and on any workers, as in every study.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doe.discrimination.design import discrimination_design
from doe.discrimination.t_optimal import discriminate
from doe.jobs.row_table import KEY, Key, Row, canonical, parquet
from doe.jobs.tasks import Job
from doe.jobs.workers import Workers
from doe.problem.problem import DesignProblem
from doe.studies.blind import cells as simulated
from doe.studies.blind import spatial_cells as spatial
from doe.studies.blind.cells import DataSet
from doe.studies.blind.rivals import (
    error,
    fitted_arm,
    has_processes,
    library_gap,
    process_gap,
    share_inside_tip,
    true_arm,
    true_gap,
)
from doe.studies.blind.score import BARS, BlindStudy, contradictions, scored_table
from identification.arm import Arm
from identification.errors import InputError, nearest
from identification.estimation.intervals import quantile_95
from identification.files.io import write_together
from identification.gap.diagnose import diagnose
from identification.gap.result import Diagnosis
from identification.model import Model
from identification.progress import Progress, silent

BATCH = 10  # sets per task
NULL_SETS, SETS = 1000, 400  # data sets per cell, without and with a hidden effect
SPATIAL_SETS = 100  # per cell in space, where a diagnosis takes ten times as long
AMBIGUOUS = "one, lambda 8, m=20"  # the cell whose ambiguous sets are measured further
MANY_SETS = 1200  # in this cell, of which a third are ambiguous, and where ten sets share an arm and its plan
NULLS = tuple(bar.cell for bar in BARS if bar.measure == "alarm")
COMPARED = ("one, lambda 8, m=50", "one, lambda 8, discriminating plan")  # cells whose gap is compared with rivals'
FURTHER_RUNS = (2, 8, 16)  # more postures for an ambiguous set
PLANS, TRUTH, DIAGNOSES = "plans.parquet", "truth.parquet", "diagnoses.parquet"


def blind_study(
    cells: Sequence[str] | None = None,
    count: int | None = None,
    folder: Path | None = None,
    workers: Workers | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> BlindStudy:
    """Diagnose data sets with hidden effects and compare with the truth afterwards.

    cells : names of the simulators' cells, default those of the full study in the plane; `spatial_cells.CELLS` has
        those in space
    count : data sets per cell; left out: 1000 without a hidden effect where there is a bar, else 400 or 1200; in space
        100
    folder : where plans.parquet, truth.parquet, diagnoses.parquet and the tables of the result go

    Raises `InputError` for an unknown cell.
    """
    keys = [dict(key) for cell in _checked(cells) for key in _keys(cell, count, seed)]
    options: dict[str, Any] = {"resume": resume, "force": force, "progress": progress}  # the seed is in the keys
    with Job.open(folder, (PLANS, TRUTH, DIAGNOSES), workers, **options) as job:
        to_plan = [key for key in keys if key["cell"] in simulated.CELLS and _to_be_planned(key) is not None]
        made = job.run(plan, to_plan, PLANS)
        plans = {row[KEY]: row.get("postures_deg") for row in made.iter_rows(named=True)}

        def planned(key: Key) -> list[list[float]] | None:
            return plans.get(canonical(key))

        truth = job.run(hide, keys, TRUTH, payload=planned)
        diagnoses = job.run(examine, keys, DIAGNOSES, payload=planned)
        found = scored_table(truth, diagnoses)
        if folder is not None:
            write_together(
                {folder / f"{name}.parquet": parquet(table) for name, table in found.tables.items()}, force=True
            )
    return found


def _checked(cells: Sequence[str] | None) -> list[str]:
    """Names of the simulator's cells, default those of the full study."""
    known = [*simulated.CELLS, *spatial.CELLS]
    for cell in cells or ():
        if cell not in known:
            raise InputError(f"cell: unknown name {cell!r}, {nearest(cell, known)}")
    names = list(cells or (cell for cell, spec in simulated.CELLS.items() if spec.reported))
    if set(names) & set(COMPARED) and not has_processes():
        lacking = "scikit-learn is not installed: no Gaussian process in the comparison"
        warnings.warn(f"{lacking}, pip install 'armcal[studies]'", UserWarning, stacklevel=3)
    return names


def _keys(cell: str, count: int | None, seed: int) -> Iterator[Key]:
    total = count or _usual_count(cell)
    for first in range(0, total, BATCH):
        yield {"cell": cell, "first": first, "sets": min(BATCH, total - first), "seed": seed}


def _usual_count(cell: str) -> int:
    if cell in spatial.CELLS:
        return SPATIAL_SETS
    if cell == AMBIGUOUS or simulated.CELLS[cell].designed:
        return MANY_SETS
    return NULL_SETS if cell in NULLS else SETS


def _to_be_planned(key: Key) -> tuple[Arm, int] | None:
    return simulated.to_be_planned(key["cell"], _number(key))


# -- tasks -------------------------------------------------------------------------------------------------------------
def plan(key: dict[str, Any], _: np.random.SeedSequence) -> list[Row]:
    """The postures that `armcal design --discriminating` gives for the arm of a batch."""
    planned = _to_be_planned(key)
    assert planned is not None  # only such cells are tasks
    arm, runs = planned
    found = discrimination_design(DesignProblem.of(Model(arm)), arm, runs)
    return [{"postures_deg": np.degrees(found.design.plan.postures).tolist()}]


def hide(key: dict[str, Any], _: np.random.SeedSequence, planned: list[list[float]] | None = None) -> list[Row]:
    """What is hidden in each set of a batch, and the held-out gap that knowing it would leave."""
    return [{"set": number, **hidden_in(data)} for number, data in _data_sets(key, planned)]


def hidden_in(data: DataSet) -> Row:
    """What is hidden in a data set, and how well a model that knows it does, and one of the geometry only."""
    gap = None if data.holdout is None or data.outside is not None else true_gap(data)
    known = {"hidden": sorted(data.effects), "outside": data.outside, "place": data.place, "gap_true_mm": gap}
    errors = {
        "error_true_mm": None if data.exact is None or data.outside is not None else error(true_arm(data), data),
        "error_geometry_mm": None if data.exact is None else error(fitted_arm(data), data),
        "error_reachable_mm": data.reachable,
    }
    values = {"parameters": list(data.values), "values": list(data.values.values())}
    return {"links": data.arm.links, "wrong_rows": list(data.wrong_rows), **known, **errors, **values}


def examine(key: dict[str, Any], _: np.random.SeedSequence, planned: list[list[float]] | None = None) -> list[Row]:
    """What the diagnosis says of each set of a batch."""
    rows = []
    for number, data in _data_sets(key, planned):
        found = diagnose(data.arm, data.measurements, data.holdout, seed=number)
        row = {"set": number, **said_of(data, found)}
        if key["cell"] in COMPARED:
            row |= {"gap_library_mm": library_gap(data), "gap_process_mm": process_gap(data)}
        if key["cell"] == AMBIGUOUS and found.verdict == "ambiguous":
            row |= _measured_further(data, found, number)
        rows.append(row)
    return rows


def said_of(data: DataSet, found: Diagnosis) -> Row:
    """What a diagnosis of a data set says, by its public results, and how well the model that it writes does."""
    arm, gap = found.extended_arm(), found.gap
    gaps = {"gap_before_mm": gap.held_out_before, "gap_named_mm": gap.held_out_after, "gap_promised_mm": gap.predicted}
    written = {"error_named_mm": error(arm, data), "inside_tip": share_inside_tip(arm, data)}
    doubts = {"confirmed": found.confirmed, "contradictions": contradictions(found.to_json())}
    return {**_said(found), **_intervals(found), **gaps, **written, **doubts}


def _said(found: Diagnosis) -> Row:
    return {
        "verdict": found.verdict,
        "named": sorted(found.named.keys),
        "candidates": [" + ".join(sorted(candidate.keys)) for candidate in found.candidates],
        "probability": _probability(found),
        "credible_set": [
            "unknown" if names is None else " + ".join(names) or "none" for names in found.probabilities.credible
        ],
        "where": found.where,
        "outlier_rows": list(found.outlier_rows),
        "scatter": [finding.name for finding in found.scatter],
    }


def _probability(found: Diagnosis) -> float:
    """Of what the verdict says."""
    if found.verdict in ("none", "unknown"):
        return found.probability[found.verdict]
    return found.probabilities.of(found.named.keys)


def _intervals(found: Diagnosis) -> Row:
    """95 % limits of base and effects [API units]."""
    parameters = Model(found.extended_arm(found.named)).parameters
    fitted = found.named.calibration
    assert fitted.covariance is not None  # a diagnosis has one
    half = quantile_95(found.named.freedom) * np.sqrt(np.diag(fitted.covariance))
    limits = {
        name: (fitted.values[name] - h, fitted.values[name] + h)
        for name, h in zip(fitted.parameter_names, half, strict=True)
    }
    units = {p.name: p.to_file for p in parameters}
    limits |= {p.name: (p.low_95 / units[p.name], p.high_95 / units[p.name]) for p in found.named.parameters}
    low, high = zip(*limits.values(), strict=True)
    return {"interval_of": list(limits), "low_95": list(low), "high_95": list(high)}


def _measured_further(data: DataSet, found: Diagnosis, number: int) -> Row:
    """The ambiguous set again after 2, 8 and 16 more postures: chosen ones, with two payloads, and random ones."""
    row: Row = {}
    payload = 0.0 if data.arm.gravity is None else data.arm.gravity.payload
    for runs in FURTHER_RUNS:
        for how, payloads in (("next", None), ("loaded", (0.0, payload)), ("random", None)):
            longer, chance = _appended(data, found, runs, how == "random", payloads, number)
            again = diagnose(data.arm, longer, seed=number)
            name = f"{how}_{runs}"
            row |= {
                f"{name}_verdict": again.verdict,
                f"{name}_named": sorted(again.named.keys),
                f"{name}_chance": chance,
            }
    return row


def _appended(
    data: DataSet, found: Diagnosis, runs: int, random: bool, payloads: tuple[float, ...] | None, number: int
) -> tuple[Any, float | None]:

    assert data.more is not None
    if random:
        generator = np.random.default_rng([20261124, number, runs])
        postures = generator.uniform(data.arm.lower, data.arm.upper, (runs, data.arm.links))
        return data.more(postures, None, None, runs), None
    best = discriminate(data.arm, found, data.measurements, runs, seed=number, payloads=payloads)
    return data.more(best.plan.postures, best.payload, best.directions, runs), best.chance


# -- data sets ---------------------------------------------------------------------------------------------------------
def _data_sets(key: dict[str, Any], planned: list[list[float]] | None) -> Iterator[tuple[int, DataSet]]:
    """Number and data of every set of a batch."""
    postures = None if planned is None else np.radians(planned)
    drawn = spatial.data_set if key["cell"] in spatial.CELLS else simulated.data_set
    for k in range(key["sets"]):
        yield key["first"] + k, drawn(key["cell"], _number(key) + k, postures)


def _number(key: Key) -> int:
    """The simulator's number of a batch's first set; the user's seed moves all of them."""
    return int(key["seed"]) * 1_000_000 + int(key["first"])
