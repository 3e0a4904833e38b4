"""`armcal report`: one page of whatever files of a campaign are given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from doe.report.compensation_tables import commanded_in_words, commands_section
from doe.report.gap_figures import workspace_arrows
from doe.report.gap_sections import (
    corrected_section,
    curve_sections,
    dh_section,
    further_sections,
    gap_section,
    missing_section,
)
from doe.report.given_files import Given
from doe.report.identification_tables import dh_table
from doe.report.origin import Origin, origin_section
from doe.report.page import Action, Section, Sheet, page
from doe.report.plan_steps import plan_section
from doe.report.signed_residuals import Compared, caption, signed_figures
from doe.report.terminal import number
from doe.report.verdict import (
    calibrated_actions,
    data_actions,
    design_verdict,
    diagnosis_actions,
    diagnosis_verdict,
    gap_in_words,
    identification_verdict,
    plan_actions,
    validation_verdict,
)
from identification.arm import Arm
from identification.errors import InputError
from identification.estimation.corrected_values import CorrectedValue, corrected_values
from identification.estimation.dh_values import Calibrated
from identification.measurements import distances
from identification.model import Model
from identification.validate import Validation, validate
from identification.validate.row_groups import data_hashes, diagnosed, outside

MOSTLY = 0.5  # of the rows
FIGURES = ("rms_mm", "mean_mm", "p95_mm", "max_mm")
PLACED = (
    "Everything stays as it is in the file but for where the arm stands, which is fitted anew to each set of "
    "measurements; so it is for the drawing."
)


@dataclass(frozen=True)
class Campaign:
    """The files given, and the residuals of every calibrated arm on every set of measurements."""

    given: Given
    tests: dict[str, dict[str, Validation]]  # measurements -> arm -> what it leaves

    @classmethod
    def of(cls, given: Given) -> Campaign:
        """Compares models and measurements. Raises `InputError` where they do not fit each other."""
        found = cls(given, {})
        for name in sorted(given.measurements if given.calibrated else (), key=found.fitted_to):
            rows = given.measurements[name]
            found.tests[name] = {model: validate(arm, rows) for model, arm in given.calibrated.items()}
        return found

    @property
    def digests(self) -> list[list[str]]:
        """Hashes of the files that each calibrated arm was fitted to, empty: it does not say."""
        found = (arm.calibration for arm in self.given.calibrated.values())
        return [data_hashes(calibration.provenance) for calibration in found if calibration]

    def fitted(self, rows: str) -> list[str]:
        """The calibrated arms that name these measurements as those that they were fitted to."""
        own = set(data_hashes(self.given.measurements[rows].provenance))
        pairs = zip(self.given.calibrated, self.digests, strict=True)
        return [model for model, fitted in pairs if not own.isdisjoint(fitted)]

    def fitted_to(self, rows: str) -> bool:
        """True if a calibration was fitted to these measurements."""
        return bool(self.fitted(rows))

    @property
    def worse(self) -> list[Action]:
        """A warning for every set of other measurements that the chosen model does not improve."""
        last = ((rows, (self.chosen, tests[self.chosen])) for rows, tests in self.tests.items() if self.chosen)
        return [
            Action(f"Do not use {model} as it is: on {rows} it is no better than the drawing (see there).")
            for rows, (model, test) in last
            if test.model.rms >= test.nominal.rms
        ]

    @property
    def elsewhere(self) -> dict[str, Validation]:
        """What the chosen model leaves on each set of measurements that it was not fitted to."""
        chosen = self.chosen
        pairs = ((rows, tests[chosen]) for rows, tests in self.tests.items() if chosen)
        return {rows: test for rows, test in pairs if chosen not in self.fitted(rows)}

    @property
    def beyond(self) -> list[Action]:
        """What to measure where most rows of other measurements are at angles that the chosen model has not seen."""
        found = []
        for rows, test in self.elsewhere.items():
            out = outside(test.arm, self.given.measurements[rows].postures)
            if out is not None and (share := float(np.mean(out.any(axis=1)))) > MOSTLY:
                far = f"{100.0 * share:.0f} % of the rows of {rows} are beyond the angles that {self.chosen} has seen"
                found.append(Action(f"Measure over all angles that the robot will use, and identify again: {far}."))
        return found

    @property
    def chosen(self) -> str | None:
        """The calibrated arm of which commands are made: that of the least error on measurements that none was fitted
        to, of equal ones and without such measurements the last given; None without any."""
        others = [tests for rows, tests in self.tests.items() if not self.fitted_to(rows)]
        squares = {
            model: sum(float(np.sum(distances(tests[model].residuals) ** 2)) for tests in others)
            for model in reversed(self.given.calibrated)
        }
        return min(squares, key=squares.__getitem__) if squares else None

    @property
    def choice(self) -> list[str]:
        """Which of several calibrations is used, and why, in a sentence."""
        if len(self.given.calibrated) < 2:
            return []
        tested = [rows for rows in self.tests if not self.fitted_to(rows)]
        why = f"it leaves the smallest error on {' and '.join(tested)}" if tested else "it is the last given"
        others = " and ".join(name for name in self.given.calibrated if name != self.chosen)
        return [f"Of the calibrations the next steps use {self.chosen}: {why}. {others} is shown beside it."]

    @property
    def verdict(self) -> list[str]:
        """The verdict in sentences: errors on rows that no fit has seen, then the most advanced result first."""
        model, diagnoses = self.chosen or "", self.said("diagnose")
        found = [validation_verdict(test.to_json(), model, rows) for rows, test in self.elsewhere.items()]
        found += [] if found else [validation_verdict(data) for data in self.said("validate")]
        found += [] if found else [gap_in_words(data) for data in diagnoses if data["confirmation"] is not None]
        found += [sentence for data in diagnoses for sentence in diagnosis_verdict(data) if sentence not in found]
        seen = (rows for rows in self.tests if rows not in self.elsewhere)  # what other models leave is in the tables
        found += [validation_verdict(self.tests[rows][model].to_json(), model, rows, seen=True) for rows in seen]
        found += self.choice
        found += [identification_verdict(data) for data in self.said("identify")]
        found += [design_verdict(data) for data in self.said("design")]
        plans = {} if self.said("design") else self.given.plans
        found += [f"The plan {name} has {len(plan)} runs." for name, (plan, _) in plans.items()]
        found += [commanded_in_words(name, table) for name, table in self.given.commands.items()]
        return found or [f"{name}: {kind}." for name, kind in self.given.kinds.items()]

    def said(self, command: str) -> list[Any]:
        """The JSON objects of a command."""
        return list(self.given.said[command].values())

    @property
    def actions(self) -> list[Action]:
        """What to do next, from the farthest step that was reached."""
        given = self.given
        arm = next((name for name, one in given.arms.items() if one.calibration is None), None)
        seen = {rows: self.fitted(rows) for rows in given.measurements}
        data = sorted(seen, key=lambda rows: (self.chosen not in seen[rows], not seen[rows])) or ["data.csv"]
        names = {"arm": arm or next(iter(given.arms), "arm.toml"), "rows": data[0]}
        if self.worse:
            pooled = " ".join(["armcal diagnose", names["arm"], *data])
            return [*self.worse, Action("See what all measurements together say, each file as a session:", pooled)]
        if diagnoses := self.said("diagnose"):
            return diagnosis_actions(diagnoses[-1], names["arm"], [names["rows"]])
        if given.calibrated or self.said("identify") or self.said("validate"):
            chosen = given.calibrated.get(self.chosen or "")
            done = chosen is not None and diagnosed(chosen)
            look, hold, use = calibrated_actions(**names, calibrated=self.chosen or "calibrated.toml")
            tested = bool(self.elsewhere) or bool(self.said("validate"))
            return [*self.beyond, *([] if done else [look]), *([] if tested else [hold]), use]
        if given.measurements:
            return data_actions(**names, fit=given.measurements[names["rows"]].fit)
        plan, fits = next(iter(given.plans), "plan.csv"), [one.fit for one, _ in given.plans.values()]
        fits += [data.get("fit") or "" for data in self.said("design")]
        return plan_actions(names["arm"], plan, next(iter(fits), ""))

    @property
    def sections(self) -> list[Section]:
        """The parts of the page."""
        diagnoses = self.said("diagnose")
        found = [part for data in diagnoses for part in (missing_section(data), gap_section(data))]
        found += [part for data in diagnoses for part in curve_sections(data)]
        found += [*self.corrected(), *(self.test_section(rows) for rows in self.tests)]
        found += [part for name in self.given.plans for part in self.plan(name)]
        arm = next(iter(self.given.arms.values()), None)
        found += [commands_section(name, table, arm) for name, table in self.given.commands.items() if arm]
        found += [_blocks(data) for data in self.said("validate")]
        return found + [part for data in diagnoses for part in further_sections(data)]

    def corrected(self) -> list[Section]:
        """Nominal and corrected values of every calibrated arm, or as `identify` said them, and as numbers of the
        Denavit-Hartenberg table where the drawing is one."""
        arms = self.given.calibrated
        first = sorted(arms, key=lambda name: name != self.chosen)
        found = [
            replace(part, folded=name != self.chosen) for name in first for part in _corrected_arm(arms[name], name)
        ]
        said = {} if arms else self.given.said["identify"]
        return found + [part for name, data in said.items() for part in _corrected_said(data, name)]

    def test_section(self, rows: str) -> Section:
        """The error of every model on some measurements, and its sign against each joint."""
        tests, measured = self.tests[rows], self.given.measurements[rows]
        last = list(tests.values())[-1]
        names = ["drawing", *tests]
        figures = [vars(last.nominal).values(), *(vars(test.model).values() for test in tests.values())]
        cells = [[name, *map(number, values)] for name, values in zip(names, figures, strict=True)]
        other = None if len(tests) == 1 else list(tests.values())[-2]
        before, pair = last.nominal_residuals if other is None else other.residuals, (names[-2], names[-1])
        named = new_effects(last.arm, None if other is None else other.arm)
        more = measured.conditions, Model(last.arm), named
        compared = Compared(last.arm, measured.postures, before, last.residuals, *more)
        used = "" if not all(self.digests) else "No model given here names this file as what it was fitted to. "
        used = f"Fitted to these rows: {', '.join(self.fitted(rows))}. " if self.fitted_to(rows) else used
        found = "".join(f"{note[:1].upper()}{note[1:]}. " for note in last.notes if "identified from" not in note)
        return Section(
            f"Error on {rows}",
            [f"{len(measured)} rows. {used}{found}", PLACED, caption(*pair, named)],
            [Sheet(["distance [mm]", "RMS", "mean", "95 % below", "largest"], cells)],
            [
                workspace_arrows(last.arm, measured.positions, ((before, pair[0]), (last.residuals, pair[1]))),
                *signed_figures(compared),
            ],
        )

    def plan(self, name: str) -> list[Section]:
        """A plan to step through, by the first arm."""
        plan, table = self.given.plans[name]
        return [plan_section(next(iter(self.given.arms.values())), plan, table, name)]


def _corrected_arm(arm: Arm, name: str) -> list[Section]:
    """Corrected values of a calibrated arm;  name : of its file"""
    values, said = corrected_values(arm), getattr(arm.calibration, "provenance", None)
    found = Calibrated.of_arm(arm)
    table = ((), []) if found is None else dh_table(found, values, Path(name))
    return [corrected_section(values, arm.chain is not None, name, said), *dh_section(*table, name)]


def _corrected_said(data: Mapping[str, Any], name: str) -> list[Section]:
    """The same by what `identify` said;  name : of that file, which of earlier versions has none"""
    values, table = ([CorrectedValue(**row) for row in data.get(key, ())] for key in ("corrected_values", "dh_table"))
    found = [corrected_section(values, "geometry" in data, name)] if "corrected_values" in data else []
    return [*found, *dh_section(table, data.get("dh_places", ()), name)]


def new_effects(arm: Arm, before: Arm | None) -> list[str]:
    """Labels of the effects that a model has and the one before had not; None: the drawing, which has none."""
    known = {effect.label for effect in Model(before).effects} if before else set()
    return [effect.label for effect in Model(arm).effects if effect.label not in known]


def _blocks(data: Any) -> Section:
    """The result of `validate`, block by block."""
    rows = [["all", "", str(data["rows"]), number(data["rms_nominal_mm"]), *(number(data[key]) for key in FIGURES)]]
    rows += [
        [b["kind"], b["name"], str(b["rows"]), number(b["rms_nominal_mm"]), *(number(b[key]) for key in FIGURES)]
        for b in data["blocks"]
    ]
    headings = ["block", "which", "rows", "RMS drawing", "RMS", "mean", "95 % below", "largest"]
    return Section("Validation, block by block", "Distances in mm.", [Sheet(headings, rows)], folded=True)


def campaign_page(given: Given, origin: Origin) -> tuple[str, Campaign]:
    """The page and what is on it. Raises `InputError` for JSON that lacks what its command says."""
    campaign = Campaign.of(given)
    arms = [arm.name for arm in given.arms.values() if arm.name]
    title = f"Calibration report: {arms[0]}" if arms else "Calibration report"
    doubtful = (*campaign.said("diagnose"), *campaign.said("identify"))
    try:
        warnings = [text for data in doubtful for text in data["warnings"]]
        sections = [*campaign.sections, origin_section(origin)]
        return page(title, campaign.verdict, sections, campaign.actions, warnings), campaign
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        names = ", ".join(name for said in given.said.values() for name in said)
        if not names:
            raise
        found = f"{type(error).__name__} {error}"
        raise InputError(f"{names}: not as the command writes it ({found}), allowed: the whole of its JSON") from error
