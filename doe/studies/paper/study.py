"""`armcal study paper`: everything of the paper, in parts that run on any workers and are kept as they finish."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.row_table import Key, Row, RowTable, frame_of, parquet
from doe.jobs.tasks import run_tasks
from doe.jobs.workers import Workers
from doe.studies.paper.errata import CHECKS, errata
from doe.studies.paper.figures import RUNS, figure_1, figure_2
from doe.studies.paper.tables import ARM_NAMES, REPLICATIONS, consistent, table_1, table_2, table_3, text_figures
from identification.errors import InputError, JobError
from identification.files.io import check_writable, write_together
from identification.progress import Progress, silent

NAMES = ("table_1", "table_2", "table_3", "text", "errata", "figure_1", "figure_2")
PARTS = "parts.parquet"
ALLOWED = 100, 100_000  # replications


@dataclass(frozen=True)
class PaperStudy:
    """Everything of the paper, computed again.

    tables : by the names in `NAMES`
    """

    tables: dict[str, pl.DataFrame]

    @property
    def passed(self) -> bool:
        """Whether theory and simulation agree everywhere and every erratum is confirmed."""
        return consistent(self.tables["table_3"]) and bool(self.tables["errata"]["confirmed"].all())


def paper_study(
    replications: int | None = None,
    folder: Path | None = None,
    workers: Workers | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> PaperStudy:
    """Everything of the paper.

    replications : simulated calibrations per table entry;  folder : for a Parquet file of each table
    Raises `InputError` for too few replications to estimate a deviation, or more than memory holds.
    """
    least, most = ALLOWED
    if replications is not None and not least <= replications <= most:
        raise InputError(f"--replications: found {replications}, allowed for the paper: {least} to {most:,}")
    targets = {} if folder is None else {name: folder / f"{name}.parquet" for name in NAMES}
    keys = list(part_keys(replications or REPLICATIONS, seed))
    with RowTable.within(folder, PARTS, resume=resume, force=force) as table:
        for target in targets.values():
            check_writable(target, resume or force)
        table.forget([key for key, rows in table.rows.items() if rows[0]["status"] != "done"])
        found = PaperStudy(assemble(run_tasks(part, keys, table, workers, seed=seed, progress=progress)))
    write_together({target: parquet(found.tables[name]) for name, target in targets.items()}, force=True)
    return found


def part_keys(replications: int, seed: int) -> Iterator[Key]:
    """One key per part: what takes long comes in pieces."""
    common = {"replications": replications, "seed": seed}
    pieces: dict[str, Any] = {"table_3": ARM_NAMES, "errata": range(len(CHECKS)), "figure_2": RUNS}
    for name in NAMES:
        for piece in pieces.get(name, (None,)):
            yield {"table": name, "piece": piece, **common}


def part(key: dict[str, Any], seed: np.random.SeedSequence) -> list[Row]:
    """A piece of a table as one row: its own rows as JSON, as tables differ in their columns."""
    number, own, piece = key["replications"], key["seed"], (key["piece"],)
    match key["table"]:
        case "table_1":
            found = table_1()
        case "table_2":
            found = table_2()
        case "table_3":
            found = table_3(number, own, piece)
        case "text":
            found = text_figures()
        case "errata":
            found = errata(number, own, piece)
        case "figure_1":
            found = figure_1(number, own)
        case _:
            found = figure_2(number, own, piece)
    return [{"rows": json.dumps(found.to_dicts())}]


def assemble(found: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Name -> table, of the parts in their order. Raises `JobError` with the reason if a part failed."""
    rows: dict[str, list[Row]] = {name: [] for name in NAMES}
    for row in found.iter_rows(named=True):
        if row["status"] != "done":
            raise JobError(f"{row['table']}: {row['error']}; go on with --resume")
        rows[row["table"]] += json.loads(row["rows"])
    return {name: frame_of(entries) for name, entries in rows.items()}
