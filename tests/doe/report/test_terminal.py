"""Numbers and tables for a terminal: nothing is lost, nothing is taken for markup."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from rich.table import Table
from rich.text import Text

from doe.report.terminal import facts, in_a_sentence, table, unit_or_dash


def shown(renderable: Table, width: int = 80) -> str:
    console = Console(width=width, file=io.StringIO())
    with console.capture() as capture:
        console.print(renderable)
    return capture.get()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.10953, "0.110"), (1.4236, "1.42"), (34.04, "34.0"), (1829.0, "1829"), (0.0, "0"), (None, "-")],
)
def test_figures_in_sentences_have_three_digits(value: float | None, text: str) -> None:
    assert in_a_sentence(value) == text


def test_brackets_are_no_markup() -> None:
    text = shown(table(["x [mm]", "effect"], [["1", "ripple[k=4]"], ["2", "[red]"]]))
    assert all(part in text for part in ("x [mm]", "ripple[k=4]", "[red]"))
    assert "[mm]" in shown(facts([("length [mm]", "260 [mm]")]))


def test_long_tables_are_cut_and_say_so() -> None:
    rows = [[str(k)] for k in range(5)]
    cut = table(["run"], rows, most=3, caption="first 3 of 5")
    assert (cut.row_count, cut.caption) == (3, "first 3 of 5")
    whole = table(["run"], rows, most=5, caption="first 5 of 5")
    assert (whole.row_count, whole.caption) == (5, None)


def test_columns_are_aligned_as_asked_and_long_words_folded() -> None:
    found = table(["name", "value"], [["length", "1"]], left=("name",), no_wrap=("value",))
    assert [column.justify for column in found.columns] == ["left", "right"]
    assert [column.no_wrap for column in found.columns] == [False, True]
    narrow = shown(table(["name"], [["abcdefghijklmnopqrstuvwxyz"]]), width=12)
    assert "".join(character for character in narrow if character.islower()) == "name" + "abcdefghijklmnopqrstuvwxyz"


def test_styled_cells_keep_their_style() -> None:
    found = table(["outcome"], [[Text("met", "green")]])
    (cell,) = found.columns[0].cells
    assert isinstance(cell, Text)
    assert cell.style == "green"


def test_a_number_without_a_unit_has_a_dash_for_one() -> None:
    assert [unit_or_dash(unit) for unit in ("mm", "1", "1/K")] == ["mm", "–", "1/K"]
