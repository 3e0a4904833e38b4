"""A design as tables for a terminal."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.bounds.bound import bound_in_words
from doe.design import BEST_KNOWN, Design, optimality_in_words
from doe.plan.expected_accuracy import ExpectedDeviations, over_draws
from doe.plan.observability import Observability
from doe.plan.order import Ordered
from doe.plan.replicate_spacing import distance_to_keep
from doe.problem.problem import DesignProblem
from doe.report.terminal import facts, in_a_sentence, judged_by_mm, number, table
from doe.report.verdict import none_below
from doe.solvers.solver import LONG_PLAN
from identification.arrays import Array
from identification.estimation.corrected_values import NARROWED
from identification.kinematics.parameters import EFFECT

WHAT_TO_FIT = (  # and not `identify --library-prior` at once: what has a name corrects more (identification/README.md)
    "armcal diagnose names those that the data show; identify --library-prior allows for all of them without names, "
    "and only of such a fit is the error at the tip that is expected here"
)


def plan_table(design: Design, most: int = 24) -> Table:
    """The postures in degrees, one row per run; long plans are cut, the file has them all."""
    headings = ["run", *(f"q{joint} [{unit}]" for joint, unit in enumerate(design.plan.units, start=1))]
    postures = enumerate(design.plan.displayed, start=1)
    rows = ([str(run), *(f"{angle:.3f}" for angle in posture)] for run, posture in postures)
    caption = f"first {most} of {len(design.plan)} runs; --out writes all"
    return table(headings, rows, "Plan", most=most, caption=caption)


def accuracy_table(design: Design) -> Table | str:
    """Expected standard deviations per link of a planar arm, else per parameter; or why there are none."""
    sigma, mean = design.problem.model.sigma, design.deviations
    if sigma is None:
        return "No expected standard deviations: the arm file has no sigma_mm."
    if mean is None:
        return "No expected standard deviations: not every parameter is estimable from the plan."
    each = design.deviations_per_draw
    over = "" if each is None else ", mean over the draws of the arm and worst of them"
    found = [deviation_columns(one) for one in ([mean] if each is None else [mean, over_draws(each, np.max)])]
    headings = [*found[0], *(f"worst {heading}" for columns in found[1:] for heading in columns)]
    values = zip(*(column for columns in found for column in columns.values()), strict=True)
    may_be_missing = set(missing_parameters(design.problem))
    hidden = may_be_missing | {*held_by_machining(design.problem, mean)}
    each_parameter = ("" if p.name in hidden else f"{p.name} [{p.file_unit}]" for p in mean.parameters)
    names = map(str, range(1, mean.length.size + 1)) if mean.planar else each_parameter
    rows = ([name, *(number(v, 5) for v in figures)] for name, figures in zip(names, values, strict=True) if name)
    first = "link" if mean.planar else "parameter"
    given = "if effects of typical size may be missing" if may_be_missing else "if the model is complete"
    return table([first, *headings], rows, f"Expected standard deviations {given} (sigma = {sigma:g} mm{over})")


def held_lines(design: Design) -> list[Text]:
    """How many parameters `accuracy_table` leaves out."""
    known = design.deviations
    weak = [] if known is None or known.planar else held_by_machining(design.problem, known)
    said = "that these postures hardly determine: the prior of [machining] holds them; --json has all"
    return [Text(f"and {len(weak)} more {said}")] if weak else []


def held_by_machining(problem: DesignProblem, deviations: ExpectedDeviations) -> list[str]:
    """Names of geometric parameters of which the plan leaves more than `NARROWED` of what was known beforehand."""
    return [
        p.name
        for p, std in zip(deviations.parameters, deviations.values.tolist(), strict=True)
        if p.kind != EFFECT and std > NARROWED * problem.deviations.get(p.name, np.inf)
    ]


def deviation_columns(deviations: ExpectedDeviations) -> dict[str, Array]:
    """Heading -> figures in the units of files, (n,) per link of a planar arm, else (p,) per parameter."""
    if not deviations.planar:
        return {"std": deviations.values * [p.to_file for p in deviations.parameters]}
    return {
        "length [mm]": deviations.length,
        "orientation [deg]": np.degrees(deviations.orientation),
        "joint offset [deg]": np.degrees(deviations.joint_offset),
    }


def summary_table(data: dict[str, Any], sentence: str) -> Table:
    """Value, bound, efficiency: what a person reads first."""
    bound, kind = data["bound"], data["criterion"]
    known = bound and not data["outside_limits"]  # no bound applies to a plan outside the limits
    searched = f"{data['starts']} start{'s' * (data['starts'] != 1)}"
    table_1 = data["table_1_max_residual"]
    bounded = "upper bound" if kind == "D" else f"upper bound of {kind}"
    kind_of_bound = bound_in_words(bound) if known else ""
    length = expected_error(data)  # then the criterion's own scale says nothing more
    rows = {
        "criterion": f"{kind}, {data['runs']} runs, {data['links']} links",
        "expected error": length,
        f"value of {kind}": None if kind == "D" or length else number(data["value"], 7),
        "information (log det M')": None if kind == "I" else number(data["log_det"], 7),
        bounded: None if length else f"{number(bound['value'], 7)} ({kind_of_bound})" if known else "-",
        "efficiency": efficiency_in_words(data, kind_of_bound if length else ""),
        "optimal": optimal_in_words(data),
        "deviation from orthogonality (Table I)": None if table_1 is None or kind == "I" else number(table_1, 6),
        "solver": f"{data['solver']}, {searched}, {data['seconds']:.2f} s" if data["solver"] else None,
        "status": sentence,
    }
    return facts((name, text) for name, text in rows.items() if text is not None)


def efficiency_in_words(data: dict[str, Any], of_bound: str) -> str:
    """The figure, or why there is none;  of_bound : what it is relative to, where a reader is to judge by the mm"""
    if data["no_efficiency"]:
        return f"-: {data['no_efficiency']}"
    judged = f" of the bound ({of_bound}). {judged_by_mm(data['efficiency'])}" if of_bound else ""
    return number(data["efficiency"], 6) + judged


def expected_error(data: dict[str, Any]) -> str | None:
    """What criterion I is about, in mm: the error by this plan, and that below which there is none."""
    if (found := data.get("expected_error_mm")) is None:
        return None
    least = found["bound"] if not data["outside_limits"] else None
    limit = "" if least is None else f"; {none_below(least, data['bound'])}"
    fit = f", if fitted by armcal identify --{data['fit']}" if data.get("fit") else ""
    return f"{in_a_sentence(found['plan'])} mm at the tip, RMS over the workspace or --test-poses{fit}{limit}"


def repeats_line(design: Design) -> list[Text]:
    """What the rule against repeats may cost, where it binds and the bound is not reached."""
    runs, apart = len(design.plan), design.problem.spacing
    better = "armcal design --repeats lets them be equal, which can be better"
    if design.solver == "random" and runs > LONG_PLAN:  # what a search of so many runs ends with, see `spread_out`
        return [Text(f"the plan is random: none was found that is better with {runs} postures {apart} apart; {better}")]
    if design.certified_optimal or distance_to_keep(design.problem, runs) == 0.0:
        return []
    return [Text(f"postures are kept {apart} apart; {better}")]


def not_estimable_line(design: Design, most: int = 4) -> list[Text]:
    """Why there is no log det: what is not estimable from the plan."""
    if np.isfinite(design.log_det):
        return []
    if design.identifies_all:
        return [Text("no log det: the information matrix of the plan is singular to the precision of the computer")]
    still, combinations = design.problem.without_effect, design.not_identifiable
    if still:
        why = "under one payload, temperature, time and approach nothing depends on"
        return [Text(f"no log det: {why} {', '.join(still)}")]
    more = ", ..." if len(combinations) > most else ""
    return [Text(f"no log det: not estimable from the plan: {', '.join(combinations[:most])}{more}")]


def missing_lines(design: Design) -> list[Text]:
    """What a plan is for where effects may be missing; or, where the model has none, that they may be."""
    problem = design.problem
    missing = missing_parameters(problem)
    held = len(problem.deviations) - len(missing)
    lines = [Text(f"{held} corrections of the geometry have the prior of its machining")] if held else []
    if missing:
        effects = {name.partition(":")[0].partition(".")[0] for name in missing}
        known = f"{len(missing)} parameters of {', '.join(sorted(effects))}"
        lines.append(Text(f"may be missing, each of its typical size: {known}; {WHAT_TO_FIT}"))
        equations = len(design.plan) * problem.model.dimension
        if equations < problem.parameters:
            found = f"{equations} equations for {problem.parameters} parameters"
            lines.append(Text(f"{found}: so few runs stay far from the bound"))
        return lines
    if problem.model.sigma is None or any(p.kind == EFFECT for p in problem.model.parameters):
        return lines
    advice = "The model has no effects, a real arm has: --robust chooses postures with the library's in mind."
    return [*lines, Text(advice)]


def missing_parameters(problem: DesignProblem) -> list[str]:
    """Names of the parameters of effects that may be missing."""
    return [p.name for p in problem.model.parameters if p.kind == EFFECT and p.name in problem.deviations]


def criteria_line(values: dict[str, float | None], error: float | None = None) -> Text:
    """The value of every criterion, all of which are better the larger they are.

    error : at the tip over the workspace [mm], what I stands for
    """
    figures = ", ".join(f"{name} {'-' if value is None else format(value, '.5g')}" for name, value in values.items())
    tip = "the tip over the workspace" + ("" if error is None else f", {in_a_sentence(error)} mm RMS")
    return Text(f"every criterion, the larger the better: {figures} (I: {tip}; Ds: what is in mm)")


def observability_line(indices: Observability) -> Text:
    """The indices O1 to O5, to compare with published plans."""
    figures = ", ".join(f"{name.upper()} {value:.4g}" for name, value in indices.to_json().items())
    return Text(f"observability indices: {figures}")


def optimal_in_words(data: dict[str, Any], most: int = 10) -> str:
    """`proven optimal` and so on, `no`, or which runs lie outside the problem, so that no bound applies."""
    outside = data["outside_limits"]
    if outside:
        more = ", ..." if len(outside) > most else ""
        are = "run {} is" if len(outside) == 1 else "runs {} are"
        return f"no: {are.format(', '.join(map(str, outside[:most])) + more)} outside joint limits or constraints"
    words = optimality_in_words(data["optimality"], data["bound"])
    return f"{words}: the bound does not say that it is optimal" if data["optimality"] == BEST_KNOWN else words or "no"


def design_tables(design: Design) -> list[Any]:
    """Everything about a plan, the summary first."""
    data = design.to_json()
    return [
        summary_table(data, design.status.value),
        *not_estimable_line(design),
        *repeats_line(design),
        plan_table(design),
        accuracy_table(design),
        *held_lines(design),
    ]


def order_line(found: Ordered) -> Text:
    """What the order of measurement costs."""
    before, after = np.degrees([found.before, found.after])
    return Text(f"order {found.order}: joint travel {before:.0f} -> {after:.0f} deg ({found.saved:.0%} saved)")
