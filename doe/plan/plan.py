"""A plan: the postures to measure, in the order of measurement, or an approximate design with weights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from identification.arrays import Array, ByValue, readonly
from identification.data_frames import frame_of_columns
from identification.document import html_lines, html_table
from identification.kinematics.counting import counting_in, in_columns
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS, REVOLUTE


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
        if set(self.joint_types) == {REVOLUTE} and counting_in(self.joint_types) is None:
            object.__setattr__(self, "joint_types", ())
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
    def units(self) -> tuple[str, ...]:
        """(n) units in which joints are shown: deg, or mm."""
        return tuple(FILE_UNITS[unit][0] for unit in self._units)

    @property
    def displayed(self) -> Array:
        """(m, n) postures in `units`, as the controller counts."""
        return readonly(in_columns(self.postures, self.joint_types) * [FILE_UNITS[unit][1] for unit in self._units])

    def to_frame(self, kind: str = "polars") -> Any:
        """A row for each posture, as in a plan file; polars or pandas."""
        columns = {f"q{j}_{unit}": q for j, (unit, q) in enumerate(zip(self.units, self.displayed.T, strict=True), 1)}
        weight = {} if self.weights is None else {"weight": self.weights}
        return frame_of_columns({"run": range(1, len(self) + 1), **columns, **weight}, kind)

    def _repr_html_(self) -> str:
        return str(self.to_frame()._repr_html_())

    def to_html(self, caption: object, heading: str, labels: Iterable[str]) -> str:
        """A caption and a table of the postures for notebooks, each row beginning with its label."""
        head = (f"q{j} [{unit}]" for j, unit in enumerate(self.units, start=1))
        rows = ([label, *(f"{q:.2f}" for q in row)] for label, row in zip(labels, self.displayed, strict=True))
        return html_lines(str(caption).splitlines()) + html_table([heading, *head], rows)

    @property
    def _units(self) -> list[str]:
        return [JOINT_UNITS[joint_type] for joint_type in self.joint_types or (REVOLUTE,) * self.links]

    @property
    def shares(self) -> Array:
        """(m,) weight of every posture; 1/m for an exact plan."""
        return np.full(len(self), 1.0 / len(self)) if self.weights is None else self.weights
