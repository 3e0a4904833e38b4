"""Tables in HTML: what a reader's parser makes of them is what was given, whatever the text."""

from __future__ import annotations

from html.parser import HTMLParser

from identification.document import html_facts, html_lines, html_table, in_symbols


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


def test_facts_stand_beside_their_names_and_a_fold_has_a_title() -> None:
    text = html_facts([("a<b", "1 & 2")])
    assert text.count("<tr>") == 1
    assert ">a&lt;b</th>" in text
    assert ">1 &amp; 2</td>" in text
