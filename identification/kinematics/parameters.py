"""Parameters of a model: names, units, bounds, scales and kinds, and vectors of their values."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import inf
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array, readonly
from identification.errors import InputError

MAX_LINKS = 12
AXES = "xyz"
# unit in the API -> (unit in files and tables, factor to it, suffix of the key in an arm file)
FILE_UNITS: Mapping[str, tuple[str, float, str]] = MappingProxyType(
    {
        "mm": ("mm", 1.0, "_mm"),
        "rad": ("deg", 180.0 / np.pi, "_deg"),
        **{unit: (unit, 1.0, "") for unit in ("1", "rad/mm", "mm/rad")},
        "rad/(N m)": ("rad/(N m)", 1.0, "_rad_per_N_m"),
        "mm/N": ("mm/N", 1.0, "_mm_per_N"),
        "1/(N m^2)": ("1/(N m^2)", 1.0, "_per_N_m2"),
        "kg": ("kg", 1.0, "_kg"),
        "1/K": ("1/K", 1.0, "_per_K"),
        "mm/session": ("mm/session", 1.0, "_mm"),
        "mm/K": ("mm/K", 1.0, "_mm_per_K"),
        "rad/session": ("deg/session", 180.0 / np.pi, "_deg"),
    }
)
# types of joints -> unit of their positions in the API
REVOLUTE, PRISMATIC = "revolute", "prismatic"
JOINT_UNITS: Mapping[str, str] = MappingProxyType({REVOLUTE: "rad", PRISMATIC: "mm"})
# kinds of parameters; those of the chain belong to a joint, those of the effects may
LENGTH_ERROR, JOINT_OFFSET, EFFECT = "length_error", "joint_offset", "effect"
# names of the parameters of a chain, in the plane and in space
GEOMETRY = re.compile(r"(length_error|joint_offset|(translation|rotation)_[xyz]):\d+|base\.r?[xyz]|tool\[.*\]\.r?[xyz]")


def error_names(frame: str | int) -> tuple[str, ...]:
    """(6) names of the translations and rotations by which a frame is off: of a joint by its number from 1, of `base`
    or `tool[1]`."""
    if isinstance(frame, int):
        return tuple(f"{motion}_{axis}:{frame}" for motion in ("translation", "rotation") for axis in AXES)
    return tuple(f"{frame}.{motion}{axis}" for motion in ("", "r") for axis in AXES)


@dataclass(frozen=True)
class Parameter:
    """One number that an identification can estimate."""

    name: str  # as it stands in reports, `length_error:1` or `EFFECT[:joint].PARAMETER` (see `Effect.key`)
    unit: str  # of the Python API (millimetres, radians); `file_unit` is what people read
    lower: float = -inf  # physical bounds, API unit
    upper: float = inf
    # length [mm] that one unit moves the tip by, in order of magnitude; criteria that are not invariant to units divide
    # by it (lengths 1, angles of joint j the best known length of link j)
    scale: float = 1.0
    kind: str = EFFECT  # or `length_error`, `joint_offset`, ..
    joint: int | None = None  # from 1, None: of the whole arm
    # standard deviation over arms as they are built, from catalogues (identification/README.md, "Typical sizes"), API
    # unit; None: not known
    typical: float | None = None
    start: float | None = None  # where fits begin and an effect that may be missing is derived, None: see `neutral`

    of_effect = property(lambda self: self.kind == EFFECT)  # not of the geometry
    short = property(lambda self: self.name.rpartition(".")[2])  # `a` of `encoder_eccentricity:2.a`
    file_unit = property(lambda self: FILE_UNITS[self.unit][0])  # in files, tables and JSON
    to_file = property(lambda self: FILE_UNITS[self.unit][1])  # factor from the API unit to that
    toml_key = property(lambda self: self.short + FILE_UNITS[self.unit][2])  # in an arm file: `a_deg`

    @property
    def neutral(self) -> float:
        """The value where nothing is known: `start`, else what the bounds allow that is nearest to 0."""
        return float(np.clip(0.0, self.lower, self.upper)) if self.start is None else self.start

    @property
    def file_name(self) -> str:
        """`name` as files have it: `base_offset.x0_mm`."""
        return self.name.removesuffix(self.short) + self.toml_key if self.of_effect else self.name


def _column(field: str) -> cached_property[Array]:
    """(p,) of a set of parameters."""
    return cached_property(lambda self: readonly([getattr(p, field) for p in self]))


class ParameterSet(tuple[Parameter, ...]):
    """An immutable sequence of p parameters, in the order of every vector and matrix of them."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(p) names."""
        return tuple(p.name for p in self)

    units = property(lambda self: tuple(p.unit for p in self))  # (p) of the API
    scales = _column("scale")  # length per unit [mm/unit]
    lower, upper = _column("lower"), _column("upper")  # physical bounds

    @cached_property
    def _places(self) -> dict[str, int]:
        return {p.name: k for k, p in enumerate(self)}

    def index(self, name: str) -> int:  # type: ignore[override]
        """Place of a parameter; raises `InputError` for a name that is not among these."""
        if name not in self._places:
            raise InputError.unknown("parameter: unknown name", name, self.names)
        return self._places[name]

    def indices(self, kind: str) -> NDArray[np.int64]:
        """Places of all parameters of a kind, in order."""
        return np.array([k for k, p in enumerate(self) if p.kind == kind], dtype=np.int64)

    length_errors = property(lambda self: self.indices(LENGTH_ERROR))  # places of the errors of lengths, in the plane
    joint_offsets = property(lambda self: self.indices(JOINT_OFFSET))  # places of the joint offsets

    @property
    def by_link(self) -> bool:
        """Whether length errors, joint offsets and effects are all there is, as of a planar chain: a row a link."""
        return {LENGTH_ERROR, JOINT_OFFSET, EFFECT}.issuperset(p.kind for p in self)

    def vector(self, values: Mapping[str, float], default: float | None = None) -> Array:
        """(p,) the values in order; where the mapping, which may have others, has none, `default`, None:
        `Parameter.neutral`, mostly 0."""
        missing = [p.neutral if default is None else default for p in self]
        return np.array([values.get(p.name, other) for p, other in zip(self, missing, strict=True)], dtype=float)

    def mapping(self, vector: ArrayLike) -> dict[str, float]:
        """Name -> value of a (p,) vector; raises `ValueError` for another length."""
        return dict(zip(self.names, np.asarray(vector, dtype=float).tolist(), strict=True))


def by_joint(values: Mapping[str, float], kind: str) -> Array:
    """(n,) the values of a kind, `kind:1` to `kind:n`, of a mapping from names."""
    return readonly([values[name] for j in range(1, MAX_LINKS + 1) if (name := f"{kind}:{j}") in values])
