"""Parameters of a model: names, units, bounds and scales."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType

import numpy as np

# unit in the API -> (unit in files and tables, factor to it, suffix of the key in an arm file)
FILE_UNITS: Mapping[str, tuple[str, float, str]] = MappingProxyType(
    {
        "mm": ("mm", 1.0, "_mm"),
        "rad": ("deg", 180.0 / np.pi, "_deg"),
        "1": ("1", 1.0, ""),
        "rad/(N m)": ("rad/(N m)", 1.0, "_rad_per_N_m"),
        "1/(N m^2)": ("1/(N m^2)", 1.0, "_per_N_m2"),
        "1/K": ("1/K", 1.0, "_per_K"),
        "mm/session": ("mm/session", 1.0, "_mm"),
        "rad/session": ("deg/session", 180.0 / np.pi, "_deg"),
    }
)


@dataclass(frozen=True)
class Parameter:
    """One number that an identification can estimate.

    name : as it stands in reports, `length_error:1` or `EFFECT[:joint].PARAMETER` (see `Effect.key`)
    unit : of the Python API (millimetres, radians); `file_unit` is what people read
    lower, upper : physical bounds, API unit
    scale : length [mm] that one unit moves the tip by, in order of magnitude; criteria that are not invariant to units
        divide by it (lengths 1, angles of joint j the best known length of link j)
    """

    name: str
    unit: str
    lower: float = -inf
    upper: float = inf
    scale: float = 1.0

    @property
    def short(self) -> str:
        """The name inside its effect: `a` of `encoder_eccentricity:2.a`."""
        return self.name.rpartition(".")[2]

    @property
    def file_unit(self) -> str:
        """Unit in files, tables and JSON."""
        return FILE_UNITS[self.unit][0]

    @property
    def to_file(self) -> float:
        """Factor from the API unit to `file_unit`."""
        return FILE_UNITS[self.unit][1]

    @property
    def toml_key(self) -> str:
        """Key in an arm file: `a_deg`."""
        return self.short + FILE_UNITS[self.unit][2]
