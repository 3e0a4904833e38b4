"""The library of effects as `armcal effects` shows it."""

from __future__ import annotations

from collections.abc import Sequence

from identification.document import Document, Facts, Part, Sheet, unit_or_dash
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


def library_document(entries: Sequence[Entry]) -> Document:
    """Name, cause and needs of every effect, by kind."""
    parts: list[Part] = []
    for kind, title in TITLES.items():
        rows = [
            [
                e.name + ":j" * e.place.startswith("each") + (f" ({e.arms[0]})" if len(e.arms) == 1 else ""),
                e.summary,
                ", ".join(e.needs),
            ]
            for e in entries
            if e.kind == kind
        ]
        parts.append(Sheet(("name", "what is wrong", "needs"), rows, title))
    advice = "A name with :j belongs to joint j. More about one of them: armcal effects backlash"
    return Document("Effects", [], [*parts, advice])


def gravity_document(needed: Sequence[str]) -> Document:
    """What is no effect but what effects follow from;  needed : names of these"""
    needs = (
        "[gravity] is no effect but a block of the arm file: how gravity pulls, and what the links and the payload "
        f"weigh. The torques that follow from it are needed by {', '.join(needed)}. To paste, with your masses:"
    )
    return Document("gravity", [], [f"{needs}\n\n{GRAVITY}\n"])


def entry_document(entry: Entry) -> Document:
    """Everything about one effect."""
    facts = [
        ("cause", entry.summary),
        ("model", entry.formula),
        ("belongs to", entry.place),
        ("arms", " and ".join(entry.arms)),
        ("needs", "; ".join(entry.supply) or "nothing besides postures and positions"),
        ("looks like", entry.alias),
    ]
    rows = [
        [p.toml_key, unit_or_dash(p.file_unit), "-" if p.typical is None else f"{p.typical * p.to_file:.2g}"]
        for p in entry.parameters
    ]
    title = "Parameters" if entry.place != "one joint or all" else "Parameters (of an arm of three joints)"
    settings = Sheet(("key", "allowed"), [*entry.settings.items()], "Settings: chosen, not estimated")
    intro = "In an arm file, with its parameters left out so that identify estimates them:"
    example = entry.example if entry.kind == "table" else f"{intro}\n\n{entry.example}\n"
    parts: list[Part] = [Facts(facts), Sheet(("key", "unit", "typical size"), rows, title), settings, example]
    return Document(entry.name, [entry.name], parts)
