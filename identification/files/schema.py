"""Tables of TOML files as pydantic models, with one-line messages for wrong values.

The description of a field is the end of its error message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from identification.arm import LARGEST_ACCELERATION, LARGEST_ANGLE, LARGEST_MASS, LENGTH_RANGE, SIGMA_RANGE
from identification.errors import InputError, nearest
from identification.spelling import close_names

Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
Length = Annotated[float, Field(ge=LENGTH_RANGE[0], le=LENGTH_RANGE[1])]
Coordinate = Annotated[float, Field(ge=-LENGTH_RANGE[1], le=LENGTH_RANGE[1])]
Angle = Annotated[float, Field(ge=-LARGEST_ANGLE, le=LARGEST_ANGLE)]
Sigma = Annotated[float, Field(ge=SIGMA_RANGE[0], le=SIGMA_RANGE[1])]
NotNegative = Annotated[float, Field(ge=0)]
Mass = Annotated[float, Field(ge=0, le=LARGEST_MASS)]
Acceleration = Annotated[float, Field(ge=-LARGEST_ACCELERATION, le=LARGEST_ACCELERATION)]


OTHER_KEYS = {  # what people write for keys of an arm file
    "lengths_mm": "links_mm",
    "link_lengths_mm": "links_mm",
    "min": "lower",
    "max": "upper",
    "g": "acceleration_m_s2",
    "theta_deg": "offset_deg",
    "theta": "offset_deg",
}


class StrictTable(BaseModel):
    """A table without unknown keys, its numbers finite."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Schema:
    """A file: the table that each path of keys leads to, `""` the whole file; `constraints.KIND` by their kind.

    elsewhere : key that the file does not have -> kind of arm whose file has it
    """

    tables: Mapping[str, type[BaseModel]]
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    def validated(self, tables: Mapping[str, Any], place: str = "") -> Any:
        """The file's model. Raises `InputError` naming key, what was found and what is allowed.

        place : where in the file the tables stand
        """
        try:
            return self.tables[""].model_validate(tables)
        except ValidationError as error:
            details = error.errors(include_url=False)
            # a misspelt key is both unknown and missing: the first of the two says more
            first = min(details, key=lambda detail: detail["type"] != "extra_forbidden")
            raise InputError(f"{place}{self._sentence(first)}") from None

    def _sentence(self, detail: Any) -> str:
        loc, kind = detail["loc"], detail["type"]
        key = _dotted(loc)
        if kind == "extra_forbidden":
            return f"{key}: {self._unknown(str(loc[-1]), loc[:-1])}"
        if kind.startswith("union_tag"):
            kinds = [path.partition(".")[2] for path in self.tables if path.startswith("constraints.")]
            if kind == "union_tag_not_found":
                return f"{key}.kind: is missing, allowed: {', '.join(sorted(kinds))}"
            tag = str(detail["ctx"]["tag"])
            return f"{key}.kind: found {tag!r}, {nearest(tag, kinds)}"
        if kind == "value_error":  # from a validator: a sentence already
            return f"{key}.{detail['ctx']['error']}"
        found = "is missing" if kind == "missing" else f"found {_shown(detail)}"
        return f"{key}: {found}, allowed: {self._allowed(loc)}"

    def _unknown(self, key: str, loc: tuple[int | str, ...]) -> str:
        """What to do about a key that the table at `loc` does not have."""
        if not loc and key in self.elsewhere:
            return f"found in the file of an arm that is not {self.elsewhere[key]}, allowed: in one that is"
        below = [path for path, table in self.tables.items() if not loc and path and key in table.model_fields]
        known = self._model(loc).model_fields
        if len(below) == 1 and "." not in below[0] and not close_names(key, known):
            return f"found outside of a table, allowed: under [{below[0]}]"
        return f"unknown key, {nearest(key, known, OTHER_KEYS)}"

    def _model(self, loc: tuple[int | str, ...]) -> type[BaseModel]:
        return self.tables[".".join(part for part in loc if isinstance(part, str))]

    def _allowed(self, loc: tuple[int | str, ...]) -> str:
        """The description of the innermost field that `loc` lies in."""
        if loc[0] == "effects" and len(loc) == 3 and loc[2] not in self.tables["effects"].model_fields:
            return "a finite number"
        for end in range(len(loc), 0, -1):
            path = ".".join(part for part in loc[: end - 1] if isinstance(part, str))
            fields = self.tables[path].model_fields if path in self.tables else {}
            if loc[end - 1] in fields:
                return str(fields[str(loc[end - 1])].description)
        return "a table"


def _dotted(loc: tuple[int | str, ...]) -> str:
    """`constraints[2].x_mm`: entries are counted from 1, and the kind of a constraint is not part of its key."""
    if loc[0] == "constraints":
        loc = (*loc[:2], *loc[3:])
    text = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in loc)
    return text.removeprefix(".")


def _shown(detail: Any) -> str:
    value = detail["input"]
    if detail["type"] in ("too_long", "too_short"):
        return f"{len(value)} values"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def require_count(key: str, values: list[Any], count: int, what: str = "values for", whose: str = "links") -> None:
    """Raises `InputError` unless there is one value for each link, joint or other item."""
    if len(values) != count:
        raise InputError(f"{key}: found {len(values)} {what} {count} {whose}, allowed: {count}")


def require_rising(key: str, values: list[float]) -> None:
    """Raises `ValueError`, as a pydantic validator must, unless the first of two values is the lower one."""
    if values[0] >= values[1]:
        raise ValueError(f"{key}: found [{values[0]:g}, {values[1]:g}], allowed: the lower one first")
