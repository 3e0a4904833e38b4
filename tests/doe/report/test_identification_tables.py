"""The values that the measurements determine, in short, from rows made by hand."""

from __future__ import annotations

import io

from rich.console import Console
from rich.text import Text

from doe.report.identification_tables import dh_tables, in_short
from identification.estimation.corrected_values import CorrectedValue


def row(name: str, nominal: float | None, value: float, std: float, prior: float | None, unit: str) -> CorrectedValue:
    return CorrectedValue(name, None, nominal, value, std, value - 2 * std, value + 2 * std, unit, "", prior)


ROWS = (
    row("zero of joint 2", 0.0, -0.08, 0.05, 0.5, "deg"),
    row("zero of joint 5", 0.0, 0.04, 0.35, 0.5, "deg"),
    row("zero of joint 6", 0.0, 0.0, 0.5, 0.5, "deg"),
    row("joint 3 x", 610.0, 609.5, 0.04, 1.0, "mm"),
    row("joint 3 y", -130.0, -129.8, 0.87, 1.0, "mm"),
    row("joint 3 z", 0.0, 0.06, 0.97, 1.0, "mm"),
    row("joint 4 yaw", 0.0, 1e-5, 2e-5, 1e-3, "deg"),  # of second order
    row("base x", None, 2574.14, 0.05, None, "mm"),
    row("base rz", None, 159.65, 0.3, None, "deg"),
)


def test_well_determined_values_are_shown_and_the_others_said() -> None:
    console = Console(width=80, file=io.StringIO())
    for part in in_short(ROWS, minimal=True):
        console.print(part)
    text = console.file.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    table, _, rest = text.partition("Weakly determined")
    assert "Well determined: 2 of 7 corrected values" in table
    assert [name in table for name in ("zero of joint 2", "joint 3 x", "joint 3 y", "zero of joint 5", "base")] == [
        True,
        True,
        False,
        False,
        False,
    ]
    said = " ".join(rest.split())
    assert "zero of joint 5, 6; joint 3 y, z." in said
    assert "As drawn to three decimals: 1 more." in said
    assert "base [mm]: x 2574.140 +- 0.050, rz 159.650 +- 0.300 deg" in said
    assert "--parameters minimal gives a complete set" in said
    assert not any("minimal" in str(part) for part in in_short(ROWS, minimal=False))


def test_the_note_on_beta_stands_beside_a_beta_only() -> None:
    plain, hayati = row("row 1 a", 0.0, 0.1, 0.01, None, "mm"), row("row 2 beta", 0.0, 0.1, 0.01, None, "deg")
    tables = (dh_tables(rows, []) for rows in ([plain], [plain, hayati]))
    noted = [any("Hayati" in part.plain for part in shown if isinstance(part, Text)) for shown in tables]
    assert noted == [False, True]
