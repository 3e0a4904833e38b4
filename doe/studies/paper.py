"""`armcal study paper`: the deviations that the paper prints, in Table III and its text, and its mistakes, computed
again: what it prints (paper.toml), what comes out. Notebook 2 has the rest, Tables I and II and both figures.

Klimchik, Wu, Caro, Pashkevich, "Design of Experiments for Calibration of Planar Anthropomorphic Manipulators". Every
table is one row per printed statement:

`place`, `links`, `runs`, `item`, `unit` : what the statement is about
`printed` : the paper's figure;  `theory` : that of our own derivation (doe/README.md, "Errata")
`simulated`, `standard_error` : the figure from simulated calibrations
`verdict` : "agrees" (to one unit of the last printed digit), "erratum", "not identifiable", or "added" where the paper
    has no figure
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.jobs import Row, frame_of
from doe.studies.monte_carlo import Study, run_study
from identification import Arm, Array, InputError, Progress, load_arm

PAPER = tomllib.loads(Path(__file__).with_name("paper.toml").read_text())
LENGTHS, SIGMA = np.array(PAPER["lengths_mm"]), PAPER["sigma_mm"]
LENGTHENED = LENGTHS + np.array(PAPER["length_errors_mm"])  # the true ones [mm]
REPLICATIONS = 10_000


def paper_arm(links: int = 4, limited: bool = False) -> Arm:
    """The first links of the paper's arm; `limited`: within the joint limits of doe/README.md, "Planar theorem"."""
    tables = {"name": f"{links} links", "links_mm": PAPER["lengths_mm"][:links], "measurement": {"sigma_mm": SIGMA}}
    if not limited:
        return load_arm(tables)
    limits = {side: PAPER["joint_limits_deg"][side][:links] for side in ("lower", "upper")}
    return load_arm(tables | {"name": f"{links} links within joint limits", "joint_limits_deg": limits})


def simulated(arms: Sequence[Arm], plans: Any, runs: Sequence[int], replications: int, seed: int) -> list[Row]:
    """Rows of the cells of calibrations of arms with the paper's deviations, one per cell and parameter."""
    rows: list[Row] = []
    for arm in arms:
        errors = {key: PAPER[key][: arm.links] for key in ("length_errors_mm", "joint_offsets_deg")}
        truths = [{"name": "paper", **errors}]
        study = Study.of([arm], plans, runs=[*runs], truths=truths, replications=replications)
        cells = run_study(study, seed=seed)["cells"]
        rows += [{"links": arm.links, **row} for row in cells.iter_rows(named=True)]
    return rows


def ideal_std(runs: int, parameter: str, lengths: Array = LENGTHS) -> float:
    """Eq. 25, which is about the orientation of link j, and its consequence for joint offsets [mm, deg]:
    dq_j = dtheta_j - dtheta_(j-1) (identification/README.md, "Covariance and intervals")."""
    name, _, number = parameter.partition(":")
    if name == "length_error":
        return SIGMA / float(np.sqrt(runs))
    j, of_link = int(number) - 1, np.degrees(SIGMA / np.sqrt(runs) / lengths)
    before = of_link[j - 1] if name == "joint_offset" and j else 0.0
    return float(np.hypot(of_link[j], before))


def agreement(printed: float | None, theory: float) -> str:
    """Whether a printed figure is ours to one unit of its last digit: 0.0276 is printed as 0.027 or as 0.028."""
    if printed is None:
        return "added"
    return "agrees" if abs(printed - theory) < 0.001 else "erratum"  # three decimals are printed


def table_3(replications: int = REPLICATIONS, seed: int = 0) -> pl.DataFrame:
    """Table III by simulation, and what it leaves out: joint offsets, 4 links with 4 runs, joint limits.

    Theory is eq. 25 with the TRUE lengths l_j + dl_j, which simulation follows: a difference of 0.6 % at most.
    """
    printed: dict[tuple[int, int, str], float] = {}
    for entry in PAPER["table_3"]:
        at, orientations = (entry["links"], entry["runs"]), list(enumerate(entry["orientations"], start=1))
        printed |= {(*at, f"length_error:{j}"): entry["length"] for j, _ in orientations}
        printed |= {(*at, f"orientation_offset:{j}"): value for j, value in orientations}
    rows: list[Row] = []
    cases = [("Table III", paper_arm(links), "dft", [3, 4, 20]) for links in (2, 3, 4)]
    cases.append(("joint limits", paper_arm(4, limited=True), "exchange", [4, 20]))
    for place, cell in [
        (place, row)
        for place, arm, plan, numbers in cases
        for row in simulated([arm], [plan], numbers, replications, seed)
    ]:
        links, runs, item = cell["links"], cell["runs"], cell["parameter"]
        case = {"place": place, "links": links, "runs": runs}
        if cell["status"] != "done":  # fewer equations than unknowns
            note = f"{2 * runs} equations, {2 * links} unknowns: {cell['error']}"
            for (n, m, name), value in printed.items():
                if (n, m) == (links, runs):
                    unit = "mm" if name.startswith("length") else "deg"
                    lost = {"item": name, "unit": unit, "printed": value, "verdict": "not identifiable", "note": note}
                    rows.append(case | lost)
            continue
        stated, ideal = printed.get((links, runs, item)) if place == "Table III" else None, ideal_std(runs, item)
        case |= {"item": item, "unit": cell["unit"], "printed": stated, "theory": cell["expected_std"], "ideal": ideal}
        error = cell["std"] / np.sqrt(2.0 * (cell["fits"] - 1))  # of normal errors
        case |= {"simulated": cell["std"], "standard_error": error, "verdict": agreement(stated, ideal)}
        rows.append(case | {"note": None})
    return frame_of(rows)


def text_figures() -> pl.DataFrame:
    """The numbers of Section VI's text, by eq. 25; simulation confirms the same formula in `table_3`."""
    rows = []
    for entry in PAPER["text"]:
        item, printed, theory = entry["item"], entry.get("printed"), ideal_std(entry["runs"], entry["item"])
        row = {"place": entry["place"], "links": 4, "runs": entry["runs"], "item": item}
        row |= {"unit": "mm" if item == "length_error" else "deg", "printed": printed, "theory": theory}
        rows.append(row | {"verdict": agreement(printed, theory)})
    return frame_of(rows)


def errata(replications: int = REPLICATIONS, seed: int = 0) -> pl.DataFrame:
    """One row per erratum: place, printed, correct. Those about deviations (`std` in paper.toml) are compared with
    simulated calibrations: the relative error of what is printed, and of its correction, `tolerance` of the check, and
    `confirmed`: the statement is wrong and the correction right. The others are algebra, which notebook 2 checks.
    """
    arms = [paper_arm(links) for links in (2, 4)]
    cells = simulated(arms, ["dft"], [4, 20, 100], replications, seed + 1)
    std = {(row["links"], row["runs"], row["parameter"]): row["std"] for row in cells}
    tolerance = float(4.5 / np.sqrt(2.0 * replications))
    rows: list[Row] = []
    for erratum in PAPER["errata"]:
        row = {name: erratum[name] for name in ("place", "printed", "correct")}
        if statements := erratum.get("std"):
            truth = np.array([std[links, runs, item] for links, runs, item, _ in statements])
            ours = [ideal_std(runs, item, LENGTHENED) for _, runs, item, _ in statements]
            wrong, right = (np.abs(values / truth - 1.0) for values in ([one[-1] for one in statements], ours))
            # each is farther away than its correction, and rounding in the paper explains less than one per cent
            confirmed = bool(np.all(wrong > np.maximum(right, 0.01)) and np.all(right <= tolerance))
            row |= {"printed_error": float(wrong.min()), "correct_error": float(right.max())}
            row |= {"tolerance": tolerance, "confirmed": confirmed}
        rows.append(row)
    return frame_of(rows)


def paper_study(
    replications: int | None = None, *, seed: int = 0, progress: Progress = Progress()
) -> dict[str, pl.DataFrame]:
    """The tables of this file by their names, `text` for `text_figures`.

    replications : simulated calibrations per table entry. Raises `InputError` for too few to tell printed deviations
        from true ones, or more than memory holds.
    """
    (least, most), number = (1_000, 100_000), replications or REPLICATIONS
    if not least <= number <= most:
        raise InputError(f"--replications: found {number}, allowed for the paper: {least:,} to {most:,}")
    progress(0, 2, "table_3")
    tables = {"table_3": table_3(number, seed), "text": text_figures()}
    progress(1, 2, "errata")
    return tables | {"errata": errata(number, seed)}


def passed(tables: Mapping[str, pl.DataFrame]) -> bool:
    """Whether theory and simulation agree, to 4.5 standard errors, in every row of Table III that has both (of 100 rows
    from one fixed seed, one is beyond that by chance once in 1,500 times), and every erratum about deviations is
    confirmed."""
    rows = tables["table_3"].drop_nulls(["simulated", "theory"])
    consistent = (rows["simulated"] - rows["theory"]).abs() <= 4.5 * rows["standard_error"]
    return bool(consistent.all() and tables["errata"]["confirmed"].drop_nulls().all())
