"""Read-only arrays of floats, and dataclasses of them that compare by value."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


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
        return all(_same(value, getattr(other, name)) for name, value in _fields(self).items())

    def __hash__(self) -> int:
        return hash((type(self), *map(_hashable, _fields(self).values())))


def _fields(item: Any) -> dict[str, Any]:
    return {entry.name: getattr(item, entry.name) for entry in fields(item)}


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return one is not None and other is not None and np.array_equal(one, other)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(value, other[key]) for key, value in one.items())
    return bool(one == other)


def _hashable(value: Any) -> Any:
    """Equal for equal values: of a mapping its keys, of an array its shape, which distinguish most things."""
    if isinstance(value, np.ndarray | Mapping):
        return np.shape(value) if isinstance(value, np.ndarray) else frozenset(value)
    return value
