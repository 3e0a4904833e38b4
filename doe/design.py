"""A plan with its certificate, recomputed from the stored problem: no number of a solver is passed on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.certificate import CERTIFIED, NUMERICAL, PROVEN, Bound, PlanOfProblem
from doe.bounds.column_generation import best_known_bound, bound_that_holds
from doe.bounds.planar_theorem import table_1_max_residual
from doe.plan.accuracy import ExpectedDeviations, error_at_poses, plan_jacobians
from doe.problem.model import turns
from doe.problem.problem import DesignProblem
from identification import Array, InputError, Plan, Status, spectrum

BEST_KNOWN = "best known"  # what a plan is of which no bound says that it is optimal


@dataclass(frozen=True, repr=False)
class Design(PlanOfProblem):
    """A plan with its certificate.

    problem : what it was made or judged for;  plan : the postures, in the order of measurement
    bound : no plan in the design space has a greater criterion value, None: not known
    status : how the search ended
    solver, starts, seconds : what was spent on it
    """

    bound: Bound | None = None
    status: Status = Status.scored
    solver: str | None = None
    starts: int = 0
    seconds: float = 0.0

    @cached_property
    def information(self) -> Array:
        """(p, p) M' of the plan."""
        return self.problem.information(self.plan.postures, self.plan.weights)

    @cached_property
    def not_identifiable(self) -> tuple[str, ...]:
        """Combinations of parameters that are not estimable with the plan, decided by the singular values as in
        `identify`; effects at neutral conditions never are. Where the smallest is below about 1e-7 of the largest, M
        cannot tell it from none, and `value` is -inf all the same."""
        parameters = self.problem.model.parameters
        jacobians = plan_jacobians(self.problem, self.plan.postures, self.plan.weights)
        ones = np.ones(len(parameters))
        return spectrum(jacobians, ones).combinations(parameters.names, ones)

    @cached_property
    def outside(self) -> tuple[int, ...]:
        """Runs (from 1) beyond a joint limit or a constraint by more than rounding: no bound holds for such a plan."""
        # [rad], [mm] by which a posture may miss limits and constraints: what rounding of a file does
        problem, q, fits = self.problem, self.plan.postures, 1e-6
        # joints that may take every angle moved into their limits by whole turns, unless the model sees it
        middle, rotary = 0.5 * (problem.lower + problem.upper), turns(problem.model)
        rotary &= problem.upper - problem.lower >= 2.0 * np.pi - fits
        moved = np.where(rotary, q - 2.0 * np.pi * np.round((q - middle) / (2.0 * np.pi)), q)
        change = np.abs(problem.scaled_jacobians(moved) - problem.scaled_jacobians(q)).max()
        angles = moved if change < 1e-9 else q  # relative to what a whole parameter does: rounding
        breaks = np.any((angles < problem.lower - fits) | (angles > problem.upper + fits), axis=1)
        breaks |= np.any(problem.walls.values(q) < -fits, axis=1)
        return tuple((np.flatnonzero(breaks) + 1).tolist())

    @cached_property
    def no_efficiency(self) -> str | None:
        """Why there is no efficiency; None where there is one."""
        if self.outside:
            listed = ", ".join(map(str, self.outside[:10])) + ", ..." * (len(self.outside) > 10)
            are = f"run {listed} is" if len(self.outside) == 1 else f"runs {listed} are"
            return f"{are} outside joint limits or constraints, where no bound applies"
        if self.bound is None:
            return "no bound is known"
        if self._share_of(self.bound) > 2.0 - CERTIFIED:
            return f"the plan is better than the bound ({self.bound}), which is therefore none"
        return None

    @cached_property
    def efficiency(self) -> float | None:
        """Fraction 0..1 of the runs that a plan at the bound would need; None where there is `no_efficiency`."""
        return None if self.bound is None or self.no_efficiency else min(self._share_of(self.bound), 1.0)

    def _share_of(self, bound: Bound) -> float:
        """Efficiency by a bound; above 1 by rounding, or where the search for it has missed something."""
        return self.problem.criterion.efficiency(self.value, bound.value, self.problem.parameters)

    @property
    def certified_optimal(self) -> bool:
        """True if the plan is allowed and none that is can be better by more than 1e-6 of efficiency."""
        return self.efficiency is not None and self.efficiency >= CERTIFIED

    @property
    def optimality(self) -> str | None:
        """What `certified_optimal` rests on: `proven`, a theorem, or `numerical`, a search for the bound; `best known`
        for another plan that a solver chose; None for one that was given or drawn at random."""
        if self.certified_optimal:
            return PROVEN if self.bound is not None and self.bound.rigorous else NUMERICAL
        return None if self.solver in (None, "random") else BEST_KNOWN

    @property
    def optimality_in_words(self) -> str:
        """`proven optimal`, `optimal up to a numerical bound`, `best known`, each of a list where the bound is; or
        empty."""
        among = "" if self.bound is None or self.bound.source != "grid" else f" among {self.bound.postures}"
        words = {PROVEN: f"proven optimal{among}", NUMERICAL: f"optimal{among} up to a numerical bound"}
        return words.get(self.optimality or "", self.optimality or "")

    @cached_property
    def table_1_max_residual(self) -> float | None:
        """Largest |mean exp(i (q_(j+1) + ... + q_k))|, 0 at an unconstrained optimum; None unless the arm is planar.

        Postures measured already are runs, as in M'.
        """
        if not getattr(self.problem.model, "planar", False):
            return None
        runs = np.append(self.plan.shares * len(self.plan), np.ones(len(self.problem.kept)))
        return table_1_max_residual(np.concatenate([self.plan.postures, self.problem.kept]), runs / runs.sum())

    @cached_property
    def deviations(self) -> ExpectedDeviations | None:
        """Expected standard deviations with the arm's sigma."""
        return ExpectedDeviations.of(self.problem, self.plan.postures, self.plan.weights)

    @property
    def expected_error(self) -> dict[str, float | None] | None:
        """Of criterion I: RMS error of the tip over the test poses [mm] by this `plan`, and at its `bound`, below which
        no plan is; None for other criteria and without sigma."""
        plan = error_at_poses(self.problem, self.value, len(self.plan))
        least = None if self.bound is None else error_at_poses(self.problem, self.bound.value, len(self.plan))
        return None if plan is None else {"plan": plan, "bound": least}

    def to_json(self) -> dict[str, Any]:
        """Keys of `design` and `score` (identification/files/README.md, "JSON keys"); None where unknown."""
        unknown = dict.fromkeys(("length_mm", "orientation_deg", "joint_offset_deg"))
        return {
            "criterion": self.problem.criterion.name,
            "runs": len(self.plan),
            "links": self.plan.links,
            "value": _number(self.value),
            "log_det": _number(self.log_det),
            "bound": None if self.bound is None else self.bound.as_dict(),
            "efficiency": _number(self.efficiency),
            "no_efficiency": self.no_efficiency,
            "certified_optimal": self.certified_optimal,
            "optimality": self.optimality,
            "not_identifiable": list(self.not_identifiable),
            "outside_limits": list(self.outside),
            **self.plan.to_json(),
            "fit": self.plan.fit or None,
            "table_1_max_residual": _number(self.table_1_max_residual),
            "std": unknown if self.deviations is None else self.deviations.to_json(),
            "expected_error_mm": self.expected_error,
            "solver": self.solver,
            "status": self.status.name,
            "starts": self.starts,
            "seconds": self.seconds,
        }

    def __str__(self) -> str:
        efficiency = self.no_efficiency or f"efficiency {self.efficiency:.6f}"
        optimal = f", {self.optimality_in_words}" if self.certified_optimal else ""
        value = round(self.value, 12) + 0.0  # no -1e-16
        return (
            f"{len(self.plan)} runs of a {self.plan.links}-link arm, {self.problem.criterion.name} = {value:.8g} "
            f"({efficiency}{optimal})\n  bound {self.bound or 'none'}\n  {self.status.name}: {self.status.value}"
        )


def score(problem: DesignProblem, plan: Plan | ArrayLike, bound: Bound | None = None) -> Design:
    """Any plan as a `Design`, judged against `bound` if there is one; knows no solver.

    plan : or its postures (m, n) [rad]. Raises `InputError` for what is no plan of this arm.
    """
    try:
        judged = plan if isinstance(plan, Plan) else Plan(np.asarray(plan, dtype=float))
        judged = replace(judged, joint_types=problem.model.joint_types)
    except (TypeError, ValueError):
        raise InputError(f"plan: {plan!r:.40}, allowed: an array (m, {problem.joints}) of joint angles [rad]") from None
    if judged.postures.ndim != 2 or judged.links != problem.joints:
        raise InputError(f"plan: shape {judged.postures.shape}, allowed: (m, {problem.joints})")
    if len(wrong := np.flatnonzero(~np.isfinite(judged.postures).all(axis=1))):
        raise InputError(f"plan: run {wrong[0] + 1} is not finite, allowed: finite joint angles")
    shares = judged.shares
    if shares.shape != (len(judged),) or not np.all(shares >= 0.0) or not np.isclose(shares.sum(), 1.0):
        raise InputError(f"plan: {shares.size} weights of sum {shares.sum():g}, allowed: {len(judged)} >= 0 of sum 1")
    return Design(problem, judged, bound)


def score_plan(problem: DesignProblem, plan: Plan | ArrayLike, *, seconds: float | None = None) -> Design:
    """Any plan, judged against the best bound that is known; outside limits and constraints none applies, and none is
    looked for. Raises `InputError` for a plan that does not fit.

    seconds : for the bound; cut by them it holds all the same
    """
    design = score(problem, plan)
    if design.outside:
        return design
    end, postures = np.inf if seconds is None else perf_counter() + seconds, design.plan.postures
    bound = best_known_bound(problem, len(postures), lambda: perf_counter() > end)
    held = bound_that_holds(problem, bound, postures, design.value, lambda: perf_counter() > end)
    return replace(design, bound=held)


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
