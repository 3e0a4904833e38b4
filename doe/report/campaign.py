"""`armcal report`: one page of whatever files of a campaign are given, plans and designs among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from doe.plan.plan import Plan
from doe.report.design import design_verdict, plan_section
from identification import Arm, Campaign, read_plan
from identification.document import Action, Section


@dataclass
class PlannedCampaign(Campaign):
    """A campaign with its plans: name -> plan, and the columns of its file; and what `design` and `score` said."""

    KEYS: ClassVar[Mapping[str, Sequence[str]]] = {
        **Campaign.KEYS,
        "design": ("criterion", "runs", "efficiency", "certified_optimal"),
    }
    ALLOWED: ClassVar[str] = (
        "arm files (.toml), plans, measurements and joint commands (.csv), what design, score, identify, diagnose or "
        "validate --json said"
    )

    plans: dict[str, tuple[Plan, Mapping[str, Sequence[str]]]] = field(default_factory=dict)

    def read_other(self, path: Path, arm: Arm) -> str:
        """A plan."""
        file = read_plan(path, arm.joint_types)
        self.plans[str(path)] = Plan(file.postures, file.weights, fit=file.fit), file.cells
        return "plan"

    def other_verdict(self) -> list[str]:
        """How good a design is, or how many runs a plan has."""
        if designs := self.results["design"]:
            return [design_verdict(data) for data in designs.values()]
        return [f"The plan {name} has {len(plan)} runs." for name, (plan, _) in self.plans.items()]

    def other_sections(self) -> list[Section]:
        """The plans, to step through."""
        arms = [*self.arms.values()]
        return [plan_section(arms[0], plan, cells, name) for name, (plan, cells) in self.plans.items()]

    def first_actions(self, arm: str) -> list[Action]:
        """From a plan to a calibration."""
        fits = [plan.fit for plan, _ in self.plans.values()]
        fits += [design.get("fit") or "" for design in self.results["design"].values()]
        plan, fit = next(iter(self.plans), "plan.csv"), next(iter(fits), "")
        why = ", as the plan is meant: what it promises is of this fit" if fit else ""
        identify = f"armcal identify {arm} data.csv{fit and f' --{fit}'} --out calibrated.toml"
        return [
            Action(f"Measure the postures of {plan}, and write the positions beside the angles (armcal help formats)."),
            Action("See whether the data are what they should be:", f"armcal check {arm} data.csv"),
            Action(f"Identify the arm{why}:", identify),
        ]
