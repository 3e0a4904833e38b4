"""`armcal study paper`: everything of the paper, in parts that run on any workers and are kept as they finish."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.row_table import Key, Row, frame_of, parquet
from doe.jobs.tasks import Job
from doe.jobs.workers import Workers
from doe.studies.paper import tables
from doe.studies.paper.errata import CHECKS, errata
from identification.errors import InputError, JobError
from identification.files.io import PathLike, check_writable, write_together
from identification.progress import Progress, silent

# what takes long comes in pieces
PIECES: dict[str, Any] = {
    **dict.fromkeys(("table_1", "table_2"), (None,)),
    "table_3": tables.ARM_NAMES,
    "text": (None,),
    "errata": range(len(CHECKS)),
    "figure_1": (None,),
    "figure_2": tables.RUNS,
}
PARTS = "parts.parquet"
ALLOWED = 100, 100_000  # replications


@dataclass(frozen=True)
class PaperStudy:
    """Everything of the paper, computed again.

    tables : by the names in `PIECES`
    """

    tables: dict[str, pl.DataFrame]

    @property
    def passed(self) -> bool:
        """Whether theory and simulation agree everywhere and every erratum is confirmed."""
        return tables.consistent(self.tables["table_3"]) and bool(self.tables["errata"]["confirmed"].all())


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
    Raises `InputError` for too few replications to estimate a deviation, or more than memory holds; `JobError` with the
    reason if a part failed.
    """
    least, most = ALLOWED
    if replications is not None and not least <= replications <= most:
        raise InputError(f"--replications: found {replications}, allowed for the paper: {least} to {most:,}")
    common = {"replications": replications or tables.REPLICATIONS, "seed": seed}
    keys: list[Key] = [{"table": name, "piece": piece, **common} for name, pieces in PIECES.items() for piece in pieces]
    rows: dict[str, list[Row]] = {name: [] for name in PIECES}
    options: dict[str, Any] = {"seed": seed, "resume": resume, "force": force, "progress": progress}
    with Job.open(folder, (PARTS,), workers, **options) as job:
        for name in PIECES if folder is not None else ():
            check_writable(folder / f"{name}.parquet", resume or force)  # type: ignore[operator]
        table = job.tables[PARTS]
        table.rows = {key: done for key, done in table.rows.items() if done[0]["status"] == "done"}
        for row in job.run(part, keys, PARTS).iter_rows(named=True):
            if row["status"] != "done":
                raise JobError(f"{row['table']}: {row['error']}; go on with --resume")
            rows[row["table"]] += json.loads(row["rows"])
    frames = {name: frame_of(entries) for name, entries in rows.items()}
    if folder is not None:
        files: dict[PathLike, str | bytes] = {
            folder / f"{name}.parquet": parquet(frame) for name, frame in frames.items()
        }
        write_together(files, force=True)
    return PaperStudy(frames)


def part(key: dict[str, Any], _: np.random.SeedSequence) -> list[Row]:
    """A piece of a table as one row: its own rows as JSON, as tables differ in their columns."""
    number, seed, piece = key["replications"], key["seed"], (key["piece"],)
    made = {
        "table_1": tables.table_1,
        "table_2": tables.table_2,
        "table_3": lambda: tables.table_3(number, seed, piece),
        "text": tables.text_figures,
        "errata": lambda: errata(number, seed, piece),
        "figure_1": lambda: tables.figure_1(number, seed),
        "figure_2": lambda: tables.figure_2(number, seed, piece),
    }
    return [{"rows": json.dumps(made[key["table"]]().to_dicts())}]
