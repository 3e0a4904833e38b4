"""The errors that reach a user: one line each, saying where, what was found and what is allowed.

Which of the names that are allowed somebody may have meant: misspelt, shortened, or another word for the same.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from difflib import SequenceMatcher
from types import MappingProxyType

FEWEST, LONGEST = 3, 60  # characters of a word in which letters may be wrong: shorter ones are like too many others
NEAR, NEAR_OF_THREE = 0.75, 0.66  # share of the letters that two words have in common, in this order; of three letters
SHOWN = 3  # names that are suggested at once; more help nobody
NOTHING: Mapping[str, str] = MappingProxyType({})


class ArmcalError(Exception):
    """Base of every error this project raises on purpose."""

    exit_code = 1


class InputError(ArmcalError):
    """Bad input or usage: the message names the place, what was found and what is allowed."""

    exit_code = 2


class JobError(ArmcalError):
    """The input was fine, the job itself could not be done (solver failed, parameters not identifiable)."""


def printable(text: str) -> str:
    """`text` with control characters, line breaks, and what no output can encode written as in Python."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def close_names(word: str, allowed: Iterable[str], meant: Mapping[str, str] = NOTHING) -> list[str]:
    """Up to three names: those that are most alike (`difflib`), else those that have the word or are a part of it.

    meant : another word -> the name that says the same

    >>> close_names("desing", ["design", "score"])
    ['design']
    >>> close_names("offset", ["base_offset", "tool_offset", "backlash"])
    ['base_offset', 'tool_offset']
    """
    options, low = sorted(set(allowed)), word.lower()
    if len(word) > LONGEST:
        return []
    spelt = {**{other: name for other, name in meant.items() if name in options}, **{name: name for name in options}}
    matcher = SequenceMatcher(b=low, autojunk=False)
    alike = dict[str, float]()
    for name in spelt:
        matcher.set_seq1(name.lower())
        alike[name] = matcher.ratio()
    best = max(alike.values(), default=0.0)
    limit = NEAR if len(low) > FEWEST else NEAR_OF_THREE if len(low) == FEWEST else 1.0
    if best >= limit:
        near = dict.fromkeys(spelt[name] for name, ratio in alike.items() if ratio == best)
    else:
        near = dict.fromkeys(option for option in options if _is_part(low, option.lower()))
    return list(near) if len(near) <= SHOWN else []


def _is_part(word: str, name: str) -> bool:
    """Whether a name has all parts of the word, begins with it, or is the beginning of it, whatever separates them; or
    both have the same number at the end, and a name begins as the word does: `dir1`, `direction1`."""
    parts, name_parts = ([part for part in re.split(r"[^a-z0-9]+", text) if part] for text in (word, name))
    if not parts or not name_parts:
        return False
    if parts[0] == name_parts[0] and (set(name_parts) <= set(parts) or (len(parts) == 1 and len(word) < FEWEST)):
        return True
    if len(word) < FEWEST:
        return len(parts) > 1 and set(parts) <= set(name_parts)
    stem, number = word.rstrip("0123456789"), re.sub(r".*?(\d*)$", r"\1", word, flags=re.DOTALL)
    numbered = bool(number) and name.startswith(stem) and name.endswith(number) and len(stem) >= FEWEST
    numbered = numbered and name.rstrip("0123456789") + number == name
    return numbered or "".join(name_parts).startswith("".join(parts)) or set(parts) <= set(name_parts)


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
