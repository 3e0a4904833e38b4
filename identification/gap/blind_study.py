"""The blind study: how often is diagnosis right on data whose effect it does not know?

The truth comes from a simulator that the caller provides (the project's own is a second implementation in plain numpy,
under tests), so that what is fitted is not what made the data. `diagnose` sees arm, measurements and hold-out only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan, sqrt
from typing import Any

import numpy as np

from identification.gap.case import Case
from identification.gap.diagnose import diagnose
from identification.gap.diagnosis import Diagnosis
from identification.gap.fit import fit, links_start
from identification.gap.whitening import Rows
from identification.model import Model
from identification.progress import Progress, silent

Simulator = Callable[[str, int], Case]  # (cell, seed) -> case


@dataclass(frozen=True)
class Outcome:
    """How one diagnosis compares with the truth. `family` maps an effect's key to its class."""

    truth: tuple[str, ...]
    found: tuple[str, ...]
    alarm: bool  # something was named or flagged
    exact: bool
    same_class: bool
    contained: bool
    size: int
    class_size: int
    placed: bool
    gap_ratio: float  # held-out gap, named model over true model


def outcome(case: Case, found: Diagnosis, families: Mapping[str, str]) -> Outcome:
    """Compare."""
    truth = tuple(sorted(case.effects))
    sets = [tuple(sorted(c.effects)) for c in found.candidates]
    named = tuple(sorted(found.effects))
    known = found.verdict != "unknown"
    return Outcome(
        truth,
        named if known else (*named, f"unknown at {found.where}"),
        found.verdict != "none",
        known and named == truth,
        known and _classes(named, families) == _classes(truth, families),
        known and truth in sets,
        len(sets),
        len({_classes(s, families) for s in sets}),
        found.where is not None and found.where == case.place,
        _gap_ratio(case, found),
    )


def _classes(keys: Sequence[str], families: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(sorted(families.get(key.partition(":")[0], key) for key in keys))


def _gap_ratio(case: Case, found: Diagnosis) -> float:
    """Held-out gap of the named model over that of the true model fitted to the same rows."""
    if case.holdout is None or found.gap.held_out_after is None or case.place is not None:
        return nan
    model = Model(case.arm.with_effects(*case.arm.effects, *case.specs))
    kept = np.ones(len(case.measurements), dtype=bool)
    kept[[row - 1 for row in found.outlier_rows]] = False
    rows = Rows.of(case.measurements).pick(kept)
    true = fit(model, rows, links_start(model, rows))
    there = Rows.of(case.holdout)
    missed = there.positions - model.position(there.postures, true.values, there.conditions)
    return float(found.gap.held_out_after / np.sqrt(np.mean(np.sum(missed**2, axis=1))))


@dataclass(frozen=True)
class Cell:
    """All outcomes of one kind of case."""

    name: str
    outcomes: tuple[Outcome, ...]

    def share(self, name: str) -> tuple[float, float]:
        """Share of the outcomes with a property, and its Monte Carlo standard error."""
        value = float(np.mean([getattr(o, name) for o in self.outcomes]))
        return value, sqrt(max(value * (1.0 - value), 0.25 / len(self.outcomes)) / len(self.outcomes))

    def mean(self, name: str) -> float:
        """Mean of a number over the outcomes that named something."""
        values = [getattr(o, name) for o in self.outcomes if o.size]
        return float(np.mean(values)) if values else nan

    @property
    def gap_ratio(self) -> float:
        """Mean held-out gap of the named over that of the true model."""
        values = [o.gap_ratio for o in self.outcomes if np.isfinite(o.gap_ratio)]
        return float(np.mean(values)) if values else nan

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        names = ("alarm", "exact", "same_class", "contained", "placed")
        shares = {name: dict(zip(("share", "standard_error"), self.share(name), strict=True)) for name in names}
        sizes = {"size": self.mean("size"), "class_size": self.mean("class_size"), "gap_ratio": self.gap_ratio}
        finite = {name: value if np.isfinite(value) else None for name, value in sizes.items()}
        return {"cell": self.name, "count": len(self.outcomes), **shares, **finite}


@dataclass(frozen=True)
class BlindStudy:
    """Cells in the order they were asked for."""

    cells: tuple[Cell, ...]
    families: Mapping[str, str] = field(default_factory=dict)

    def confusion(self) -> Counter[tuple[str, str]]:
        """(hidden, named) -> how often, joints left out."""
        pairs = Counter[tuple[str, str]]()
        for cell in self.cells:
            for o in cell.outcomes:
                pairs[_short(o.truth), _short(o.found)] += 1
        return pairs

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        table = [{"hidden": a, "named": b, "count": n} for (a, b), n in self.confusion().most_common()]
        return {"cells": [cell.to_json() for cell in self.cells], "confusion": table}

    def __str__(self) -> str:
        head = f"{'cell':28} count  alarm  exact  class  in set placed   +-   size  classes gap/true"
        lines = [head]
        for c in self.cells:
            shares = [c.share(n)[0] for n in ("alarm", "exact", "same_class", "contained", "placed")]
            error = max(c.share(n)[1] for n in ("exact", "alarm", "placed"))
            figures = "  ".join(f"{s:.3f}" for s in shares)
            sizes = f"{c.mean('size'):5.2f}  {c.mean('class_size'):5.2f}   {c.gap_ratio:6.3f}"
            lines.append(f"{c.name:28} {len(c.outcomes):5}  {figures}  {error:.3f} {sizes}")
        return "\n".join(lines)


def _short(keys: Sequence[str]) -> str:
    return " + ".join(sorted(key.partition(":")[0] for key in keys)) or "none"


def blind_study(
    simulator: Simulator,
    cells: Sequence[str],
    count: int,
    seed: int = 0,
    draws: int = 499,
    progress: Progress = silent,
) -> BlindStudy:
    """Diagnose `count` data sets per cell and compare with the truth afterwards.

    simulator : makes the case of a cell from a seed; the same seed gives the same case
    """
    from identification.effects import library

    families = {name: cls.family or name for name, cls in library().items()}
    done = []
    for index, name in enumerate(cells):
        outcomes = []
        for k in range(count):
            case = simulator(name, seed + k)
            found = diagnose(case.arm, case.measurements, case.holdout, seed=k, draws=draws)
            outcomes.append(outcome(case, found, families))
            progress(index * count + k + 1, len(cells) * count, name)
        done.append(Cell(name, tuple(outcomes)))
    return BlindStudy(tuple(done), families)
