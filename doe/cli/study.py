"""`armcal study`: Monte Carlo studies."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from doe.cli.verb import Count, JobOptions, interruptible
from identification import InputError, JobError, Progress
from identification.document import Answer, Document
from identification.files.io import write_together
from identification.workflow import VERBS

BUILT_IN = ("blind", "blind-spatial")

EXAMPLE = """armcal study study.toml --workers 4

\b
where study.toml has, for instance (names of files are beside it):
    arms = ["arm.toml"]
    # solvers of `armcal design`, "dft", "random", plan files
    plans = ["exchange", "random", "plan.csv"]
    runs = [10, 20]           # of measurements; a plan file has its own
    sigma_mm = [0.05, 0.1]    # left out: the arm's own
    # simulated data sets per cell
    replications = 10000

\b
    # what is there; left out: the arm's own calibration and effects
    [[truths]]
    name = "eccentric"
    length_errors_mm = [1.5, -0.6, -0.4, 0.7]
    joint_offsets_deg = [0.5, -0.5, 0.7, -0.3]
    # of spatial arms instead of these two lists:
    # values = {"translation_x:3" = 0.5, "joint_offset:2" = 0.2}
    [[truths.effects]]
    name = "encoder_eccentricity"
    joint = 2
    a_deg = 0.03
    b_deg = -0.01

\b
    # what is fitted; left out: the arm's own effects
    [[models]]
    name = "base"
    effects = []"""


@VERBS.declare(EXAMPLE)
def study_files(
    study: Annotated[str, "STUDY.toml|NAME"],
    *,
    replications: Count | None = None,
    cells: Annotated[tuple[str, ...], "--cell", "NAME"] = (),
    job: JobOptions,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """Run a simulation study, or one that comes with armcal.

    Simulate, identify and count: what plans, models and noise do to the accuracy. STUDY is a file, or the name of a
    study that comes with armcal: blind (diagnoses of data with hidden effects, compared with the truth afterwards),
    blind-spatial (the same for six-axis arms).
    The folder gets cells.parquet (one row per cell and parameter: errors, deviations, coverage), blocks.parquet and
    plans.parquet; notebooks read them with polars.

    replications : Simulated data sets per cell, instead of the file's.
    cells : Of blind or blind-spatial: only this; repeatable.
    """
    if study not in BUILT_IN and not study.endswith(".toml"):
        raise InputError.unknown("study: unknown name", study, [*BUILT_IN, "NAME.toml"])
    if cells and study not in BUILT_IN:
        raise InputError(f"--cell: {cells[0]!r} of the study {study}, allowed: of blind and blind-spatial")
    folder = job.out or Path(study).with_suffix(".results")
    with interruptible(f"finished rows are kept in {folder}, go on with --resume"):
        if study in BUILT_IN:
            from doe.report.studies import blind_parts, reliability_figure
            from doe.studies.blind.cells import CELLS
            from doe.studies.blind.study import blind_study

            offered = {name: spec.reported for name, spec in CELLS.items() if spec.space == (study == "blind-spatial")}
            if further := [name for name in cells if name not in offered]:
                raise InputError.unknown(f"--cell: unknown name of the study {study}", further[0], offered)
            asked = cells or [name for name in offered if offered[name]]
            tables = blind_study(asked, replications, folder, **job.how(seed, progress))
            if len(tables["reliability"]):
                picture = reliability_figure(tables["reliability"])
                write_together({folder / "reliability.png": picture}, force=True)
            shown, sets = blind_parts(tables), tables.pop("sets")
            passed = "failed" not in sets["status"]
            rows = {name: table.to_dicts() for name, table in tables.items()}
            data = {"out": folder, "passed": passed, **rows}
            return Answer(data, Document(parts=shown), exit_code=0 if passed else 1)
        from doe.report.studies import monte_carlo_parts
        from doe.studies.monte_carlo import Study, run_study

        tables = run_study(Study.load(Path(study), replications), folder, **job.how(seed, progress))
        made, blocks = tables["cells"], tables["blocks"]
        if "done" not in blocks["status"]:
            reason = re.sub(r"\b[A-Z]\w*Error: ", "", blocks["error"][0])  # users need no exception types
            raise JobError(f"no cell could be done: {reason}")
        data = {"out": folder, "cells": made.to_dicts(), "failed": len(made.filter(made["status"] != "done"))}
        written = f"{len(made)} rows written to {folder / 'cells.parquet'}"
        return Answer(data, Document(parts=[*monte_carlo_parts(tables), written]))
