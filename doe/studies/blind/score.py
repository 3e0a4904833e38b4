"""Truth and diagnoses joined: rates with their Monte Carlo errors, the confusion matrix, reliability, and the bars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.rows import frame_of
from doe.studies.blind.cells import TABLE
from identification import library

NOTHING, OUTSIDE = "nothing", "outside the library"
ALL, ALL_OUTSIDE = "all sets", "all outside the library"  # stand for a cell where a figure is of all of them together
SURE = 0.9  # probability with which no name should be said where the library has none
KEEPS = "confirmed with 3 x the reachable error"
MEDIANS = ("error / geometry",)  # measures with single large values: the median of the sets
RIVALS = {"true": "gap_true_mm", "library": "gap_library_mm", "process": "gap_process_mm"}
OF_ALL = ("intervals, base", "intervals, effects", "contradiction")  # measures of all cells together
FURTHER = ("next_2", "next_8", "next_16", "loaded_2", "loaded_8", "loaded_16", "random_2", "random_8", "random_16")
OUTCOMES = ("met", "within its error", "missed")
EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)  # bins of what is said with which probability
MIDDLE = (0.7, 0.95)  # where a good classifier is easily too sure
Judged = dict[str, Any]
Said = Mapping[str, Any]  # a row of both tables: what was hidden in a data set, and what was said of it


@dataclass(frozen=True)
class BlindStudy:
    """What the blind study found.

    cells : cell, measure, value, standard_error, count;  bars : the same rows with what is asked and how it came out
    confusion : hidden, named (classes of effects, joints left out), count
    reliability : from, to, said, right, count: bins of the probability with which something was said
    sets : one row per data set, hidden and named side by side;  failures : batches that could not be done
    """

    cells: pl.DataFrame
    bars: pl.DataFrame
    confusion: pl.DataFrame
    reliability: pl.DataFrame
    sets: pl.DataFrame
    failures: int

    @property
    def tables(self) -> dict[str, pl.DataFrame]:
        """What is written as NAME.parquet."""
        return {name: getattr(self, name) for name in ("cells", "bars", "confusion", "reliability")}

    @property
    def passed(self) -> bool:
        """Whether every set could be diagnosed."""
        return self.failures == 0

    def value(self, cell: str, measure: str) -> float:
        """One figure. Raises `KeyError` if the cell has no such measure."""
        return {(row[0], row[1]): float(row[2]) for row in self.cells.iter_rows()}[cell, measure]

    def __str__(self) -> str:
        counts = Counter(self.bars["outcome"]) if len(self.bars) else Counter[str]()
        outcomes = ", ".join(f"{counts[word]} {word}" for word in OUTCOMES if counts[word])
        failed = f"; {self.failures} batches failed" if self.failures else ""
        return f"{len(self.sets)} blind data sets; bars: {outcomes or 'none'}{failed}"

    __repr__ = __str__


@dataclass(frozen=True)
class Bar:
    """Target of a measure in a cell (identification/README.md, "How often is the diagnosis right?")."""

    cell: str
    measure: str
    value: float
    at_most: bool = False

    def outcome(self, value: float, error: float) -> str:
        """`met`, `within its error` (missed by less than two standard errors) or `missed`."""
        short = value - self.value if self.at_most else self.value - value
        return OUTCOMES[0] if short <= 0.0 else OUTCOMES[1] if short <= 2.0 * error else OUTCOMES[2]


BARS = tuple(
    Bar(cell, measure, float(value), sign == "<=")
    for cell, asked in TABLE["bars"].items()
    for measure, sign, value in (bar.rsplit(maxsplit=2) for bar in asked)
)


def scored_table(truth: pl.DataFrame, diagnoses: pl.DataFrame) -> BlindStudy:
    """Join the table of truths and that of diagnoses."""
    failures = sum(int((frame["status"] != "done").sum()) for frame in (truth, diagnoses))
    hidden = {(row["cell"], row["set"]): row for row in truth.iter_rows(named=True) if row["status"] == "done"}
    done = [row for row in diagnoses.iter_rows(named=True) if row["status"] == "done"]
    families = {name: cls.family for name, cls in library().items()}
    sets = [scored_set({**row, **hidden[at]}, families) for row in done if (at := (row["cell"], row["set"])) in hidden]
    of_cells: dict[str, list[Judged]] = {}
    for judged in sets:
        of_cells.setdefault(judged["cell"], []).append(judged)
    beyond = [s for s in sets if s["hidden_class"] == OUTSIDE and "error / geometry" in s]
    if len({s["cell"] for s in beyond}) > 1:
        of_cells[ALL_OUTSIDE] = beyond
    cells = [row for cell, judged in of_cells.items() for row in _measures(judged, cell)]
    cells += [*calibration(sets), *(row for row in _measures(sets, ALL) if row["measure"] in OF_ALL)]
    figures = {(row["cell"], row["measure"]): row for row in cells}
    bars = [
        {
            **(row := figures[bar.cell, bar.measure]),
            "asked": f"{'<=' if bar.at_most else '>='} {bar.value:g}",
            "outcome": bar.outcome(row["value"], row["standard_error"]),
        }
        for bar in BARS
        if (bar.cell, bar.measure) in figures
    ]
    pairs = Counter((s["hidden_class"], s["named_class"]) for s in sets)
    confusion = [{"hidden": a, "named": b, "count": n} for (a, b), n in pairs.most_common()]
    bins = frame_of(reliability(sets))
    return BlindStudy(frame_of(cells), frame_of(bars), frame_of(confusion), bins, frame_of(sets), failures)


# -- one data set ------------------------------------------------------------------------------------------------------
def scored_set(row: Said, families: Mapping[str, str]) -> Judged:
    """One data set: what was hidden, what was named, and in which respects that is right (None: not asked)."""
    unknown, outside = row["verdict"] == "unknown", row.get("outside") is not None
    hidden, named = sorted(row["hidden"] or ()), sorted(row["named"] or ())
    beyond = f"{OUTSIDE}, {row['place'] or row['outside']}" if outside else NOTHING
    judged: Judged = {
        "cell": row["cell"],
        "set": row["set"],
        "hidden": " + ".join(hidden) or beyond,
        "named": " + ".join(named + ([f"unknown, {row['where']}"] if unknown else [])) or NOTHING,
        "hidden_class": _classes(hidden, families, OUTSIDE if outside else None),
        "named_class": _classes(named, families, "unknown" if unknown else None),
        "alarm": row["verdict"] != "none",
    }
    if hidden:
        options = row["candidates"] or []
        judged["exact"] = not unknown and named == hidden
        judged["class"] = judged["hidden_class"] == judged["named_class"]
        judged["in the set"] = not unknown and " + ".join(hidden) in options
        judged["size of the set"] = len(options) or None
    if outside:
        judged |= _places_judged(row)
    if row["wrong_rows"]:
        judged["outliers listed"] = set(row["wrong_rows"]) <= set(row["outlier_rows"] or ())
    judged |= probability_judged(row) | intervals_judged(row, judged.get("exact", False)) | _error_judged(row)
    gap = row["gap_named_mm"]
    judged |= {f"gap / {rival}": gap / row[column] for rival, column in RIVALS.items() if gap and row.get(column)}
    if row.get("next_2_verdict") is not None:
        judged["next_0 right"] = judged["exact"]
    for way in FURTHER:  # the same set with further postures, where it was ambiguous
        if (verdict := row.get(f"{way}_verdict")) is not None:
            again = sorted(row[f"{way}_named"] or ())
            right = verdict in ("named", "ambiguous") and again == hidden
            kind = "gravity" if judged["hidden_class"] == "gravity" else "others"
            judged |= {f"{way} right": right, f"{way} right, {kind}": right}
            judged[f"{way} right, alone"] = right and verdict == "named"
            judged[f"{way} class"] = _classes(again, families, None) == judged["hidden_class"]
            judged[f"{way} predicted"] = row.get(f"{way}_chance")
    return judged


def _classes(keys: Sequence[str], families: Mapping[str, str], besides: str | None) -> str:
    """Classes of effects, joints left out; `nothing` for none."""
    names = sorted(families.get(name, name) for name in (key.partition(":")[0] for key in keys))
    return " + ".join([*names, *([besides] if besides else [])]) or NOTHING


FOLLOWING = {
    "time": ("base_drift", "base_rotation_drift", "base_step", "thermal_transient", "joint_step", "link_step"),
    "temperature": ("thermal_growth",),
    "workspace": ("axes_skew", "measurement_scale"),
}


def _places_judged(row: Said) -> Judged:
    """Where something outside the library was hidden: where it is said to be, unless no place is right.

    An effect of the library is at its joint, at the time or the temperature that it follows, or in the workspace.
    """
    unknown = row["verdict"] == "unknown"
    sure = row["verdict"] in ("named", "ambiguous") and (row.get("probability") or 0.0) >= SURE
    judged: Judged = {"no effect": row["verdict"] == "none", f"named at {SURE:g}": sure}
    if row["place"] is None:
        return judged
    right, places = set(row["place"].split(" or ")), [{row["where"]}] if unknown and row["where"] else []
    for name, _, joint in (key.partition(":") for key in row["named"] or ()):
        followed = {place for place, names in FOLLOWING.items() if name in names}
        places.append(followed | ({f"joint:{joint}"} if joint else set()))
    judged["located"] = unknown and row["where"] in right
    judged["wrong place"] = any(not at & right for at in places)
    return judged


def probability_judged(row: Said) -> Judged:
    """What was said with which probability, and whether it is right; the credible set, where something is hidden.

    The verdict is what is said: nothing, the named set, or something outside the library.
    """
    if row.get("probability") is None:
        return {}
    hidden = sorted(row["hidden"] or ())
    truth = "unknown" if row.get("outside") is not None else " + ".join(hidden) or "none"
    verdict = row["verdict"]
    answer = verdict if verdict in ("none", "unknown") else " + ".join(sorted(row["named"]))
    judged: Judged = {"said": row["probability"], "right": answer == truth}
    if hidden:
        judged |= {"in the 90 % set": truth in row["credible_set"], "size of the 90 % set": len(row["credible_set"])}
    return judged


def intervals_judged(row: Said, exact: bool) -> dict[str, float]:
    """Shares of the true values inside their 95 % intervals: base parameters, and those of effects rightly named."""
    inside = _inside(row)
    of_base = {name: name.startswith(("length_error:", "joint_offset:")) for name in inside}
    shares = {"intervals, base": [held for name, held in inside.items() if of_base[name]]}
    shares["intervals, effects"] = [held for name, held in inside.items() if exact and not of_base[name]]
    return {name: float(np.mean(held)) for name, held in shares.items() if held}


def _inside(row: Said) -> dict[str, bool]:
    """Parameter -> whether its 95 % interval holds the true value, for those that have both."""
    truth = dict(zip(row.get("parameters") or (), row.get("values") or (), strict=True))
    limits = zip(row.get("interval_of") or (), row.get("low_95") or (), row.get("high_95") or (), strict=True)
    return {name: low <= truth[name] <= high for name, low, high in limits if name in truth}


def _error_judged(row: Said) -> Judged:
    """Where the hold-out is known without noise: the written model's error and intervals there, and where many effects
    were hidden, each of them, what else was named, and all intervals."""
    judged: Judged = {"contradiction": bool(row["contradictions"])} if "contradictions" in row else {}
    if (error := row.get("error_named_mm")) is None:
        return judged
    references = {f"error / {name}": row.get(f"error_{name}_mm") for name in ("true", "geometry", "reachable")}
    judged |= {name: error / reference for name, reference in references.items() if reference}
    judged["inside tip intervals"] = row.get("inside_tip")
    if row.get("gap_promised_mm") and row.get("gap_named_mm"):
        judged["promised / reached"] = row["gap_promised_mm"] / row["gap_named_mm"]
    if row.get("confirmed") and row.get("error_reachable_mm"):
        judged[KEEPS] = error > 3.0 * row["error_reachable_mm"]
    if row.get("outside") is not None:
        return judged
    hidden, named = set(row["hidden"]), set(row["named"] or ())
    judged |= {"false names": float(len(named - hidden)), "false unknown": row["verdict"] == "unknown"}
    inside = list(_inside(row).values())
    shares = {"effects named": [name in named for name in hidden], "intervals, all": inside}
    return judged | {name: float(np.mean(held)) for name, held in shares.items() if held}


def contradictions(diagnosis: Said) -> list[str]:
    """Where verdict, effects and probabilities of a diagnosis (`Diagnosis.to_json`) contradict each other."""
    chance = dict(diagnosis["probabilities"])
    none, unknown, verdict = chance.pop("none"), chance.pop("unknown"), diagnosis["verdict"]
    others = {" + ".join(one["effects"]): one["probability"] for one in diagnosis["other_sets"]}
    named = " + ".join(diagnosis["effects"])
    stated = chance.get(named, 0.0)
    rest = chance.pop("other sets", 0.0)
    of_library = sum(chance.values()) + rest
    rivals = [*(p for name, p in chance.items() if name != named), *others.values()]
    wrong = {
        "probabilities without sum 1": abs(none + unknown + of_library - 1.0) > 1e-6,
        "listed beyond the rest": sum(others.values()) > rest + 1e-6,
        "none less likely than something": verdict == "none" and none < max(of_library, unknown) - 1e-9,
        "none with effects": verdict == "none" and bool(named),
        "named nothing": verdict in ("named", "ambiguous") and not named,
        "names less likely than none": verdict in ("named", "ambiguous") and of_library < max(none, unknown) - 1e-9,
        "named at less than a half": verdict == "named" and stated < 0.5,
        "named less likely than others": verdict in ("named", "ambiguous") and stated < max(rivals, default=0.0),
        "named beside its equals": verdict == "named" and len(chance) > 1 and stated < 0.5,
        "ambiguous alone": verdict == "ambiguous" and len(chance) < 2 and stated >= 0.5,
        "unknown less likely than names or none": verdict == "unknown" and unknown < max(none, of_library) - 1e-9,
    }
    return [doubt for doubt, holds in wrong.items() if holds]


# -- all of them -------------------------------------------------------------------------------------------------------
def _measures(sets: Sequence[Judged], cell: str) -> Iterator[Judged]:
    """Mean and standard error of everything that was judged in a cell; of `MEDIANS` the median."""
    texts = ("cell", "set", "hidden", "named", "hidden_class", "named_class")
    for measure in dict.fromkeys(name for row in sets for name in row if name not in texts):
        values = [row[measure] for row in sets if row.get(measure) is not None]
        if not values:
            continue
        mean, n = float(np.mean(values)), len(values)
        if isinstance(values[0], bool):
            error = _of_share(mean, n)
        elif measure in MEDIANS:  # half the width of the interval that holds the median in 0.68 of cases
            mean = float(np.median(values))
            ranks = np.clip(0.5 * n + 0.5 * sqrt(n) * np.array([-1.0, 1.0]) - 0.5, 0, n - 1)
            error = 0.5 * float(np.ptp(np.interp(ranks, np.arange(n), np.sort(values)))) if n > 1 else float("inf")
        else:
            error = float(np.std(values, ddof=1)) / sqrt(n) if n > 1 else float("inf")
        yield {"cell": cell, "measure": measure, "value": mean, "standard_error": error, "count": n}


def _of_share(share: float, count: int) -> float:
    """Standard error of a share; never claims to be certain: at least that of half a set."""
    return sqrt(max(share * (1.0 - share), 0.25 / count) / count)


def reliability(sets: Sequence[Judged]) -> list[Judged]:
    """Bins of what was said: from, to, mean of what was said, share that was right, data sets."""
    pairs = [(s["said"], s["right"]) for s in sets if s.get("said") is not None]
    rows = []
    for low, high in pairwise(EDGES):
        within = [(p, right) for p, right in pairs if low <= p < high or (high == 1.0 and p >= 1.0)]
        if within:
            mean, right = np.mean(within, axis=0).tolist()
            rows.append({"from": low, "to": high, "said": mean, "right": right, "count": len(within)})
    return rows


def calibration(sets: Sequence[Judged]) -> Iterator[Judged]:
    """Expected calibration error, and how much too sure the middle of the scale is, with their standard errors."""
    bins = reliability(sets)
    middle = [(s["said"], s["right"]) for s in sets if s.get("said") is not None and MIDDLE[0] <= s["said"] < MIDDLE[1]]
    mean, right = np.mean(middle, axis=0).tolist() if middle else (0.0, 0.0)
    one: list[Judged] = [{"said": mean, "right": right, "count": len(middle)}] if middle else []
    for measure, rows in (("calibration error", bins), ("said less right, 0.7 to 0.95", one)):
        if total := sum(row["count"] for row in rows):
            value = sum(row["count"] / total * abs(row["said"] - row["right"]) for row in rows)
            error = sqrt(sum((row["count"] / total * _of_share(row["right"], row["count"])) ** 2 for row in rows))
            yield {"cell": ALL, "measure": measure, "value": value, "standard_error": error, "count": total}
