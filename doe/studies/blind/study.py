"""The blind study: how often is the diagnosis right about effects that were hidden from it?

A simulator that shares no code with the models (plain numpy) draws arm, plan, noise and hidden effects and
hands over what a user has: arm and measurements. What the diagnosis says of them is kept beside what is hidden, and
scored: rates with their Monte Carlo errors, the confusion matrix, reliability, and the bars.

Tasks are batches of data sets: keyed, resumable and on any workers, as in every study.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import inf, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from doe.discrimination.design import discrimination_design
from doe.discrimination.t_optimal import discriminate
from doe.jobs import Columns, Key, Row, frame_of, parquet, run_tasks, sheet
from doe.problem.problem import DesignProblem
from doe.studies.blind.cells import CELLS, SAME_ARM, TABLE, DataSet, data_set, to_be_planned
from identification import Arm, Array, InputError, design_model, diagnose, fitted_arm, library, rms_distance
from identification.document import Sheet
from identification.files.io import write_together

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BATCH = SAME_ARM  # sets per task
AMBIGUOUS = "one, lambda 8, m=20"  # the cell whose ambiguous sets are measured further
FURTHER_RUNS = (2, 8)  # more postures for an ambiguous set
NOTHING, OUTSIDE = "nothing", "outside the library"
ALL, ALL_OUTSIDE = "all sets", "all outside the library"  # stand for a cell where a figure is of all of them together
KEEPS = "confirmed with 3 x the reachable error"
OF_ALL = ("intervals, base", "intervals, effects", "contradiction")  # measures of all cells together
OUTCOMES = ("met", "within its error", "missed")
EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)  # bins of what is said with which probability
Judged = dict[str, Any]
RELIABLE: Columns = {"stated": ("bin", ""), "mean": ("said", ".3f"), "right": ("right", ".3f"), "sets": ("count", "")}
BARS: Columns = {name: (name, "") for name in ("cell", "measure", "asked", "measured", "outcome")}


def blind_study(
    cells: Sequence[str], count: int | None = None, folder: Path | None = None, *, seed: int = 0, **how: Any
) -> dict[str, pl.DataFrame]:
    """Diagnose data sets with hidden effects and compare with the truth afterwards: `sets` (what is hidden in each, and
    what the diagnosis says of it, see `examine`) and the tables of `scored`.

    cells : names of the simulators' cells
    count : data sets per cell; left out: `CellSpec.sets`
    folder : where NAME.parquet of each goes;  how : `workers`, `resume`, `force` and `progress` of `run_tasks`

    Raises `InputError` for an unknown cell.
    """
    keys: list[Key] = []
    InputError.check_names("cell: unknown name", cells, CELLS)
    for cell in cells:
        total = count or CELLS[cell].sets
        keys += [
            {"cell": cell, "first": first, "sets": min(BATCH, total - first), "seed": seed}
            for first in range(0, total, BATCH)
        ]
    sets = run_tasks(examine, keys, folder and folder / "sets.parquet", seed=seed, **how)
    score = scored(sets)
    if folder is not None:
        write_together({folder / f"{name}.parquet": parquet(frame) for name, frame in score.items()}, force=True)
    return {"sets": sets, **score}


# -- tasks -------------------------------------------------------------------------------------------------------------
def examine(key: dict[str, Any], _: np.random.SeedSequence) -> list[Row]:
    """What is hidden in each set of a batch and how well a model does that knows it, or the geometry only; what the
    diagnosis says of the set, by its public results, and how well the model does that it writes.

    The user's seed moves all of the simulator's numbers. Designed postures are those of `armcal design
    --discriminating`.
    """
    first, planned = int(key["seed"]) * 1_000_000 + key["first"], None
    if CELLS[key["cell"]].designed:
        arm, runs = to_be_planned(key["cell"], first)
        planned = discrimination_design(DesignProblem.of(arm), arm, runs).design.plan.postures
    rows = []
    for k in range(key["sets"]):
        data, number = data_set(key["cell"], first + k, planned), key["first"] + k
        diagnosis = diagnose(data.arm, data.measurements, data.holdout, seed=number)
        true, geometry, written = None, data.arm, diagnosis.extended_arm()
        if data.exact is not None:
            geometry = fitted_arm(data.arm, data.measurements, left_out=data.wrong_rows)
        if data.outside is None and data.holdout is not None:
            true = fitted_arm(data.arm, data.measurements, data.specs, data.wrong_rows)
        chances, named, verdict = diagnosis.probabilities, diagnosis.named, diagnosis.verdict
        low, high = zip(*named.limits_95.values(), strict=True)
        row: Row = {
            "set": number,
            "wrong_rows": list(data.wrong_rows),
            "hidden": sorted(data.effects),
            "outside": data.outside,
            "place": data.place,
            "gap_true_mm": gap(true, data, None if data.holdout is None else data.holdout.positions),
            "error_true_mm": gap(true, data, data.exact),
            "error_geometry_mm": gap(geometry, data, data.exact),
            "error_reachable_mm": data.reachable,
            "parameters": list(data.values),
            "values": list(data.values.values()),
            "verdict": verdict,
            "named": sorted(named.keys),
            "candidates": [" + ".join(sorted(candidate.keys)) for candidate in diagnosis.candidates],
            "probability": chances.of(None if verdict == "unknown" else named.keys),
            "credible_set": ["unknown" if names is None else " + ".join(names) or "none" for names in chances.credible],
            "where": diagnosis.where,
            "outlier_rows": list(diagnosis.outlier_rows),
            "interval_of": list(named.limits_95),  # of base and effects [API units]
            "low_95": list(low),
            "high_95": list(high),
            "gap_named_mm": diagnosis.gap.held_out_after,
            "gap_promised_mm": diagnosis.gap.predicted,
            "confirmed": diagnosis.confirmed,
            "contradictions": contradictions(diagnosis.to_json()),
            "error_named_mm": gap(written, data, data.exact),
            "inside_tip": inside_tip(written, data),
        }
        for runs in FURTHER_RUNS if key["cell"] == AMBIGUOUS and verdict == "ambiguous" else ():
            best = discriminate(data.arm, diagnosis, runs, seed=number)
            again = diagnose(data.arm, data.further(best.plan.postures, best.directions), seed=number)
            row |= {f"next_{runs}_verdict": again.verdict, f"next_{runs}_named": sorted(again.named.keys)}
        rows.append(row)
    return rows


def inside_tip(arm: Arm, data: DataSet) -> float | None:
    """Share of the coordinates of the hold-out without noise that are inside a calibrated arm's 95 % intervals; None
    where either is not known."""
    if data.exact is None or data.holdout is None:
        return None
    computed, half = design_model(arm).predicted_95(data.holdout)
    return None if half is None else float(np.mean(np.abs(data.exact - computed) <= half))


def gap(arm: Arm | None, data: DataSet, positions: Array | None) -> float | None:
    """RMS distance [mm] of a calibrated arm from positions at the hold-out's postures; None where there are none."""
    if arm is None or positions is None or data.holdout is None:
        return None
    predicted = design_model(arm).position(data.holdout.postures, conditions=data.holdout.conditions)
    return rms_distance(positions - predicted)


def contradictions(diagnosis: Mapping[str, Any]) -> list[str]:
    """Where verdict, effects and probabilities of a diagnosis (`Diagnosis.to_json`) contradict each other."""
    chance = dict(diagnosis["probabilities"])
    none, unknown, verdict = chance.pop("none"), chance.pop("unknown"), diagnosis["verdict"]
    others = {" + ".join(one["effects"]): one["probability"] for one in diagnosis["other_sets"]}
    named, names = " + ".join(diagnosis["effects"]), verdict in ("named", "ambiguous")
    stated, rest = chance.get(named, 0.0), chance.pop("other sets", 0.0)
    of_library = sum(chance.values()) + rest
    rivals = [*(p for name, p in chance.items() if name != named), *others.values()]
    wrong = {
        "probabilities without sum 1": abs(none + unknown + of_library - 1.0) > 1e-6,
        "listed beyond the rest": sum(others.values()) > rest + 1e-6,
        "none less likely than something": verdict == "none" and none < max(of_library, unknown) - 1e-9,
        "none with effects": verdict == "none" and bool(named),
        "named nothing": names and not named,
        "names less likely than none": names and of_library < max(none, unknown) - 1e-9,
        "named at less than a half": verdict == "named" and stated < 0.5,
        "named less likely than others": names and stated < max(rivals, default=0.0),
        "ambiguous alone": verdict == "ambiguous" and len(chance) < 2 and stated >= 0.5,
        "unknown less likely than names or none": verdict == "unknown" and unknown < max(none, of_library) - 1e-9,
    }
    return [doubt for doubt, holds in wrong.items() if holds]


# -- the score of one data set -----------------------------------------------------------------------------------------
def scored_set(row: Mapping[str, Any]) -> Judged:
    """One data set: classes of what was hidden and of what was named, and in which respects that is right (None, or
    left out: not asked)."""
    verdict, unknown, outside = row["verdict"], row["verdict"] == "unknown", row["outside"] is not None
    hidden, named = row["hidden"] or [], row["named"] or []
    true = "unknown" if outside else " + ".join(hidden) or "none"
    exact, names = not unknown and named == hidden, verdict in ("named", "ambiguous")
    judged: Judged = {
        "cell": row["cell"],
        "hidden": classes(hidden, OUTSIDE if outside else None),
        "named": classes(named, "unknown" if unknown else None),
        "alarm": verdict != "none",
        "contradiction": bool(row["contradictions"]),
        # of nothing, the named set, or something outside the library
        "said": row["probability"],
        "right": true == (" + ".join(named) if names else verdict),
    }
    if hidden:
        judged["exact"] = exact
        judged["class"] = judged["hidden"] == judged["named"]
        judged["in the set"] = not unknown and true in (row["candidates"] or ())
        judged["in the 90 % set"] = true in (row["credible_set"] or ())
        judged["size of the 90 % set"] = len(row["credible_set"] or ())
    if outside:
        judged["no effect"] = verdict == "none"
    if outside and row["place"] is not None:  # an effect of the library is at its joint, or at what it follows
        right, places = set(row["place"].split(" or ")), [{row["where"]}] if unknown and row["where"] else []
        for name, _, joint in (key.partition(":") for key in named):
            followed = {place for place, names in TABLE["following"].items() if name in names}
            places.append(followed | ({f"joint:{joint}"} if joint else set()))
        judged["located"] = unknown and row["where"] in right
        judged["wrong place"] = any(not at & right for at in places)
    if row["wrong_rows"]:
        judged["outliers listed"] = set(row["wrong_rows"]) <= set(row["outlier_rows"] or ())

    values = dict(zip(row["parameters"] or (), row["values"] or (), strict=True))
    limits = zip(row["interval_of"] or (), row["low_95"] or (), row["high_95"] or (), strict=True)
    held = {name: low <= values[name] <= high for name, low, high in limits if name in values}
    base = {name for name in held if name.startswith(("length_error:", "joint_offset:"))}
    shares = {"intervals, base": [held[name] for name in base]}
    shares["intervals, effects"] = [held[name] for name in held.keys() - base] if hidden and exact else []
    if row["error_named_mm"] is not None:  # the hold-out is known without noise
        ratios = {f"error / {name}": ("error_named_mm", f"error_{name}_mm") for name in ("true", "geometry")}
        ratios["promised / reached"] = "gap_promised_mm", "gap_named_mm"
        judged |= {name: row[top] / row[below] for name, (top, below) in ratios.items() if row[top] and row[below]}
        judged["inside tip intervals"] = row["inside_tip"]
        if row["confirmed"] and row["error_reachable_mm"]:
            judged[KEEPS] = row["error_named_mm"] > 3.0 * row["error_reachable_mm"]
        if not outside:
            judged |= {"false names": float(len(set(named) - set(hidden))), "false unknown": unknown}
            shares |= {"effects named": [name in named for name in hidden], "intervals, all": list(held.values())}
    judged |= {name: float(np.mean(right)) for name, right in shares.items() if right}
    if row["gap_named_mm"] and row["gap_true_mm"]:
        judged["gap / true"] = row["gap_named_mm"] / row["gap_true_mm"]
    for way in (f"next_{runs}" for runs in FURTHER_RUNS):  # the same set with further postures, where it was ambiguous
        if row.get(f"{way}_verdict") is not None:
            judged[f"{way} right"] = row[f"{way}_verdict"] in ("named", "ambiguous") and row[f"{way}_named"] == hidden
    return judged


def classes(keys: Sequence[str], besides: str | None) -> str:
    """Classes of effects, joints left out; `nothing` for none."""
    names = [name for name, _, _ in (key.partition(":") for key in keys)]
    families = sorted(library()[name].family if name in library() else name for name in names)
    return " + ".join([*families, *([besides] if besides else [])]) or NOTHING


# -- all of them -------------------------------------------------------------------------------------------------------
def scored(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """The score of the rows of all sets: `cells` (cell, measure, value, standard_error, count); `bars` (the same rows
    with what is asked and how it came out); `confusion` (hidden, named: classes of effects, joints left out, count);
    `reliability` (from, to, said, right, count: bins of the probability with which something was said)."""
    sets = [scored_set(row) for row in rows.iter_rows(named=True) if row["status"] == "done"]
    of_cells: dict[str, list[Judged]] = {}
    for judged in sets:
        of_cells.setdefault(judged["cell"], []).append(judged)
    beyond = [s for s in sets if s["hidden"] == OUTSIDE and "error / geometry" in s]
    if len({s["cell"] for s in beyond}) > 1:
        of_cells[ALL_OUTSIDE] = beyond
    cells = [row for cell, judged in of_cells.items() for row in measures(judged, cell)]
    cells += [*calibration(sets), *(row for row in measures(sets, ALL) if row["measure"] in OF_ALL)]
    figures = {(row["cell"], row["measure"]): row for row in cells}
    bars = []
    for cell, bar in ((cell, bar) for cell, bars in TABLE["bars"].items() for bar in bars):
        measure, sign, text = bar.rsplit(maxsplit=2)
        if (row := figures.get((cell, measure))) is not None:
            asked = float(text)
            short = row["value"] - asked if sign == "<=" else asked - row["value"]
            within = short <= 2.0 * row["standard_error"]
            outcome = OUTCOMES[0] if short <= 0.0 else OUTCOMES[1] if within else OUTCOMES[2]
            bars.append({**row, "asked": f"{sign} {asked:g}", "outcome": outcome})
    pairs = Counter((s["hidden"], s["named"]) for s in sets)
    confusion = [{"hidden": a, "named": b, "count": n} for (a, b), n in pairs.most_common()]
    tables = {"cells": cells, "bars": bars, "confusion": confusion, "reliability": reliability(sets)}
    return {name: frame_of(table) for name, table in tables.items()}


def measures(sets: Sequence[Judged], cell: str) -> Iterator[Judged]:
    """Mean and standard error of everything that was judged in a cell; of errors relative to geometry's, of which
    single ones are large, the median."""
    for measure in dict.fromkeys(name for row in sets for name in row if name not in ("cell", "hidden", "named")):
        values = [row[measure] for row in sets if row.get(measure) is not None]
        if not values:
            continue
        mean, n, error = float(np.mean(values)), len(values), inf
        if isinstance(values[0], bool):
            error = float(of_share(mean, n))
        elif measure == "error / geometry":  # half the width of the interval that holds the median in 0.68 of cases
            mean = float(np.median(values))
            ranks = np.clip(0.5 * n + 0.5 * sqrt(n) * np.array([-1.0, 1.0]) - 0.5, 0, n - 1)
            error = 0.5 * float(np.ptp(np.interp(ranks, np.arange(n), np.sort(values)))) if n > 1 else inf
        elif n > 1:
            error = float(np.std(values, ddof=1)) / sqrt(n)
        yield {"cell": cell, "measure": measure, "value": mean, "standard_error": error, "count": n}


def of_share(share: Any, count: Any) -> Any:
    """Standard errors of shares; none claims to be certain: at least that of half a set."""
    return np.sqrt(np.maximum(share * (1.0 - share), 0.25 / count) / count)


def reliability(sets: Sequence[Judged], edges: Sequence[float] = EDGES) -> list[Judged]:
    """Bins of what was said: from, to, mean of what was said, share that was right, data sets."""
    pairs = [(s["said"], s["right"]) for s in sets if s.get("said") is not None]
    rows = []
    for low, high in pairwise(edges):
        within = [(p, right) for p, right in pairs if low <= p < high or (high == 1.0 and p >= 1.0)]
        if within:
            mean, right = np.mean(within, axis=0).tolist()
            rows.append({"from": low, "to": high, "said": mean, "right": right, "count": len(within)})
    return rows


def calibration(sets: Sequence[Judged]) -> Iterator[Judged]:
    """Expected calibration error, and how much too sure the middle of the scale is, where a good classifier easily is,
    with their standard errors."""
    for measure, edges in (("calibration error", EDGES), ("said less right, 0.7 to 0.95", (0.7, 0.95))):
        rows = reliability(sets, edges)
        if total := sum(row["count"] for row in rows):
            value = sum(row["count"] / total * abs(row["said"] - row["right"]) for row in rows)
            error = sqrt(sum((row["count"] / total * of_share(row["right"], row["count"])) ** 2 for row in rows))
            yield {"cell": ALL, "measure": measure, "value": value, "standard_error": error, "count": total}


# -- as a document -----------------------------------------------------------------------------------------------------
def blind_parts(tables: Mapping[str, pl.DataFrame]) -> list[Any]:
    """Verdict, figures of the cells, reliability, bars, and the most frequent mistakes."""
    bars = [{**row, "measured": with_error(row)} for row in tables["bars"].iter_rows(named=True)]
    counts = {word: sum(row["outcome"] == word for row in bars) for word in OUTCOMES}
    outcomes = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    done = len(tables["sets"].filter(status="done"))
    failed = f"; {len(tables['sets']) - done} batches failed" if done < len(tables["sets"]) else ""
    parts: list[Any] = [f"{done} blind data sets; bars: {outcomes or 'none'}{failed}"]
    cells: dict[str, dict[str, Any]] = {}
    for row in tables["cells"].iter_rows(named=True):
        cells.setdefault(row["cell"], {})[row["measure"]] = row
    for title, (first, *others) in TABLE["tables"].items():  # where a cell has the first of the measures
        rows = [
            [cell, str(row[first]["count"]), *(with_error(row.get(name)) for name in (first, *others))]
            for cell, row in cells.items()
            if first in row
        ]
        parts.append(Sheet(("hidden", "sets", first, *others), rows, title))
    error = with_error(cells.get(ALL, {}).get("calibration error"))
    title = f"Is what is stated with probability p right in a share p of the sets? Expected calibration error {error}"
    bins = ({**row, "bin": f"{row['from']:g} to {row['to']:g}"} for row in tables["reliability"].iter_rows(named=True))
    wrong = [
        [row["hidden"], row["named"], str(row["count"])]
        for row in tables["confusion"].iter_rows(named=True)
        if row["hidden"] != row["named"] and not (row["hidden"] == OUTSIDE and row["named"].endswith("unknown"))
    ]
    mistakes = Sheet(("hidden", "named", "sets"), wrong, "Most frequent mistakes between classes", 12)
    return [*parts, sheet(bins, RELIABLE, title), sheet(bars, BARS, "Bars"), mistakes]


def with_error(row: dict[str, Any] | None) -> str:
    """`.931(13)`: the value and its standard error in units of its last digit; empty without a row."""
    if row is None:
        return ""
    value = f"{row['value']:.3f}".removeprefix("0" if row["value"] < 1.0 else "")
    error = 1000.0 * row["standard_error"]
    return f"{value}({error:.0f})" if np.isfinite(error) else value


def reliability_figure(rows: pl.DataFrame) -> Figure:
    """Reliability diagram: share right against stated probability, bars of two standard errors, and number of sets."""
    from matplotlib.figure import Figure  # deferred: workers draw nothing
    from matplotlib.ticker import NullFormatter

    stated, right, count = (rows[name].to_numpy() for name in ("said", "right", "count"))
    error = 2.0 * of_share(right, count)
    figure = Figure(figsize=(5.0, 5.6), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    axes.plot([0.0, 1.0], [0.0, 1.0], color="gray", linewidth=1.0, label="as often as stated")
    axes.errorbar(stated, right, error, fmt="o", markersize=5, capsize=3, label="data sets, +- 2 standard errors")
    axes.set(ylabel="share that was right", ylim=(0.0, 1.02), title="Stated with probability p: right in a share p?")
    axes.legend(loc="lower right", frameon=False)
    low, high = rows["from"].to_numpy(), rows["to"].to_numpy()
    below.bar(low, count, high - low, align="edge", edgecolor="white")
    below.set(yscale="log", ylim=(10.0 ** np.floor(np.log10(max(count.min(), 1))), None))
    below.set(ylabel="data sets", xlabel="stated probability", xlim=(0.0, 1.02))
    below.yaxis.set_minor_formatter(NullFormatter())
    return figure
