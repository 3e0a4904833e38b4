"""The errors that reach a user: one line each, saying where, what was found and what is allowed.

Which of the names that are allowed somebody may have meant: misspelt or shortened.
"""

import re
from collections.abc import Collection, Generator, Iterable, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Self


class ArmcalError(Exception):
    """Base of every error this project raises on purpose."""

    exit_code = 1


class InputError(ArmcalError):
    """Bad input or usage: the message names the place, what was found and what is allowed."""

    exit_code = 2

    @classmethod
    def unknown(cls, what: str, name: str, allowed: Iterable[str]) -> Self:
        """Of a name that is not allowed: `solver: unknown name 'ipot', did you mean 'ipopt'? allowed: ...`;  what : the
        place, and what the name is there"""
        return cls(f"{what} {name!r}, {nearest(name, allowed)}")

    @classmethod
    def check_names(cls, what: str, names: Iterable[str], allowed: Collection[str]) -> None:
        """Raises the error of `unknown` for the first of the names that is not allowed."""
        for name in names:
            if name not in allowed:
                raise cls.unknown(what, name, allowed)

    @classmethod
    @contextmanager
    def at(cls, place: object, *others: str) -> Generator[None, None, None]:
        """What is raised within is said of this place, unless it begins with it, or with one of others."""
        try:
            yield
        except cls as error:
            raise cls(str(error) if str(error).startswith((f"{place}: ", *others)) else f"{place}: {error}") from None


class JobError(ArmcalError):
    """The input was fine, the job itself could not be done (solver failed, parameters not identifiable)."""


def require(condition: object, message: str) -> None:
    """Raises `InputError` where the condition does not hold, or is empty."""
    if not condition:
        raise InputError(message)


def printable(text: str) -> str:
    """`text` with control characters, line breaks, and what no output can encode written as in Python."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def close_names(word: str, allowed: Iterable[str]) -> list[str]:
    """Up to three names: those that are most alike (`difflib`), else those that it begins with or that have it in them.

    >>> close_names("desing", ["design", "score"])
    ['design']
    >>> close_names("offset", ["base_offset", "tool_offset", "backlash"])
    ['base_offset', 'tool_offset']
    """
    options, low = sorted(set(allowed)), word.lower()[:60]  # longer than any name
    spelt = {name.lower(): name for name in options}
    near = [spelt[other] for other in get_close_matches(low, spelt, n=4, cutoff=0.66 if len(low) == 3 else 0.75)]
    bare = {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in options}
    part = re.sub(r"[^a-z0-9]", "", low)
    near = near or [n for n in options if (part and part.startswith(bare[n])) or (len(part) > 2 and part in bare[n])]
    return list(dict.fromkeys(near)) if len(near) <= 3 else []  # more help nobody


def nearest(word: str, allowed: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: which valid ones may be meant, and all that are valid.

    >>> nearest("lenghts_mm", ["links_mm", "lengths_mm"])
    "did you mean 'lengths_mm'? allowed: lengths_mm, links_mm"
    """
    options = sorted(set(allowed))
    return f"{suggestion(close_names(word, options))}allowed: {', '.join(options)}"


def suggestion(names: Sequence[str]) -> str:
    """`did you mean 'a' or 'b'? `, empty without names.

    >>> suggestion(["a", "b", "c"])
    "did you mean 'a', 'b' or 'c'? "
    """
    *first, last = map(repr, names) if names else [""]
    return f"did you mean {' or '.join(filter(None, [', '.join(first), last]))}? " if last else ""
