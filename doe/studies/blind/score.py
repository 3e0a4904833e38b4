"""Truth and diagnoses joined: rates with their Monte Carlo errors, the confusion matrix, and the targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
import polars as pl

from doe.jobs.row_table import frame_of
from doe.studies.blind.reliability import (
    ALL,
    calibration,
    intervals_judged,
    probability_judged,
    reliability,
    share_inside,
)
from identification.effects import library

NOTHING = "nothing"
OUTSIDE = "outside the library"
SURE = 0.9  # probability with which no name should be said where the library has none
ALL_OUTSIDE = "all outside the library"  # stands for a cell where a figure is of all of them together
KEEPS = "confirmed with 3 x the reachable error"
MEDIANS = ("error / geometry",)  # measures with single large values: the median of the sets
RIVALS = {"true": "gap_true_mm", "library": "gap_library_mm", "process": "gap_process_mm"}
OF_ALL = ("intervals, base", "intervals, effects", "contradiction")  # measures of all cells together
FURTHER = ("next_2", "next_8", "next_16", "loaded_2", "loaded_8", "loaded_16", "random_2", "random_8", "random_16")


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
        return {
            "cells": self.cells,
            "bars": self.bars,
            "confusion": self.confusion,
            "reliability": self.reliability,
        }

    @property
    def passed(self) -> bool:
        """Whether every set could be diagnosed."""
        return self.failures == 0

    def value(self, cell: str, measure: str) -> float:
        """One figure. Raises `KeyError` if the cell has no such measure."""
        for row in self.cells.iter_rows(named=True):
            if (row["cell"], row["measure"]) == (cell, measure):
                return float(row["value"])
        raise KeyError((cell, measure))

    def __str__(self) -> str:
        counts = Counter(self.bars["outcome"]) if len(self.bars) else Counter[str]()
        outcomes = ", ".join(f"{counts[word]} {word}" for word in OUTCOMES if counts[word])
        failed = f"; {self.failures} batches failed" if self.failures else ""
        return f"{len(self.sets)} blind data sets; bars: {outcomes or 'none'}{failed}"

    __repr__ = __str__


OUTCOMES = ("met", "within its error", "missed")


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


def _bars() -> Iterator[Bar]:
    for m in (20, 50, 200):
        yield Bar(f"none m={m}", "alarm", 0.05, at_most=True)
    for noise in ("joint", "reach"):
        yield Bar(f"none, {noise} noise", "alarm", 0.07, at_most=True)
    for plan, exact in (("m=50", 0.872), ("m=200", 0.908), ("discriminating plan", 0.887)):
        cell = f"one, lambda 6, {plan}"
        yield from (Bar(cell, "exact", exact), Bar(cell, "class", 0.96), Bar(cell, "in the set", 0.95))
        yield from (Bar(cell, "in the 90 % set", 0.9), Bar(cell, "size of the 90 % set", 1.4, at_most=True))
    for plan, exact in (("m=50", 0.928), ("discriminating plan", 0.91)):
        cell = f"one, lambda 8, {plan}"
        yield from (Bar(cell, "exact", exact), Bar(cell, "class", 0.985), Bar(cell, "in the set", 0.95))
        yield Bar(cell, "gap / true", 1.05, at_most=True)
        yield from (Bar(cell, f"gap / {rival}", 1.0, at_most=True) for rival in ("library", "process"))
    yield from (Bar("two, lambda 8", "exact", 0.857), Bar("two, lambda 8", "class", 0.92))
    yield Bar("outside, lambda 7", "located", 0.95)
    yield Bar("three outliers, lambda 8", "exact", 0.92)
    yield Bar("three outliers, lambda 8", "outliers listed", 1.0)
    yield from (Bar("one, lambda 8, m=20", "next_2 right", 0.75), Bar("one, lambda 8, m=20", "next_8 right", 0.86))
    for cell in ("m=60", "m=200", "two reflectors"):
        yield Bar(f"space, none, {cell}", "alarm", 0.07, at_most=True)
        yield Bar(f"space, lambda 8, {cell}", "exact", 0.8)
        yield Bar(f"space, lambda 8, {cell}", "in the set", 0.95)
    for cell in ("two, lambda 8", "two, lambda 8, m=200", "three outliers, lambda 8"):
        yield Bar(f"space, {cell}", "exact", 0.8)
    yield Bar("space, three outliers, lambda 8", "outliers listed", 1.0)
    yield from (Bar(f"space, outside, lambda {lam}", "located", 0.95) for lam in (7, 10))
    for cell in ("many effects", "many effects, harmonics", "space, many effects"):
        for measure, value in (("error / true", 1.5), ("false names", 0.8), ("false unknown", 0.1)):
            yield Bar(cell, measure, value, at_most=True)
        yield from (Bar(cell, "effects named", 0.8), Bar(cell, "intervals, all", 0.92))
    for m in (50, 100, 300):
        yield Bar(f"many small effects, m={m}", "error / true", 1.6, at_most=True)
        yield Bar(f"many small effects, m={m}", "inside tip intervals", 0.88)
        yield Bar(f"six to nine effects, m={m}", "error / true", 1.1, at_most=True)
        yield Bar(f"six to nine effects, m={m}", "false names", 0.4, at_most=True)
        yield Bar(f"six to nine effects, m={m}", "effects named", 0.9)
        yield Bar(f"six to nine effects, m={m}", "inside tip intervals", 0.94)
    most = {"no effect": 0.03, "wrong place": 0.15, "error / geometry": 0.55, KEEPS: 0.1}
    yield from (Bar(ALL_OUTSIDE, measure, value, at_most=True) for measure, value in most.items())
    yield Bar(ALL_OUTSIDE, "inside tip intervals", 0.85)
    for kind, value in (("quantized", 0.04), ("reach, m=100", 0.04), ("outliers, m=100", 0.04)):
        yield Bar(f"none, {kind}", "alarm", value, at_most=True)
    yield from (Bar(f"none, {kind}", "alarm", 0.07, at_most=True) for kind in ("Student t3", "serial, m=100"))
    yield Bar("none, random walk", "wrong place", 0.1, at_most=True)
    yield Bar("three reads, none", "false names", 0.05, at_most=True)
    for cell in ("three reads, none", "three reads, six to nine effects"):
        yield from (Bar(cell, "promised / reached", 0.85), Bar(cell, "promised / reached", 1.15, at_most=True))
    yield Bar(ALL, "contradiction", 0.0, at_most=True)
    for measure in ("calibration error", "said less right, 0.7 to 0.95"):
        yield Bar(ALL, measure, 0.03, at_most=True)
    for measure in ("intervals, base", "intervals, effects"):
        yield from (Bar(ALL, measure, 0.93), Bar(ALL, measure, 0.97, at_most=True))


BARS = tuple(_bars())


def scored_table(truth: pl.DataFrame, found: pl.DataFrame) -> BlindStudy:
    """Join the table of truths and that of diagnoses."""
    failures = sum(int((frame["status"] != "done").sum()) for frame in (truth, found))
    hidden = {(row["cell"], row["set"]): row for row in truth.iter_rows(named=True) if row["status"] == "done"}
    done = [row for row in found.iter_rows(named=True) if row["status"] == "done"]
    families = {name: cls.family for name, cls in library().items()}
    sets = [
        scored_set({**row, **hidden[place]}, families) for row in done if (place := (row["cell"], row["set"])) in hidden
    ]
    cells = [
        row
        for cell in dict.fromkeys(s["cell"] for s in sets)
        for row in _measures([s for s in sets if s["cell"] == cell])
    ]
    beyond = [s for s in sets if s["hidden_class"] == OUTSIDE and "error / geometry" in s]
    cells += [*_measures(beyond, ALL_OUTSIDE)] if len({s["cell"] for s in beyond}) > 1 else []
    cells += [*calibration(sets), *(row for row in _measures(sets, ALL) if row["measure"] in OF_ALL)]
    pairs = Counter((s["hidden_class"], s["named_class"]) for s in sets)
    confusion = [{"hidden": a, "named": b, "count": n} for (a, b), n in pairs.most_common()]
    return BlindStudy(
        frame_of(cells),
        frame_of(list(_against_bars(cells))),
        frame_of(confusion),
        frame_of(reliability(sets)),
        frame_of(sets),
        failures,
    )


def scored_set(row: Mapping[str, Any], families: Mapping[str, str]) -> dict[str, Any]:
    """One data set: what was hidden, what was named, and in which respects that is right (None: not asked)."""
    known, outside = row["verdict"] != "unknown", row.get("outside") is not None
    hidden, named = sorted(row["hidden"] or ()), sorted(row["named"] or ())
    judgement = {
        "cell": row["cell"],
        "set": row["set"],
        "hidden": " + ".join(hidden)
        or (f"outside the library, {row['place'] or row['outside']}" if outside else NOTHING),
        "named": " + ".join(named + ([] if known else [f"unknown, {row['where']}"])) or NOTHING,
        "hidden_class": _classes(hidden, families, OUTSIDE if outside else None),
        "named_class": _classes(named, families, None if known else "unknown"),
        "alarm": row["verdict"] != "none",
    }
    if hidden:
        judgement |= _names_judged(row, judgement)
    if outside:
        judgement |= _places_judged(row)
    if row["wrong_rows"]:
        judgement["outliers listed"] = set(row["wrong_rows"]) <= set(row["outlier_rows"] or ())
    judgement |= probability_judged(row) | intervals_judged(row, judgement.get("exact", False)) | _many_judged(row)
    return judgement | _gaps_judged(row) | _further_judged(row, judgement, families)


def _names_judged(row: Mapping[str, Any], judgement: Mapping[str, Any]) -> dict[str, Any]:
    """Names, classes and the ambiguity set, where the library has everything that was hidden."""
    known, options = row["verdict"] != "unknown", row["candidates"] or []
    hidden, named = sorted(row["hidden"]), sorted(row["named"] or ())
    return {
        "exact": known and named == hidden,
        "class": judgement["hidden_class"] == judgement["named_class"],
        "in the set": known and " + ".join(hidden) in options,
        "size of the set": len(options) or None,
    }


def _places_judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """Where something outside the library was hidden: where it is said to be, unless no place is right."""
    named, unknown = row["named"] or (), row["verdict"] == "unknown"
    sure = row["verdict"] in ("named", "ambiguous") and (row.get("probability") or 0.0) >= SURE
    judged: dict[str, Any] = {"no effect": row["verdict"] == "none", f"named at {SURE:g}": sure}
    if row["place"] is not None:
        right = set(row["place"].split(" or "))
        said = [places_of_effect(key) for key in named] + ([{row["where"]}] if unknown and row["where"] else [])
        judged["located"] = unknown and row["where"] in right
        judged["wrong place"] = any(not places & right for places in said)
    return judged


def places_of_effect(key: str) -> set[str]:
    """Where an effect of the library is: its joint, the time or the temperature that it follows, the workspace."""
    name, _, joint = key.partition(":")
    followed = {place for place, names in FOLLOWING.items() if name in names}
    return followed | ({f"joint:{joint}"} if joint else set()) or {"arm"}


FOLLOWING = {
    "time": ("base_drift", "base_rotation_drift", "base_step", "thermal_transient", "joint_step", "link_step"),
    "temperature": ("thermal_growth",),
    "workspace": ("axes_skew", "measurement_scale"),
}


def contradictions(said: Mapping[str, Any]) -> list[str]:
    """Where verdict, effects and probabilities of a diagnosis (`Diagnosis.to_json`) contradict each other."""
    chance = dict(said["probabilities"])
    none, unknown, verdict = chance.pop("none"), chance.pop("unknown"), said["verdict"]
    others = {" + ".join(one["effects"]): one["probability"] for one in said["other_sets"]}
    named = " + ".join(said["effects"])
    own = chance.get(named, 0.0)
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
        "named at less than a half": verdict == "named" and own < 0.5,
        "named less likely than others": verdict in ("named", "ambiguous") and own < max(rivals, default=0.0),
        "named beside its equals": verdict == "named" and len(chance) > 1 and own < 0.5,
        "ambiguous alone": verdict == "ambiguous" and len(chance) < 2 and own >= 0.5,
        "unknown less likely than names or none": verdict == "unknown" and unknown < max(none, of_library) - 1e-9,
    }
    return [doubt for doubt, there in wrong.items() if there]


def _many_judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """Where the hold-out is known without noise: the written model's error and intervals there, and where many effects
    were hidden, each of them, what else was named, and all intervals."""
    judged: dict[str, Any] = {"contradiction": bool(row["contradictions"])} if "contradictions" in row else {}
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
    return (
        judged
        | ({"effects named": len(hidden & named) / len(hidden)} if hidden else {})
        | {"intervals, all": share_inside(row)}
    )


def _gaps_judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """The held-out gap relative to those of the models it is compared with."""
    gap = row["gap_named_mm"]
    return {f"gap / {rival}": gap / row[column] for rival, column in RIVALS.items() if gap and row.get(column)}


def _further_judged(
    row: Mapping[str, Any], judgement: Mapping[str, Any], families: Mapping[str, str]
) -> dict[str, Any]:
    """The same set with further postures, where it was ambiguous."""
    found: dict[str, Any] = {}
    if row.get("next_2_verdict") is not None:
        found["next_0 right"] = judgement["exact"]
    for way in FURTHER:
        if (verdict := row.get(f"{way}_verdict")) is not None:
            again = sorted(row[f"{way}_named"] or ())
            right = verdict in ("named", "ambiguous") and again == sorted(row["hidden"])
            kind = "gravity" if judgement["hidden_class"] == "gravity" else "others"
            found |= {f"{way} right": right, f"{way} right, {kind}": right}
            found[f"{way} right, alone"] = right and verdict == "named"
            found[f"{way} class"] = _classes(again, families, None) == judgement["hidden_class"]
            found[f"{way} predicted"] = row.get(f"{way}_chance")
    return found


def _classes(keys: Sequence[str], families: Mapping[str, str], more: str | None) -> str:
    """Classes of effects, joints left out; `nothing` for none."""
    names = sorted(families.get(name, name) for name in (key.partition(":")[0] for key in keys))
    return " + ".join([*names, *([more] if more else [])]) or NOTHING


def _measures(sets: Sequence[Mapping[str, Any]], cell: str | None = None) -> Iterator[dict[str, Any]]:
    """Mean and standard error of everything that was judged in a cell; of `MEDIANS` the median."""
    texts = ("cell", "set", "hidden", "named", "hidden_class", "named_class")
    for measure in dict.fromkeys(name for row in sets for name in row if name not in texts):
        values = [row[measure] for row in sets if row.get(measure) is not None]
        if not values:
            continue
        mean, n = float(np.mean(values)), len(values)
        if isinstance(values[0], bool):  # never claims to be certain: at least the error of half a set
            error = sqrt(max(mean * (1.0 - mean), 0.25 / n) / n)
        elif measure in MEDIANS:  # half the width of the interval that holds the median in 0.68 of cases
            mean = float(np.median(values))
            ranks = np.clip(0.5 * n + 0.5 * sqrt(n) * np.array([-1.0, 1.0]) - 0.5, 0, n - 1)
            error = 0.5 * float(np.ptp(np.interp(ranks, np.arange(n), np.sort(values)))) if n > 1 else float("inf")
        else:
            error = float(np.std(values, ddof=1)) / sqrt(n) if n > 1 else float("inf")
        yield {"cell": cell or sets[0]["cell"], "measure": measure, "value": mean, "standard_error": error, "count": n}


def _against_bars(cells: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    figures = {(row["cell"], row["measure"]): row for row in cells}
    for bar in BARS:
        if (row := figures.get((bar.cell, bar.measure))) is not None:
            asked = f"{'<=' if bar.at_most else '>='} {bar.value:g}"
            yield {**row, "asked": asked, "outcome": bar.outcome(row["value"], row["standard_error"])}
