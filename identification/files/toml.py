"""Changing a user's TOML file without spoiling it: comments and order stay as they are."""

from __future__ import annotations

import tomllib
from typing import Any

import tomlkit
from tomlkit.items import AoT, Comment, Item, Table, Whitespace

from identification.errors import JobError

Plain = dict[str, Any]


def append_tables(text: str, key: str, entries: list[Plain]) -> str:
    """`text` with `entries` added to the array of tables `[[key]]`, which is made if it is not there."""
    before = tomllib.loads(text)
    document = tomlkit.parse(_ended(text))
    existing = document.get(key)
    if isinstance(existing, AoT):
        trivia = _pop_trailing(existing[-1])
        for entry in entries:
            _extend(existing[-1], [Whitespace("\n")])
            existing.append(_table(entry))
        _extend(existing[-1], trivia)
    elif existing is not None:  # key = [{...}], in one line
        existing.extend(entries)
    else:
        document[key] = AoT([_table(entry) for entry in entries])
    return _checked(document, {**before, key: [*before.get(key, ()), *entries]})


def replace_table(text: str, key: str, entry: Plain) -> str:
    """`text` with the table `[key]` replaced where it stands, or added at the end."""
    before = tomllib.loads(text)
    document = tomlkit.parse(_ended(text))
    old = document.get(key)
    if type(old) is Table:
        _refill(old, entry)
    else:  # not there, in one line, or in several places
        if old is not None:
            document.remove(key)
        document[key] = _table(entry)
    return _checked(document, {**before, key: entry})


def _ended(text: str) -> str:
    return text if text.endswith("\n") else text + "\n"


def _table(entry: Plain) -> Table:
    table = tomlkit.table()
    _fill(table, entry)
    return table


def _fill(table: Table, entry: Plain) -> None:
    """Sets the keys: plain values first, because what follows a sub-table's header belongs to the sub-table."""
    for key, value in sorted(entry.items(), key=lambda item: isinstance(item[1], dict)):
        if isinstance(value, dict):
            table[key] = _table(value)
        elif isinstance(value, list) and value and isinstance(value[0], list):
            matrix = tomlkit.array()
            matrix.extend(value)
            table[key] = matrix.multiline(True)  # a row per line
        else:
            table[key] = value


def _refill(table: Table, entry: Plain) -> None:
    trivia = _pop_trailing(table)
    for key in [key for key in table if key not in entry or isinstance(table[key], dict)]:
        table.remove(key)
    _fill(table, entry)
    _extend(table, trivia)


def _last_table(table: Table) -> Table:
    """The table that the text just before the next header belongs to."""
    last = table.value.body[-1][1] if table.value.body else None
    return _last_table(last) if type(last) is Table else table


def _pop_trailing(table: Table) -> list[Item]:
    """Remove and return trailing blank lines and comments: they belong to the table that follows, not to this one."""
    body = _last_table(table).value.body
    trivia: list[Item] = []
    while body and body[-1][0] is None and isinstance(body[-1][1], Comment | Whitespace):
        trivia.insert(0, body.pop()[1])
    return trivia


def _extend(table: Table, trivia: list[Item]) -> None:
    body = _last_table(table).value.body
    body.extend((None, item) for item in trivia)


def _checked(document: tomlkit.TOMLDocument, wanted: Plain) -> str:
    """The text, after a second parser has read exactly the intended tables from it: a user's file is never damaged."""
    text = tomlkit.dumps(document)
    if tomllib.loads(text) != wanted:
        message = "write its tables as [table] and [[table]], each in one place"
        raise JobError(f"the TOML file's layout is too unusual to be extended: {message}")
    return text
