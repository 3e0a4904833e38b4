"""An error curve of a joint as a result: the function with its uncertainty, and what it looks like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.error_curve import ErrorCurve
from identification.gap.curve_shapes import Wave, shape_text, waves

COLUMNS = ("angle_deg", "correction_deg", "std_deg", "error_deg")


@dataclass(frozen=True)
class Curve:
    """The error of a joint, real less commanded angle, over the angles measured.

    joint : from 1;  table : the function
    angles : (a,) [rad] every half node;  error, std : (a,) of the function there and its standard deviation [rad]
    length : correlation length of the prior that the data chose [rad]
    """

    joint: int
    table: ErrorCurve
    angles: Array
    error: Array
    std: Array
    length: float

    @property
    def key(self) -> str:
        """`joint_error_curve:1`"""
        return self.spec.key

    @property
    def spec(self) -> EffectSpec:
        """How it stands in an arm file."""
        return EffectSpec("joint_error_curve", self.joint, curve=self.table)

    @property
    def correction(self) -> Array:
        """(a,) what to add to the command for the joint to stand at `angles` [rad]."""
        added = -self.error
        for _ in range(3):  # the error at the corrected command; slopes are far below one
            added = -self.table.at(self.angles + added)
        return added

    @cached_property
    def waves(self) -> tuple[Wave, ...]:
        """What it is made of, strongest first."""
        return waves(self.angles, self.error, self.std)

    @property
    def shape(self) -> str:
        """For people: what it looks like."""
        return shape_text(self.angles, self.error, self.std, self.waves)

    def table_rows(self) -> list[tuple[float, ...]]:
        """Joint, then angle, correction, standard deviation and error [deg]: the rows of `--curves`."""
        columns = np.degrees([self.angles, self.correction, self.std, self.error])
        return [(self.joint, *(round(float(v), 7) for v in row)) for row in columns.T]

    def to_json(self) -> dict[str, Any]:
        """An entry of `curves` (identification/files/README.md, "JSON keys")."""
        columns = list(zip(*self.table_rows(), strict=True))[1:]
        return {
            "joint": self.joint,
            "from_deg": float(np.degrees(self.table.start)),
            "to_deg": float(np.degrees(self.table.stop)),
            "length_deg": float(np.degrees(self.length)),
            "shape": self.shape,
            "waves": [wave.to_json() for wave in self.waves],
            **{name: list(column) for name, column in zip(COLUMNS, columns, strict=True)},
        }


def curves_text(curves: Sequence[Curve]) -> str:
    """The CSV table of `armcal diagnose --curves`: what to add to the commanded angle, every half node."""
    rows = [row for curve in curves for row in curve.table_rows()]
    return "".join(",".join(map(str, line)) + "\n" for line in (("joint", *COLUMNS), *rows))
