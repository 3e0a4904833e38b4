"""Whatever files of a campaign are given, as one document: arms, plans, measurements."""

from collections.abc import Callable, Sequence
from pathlib import Path

from identification.arm import Arm
from identification.document import Action, Document, Pictures, Section, Sheet, as_sentence, count_of, number
from identification.documents import identification as shown
from identification.documents.pictures import signed_figures, workspace_arrows
from identification.errors import InputError, require
from identification.estimation.result import corrected_values, dh_lines
from identification.files.arm import load_arm
from identification.files.csv import read_table
from identification.files.measurement import Plan, is_plan, load_measurements
from identification.measurements import MOST, Measurements
from identification.model import Model
from identification.validate import Validation, validate

ALLOWED = "arm files (.toml), plans and measurements (.csv)"
PLACED = (
    "Only where the arm and the measured points are is fitted to each set of measurements, also for the drawing; "
    "everything else stays as it is in the file."
)


def campaign_document(
    paths: Sequence[Path], package_dirs: Sequence[Path] = (), show_plan: Callable[..., Section] | None = None
) -> tuple[Document, dict[str, str]]:
    """A report on the files: calibrations side by side, the error of each on every set of measurements, what to do
    next; and the kind of each file, in words.

    show_plan : the section of a plan of an arm, of its name and of what the model in use leaves of measurements

    Raises `InputError` for a file of another kind, one given twice, a table without an arm file, files of two arms.
    """
    # the files by name; tables are read by the first arm
    kinds, arms, plans, measurements = dict[str, str](), dict[str, Arm](), dict[str, Plan](), dict[str, Measurements]()
    for path in sorted(paths, key=lambda path: path.suffix.lower() != ".toml"):
        name, ending, first = str(path), path.suffix.lower(), next(iter(arms), None)
        require(name not in kinds, f"{name}: is given twice, allowed: each file once")
        if ending == ".toml":
            arms[name] = arm = load_arm(path, package_dirs)
            if first is not None and not arms[first].chain.drawn_as(arm.chain):
                raise InputError(f"{name}: another arm than that of {first}, allowed: files of one arm")
            kinds[name] = "arm" if arm.calibration is None else "arm with a calibration"
        elif ending not in (".csv", ".tsv", ".txt"):
            raise InputError(f"{name}: ending {path.suffix!r}, allowed: {ALLOWED}")
        elif first is None:
            raise InputError(f"{name}: a table without its arm, allowed: the arm file (.toml) beside it")
        elif is_plan(read_table(path), arms[first]):
            plans[name], kinds[name] = Plan.load(path, arms[first].joint_types, vias=True), "plan"
        else:
            measurements[name], kinds[name] = load_measurements(path, arms[first]), "measurements"
    drawn = next(iter(arms.values()))

    # what each calibrated arm leaves of each set of measurements, those first that no arm says it was fitted to
    calibrated = {name: arm for name, arm in arms.items() if arm.calibration is not None}
    seen = {
        rows: [name for name, arm in calibrated.items() if measured.share_fitted(arm.provenance) >= MOST]
        for rows, measured in measurements.items()
    }
    tests = {
        rows: {name: validate(arm, measurements[rows]) for name, arm in calibrated.items()}
        for rows in sorted(seen, key=lambda rows: bool(seen[rows]))
        if calibrated
    }

    # the model in use has the least error on rows that none was fitted to, of equal ones and without such rows it is
    # the last given
    fresh = [rows for rows in tests if not seen[rows]]
    counts = {rows: len(measurements[rows]) for rows in fresh}
    squares = {name: sum(tests[rows][name].model.rms ** 2 * m for rows, m in counts.items()) for name in calibrated}
    model = min(reversed(squares), key=squares.__getitem__, default="")
    elsewhere = [rows for rows in tests if model not in seen[rows]]
    ordered = sorted(tests, key=lambda rows: rows not in elsewhere)
    lines = [shown.validation_verdict(tests[rows][model].to_json(), model, rows) for rows in ordered]
    if len(calibrated) > 1:
        why = f"it leaves the smallest error on {' and '.join(fresh)}" if fresh else "it is the last given"
        others = " and ".join(name for name in calibrated if name != model)
        lines.append(f"The next steps use the calibration {model}: {why}. Other calibrations: {others}.")
    lines += [f"The plan {name} has {count_of(len(plan.measured), 'run')}." for name, plan in plans.items()]
    verdict = lines or [f"Read: {', '.join(f'{name} ({kind})' for name, kind in kinds.items())}."]

    sections = list[Section]()
    for name in sorted(calibrated, key=lambda name: name != model):
        corrected = corrected_values(calibrated[name])
        rows, places, _ = dh_lines(calibrated[name], corrected)
        sections.append(shown.corrected_section(f"Corrected values: {name}", corrected, folded=name != model))
        sections += [Section(part.title, part.parts, name != model) for part in shown.dh_sections(rows, places, name)]
    sections += [error_section(name, of_models, seen[name]) for name, of_models in tests.items()]
    left = {name: of_models[model] for name, of_models in tests.items()}
    sections += [show_plan(drawn, plan, name, tests=left) for name, plan in plans.items()] if show_plan else []

    # what to do next, from the farthest step that was reached
    arm_file = next((name for name in arms if name not in calibrated), next(iter(arms)))
    data = sorted(seen, key=lambda rows: (model not in seen[rows], not seen[rows])) or ["data.csv"]
    look, hold, use = shown.calibrated_actions(arm_file, data[0], model or "calibrated.toml")
    fit = next(iter([each.fit for each in measurements.values()] + [plan.fit for plan in plans.values()]), "")
    if worse := [rows for rows, test in left.items() if test.model.rms >= test.nominal.rms]:
        pooled = " ".join(["armcal diagnose", arm_file, *data])
        doubt = f"Do not use {model} as it is: on {' and '.join(worse)} it is no better than the drawing (see there)."
        actions = [Action(doubt), Action("Diagnose all measurements together, each file as a session:", pooled)]
    elif moved := [rows for rows, test in left.items() if shown.noted(test.to_json(), shown.ZEROS)]:
        actions = shown.validation_actions(left[moved[0]].to_json(), model, moved[0])
    elif model:
        actions = [*([] if Model(calibrated[model]).complete else [look]), *([] if elsewhere else [hold]), use]
    elif measurements:
        actions = [Action("Identify the arm:", shown.identify_command(arm_file, data[0], fit)), look]
    else:
        why = ", with the fit that the plan was designed for" if fit else ""
        measure = f"Measure the postures of {next(iter(plans), 'plan.csv')}, and write the positions beside the"
        actions = [
            Action(f"{measure} angles (armcal help formats)."),
            Action("Check the data:", f"armcal check {arm_file} data.csv"),
            Action(f"Identify the arm{why}:", shown.identify_command(arm_file, "data.csv", fit)),
        ]
    return Document(f"Calibration report: {drawn.name}".removesuffix(": "), verdict, sections, actions), kinds


def error_section(rows: str, tests: dict[str, Validation], fitted: Sequence[str]) -> Section:
    """The error of the drawing and of every model on some measurements, and its sign against each joint;
    rows : name of the measurements;  fitted : models that were fitted to them"""
    *_, last = tests.values()
    measured, left = last.measurements, {"drawing": last.nominal_residuals}
    left |= {name: test.residuals for name, test in tests.items()}
    figures = [last.nominal, *(test.model for test in tests.values())]
    cells = [[name, *map(number, values)] for name, values in zip(left, figures, strict=True)]
    pairs = [(residuals, name) for name, residuals in left.items()][-2:]
    used = f"Fitted to these rows: {', '.join(fitted)}." if fitted else "No model given here was fitted to this file."
    notes = [as_sentence(note) for note in last.notes if note != shown.FITTED]
    return Section(
        f"Error on {rows}",
        [
            " ".join([f"{count_of(len(measured), 'row')}.", used, *notes]),
            PLACED,
            Sheet(["distance [mm]", "RMS", "mean", "95 % below", "largest"], cells),
            Pictures(lambda: [workspace_arrows(last.arm, measured.positions, pairs)]),
            Pictures(lambda: signed_figures(last.arm, measured.postures, pairs, measured.conditions)),
        ],
    )
