"""Row tables: nothing finished is lost, nothing is overwritten unasked, floats survive to the bit."""

from __future__ import annotations

import math
import subprocess
import sys
from contextlib import suppress
from io import FileIO
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doe.jobs import rows as row_table
from doe.jobs.rows import RowTable, canonical, frame_of, journal_of, read_rows
from identification.errors import InputError, JobError

KEYS = [{"task": k} for k in range(5)]


def fill(path: Path, keys: list[dict[str, int]], **how: bool) -> None:
    with RowTable.open(path, **how) as table:
        for key in keys:
            table.add(key, [{**key, "value": key["task"] / 3.0}])


def test_finished_table_is_one_parquet_file(tmp_path: Path) -> None:
    fill(tmp_path / "rows.parquet", KEYS)
    assert [f.name for f in tmp_path.iterdir()] == ["rows.parquet"]
    assert pl.read_parquet(tmp_path / "rows.parquet")["value"].to_list() == [k / 3.0 for k in range(5)]


def test_existing_table_is_refused_resumed_or_replaced(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    fill(path, KEYS[:2])
    with pytest.raises(InputError, match="--resume"), RowTable.open(path):
        pass
    fill(path, KEYS[2:], resume=True)
    assert read_rows(path)["task"].to_list() == [0, 1, 2, 3, 4]
    fill(path, KEYS[3:], force=True)
    assert read_rows(path)["task"].to_list() == [3, 4]


def test_rows_of_a_killed_process_are_there(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    code = (
        "import os, signal, sys\nfrom doe.jobs.rows import RowTable\n"
        f"with RowTable.open({str(path)!r}) as table:\n"
        "    for k in range(3): table.add({'task': k}, [{'value': k / 3.0}])\n"
        '    table._journal.write(b\'["{}", [{"val\'); table._journal.flush()\n'  # torn in mid-line
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3], check=False).returncode == -9
    assert not path.exists()
    assert read_rows(path)["value"].to_list() == [0.0, 1 / 3, 2 / 3]
    with pytest.raises(InputError, match="journal: exists"), RowTable.open(path):
        pass
    with RowTable.open(path, resume=True) as table:
        assert [{"task": k} in table for k in range(4)] == [True, True, True, False]
        table.add({"task": 3}, [{"value": 1.0}])
    assert pl.read_parquet(path)["value"].to_list() == [0.0, 1 / 3, 2 / 3, 1.0]


def test_rows_are_kept_when_the_work_raises(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    with suppress(KeyboardInterrupt), RowTable.open(path) as table:
        table.add({"task": 0}, [{"value": 1}])
        raise KeyboardInterrupt
    assert read_rows(path)["value"].to_list() == [1]
    assert not journal_of(path).exists()


def test_ctrl_c_while_the_table_is_written_leaves_it_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows are in the Parquet file, no journal is left, and the signal ends the command."""
    parquet, came = row_table.parquet, iter([True])

    def interrupted(frame: pl.DataFrame) -> bytes:
        if next(came, False):
            raise KeyboardInterrupt
        return parquet(frame)

    monkeypatch.setattr(row_table, "parquet", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path / "rows.parquet", KEYS)
    assert [f.name for f in tmp_path.iterdir()] == ["rows.parquet"]
    assert pl.read_parquet(tmp_path / "rows.parquet")["task"].to_list() == list(range(5))


def test_two_writers_are_refused(tmp_path: Path) -> None:
    with (
        RowTable.open(tmp_path / "rows.parquet"),
        pytest.raises(InputError, match="another run"),
        RowTable.open(tmp_path / "rows.parquet", resume=True),
    ):
        pass


def test_a_run_that_waited_for_another_does_not_write_into_its_removed_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first opens the journal, the second ends and removes it, the first gets the lock."""
    path, opened = tmp_path / "rows.parquet", row_table._opened

    def late(journal: Path) -> object:
        stream = opened(journal)
        monkeypatch.setattr(row_table, "_opened", opened)
        journal.unlink()
        return stream

    monkeypatch.setattr(row_table, "_opened", late)
    with RowTable.open(path) as table:
        table.add(KEYS[0], [{"value": 1}])
        assert read_rows(path)["value"].to_list() == [1]


def test_replaced_rows_do_not_come_back_when_the_new_run_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    fill(path, KEYS[:3])
    with RowTable.open(path, force=True) as table:
        table.add(KEYS[4], [{"task": 4}])
        assert read_rows(path)["task"].to_list() == [4]


def test_a_full_disk_is_one_line_and_keeps_the_rows_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "rows.parquet"

    def torn(table: RowTable, line: bytes, journal: FileIO) -> None:
        journal.write(line[:7])
        raise OSError(28, "No space left on device")

    with RowTable.open(path) as table:
        table.add(KEYS[0], [{"value": 1}])
        table._finish = lambda: None  # type: ignore[method-assign]  # no space for the table either
        monkeypatch.setattr(RowTable, "_append", torn)
        with pytest.raises(JobError, match=r"journal: cannot be written \(No space.*--resume"):
            table.add(KEYS[1], [{"value": 2}])
    assert read_rows(path)["value"].to_list() == [1]


@pytest.mark.parametrize("path", ["missing/rows.parquet", "."])
def test_bad_place_is_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(InputError, match="allowed"), RowTable.open(tmp_path / path):
        pass


def test_foreign_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("no")
    pl.DataFrame({"x": [1]}).write_parquet(tmp_path / "b.parquet")
    for name, found in (("a", "not a Parquet file"), ("b", "no column")):
        with pytest.raises(InputError, match=found), RowTable.open(tmp_path / f"{name}.parquet", resume=True):
            pass
    assert len(list(tmp_path.iterdir())) == 2  # and no journal
    with pytest.raises(InputError, match="no such table"):
        read_rows(tmp_path / "c.parquet")


@given(st.dictionaries(st.text(), st.integers() | st.text() | st.booleans() | st.none()))
def test_canonical_ignores_the_order(key: dict[str, object]) -> None:
    assert canonical(key) == canonical(dict(reversed(key.items())))


def test_columns_are_the_union_of_the_rows() -> None:
    frame = frame_of([{"a": 1, "b": "x"}, {"a": 2.5, "c": [1.0, 2.0]}, {"a": math.inf, "error": None}])
    assert frame["a"].to_list() == [1.0, 2.5, math.inf]
    assert frame["b"].to_list() == ["x", None, None]
    assert frame["c"].to_list() == [None, [1.0, 2.0], None]


def test_floats_survive_journal_and_parquet(tmp_path: Path) -> None:
    values = np.random.default_rng(1).standard_normal(200) * 10.0 ** np.arange(-100, 100)
    path = tmp_path / "rows.parquet"
    with RowTable.open(path) as table:
        table.add({"task": 0}, [{"value": float(v)} for v in values])
        assert np.array_equal(read_rows(path)["value"].to_numpy(), values)
    assert np.array_equal(read_rows(path)["value"].to_numpy(), values)
