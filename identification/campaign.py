"""Whatever files of a campaign are given, as one document: arms, plans, measurements, joint commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from identification.arm import Arm
from identification.document import Action, Document, Pictures, Section, Sheet, as_sentence, number
from identification.documents.identification import (
    calibrated_actions,
    command_rows,
    corrected_section,
    dh_sections,
    identify_command,
    rows_listed,
    validation_verdict,
)
from identification.documents.pictures import signed_figures, workspace_arrows
from identification.errors import InputError
from identification.estimation.result import corrected_values
from identification.files.arm import load_arm
from identification.files.csv import Table, read_table
from identification.files.measurement import UNITS, Plan
from identification.instruments import TRACKER
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import Measurements, distances, load_measurements
from identification.origin import data_hashes, diagnosed
from identification.reuse import same_drawing
from identification.validate import Validation, validate
from identification.workflow import dh_lines

ALLOWED = "arm files (.toml), plans, measurements and joint commands (.csv)"
PLACED = (
    "Everything stays as it is in the file but for where the arm stands, which is fitted to each set of measurements; "
    "so it is for the drawing."
)


@dataclass
class Campaign:
    """Name -> content of the files of each kind, in the order given.

    kinds : of every file, in words
    tests : measurements -> calibrated arm -> what it leaves of them
    show_plan : the section of a plan of an arm, its name, and what the chosen model leaves of measurements
    package_dirs : as of `load_arm`
    """

    show_plan: Callable[..., Section] | None = None
    package_dirs: Sequence[Path] = ()
    kinds: dict[str, str] = field(default_factory=dict)
    arms: dict[str, Arm] = field(default_factory=dict)
    plans: dict[str, Plan] = field(default_factory=dict)
    measurements: dict[str, Measurements] = field(default_factory=dict)
    commands: dict[str, Table] = field(default_factory=dict)
    tests: dict[str, dict[str, Validation]] = field(default_factory=dict)

    @classmethod
    def of(cls, paths: Sequence[Path], **shows: Any) -> Self:
        """Reads every file by its kind, tables by the first arm, and compares models and measurements.

        Raises `InputError` for a file of another kind, one given twice, a table without an arm file, files of two arms.
        """
        campaign = cls(**shows)
        for path in sorted(paths, key=lambda path: path.suffix.lower() != ".toml"):  # tables are read by the arm
            if str(path) in campaign.kinds:
                raise InputError(f"{path}: is given twice, allowed: each file once")
            campaign.kinds[str(path)] = campaign.read(path)
        if calibrated := campaign.calibrated:
            for name in sorted(campaign.measurements, key=lambda name: bool(campaign.fitted(name))):
                rows = campaign.measurements[name]
                campaign.tests[name] = {model: validate(arm, rows) for model, arm in calibrated.items()}
        return campaign

    def read(self, path: Path) -> str:
        """Reads a file and returns its kind."""
        name, ending = str(path), path.suffix.lower()
        if ending == ".toml":
            self.arms[name] = arm = load_arm(path, self.package_dirs)
            first, other = next(iter(self.arms.items()))
            if not same_drawing(other, arm):
                raise InputError(f"{name}: another arm than that of {first}, allowed: files of one arm")
            return "arm with a calibration" if arm.calibration is not None else "arm"
        if ending not in (".csv", ".tsv", ".txt"):
            raise InputError(f"{name}: ending {path.suffix!r}, allowed: {ALLOWED}")
        if not self.arms:
            raise InputError(f"{name}: a table without its arm, allowed: the arm file (.toml) beside it")
        arm, table = next(iter(self.arms.values())), read_table(path)
        if all(column in table for column in ("error_mm", "reachable")):
            self.commands[name] = table
            return "joint commands"
        instrument = arm.chain.instrument
        read = ((c.name, c.quantity) for c in (*TRACKER.coordinates[:1], *instrument.coordinates[:1]))
        columns = [f"{axis}_{unit}" for axis, quantity in read for unit in UNITS[quantity]]
        touched = instrument.contact and "run" not in table  # a plan: postures and no reading, too
        if touched or any(column in table for column in columns):
            self.measurements[name] = load_measurements(path, arm)
            return "measurements"
        self.plans[name] = Plan.load(path, arm.joint_types, vias=True)
        return "plan"

    # -- models and measurements ---------------------------------------------------------------------------------------
    @property
    def calibrated(self) -> dict[str, Arm]:
        """The arms that have a calibration."""
        return {name: arm for name, arm in self.arms.items() if arm.calibration is not None}

    def fitted(self, rows: str) -> list[str]:
        """The calibrated arms that name these measurements as those that they were fitted to."""
        hashes = set(data_hashes(self.measurements[rows].provenance))
        return [model for model, arm in self.calibrated.items() if not hashes.isdisjoint(fitted_to(arm))]

    @property
    def chosen(self) -> str | None:
        """The calibrated arm of which commands are made: that of the least error on measurements that none was fitted
        to, of equal ones and without such measurements the last given; None without any."""
        others = [tests for rows, tests in self.tests.items() if not self.fitted(rows)]
        squares = {
            model: sum(float(np.sum(distances(tests[model].residuals) ** 2)) for tests in others)
            for model in reversed(self.calibrated)
        }
        return min(squares, key=squares.__getitem__) if squares else None

    @property
    def elsewhere(self) -> dict[str, Validation]:
        """What the chosen model leaves on each set of measurements that it was not fitted to."""
        chosen = self.chosen or ""
        return {rows: tests[chosen] for rows, tests in self.tests.items() if chosen not in self.fitted(rows)}

    # -- what is said --------------------------------------------------------------------------------------------------
    @property
    def verdict(self) -> list[str]:
        """The verdict in sentences: errors on rows that no fit has seen first."""
        model = self.chosen or ""
        lines = [validation_verdict(test.to_json(), model, rows) for rows, test in self.elsewhere.items()]
        seen = (rows for rows in self.tests if rows not in self.elsewhere)  # what other models leave is in the tables
        lines += [validation_verdict(self.tests[rows][model].to_json(), model, rows, seen=True) for rows in seen]
        if len(self.calibrated) > 1:
            tested = " and ".join(rows for rows in self.tests if not self.fitted(rows))
            why = f"it leaves the smallest error on {tested}" if tested else "it is the last given"
            others = " and ".join(name for name in self.calibrated if name != model)
            lines.append(f"Of the calibrations the next steps use {model}: {why}. {others} is shown beside it.")
        lines += [f"The plan {name} has {len(plan.measured)} runs." for name, plan in self.plans.items()]
        lines += [commanded_in_words(name, table) for name, table in self.commands.items()]
        return lines or [f"{name}: {kind}." for name, kind in self.kinds.items()]

    @property
    def actions(self) -> list[Action]:
        """What to do next, from the farthest step that was reached."""
        arm = next((name for name, one in self.arms.items() if one.calibration is None), next(iter(self.arms)))
        seen = {rows: self.fitted(rows) for rows in self.measurements}
        data = sorted(seen, key=lambda rows: (self.chosen not in seen[rows], not seen[rows])) or ["data.csv"]
        if worse := [
            Action(f"Do not use {self.chosen} as it is: on {rows} it is no better than the drawing (see there).")
            for rows, tests in self.tests.items()
            if (test := tests[self.chosen or ""]).model.rms >= test.nominal.rms
        ]:
            pooled = " ".join(["armcal diagnose", arm, *data])
            return [*worse, Action("See what all measurements together say, each file as a session:", pooled)]
        look, hold, use = calibrated_actions(arm, data[0], self.chosen or "calibrated.toml")
        if self.chosen is not None:
            done = diagnosed(self.calibrated[self.chosen])
            return [*([] if done else [look]), *([] if self.elsewhere else [hold]), use]
        if self.measurements:
            fit = self.measurements[data[0]].fit
            return [Action("Identify the arm:", identify_command(arm, data[0], fit)), look]
        fit = next((plan.fit for plan in self.plans.values()), "")
        why = ", as the plan is meant: what it promises is of this fit" if fit else ""
        measure = f"Measure the postures of {next(iter(self.plans), 'plan.csv')}, and write the positions beside the"
        return [
            Action(f"{measure} angles (armcal help formats)."),
            Action("See whether the data are what they should be:", f"armcal check {arm} data.csv"),
            Action(f"Identify the arm{why}:", identify_command(arm, "data.csv", fit)),
        ]

    def document(self) -> Document:
        """All of it."""
        drawn, sections = next(iter(self.arms.values())), list[Section]()
        for name in sorted(self.calibrated, key=lambda name: name != self.chosen):
            arm, closed = self.calibrated[name], name != self.chosen
            corrected = corrected_values(arm)
            rows, places = dh_lines(arm, corrected, Path(name))
            sections.append(corrected_section(f"Corrected values: {name}", corrected, folded=closed))
            sections += [Section(part.title, part.parts, closed) for part in dh_sections(rows, places, name)]
        sections += [self.test_section(rows) for rows in self.tests]
        show, left = self.show_plan, {rows: tests[self.chosen or ""] for rows, tests in self.tests.items()}
        sections += [show(drawn, plan, name, tests=left) for name, plan in self.plans.items()] if show else []
        joints = [f"q{j}_{'deg' if kind == REVOLUTE else 'mm'}" for j, kind in enumerate(drawn.joint_types, start=1)]
        axes = [f"{axis}_mm" for axis in "xyz"[: drawn.dimension]]
        for name, table in self.commands.items():
            targets = np.column_stack([table.floats(key) for key in axes])
            angles = np.column_stack([table.floats(key, empty=np.nan) for key in joints])
            commanded = command_rows(targets, angles, table.floats("error_mm", empty=np.nan))
            reasons = table.frame["message"].fill_null("").to_list() if "message" in table else [""] * len(table)
            lines = [[*row, str(reason)] for row, reason in zip(commanded, reasons, strict=True)]
            lead = f"{commanded_in_words(name, table)} The miss is the calibrated model's, not the robot's accuracy."
            heads = ["row", *axes, *joints, "miss [mm]", "why there is none"]
            sheet = Sheet(heads, lines, "", 24, "the file has all")
            sections.append(Section(f"Joint commands: {name}", [lead, sheet]))
        title = f"Calibration report: {drawn.name}".removesuffix(": ")
        return Document(title, self.verdict, sections, self.actions)

    def test_section(self, rows: str) -> Section:
        """The error of every model on some measurements, and its sign against each joint."""
        tests, measured, fitted = self.tests[rows], self.measurements[rows], self.fitted(rows)
        last, names = list(tests.values())[-1], ["drawing", *tests]
        figures = [last.nominal, *(test.model for test in tests.values())]
        cells = [[name, *map(number, values)] for name, values in zip(names, figures, strict=True)]
        other = None if len(tests) == 1 else list(tests.values())[-2]
        before, pair = last.nominal_residuals if other is None else other.residuals, (names[-2], names[-1])
        used = f"Fitted to these rows: {', '.join(fitted)}." if fitted else ""
        if not fitted and all(fitted_to(arm) for arm in self.calibrated.values()):
            used = "No model given here names this file as what it was fitted to."
        notes = [as_sentence(note) for note in last.notes if "identified from" not in note]
        pairs = [*zip((before, last.residuals), pair, strict=True)]
        return Section(
            f"Error on {rows}",
            [
                " ".join([f"{len(measured)} rows.", used, *notes]),
                PLACED,
                Sheet(["distance [mm]", "RMS", "mean", "95 % below", "largest"], cells),
                Pictures(lambda: [workspace_arrows(last.arm, measured.positions, pairs)]),
                Pictures(lambda: signed_figures(last.arm, measured.postures, pairs, measured.conditions)),
            ],
        )


def fitted_to(arm: Arm) -> list[str]:
    """Hashes of the files that a calibrated arm was fitted to, empty: it does not say."""
    return [] if arm.calibration is None else data_hashes(arm.calibration.provenance)


def commanded_in_words(name: str, commands: Table) -> str:
    """How many targets a file of commands reaches;  name : of the file"""
    reached = commands.floats("reachable") > 0.0
    missing = (np.flatnonzero(~reached) + 1).tolist()
    none = f"; {rows_listed(missing)} {'have' if len(missing) > 1 else 'has'} none" if missing else ""
    return f"{name} has commands for {np.count_nonzero(reached)} of {len(commands)} targets{none}."
