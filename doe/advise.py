"""How many measurements? Efficiency and expected accuracy against the number of runs.

The number matters more than the solver: 10 runs can tell less per run than 8 (doe/README.md, "Exact plans"). But the
more runs the more is known: each plan is begun from the one of fewer runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from doe.bounds.certificate import Bound
from doe.bounds.column_generation import bound_that_holds, bounds_of_runs
from doe.design import Design
from doe.plan.accuracy import ExpectedDeviations, TipErrors
from doe.plan.spacing import with_additions
from doe.problem.model import NEEDS_SIGMA
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from identification import Arm, Array, InputError, Progress, Status, require
from identification.document import Document, Documented, Sheet, in_a_sentence, number

# key of `tip_error_mm` -> heading
TIP_ERRORS = {
    "model_right": "model\nright\n[mm]",
    "model_right_worst": "worst\npose\n[mm]",
    "effects_missing": "effects\nmissing\n[mm]",
    "effects_missing_prior": "library\nprior\n[mm]",
}
RIGHT = "Expected tip errors at random poses in the workspace, if the model is right: RMS, and at the worst of these."
BOUND_CUT = (
    "The time limit ended the search for the bound: plans may be better than their efficiency says. Raise --seconds "
    "to find out."
)
DIAGNOSED = (
    "The model has the effects that its diagnosis found, at the sizes measured; others are not counted: armcal "
    "diagnose says which sizes its data rule out. armcal validate compares it with new measurements."
)
MISSING = (
    "The last two columns: if effects of typical size are missing, without and with identify --library-prior, which "
    "allows for them. They may rise with the runs: more runs do not help against a missing effect, which the fit hides "
    "in wrong lengths and zeros. Where effects may be missing, choose the postures with armcal design --robust."
)


@dataclass(frozen=True, repr=False)
class Advice(Documented):
    """The best plan found for every number of runs asked for.

    designs : in the order of `runs`
    target : wanted accuracy [mm], see `accuracy`, or None
    tip_errors : number of runs -> `TipErrors.of_plan` of its design; empty where no sizes are known
    """

    designs: tuple[Design, ...]
    target: float | None = None
    tip_errors: Mapping[int, Mapping[str, float]] = field(default_factory=dict)

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
        return bool(problem.deviations) or not problem.model.parameters.length_errors.size

    def accuracy(self, design: Design) -> float | None:
        """Accuracy of a design [mm]: the largest expected standard deviation of a length of the arm's geometry, or
        (`of_tip`) the expected error of the tip if the model is right. None without sigma."""
        if self.of_tip:
            return self.tip_errors[len(design.plan)]["model_right"]
        return None if design.deviations is None else design.deviations.largest("mm")

    @property
    def smallest(self) -> Design | None:
        """The plan with the fewest runs that reaches the target; None if none does (or there is no target)."""
        if self.target is None:
            return None
        reached = (d for d in self.designs if (std := self.accuracy(d)) is not None and std <= self.target)
        return min(reached, key=lambda d: len(d.plan), default=None)

    def efficient_runs(self) -> tuple[int, ...]:
        """Numbers of runs whose plan is at the bound: efficiency at least 0.999."""
        return tuple(len(d.plan) for d in self.designs if d.efficiency is not None and d.efficiency >= 0.999)

    def to_json(self) -> dict[str, Any]:
        """One row per number of runs, and the smallest number for the target."""
        keys, rows = ("runs", "log_det", "bound", "efficiency", "certified_optimal", "std", "status"), []
        for design in self.designs:
            data, expected = design.to_json(), design.deviations
            row = {key: data[key] for key in keys}
            row["largest_length_std_mm"] = None if expected is None else expected.largest("mm")
            errors = self.tip_errors.get(len(design.plan), {})
            finite = {key: error if np.isfinite(error) else None for key, error in errors.items()}
            rows.append(row | {"tip_error_mm": finite or None})
        smallest = None if self.smallest is None else len(self.smallest.plan)
        return {"rows": rows, "target_mm": self.target, "smallest_runs": smallest}

    def document(self) -> Document:
        """The answer in one sentence, a row for each number of runs, and what the figures do not promise."""
        missing = any(np.isfinite(each["effects_missing"]) for each in self.tip_errors.values())  # before a diagnosis
        tips = dict([*TIP_ERRORS.items()][: 4 if missing else 2]) if self.tip_errors else {}
        of_lengths = not self.of_tip and any(design.deviations for design in self.designs)
        headings = ["runs", "efficiency", *(["length\nstd\n[mm]", "angle\nstd\n[deg]"] if of_lengths else [])]
        rows = []
        for runs, design in zip(self.runs, self.designs, strict=True):
            star, sure = " *" if (design.efficiency or 0.0) >= 0.999 else "  ", design.deviations  # of the bound
            row = [str(runs), f"{number(design.efficiency, 5)}{star}"]
            if of_lengths:
                largest = (None, None) if sure is None else (sure.largest("mm"), np.degrees(sure.largest("rad")))
                row += [number(value, 5) for value in largest]
            rows.append([*row, *(number(self.tip_errors[runs][key], 4) for key in tips)])
        parts: list[Any] = [Sheet([*headings, *tips.values()], rows, most=40)]
        parts += ["* within 0.1 % of the bound."] if self.efficient_runs() else []
        parts += [BOUND_CUT] if any(design.bound and design.bound.cut for design in self.designs) else []
        parts += [design.status.value for design in self.designs if design.status is Status.interrupted]
        parts += [RIGHT, MISSING if missing else DIAGNOSED] if self.tip_errors else []
        return Document("How many runs", [self.verdict], parts)

    @property
    def verdict(self) -> str:
        """What to do, in one line."""
        runs = np.array(sorted(self.efficient_runs()), dtype=int)
        stretches = np.split(runs, np.flatnonzero(np.diff(runs) != 1) + 1) if runs.size else []
        good = ", ".join(f"{part[0]}" if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in stretches)
        efficient = f"Plans within 0.1 % of the bound exist for m = {good}."
        efficient = efficient if good else "None of these plans is within 0.1 % of the bound."
        if self.target is None:
            return efficient
        if (smallest := self.smallest) is None:
            return f"None of these plans, of up to {max(self.runs)} runs, reaches {self.target:g} mm. {efficient}"
        of = "at the tip" if self.of_tip else "in each length"
        lacks = self.tip_errors.get(len(smallest.plan), {}).get("effects_missing", np.inf)
        missing = f"; at the tip {in_a_sentence(lacks)} mm if effects of typical size are missing"
        right = f"if the model is right{missing if np.isfinite(lacks) else ''}"
        return f"{len(smallest.plan)} runs suffice for {self.target:g} mm {of}, {right}. {efficient}"


def with_scatter(arm: Arm) -> tuple[Arm, str]:
    """The arm with a sigma, where it has none the scatter that its calibration left; and where it comes from, or what
    is missing without one."""
    if arm.sigma is not None:
        return arm, ""
    if arm.calibration is None or (scatter := arm.calibration.scatter) is None:
        return arm, f"No standard deviations and no tip error: computing them {NEEDS_SIGMA}."
    scatter_in_words = f"sigma_mm = {scatter:.3g}, the residual scatter of its identification"
    return replace(arm, sigma=scatter), f"The arm file has no sigma_mm: {scatter_in_words}, is used instead."


def advise(
    problem: DesignProblem,
    runs: Sequence[int],
    *,
    target: float | None = None,
    seed: int = 0,
    seconds: float | None = None,
    progress: Progress = Progress(),
) -> Advice:
    """Design a plan for every number of runs; stop early only by Ctrl-C, which keeps what is there.

    No plan is worse than the one of fewer runs with the best postures added, neither by the criterion of its whole
    information nor by what it promises if the model is right: another one takes its place only if it is better.
    target : wanted accuracy [mm], see `Advice.accuracy`; needs the arm's sigma
    seconds : for everything, of which the bounds may take up to a quarter; shared by the numbers of runs
    Raises `InputError` for numbers of runs below the fewest possible, or a target without sigma.
    """
    fewest, sigma = problem.fewest_runs, problem.model.sigma
    if not runs or min(runs) < fewest:
        raise InputError(f"runs: {min(runs, default=None)}, allowed: >= {fewest} ({problem.parameters} unknowns)")
    require(target is None or sigma is not None, f"--target-mm {NEEDS_SIGMA}")
    if target is not None and not (np.isfinite(target) and target > 0.0):
        raise InputError(f"--target-mm: found {target:g}, allowed: > 0")
    began, budget = perf_counter(), np.inf if seconds is None else seconds
    errors = TipErrors.of(problem, max(runs))
    # of the time, at most
    bounds = bounds_of_runs(problem, sorted(runs), lambda: perf_counter() > began + 0.25 * budget)
    designs: dict[int, Design] = {}
    fewer: Design | None = None

    def keeps(most: Array, postures: Array) -> bool:
        return bool(np.all(promised(problem, postures, errors) <= most))

    try:
        for done, m in enumerate(sorted(set(runs))):
            progress(done, len(runs), f"{m} runs")
            begin, most = None, np.array(np.inf)
            if fewer is not None:
                generator = np.random.default_rng([seed, m])
                begin = with_additions(problem, fewer.plan.postures, m - len(fewer.plan), generator)
                most = promised(problem, fewer.plan.postures, errors) * (1.0 + 1e-9)  # as good to rounding
            design = solve(
                problem,
                m,
                seed=seed,
                # random ones beside the plan of fewer runs
                starts=5 if problem.many_parameters and begin is not None else None,
                seconds=None if seconds is None else max(began + seconds - perf_counter(), 0.0) / (len(runs) - done),
                bound=bounds[m] or Bound(np.inf, "continuous"),  # none is computed
                begin=begin,
                accepted=partial(keeps, most),
            )
            held = bound_that_holds(problem, bounds[m], design.plan.postures, design.value)
            designs[m] = fewer = replace(design, bound=held)
            if design.status is Status.interrupted:  # by Ctrl-C, which the search for a plan keeps to itself
                break
    except KeyboardInterrupt:
        if not designs:
            raise
    made = tuple(designs[m] for m in runs if m in designs)
    return Advice(made, target, {len(d.plan): errors.of_plan(d.plan.postures) for d in made if errors is not None})


def promised(problem: DesignProblem, postures: Array, errors: TipErrors | None) -> Array:
    """(k,) what falls with every run added: expected deviations, and errors of the tip if the model is right."""
    expected = ExpectedDeviations.of(problem, postures)
    deviations = [np.inf, np.inf] if expected is None else [expected.largest("mm"), expected.largest("rad")]
    of_tip = {} if errors is None else errors.of_plan(postures)
    return np.array([*deviations, *(error for key, error in of_tip.items() if key.startswith("model_right"))])
