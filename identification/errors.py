"""The errors that reach a user: one line each, saying where, what was found and what is allowed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from identification.spelling import NOTHING, close_names

LONGEST_WORD, LONGEST_LINE = 400, 2000  # characters of a message; what is in the middle of a longer one is left out


class ArmcalError(Exception):
    """Base of every error this project raises on purpose."""

    exit_code = 1


class InputError(ArmcalError):
    """Bad input or usage: the message names the place, what was found and what is allowed."""

    exit_code = 2


class JobError(ArmcalError):
    """The input was fine, the job itself could not be done (solver failed, parameters not identifiable)."""

    exit_code = 1


def in_one_line(text: str) -> str:
    """A message as one line of printable characters, whatever names and cells of files it repeats.

    Control characters are written as in Python; of a very long word or line the middle is left out.

    >>> in_one_line("arm\\nfile.toml: no such file")
    'arm\\\\nfile.toml: no such file'
    """
    words = re.sub(rf"\S{{{LONGEST_WORD + 1},}}", lambda word: _shortened(word.group(), LONGEST_WORD), printable(text))
    return _shortened(words, LONGEST_LINE)


def printable(text: str) -> str:
    """`text` with control characters, line breaks, and what no output can encode written as in Python."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def _shortened(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most * 2 // 3]} .. {text[-most // 4 :]}"


def nearest(word: str, allowed: Iterable[str], meant: Mapping[str, str] = NOTHING) -> str:
    """The end of a sentence about an unknown name: which valid ones may be meant, and all that are valid.

    meant : another word -> the name that says the same

    >>> nearest("lenghts_mm", ["links_mm", "lengths_mm"])
    "did you mean 'lengths_mm'? allowed: lengths_mm, links_mm"
    """
    options = sorted(set(allowed))
    return f"{suggestion(close_names(word, options, meant))}allowed: {', '.join(options)}"


def suggestion(names: Sequence[str]) -> str:
    """`did you mean 'a' or 'b'? `, empty without names.

    >>> suggestion(["a", "b", "c"])
    "did you mean 'a', 'b' or 'c'? "
    """
    *first, last = map(repr, names) if names else [""]
    return f"did you mean {' or '.join(filter(None, [', '.join(first), last]))}? " if last else ""
