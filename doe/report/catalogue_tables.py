"""The library of effects as tables for a terminal (rich)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.text import Text

from doe.report.terminal import facts, table, unit_or_dash
from identification.effects.catalogue import GRAVITY, Entry

TITLES = {
    "looked for": "Effects that diagnose looks for",
    "table": "Found by diagnose where no name fits",
    "scatter": "Effects on the scatter: simulated, screened for, not estimated",
    "alias": "Cannot be distinguished from the geometry: listed, never named",
    "on request": "Estimated where the arm file asks for it",
    "commands": "From columns of commands beside the angles read",
    "sessions": "Set by armcal where there are several sessions",
}
HEADINGS = ("name", "what is wrong", "needs")


def library_tables(entries: Sequence[Entry]) -> list[Any]:
    """Name, cause and needs of every effect, by kind."""
    shown: list[Any] = []
    for kind, title in TITLES.items():
        rows = [[_name(e), e.summary, ", ".join(e.needs)] for e in entries if e.kind == kind]
        if rows:
            shown.append(table(HEADINGS, rows, title, left=HEADINGS))
    return [*shown, "A name with :j belongs to joint j. More about one of them: armcal effects backlash"]


def _name(entry: Entry) -> str:
    only = f" ({entry.arms[0]})" if len(entry.arms) == 1 else ""
    return entry.name + (":j" if entry.place.startswith("each") else "") + only


def gravity_tables(needed: Sequence[str]) -> list[Any]:
    """What is no effect but what effects follow from;  needed : names of these"""
    said = (
        "[gravity] is no effect but a block of the arm file: how gravity pulls, and what the links and the payload "
        f"weigh. The torques that follow from it are needed by {', '.join(needed)}. To paste, with your masses:"
    )
    return [Text(f"{said}\n\n{GRAVITY}\n")]


def entry_tables(entry: Entry) -> list[Any]:
    """Everything about one effect."""
    lines = [
        ("cause", entry.summary),
        ("model", entry.formula),
        ("belongs to", entry.place),
        ("arms", " and ".join(entry.arms)),
        ("needs", "; ".join(entry.supply) or "nothing besides postures and positions"),
    ]
    if entry.alias is not None:
        lines.append(("looks like", entry.alias))
    shown: list[Any] = [Text(entry.name, style="bold"), facts(lines)]
    if entry.parameters:
        rows = [[p.toml_key, unit_or_dash(p.file_unit), _size(p.typical, p.to_file)] for p in entry.parameters]
        title = "Parameters" if entry.place != "one joint or all" else "Parameters (of an arm of three joints)"
        shown.append(table(("key", "unit", "typical size"), rows, title, left=("key", "unit")))
    if entry.settings:
        rows = [[name, allowed] for name, allowed in entry.settings.items()]
        shown.append(table(("key", "allowed"), rows, "Settings: chosen, not estimated", left=("key", "allowed")))
    intro = "In an arm file, with its parameters left out so that identify estimates them:"
    return [*shown, entry.example if entry.kind == "table" else Text(f"{intro}\n\n{entry.example}\n")]


def _size(typical: float | None, factor: float) -> str:
    return "-" if typical is None else f"{typical * factor:.2g}"
