"""What people and programs get wrong in texts: strategies that spoil a valid file, and words that are no numbers."""

from __future__ import annotations

from hypothesis import strategies as st

WORDS = (
    *("0", "-0.0", "-1", "3.7", "1e-320", "1e-9", "1e6", "1e308", "1e309", "-1e200", "nan", "inf", "-inf"),
    *("99999999999999999999", "²", "١", "1_000", "0x10", "1,5", "1;5", "true", "null", "", " ", "''", '"', '"x', "[]"),
    *("{}", "[[1.0]]", "é", "\x1b[31m", "\x00", "\ufeff", "\u202e", "a" * 100_000, "../../etc/passwd", "/dev/full"),
    *("<!DOCTYPE r>", "&x;", "]]>", "q1_deg", "--force", "-", "\\", "1980-01-01", "0.1.2", "+5", "5.", ".5", "١٢"),
)
words = st.sampled_from(WORDS)


@st.composite
def spoilt(draw: st.DrawFn, text: str, changes: int = 2) -> str:
    """`text` with a few changes: a word replaced, a line gone or twice, a character put in, the end cut off."""
    for _ in range(draw(st.integers(1, changes))):
        text = draw(st.sampled_from(CHANGES))(draw, text)
    return text


def one_in(draw: st.DrawFn, number: int) -> bool:
    """True in one of so many draws."""
    return draw(st.sampled_from(range(number))) == number - 1


@st.composite
def mostly_valid(draw: st.DrawFn, text: str) -> str:
    """The text itself, or spoilt in one of seven."""
    return draw(spoilt(text)) if one_in(draw, 7) else text


def replaced(draw: st.DrawFn, text: str) -> str:
    """One number or name is another word."""
    import re

    found = list(re.finditer(r"[\w.+-]+", text))
    if not found:
        return text
    one = found[draw(st.integers(0, len(found) - 1))]
    return text[: one.start()] + draw(words) + text[one.end() :]


def line_gone(draw: st.DrawFn, text: str) -> str:
    """Without one of the lines."""
    lines = text.splitlines(keepends=True)
    gone = draw(st.integers(0, len(lines))) if lines else 0
    return "".join(lines[:gone] + lines[gone + 1 :])


def line_twice(draw: st.DrawFn, text: str) -> str:
    """One of the lines twice."""
    lines = text.splitlines(keepends=True)
    again = draw(st.integers(0, len(lines) - 1)) if lines else 0
    return "".join(lines[: again + 1] + lines[again:])


def put_in(draw: st.DrawFn, text: str) -> str:
    """A word or a character somewhere."""
    at = draw(st.integers(0, len(text)))
    return text[:at] + draw(words | st.characters(codec="utf-8")) + text[at:]


def cut_off(draw: st.DrawFn, text: str) -> str:
    """The beginning only."""
    return text[: draw(st.integers(0, len(text)))]


def swapped(draw: st.DrawFn, text: str) -> str:
    """One character for another, everywhere."""
    old, new = draw(st.sampled_from([(",", ";"), (",", "\t"), (".", ","), ("\n", "\r\n"), ("\n", "\r"), ("_", "-")]))
    return text.replace(old, new)


CHANGES = (replaced, replaced, replaced, line_gone, line_twice, put_in, cut_off, swapped)
