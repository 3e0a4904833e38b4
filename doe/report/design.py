"""Plans as documents: a design or a scored plan, how many runs, weights, what a plan could show, the next postures."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.bounds.certificate import ApproximateDesign
from doe.design import BEST_KNOWN, Design
from doe.plan.moves import clearance_of, said_of_collisions, unproven
from doe.plan.spacing import places_of_free_joint
from doe.problem.clearance import distance_in_words
from doe.problem.model import offers
from doe.problem.problem import DesignProblem
from doe.report.page import PlanSteps
from identification import Array, Plan, Status
from identification.document import Document, Pictures, Section, Sheet, count_of, in_a_sentence, number

if TYPE_CHECKING:
    from doe.advise import Advice
    from doe.discrimination.design import Discrimination
    from doe.discrimination.t_optimal import NextPostures
    from identification import Arm, Diagnosis

Data = Mapping[str, Any]  # what a command says with --json

WHAT_TO_FIT = (  # and not `identify --library-prior` at once: what has a name corrects more (identification/README.md)
    "armcal diagnose names those that the data show; identify --library-prior allows for all of them without names, "
    "and the error at the tip expected here is that of such a fit alone"
)


# -- armcal design, score ----------------------------------------------------------------------------------------------
def design_document(design: Design) -> Document:
    """Everything about a plan: value, bound, efficiency, what a person reads first; then the postures, the accuracy."""
    plan, beside = design.plan, columns_beside(design)
    if plan.weights is not None:
        beside["weight"] = [f"{share:.5f}" for share in plan.shares]
    numbered = enumerate(zip(plan.displayed, *beside.values(), strict=True), start=1)
    rows = [[str(run), *(f"{angle:.3f}" for angle in q), *more] for run, (q, *more) in numbered]
    table = Sheet(["run", *posture_headings(plan), *beside], rows, "Plan", 24)
    parts = [design_facts(design), *remarks(design), table, *accuracy(design)]
    return Document("Plan", [design_verdict(design)], parts)


def columns_beside(design: Design | ApproximateDesign) -> dict[str, Sequence[str]]:
    """What the model says of the postures of a plan besides, name -> (m,): the cup that each touches, say."""
    model: Any = design.problem.model
    return dict(model.plan_columns(design.plan.postures)) if offers(model, "plan_columns") else {}


def design_verdict(design: Design) -> str:
    """How good a plan is, in a sentence or two."""
    runs, bound = count_of(len(design.plan), "run"), design.bound
    optimal = f", {design.optimality_in_words}" if design.certified_optimal else ""
    criterion = f"{design.problem.criterion.name}{optimal}"
    if not (error := design.expected_error):
        why = design.no_efficiency
        efficiency = f"no efficiency: {why}" if why else f"the efficiency {design.efficiency:.4f}"
        return f"The plan of {runs} has {efficiency} ({criterion})."
    sentence = f"With the plan of {runs} (criterion {criterion}) expect an error of "
    listed = design.problem.choices is not None and not design.problem.sampled
    where = "candidates" if listed and not getattr(design.problem.model, "tied", False) else "workspace"
    sentence += f"{in_a_sentence(error['plan'])} mm at the tip, RMS over the {where} or --test-poses"
    sentence += f", if fitted by armcal identify --{fit}" if (fit := design.problem.fit) else ""
    if bound is None or error["bound"] is None or design.efficiency is None:
        return f"{sentence}."  # no bound applies to a plan outside the limits
    kind = "" if bound.rigorous else " (a numerical bound)"
    sentence += f"; no plan of {runs} from {bound.postures} is below {in_a_sentence(error['bound'])} mm{kind}"
    # a plan of whole runs should reach nine tenths of the bound where it determines every parameter
    hope = "Do not expect it near 1: the" if design.efficiency < 0.9 else "The"
    judge = f"{hope} bound allows fractions of a run. Judge by the mm."
    return f"{sentence}. Efficiency {design.efficiency:.4f}. {judge}"


def design_facts(design: Design) -> Sheet:
    """Value, bound, efficiency; of criterion I not its own scale, which says nothing more than the millimetres."""
    bound, kind, in_mm = design.bound, design.problem.criterion.name, design.expected_error is not None
    table_1, runs, links = design.table_1_max_residual, len(design.plan), design.plan.links
    words = bound.words if bound and not design.outside else ""
    highest = f"{number(bound.value, 7)} ({words})" if bound and words and not in_mm else ""
    efficiency = f"-: {design.no_efficiency}" if design.no_efficiency else number(design.efficiency, 6)
    optimal = design.optimality_in_words or "not shown"
    optimal += ": the bound does not say that it is optimal" if design.optimality == BEST_KNOWN else ""
    return Sheet.facts(
        {
            "criterion": f"{kind}, {count_of(runs, 'run')}, {count_of(links, 'link')}",
            f"value of {kind}": "" if kind == "D" or in_mm else number(design.value, 7),
            "information (log det M')": "" if kind == "I" else number(design.log_det, 7),
            "upper bound" if kind == "D" else f"upper bound of {kind}": highest,
            "efficiency": f"{efficiency} of the bound ({words})" if words and in_mm else efficiency,
            "optimal": optimal,
            "deviation from orthogonality (Table I)": "" if table_1 is None or kind == "I" else number(table_1, 6),
            "solver": design.solver and f"{design.solver}, {count_of(design.starts, 'start')}, {design.seconds:.2f} s",
            "status": design.status.value,
        }
    )


def posture_headings(plan: Plan) -> list[str]:
    """`q1 [deg]` and so on."""
    return [f"q{joint} [{unit}]" for joint, unit in enumerate(plan.units, start=1)]


def remarks(design: Design) -> list[str]:
    """How many postures are measured already; why there is no log det, where there is none; and what the rule against
    repeats may cost, where a search kept it and the bound is not reached."""
    problem, lines = design.problem, list[str]()
    alike = ", under one payload, temperature, time and approach" * bool(getattr(problem.model, "needs", ()))
    if kept := len(problem.kept):
        lines.append(f"every figure is of these runs and the {kept} measured already (--keep) in one session{alike}")
    if not np.isfinite(design.log_det):
        still, combinations = problem.without_effect, design.not_identifiable
        why = f"not estimable from the plan: {', '.join(combinations[:4])}{', ...' * (len(combinations) > 4)}{alike}"
        if not combinations:
            why = "the information matrix of the plan is singular to the precision of the computer"
        elif still:
            why = f"under one payload, temperature, time and approach nothing depends on {', '.join(still)}"
        lines.append(f"no log det: {why}")
    moved_apart = problem.minimum_distance > 0.0 and problem.choices is None and places_of_free_joint(problem) == 1
    if design.solver and not design.certified_optimal and len(design.plan) > 1 and moved_apart:
        better = "armcal design --repeats lets them be equal, which can be better"
        lines.append(f"postures are kept {problem.spacing} apart; {better}")
    return lines


def accuracy(design: Design) -> list[Sheet | str]:
    """Expected standard deviations per link of a planar arm, else per parameter, those that may be missing and those
    that the prior of [machining] holds left out and counted; or why there are none."""
    problem, sigma, mean, weak = design.problem, design.problem.model.sigma, design.deviations, 0
    missing = problem.missing
    if sigma is None or mean is None:
        why = "the arm file has no sigma_mm" if sigma is None else "not every parameter is estimable from the plan"
        return [f"No expected standard deviations: {why}."]
    if mean.by_link:
        columns = mean.length, np.degrees(mean.orientation), np.degrees(mean.joint_offset)
        headings = ["link", "length [mm]", "orientation [deg]", "joint offset [deg]"]
        rows = [[str(j), *(number(v, 5) for v in each)] for j, each in enumerate(zip(*columns, strict=True), start=1)]
    else:
        headings, rows = ["parameter", "std"], []
        for parameter, std in zip(mean.parameters, mean.values.tolist(), strict=True):
            # above half of the deviation before, the prior says more of a parameter than the plan
            if not parameter.of_effect and std > 0.5 * problem.deviations.get(parameter.name, np.inf):
                weak += 1
            elif parameter.name not in missing:
                rows.append([f"{parameter.name} [{parameter.file_unit}]", number(std * parameter.to_file, 5)])
    condition = "if effects of typical size may be missing" if missing else "if the model is complete"
    own = problem.fit == "library-prior"  # effects of --missing alone have none
    noise = f"{sigma:.4g} mm" + ", an error of each posture included" * own
    noise += "" if design.plan.weights is None else f", {len(design.plan)} runs shared out by the weights"
    table = Sheet(headings, rows, f"Expected standard deviations {condition} (sigma = {noise})")
    held = "more that these postures hardly determine: the prior of [machining] holds them; --json has all"
    return [table, *([f"and {weak} {held}"] if weak else [])]


def missing_lines(design: Design) -> list[str]:
    """What a plan is for where effects may be missing; or, where the model has none, that they may be."""
    problem, missing = design.problem, design.problem.missing
    held = len(problem.deviations) - len(missing)
    lines = [f"{held} corrections of the geometry have the prior of its machining"] if held else []
    if missing:
        effects = {name.partition(":")[0].partition(".")[0] for name in missing}
        named = f"{len(missing)} parameters of {', '.join(sorted(effects))}"
        order = ", which also allows for what follows from the order of its rows (backlash, drifts), and expects more"
        more = order if problem.fit == "library-prior" else ""
        lines.append(f"may be missing, each of its typical size: {named}; {WHAT_TO_FIT}{more}")
        equations = len(design.plan) * problem.model.dimension
        if equations < problem.parameters:
            few = f"{equations} equations for {problem.parameters} parameters"
            lines.append(f"{few}: so few runs stay far from the bound")
    elif problem.model.sigma is not None and not any(p.of_effect for p in problem.model.parameters):
        lines.append("The model has no effects, but a real arm has: --robust plans with those of the library in mind.")
    return lines


# -- a plan to step through --------------------------------------------------------------------------------------------
STEPS = (
    "Step through the runs, move them, or strike them out: what is left is computed in this page, and the edited plan "
    "is a file that armcal score reads. The figures are of criterion D for the model of the arm file alone, also where "
    "the plan was chosen by another criterion or with missing effects in mind (--robust)."
)


def plan_section(
    arm: Arm, plan: Plan, name: str = "", lead: str = "", tests: Mapping[str, Any] = MappingProxyType({})
) -> Section:
    """A part of a page in which the plan is stepped through, reordered and cut; a long one or one of weights is drawn.

    name : of the plan's file, if it has one;  tests : measurements -> what a calibrated arm in space leaves of them
    """
    from doe.report.figures import plan_figure  # deferred: tables need no pictures

    problem, postures = DesignProblem.of(arm), plan.measured
    near = said_of_collisions(problem.constraints, arm.dimension, postures)[1]
    if plan.weights is None and (moves := unproven(problem.constraints, plan.postures)):
        near.append(f"Moves: {len(moves)} of {len(plan) - 1} may collide on the way; armcal score names them.")
    title = f"The plan {name}".rstrip()
    if (steps := plan_steps(problem, plan, Path(name or "plan.csv").stem, tests)) is not None:
        short = [
            line.replace("each other:", "each other; step to a run to see which.") for line in near if line[0] != " "
        ]
        return Section(title, [PlanSteps(lambda: [f"{lead} {STEPS}".strip(), *short], steps)])
    sentence = f"{lead} {len(postures)} runs, too many or weighted: drawn only.".strip()
    return Section(title, [Pictures(lambda: [sentence, *near, plan_figure(arm, postures)])])


def plan_steps(
    problem: DesignProblem, plan: Plan, name: str = "plan", tests: Mapping[str, Any] = MappingProxyType({})
) -> dict[str, Any] | None:
    """What page.js computes log det M' of edited plans from, as `armcal score` does: rows of the file, all columns of
    which an edited plan keeps, and which rows are runs; of these lines to draw, Jacobians to 12 digits, and which
    bodies are too near to each other. None for a plan too long for it, or of weights.

    problem : of an arm;  name : of the edited file, without its ending
    """
    from doe.report.figures import outlines, scene

    def rounded(values: Array, digits: int) -> Any:
        return np.vectorize(lambda value: float(f"{value:.{digits}g}"), otypes=[float])(values).tolist()

    model: Any = problem.model
    runs, cells = plan.measured, plan.cells
    numbers = len(runs) * model.dimension * problem.parameters
    # more runs than a person steps through, or too many numbers of the Jacobians, some 12 characters each
    if plan.weights is not None or len(runs) > 200 or numbers > 150_000:
        return None
    near: list[list[dict[str, Any]]] = [[] for _ in range(len(runs))]
    clearance = clearance_of(problem.constraints)
    for each in clearance.too_near(runs) if clearance else ():
        near[each["run"] - 1].append({"bodies": each["bodies"], "text": distance_in_words(each)})
    if not cells:  # those of the file that it would have
        head, *lines = csv.reader(plan.text().splitlines()[bool(plan.fit) :])
        cells = {name: texts for name, *texts in zip(head, *lines, strict=True) if name != "run"}
    steps = {
        "file": f"{name}-edited.csv",
        "comment": f"# fit: {plan.fit}" if plan.fit else "",
        "columns": list(cells),
        "rows": [list(row) for row in zip(*cells.values(), strict=True)],
        "runs": np.flatnonzero(plan.is_run).tolist(),
        "joints": posture_headings(plan),
        "postures": rounded(plan.displayed, 6),
        "jacobians": rounded(problem.scaled_jacobians(runs).reshape(len(runs), -1), 12),
        "parameters": problem.parameters,
        "precisions": rounded(problem.precisions, 12),
        "points": rounded(model.points(runs), 5),
        "near": near,
        "outlines": [{"line": rounded(line, 5), "forbidden": forbidden} for line, forbidden in outlines(model.arm)],
    }
    return steps if model.arm.chain.projection is None else steps | {"scene": scene(model, plan.postures, tests)}


# -- armcal advise -----------------------------------------------------------------------------------------------------
# key of `tip_error_mm` -> heading
TIP_ERRORS = {
    "model_right": "model\nright\n[mm]",
    "model_right_worst": "worst\npose\n[mm]",
    "effects_missing": "effects\nmissing\n[mm]",
    "effects_missing_prior": "library\nprior\n[mm]",
}
RIGHT = (
    "Expected errors of the tip where nothing was measured, if the model is right: RMS over the workspace, and at the "
    "worst of its poses."
)
BOUND_CUT = (
    "The search for the bound was cut by the time limit: plans may be better than their efficiency says. Raise "
    "--seconds to know."
)
DIAGNOSED = (
    "The model has the effects that its diagnosis found, at the sizes measured; others are not counted: armcal "
    "diagnose says which sizes its data rule out. armcal validate compares it with new measurements."
)
MISSING = (
    "The last two columns: if effects of typical size are missing, and if these are allowed for by identify "
    "--library-prior. They may rise with the runs: more runs do not help against a missing effect; the fit hides it in "
    "wrong lengths and zeros. Where effects may be missing, choose the postures with armcal design --robust."
)


def advice_document(advice: Advice) -> Document:
    """The answer in one sentence, a row for each number of runs, and what the figures do not promise."""
    missing = any(np.isfinite(each["effects_missing"]) for each in advice.tip_errors.values())  # before a diagnosis
    tips = dict([*TIP_ERRORS.items()][: 4 if missing else 2]) if advice.tip_errors else {}
    of_lengths = not advice.of_tip and any(design.deviations for design in advice.designs)
    headings = ["runs", "efficiency", *(["length\nstd\n[mm]", "angle\nstd\n[deg]"] if of_lengths else [])]
    rows = []
    for runs, design in zip(advice.runs, advice.designs, strict=True):
        star, sure = " *" if (design.efficiency or 0.0) >= 0.999 else "  ", design.deviations  # of the bound
        row = [str(runs), f"{number(design.efficiency, 5)}{star}"]
        if of_lengths:
            largest = (None, None) if sure is None else (sure.largest("mm"), np.degrees(sure.largest("rad")))
            row += [number(value, 5) for value in largest]
        rows.append([*row, *(number(advice.tip_errors[runs][key], 4) for key in tips)])
    parts: list[Any] = [Sheet([*headings, *tips.values()], rows, most=40)]
    parts += ["* within 0.1 % of the bound."] if advice.efficient_runs() else []
    parts += [BOUND_CUT] if any(design.bound and design.bound.cut for design in advice.designs) else []
    parts += [design.status.value for design in advice.designs if design.status is Status.interrupted]
    parts += [RIGHT, MISSING if missing else DIAGNOSED] if advice.tip_errors else []
    return Document("How many runs", [advice_sentence(advice)], parts)


def advice_sentence(advice: Advice) -> str:
    """What to do, in one line."""
    runs = np.array(sorted(advice.efficient_runs()), dtype=int)
    stretches = np.split(runs, np.flatnonzero(np.diff(runs) != 1) + 1) if runs.size else []
    good = ", ".join(f"{part[0]}" if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in stretches)
    efficient = f"Plans within 0.1 % of the bound exist for m = {good}."
    efficient = efficient if good else "None of these plans is within 0.1 % of the bound."
    if advice.target is None:
        return efficient
    smallest = advice.smallest
    if smallest is None:
        return f"None of these plans, of up to {max(advice.runs)} runs, reaches {advice.target:g} mm. {efficient}"
    of = "at the tip" if advice.of_tip else "in each length"
    lacks = advice.tip_errors.get(len(smallest.plan), {}).get("effects_missing", np.inf)
    missing = f"; at the tip {in_a_sentence(lacks)} mm if effects of typical size are missing"
    right = f"if the model is right{missing if np.isfinite(lacks) else ''}"
    return f"{len(smallest.plan)} runs suffice for {advice.target:g} mm {of}, {right}. {efficient}"


# -- armcal relax ------------------------------------------------------------------------------------------------------
def relax_document(design: ApproximateDesign, compared: Sequence[Data] = (), runs: int | None = None) -> Document:
    """Value, bound and efficiency, then the support, heaviest first, and independent answers side by side.

    runs : m, where the value depends on it, as that of a prior per run does
    """
    where = "all postures" if design.candidates is None else f"{design.candidates} candidates"
    kind = design.problem.criterion.name
    weighted = zip(design.plan.shares, design.plan.displayed, strict=True)
    of_runs = "" if runs is None else f", {runs} runs"
    rows = [[f"{weight:.5g}", *(f"{angle:.2f}" for angle in q)] for weight, q in weighted]  # none is printed as zero
    facts: dict[str, str | None] = {
        "criterion": f"{kind} over {where}{of_runs}, {len(design.plan)} with positive weight",
        "value": number(design.value, 9),
        "upper bound": "-" if design.bound is None else str(design.bound),
        f"gap ({'max d - p' if kind == 'D' else 'max tr(G F) - tr(G M)'})": f"{max(design.gap, 0.0):.2g}",
        "efficiency at least": number(design.efficiency_lower_bound, 9),
        "solver": ", ".join(filter(None, [design.solver, design.solver_status, f"{design.seconds:.2f} s"])),
        "status": design.status.value,
    }
    support = Sheet(["weight", *posture_headings(design.plan)], rows, "Support", 24)
    digits = {"value": 7, "bound": 7, "table_1_max_residual": 4}
    answers = [[row["method"], row["space"], *(number(row[k], n) for k, n in digits.items())] for row in compared]
    title = "Cross-check: independent answers (Table I: deviation from orthogonality)"
    check = Sheet(("method", "over", "value", "upper bound", "Table I"), answers, title)
    return Document("Weights", [], [Sheet.facts(facts), support, check])


# -- missing effects ---------------------------------------------------------------------------------------------------
def discriminating_parts(result: Discrimination) -> list[Any]:
    """The efficiency that the plan gives up, and what it can detect in return."""
    from doe.discrimination.design import LAMBDA, MOST_SEEN

    parts: list[Any] = [
        f"D-efficiency relative to the best plan found: {result.relative_efficiency:.4f}",
        f"probability that a missing effect gets a wrong name: at most {result.wrong:.3f} "
        f"(the best plan: {result.best_wrong:.3f}, random postures: {result.random_wrong:.3f})",
        f"  for effects whose total shift (root sum of squares) at as many random postures is {LAMBDA:g} sigma; "
        "gear ripple, backlash and drift are left out",
    ]
    if result.sees is None or result.best_sees is None:
        many = f"what a plan of more than {MOST_SEEN:,} runs can detect is not worked out"
        return [*parts, *([many] if len(result.design.plan) > MOST_SEEN else [])]
    data = result.to_json()
    clear, blind = (", ".join(data[f"not_visible{which}"]) or "none" for which in ("", "_in_best_plan"))
    return [*parts, f"effects it cannot see: {clear} (the best plan: {blind})", *result.sees.document().parts]


# -- armcal discriminate -----------------------------------------------------------------------------------------------
def next_document(diagnosis: Diagnosis, result: NextPostures) -> Document:
    """The rivals, the chance, the postures, and what to do before their rows can be appended: measurements without a
    payload column mean the arm's own payload."""
    columns = {"run": np.arange(1, len(result.plan) + 1), **result.plan.columns, **result.columns}
    arm, measured = diagnosis.arm, diagnosis.measurements.conditions
    rows = [[f"{value:g}" for value in row] for row in zip(*columns.values(), strict=True)]
    notes = []
    if "payload_kg" in columns and measured.payload is None and arm.gravity is not None:
        notes = [f"note: the measured rows need a column payload_kg too: {arm.gravity.payload:g} in each of them"]
    table = Sheet(list(columns), rows, "Next postures")
    return Document("Next postures", [str(result)], [diagnosis.sentence, table, *notes])
