"""A document in its renderings: nothing is lost, nothing is taken for markup, wherever it is shown."""

import math
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure

from identification.document import (
    Action,
    Document,
    Pictures,
    Section,
    Sheet,
    as_sentence,
    estimate_text,
    html,
    in_a_sentence,
    number,
    of_joints,
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
        Sheet.facts({"length [mm]": "260 [mm]", "left out": None, "nothing": ""}),
        Section("Open", [Sheet(["effect", "value [mm]"], [["ripple[k=4]", "1.5"], [NASTY, "-22.75"]]), "After it."]),
        Section("Closed", ["Hidden at first.", Sheet(["a"], [["b"]], "In a fold")], folded=True),
        Section("Seen", [Pictures(figures)]),
        Section("Stepped through", [Pictures(lambda: ["Step."])]),
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
        self.open += [tag] if tag not in ("meta", "br", "img") else []

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts += [data.strip()] if data.strip() else []


def test_a_notebook_shows_all_of_it_escaped() -> None:
    parser = Texts()
    parser.feed(DOCUMENT._repr_html_())
    assert parser.open == []
    said = "\n".join(parser.texts)
    for part in (f"A paragraph {NASTY}, chi2 1 +- 2.", "260 [mm]", "ripple[k=4]", "Hidden at first.", "In a fold"):
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


def test_long_tables_are_cut_and_say_so() -> None:
    rows = [[str(k)] for k in range(300)]
    cut, whole = Sheet(["run"], rows, most=3), Sheet(["run"], rows)
    text = str(Document(parts=[cut]))
    assert "first 3 of 300; --json has all" in text
    assert [line.strip() for line in text.splitlines() if line.strip().isdigit()] == ["0", "1", "2"]
    assert "299" in str(Document(parts=[whole]))
    assert html(cut).count("<tr>") == 1 + 200
    assert "first 200 of 300" in html(cut)
    assert html(whole).count("<tr>") == 1 + 300
    assert "first" not in str(Document(parts=[Sheet(["run"], rows[:3], most=3)]))


# -- HTML --------------------------------------------------------------------------------------------------------------
def test_cells_come_out_as_they_went_in_and_long_ones_may_be_broken() -> None:
    headings, row = ("a<b", "x & y", "z"), ["</td><script>", "", 'q "7"' * 9]
    parser = Texts()
    parser.feed(html(Sheet(headings, [row, ["", "x" * 24, "x" * 25]])))
    assert parser.texts == [*headings, row[0], row[2], "x" * 24, "x" * 25]
    assert html(Sheet(["h"], [["x" * 25]])).count('class="text"') == 2  # with its heading
    assert 'class="text"' not in html(Sheet(["h"], [["x" * 24]]))
    assert html(Document(verdict=["1 < 2", "two"])) == "<p><b>1 &lt; 2</b></p>\n<p><b>two</b></p>\n"
    facts = html(Sheet.facts({"a<b": "1 & 2"}))
    assert (facts.count("<tr>"), ">a&lt;b</td>" in facts, ">1 &amp; 2</td>" in facts) == (1, True, True)


# -- numbers as people read them ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("shown", "text"),
    [
        *((number(value), "-") for value in (None, math.nan, math.inf)),
        *((number(1.23456), "1.2346"), (number(-1e-9), "0.0000")),
        # three significant digits of the standard deviation, in mm and deg at most five decimals
        *((estimate_text(1.23456789, std, "1/K"), text) for std, text in ((0.0123, "1.2346"), (12.3, "1.2"))),
        *((estimate_text(None, 1.0, "mm"), "-"), (estimate_text(2e7, 1.0, "mm"), "2e+07")),
        *((estimate_text(0.5, None, "mm"), "0.5000"), (estimate_text(-1e-5, 0.1, "mm"), "0.000")),
        *((estimate_text(0.0, None, "mm"), "0"), (estimate_text(1.23456789, 1e-6, "mm"), "1.23457")),
        (estimate_text(1.23456789e-7, 1e-9, "1"), "1.23e-07"),
        *((in_a_sentence(0.10953), "0.110"), (in_a_sentence(1.4236), "1.42"), (in_a_sentence(34.04), "34.0")),
        *((in_a_sentence(1829.0), "1829"), (in_a_sentence(0.0), "0"), (in_a_sentence(None), "-")),
        *((unit_or_dash("mm"), "mm"), (unit_or_dash("1"), "–"), (as_sentence("two [mm]"), "Two [mm].")),
        *((of_joints([2]), "joint 2"), (of_joints([1, 3]), "joints 1 and 3"), (of_joints([1, 2, 3]), "joints 1 to 3")),
    ],
)
def test_numbers_and_words_as_people_read_them(shown: str, text: str) -> None:
    assert shown == text
