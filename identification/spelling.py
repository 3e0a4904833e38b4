"""Which of the names that are allowed somebody may have meant: misspelt, shortened, or another word for the same."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from difflib import SequenceMatcher
from types import MappingProxyType

FEWEST, LONGEST = 3, 60  # characters of a word in which letters may be wrong: shorter ones are like too many others
NEAR, NEAR_OF_THREE = 0.75, 0.66  # share of the letters that two words have in common, in this order; of three letters
SHOWN = 3  # names that are suggested at once; more help nobody
NOTHING: Mapping[str, str] = MappingProxyType({})


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
    """Whether a name has all parts of the word, begins with it, or is the beginning of it, whatever separates them."""
    parts, name_parts = ([part for part in re.split(r"[^a-z0-9]+", text) if part] for text in (word, name))
    if not parts or not name_parts:
        return False
    if parts[0] == name_parts[0] and set(name_parts) <= set(parts):
        return True
    begins = len(word) >= FEWEST and ("".join(name_parts).startswith("".join(parts)) or _is_numbered(word, name))
    if len(parts) == 1 and len(word) < FEWEST:
        return parts[0] == name_parts[0]
    return begins or set(parts) <= set(name_parts)


def _is_numbered(word: str, name: str) -> bool:
    """Whether both have the same number at the end, and a name begins as the word does: `dir1`, `direction1`."""
    (head, number), (stem, other) = (re.fullmatch(r"(.*?)(\d*)", text, re.DOTALL).groups() for text in (name, word))  # type: ignore[union-attr]
    return bool(number) and number == other and len(stem) >= FEWEST and head.startswith(stem)
