"""What a plan could show of missing effects, before anything is measured: for the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table
from rich.text import Text

from identification.gap.preflight import Preflight

MOST_PAIRS = 8


def preflight_tables(sees: Preflight) -> list[Any]:
    """Share, smallest size and look-alikes of every effect."""
    table = Table(title="What this plan can show of missing effects", title_justify="left")
    table.add_column("effect")
    for heading in ("visible share", "smallest size found (90 %)", "looks like"):
        table.add_column(Text(heading), justify="right")
    pairs = sees.pairs()
    for name, share in zip(sees.names, sees.shares, strict=True):
        alike = [f"{other} ({likeness:.2f})" for one, other, likeness in pairs if one == name]
        more = f" and {len(alike) - 2} more" if len(alike) > 2 else ""
        size = sees.detectable[name]
        table.add_row(name, f"{share:.2f}", str(size), Text(", ".join(alike[:2]) + more))
    skipped = [Text(f"not judged: {key}: {why}") for key, why in sees.skipped.items()]
    never = [Text(f"never visible: {key}: the same as {why}") for key, why in sees.aliases.items()]
    return [table, Text(f"{sees.freedom} degrees of freedom to spare"), *skipped, *never]
