"""The errors that reach a user: one line each, saying where, what was found and what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class ArmcalError(Exception):
    """Base of every error this project raises on purpose."""

    exit_code = 1


class InputError(ArmcalError):
    """Bad input or usage: the message names the place, what was found and what is allowed."""

    exit_code = 2


class JobError(ArmcalError):
    """The input was fine, the job itself could not be done (solver failed, parameters not identifiable)."""

    exit_code = 1


def nearest(word: str, allowed: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: the nearest valid one, case aside, and all that are valid.

    >>> nearest("lenghts_mm", ["links_mm", "lengths_mm"])
    "did you mean 'lengths_mm'? allowed: lengths_mm, links_mm"
    """
    options = sorted(set(allowed))
    lower = {option.lower(): option for option in options}
    close = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.5)
    hint = f"did you mean '{lower[close[0]]}'? " if close else ""
    return f"{hint}allowed: {', '.join(options)}"
