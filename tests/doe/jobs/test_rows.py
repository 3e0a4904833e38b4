"""Row tables: nothing finished is lost, nothing is overwritten unasked, floats survive to the bit."""

from __future__ import annotations

import math
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doe import jobs
from doe.jobs import RowTable, canonical, frame_of
from identification import InputError


def fill(path: Path, tasks: range, **how: bool) -> None:
    with RowTable(path, **how) as table:
        for task in tasks:
            table.add(f"{task}", [{"task": task, "value": task / 3.0}])


def test_a_table_is_one_file_that_is_refused_resumed_or_replaced(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    fill(path, range(2))
    assert [f.name for f in tmp_path.iterdir()] == ["rows.parquet"]
    assert pl.read_parquet(path)["value"].to_list() == [0.0, 1.0 / 3.0]
    with pytest.raises(InputError, match="--resume"):
        RowTable(path)
    assert [f.name for f in tmp_path.iterdir()] == ["rows.parquet"]
    fill(path, range(2, 5), resume=True)
    assert pl.read_parquet(path)["task"].to_list() == [0, 1, 2, 3, 4]
    with RowTable(path, force=True) as table:
        assert not path.exists()  # what is replaced does not come back when the new run is killed
        table.add("4", [{"task": 4}])
    assert pl.read_parquet(path)["task"].to_list() == [4]


def test_rows_of_a_killed_process_are_there(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    table = RowTable(path)
    for k in range(3):
        table.add(f"{k}", [{"value": k / 3.0}])
    table._open.write(b'["{}", [{"val')  # torn in mid-line
    table._open.close()
    with pytest.raises(InputError, match="journal: exists"):
        RowTable(path)
    with RowTable(path, resume=True) as table:
        assert list(table.rows) == ["0", "1", "2"]
        table.add("3", [{"value": 1.0}])
    assert pl.read_parquet(path)["value"].to_list() == [0.0, 1 / 3, 2 / 3, 1.0]


@pytest.mark.parametrize("where", ["work", "table"])
def test_ctrl_c_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """During the work the table is closed; while it is written the journal remains."""
    path, name = tmp_path / "rows.parquet", "rows.parquet" if where == "work" else "rows.parquet.journal"
    if where == "table":
        monkeypatch.setattr(jobs, "parquet", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt), RowTable(path) as table:  # noqa: PT012
        table.add("0", [{"value": 1}])
        if where == "work":
            raise KeyboardInterrupt
    assert [f.name for f in tmp_path.iterdir()] == [name]
    monkeypatch.undo()
    with RowTable(path, resume=True) as table:
        assert table.rows["0"] == [{"key": "0", "value": 1}]


def test_bad_places_and_foreign_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("no")
    pl.DataFrame({"x": [1]}).write_parquet(tmp_path / "b.parquet")
    places = {
        "missing/there/rows.parquet": "allowed",
        ".": "allowed",
        "a.parquet": "not a Parquet",
        "b.parquet": "column 'key'",
    }
    for name, said in places.items():
        with pytest.raises(InputError, match=said):
            RowTable(tmp_path / name, resume=True)
    assert len(list(tmp_path.iterdir())) == 2  # and no journal


def test_a_table_without_a_finished_task_leaves_nothing(tmp_path: Path) -> None:
    """Of a folder that it made, that is; what is in one stays."""
    for folder in (tmp_path / "new", tmp_path):
        with RowTable(folder / "rows.parquet") as table:
            table.add("0", [{"status": "failed"}])
        assert not list(tmp_path.iterdir())


@given(st.dictionaries(st.text(), st.integers() | st.text() | st.booleans() | st.none()))
def test_canonical_ignores_the_order(key: dict[str, object]) -> None:
    assert canonical(key) == canonical(dict(reversed(key.items())))


def test_columns_are_the_union_of_the_rows() -> None:
    frame = frame_of([{"a": 1, "b": "x"}, {"a": 2.5, "c": [1.0, 2.0]}, {"a": math.inf, "error": None}])
    assert frame["a"].to_list() == [1.0, 2.5, math.inf]
    assert frame["b"].to_list() == ["x", None, None]
    assert frame["c"].to_list() == [None, [1.0, 2.0], None]


def test_floats_survive_open_and_parquet(tmp_path: Path) -> None:
    values = np.random.default_rng(1).standard_normal(200) * 10.0 ** np.arange(-100, 100)
    path = tmp_path / "rows.parquet"
    table = RowTable(path)
    table.add("0", [{"value": float(v)} for v in values])
    table._open.close()  # as a killed process leaves it
    for _ in range(2):
        with RowTable(path, resume=True) as again:
            assert [row["value"] for row in again.rows["0"]] == values.tolist()
    assert not table.journal.exists()
