"""How much do the figures of the diagnosis hang on its constants? Each one smaller and larger, on sets of its own.

The blind study that the README reports draws its sets with seed 0; these have seed 11, so no constant is judged by the
figures it may have been chosen for. All settings see the same sets: what counts is how many of them change. About 25
minutes on one idle core. What it found: identification/README.md, "Constants".
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import product
from typing import Any

import pytest

from doe.studies.blind.study import blind_study

SEED, SETS, DRAWS = 11, 40, 399
NONE, ONE, TWO = "none m=50", "one, lambda 6, m=50", "two, lambda 8"
OUTSIDE, OUTLIERS, SHAKING = "outside, lambda 7", "three outliers, lambda 8", "none, joint noise"
MEASURES = {NONE: "alarm", ONE: "exact", TWO: "exact", OUTSIDE: "located", OUTLIERS: "exact", SHAKING: "alarm"}
UNMODELLED = ("unmodelled", "unmodelled_survey", "unmodelled_shapes")
MODULES = ("selection", "search", "noise", ".estimation.outlying", *UNMODELLED, "workflow", "diagnose")

# module, constant, smaller value, larger value, cells that it acts on
CONSTANTS: list[tuple[str, str, Any, Any, tuple[str, ...]]] = [
    ("selection", "ALPHA_FIRST", 0.0175, 0.07, (NONE, ONE)),
    ("selection", "ALPHA_NEXT", 0.0025, 0.01, (ONE, TWO)),
    ("unmodelled_survey", "LEVEL", 0.0005, 0.002, (OUTSIDE, ONE)),
    ("unmodelled", "ODDS", 3.0, 12.0, (OUTSIDE, TWO)),
    ("unmodelled_survey", "BOOTSTRAP_LEVEL", 0.025, 0.1, (OUTSIDE,)),
    ("search", "WAVES", 2, 6, (OUTSIDE,)),
    (".estimation.outlying", "OUTLIER", 3.0, 12.0, (OUTLIERS,)),
    ("noise", "HINT", 0.1, 0.4, (SHAKING,)),
    ("noise", "LEVEL", 0.005, 0.02, (SHAKING,)),
    ("search", "LEVEL_FACTOR", 0.25, 1.0, (SHAKING,)),
    ("workflow", "CREDIT", 3.0, 12.0, (OUTSIDE,)),
    ("selection", "WINDOW", 3.0, 12.0, (ONE,)),
    ("unmodelled_shapes", "CENTRES", 12, 48, (OUTSIDE,)),
    ("workflow", "PASSES", 2, 8, (SHAKING,)),
    ("selection", "ALPHA_SEVERAL", 1e-6, 1e-4, (TWO,)),
    ("selection", "MARGIN", 4.0, 16.0, (ONE,)),
    ("selection", "REFITS", 3, 12, (ONE,)),
]


@contextmanager
def changed(module: str, name: str, value: Any) -> Iterator[None]:
    """A constant replaced wherever it was imported to."""
    loaded = [importlib.import_module(f".{part}", "identification.gap") for part in MODULES]
    before = getattr(importlib.import_module(f".{module}", "identification.gap"), name)
    places = [place for place in loaded if getattr(place, name, None) is before]
    for place in places:
        setattr(place, name, value)
    try:
        yield
    finally:
        for place in places:
            setattr(place, name, before)


def judged(cell: str) -> dict[str, dict[int, float]]:
    """Measure -> set -> what it is in that set."""
    study = blind_study([cell], SETS, seed=SEED, draws=DRAWS)
    assert study.failures == 0
    found = study.sets
    names = [name for name in (MEASURES[cell], "class", "in the set", "size of the set") if name in found.columns]
    return {
        name: {row["set"]: float(row[name]) for row in found.iter_rows(named=True) if row[name] is not None}
        for name in names
    }


as_set = cache(judged)


@pytest.mark.benchmark
@pytest.mark.parametrize(("module", "name", "smaller", "larger", "cells"), CONSTANTS, ids=lambda x: str(x)[:24])
def test_constant(module: str, name: str, smaller: Any, larger: Any, cells: tuple[str, ...]) -> None:
    """No other value is clearly better: by less than three standard errors of the sets that change."""
    for cell, value in product(cells, (smaller, larger)):
        now = as_set(cell)
        with changed(module, name, value):
            other = judged(cell)
        for measure, figures in now.items():
            up = sum(other[measure].get(k, one) > one for k, one in figures.items())
            down = sum(other[measure].get(k, one) < one for k, one in figures.items())
            means = [sum(found.values()) / len(found) for found in (figures, other[measure])]
            print(
                f"\n{name} = {value}: {cell}: {measure} {means[0]:.3f} -> {means[1]:.3f}, {up} up, {down} down", end=""
            )
            if measure != "size of the set":
                better = down - up if measure == "alarm" else up - down
                assert better <= 3.0 * (up + down) ** 0.5
