"""A plan: the postures to measure, in the order of measurement, or an approximate design with weights; its file; and
from weights to whole numbers of runs by efficient apportionment, which loses least in the worst case.

F. Pukelsheim, S. Rieder, "Efficient rounding of approximate designs", Biometrika 79 (1992): start from
ceil((m - k/2) w_i) runs on each of the k support postures; while there are too few, add one where n_i / w_i is
smallest, while too many, take one where (n_i - 1) / w_i is largest. No rounding has a better guaranteed efficiency.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification import (
    Array,
    ByValue,
    InputError,
    frame_of_columns,
    plan_file_text,
    posture_columns,
    read_plan,
    readonly,
)


@dataclass(frozen=True, eq=False)
class Plan(ByValue):
    """m postures of an n-link arm.

    postures : (m, n) joint angles [rad], of prismatic joints positions [mm]
    weights : (m,) shares of the measurements, summing to one, None: an exact plan, every row is one measurement
    joint_types : (n) `revolute` or `prismatic`, empty: all revolute; `JointKinds` say how files count them
    fit : how its measurements are to be fitted, as options of `armcal identify`; empty: by the model of the arm file
    """

    postures: Array
    weights: Array | None = None
    joint_types: tuple[str, ...] = ()
    fit: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "postures", readonly(np.atleast_2d(self.postures)))
        if self.weights is not None:
            object.__setattr__(self, "weights", readonly(self.weights))

    def __len__(self) -> int:
        return len(self.postures)

    @property
    def links(self) -> int:
        """n, the number of joints."""
        return int(self.postures.shape[1])

    @property
    def shares(self) -> Array:
        """(m,) weight of every posture; 1/m for an exact plan."""
        return np.full(len(self), 1.0 / len(self)) if self.weights is None else self.weights

    @property
    def units(self) -> tuple[str, ...]:
        """(n) units in which joints are shown: deg, or mm."""
        return tuple(name.partition("_")[2] for name in posture_columns(self.postures, self.joint_types or None))

    @property
    def displayed(self) -> Array:
        """(m, n) postures in `units`, as the controller counts."""
        return readonly(np.column_stack([*posture_columns(self.postures, self.joint_types or None).values()]))

    def to_frame(self, kind: str = "polars") -> Any:
        """A row for each posture, as in a plan file; polars or pandas."""
        columns = {"run": range(1, len(self) + 1)} | posture_columns(self.postures, self.joint_types or None)
        return frame_of_columns(columns if self.weights is None else columns | {"weight": self.weights}, kind)

    def to_html(self, caption: object) -> str:
        """A caption and the postures, for notebooks."""
        return f"<pre>{escape(str(caption))}</pre>\n{self._repr_html_()}"

    def _repr_html_(self) -> str:
        from polars import Config

        with Config(tbl_rows=-1, tbl_cols=-1, tbl_hide_column_data_types=True):
            return str(self.to_frame()._repr_html_())


# -- files: CSV in degrees ---------------------------------------------------------------------------------------------
def load_plan(path: str | PathLike[str], joints: int | Sequence[str] | None = None) -> Plan:
    """The plan of a CSV file `run,q1_deg,...,qn_deg[,weight]`, rows in the order of measurement, `# fit: ...` above.

    joints : how many the arm has, or the type of each: a prismatic one has a column `q1_mm`

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    file = read_plan(path, joints)
    return Plan(file.postures, file.weights, fit=file.fit)


def plan_text(
    plan: Plan, joint_types: int | Sequence[str] | None = None, columns: Mapping[str, Sequence[str]] | None = None
) -> str:
    """The text of a plan file; `load_plan` reads the same from it, to rounding (1e-14 rad).

    columns : of names, (m,) each, that are written besides
    """
    return plan_file_text(plan.postures, plan.weights, plan.fit, joint_types, columns)


# -- from weights to whole numbers of runs -----------------------------------------------------------------------------
def apportion(weights: Array, runs: int) -> NDArray[np.int64]:
    """(k,) whole numbers that sum to `runs`, near runs * weights; at least one each where runs >= k.

    weights : (k,) positive, summing to one. With fewer runs than postures only the heaviest `runs` get one.
    """
    shares = np.asarray(weights, dtype=float)
    if not np.all(shares > 0.0) or abs(shares.sum() - 1.0) > 1e-6:  # more than rounding of a file
        raise InputError(f"weights: sum {shares.sum():g}, smallest {shares.min():g}, allowed: positive, sum one")
    if runs <= len(shares):
        heaviest = np.argsort(-shares, kind="stable")[:runs]
        return np.isin(np.arange(len(shares)), heaviest).astype(np.int64)
    numbers = np.ceil((runs - len(shares) / 2.0) * shares).astype(np.int64)
    while numbers.sum() < runs:
        numbers[np.argmin(numbers / shares)] += 1
    while numbers.sum() > runs:
        numbers[np.argmax((numbers - 1) / shares)] -= 1
    return numbers


def rounded_plan(plan: Plan, runs: int) -> Array:
    """(runs, n) postures of an approximate design, each as often as its weight asks for."""
    carried = plan.shares > 0.0
    numbers = apportion(plan.shares[carried] / plan.shares[carried].sum(), runs)
    return np.repeat(plan.postures[carried], numbers, axis=0)
