"""Tables of a file with one key spoilt: what every reader must refuse in one line that names the key."""

from __future__ import annotations

import copy
import math
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tomlkit

from identification.errors import InputError

Tables = dict[str, Any]


def keys(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Paths of all keys, those of tables in lists of tables too."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield (*path, key)
            yield from keys(item, (*path, key))
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from keys(item, (*path, k))


def spoilt(tables: Tables, free: tuple[str, ...] = ()) -> Iterator[tuple[str, str, Tables]]:
    """(what was done, key, tables with that): each key misspelt, of another type, not finite, and left out.

    free : names of tables in which any key may stand
    """
    for path in keys(tables):
        *_, name = path
        value = at(tables, path)
        changes: dict[str, Any] = {"of another type": 7.5 if isinstance(value, str) else "text"}
        if isinstance(value, float):
            changes |= {"not finite": math.nan}
        if isinstance(value, list) and value and not isinstance(value[0], dict):
            changes |= {"too long": value * 30} if isinstance(value[0], float) else {}
            changes |= {} if isinstance(value[0], str) else {"of texts": ["text"] * len(value)}
        inside = any(part in free for part in path[:-1])
        for what, wrong in changes.items() if not inside else ():
            yield what, str(name), with_key(tables, path, str(name), wrong)
        if not inside:
            yield "misspelt", str(name), with_key(tables, path, f"{name}_x", value)
        yield "left out", str(name), with_key(tables, path, None, None)


def check(read: Callable[[Path], object], path: Path, free: tuple[str, ...] = ()) -> None:
    """Of a TOML file: a wrong key is refused in one line that names it; one left out may be read."""
    for what, key, tables in spoilt(tomllib.loads(path.read_text()), free):
        path.write_text(tomlkit.dumps(tables))
        message = message_of(read, path)
        assert what == "left out" or message is not None, (what, key)
        if message is not None:
            assert message.startswith(f"{path}: "), message
            assert key in message, (what, key, message)
            assert "\n" not in message


def message_of(read: Callable[[Path], object], path: Path) -> str | None:
    """Why a file is refused; None: it is read."""
    try:
        read(path)
    except InputError as error:
        return str(error)
    return None


def at(tables: Any, path: tuple[str | int, ...]) -> Any:
    for part in path:
        tables = tables[part]
    return tables


def with_key(tables: Tables, path: tuple[str | int, ...], name: str | None, value: Any) -> Tables:
    """A copy in which the key has this name and value; None: in which it is not."""
    changed = copy.deepcopy(tables)
    place = at(changed, path[:-1])
    del place[path[-1]]
    if name is not None:
        place[name] = value
    return changed
