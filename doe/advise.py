"""How many measurements? Efficiency and expected accuracy against the number of runs.

The number matters more than the solver: 10 runs can be worse than 8 (doe/README.md, "Exact plans").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from doe.design import Design
from doe.plan.tip_error import TipError, robust_or_none, tip_error
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification.errors import InputError
from identification.kinematics.parameters import LENGTH_ERROR
from identification.progress import Progress, silent


@dataclass(frozen=True)
class Advice:
    """The best plan found for every number of runs asked for.

    designs : in the order of `runs`
    target : wanted accuracy [mm], see `accuracy`, or None
    tip_errors : of every design, if the model is right and if effects are missing; empty where no sizes are known
    """

    designs: tuple[Design, ...]
    target: float | None = None
    tip_errors: tuple[TipError, ...] = ()

    @property
    def runs(self) -> tuple[int, ...]:
        """The numbers of runs."""
        return tuple(len(design.plan) for design in self.designs)

    @property
    def of_tip(self) -> bool:
        """True where accuracy is that of the tip: a geometry with a prior has deviations of that prior's size, and of
        another no length may be estimated."""
        if not self.tip_errors:
            return False
        problem = self.designs[0].problem
        return bool(problem.deviations) or not any(p.kind == LENGTH_ERROR for p in problem.model.parameters)

    def accuracy(self, design: Design) -> float | None:
        """Of one of the designs the largest expected standard deviation of a length of the arm's geometry [mm], or the
        expected error of the tip if the model is right (`of_tip`); None without sigma."""
        if self.of_tip:
            return next(e.right for d, e in zip(self.designs, self.tip_errors, strict=True) if d is design)
        return None if design.deviations is None else design.deviations.largest_length

    @property
    def smallest(self) -> Design | None:
        """The plan with the fewest runs that reaches the target; None if none does (or there is no target)."""
        if self.target is None:
            return None
        reached = (d for d in self.designs if (found := self.accuracy(d)) is not None and found <= self.target)
        return min(reached, key=lambda d: len(d.plan), default=None)

    def efficient_runs(self, efficiency: float = 0.999) -> tuple[int, ...]:
        """Numbers of runs whose plan is at the bound: efficiency at least `efficiency`."""
        return tuple(len(d.plan) for d in self.designs if d.efficiency is not None and d.efficiency >= efficiency)

    def to_json(self) -> dict[str, Any]:
        """One row per number of runs, and the smallest number for the target."""
        smallest = self.smallest
        return {
            "rows": [self._row(k) for k in range(len(self.designs))],
            "target_mm": self.target,
            "smallest_runs": None if smallest is None else len(smallest.plan),
        }

    def _row(self, k: int) -> dict[str, Any]:
        data = self.designs[k].to_json()
        keys = ("runs", "log_det", "bound", "efficiency", "certified_optimal", "std", "status")
        tip = self.tip_errors[k].to_json() if self.tip_errors else None
        known = self.designs[k].deviations
        largest = None if known is None else known.largest_length
        return {key: data[key] for key in keys} | {"largest_length_std_mm": largest, "tip_error_mm": tip}


def advise(
    problem: DesignProblem,
    runs: Sequence[int],
    *,
    target: float | None = None,
    seed: int = 0,
    seconds_each: float | None = None,
    progress: Progress = silent,
) -> Advice:
    """Design a plan for every number of runs; stop early only by Ctrl-C, which keeps what is there.

    target : wanted accuracy [mm], see `Advice.accuracy`; needs the arm's sigma
    Raises `InputError` for numbers of runs below the fewest possible, or a target without sigma.
    """
    fewest = problem.fewest_runs
    if not runs or min(runs) < fewest:
        raise InputError(f"runs: {min(runs, default=None)}, allowed: >= {fewest} ({problem.parameters} unknowns)")
    if target is not None and problem.model.sigma is None:
        raise InputError("target_mm: the arm file has no sigma_mm, allowed: a [measurement] table with sigma_mm")
    if target is not None and not (np.isfinite(target) and target > 0.0):
        raise InputError(f"target_mm: {target}, allowed: > 0")
    designs: list[Design] = []
    try:
        for done, m in enumerate(runs):
            progress(done, len(runs), f"{m} runs")
            designs.append(solve(problem, m, seed=seed, seconds=seconds_each))
    except KeyboardInterrupt:
        if not designs:
            raise
    wide = robust_or_none(problem)
    errors = () if wide is None else tuple(tip_error(problem, wide, design.plan.postures) for design in designs)
    return Advice(tuple(designs), target, errors)
