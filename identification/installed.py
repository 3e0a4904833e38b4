"""What installed packages add by entry points: named before their code runs, and refused in one line where it fails."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib import metadata
from typing import Any

from identification.errors import InputError


def additions(group: str) -> Iterator[tuple[str, str, Any]]:
    """Name, place (for messages) and object of every entry point of a group.

    Warns (`UserWarning`) of all of them before the first is loaded, which runs the package's code. Raises `InputError`
    for one that cannot be loaded.
    """
    points = list(metadata.entry_points(group=group))
    if points:
        listed = ", ".join(f"{point.name} ({package(point)})" for point in points)
        warnings.warn(f"{group} of installed packages, whose code runs now: {listed}", UserWarning, stacklevel=2)
    for point in points:
        where = f"entry point {group}: {point.name} = {point.value}"
        try:
            loaded = point.load()
        except Exception as error:  # noqa: BLE001 - other people's code
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(f"{where}: {reason}, allowed: a package that can be imported") from None
        yield point.name, where, loaded


def package(point: metadata.EntryPoint) -> str:
    """Name and version of the package of an entry point."""
    return "of no package" if point.dist is None else f"{point.dist.name} {point.dist.version}"
