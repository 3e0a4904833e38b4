"""The verbs of `doe`: plans, before and after the measurements, the page of a campaign, studies, and the demo.

Each is declared by its signature, its docstring and its example (doe/cli/verb.py); what they need is loaded when they
are called, so that `armcal --help` answers at once.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

import doe
from doe.cli.verb import Count, JobOptions, Picture, Seconds, WholeNumbers, interruptible
from identification import InputError, JobError, Progress, require
from identification.document import Answer, Document, Sheet, count_of, in_a_sentence
from identification.files.io import write_together
from identification.workflow import VERBS, Folder, Names, Written

if TYPE_CHECKING:
    from doe.problem.problem import DesignProblem
    from identification import Arm

BUILT_IN = ("blind", "blind-spatial")  # studies that come with armcal
MOVES = 30.0  # [s] of a processor that free moves are searched for
UNLIKE_ROBUST = "score --robust assumes that fit; these figures are for a fit of the arm file's model alone"


# -- from options to a problem, and from an answer to files ------------------------------------------------------------
@dataclass(frozen=True)
class CriterionOptions:
    """The criterion, and whether the model may lack effects.

    criterion : D, A, E, I, Ds or Dstar; left out: D, with --robust I.
    test_poses : CSV of postures that matter, for criterion I.
    subset : Parameters that matter, for Ds: length_error:1,joint_offset:2
    robust : The arm may have effects of the library that its file does not name.
    missing : Only these effects, for --robust: gear_ratio,joint_coupling
    """

    criterion: str | None = None
    test_poses: Path | None = None
    subset: Names | None = None
    robust: bool = False
    missing: Names | None = None


def design_problem(
    arm: Arm,
    wanted: CriterionOptions,
    runs: int = 0,
    *,
    keep: Path | None = None,
    candidates: Path | None = None,
    repeats: bool = False,
) -> DesignProblem:
    """The problem that the options describe, of a plan of so many runs. Raises `InputError` for files and names that do
    not fit."""
    from doe.criteria import NAMES
    from doe.plan.accuracy import criterion_of, missing_effects, robust_problem
    from identification import Plan, design_model

    name = wanted.criterion or ("I" if wanted.robust else "D")
    require(wanted.missing is None or wanted.robust, "--missing: found without --robust, allowed: with --robust")
    for option, value, needed in (("--test-poses", wanted.test_poses, "I"), ("--subset", wanted.subset, "Ds")):
        if value is not None and name in NAMES and name != needed:
            raise InputError(f"{option}: criterion {name} does not use it, allowed: with criterion {needed}")
    model, restrictions = design_model(arm), dict[str, Any]()
    if keep is not None:
        measured = Plan.load(keep, arm.joint_types, carried_out=True)
        with InputError.at(keep):
            restrictions["kept"], restrictions["kept_excess"] = model.measured_already(measured)
    if candidates is not None:
        choices = restrictions["choices"] = Plan.load(candidates, arm.joint_types).postures
        tell_of_candidates(candidates, doe.DesignProblem.of(model, choices=choices), choices)
    if repeats:
        restrictions["minimum_distance"] = 0.0
    if repeats and wanted.robust:  # each posture's own error is the same in all of its repeats
        warnings.warn("--repeats: --robust is a little too optimistic about postures that are repeated", stacklevel=2)
    problem = doe.DesignProblem.of(model, **restrictions)
    if wanted.robust:
        missing = wanted.missing
        fit = "library-prior" + (f" --missing {','.join(missing)}" if missing else "")  # see `Plan`
        counted = missing_effects(problem, missing, runs)
        if missing and counted.left_out:
            reasons = ", ".join(f"{effect} ({why})" for effect, why in counted.left_out.items())
            warnings.warn(f"--missing: the plan does not allow for {reasons}", UserWarning, stacklevel=2)
        problem = replace(robust_problem(problem, counted), fit=fit)
    if not wanted.robust or name != "I" or wanted.test_poses is not None:
        poses = None if wanted.test_poses is None else Plan.load(wanted.test_poses, arm.joint_types).postures
        problem = replace(problem, criterion=criterion_of(problem, name, wanted.subset or (), poses))
    return problem


def tell_of_candidates(path: Path, problem: DesignProblem, postures: Any) -> None:
    """Warn of those (N, n) of a file that are not allowed. Raises `InputError`, with the file's name, for none that
    is."""
    from doe.problem.problem import listed_candidates

    with InputError.at(path):
        left_out = len(postures) - len(listed_candidates(problem, postures))
    if left_out:
        apart = f"{left_out} of {len(postures)} postures violate the limits or a constraint and are left out"
        warnings.warn(f"{path}: {apart}", UserWarning, stacklevel=2)


def with_collisions(answer: Answer, problem: DesignProblem, postures: Any = None, moves: Any = None) -> Answer:
    """The answer with what is known of collisions at postures (m, n) and of moves along others, None: it has none."""
    from doe.plan.moves import said_of_collisions

    data, lines = said_of_collisions(problem.constraints, problem.model, postures, moves)
    return replace(answer, data=answer.data | data, document=answer.document.plus(*lines))


# -- plans -------------------------------------------------------------------------------------------------------------
@VERBS.declare("armcal design arm.toml --runs 20 --out plan.csv")
def design_files(
    arm: Path,
    *,
    runs: Annotated[int, range(1, 100_001)],
    solver: str | None = None,
    starts: Count | None = None,
    seconds: Seconds | None = None,
    discriminating: bool = False,
    order: Literal["given", "travel", "random"] | None = None,
    approach: Literal["any", "positive", "negative", "alternate"] = "any",
    criterion: CriterionOptions,
    keep: Path | None = None,
    candidates: Path | None = None,
    repeats: bool = False,
    clearance_mm: float | None = None,
    picture: Picture | None = None,
    out: Written | None = None,
    package_dir: tuple[Path, ...] = (),
    force: bool = False,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """Choose the postures to measure, with a certificate.

    The RUNS postures that calibrate the arm best, and how good they are.

    runs : Number of (new) measurements m.
    solver : Method; left out: the best for the problem.
    starts : Number of starts.
    seconds : Time budget of the search [s]; left out: none up to 100 runs, 30 for more.
    discriminating : Also make missing effects distinguishable (costs some D-efficiency).
    order : Order of measurement; travel: little joint travel; left out: travel where bodies are known, up to 100 runs.
    approach : Direction in which every joint approaches each posture.
    keep : Postures already measured; the plan complements them.
    candidates : CSV of allowed postures to choose from.
    repeats : A posture may be measured more than once.
    clearance_mm : Smallest distance that bodies keep; left out: that of [cell].
    picture : Draw the postures (.png, .svg, .pdf).
    out : Write the plan (CSV).
    """
    from doe.plan.accuracy import tip_beside_random, with_choices
    from doe.plan.moves import drive, with_approach
    from identification import Status, load_arm

    require(not (criterion.robust and discriminating), "--discriminating: found with --robust, allowed: one of them")
    loaded = load_arm(arm, package_dir)
    if clearance_mm is not None:
        require(0.0 <= clearance_mm < math.inf, f"--clearance-mm: found {clearance_mm:g}, allowed: a number >= 0")
        if loaded.cell is None:
            lacks = "found for an arm without bodies, allowed: with [cell] or bodies in its URDF file"
            raise InputError(f"--clearance-mm: {lacks}")
        if clearance_mm < loaded.cell.clearance:
            kept = f"clearance_mm = {loaded.cell.clearance:g} in [cell], which check, score and program use"
            warnings.warn(f"--clearance-mm: {clearance_mm:g} is less than {kept}; change it there, too", stacklevel=2)
        loaded = replace(loaded, cell=replace(loaded.cell, clearance=clearance_mm))
    if approach != "any" and loaded.chain.instrument.contact:
        raise InputError(f"--approach: found {approach} for contacts, allowed: any, since surface or cup is in the way")
    counts = loaded.counting.matrix
    progress(0, None, "the arm and its cell")
    problem = design_problem(loaded, criterion, runs, keep=keep, candidates=candidates, repeats=repeats)
    problem = with_approach(problem, approach, counts)
    if criterion.robust and solver in (None, "exchange"):
        problem = with_choices(problem)
    effort: dict[str, Any] = {"solver": solver, "starts": starts, "seconds": seconds, "seed": seed}
    if discriminating:
        from doe.discrimination.design import discrimination_design

        chosen = discrimination_design(problem, loaded, runs, progress=progress, **effort)
        design = chosen.design
    else:
        design = doe.solve(problem, runs, progress=progress, **effort)
    end = process_time() + min(MOVES, seconds or MOVES)

    def late() -> bool:
        progress(0, None, f"free moves, at most {max(end - process_time(), 0.0):.0f} s left")
        return process_time() > end

    planned = design.problem, design.plan, order, approach, counts, seed
    try:
        driven = drive(*planned, late)
    except KeyboardInterrupt:  # the plan is there; moves that are not proven by now are named
        driven = drive(*planned, lambda: True)
    design = design.driven(driven)
    try:
        progress(0, None, "tip error expected of the plan, and of random ones")
        expected, extra = tip_beside_random(design.problem, design.plan.postures, seed)
    except KeyboardInterrupt:  # the plan is there, too
        design, expected, extra = replace(design, status=Status.interrupted), None, []
    shown = replace(chosen, design=design) if discriminating else design
    files: dict[Path | None, tuple[str, Any]] = {out: ("plan", driven.moves.text(design.columns_beside))}
    if picture is not None:
        from doe.report.figures import plan_figure  # matplotlib takes longer to load than a small design

        files[picture] = "picture", plan_figure(loaded, design.plan.postures)
    first = "--out plan.csv writes this plan; " if out is None else ""
    then = f"; then armcal identify {arm} DATA --{problem.fit} --out calibrated.toml" if problem.fit else ""
    extra += [*driven.lines, f"Next: {first}measure the tip at these postures, then armcal check {arm} DATA{then}"]
    data = design.to_json() | (shown.to_json() if discriminating else {}) | {"expected_tip": expected, **driven.data}
    answer = Answer(data, shown.document().plus(*extra), files=files)
    return with_collisions(answer, design.problem, design.plan.postures)


@VERBS.declare("armcal score arm.toml plan.csv")
def score_files(
    arm: Path, plan: Path, *, seconds: Seconds = 20.0, criterion: CriterionOptions, package_dir: tuple[Path, ...] = ()
) -> Answer:
    """Judge a plan of your own against the bound.

    Efficiency against the bound, expected standard deviations, effects that the PLAN could show.

    seconds : Time budget of the search for the bound [s].
    """
    from doe.plan.accuracy import average_error, criterion_values, error_at_poses, observability, with_choices
    from identification import Plan, design_model, load_arm

    loaded = load_arm(arm, package_dir)
    judged = Plan.load(plan, loaded.joint_types)
    bounded = design_problem(loaded, criterion, len(judged))
    if criterion.robust or bounded.choices is not None:
        bounded = with_choices(bounded, judged.postures)
    need = f"at least {bounded.fewest_runs} for {bounded.parameters} parameters"
    require(len(judged) >= bounded.fewest_runs, f"{plan}: runs: found {len(judged)}, allowed: {need}")
    design = doe.score_plan(bounded, judged, seconds=seconds)
    if design.missed:
        warnings.warn(f"{plan}: {design.no_efficiency}", UserWarning, stacklevel=2)
    sees = None
    try:
        require(len(judged) <= 100_000, f"not checked for {len(judged)} runs, allowed: 100,000, as in armcal design")
        sees = design_model(loaded).detectability(judged)
        tables: list[Any] = [*sees.document().parts]
    except InputError as reason:  # too few runs to test for effects, or too many: a property of the plan, not bad input
        tables = [f"missing effects: {reason}"]
    problem = doe.DesignProblem.of(loaded)
    tip, weighted = replace(problem, criterion=average_error(problem)), (judged.postures, judged.weights)
    values = criterion_values(problem, *weighted)
    data = design.to_json() | {
        "workspace_error_mm": None if values["I"] is None else error_at_poses(tip, values["I"], len(judged)),
        "observability": observability(problem, *weighted),
        "criteria": values,
        "preflight": None if sees is None else sees.to_json(),
    }
    moves = None if judged.weights is not None else Plan.load(plan, loaded.joint_types, vias=True).postures
    meant = f"{plan} was designed for a fit with armcal identify --{judged.fit}: {UNLIKE_ROBUST}"
    lines = [meant] if judged.fit and not criterion.robust else []
    figures = ", ".join(f"{name} {'-' if value is None else format(value, '.5g')}" for name, value in values.items())
    rms = "" if (error := data["workspace_error_mm"]) is None else f", {in_a_sentence(error)} mm RMS"
    of = f"I: the tip over the workspace{rms}; Ds: the parameters in mm"
    lines.append(f"all criteria (larger is better): {figures} ({of})")
    indices = ", ".join(f"{name.upper()} {value:.4g}" for name, value in data["observability"].items())
    lines.append(f"observability indices: {indices}")
    if getattr(problem.model, "needs", ()) and any(column is not None for column in judged.conditions.values()):
        lines.append("The lines below use payloads, temperatures and directions of the plan; the figures above do not.")
    return with_collisions(Answer(data, design.document().plus(*lines, *tables)), problem, judged.postures, moves)


@VERBS.declare("armcal advise arm.toml --runs 4:40 --target-mm 0.02")
def advise_files(
    arm: Path,
    *,
    runs: Annotated[str, "A:B"] = "4:40",
    target_mm: float | None = None,
    seconds: Seconds = 60.0,
    package_dir: tuple[Path, ...] = (),
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """How many measurements are needed?

    Efficiency and expected accuracy against the number of runs; the smallest number for a wanted accuracy.

    runs : Numbers of runs, A to B.
    target_mm : Wanted accuracy [mm]: largest std of a link length, in space RMS error of the tip.
    seconds : Time budget of all numbers of runs together [s].
    """
    from doe.advise import advise, with_scatter
    from identification import load_arm

    loaded, given_sigma = with_scatter(load_arm(arm, package_dir))
    problem = doe.DesignProblem.of(loaded)
    fewest, ends = problem.fewest_runs, runs.split(":")
    if not 1 <= len(ends) <= 2 or not all(re.fullmatch(r"\s*\d{1,6}\s*", part, re.ASCII) for part in ends):
        raise InputError(f"--runs: {runs!r}, allowed: A:B or A with whole numbers up to 999999, such as 4:40")
    low, high = int(ends[0]), int(ends[-1])
    require(low <= high and high >= fewest, f"--runs: {runs!r}, allowed: A <= B, and B >= {fewest} for this arm")
    numbers = range(max(low, fewest), high + 1)
    advice = advise(problem, numbers, target=target_mm, seed=seed, seconds=seconds, progress=progress)
    doubts = [given_sigma] if given_sigma else []
    return with_collisions(Answer(advice.to_json(), advice.document().plus(*doubts), warnings=doubts), problem)


@VERBS.declare("armcal relax arm.toml --grid 9 --solver clarabel")
def relax_files(
    arm: Path,
    *,
    grid: Annotated[int, click.IntRange(min=2)] | None = None,
    candidates: Path | None = None,
    solver: str | None = None,
    check: Annotated[bool, "--check/--no-check"] = True,
    runs: Count | None = None,
    seconds: Seconds | None = None,
    criterion: CriterionOptions,
    out: Written | None = None,
    package_dir: tuple[Path, ...] = (),
    force: bool = False,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """Optimal weights over candidate postures.

    With a certificate that is recomputed from the weights, and a cross-check.

    grid : Levels per joint; left out: about 10,000 in all.
    candidates : CSV of allowed postures instead of a grid.
    solver : column_generation (the default), or clarabel or scs, which are independent of it.
    check : Cross-check by independent methods.
    runs : Number of measurements m, required by --robust; in space, left out: as many as parameters.
    seconds : Time budget [s]; left out: 40.
    out : Write the plan with weights (CSV).
    """
    from doe.bounds.column_generation import LARGEST, relax
    from doe.plan.accuracy import with_choices
    from doe.solvers.solving import cross_check
    from identification import Plan, load_arm

    loaded, robust = load_arm(arm, package_dir), criterion.robust
    if robust and runs is None:
        raise InputError("--robust: found without --runs, allowed: with --runs, the number of measurements")
    problem = design_problem(loaded, criterion, runs or 0, candidates=candidates if robust else None)
    require(runs is None or problem.deviations, "--runs: found without --robust, allowed: with --robust")
    problem = with_choices(problem) if robust and grid is None else problem
    solver = solver or "column_generation"
    if seconds is not None and solver in LARGEST:
        reason, allowed = f"found with --solver {solver}", "column_generation"
        raise InputError(f"--seconds: {reason}, which cannot be stopped, allowed: with {allowed}")
    if grid is not None and (candidates is not None or problem.choices is not None):
        raise InputError("--grid: found with a list of postures, allowed: without --candidates, and not for contacts")
    if candidates is not None:
        places: Any = Plan.load(candidates, problem.model.joint_types).postures
        tell_of_candidates(candidates, problem, places)
    elif problem.choices is not None:
        places = problem.choices
    else:  # by default levels that give about ten thousand candidates
        places = grid or max(2, min(181, round(10_000 ** (1.0 / max(len(problem.active_joints), 1)))))
    progress(0, 2, "weights")
    # of 40 s, a million candidates take a third of the first half
    end = perf_counter() + (seconds or 40.0)
    weighted = end - 0.5 * (seconds or 40.0) if check else end
    new = runs or (problem.parameters if problem.deviations else None)
    relaxation = relax(problem, places, solver, runs=new, stop=lambda: perf_counter() > weighted)
    data, compared = relaxation.to_json() | {"runs": new}, list[dict[str, Any]]()
    if check:
        progress(1, 2, "cross-check")
        checked = with_choices(problem) if robust else problem
        exact = new or problem.parameters  # what a prior is worth depends on the runs
        compared = cross_check(checked, relaxation, exact, seed=seed, seconds=end - perf_counter())
        data["cross_check"] = compared
    text = replace(relaxation.plan, fit=problem.fit).text(relaxation.columns_beside)
    answer = Answer(data, relaxation.document(compared, new), files={out: ("plan with weights", text)})
    return with_collisions(answer, problem, relaxation.plan.postures)


@VERBS.declare("armcal compare arm.toml --runs 10,20 --solvers exchange,ipopt --out runs")
def compare_files(
    arms: Annotated[tuple[Path, ...], "ARM..."],
    *,
    runs: WholeNumbers,
    solvers: Names | None = None,
    criteria: Annotated[Names, "--criterion"] = "D",  # type: ignore[assignment]
    starts: WholeNumbers | None = None,
    repeats: Count = 5,
    seconds: Seconds = 60.0,
    job: JobOptions,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """Compare design solvers side by side.

    Each run, on the problems ARM x RUNS, has its own process. Every plan is evaluated on the stored problem,
    independently of its solver. Hit rate: fraction of the runs that found the best known value; with --repeats 10
    --starts 1, the fraction of good starts.

    runs : Numbers of measurements m, as in 10,20.
    solvers : Names, as in a,b; left out: all.
    criteria : D, A, E or Dstar; several as in D,A.
    starts : Starts of one run, as in 1,10; left out: the solver's own.
    repeats : Repetitions of each search, with different seeds.
    seconds : Limit of one run [s].
    """
    from doe.jobs import parquet
    from doe.solvers import available_solvers
    from doe.studies.comparison import compare, comparison_parts, summary
    from identification import load_arm

    if job.resume and job.out is None:
        raise InputError("--resume: needs --out, allowed: the folder of an earlier comparison")
    asked: dict[str, Any] = {"starts": starts or [None], "repeats": repeats, "seconds": seconds, "criteria": criteria}
    asked |= {"path": job.out and job.out / "rows.parquet", **job.how(seed, progress, 1)}
    loaded = [load_arm(arm) for arm in arms]
    with interruptible("; without --out nothing is kept", job.out):
        rows = compare(loaded, runs, [*available_solvers()] if solvers is None else solvers, **asked)
        shown, summed = comparison_parts(rows), summary(rows)
        if job.out is not None:
            job.out.mkdir(exist_ok=True)  # where every run failed no rows are kept
            write_together({job.out / "summary.parquet": parquet(summed)}, force=True)
            shown.append(f"rows and summary written to {job.out}")
        return Answer({"rows": rows.drop("key").to_dicts(), "summary": summed.to_dicts()}, Document(parts=shown))


@VERBS.declare("armcal program arm.toml plan.csv --robot ur --out plan.script")
def program_files(
    arm: Path,
    plan: Path,
    *,
    robot: Literal["ur", "abb", "kuka", "fanuc", "ros"],
    speed: Annotated[int, range(1, 101), "PERCENT"] = 20,
    settle: Annotated[float, "S"] = 2.0,
    template: Path | None = None,
    package_dir: tuple[Path, ...] = (),
    out: Written,
    force: bool = False,
) -> Answer:
    """Write a robot program that drives through a plan.

    Joint moves to the postures of PLAN in its order, with a pause for the measurement at each. Joints are written as
    the controller counts them (columns of PLAN). These programs were not tested on a controller: run them slowly first.

    robot : Language: URScript, RAPID, KRL, FANUC TP (.LS), or a JointTrajectory of ROS 2 (YAML).
    speed : Speed of the joint moves, in percent of 120 deg/s and 1 m/s, or of the controller's own.
    settle : Seconds between arrival and measurement, up to 300.
    template : Jinja2 template of your own; its variables: doe/README.md, "Programs".
    out : Write the program, which is named after the file.
    """
    from doe import DesignProblem
    from doe.plan.moves import in_sentences
    from doe.program.program import program
    from identification import Plan, load_arm

    loaded = load_arm(arm, package_dir)
    file = Plan.load(plan, loaded.joint_types, vias=True)
    if file.weights is not None:
        raise InputError(f"{plan}: found weights, allowed: an exact plan, each row a measurement or a way-point")
    options: dict[str, Any] = {"speed": speed, "settle": settle, "name": out.stem, "template": template}
    with InputError.at(plan, "--", str(template)):
        text, made = program(loaded, file, robot, **options)
    runs, vias = len(file.measured), len(file) - len(file.measured)
    counted = f"{count_of(runs, 'run')} and {count_of(vias, 'way-point')}"
    first = "the move to the first row was not checked: try it slowly"
    sentence = f"{counted}, about {made['seconds'] / 60.0:.1f} min without measuring; {first}"
    headings = ["", *file.headings, "after [s]"]
    rows = [[m["kind"], *(f"{q:.3f}" for q in m["joints"]), f"{m['seconds']:.0f}"] for m in made["moves"]]
    doubts = in_sentences(made["not_free"])
    if loaded.chain.instrument.contact:
        doubts.append("Each run ends in contact, which moves reach and leave in any direction: add way-points off it")
    if robot != "ros" and "prismatic" in loaded.joint_types:
        j = loaded.joint_types.index("prismatic") + 1
        doubts.append(
            f"Joint {j} slides and is axis {j} of the program: a rail that is an external axis needs --template"
        )
    if robot == "ros" and any(loaded.counting.coupled_to):
        doubts.append("Joints are as the controller counts: a driver that undoes coupled_to needs those of the URDF")
    if robot == "kuka" and made["name"].lower() != out.stem.lower():
        doubts.append(f"{out}: a KUKA needs a file with the name of the program: {made['name']}.src")
    if elsewhere := file.from_elsewhere:
        named = f"run{'s' * (len(elsewhere) != 1)} {', '.join(map(str, elsewhere))}"
        doubts.append(f"Without way-points, joints approach {named} from other sides than direction1.. of {plan} says")
    document = Document(parts=[sentence, Sheet(headings, rows, most=60), *doubts])
    data, said = {"robot": robot, "runs": runs, "vias": vias, **made}, [line.strip() for line in doubts]
    answer = Answer(data, document, warnings=said, files={out: ("program", text)})
    return with_collisions(answer, DesignProblem.of(loaded), file.measured)


# -- after measurements ------------------------------------------------------------------------------------------------
@VERBS.declare("armcal discriminate arm.toml data.csv --runs 4 --out next.csv")
def discriminate_files(
    arm: Path,
    data: tuple[Path, ...],
    *,
    runs: Count,
    payloads: str | None = None,
    seconds: Seconds = 30.0,
    out: Written | None = None,
    package_dir: tuple[Path, ...] = (),
    force: bool = False,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """Next postures for an ambiguous diagnosis.

    The next RUNS postures, which tell its candidates apart, and their chance of success. Several files DATA are
    sessions of one arm, as for `armcal diagnose`.

    runs : Number of further measurements K.
    payloads : Payloads to choose from [kg], as 0,5,10; left out: the arm's own.
    seconds : Time budget of the choice, after the diagnosis [s].
    out : Write the next postures (CSV).
    """
    from doe.discrimination.t_optimal import discriminate
    from identification import Plan, load_arm

    loaded, masses = load_arm(arm, package_dir), None
    if payloads is not None:
        try:
            masses = tuple(float(word) for word in payloads.split(","))
        except ValueError:
            masses = (-1.0,)
        if not all(0.0 <= mass < math.inf for mass in masses):
            raise InputError(f"--payloads: {payloads!r}, allowed: numbers >= 0 [kg], as in 0,5,10")
        require(loaded.gravity is not None, f"--payloads: {arm} has no [gravity] table, allowed: with one")
    loaded.chain.refuse_contacts()
    problem = doe.DesignProblem.of(loaded)
    measured = [q for path in data for q in Plan.load(path, loaded.joint_types, carried_out=True).postures.round(3)]
    if (postures := len(set(map(tuple, measured)))) < (fewest := problem.fewest_runs):
        enough = f"at least {fewest} for the arm's own parameters; armcal design --keep {data[-1]} chooses more"
        raise InputError(f"{data[-1]}: {len(measured)} rows of {count_of(postures, 'posture')}, allowed: {enough}")
    diagnosis = VERBS["diagnose"][0](arm, data, seed=seed, progress=progress).result
    keys = {"verdict": diagnosis.verdict, "candidates": [list(candidate.effects) for candidate in diagnosis.candidates]}
    if diagnosis.verdict != "ambiguous":
        lines = [f"Nothing to distinguish, since the verdict is not ambiguous. {diagnosis.sentence}"]
        lines += [] if out is None else [f"{out} was not written: there are no next postures"]
        nothing = dict.fromkeys(("payload_kg", "directions", "chance", "status"))
        return Answer({**keys, "postures_deg": [], "pairs": [], **nothing}, Document(parts=lines))
    end = perf_counter() + seconds

    def late() -> bool:
        left = end - perf_counter()
        progress(5, None, f"choosing the next postures, at most {max(left, 0.0):.0f} s left")
        return left < 0.0

    chosen = discriminate(loaded, diagnosis, runs, seed, masses, stop=late)
    document = chosen.document().plus(f"Measure these postures and append the rows to {data[-1]}.")
    text = chosen.plan.text(further=chosen.columns)
    answer = Answer(keys | chosen.to_json(), document, files={out: ("next postures", text)})
    return with_collisions(answer, problem, chosen.plan.postures)


@VERBS.declare("armcal report arm.toml calibrated.toml plan.csv data.csv --out page.html")
def report_files(
    files: tuple[Path, ...],
    *,
    out: Written,
    package_dir: tuple[Path, ...] = (),
    force: bool = False,
    page: Callable[[Document, Sequence[Path]], str],
) -> Answer:
    """Make one page from the files of a campaign.

    Arm files (nominal, calibrated, extended), plans and measurements. The page has the verdict (first the error on rows
    that no fit has seen), what to do next, corrected values, signed errors, and plans that can be stepped
    through and edited; it is one file that works offline.

    out : Write the page.
    """
    from doe.report.page import hashes
    from doe.report.plan import plan_section
    from identification import campaign_document

    document, kinds = campaign_document(files, package_dir, plan_section)
    listed = [
        {"file": name, "kind": kinds[name], "bytes": size, "sha256": digest} for name, size, digest in hashes(files)
    ]
    data = {"page": out, "verdict": document.verdict, "files": listed}
    return Answer(data, Document(parts=document.verdict), files={out: ("page", page(document, files))})


# -- studies, and the demo ---------------------------------------------------------------------------------------------
@VERBS.declare("armcal study study.toml --workers 4")
def study_files(
    study: Annotated[str, "STUDY.toml|NAME"],
    *,
    replications: Count | None = None,
    cells: Annotated[tuple[str, ...], "--cell", "NAME"] = (),
    job: JobOptions,
    seed: int = 0,
    progress: Progress = Progress(),
) -> Answer:
    """Run a simulation study, or one that comes with armcal.

    Simulate, identify and count: what plans, models and noise do to the accuracy. STUDY is a file (armcal help formats
    shows one), or the name of a study that comes with armcal: blind (diagnoses of data with hidden effects, compared
    with the truth afterwards), blind-spatial (the same for six-axis arms).
    The folder gets cells.parquet (one row per cell and parameter: errors, deviations, coverage), blocks.parquet and
    plans.parquet; notebooks read them with polars.

    replications : Simulated data sets per cell, instead of the file's.
    cells : Only this cell of blind or blind-spatial; may be repeated.
    """
    if study not in BUILT_IN and not study.endswith(".toml"):
        raise InputError.unknown("study: unknown name", study, [*BUILT_IN, "NAME.toml"])
    if cells and study not in BUILT_IN:
        raise InputError(f"--cell: {cells[0]!r} for the study {study}, allowed: for blind and blind-spatial")
    folder, how = job.out or Path(study).with_suffix(".results"), job.how(seed, progress)
    with interruptible("", folder):
        if study in BUILT_IN:
            from doe.studies.blind.cells import CELLS
            from doe.studies.blind.study import blind_parts, blind_study, reliability_figure

            offered = {name: spec.reported for name, spec in CELLS.items() if spec.space == (study == "blind-spatial")}
            InputError.check_names(f"--cell: unknown name of the study {study}", cells, offered)
            tables = blind_study(cells or [*filter(offered.get, offered)], replications, folder, **how)
            if len(tables["reliability"]):
                write_together({folder / "reliability.png": reliability_figure(tables["reliability"])}, force=True)
            shown, passed = blind_parts(tables), "failed" not in tables.pop("sets")["status"]
            data = {"out": folder, "passed": passed, **{name: table.to_dicts() for name, table in tables.items()}}
            return Answer(data, Document(parts=shown), exit_code=0 if passed else 1)
        from doe.studies.monte_carlo import Study, monte_carlo_parts, run_study

        tables = run_study(Study.load(Path(study), replications), folder, **how)
        rows, blocks = tables["cells"], tables["blocks"]
        if "done" not in blocks["status"]:
            reason = re.sub(r"\b[A-Z]\w*Error: ", "", blocks["error"][0])  # users need no exception types
            raise JobError(f"no cell could be done: {reason}")
        data = {"out": folder, "cells": rows.to_dicts(), "failed": len(rows.filter(rows["status"] != "done"))}
        written = f"{len(rows)} rows written to {folder / 'cells.parquet'}"
        return Answer(data, Document(parts=[*monte_carlo_parts(tables), written]))


@VERBS.declare("armcal demo --spatial --out my-demo")
def demo_files(
    *,
    spatial: bool = False,
    out: Folder = Folder(Path("armcal-demo")),  # noqa: B008
    force: bool = False,
    seed: int = 0,
    progress: Progress = Progress(),
    page: Callable[[Document, Sequence[Path]], str],
) -> Answer:
    """Run the whole loop on a simulated arm.

    The paper's 4-link arm, or one of six axes: from a plan to the missing effect, commands for the real arm, in space a
    corrected URDF file, and a report.html.

    spatial : Six axes and a laser tracker instead of the paper's 4-link arm.
    out : Directory for the files.
    """
    from doe.demo.run import demo_document, overview_figure, run_demo

    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not force:
            raise InputError(f"{out}: exists and is not empty, allowed: a new directory, or --force")
    except OSError as error:  # a file, a name that is too long, links that lead in a circle, no right to write
        raise InputError(f"{out}: cannot be created ({error.strerror}), allowed: a writable place") from None
    with interruptible(f"; the files in {out} are complete, but some are missing"):
        demo = run_demo(out, spatial=spatial, seed=seed, progress=progress)
        document, picture = demo_document(demo), overview_figure(demo)
        text = page(document, [out / name for name in demo.data["files"]])
        write_together({out / "overview.png": picture, out / "report.html": text}, force=True)
        files = ", ".join(demo.data["files"])
        look = f"Open {out / 'report.html'} in a browser; the other files are beside it: {files}"
        return with_collisions(Answer(demo.data, document.plus(look)), demo.design.problem, demo.design.plan.postures)
