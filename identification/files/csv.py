"""Tables of text from CSV and Parquet files and data frames; errors name file, row, column and what is allowed."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError, close_names, suggestion
from identification.files.io import PathLike, decode, read_bytes

QUOTED = "cells without quotation marks, or in a pair of them"
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
# columns that mean something by themselves: none of them is a misspelling of another
KNOWN = re.compile(
    r"q\d+_(deg|rad|mm?)|direction\d+|(x|y|z|sigma|distance)_mm?|order|time_s|temperature_C|payload_kg|posture|session|run|weight"
    r"|marker|surface|cup|kind|r[xyz]_(deg|rad)|q[wxyz]|commanded\d+_(deg|rad|mm?)"
)
NAMES = ("session", "marker", "surface", "cup", "kind")  # columns of texts
MEASURE, VIA = "measure", "via"  # of the column `kind`: rows to measure, and way-points of the moves between them
FITS = re.compile(r"library-prior( --missing [\w,]+)?")  # options of `armcal identify`


@dataclass(frozen=True)
class Table:
    """A table of text, blank lines left out.

    frame : the columns, all of them strings, numbers with decimal points; an empty cell is null
    lines : (m,) line number of every row in the file, from 1; empty: a table without lines
    sha256 : of the file's bytes; empty: no file
    fit : what a comment `# fit: library-prior` above the header says, as options of `armcal identify`; empty: nothing
    used : columns that were asked for
    """

    path: str
    frame: pl.DataFrame
    lines: NDArray[np.int64]
    sha256: str = ""
    fit: str = ""
    used: set[str] = field(default_factory=set)

    def __len__(self) -> int:
        return self.frame.height

    def __contains__(self, column: str) -> bool:
        return column in self.frame.columns

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns, in the order of the file."""
        return tuple(self.frame.columns)

    def require(self, columns: Iterable[str]) -> None:
        """Raises `InputError` naming the first of `columns` that is missing, and a column that may be meant."""
        for column in columns:
            if column not in self:
                others = [name for name in self.columns if not KNOWN.fullmatch(name)]
                close = close_names(column, others)
                if not close and (joint := re.match(r"q(\d+)_", column)):  # a name such as `theta1_deg` or `J1`
                    close = [name for name in others if re.fullmatch(rf"[A-Za-z_]+0*{joint[1]}([^\d].*)?", name)]
                hint = suggestion(close[:1]).replace("did you mean", "did you mean to rename")
                state = f"column {column!r} is missing, found: {', '.join(self.columns)}"
                raise InputError(f"{self.path}: {state}; {hint}allowed: a column of that name")
            self.used.add(column)

    def place(self, row: int, column: str) -> str:
        """`data.csv: row 3 (line 4), column x_mm`; `row` counts from 0."""
        line = f" (line {self.lines[row]})" if len(self.lines) else ""
        return f"{self.path}: row {row + 1}{line}, column {column}"

    def floats(
        self,
        column: str,
        allowed: str = "a finite number",
        test: Callable[[Array], NDArray[np.bool_]] = np.isfinite,
        empty: float | None = None,
    ) -> Array:
        """(m,) the column as finite numbers for which `test` (vectorised) holds.

        empty : what an empty cell, or a NaN of a frame, stands for; None: for nothing

        Raises `InputError` naming the first row that has anything else; `allowed` says in words what `test` wants.
        """
        self.require([column])
        text = self.frame[column]
        numbers = text.cast(pl.Float64, strict=False)
        if numbers.null_count() > text.null_count():  # spaces around a number are fine, and rare
            numbers = text.str.strip_chars().cast(pl.Float64, strict=False)
        values = numbers.fill_null(np.nan).to_numpy()
        good = np.isfinite(values) & test(values)
        if empty is not None:
            blank = (text.fill_null("nan").str.to_lowercase() == "nan").to_numpy()
            values, good = np.where(blank, empty, values), good | blank
        self.require_good(good, column, allowed)
        return values

    def texts(self, column: str) -> NDArray[np.str_]:
        """(m,) the column as texts, spaces around them cut off. Raises `InputError` naming the first empty row."""
        self.require([column])
        text = self.frame[column].str.strip_chars().fill_null("")
        self.require_good((text != "").to_numpy(), column, "a name")
        return np.array(text.to_list(), dtype=np.str_)

    def require_good(self, good: NDArray[np.bool_], column: str, allowed: str) -> None:
        """Raises `InputError` naming the first row that is not."""
        if not good.all():
            text = self.frame[column][row := int(np.argmin(good))]
            cell = repr(text) if text and text.strip() else "an empty cell"
            raise InputError(f"{self.place(row, column)}: found {cell}, allowed: {allowed}")

    def warn_unused(self, expected: Iterable[str] = (), hint: str = "") -> None:
        """One `UserWarning` for all columns that were not asked for, with the nearest `expected` one where there is
        one; these may be there without a word.

        hint : what else to say
        """
        free, unused = [column for column in expected if column not in self], []
        for column in (column for column in self.columns if column not in {*self.used, *expected}):
            near = "" if KNOWN.fullmatch(column) else suggestion(close_names(column, free)).strip()
            unused.append(f"{column!r} ({near})" if near else f"{column!r}")
        if unused:
            columns = "column is" if len(unused) == 1 else "columns are"
            message = "; ".join(filter(None, [f"{columns} not used: {', '.join(unused)}", hint]))
            warnings.warn(f"{self.path}: {message}", UserWarning, stacklevel=3)


def read_table(path: PathLike, *, vias: bool = False) -> Table:
    """Reads a Parquet file, or a text file of columns with one header line.

    vias : with the way-points that a plan has between its postures, where nobody measures

    Lines above the header that begin with # are comments; `# fit: ...` among them says how the rows are to be fitted.
    Columns are separated by commas, or as European spreadsheets write them by semicolons or tabs, then with decimal
    points or commas. Between commas numbers with decimal commas are in quotation marks.

    Raises `InputError` for a missing or empty file, no data rows, a header that is missing, repeats a name or does not
    fit the rows (ragged rows), bytes that are not UTF-8, and quoted numbers whose commas may separate thousands.
    """
    content = read_bytes(path)
    sha256 = hashlib.sha256(content).hexdigest()
    if content.startswith(b"PAR1"):
        try:
            frame = pl.read_parquet(io.BytesIO(content))
        except (pl.exceptions.PolarsError, OSError):
            raise InputError(f"{path}: not a whole Parquet file, allowed: CSV or Parquet") from None
        return table_of_frame(frame, str(path), sha256, vias=vias)
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):  # .xlsx and .ods, or .xls
        raise InputError(f"{path}: found a spreadsheet, allowed: CSV or Parquet; save it as CSV")
    content, line, fit = content.removeprefix(codecs.BOM_UTF8), 1, ""
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    # a spreadsheet makes cells of a comment: it may come back in quotation marks and with separators at its end
    while (above := re.match(rb'[^\S\n]*\n|"?#.*\n?', content)) is not None:
        if asked := re.match(r"#\s*fit\s*:\s*(.*)", decode(path, above[0]).strip('"\n,;\t ')):
            fit = " ".join(asked[1].split())
            if not FITS.fullmatch(fit):
                allowed = "library-prior, or library-prior --missing NAMES"
                raise InputError(f"{path}: line {line}: fit {fit!r}, allowed: {allowed}")
        content, line = content[above.end() :], line + 1
    first = decode(path, content.partition(b"\n")[0])
    separator = next((s for s in ("\t", ";") if s in first and "," not in first), ",")
    try:
        frame = pl.read_csv(content, infer_schema=False, separator=separator)
    except pl.exceptions.PolarsError as error:
        _raise_for_ragged_row(path, content, line, separator)
        state = f"not a valid CSV file: {str(error).splitlines()[0]}"
        raise InputError(f"{path}: {state}, allowed: the names of the columns, {QUOTED}") from None
    header = [re.sub(r"_duplicated_\d+$", "", name).strip() for name in frame.columns]
    for name in filter(None, header):
        if re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?", name):
            raise InputError(f"{path}: line {line} has the number {name!r}, allowed: the names of the columns")
        if header.count(name) > 1:
            raise InputError(f"{path}: column {name!r} is there {header.count(name)} times, allowed: once")
    # short rows are filled up with nulls: a null in the last column asks for a closer look
    if frame.width > 1 and frame.to_series(-1).null_count():
        _raise_for_ragged_row(path, content, line, separator)
    frame.columns = [name or f"\n{k}" for k, name in enumerate(header)]  # a name that no header can have
    filled = ~frame.select(pl.all_horizontal(pl.all().is_null())).to_series()
    frame, lines = frame.filter(filled), np.flatnonzero(filled.to_numpy()) + line + 1
    if frame.height == 0:
        _raise_for_ragged_row(path, content, line, separator)
        raise InputError(f"{path}: there are no rows below the header, allowed: at least 1 row")
    for k in (k for k, name in enumerate(header) if not name):  # empty ones are what spreadsheets leave behind
        if frame[f"\n{k}"].null_count() < frame.height:
            raise InputError(f"{path}: column {k + 1} has no name in line {line}, allowed: a name")
        frame = frame.drop(f"\n{k}")
    numbers = frame.columns
    if separator == ",":  # then decimal commas are in quotation marks, and may be those of thousands
        numbers = [name for name in frame.columns if b'"' in content and KNOWN.fullmatch(name) and name not in NAMES]
        cells = frame.select(numbers).unpivot()["value"] if numbers else pl.Series([], dtype=pl.String)
        commas = cells.filter(cells.str.contains(r"^\s*[-+]?\d*,\d*([eE][-+]?\d+)?\s*$"))
        if len(commas) and commas.str.contains(r"^\s*[-+]?[1-9]\d{0,2},\d{3}\s*$").all():
            allowed = "decimal points, or semicolons between the columns"
            raise InputError(f"{path}: found {commas[0]!r}, a decimal comma or one of thousands, allowed: {allowed}")
    for name in numbers:
        points: Any = frame[name].str.strip_chars().str.replace(",", ".", literal=True)
        number = points.cast(pl.Float64, strict=False).is_not_null()
        frame = frame.with_columns(points.zip_with(number, frame[name]).alias(name))
    return _measured(Table(str(path), frame, lines, sha256, fit), vias)


def table_of_frame(frame: Any, name: str = "frame", sha256: str = "", *, vias: bool = False) -> Table:
    """A data frame of polars or pandas, or a mapping of names to columns, as a table; numbers keep all their digits.

    vias : as of `read_table`. Raises `InputError` for what is no such frame, no rows, and columns of different lengths.
    """
    if not hasattr(frame, "keys") and not hasattr(frame, "columns"):
        raise InputError(f"{name}: {type(frame).__name__}, allowed: a data frame of polars or pandas")
    series = []
    for column in list(frame.columns if hasattr(frame, "columns") else frame.keys()):
        cells = frame[column].to_list() if hasattr(frame[column], "to_list") else np.asarray(frame[column]).tolist()
        # numbers by `repr`, which loses no digit
        texts = [None if text in ("None", "nan", "<NA>") else text for text in map(str, cells)]
        series.append(pl.Series(str(column), texts, dtype=pl.String))
    if len({len(each) for each in series}) > 1:
        raise InputError(f"{name}: found columns of different lengths, allowed: one length")
    if not series or not len(series[0]):
        raise InputError(f"{name}: there are no rows, allowed: at least 1 row")
    return _measured(Table(name, pl.DataFrame(series), np.zeros(0, dtype=np.int64), sha256), vias)


def _measured(table: Table, vias: bool) -> Table:
    """The rows to measure of a table whose column `kind` says of the others that they are way-points."""
    if "kind" not in table:
        return table
    kinds = table.frame["kind"].str.strip_chars().fill_null("")
    measured, via = (kinds == MEASURE).to_numpy(), (kinds == VIA).to_numpy()
    if via.any():
        table.require_good(measured | via, "kind", f"{MEASURE} or {VIA}")
        if not measured.any():
            raise InputError(f"{table.path}: column kind: found only {VIA}, allowed: at least 1 row {MEASURE}")
    if not (measured | via).all():  # a column of somebody else
        return table
    table.used.add("kind")
    rows = measured | vias
    return replace(table, frame=table.frame.filter(rows), lines=table.lines[rows] if len(table.lines) else table.lines)


def _raise_for_ragged_row(path: PathLike, content: bytes, header: int, separator: str) -> None:
    """Raises `InputError` for a row of another length, or with quotation marks that do not enclose a whole cell.

    header : its line
    """
    reader = csv.reader(io.StringIO(decode(path, content), newline=""), delimiter=separator, strict=True)
    row, line, columns = -1, header - 1, 0
    try:
        for cells in (cells for cells in reader if any(cell.strip() for cell in cells)):
            row, line, columns = row + 1, header - 1 + reader.line_num, columns or len(cells)
            if len(cells) != columns:
                allowed = f"{columns} separated by {SEPARATORS[separator]}, as in the header"
                raise InputError(f"{path}: row {row} (line {line}): found {len(cells)} cells, allowed: {allowed}")
    except csv.Error as error:
        raise InputError(f"{path}: row {row + 1} (from line {line + 1}): {error}, allowed: {QUOTED}") from None


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
