"""Tables of rows: nothing finished is lost, nothing is overwritten unasked, floats survive to the bit."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import jobs
from doe.jobs import canonical, frame_of, parquet, run_tasks
from identification import InputError

sys.path.insert(0, str(Path(__file__).parent))
import work

KEYS = [{"task": task, "setting": "a"} for task in range(12)]


def test_a_table_is_one_file_that_is_refused_resumed_or_replaced(tmp_path: Path) -> None:
    path, asked = tmp_path / "job" / "rows.parquet", list[object]()
    first = run_tasks(work.draw, KEYS[:2], path, seed=5)
    with pytest.raises(InputError, match="--resume"):
        run_tasks(work.draw, KEYS[:2], path, seed=5)
    with pytest.raises(InputError, match="--seed 5, found 6"):
        run_tasks(work.draw, KEYS, path, seed=6, resume=True)
    more = run_tasks(work.draw, KEYS[:3], path, seed=5, resume=True, payload=asked.append)
    assert more.head(len(first)).equals(first.select(more.columns))
    assert asked == [KEYS[2]]
    assert more["value"].to_list() == pl.read_parquet(path)["value"].to_list() == work.drawn(KEYS[:3], seed=5)
    run_tasks(work.draw, KEYS[4:5], path, force=True, progress=lambda *_: asked.append(path.exists()))
    assert asked[1:] == [False, False]  # what is replaced does not come back when the new run is killed
    assert pl.read_parquet(path)["task"].to_list() == [4, 4]
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("writing", [False, True])
def test_ctrl_c_keeps_what_is_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writing: bool) -> None:
    """While a task runs; a second one while the table is written leaves no half of it."""
    path, run = tmp_path / "rows.parquet", lambda **how: run_tasks(work.stop_at_three, KEYS, path, **how)
    if writing:
        monkeypatch.setattr(jobs, "parquet", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(payload=lambda _: "interrupt")
    monkeypatch.undo()
    assert len([*tmp_path.iterdir()]) == (0 if writing else 1)
    seen = list[float]()
    frame = run(payload=lambda _: "", resume=True, progress=lambda done, *_: seen.append(done))
    assert seen == [*range(0 if writing else 3, 13)]
    assert frame["value"].to_list() == work.drawn(KEYS)


def test_bad_places_and_foreign_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("no")
    pl.DataFrame({"x": [1]}).write_parquet(tmp_path / "b.parquet")
    places = {"missing/there/rows.parquet": "no folder", ".": "allowed", "a.parquet": "not a Parquet"}
    for name, reason in {**places, "b.parquet": "column 'key'"}.items():
        with pytest.raises(InputError, match=reason):
            run_tasks(work.draw, KEYS, tmp_path / name, resume=True)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_table_without_a_finished_task_leaves_nothing(tmp_path: Path) -> None:
    for folder in (tmp_path / "new", tmp_path):
        run_tasks(work.stop_at_three, [KEYS[3]], folder / "rows.parquet", payload=lambda _: "raises")
        assert not list(tmp_path.iterdir())


@given(st.dictionaries(st.text(), st.integers() | st.text() | st.booleans() | st.none()))
def test_canonical_ignores_the_order(key: dict[str, object]) -> None:
    assert canonical(key) == canonical(dict(reversed(key.items())))


def test_columns_are_the_union_of_the_rows() -> None:
    frame = frame_of([{"a": 1, "b": "x"}, {"a": 2.5, "c": [1.0, 2.0]}, {"a": math.inf, "error": None}])
    assert frame["a"].to_list() == [1.0, 2.5, math.inf]
    assert frame["b"].to_list() == ["x", None, None]
    assert frame["c"].to_list() == [None, [1.0, 2.0], None]


def test_floats_survive(tmp_path: Path) -> None:
    values = (np.random.default_rng(1).standard_normal(200) * 10.0 ** np.arange(-100, 100)).tolist()
    (tmp_path / "rows").write_bytes(parquet(frame_of([{"value": value} for value in values])))
    assert pl.read_parquet(tmp_path / "rows")["value"].to_list() == values


@given(done=st.sets(st.integers(0, 11)), again=st.sets(st.integers(0, 11)))
@settings(max_examples=20)
def test_wherever_it_stopped_the_bytes_are_those_of_one_run(
    done: set[int], again: set[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Finished in any order by two earlier runs."""
    folder = tmp_path_factory.mktemp("rows")
    for part in (done, again):
        run_tasks(work.mixed, [KEYS[k] for k in sorted(part, reverse=True)], folder / "parts", resume=True)
    for name in ("parts", "whole"):
        run_tasks(work.mixed, KEYS, folder / name, resume=True)
    parts, whole = (parquet(pl.read_parquet(folder / name).drop("seconds")) for name in ("parts", "whole"))
    assert parts == whole
