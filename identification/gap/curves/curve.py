"""`Curve`: the error curve of a joint as a result, with its uncertainty and a description of its shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.error_curve import ErrorCurve
from identification.gap.curves.curve_shapes import Wave, shape_text, waves

COLUMNS = ("angle_deg", "correction_deg", "std_deg", "error_deg")


@dataclass(frozen=True)
class Curve:
    """The error of a joint, real less commanded angle, over the range of the measured angles.

    joint : from 1;  table : the function;  angles : (a,) every half node [rad]
    error, std : (a,) values of the function and their standard deviations [rad]
    length : correlation length of the prior, as estimated from the data [rad]
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
        """The effect as an entry of an arm file."""
        return EffectSpec("joint_error_curve", self.joint, curve=self.table)

    @property
    def correction(self) -> Array:
        """(a,) correction to be added to the command so that the joint reaches `angles` [rad]."""
        added = -self.error
        for _ in range(3):  # the error at the corrected command; slopes are far below one
            added = -self.table.at(self.angles + added)
        return added

    @cached_property
    def waves(self) -> tuple[Wave, ...]:
        """The waves that it consists of, strongest first."""
        return waves(self.angles, self.error, self.std)

    @property
    def shape(self) -> str:
        """Description of its shape."""
        return shape_text(self.angles, self.error, self.std, self.waves)

    def table_rows(self) -> list[tuple[float, ...]]:
        """Rows of `--curves`: joint, then angle, correction, standard deviation and error [deg]."""
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
    """The CSV table of `armcal diagnose --curves`: the correction of the commanded angle at every half node."""
    rows = [row for curve in curves for row in curve.table_rows()]
    return "".join(",".join(map(str, line)) + "\n" for line in (("joint", *COLUMNS), *rows))
