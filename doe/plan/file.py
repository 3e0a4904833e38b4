"""Plan files: CSV in degrees <-> `Plan` in radians."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

from doe.plan.plan import Plan
from identification.files.plan import plan_file_text, read_plan


def load_plan(path: str | PathLike[str], joints: int | Sequence[str] | None = None) -> Plan:
    """The plan of a CSV file `run,q1_deg,...,qn_deg[,weight]`, rows in the order of measurement, `# fit: ...` above.

    joints : how many the arm has, or the type of each: a prismatic one has a column `q1_mm`

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    file = read_plan(path, joints)
    return Plan(file.postures, file.weights, fit=file.fit)


def plan_text(plan: Plan, joint_types: int | Sequence[str] | None = None) -> str:
    """The text of a plan file; `load_plan` reads the same from it, to rounding (1e-14 rad)."""
    return plan_file_text(plan.postures, plan.weights, plan.fit, joint_types)
