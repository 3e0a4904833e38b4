"""Read-only arrays of floats, and dataclasses of them that compare by value."""

import copyreg
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from itertools import accumulate
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
SHOWN = 5  # rows named in a sentence


def _read_only_mapping(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


# Python pickles no read-only mapping by itself; with this, arms and results travel to workers and into caches
copyreg.pickle(MappingProxyType, lambda proxy: (_read_only_mapping, (dict(proxy),)))


def readonly(values: ArrayLike, *shape: int) -> Array:
    """A float copy of `values` that cannot be written to, of the given shape if one is given."""
    array = np.array(values, dtype=float)
    if shape:
        array = array.reshape(shape)
    array.setflags(write=False)
    return array


class ReadOnly:
    """Base of frozen dataclasses: what a field declares as `Array` or as `Mapping` is a copy that cannot be changed.

    By the words of the declaration: modules with such classes have `from __future__ import annotations`.
    """

    def __post_init__(self) -> None:
        for name, is_array in _copied(type(self)):
            value = getattr(self, name)
            if not is_array:
                object.__setattr__(self, name, MappingProxyType(dict(value)))
            elif value is not None and (not isinstance(value, np.ndarray) or value.flags.writeable):
                object.__setattr__(self, name, readonly(value))


@cache
def _copied(kind: Any) -> tuple[tuple[str, bool], ...]:
    """Fields of a dataclass that hold arrays or mappings, and whether arrays."""
    words = [(each.name, str(each.type)) for each in fields(kind)]
    return tuple((name, word.startswith("Array")) for name, word in words if word.startswith(("Array", "Mapping")))


class ByValue(ReadOnly):
    """Base of frozen dataclasses that hold arrays or mappings: equal if class and fields are, to the last bit."""

    def __eq__(self, other: object) -> bool:
        return _contents(self) == _contents(other) if type(self) is type(other) else NotImplemented

    def __hash__(self) -> int:
        return hash((type(self), _contents(self)))


def _contents(data: Any) -> tuple[Any, ...]:
    """Of the fields of a dataclass what is equal for equal values, and hashable."""
    return tuple(_hashable(getattr(data, each.name)) for each in fields(data))


def _hashable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, *value.ravel().tolist()
    if isinstance(value, Mapping):
        return frozenset((key, _hashable(held)) for key, held in value.items())
    return tuple(map(_hashable, value)) if isinstance(value, list) else value


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Where each part of a vector stands, of parts of these sizes in this order."""
    ends = accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def rows_in_words(chosen: NDArray[np.bool_]) -> str:
    """The numbers from 1 of the rows chosen (m,), the first few of many."""
    numbers = (np.flatnonzero(chosen) + 1).tolist()
    rest = f" and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else ""
    return f"row{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers[:SHOWN]))}{rest}"
