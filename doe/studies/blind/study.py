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
from doe.jobs.rows import KEY, Key, Row, canonical, parquet
from doe.jobs.running import Job, Workers
from doe.problem.problem import DesignProblem
from doe.studies.blind.cells import CELLS, DataSet, data_set, to_be_planned
from doe.studies.blind.rivals import (
    error,
    fitted_arm,
    gap,
    has_processes,
    library_gap,
    process_gap,
    share_inside_tip,
    true_arm,
)
from doe.studies.blind.score import BARS, BlindStudy, contradictions, scored_table
from identification import Diagnosis, InputError, Measurements, Model, Progress, diagnose, nearest, quantile_95, silent
from identification.files.io import write_together

BATCH = 10  # sets per task
NULL_SETS, SETS = 1000, 400  # data sets per cell, without and with a hidden effect
SPATIAL_SETS = 100  # per cell in space, where a diagnosis takes ten times as long
AMBIGUOUS = "one, lambda 8, m=20"  # the cell whose ambiguous sets are measured further
MANY_SETS = 1200  # in this cell, of which a third are ambiguous, and where ten sets share an arm and its plan
COMPARED = ("one, lambda 8, m=50", "one, lambda 8, discriminating plan")  # cells whose gap is compared with rivals'
FURTHER_RUNS = (2, 8, 16)  # more postures for an ambiguous set
PLANS, TRUTH, DIAGNOSES = "plans.parquet", "truth.parquet", "diagnoses.parquet"
Planned = list[list[float]] | None  # postures [deg] of a batch's plan, None: random ones


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

    cells : names of the simulators' cells, default those of the full study in the plane
    count : data sets per cell; left out: 1000 without a hidden effect where there is a bar, else 400 or 1200; in space
        100
    folder : where plans.parquet, truth.parquet, diagnoses.parquet and the tables of the result go

    Raises `InputError` for an unknown cell.
    """
    for cell in cells or ():
        if cell not in CELLS:
            raise InputError(f"cell: unknown name {cell!r}, {nearest(cell, CELLS)}")
    names = cells or reported_cells(space=False)
    if set(names) & set(COMPARED) and not has_processes():
        lacking = "scikit-learn is not installed: no Gaussian process in the comparison"
        warnings.warn(f"{lacking}, pip install 'armcal[studies]'", UserWarning, stacklevel=2)
    totals = [(cell, count or _usual_count(cell)) for cell in names]
    keys = [
        {"cell": cell, "first": first, "sets": min(BATCH, total - first), "seed": seed}
        for cell, total in totals
        for first in range(0, total, BATCH)
    ]
    options: dict[str, Any] = {"resume": resume, "force": force, "progress": progress}  # the seed is in the keys
    with Job.open(folder, (PLANS, TRUTH, DIAGNOSES), workers, **options) as job:
        made = job.run(plan, [key for key in keys if CELLS[key["cell"]].designed], PLANS)
        plans = {row[KEY]: row.get("postures_deg") for row in made.iter_rows(named=True)}

        def planned(key: Key) -> Planned:
            return plans.get(canonical(key))

        truth = job.run(hide, keys, TRUTH, payload=planned)
        diagnoses = job.run(examine, keys, DIAGNOSES, payload=planned)
        score = scored_table(truth, diagnoses)
        if folder is not None:
            files = {folder / f"{name}.parquet": parquet(table) for name, table in score.tables.items()}
            write_together(files, force=True)
    return score


def reported_cells(space: bool) -> list[str]:
    """Names of the cells of the full study, in the plane or in space."""
    return [name for name, spec in CELLS.items() if spec.reported and spec.space == space]


def _usual_count(cell: str) -> int:
    if CELLS[cell].space:
        return SPATIAL_SETS
    if cell == AMBIGUOUS or CELLS[cell].designed:
        return MANY_SETS
    return NULL_SETS if any(bar.cell == cell and bar.measure == "alarm" for bar in BARS) else SETS


def _number(key: Key) -> int:
    """The simulator's number of a batch's first set; the user's seed moves all of them."""
    return int(key["seed"]) * 1_000_000 + int(key["first"])


def _data_sets(key: Key, planned: Planned) -> Iterator[tuple[int, DataSet]]:
    """Number and data of every set of a batch."""
    postures = None if planned is None else np.radians(planned)
    for k in range(key["sets"]):
        yield key["first"] + k, data_set(key["cell"], _number(key) + k, postures)


# -- tasks -------------------------------------------------------------------------------------------------------------
def plan(key: dict[str, Any], _: np.random.SeedSequence) -> list[Row]:
    """The postures that `armcal design --discriminating` gives for the arm of a batch."""
    asked = to_be_planned(key["cell"], _number(key))
    assert asked is not None  # only such cells are tasks
    best = discrimination_design(DesignProblem.of(Model(asked[0])), *asked).design.plan
    return [{"postures_deg": np.degrees(best.postures).tolist()}]


def hide(key: dict[str, Any], _: np.random.SeedSequence, planned: Planned = None) -> list[Row]:
    """What is hidden in each set of a batch, the held-out gap that knowing it would leave, and how well a model that
    knows it does, and one of the geometry only."""
    rows = []
    for number, data in _data_sets(key, planned):
        inside = data.outside is None
        arm = true_arm(data) if inside and data.holdout is not None else data.arm
        rows.append(
            {
                "set": number,
                "links": data.arm.links,
                "wrong_rows": list(data.wrong_rows),
                "hidden": sorted(data.effects),
                "outside": data.outside,
                "place": data.place,
                "gap_true_mm": gap(arm, data, data.holdout.positions) if inside and data.holdout is not None else None,
                "error_true_mm": error(arm, data) if inside else None,
                "error_geometry_mm": None if data.exact is None else error(fitted_arm(data), data),
                "error_reachable_mm": data.reachable,
                "parameters": list(data.values),
                "values": list(data.values.values()),
            }
        )
    return rows


def examine(key: dict[str, Any], _: np.random.SeedSequence, planned: Planned = None) -> list[Row]:
    """What the diagnosis says of each set of a batch."""
    rows = []
    for number, data in _data_sets(key, planned):
        diagnosis = diagnose(data.arm, data.measurements, data.holdout, seed=number)
        row = {"set": number, **said_of(data, diagnosis)}
        if key["cell"] in COMPARED:
            row |= {"gap_library_mm": library_gap(data), "gap_process_mm": process_gap(data)}
        if key["cell"] == AMBIGUOUS and diagnosis.verdict == "ambiguous":
            row |= _measured_further(data, diagnosis, number)
        rows.append(row)
    return rows


def said_of(data: DataSet, diagnosis: Diagnosis) -> Row:
    """What a diagnosis of a data set says, by its public results, and how well the model that it writes does."""
    arm, verdict, chances = diagnosis.extended_arm(), diagnosis.verdict, diagnosis.probabilities
    of_nothing = verdict in ("none", "unknown")
    named, calibration = diagnosis.named, diagnosis.named.calibration
    assert calibration.covariance is not None  # a diagnosis has one
    half = quantile_95(named.freedom) * np.sqrt(np.diag(calibration.covariance))
    values = [calibration.values[name] for name in calibration.parameter_names]
    limits = {n: (v - h, v + h) for n, v, h in zip(calibration.parameter_names, values, half, strict=True)}
    units = {p.name: p.to_file for p in Model(diagnosis.extended_arm(named)).parameters}
    limits |= {p.name: (p.low_95 / units[p.name], p.high_95 / units[p.name]) for p in named.parameters}
    low, high = zip(*limits.values(), strict=True)
    return {
        "verdict": verdict,
        "named": sorted(diagnosis.named.keys),
        "candidates": [" + ".join(sorted(candidate.keys)) for candidate in diagnosis.candidates],
        "probability": diagnosis.probability[verdict] if of_nothing else chances.of(diagnosis.named.keys),
        "credible_set": ["unknown" if names is None else " + ".join(names) or "none" for names in chances.credible],
        "where": diagnosis.where,
        "outlier_rows": list(diagnosis.outlier_rows),
        "scatter": [finding.name for finding in diagnosis.scatter],
        "interval_of": list(limits),  # of base and effects [API units]
        "low_95": list(low),
        "high_95": list(high),
        "gap_before_mm": diagnosis.gap.held_out_before,
        "gap_named_mm": diagnosis.gap.held_out_after,
        "gap_promised_mm": diagnosis.gap.predicted,
        "error_named_mm": error(arm, data),
        "inside_tip": share_inside_tip(arm, data),
        "confirmed": diagnosis.confirmed,
        "contradictions": contradictions(diagnosis.to_json()),
    }


def _measured_further(data: DataSet, diagnosis: Diagnosis, number: int) -> Row:
    """The ambiguous set again after 2, 8 and 16 more postures: chosen ones, with two payloads, and random ones."""
    assert data.further is not None
    assert data.arm.gravity is not None
    row: Row = {}
    for runs in FURTHER_RUNS:
        longer: dict[str, tuple[Measurements, float | None]] = {}
        for way, payloads in (("next", None), ("loaded", (0.0, data.arm.gravity.payload))):
            best = discriminate(data.arm, diagnosis, data.measurements, runs, seed=number, payloads=payloads)
            longer[way] = data.further(best.plan.postures, best.payload, best.directions, runs), best.chance
        generator = np.random.default_rng([20261124, number, runs])
        postures = generator.uniform(data.arm.lower, data.arm.upper, (runs, data.arm.links))
        longer["random"] = data.further(postures, None, None, runs), None
        for way, (measurements, chance) in longer.items():
            again = diagnose(data.arm, measurements, seed=number)
            answer = {"verdict": again.verdict, "named": sorted(again.named.keys), "chance": chance}
            row |= {f"{way}_{runs}_{name}": value for name, value in answer.items()}
    return row
