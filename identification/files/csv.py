"""Tables of text from CSV files; errors name file, row, column and what is allowed."""

import csv
import hashlib
import io
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError, close_names, require, suggestion
from identification.files.io import PathLike, decode, read_bytes

# columns that mean something by themselves: none of them is a misspelling of another
MEANINGFUL = re.compile(
    r"(q|commanded)\d+_(deg|rad|mm?)|direction\d+|(x|y|z|sigma|distance)_mm?|r[xyz]_(deg|rad)|q[wxyz]|order|time_s"
    r"|temperature_C|payload_kg|posture|session|marker|surface|cup|run|weight|kind"
)
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
MEASURE, VIA = "measure", "via"  # of the column `kind`: rows to measure, and way-points of the moves between them
FITS = re.compile(r"library-prior( --missing [\w,]+)?")  # options of `armcal identify`


@dataclass(frozen=True)
class Table:
    """A table of text, blank lines left out: the rows to measure, and way-points if wanted.

    frame : the columns, all of them strings without spaces around them; an empty cell is null
    lines : (m,) line number of every row in the file, from 1
    sha256 : of the file's bytes
    fit : what a comment `# fit: library-prior` above the header says, as options of `armcal identify`; empty: nothing
    used : columns that were asked for
    """

    path: str
    frame: pl.DataFrame
    lines: NDArray[np.int64]
    sha256: str
    fit: str
    used: set[str] = field(default_factory=set)

    def __len__(self) -> int:
        return self.frame.height

    def __contains__(self, column: str) -> bool:
        return column in self.frame.columns

    def require(self, columns: Iterable[str]) -> None:
        """Raises `InputError` naming the first of `columns` that is missing, and a column that may be meant."""
        for column in columns:
            if column not in self:
                close = close_names(column, (name for name in self.frame.columns if not MEANINGFUL.fullmatch(name)))[:1]
                hint = suggestion(close).replace("did you mean", "did you mean to rename")
                state = f"column {column!r} is missing, found: {', '.join(self.frame.columns)}"
                raise InputError(f"{self.path}: {state}; {hint}allowed: a column of that name")
            self.used.add(column)

    def place(self, row: int, column: str) -> str:
        """`data.csv: row 3 (line 4), column x_mm`; `row` counts from 0."""
        return f"{self.path}: row {row + 1} (line {self.lines[row]}), column {column}"

    def floats(
        self,
        column: str,
        allowed: str = "a finite number",
        test: Callable[[Array], NDArray[np.bool_]] = np.isfinite,
        empty: float | None = None,
    ) -> Array:
        """(m,) the column as finite numbers for which `test` (vectorised) holds.

        empty : what an empty cell, or a NaN, stands for; None: for nothing

        Raises `InputError` naming the first row that has anything else; `allowed` says in words what `test` wants.
        """
        self.require([column])
        text = self.frame[column]
        values = text.cast(pl.Float64, strict=False).fill_null(np.nan).to_numpy()
        good = np.isfinite(values) & test(values)
        if empty is not None:
            blank = (text.fill_null("nan").str.to_lowercase() == "nan").to_numpy()
            values, good = np.where(blank, empty, values), good | blank
        self.require_good(good, column, allowed)
        return values

    def texts(self, column: str) -> NDArray[np.str_]:
        """(m,) the column as texts. Raises `InputError` naming the first empty row."""
        self.require([column])
        self.require_good(self.frame[column].is_not_null().to_numpy(), column, "a name")
        return np.array(self.frame[column].to_list(), dtype=np.str_)

    def require_good(self, good: NDArray[np.bool_], column: str, allowed: str) -> None:
        """Raises `InputError` naming the first row that is not."""
        if not good.all():
            text = self.frame[column][row := int(np.argmin(good))]
            cell = "an empty cell" if text is None else repr(text)
            raise InputError(f"{self.place(row, column)}: found {cell}, allowed: {allowed}")

    def warn_unused(self, expected: Iterable[str] = (), hint: str = "") -> None:
        """One `UserWarning` for all columns that were not asked for, with the nearest `expected` one where there is
        one; these may be there without a word;  hint : what else to say"""
        unused, free = [], [column for column in expected if column not in self]
        for column in (column for column in self.frame.columns if column not in {*self.used, *expected}):
            near = "" if MEANINGFUL.fullmatch(column) else suggestion(close_names(column, free)).strip()
            unused.append(f"{column!r} ({near})" if near else f"{column!r}")
        if unused:
            what = f"{'column is' if len(unused) == 1 else 'columns are'} not used: {', '.join(unused)}"
            warnings.warn(f"{self.path}: {what}{hint and f'; {hint}'}", UserWarning, stacklevel=3)


def read_table(path: PathLike, *, vias: bool = False) -> Table:
    """Reads a text file of columns with one header line.

    vias : with the way-points that a plan has between its postures, where nobody measures: its column `kind` says so

    Lines above the header that begin with # are comments; `# fit: ...` among them says how the rows are to be fitted.
    Columns are separated by commas, or as European spreadsheets write them by semicolons or tabs, with either decimal.

    Raises `InputError` for a missing or empty file, no data rows, a header that is missing, repeats a name or does not
    fit the rows (ragged rows), and bytes that are not UTF-8.
    """
    content = read_bytes(path)
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"PAR1")):  # .xlsx and .ods, .xls, .parquet
        raise InputError(f"{path}: found a spreadsheet or a Parquet file, allowed: CSV; save it as CSV")
    text, above, fit = decode(path, content).replace("\r\n", "\n").replace("\r", "\n"), 0, ""
    # a spreadsheet makes cells of a comment: it may come back in quotation marks and with separators at its end
    while (comment := re.match(r'[^\S\n]*\n|"?#.*\n?', text)) is not None:
        text, above = text[comment.end() :], above + 1
        if asked := re.match(r"#\s*fit\s*:\s*(.*)", comment[0].strip('"\n,;\t ')):
            fit = " ".join(asked[1].split())
            allowed = "library-prior, or library-prior --missing NAMES"
            require(FITS.fullmatch(fit), f"{path}: line {above}: fit {fit!r}, allowed: {allowed}")
    first = text.partition("\n")[0]
    separator = next((s for s in ("\t", ";") if s in first and "," not in first), ",")
    reader = csv.reader(io.StringIO(text), delimiter=separator, strict=True)
    lines, rows = list[int](), list[list[str]]()
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            rows.append(cells)
            lines.append(above + reader.line_num)
            if len(cells) != len(rows[0]):
                allowed = f"{len(rows[0])} separated by {SEPARATORS[separator]}, as in the header"
                row = f"row {len(rows) - 1} (line {lines[-1]})"
                raise InputError(f"{path}: {row}: found {len(cells)} cells, allowed: {allowed}")
    except csv.Error as error:
        row = f"row {len(rows)} (from line {lines[-1] + 1 if lines else above + 1})"
        allowed = "cells without quotation marks, or in a pair of them"
        raise InputError(f"{path}: {row}: {error}, allowed: {allowed}") from None
    require(rows, f"{path}: there is no header, allowed: the names of the columns")
    header, columns = [name.strip() for name in rows[0]], dict[str, Sequence[str]]()
    for k, (name, column) in enumerate(zip(header, zip(*rows[1:], strict=True), strict=False), start=1):
        if name:
            columns[name] = column
        elif any(cell.strip() for cell in column):  # empty ones are what spreadsheets leave behind
            allowed = "a name, or no such column (of pandas: to_csv(.., index=False))"
            raise InputError(f"{path}: column {k} has no name in line {lines[0]}, allowed: {allowed}")
    if re.search(r"\s", first.strip()) and len(header) == 1:
        raise InputError(f"{path}: line {lines[0]} is separated by spaces, allowed: by commas, semicolons or tabs")
    for name in filter(None, header):
        if re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?", name):
            raise InputError(f"{path}: line {lines[0]} has the number {name!r}, allowed: the names of the columns")
        require(header.count(name) <= 1, f"{path}: column {name!r} is there {header.count(name)} times, allowed: once")
    require(columns, f"{path}: there are no rows, allowed: at least 1 row")
    frame = pl.DataFrame(columns, schema=dict.fromkeys(columns, pl.String))
    frame = frame.with_columns(pl.all().str.strip_chars().replace("", None))
    if separator != ",":
        frame = frame.with_columns(pl.all().str.replace(r"^([-+]?\d*),(\d*([eE][-+]?\d+)?)$", "$1.$2"))
    table = Table(str(path), frame, np.array(lines[1:]), hashlib.sha256(content).hexdigest(), fit)
    kind = frame["kind"].fill_null("").to_numpy() if "kind" in table else np.array([""])
    if (is_via := kind == VIA).any():
        table.require_good(np.isin(kind, (MEASURE, VIA)), "kind", f"{MEASURE} or {VIA}")
        require(not is_via.all(), f"{path}: column kind: found only {VIA}, allowed: at least 1 row {MEASURE}")
    if not np.isin(kind, (MEASURE, VIA)).all():  # a column of somebody else
        return table
    rows = ~is_via | vias
    return replace(table, frame=frame.filter(rows), lines=table.lines[rows], used={"kind"})


# -- writing -----------------------------------------------------------------------------------------------------------
def csv_text(columns: dict[str, NDArray[np.generic]], fit: str = "") -> str:
    """CSV of columns of one length; whole floats that only count (`order`, `run`, directions) lose their `.0`.

    NaN is an empty cell;  fit : `Table.fit`, for the comment above the header
    """
    series = []
    for name, values in columns.items():
        column = pl.Series(name, values.tolist() if values.dtype.kind == "U" else np.ascontiguousarray(values))
        counts = name == "order" and np.all(np.abs(values) < 2.0**53)
        if counts or name == "run" or re.fullmatch(r"direction\d+", name):
            column = column.cast(pl.Float64).fill_nan(None).cast(pl.Int64)
        series.append(column)
    return (f"# fit: {fit}\n" if fit else "") + pl.DataFrame(series).fill_nan(None).write_csv()
