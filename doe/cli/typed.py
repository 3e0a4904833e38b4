"""The command as it was typed, for pages that say where they come from."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from doe.report.page import Origin

WORDS = "armcal.words"  # in the context's `meta`: what was typed after `armcal`


def origin(seed: int, files: Iterable[Path | None]) -> Origin:
    """The command line and input files, for a page that the running command makes."""
    from doe.report.page import Origin

    words = click.get_current_context().meta.get(WORDS, ())
    return Origin(shlex.join(("armcal", *words)), seed, [path for path in files if path is not None])
