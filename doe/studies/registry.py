"""Studies that have a name instead of a file: `armcal study paper`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from doe.jobs.workers import Workers
from identification.progress import Progress

if TYPE_CHECKING:
    import polars


@dataclass(frozen=True)
class NamedResult:
    """What a named study found.

    frames : name -> table; written as NAME.parquet;  shown : for people (rich renderables or text), verdict first
    passed : whether it came out as it must; decides the exit code
    """

    frames: Mapping[str, polars.DataFrame]
    shown: tuple[Any, ...]
    passed: bool


class NamedStudy(Protocol):
    """A named study. `replications` None: its own number; `table` keeps finished rows for --resume, None: nowhere."""

    def __call__(
        self,
        *,
        folder: Path | None,
        workers: Workers,
        seed: int,
        replications: int | None,
        resume: bool,
        force: bool,
        progress: Progress,
    ) -> NamedResult: ...


# name -> where the function is; imported when asked for
STUDIES: Mapping[str, str] = MappingProxyType(
    {"blind": "doe.studies.blind.study:study", "paper": "doe.studies.paper.study:study"}
)


def named(name: str) -> NamedStudy:
    """The study of a name in `STUDIES`."""
    module, _, function = STUDIES[name].partition(":")
    found: NamedStudy = getattr(import_module(module), function)
    return found
