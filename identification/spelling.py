"""Which of the names that are allowed somebody may have meant: misspelt, shortened, or another word for the same."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType

FEWEST, LONGEST = 3, 60  # characters of a word in which letters may be wrong: shorter ones are like too many others
PER_MISTAKE, MOST = 4, 3  # characters of which one may be wrong, and mistakes of a word
SHOWN = 3  # names that are suggested at once; more help nobody
NOTHING: Mapping[str, str] = MappingProxyType({})


def close_names(word: str, allowed: Iterable[str], meant: Mapping[str, str] = NOTHING) -> list[str]:
    """Up to three names: those with the fewest wrong letters, else those that have the word or are a part of it.

    meant : another word -> the name that says the same

    >>> close_names("desing", ["design", "score"])
    ['design']
    >>> close_names("offset", ["base_offset", "tool_offset", "backlash"])
    ['base_offset', 'tool_offset']
    """
    options, low = sorted(set(allowed)), word.lower()
    if len(word) > LONGEST:
        return []
    others = {other: name for other, name in meant.items() if name in options}
    spelt = {**others, **{option: option for option in options}}
    limit = min(max((len(low) - 1) // PER_MISTAKE, 1), MOST) if len(low) >= FEWEST else 0
    far = {name: letters_wrong(low, name.lower(), limit) for name in spelt}
    if (least := min(far.values(), default=limit + 1)) <= limit:
        found = dict.fromkeys(spelt[name] for name, count in far.items() if count == least)
    else:
        found = dict.fromkeys(option for option in options if _is_part(low, option.lower()))
    return list(found) if len(found) <= SHOWN else []


def letters_wrong(word: str, name: str, most: int) -> int:
    """Letters to put in, leave out, change, or swap with the next, to turn one into the other (optimal string
    alignment: L. Boytsov, "Indexing methods for approximate dictionary searching", 2011); most + 1 for any more."""
    if word == name:
        return 0
    if not most or abs(len(word) - len(name)) > most:
        return most + 1
    before, last = [0] * (len(name) + 1), list(range(len(name) + 1))
    for i, a in enumerate(word, start=1):
        row = [i]
        for j, b in enumerate(name, start=1):
            row.append(min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (a != b)))
            if i > 1 and j > 1 and a == name[j - 2] and word[i - 2] == b:
                row[j] = min(row[j], before[j - 2] + 1)
        before, last = last, row
    return min(last[-1], most + 1)


def _is_part(word: str, name: str) -> bool:
    """Whether a name has all parts of the word, begins with it, or is the beginning of it, whatever separates them."""
    parts, own = ([part for part in re.split(r"[^a-z0-9]+", text) if part] for text in (word, name))
    if not parts or not own:
        return False
    if parts[0] == own[0] and set(own) <= set(parts):
        return True
    begins = len(word) >= FEWEST and ("".join(own).startswith("".join(parts)) or _is_numbered(word, name))
    if len(parts) == 1 and len(word) < FEWEST:
        return parts[0] == own[0]
    return begins or set(parts) <= set(own)


def _is_numbered(word: str, name: str) -> bool:
    """Whether both have the same number at the end, and a name begins as the word does: `dir1`, `direction1`."""
    (own, number), (stem, other) = (re.fullmatch(r"(.*?)(\d*)", text, re.DOTALL).groups() for text in (name, word))  # type: ignore[union-attr]
    return bool(number) and number == other and len(stem) >= FEWEST and own.startswith(stem)
