"""Tables of rows under keys: written as rows finish, intact after a crash, continued where they stopped.

A table is one Parquet file. While work goes on, finished rows are appended to a journal beside it (one line of JSON per
key, floats to the last bit); closing the table turns both into the Parquet file. After a kill the journal remains, and
`RowTable.open(..., resume=True)` reads it; a line cut short by the crash is dropped, and its key is done again.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from identification import InputError, JobError
from identification.files.io import provide_temporary_folder, sync_folder, write_together

if TYPE_CHECKING:
    import polars


Key = Mapping[str, Any]  # JSON types only; says everything that the rows depend on
Row = dict[str, Any]
KEY = "key"  # column with the key's canonical text


def canonical(key: Key) -> str:
    """The key as text, independent of the order of its entries.

    >>> canonical({"runs": 4, "arm": "a"})
    '{"arm":"a","runs":4}'
    """
    return json.dumps(key, sort_keys=True, separators=(",", ":"), allow_nan=False)


@dataclass
class RowTable:
    """Rows per key, in memory and in the journal."""

    path: Path
    rows: dict[str, list[Row]] = field(default_factory=dict)
    _journal: FileIO | None = None
    _synced: float = 0.0

    @classmethod
    @contextmanager
    def open(cls, path: Path | str | None, *, resume: bool = False, force: bool = False) -> Iterator[RowTable]:
        """A table to add rows to, Parquet file written on the way out (also after Ctrl-C or an error).

        path : the Parquet file; None keeps the rows in memory only
        resume : continue a table that exists;  force : replace it
        Raises `InputError` if the table exists and neither is given, or another process is writing it.
        """
        if path is None:
            yield cls(Path())
            return
        target = Path(path).resolve()
        if not target.parent.is_dir():
            raise InputError(
                f"{path}: there is no folder {str(target.parent)!r}, allowed: a file in an existing folder"
            )
        if target.is_dir():
            raise InputError(f"{path}: is a directory, allowed: a file name")
        with _locked(journal_of(target)) as journal:
            table = cls(target, _first_rows(target, journal, resume, force), journal)
            try:
                yield table
            finally:
                try:
                    table._finish()
                except KeyboardInterrupt:  # once more, for the signal to find the table whole and no journal
                    table._finish()
                    raise

    def add(self, key: Key, rows: Sequence[Row]) -> None:
        """The rows of one key, in the journal before this returns. Raises `JobError` if that cannot be written."""
        text = canonical(key)
        self.rows[text] = [{KEY: text, **row} for row in rows]
        if self._journal is None:
            return
        try:
            self._append(json.dumps([text, list(rows)]).encode() + b"\n", self._journal)
        except OSError as error:
            reason = f"cannot be written ({error.strerror}); finished rows are kept, go on with --resume"
            raise JobError(f"{journal_of(self.path)}: {reason}") from None

    def _append(self, line: bytes, journal: FileIO) -> None:
        while line:
            line = line[journal.write(line) :]
        # a second of finished rows is what a power failure may cost; the death of the process costs none
        if time.monotonic() > self._synced + 1.0:
            os.fsync(journal.fileno())
            self._synced = time.monotonic()

    def arrange(self, keys: Iterable[Key]) -> None:
        """Sort the rows of these keys to the front in the order of the keys, whichever finished first."""
        first = [text for key in keys if (text := canonical(key)) in self.rows]
        self.rows = {text: self.rows[text] for text in dict.fromkeys([*first, *self.rows])}

    def __contains__(self, key: Key) -> bool:
        return canonical(key) in self.rows

    def frame(self, keys: Iterable[Key] | None = None) -> polars.DataFrame:
        """All rows, or those of some keys in their order; without a row, a frame without columns."""
        wanted = self.rows if keys is None else [text for key in keys if (text := canonical(key)) in self.rows]
        return frame_of([row for text in wanted for row in self.rows[text]])

    def _finish(self) -> None:
        if self.rows:
            write_together({self.path: parquet(self.frame())}, force=True)
            sync_folder(self.path.parent)  # before the journal goes
        journal_of(self.path).unlink(missing_ok=True)


def frame_of(rows: Sequence[Row]) -> polars.DataFrame:
    """Rows as a polars frame with the union of their columns; what a row does not have is null."""
    import polars

    return polars.DataFrame(rows, infer_schema_length=None, strict=False) if rows else polars.DataFrame()


def parquet(frame: polars.DataFrame) -> bytes:
    """The content of the frame's Parquet file."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer)
    return buffer.getvalue()


def with_columns(frame: polars.DataFrame, types: Mapping[str, Any]) -> polars.DataFrame:
    """The frame with columns of these names and types; one that no row has is there, empty."""
    import polars as pl

    empty = [pl.lit(None).alias(name) for name in types if name not in frame.columns]
    return frame.with_columns(empty).cast(types)  # type: ignore[arg-type]


def read_rows(path: Path | str) -> polars.DataFrame:
    """The rows of a table, also of one that is being written or was interrupted. Raises `InputError` if none."""
    target, journal = Path(path), journal_of(Path(path))
    if not target.exists() and not journal.exists():
        raise InputError(f"{path}: no such table, allowed: the Parquet file of an earlier run")
    rows = _from_parquet(target)
    if journal.exists():
        with open(journal, "rb") as stream:
            rows |= _parse(stream.read())[0]
    return frame_of([row for of_key in rows.values() for row in of_key])


def made(folder: Path | str) -> Path:
    """The folder, created if it does not exist. Raises `InputError` if that fails."""
    try:
        Path(folder).mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}), allowed: a folder in an existing one") from None
    return Path(folder)


def short_hash(content: str | bytes) -> str:
    """Twelve hexadecimal digits that identify a long input in the keys of tasks."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()[:12]


def journal_of(path: Path) -> Path:
    """The file that holds finished rows while work goes on."""
    return path.with_name(path.name + ".journal")


@contextmanager
def _locked(path: Path) -> Iterator[FileIO]:
    """The journal, opened and locked for this process. An empty journal is deleted on exit."""
    stream = _opened(path)
    while not _is_named(stream, path):  # another run ended, and took its journal away, while this one waited
        stream.close()
        stream = _opened(path)
    with stream:
        try:
            yield stream
        finally:
            if _is_named(stream, path) and path.stat().st_size == 0:
                path.unlink()


def _opened(path: Path) -> FileIO:
    import portalocker

    provide_temporary_folder(path.parent)
    try:
        stream = FileIO(path, "a+b")
        portalocker.lock(stream, portalocker.LockFlags.EXCLUSIVE | portalocker.LockFlags.NON_BLOCKING)
    except portalocker.AlreadyLocked:
        stream.close()
        raise InputError(f"{path}: another run is writing this table, allowed: one at a time") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}), allowed: a writable place") from None
    return stream


def _is_named(stream: FileIO, path: Path) -> bool:
    """True if the open file is still the one at this path."""
    return path.exists() and os.path.samestat(os.fstat(stream.fileno()), path.stat())


def _first_rows(target: Path, journal: FileIO, resume: bool, force: bool) -> dict[str, list[Row]]:
    """What an earlier run left. What is to be replaced goes at once: what is resumed later is of one run.

    Raises `InputError` if there is something, and neither `resume` nor `force` is given.
    """
    if resume:
        journal.seek(0)
        rows, size = _parse(journal.read())
        journal.truncate(size)  # the torn end of a crashed run
        return {**_from_parquet(target), **rows}
    if not force:
        for path, exists in ((target, target.exists()), (journal_of(target), journal.seek(0, io.SEEK_END) > 0)):
            if exists:
                raise InputError(f"{path}: exists, allowed: a new name, --resume to go on, or --force to replace it")
    target.unlink(missing_ok=True)
    journal.truncate(0)
    return {}


def _from_parquet(path: Path) -> dict[str, list[Row]]:
    import polars

    if not path.exists():
        return {}
    try:
        frame = polars.read_parquet(path)
    except (polars.exceptions.PolarsError, OSError) as error:
        raise InputError(
            f"{path}: not a Parquet file ({str(error).splitlines()[0]}), allowed: a table written by armcal"
        ) from None
    if KEY not in frame.columns:
        raise InputError(f"{path}: has no column {KEY!r}, allowed: a table written by armcal")
    return frame.rows_by_key(KEY, named=True, include_key=True)


def _parse(content: bytes) -> tuple[dict[str, list[Row]], int]:
    """The rows of a journal, and how many of its bytes are whole lines."""
    rows, size = {}, 0
    with suppress(ValueError, TypeError):  # the torn end of a crashed run
        for line in content.splitlines(keepends=True):
            text, of_key = json.loads(line)
            if line.endswith(b"\n"):
                rows[text] = [{KEY: text, **row} for row in of_key]
                size += len(line)
    return rows, size
