"""Read-only arrays of floats, and dataclasses of them that compare by value."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from dataclasses import fields
from itertools import accumulate
from numbers import Real
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


class ByValue:
    """Base of frozen dataclasses that hold arrays or mappings: equal if class and fields are, to the last bit."""

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(map(_same, _values(self), _values(other)))

    def __hash__(self) -> int:
        return hash((type(self), *map(_hashable, _values(self))))


def _values(data: Any) -> list[Any]:
    return [getattr(data, each.name) for each in fields(data)]


def _same(one: Any, other: Any) -> bool:
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return one is not None and other is not None and np.array_equal(one, other)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(map(_same, one.values(), map(other.get, one)))
    return bool(one == other)


def _hashable(value: Any) -> Any:
    """Equal for equal values; of an array shape and (effort) first 50 numbers, of a mapping keys, numbers, arrays."""
    if isinstance(value, Mapping):
        numbers = {key: held for key, held in value.items() if isinstance(held, Real | np.ndarray)}
        return frozenset(value), frozenset(zip(numbers, map(_hashable, numbers.values()), strict=True))
    return (value.shape, *value.flat[:50].tolist()) if isinstance(value, np.ndarray) else value


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Where each part of a vector stands, of parts of these sizes in this order."""
    ends = accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def rows_in_words(chosen: NDArray[np.bool_]) -> str:
    """The numbers from 1 of the rows chosen (m,), the first few of many."""
    numbers = (np.flatnonzero(chosen) + 1).tolist()
    rest = f" and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else ""
    return f"row{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers[:SHOWN]))}{rest}"
