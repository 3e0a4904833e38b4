"""Files are written whole or not at all; every complaint is one line with the file, the place and what is allowed."""

from __future__ import annotations

import hashlib
import os
import tomllib
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.errors import InputError
from identification.files import io as files
from identification.files.csv import read_table


def message_of(call, *arguments) -> str:
    """The one-line message of the `InputError` that the call raises."""
    with pytest.raises(InputError) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    return message


def names(message: str, *parts: str) -> None:
    """The message has every part."""
    missing = [part for part in parts if part not in message]
    assert not missing, f"{missing} not in {message!r}"


# -- writing -----------------------------------------------------------------------------------------------------------
def test_write_whole_writes_and_leaves_nothing_else(tmp_path: Path) -> None:
    files.write_together({tmp_path / "a.csv": "ä\n"})
    assert (tmp_path / "a.csv").read_bytes() == "ä\n".encode()
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_existing_file_needs_force_and_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("old")
    path.chmod(0o640)
    names(message_of(files.write_together, {path: "new"}), "a.csv", "exists", "--force")
    assert path.read_text() == "old"
    files.write_together({path: b"new"}, force=True)
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640


def test_bad_targets(tmp_path: Path) -> None:
    names(message_of(files.write_together, {tmp_path / "no" / "a.csv": ""}), "a.csv", "there is no folder", "allowed")
    names(message_of(files.write_together, {tmp_path: ""}, True), "is a directory", "allowed")
    names(message_of(files.check_writable, tmp_path / "no" / "a.csv"), "there is no folder")
    files.check_writable(None)
    files.check_writable(tmp_path / "a.csv")
    assert not list(tmp_path.iterdir())


def test_write_together_is_all_or_none(tmp_path: Path) -> None:
    (tmp_path / "b").write_text("old")
    both = {tmp_path / "a": "1", tmp_path / "b": "2"}
    names(message_of(files.write_together, both), "b: the file exists")
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    files.write_together(both, force=True)
    assert [(tmp_path / name).read_text() for name in "ab"] == ["1", "2"]


@pytest.mark.parametrize("stop", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_what_was_replaced_is_put_back_when_the_next_cannot_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: BaseException
) -> None:
    (tmp_path / "a").write_text("old")
    place, seen = files._place, []

    def third(new: Path, target: Path, *, fresh: bool) -> None:
        seen.append(target.name)
        if len(seen) == 3:
            raise stop
        place(new, target, fresh=fresh)

    monkeypatch.setattr(files, "_place", third)
    with pytest.raises((InputError, KeyboardInterrupt)):
        files.write_together({tmp_path / name: "new" for name in "abc"}, force=True)
    assert seen == ["a", "b", "c"]
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "old"}


def test_a_file_that_another_command_wrote_meanwhile_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    new = files._write_new

    def late(path: Path, content: str | bytes, mode_of: Path) -> None:
        new(path, content, mode_of)
        (tmp_path / "b").write_text("theirs")

    monkeypatch.setattr(files, "_write_new", late)
    both = {tmp_path / "a": "1", tmp_path / "b": "2"}
    names(message_of(files.write_together, both), "b: the file exists", "--force")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"b": "theirs"}


@pytest.mark.parametrize("lacking", ["_unnamed", "link"])
def test_file_systems_without_nameless_files_or_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacking: str
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(files, "_unnamed", lambda _: None)
    if lacking == "link":
        monkeypatch.setattr(files.os, "link", refused)
    files.write_together({tmp_path / "a": "1"})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "1"}


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    names(message_of(files.write_together, {path: "new"}, True), "a: cannot be written", "No space left")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


# -- TOML --------------------------------------------------------------------------------------------------------------
def test_a_long_key_takes_no_memory(tmp_path: Path) -> None:
    """The standard library's parser keeps every prefix of a dotted key: 100 kB of it took 8.7 GB."""
    (tmp_path / "a.toml").write_text(".".join(["a"] * 50000) + " = 1\n")
    tracemalloc.start()
    try:
        message_of(files.read_toml, tmp_path / "a.toml")
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


def test_keys_of_some_parts_and_texts_with_points_are_read(tmp_path: Path) -> None:
    text = 'a.b."c.d".e = 1\n[x.y]\nz = "' + "1.2, " * 500 + '"\nw = [' + "0.1, 1.5e-3, " * 500 + "]\n"
    (tmp_path / "a.toml").write_text(text)
    assert files.read_toml(tmp_path / "a.toml") == tomllib.loads(text)


@pytest.mark.parametrize("unit", ['"\\"', "\"'", "'", '"', 'a"', "\\", "a ", "a.", '"a"."', " .", "-"])
def test_looking_for_long_keys_takes_time_in_proportion(unit: str) -> None:
    """Texts made to be searched again from every place: 300 kB of each in an instant, not in hours."""
    files.TOO_LONG_KEY.search(unit * (300_000 // len(unit)))


def test_read_toml_drops_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert files.read_toml(tmp_path / "a.toml") == {"a": 1}


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b"a = 1\nb = = 2\n", ["line 2, column 5", "not valid TOML", "allowed"]),
        (b"", ["empty"]),
        (b" \n\n", ["empty"]),
        (b"a = 1\nb = '\xff'\n", ["UTF-8", "byte 0xff on line 2"]),
        (b"a = " + b"[" * 5000, ["not valid TOML"]),
        (b"a = " + b"1" * 4301, ["not valid TOML", "a whole number of more than 4300 digits, allowed: TOML 1.0"]),
        (b"[a]\n" + b".".join([b"a"] * 50000) + b" = 1\n", ["line 2", "a key of more than 100 parts", "less nested"]),
        (b"\n[" + b" . ".join([b'"a.b"'] * 20000) + b"]", ["line 2", "a key of more than 100 parts"]),
        (b"a = {" + b".".join([b"'a=b'"] * 20000) + b" = 1}", ["line 1", "a key of more than 100 parts"]),
    ],
)
def test_bad_toml(tmp_path: Path, content: bytes, parts: list[str]) -> None:
    (tmp_path / "a.toml").write_bytes(content)
    names(message_of(files.read_toml, tmp_path / "a.toml"), "a.toml: ", *parts)


def test_missing_file_and_directory(tmp_path: Path) -> None:
    for read in (files.read_toml, read_table):
        names(message_of(read, tmp_path / "no.toml"), "no.toml: no such file", "allowed")
        names(message_of(read, tmp_path), "is a directory", "allowed")


# -- CSV ---------------------------------------------------------------------------------------------------------------
def table(tmp_path: Path, content: str | bytes):
    path = tmp_path / "data.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path)


@pytest.mark.parametrize(
    "content",
    [
        b"a,b\n1,2\n3,4\n",
        b"a,b\n1,2\n3,4",
        b"\xef\xbb\xbfa,b\r\n1,2\r\n3,4\r\n",
        b' a ,"b"\n 1 ,2\n3," 4"\n',
        b"a,b,\n1,2,\n3,4,\n",
        b"a,b\n\n1,2\n\n,\n3,4\n\n",
    ],
)
def test_forms_of_a_csv_file(tmp_path: Path, content: bytes) -> None:
    read = table(tmp_path, content)
    assert read.columns == ("a", "b")
    np.testing.assert_array_equal([read.floats("a"), read.floats("b")], [[1, 3], [2, 4]])
    assert read.sha256 == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    "content",
    [
        "a;b;c\n1,5;-2,25e1;x,y\n0;4;z\n",
        "a\tb\tc\n1.5\t-22.5\tx,y\n0\t4\tz\n",
        "\ufeffa;b;c\r\n\r\n1.5;-22,5;x,y\r\n0;4;z\r\n;;\r\n",
    ],
)
def test_european_columns_have_decimal_commas(tmp_path: Path, content: str) -> None:
    read = table(tmp_path, content)
    np.testing.assert_array_equal([read.floats("a"), read.floats("b")], [[1.5, 0.0], [-22.5, 4.0]])
    assert read.texts("c").tolist() == ["x,y", "z"]
    names(message_of(table(tmp_path, "a;b\n1;2\n3;4,5,6\n").floats, "b"), "row 2 (line 3), column b", "found '4,5,6'")


def test_quoted_decimal_commas_between_commas(tmp_path: Path) -> None:
    """Texts may have commas and points; numbers all have one kind of decimal mark."""
    content = 'x_mm,y_mm,session,note\n"1,5","-22,123","a.1, b",0.5\n0,"4,25e1",c,"1,5"\n'
    read = table(tmp_path, content)
    np.testing.assert_array_equal([read.floats("x_mm"), read.floats("y_mm")], [[1.5, 0.0], [-22.123, 42.5]])
    assert read.texts("session").tolist() == ["a.1, b", "c"]
    mixed = table(tmp_path, 'x_mm,y_mm\n1.5,2\n3,"4,25"\n')
    names(message_of(mixed.floats, "y_mm"), "row 2 (line 3), column y_mm: found '4,25', allowed: a finite number")
    plain = table(tmp_path, 'x_mm,note\n1.5,"1,5"\n')
    assert plain.floats("x_mm").tolist() == [1.5]


def test_commas_that_may_be_of_thousands(tmp_path: Path) -> None:
    said = message_of(table, tmp_path, 'x_mm,y_mm\n"1,500","-22,125"\n')
    names(
        said, "data.csv: found '1,500', a decimal comma or one of thousands", "allowed: decimal points, or semicolons"
    )
    for sure in ("0,500", "1234,500"):  # no thousands are written like that
        read = table(tmp_path, f'x_mm,y_mm\n"1,500","{sure}"\n')
        assert read.floats("y_mm").tolist() == [float(sure.replace(",", "."))]


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("", ["empty"]),
        ("a,b\n", ["no rows", "at least 1 row"]),
        ("a,b\n1,5,2,5\n3,0,4,5\n", ["found 4 cells, allowed: 2, as in the header; with decimal commas separate the"]),
        ("a,b\n1;2\n3;4\n", ["the header is separated by commas, this row by semicolons"]),
        ("a;b\n1,2\n3,4\n", ["the header is separated by semicolons, this row by commas"]),
        ("a\tb\tc\n1;2;3\n", ["the header is separated by tabs, this row by semicolons"]),
        ("a,b\n\n,\n", ["no rows"]),
        ("a,b\n1,2\n3\n4,5\n", ["row 2 (line 3)", "found 1 cells", "allowed: 2"]),
        ("a,b\n1,2\n\n3,4,5\n", ["row 2 (line 4)", "found 3 cells", "allowed: 2"]),
        ("a,b,a\n1,2,3\n", ["column 'a'", "2 times", "allowed: once"]),
        ("a;b\n1,5;2\n3;4;5\n", ["row 2 (line 3)", "found 3 cells", "allowed: 2"]),
        ("1,2\n3,4\n", ["line 1", "'1'", "allowed: the names"]),
        ("\na,b\n1,2\n", ["line 1 is blank", "allowed"]),
        ("# by hand\n# fit: library-prior\n\na,b\n", ["line 3 is blank", "allowed"]),
        ("# by hand\n1,2\n3,4\n", ["line 2", "'1'", "allowed: the names"]),
        ("# by hand\na,b\n1,2\n3\n4,5\n", ["row 2 (line 4)", "found 1 cells", "allowed: 2"]),
        ('# by hand\na,b\n1,"2\n3,4\n', ["row 1 (from line 3)", "unexpected end"]),
        ("# fit: splines\na,b\n1,2\n", ["line 1: fit 'splines'", "allowed: library-prior, or library-prior --missing"]),
        ("# fit:\na,b\n1,2\n", ["line 1: fit ''", "allowed: library-prior"]),
        ("# a,b\n", ["line 2 is blank", "allowed"]),
        ("a,,b\n1,2,3\n", ["column 2 has no name", "allowed"]),
        ("a,b\r1,2\r", ["carriage return", "allowed"]),
        (b"a,b\n1,\xff\n", ["UTF-8", "line 2"]),
        (b"\xff\xfea\x00,\x00b\x00\n\x00", ["UTF-8", "line 1"]),
        ('a,b\n1,"2\n3,4\n', ["row 1 (from line 2)", "unexpected end", "allowed: cells without quotation marks"]),
        ('a,b\n1,2\n3,"6"x\n', ["row 2 (from line 3)"]),
        (f'a,b\n1,"{"6" * 200_000}\n', ["row 1 (from line 2)", "field larger"]),
        ('"a,b\n1,2\n', ["line 1"]),
    ],
)
def test_bad_csv(tmp_path: Path, content: str | bytes, parts: list[str]) -> None:
    names(message_of(table, tmp_path, content), "data.csv: ", *parts)


@pytest.mark.parametrize(
    ("above", "fit", "lines"),
    [
        ("", "", 0),
        ("# by hand\n", "", 1),
        ("# fit: library-prior\n", "library-prior", 1),
        ("\ufeff# fit: library-prior\r\n", "library-prior", 1),
        ("#fit:library-prior\n# by hand, on Monday\n", "library-prior", 2),
        ("# fit: library-prior --missing backlash,gear_ratio\n", "library-prior --missing backlash,gear_ratio", 1),
        ('"# fit: library-prior --missing backlash,gear_ratio",\n', "library-prior --missing backlash,gear_ratio", 1),
        ("# fit: library-prior,,\n", "library-prior", 1),
    ],
)
def test_comments_above_the_header(tmp_path: Path, above: str, fit: str, lines: int) -> None:
    """As written, as a spreadsheet saves them again, and of any other kind; rows keep their lines."""
    read = table(tmp_path, f"{above}a,x_mm\n1,2.5\n3,nan\n")
    assert (read.fit, read.columns, len(read)) == (fit, ("a", "x_mm"), 2)
    names(message_of(read.floats, "x_mm"), f"data.csv: row 2 (line {lines + 3}), column x_mm")


@pytest.mark.parametrize("cell", ["nan", "inf", "-inf", "abc", "1.2.3", "1e999", "0x10", "1_000", "--1", ""])
def test_cells_that_are_not_finite_numbers(tmp_path: Path, cell: str) -> None:
    read, shown = table(tmp_path, f"a,x_mm\n1,1.5\n\n1,{cell}\n"), repr(cell) if cell else "an empty cell"
    place = "data.csv: row 2 (line 4), column x_mm"
    names(message_of(read.floats, "x_mm"), place, f"found {shown}", "allowed: a finite number")
    names(message_of(read.floats, "a", "> 1", lambda v: v > 1), "row 1 (line 2), column a", "'1'", "allowed: > 1")


def test_missing_column_names_the_nearest(tmp_path: Path) -> None:
    read = table(tmp_path, "q1_deg,x_mn\n1,2\n")
    names(message_of(read.floats, "x_mm"), "data.csv", "'x_mm' is missing", "did you mean to rename 'x_mn'?", "q1_deg")


@settings(max_examples=30)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=20))
def test_floats_are_read_exactly(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    path = tmp_path_factory.mktemp("table") / "data.csv"
    path.write_text("a\n" + "\n".join(map(repr, values)) + "\n")
    np.testing.assert_array_equal(read_table(path).floats("a"), values)


def test_a_read_only_folder_is_found_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # who runs the tests may be root, whom no mode bits stop
    monkeypatch.setattr(os, "access", lambda path, mode: not (path == tmp_path.resolve() and mode == os.W_OK))
    with pytest.raises(InputError, match="cannot be written to"):
        files.check_writable(tmp_path / "plan.csv")
