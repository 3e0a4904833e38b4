"""A document in its renderings: nothing is lost, nothing is taken for markup, wherever it is shown."""

from __future__ import annotations

import math
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure

from identification.document import (
    Action,
    Document,
    Facts,
    Pictures,
    PlanSteps,
    Section,
    Sheet,
    as_sentence,
    as_text,
    estimate_text,
    html,
    html_facts,
    html_lines,
    html_table,
    in_a_sentence,
    in_symbols,
    number,
    to_significant_digits,
    unit_or_dash,
)

NASTY = "[red]<b>x & y</b>[/red]"
DRAWN: list[str] = []


def figures() -> list[Figure | str]:
    DRAWN.append("drawn")
    return ["How it is read.", Figure(figsize=(1.0, 1.0))]


DOCUMENT = Document(
    "Report",
    ["The verdict.", "", f"Then {NASTY}."],
    [
        f"A paragraph {NASTY}, chi2 1 +- 2.",
        Facts([("length [mm]", "260 [mm]"), ("left out", None), ("nothing", "")]),
        Section("Open", [Sheet(["effect", "value [mm]"], [["ripple[k=4]", "1.5"], [NASTY, "-22.75"]]), "After it."]),
        Section("Closed", ["Hidden at first.", Sheet(["a"], [["b"]], "In a fold")], folded=True),
        Section("Seen", [Pictures(figures)]),
        Section("Stepped through", [PlanSteps({"file": "plan.csv"}, "Step.")]),
        Sheet(["never"], []),
    ],
    [Action("Go on:", "armcal check <b>"), Action("Or stop.")],
    ["Careful."],
)


class Texts(HTMLParser):
    """What a reader's parser makes of it: texts in order, and elements that were not closed."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open += [tag] if tag != "img" else []

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts += [data.strip()] if data.strip() else []


def test_a_notebook_shows_all_of_it_escaped() -> None:
    parser = Texts()
    parser.feed(DOCUMENT._repr_html_())
    assert parser.open == []
    said = "\n".join(parser.texts)
    for part in (f"A paragraph {NASTY}, χ² 1 ± 2.", "260 [mm]", "ripple[k=4]", "Hidden at first.", "In a fold"):
        assert part in said
    for part in ("Careful.", "The verdict.", "How it is read.", "Step.", "Go on: armcal check <b>"):
        assert part in parser.texts
    assert "left out" not in said
    assert "never" not in said
    assert DOCUMENT._repr_html_().count("data:image/png;base64,") == 1


def test_a_terminal_shows_what_is_open_without_drawing_a_picture() -> None:
    DRAWN.clear()
    text = str(DOCUMENT)
    lines = [line.strip() for line in text.splitlines()]
    assert lines[:3] == ["Careful.", "The verdict.", f"Then {NASTY}."]
    assert lines[-3:] == ["next: Go on:", "armcal check <b>", "next: Or stop."]
    assert all(part in text for part in (NASTY, "260 [mm]", "ripple[k=4]", "Open", "After it."))
    assert not any(part in text for part in ("Closed", "In a fold", "Seen", "How it is", "Stepped", "never", "nothing"))
    assert DRAWN == []
    longer = str(DOCUMENT.plus("One more."))
    assert longer.index("After it.") < longer.index("One more.") < longer.index("next:")


def test_text_has_no_colors_wherever_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does a notebook print it twice: rich would, when it finds itself in one."""
    plain = str(DOCUMENT)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert str(DOCUMENT) == plain
    assert "\x1b" not in plain


def test_figures_end_at_the_right_and_words_begin_at_the_left() -> None:
    rows = [["one", "1.5", "yes", "< 1e-6"], ["three", "-", "", "-22.750"], ["five", "12", "no", "5 *"]]
    table = Sheet(["name", "value", "holds", "miss"], rows)
    assert table.figures() == [False, True, False, True]
    lines = as_text(table).splitlines()[-4:]
    assert [line.index("1.5") + 3 for line in lines if "1.5" in line] == [
        line.index("12") + 2 for line in lines if "12" in line
    ]


@pytest.mark.parametrize("width", [30, 80])
def test_no_figure_is_cut_off_where_there_is_no_room(width: int) -> None:
    row = [f"-{k}234.5678" for k in range(1, 8)]
    text = as_text(Sheet([*"abcdefg"], [row]), width)
    assert max(map(len, text.splitlines())) <= width
    digits = [character for character in "".join(text.split()) if character.isdigit()]
    assert sorted(digits) == sorted(character for cell in row for character in cell if character.isdigit())
    if width == 80:
        assert all(cell in text for cell in row)


def test_long_tables_are_cut_and_say_so() -> None:
    rows = [[str(k)] for k in range(300)]
    cut, whole = Sheet(["run"], rows, most=3), Sheet(["run"], rows)
    assert "first 3 of 300; --out writes all" in as_text(cut)
    assert [line.strip() for line in as_text(cut).splitlines() if line.strip().isdigit()] == ["0", "1", "2"]
    assert "299" in as_text(whole)
    assert html(cut).count("<tr>") == 1 + 200
    assert "first 200 of 300" in html(cut)
    assert html(whole).count("<tr>") == 1 + 300
    assert "first" not in as_text(Sheet(["run"], rows[:3], most=3))


# -- tables in HTML ----------------------------------------------------------------------------------------------------
class Cells(HTMLParser):
    """Rows of texts."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1] and data.strip():
            self.rows[-1][-1] += data


def test_cells_come_out_as_they_went_in() -> None:
    headings, rows = ("a<b", "x & y"), [["</td><script>", "1"], ["", 'q "7"' * 9]]
    parser = Cells()
    parser.feed(html_table(headings, rows))
    assert parser.rows == [list(headings), *rows]


def test_long_cells_may_be_broken() -> None:
    assert html_table(["h"], [["x" * 25]]).count('class="text"') == 2  # with its heading
    assert 'class="text"' not in html_table(["h"], [["x" * 24]])


def test_lines_are_paragraphs() -> None:
    assert html_lines(["1 < 2", "two"], strong=True) == "<p><b>1 &lt; 2</b></p>\n<p><b>two</b></p>\n"


def test_rows_that_are_too_wide_for_a_phone_have_their_headings_in_each_cell() -> None:
    """Six columns of 8 characters and their spaces are 60, three are 30; two columns always have room."""
    wide, narrow = ["a" * 8] * 6, ["a" * 8] * 3
    assert html_table(wide, [wide]).count('data-heading="aaaaaaaa"') == 6
    assert html_table(wide, [wide]).startswith('<table class="wide">')
    assert "data-heading" not in html_table(narrow, [narrow])
    assert "data-heading" not in html_table(["a", "b"], [["x" * 90, "y" * 20]])
    assert html_table(["<i>", "b", "c"], [["x" * 30, "1", "2"] * 1]).count('data-heading="&lt;i&gt;"') == 0
    assert html_table(["<i>", "b", "c"], [["x" * 40, "1", "2"]]).count('data-heading="&lt;i&gt;"') == 1


def test_symbols_are_those_of_books_and_keys_stay_as_they_are() -> None:
    said = in_symbols("sigma 0.1 mm, chi2 20.5, RMS 2 -> 1 mm, 1 +- 2; sigma_mm, chi2s")
    assert said == "σ 0.1 mm, χ² 20.5, RMS 2 → 1 mm, 1 ± 2; sigma_mm, chi2s"


def test_facts_stand_beside_their_names() -> None:
    text = html_facts([("a<b", "1 & 2")])
    assert text.count("<tr>") == 1
    assert ">a&lt;b</th>" in text
    assert ">1 &amp; 2</td>" in text


# -- numbers as people read them ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("value", "text"), [(None, "-"), (math.nan, "-"), (math.inf, "-"), (1.23456, "1.2346"), (-1e-9, "0.0000")]
)
def test_number(value: float | None, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.23456789, 0.0123, "1.2346"),
        (1.23456789, 12.3, "1.2"),
        (None, 1.0, "-"),
        (2e7, 1.0, "2e+07"),
        (0.5, None, "0.5"),
        (-1e-5, 0.1, "0.000"),
    ],
)
def test_significant_digits_are_three_of_the_standard_deviation(
    value: float | None, std: float | None, text: str
) -> None:
    assert to_significant_digits(value, std) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.10953, "0.110"), (1.4236, "1.42"), (34.04, "34.0"), (1829.0, "1829"), (0.0, "0"), (None, "-")],
)
def test_figures_in_sentences_have_three_digits(value: float | None, text: str) -> None:
    assert in_a_sentence(value) == text


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [(0.0, None, "mm", "0"), (1.23456789, 1e-6, "mm", "1.23457"), (1.23456789e-7, 1e-9, "1", "1.23e-07")],
)
def test_estimates_in_mm_and_deg_have_at_most_five_decimals(value: float, std: float, unit: str, text: str) -> None:
    assert estimate_text(value, std, unit) == text


def test_a_number_without_a_unit_has_a_dash_for_one_and_a_clause_becomes_a_sentence() -> None:
    assert [unit_or_dash(unit) for unit in ("mm", "1", "1/K")] == ["mm", "–", "1/K"]
    assert [as_sentence(clause) for clause in ("two [mm]", "Done.", "")] == ["Two [mm].", "Done.", "."]
