"""A plan with its certificate, recomputed from the stored problem: no number of a solver is passed on."""

from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.certificate import CERTIFIED, NUMERICAL, PROVEN, Bound, PlanOfProblem
from doe.bounds.column_generation import best_known_bound, bound_that_holds
from doe.bounds.planar_theorem import table_1_max_residual
from doe.plan.accuracy import ExpectedDeviations, error_at_poses, indistinct
from doe.plan.moves import Drive
from doe.plan.spacing import places_of_free_joint
from doe.problem.model import turns
from doe.problem.problem import DesignProblem
from identification import InputError, Plan, Status
from identification.document import Document, Sheet, count_of, in_a_sentence, number

BEST_KNOWN = "best known"  # what a plan is of which no bound says that it is optimal
WHAT_TO_FIT = (  # not `identify --library-prior` at once: what has a name corrects more (identification/README.md)
    "armcal diagnose names those that the data show; identify --library-prior allows for all without naming any, and "
    "the tip error expected here is that of such a fit only"
)


@dataclass(frozen=True, repr=False)
class Design(PlanOfProblem):
    """A plan with its certificate.

    problem : what it was made or judged for;  plan : the postures, in the order of measurement
    bound : upper bound of the criterion over the design space, None: not known
    status : how the search ended
    solver, starts, seconds : how it was searched for
    """

    bound: Bound | None = None
    status: Status = Status.scored
    solver: str | None = None
    starts: int = 0
    seconds: float = 0.0

    @cached_property
    def not_identifiable(self) -> tuple[str, ...]:
        """Combinations of parameters that the plan does not determine (`indistinct`). M cannot tell singular values
        below about 1e-7 of the largest from zero: `value` is then -inf although they count here."""
        return indistinct(self.problem, self.plan.postures, self.plan.weights)

    @cached_property
    def missed(self) -> dict[int, str]:
        """Runs (from 1) beyond joint limits or constraints by more than rounding -> which, and by how much."""
        problem, q, fits = self.problem, self.plan.postures, 1e-6  # [rad], [mm]: what rounding of a file does
        # joints that may take every angle moved into their limits by whole turns, unless the model sees it
        middle, rotary = 0.5 * (problem.lower + problem.upper), turns(problem.model)
        rotary &= problem.upper - problem.lower >= 2.0 * np.pi - fits
        moved = np.where(rotary, q - 2.0 * np.pi * np.round((q - middle) / (2.0 * np.pi)), q)
        change = np.abs(problem.scaled_jacobians(moved) - problem.scaled_jacobians(q)).max()
        angles = moved if change < 1e-9 else q  # relative to what a whole parameter does: rounding
        return self.plan.missed(np.maximum(problem.lower - angles, angles - problem.upper), problem.walls, fits)

    @cached_property
    def no_efficiency(self) -> str | None:
        """Why there is no efficiency; None where there is one."""
        if outside := [*self.missed]:
            listed = ", ".join(map(str, outside[:10])) + ", ..." * (len(outside) > 10)
            are = f"run {listed} is" if len(outside) == 1 else f"runs {listed} are"
            return f"{are} outside joint limits or constraints, where no bound applies"
        if self.bound is None:
            return "no bound is known"
        if self._share_of(self.bound) > 2.0 - CERTIFIED:
            return f"the plan is better than the bound ({self.bound}), which is therefore not valid"
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
        """True if the plan is allowed and no allowed plan can be better by more than 1e-6 of efficiency."""
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
            "outside_limits": list(self.missed),
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

    def driven(self, drive: Drive) -> Self:
        """With the measurements as they are driven through; a plan with other postures is not what was searched for."""
        replaced = drive.data.get("moves", {}).get("replaced", 0)
        return replace(self, plan=drive.plan, status=Status.replaced if replaced else self.status)

    # -- in words --------------------------------------------------------------------------------------------------
    def document(self) -> Document:
        """Value, bound, efficiency, what a person reads first; then the postures, the accuracy, what may be missing."""
        plan, beside = self.plan, self.columns_beside
        if plan.weights is not None:
            beside["weight"] = [f"{share:.5f}" for share in plan.shares]
        parts = [self._facts(), *self._remarks(), plan.sheet("Plan", beside, 24), *self._accuracy(), *self._missing()]
        return Document("Plan", [self.verdict], parts)

    @property
    def verdict(self) -> str:
        """How good the plan is, in a sentence or two."""
        runs, bound = count_of(len(self.plan), "run"), self.bound
        least = "at least " if bound is not None and bound.cut else ""  # a search to its end lowers the bound
        criterion = self.problem.criterion.name + (f", {self.optimality_in_words}" if self.certified_optimal else "")
        if not (error := self.expected_error):
            why = self.no_efficiency
            efficiency = f"no efficiency: {why}" if why else f"an efficiency of {least}{self.efficiency:.4f}"
            return f"The plan of {runs} has {efficiency} ({criterion})."
        sentence = f"The plan of {runs} (criterion {criterion}) has an expected tip error of "
        listed = self.problem.choices is not None and not self.problem.sampled
        where = "candidates" if listed and not getattr(self.problem.model, "tied", False) else "workspace"
        sentence += f"{in_a_sentence(error['plan'])} mm, RMS over the {where} or --test-poses"
        sentence += f", if fitted by armcal identify --{fit}" if (fit := self.problem.fit) else ""
        if bound is None or error["bound"] is None or self.efficiency is None:
            return f"{sentence}."  # no bound applies to a plan outside the limits
        kind = "" if bound.rigorous else " (a numerical bound)"
        sentence += f"; no plan of {runs} from {bound.postures} can be below {in_a_sentence(error['bound'])} mm{kind}"
        # a plan of whole runs should reach nine tenths of the bound where it determines every parameter
        hope = "Do not expect a value near 1: the" if self.efficiency < 0.9 else "The"
        judge = f"{hope} bound allows fractions of a run. Judge the plan by the error in mm."
        if self.problem.beyond:
            shared = in_a_sentence(float(np.sqrt(self.problem.beyond)))
            judge += f" No plan can reduce {shared} mm RMS of this error; the efficiency leaves it out."
        return f"{sentence}. Efficiency {least}{self.efficiency:.4f}. {judge}"

    def _facts(self) -> Sheet:
        """Value, bound, efficiency; of criterion I not its own scale, which says nothing more than the millimetres."""
        bound, kind, in_mm = self.bound, self.problem.criterion.name, self.expected_error is not None
        table_1, runs, links = self.table_1_max_residual, len(self.plan), self.plan.links
        words = bound.words if bound and not self.missed else ""
        highest = f"{number(bound.value, 7)} ({words})" if bound and words and not in_mm else ""
        efficiency = f"-: {self.no_efficiency}" if self.no_efficiency else number(self.efficiency, 6)
        optimal = self.optimality_in_words or "not shown"
        optimal += ": the bound does not prove it optimal" if self.optimality == BEST_KNOWN else ""
        return Sheet.facts(
            {
                "criterion": f"{kind}, {count_of(runs, 'run')}, {count_of(links, 'link')}",
                f"value of {kind}": "" if kind == "D" or in_mm else number(self.value, 7),
                "information (log det M')": "" if kind == "I" else number(self.log_det, 7),
                "upper bound" if kind == "D" else f"upper bound of {kind}": highest,
                "efficiency": f"{efficiency} of the bound ({words})" if words and in_mm else efficiency,
                "optimal": optimal,
                "deviation from orthogonality (Table I)": "" if table_1 is None or kind == "I" else number(table_1, 6),
                "solver": self.solver and f"{self.solver}, {count_of(self.starts, 'start')}, {self.seconds:.2f} s",
                "status": self.status.value,
            }
        )

    def _remarks(self) -> list[str]:
        """How many postures are measured already; why there is no log det, where there is none; and what the rule
        against repeats may cost, where a search kept it and the bound is not reached."""
        problem, lines = self.problem, list[str]()
        alike = ", at one payload, temperature, time and approach direction" * bool(getattr(problem.model, "needs", ()))
        if kept := len(problem.kept):
            lines.append(f"figures are for these runs and the {kept} measured already (--keep) in one session{alike}")
        lines += [f"  run {run}: outside {what}" for run, what in [*self.missed.items()][:10]]
        if not np.isfinite(self.log_det):
            still, combinations = problem.without_effect, self.not_identifiable
            why = (
                f"not estimable from the plan: {', '.join(combinations[:4])}{', ...' * (len(combinations) > 4)}{alike}"
            )
            if not combinations:
                why = "the information matrix of the plan is singular to the precision of the computer"
            elif still:
                why = f"nothing depends on {', '.join(still)} at one payload, temperature, time and approach direction"
            lines.append(f"no log det: {why}")
        moved_apart = problem.minimum_distance > 0.0 and problem.choices is None and places_of_free_joint(problem) == 1
        if self.solver and not self.certified_optimal and len(self.plan) > 1 and moved_apart:
            better = "armcal design --repeats allows equal ones, which can be better"
            lines.append(f"postures are kept at least {problem.spacing} apart; {better}")
        return lines

    def _accuracy(self) -> list[Sheet | str]:
        """Expected standard deviations per link of a planar arm, else per parameter, those that may be missing and
        those that the prior of [machining] holds left out and counted; or why there are none."""
        problem, sigma, mean, weak = self.problem, self.problem.model.sigma, self.deviations, 0
        if sigma is None or mean is None:
            why = "the arm file has no sigma_mm" if sigma is None else "not every parameter is estimable from the plan"
            return [f"No expected standard deviations: {why}."]
        if mean.by_link:
            columns = mean.length, np.degrees(mean.orientation), np.degrees(mean.joint_offset)
            headings = ["link", "length [mm]", "orientation [deg]", "joint offset [deg]"]
            each = enumerate(zip(*columns, strict=True), start=1)
            rows = [[str(j), *(number(v, 5) for v in values)] for j, values in each]
        else:
            headings, rows = ["parameter", "std"], []
            for parameter, std in zip(mean.parameters, mean.values.tolist(), strict=True):
                # above half of the deviation before, the prior says more of a parameter than the plan
                if not parameter.of_effect and std > 0.5 * problem.deviations.get(parameter.name, np.inf):
                    weak += 1
                elif parameter.name not in problem.missing:
                    rows.append([f"{parameter.name} [{parameter.file_unit}]", number(std * parameter.to_file, 5)])
        condition = "if effects of typical size may be missing" if problem.missing else "if the model is complete"
        own = problem.fit == "library-prior"  # effects of --missing alone have none
        noise = f"{sigma:.4g} mm" + ", including an error of each posture" * own
        noise += "" if self.plan.weights is None else f", {len(self.plan)} runs distributed by the weights"
        table = Sheet(headings, rows, f"Expected standard deviations {condition} (sigma = {noise})")
        held = "more, which these postures hardly determine and the [machining] prior holds; --json lists all"
        return [table, *([f"and {weak} {held}"] if weak else [])]

    def _missing(self) -> list[str]:
        """What a plan is for where effects may be missing; or, where the model has none, that they may be."""
        problem, missing = self.problem, self.problem.missing
        held = len(problem.deviations) - len(missing)
        lines = [f"{held} corrections of the geometry have a prior from [machining]"] if held else []
        if missing:
            effects = {name.partition(":")[0].partition(".")[0] for name in missing}
            named = f"{len(missing)} parameters of {', '.join(sorted(effects))}"
            order = (
                ", which also allows for effects of the order of the rows (backlash, drifts) and expects a larger error"
            )
            more = order if problem.fit == "library-prior" else ""
            lines.append(f"Effects that may be missing, each of typical size: {named}; {WHAT_TO_FIT}{more}")
            equations = len(self.plan) * problem.model.dimension
            if equations < problem.parameters:
                few = f"{equations} equations for {problem.parameters} parameters"
                lines.append(f"{few}: a plan of so few runs stays far from the bound")
        elif problem.model.sigma is not None and not any(p.of_effect for p in problem.model.parameters):
            lines.append("The model has no effects, but a real arm has some: --robust allows for those of the library.")
        return lines


def score(problem: DesignProblem, plan: Plan | ArrayLike, bound: Bound | None = None) -> Design:
    """Any plan as a `Design`, judged against `bound` if there is one, without any solver.

    plan : a `Plan`, or its postures (m, n) [rad]. Raises `InputError` if it is no plan of this arm.
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
    """Any plan, judged against the best known bound; outside limits and constraints no bound applies, and none is
    searched for. Raises `InputError` for a plan that does not fit.

    seconds : time for the bound, which is valid even if its search is cut short
    """
    design = score(problem, plan)
    if design.missed:
        return design
    end, postures = np.inf if seconds is None else perf_counter() + seconds, design.plan.postures
    bound = best_known_bound(problem, len(postures), lambda: perf_counter() > end)
    return replace(design, bound=bound_that_holds(problem, bound, postures, design.value, lambda: perf_counter() > end))


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
