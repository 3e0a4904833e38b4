"""All or nothing is written; TOML and CSV are read as people and programs save them; what is wrong is one line."""

import hashlib
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.files import io as files
from identification.files.csv import Table, read_table
from tests.refusals import refused


def held(folder: Path) -> dict[str, str]:
    """Name -> text of every file of a folder."""
    return {path.name: path.read_text() for path in folder.iterdir()}


# -- writing -----------------------------------------------------------------------------------------------------------
def test_files_are_written_together_and_replaced_by_force_only(tmp_path: Path) -> None:
    first, second = tmp_path / "a.csv", tmp_path / "b"
    files.write_together({first: "ä\udce4\n"})  # as names of files are read that are not UTF-8
    assert first.read_bytes() == "ä?\n".encode()
    first.chmod(0o640)
    refused(files.write_together, {first: "new", second: "2"}, names=("a.csv", "exists", "--force"))
    assert held(tmp_path) == {"a.csv": "ä?\n"}  # none of the two, and nothing else
    files.write_together({first: b"new", second: "2"}, force=True)
    assert held(tmp_path) == {"a.csv": "new", "b": "2"}
    assert first.stat().st_mode & 0o777 == 0o640  # it keeps its mode


def test_places_that_cannot_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files.check_writable(tmp_path / "a.csv")
    # who runs the tests may be root, whom no mode bits stop
    monkeypatch.setattr(os, "access", lambda path, mode: not (path == tmp_path.resolve() and mode == os.W_OK))
    for place, force, part in (
        (tmp_path / "no" / "a.csv", False, "there is no folder"),
        (tmp_path, True, "is a directory"),
        (tmp_path / "plan.csv", False, "cannot be written to"),
    ):
        refused(files.write_together, {place: ""}, force, names=(f"{place}: ", part, "allowed"))
        refused(files.check_writable, place, force, names=(part,))
    assert held(tmp_path) == {}


def test_old_files_and_those_of_others_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where another command has written one meanwhile, and where the disk is full."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    both = {tmp_path / "a": "1", tmp_path / "b": "2"}
    monkeypatch.setattr(files.os, "fsync", lambda _: (tmp_path / "b").write_text("theirs"))
    refused(files.write_together, both, names=("b: the file exists", "--force"))
    monkeypatch.setattr(files.os, "fsync", full)
    refused(files.write_together, both, True, names=("a: cannot be written", "No space"))
    assert held(tmp_path) == {"b": "theirs"}


# -- TOML --------------------------------------------------------------------------------------------------------------
def test_toml_is_read_whatever_its_keys_texts_and_first_bytes(tmp_path: Path) -> None:
    text = 'a.b."c.d".e = 1\n[x.y]\nz = "' + "1.2, " * 500 + '"\nw = [' + "0.1, 1.5e-3, " * 500 + "]\n"
    for content in (text.encode(), b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode()):
        (tmp_path / "a.toml").write_bytes(content)
        assert files.read_toml(tmp_path / "a.toml") == tomllib.loads(text)


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b"a = 1\nb = = 2\n", ["line 2, column 5", "not valid TOML", "allowed"]),
        (b"", ["empty"]),
        (b" \n\n", ["empty"]),
        (b"a = 1\nb = '\xff'\n", ["UTF-8", "byte 0xff on line 2"]),
        (b"a = " + b"[" * 5000, ["not valid TOML"]),
        (b"a = " + b"1" * 4301, ["not valid TOML", "4300 digits"]),
    ],
)
def test_bad_toml(tmp_path: Path, content: bytes, parts: list[str]) -> None:
    (tmp_path / "a.toml").write_bytes(content)
    refused(files.read_toml, tmp_path / "a.toml", names=["a.toml: ", *parts])


def test_missing_file_and_directory(tmp_path: Path) -> None:
    for read in (files.read_toml, read_table):
        refused(read, tmp_path / "no.toml", names=("no.toml: no such file", "allowed"))
        refused(read, tmp_path, names=("is a directory", "allowed"))


# -- CSV ---------------------------------------------------------------------------------------------------------------
def table(folder: Path, content: str | bytes) -> Table:
    (folder / "data.csv").write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(folder / "data.csv")


NUMBERS = {"a": [1.0, 3.0], "b": [2.0, 4.0]}
EUROPE = {"a": [1.5, 0.0], "b": [-22.5, 4.0], "c": ["x,y", "z"]}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"a,b\n1,2\n3,4", NUMBERS),
        (b"\xef\xbb\xbfa,b\r\n1,2\r\n3,4\r\n", NUMBERS),
        (b' a ,"b"\n 1 ,2\n3," 4"\n', NUMBERS),
        (b"a,b,\n1,2,\n3,4,\n", NUMBERS),
        (b"\na,b\r1,2\r3,4\r", NUMBERS),
        (b"a,b\n\n1,2\n\n,\n3,4\n\n", NUMBERS),
        (b"a;b;c\n1,5;-2,25e1;x,y\n0;4;z\n", EUROPE),
        (b"a\tb\tc\n1.5\t-22.5\tx,y\n0\t4\tz\n", EUROPE),
        (b"\xef\xbb\xbfa;b;c\r\n\r\n1.5;-22,5;x,y\r\n0;4;z\r\n;;\r\n", EUROPE),
        # between commas texts may have commas and points
        (b'x_mm,c\n1.5,"1,5"\n0,"a.1, b"\n', {"x_mm": [1.5, 0.0], "c": ["1,5", "a.1, b"]}),
    ],
)
def test_forms_of_a_csv_file(tmp_path: Path, content: bytes, expected: dict[str, list]) -> None:
    """With any line ends, blank lines and cells; with semicolons, tabs, decimal commas."""
    read = table(tmp_path, content)
    assert set(expected) <= set(read.frame.columns)
    assert {n: (read.texts if n == "c" else read.floats)(n).tolist() for n in expected} == expected
    assert read.sha256 == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("", ["empty"]),
        ("a,b\n", ["no rows", "at least 1 row"]),
        ("a,b\n1,5,2,5\n3,0,4,5\n", ["found 4 cells, allowed: 2 separated by commas, as in the header"]),
        ("a,b\n1;2\n3;4\n", ["found 1 cells, allowed: 2 separated by commas"]),
        ("a;b\n1,2\n3,4\n", ["found 1 cells, allowed: 2 separated by semicolons"]),
        ("a\tb\tc\n1;2;3\n", ["found 1 cells, allowed: 3 separated by tabs"]),
        ("a,b\n\n,\n", ["no rows"]),
        ("a,b\n1,2\n3\n4,5\n", ["row 2 (line 3)", "found 1 cells", "allowed: 2"]),
        ("a,b\n1,2\n\n3,4,5\n", ["row 2 (line 4)", "found 3 cells", "allowed: 2"]),
        ("a,b,a\n1,2,3\n", ["column 'a'", "2 times", "allowed: once"]),
        ("a;b\n1,5;2\n3;4;5\n", ["row 2 (line 3)", "found 3 cells", "allowed: 2"]),
        ("1,2\n3,4\n", ["line 1", "'1'", "allowed: the names"]),
        ("# by hand\n1,2\n3,4\n", ["line 2", "'1'", "allowed: the names"]),
        ("# by hand\na,b\n1,2\n3\n4,5\n", ["row 2 (line 4)", "found 1 cells", "allowed: 2"]),
        ('# by hand\na,b\n1,"2\n3,4\n', ["row 1 (from line 3)", "unexpected end"]),
        ("# fit: splines\na,b\n1,2\n", ["line 1: fit 'splines'", "allowed: library-prior, or library-prior --missing"]),
        ("# fit:\na,b\n1,2\n", ["line 1: fit ''", "allowed: library-prior"]),
        ("# a,b\n", ["no header", "allowed: the names of the columns"]),
        ("PK\x03\x04\x14", ["found a spreadsheet", "save it as CSV"]),
        ("a,,b\n1,2,3\n", ["column 2 has no name", "allowed"]),
        (",a\n0,1\n", ["column 1 has no name in line 1, allowed: a name, or no such column (of pandas: "]),
        ("q1_deg q2_deg\n1 2\n", ["line 1 is separated by spaces, allowed: by commas, semicolons or tabs"]),
        (b"a,b\n1,\xff\n", ["UTF-8", "line 2"]),
        (b"\xff\xfea\x00,\x00b\x00\n\x00", ["UTF-8", "line 1"]),
        ('a,b\n1,"2\n3,4\n', ["row 1 (from line 2)", "unexpected end", "allowed: cells without quotation marks"]),
        ('a,b\n1,2\n3,"6"x\n', ["row 2 (from line 3)"]),
        (f'a,b\n1,"{"6" * 200_000}\n', ["row 1 (from line 2)", "field larger"]),
        ('"a,b\n1,2\n', ["line 1"]),
    ],
)
def test_bad_csv(tmp_path: Path, content: str | bytes, parts: list[str]) -> None:
    refused(table, tmp_path, content, names=["data.csv: ", *parts])


MISSING = "library-prior --missing backlash,gear_ratio"


@pytest.mark.parametrize(
    ("above", "fit", "lines"),
    [
        ("", "", 0),
        ("# by hand\n", "", 1),
        ("\ufeff# fit: library-prior\r\n", "library-prior", 1),
        ("#fit:library-prior\n# by hand, on Monday\n", "library-prior", 2),
        (f"# fit: {MISSING}\n", MISSING, 1),
        (f'"# fit: {MISSING}",\n', MISSING, 1),
        ("# fit: library-prior,,\n", "library-prior", 1),
    ],
)
def test_comments_above_the_header(tmp_path: Path, above: str, fit: str, lines: int) -> None:
    """As written, as a spreadsheet saves them again, and of any other kind; rows keep their lines."""
    read = table(tmp_path, f"{above}a,x_mm\n1,2.5\n3,nan\n")
    assert (read.fit, read.frame.columns, len(read)) == (fit, ["a", "x_mm"], 2)
    refused(read.floats, "x_mm", names=(f"data.csv: row 2 (line {lines + 3}), column x_mm",))


def test_cells_that_are_not_finite_numbers_and_columns_that_are_not_there(tmp_path: Path) -> None:
    for cell in ("nan", "inf", "-inf", "abc", "1.2.3", "1e999", "0x10", "1_000", "--1", ""):
        read, shown = table(tmp_path, f"a,x_mm\n1,1.5\n\n1,{cell}\n"), repr(cell) if cell else "an empty cell"
        place = "data.csv: row 2 (line 4), column x_mm"
        refused(read.floats, "x_mm", names=(place, f"found {shown}", "allowed: a finite number"))
    refused(read.floats, "a", "> 1", lambda v: v > 1, names=("row 1 (line 2), column a", "'1'", "allowed: > 1"))
    read = table(tmp_path, 'x_mm,y_mm,z_mn\n1.5,2,0\n3,"4,25",0\n')
    refused(read.floats, "z_mm", names=("data.csv", "'z_mm' is missing", "did you mean to rename 'z_mn'?", "x_mm"))
    refused(read.floats, "y_mm", names=("row 2 (line 3), column y_mm", "found '4,25'"))
    read = table(tmp_path, "a;b\n1;2\n3;4,5,6\n")
    refused(read.floats, "b", names=("row 2 (line 3), column b", "found '4,5,6'"))


@settings(max_examples=30)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=20))
def test_floats_are_read_exactly(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    read = table(tmp_path_factory.mktemp("table"), "a\n" + "\n".join(map(repr, values)) + "\n")
    np.testing.assert_array_equal(read.floats("a"), values)
