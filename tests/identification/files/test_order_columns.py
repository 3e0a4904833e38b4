"""Rows struck out of a file: what the order says of the rows that are left is what it said before, or unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification.effects.catalogue import entry
from identification.errors import InputError
from identification.files.measurement import measurement_text
from identification.gap.library_prior import given_by
from identification.inspection.readings import gap_notes
from identification.measurements import Measurements, load_measurements
from identification.sessions import pooled_sessions

M = 30
Q = np.random.default_rng(41).integers(-4, 5, (M, 3)) * 0.25  # few values, so that joints often rest
WHOLE = Measurements(Q, np.zeros((M, 2)), order=np.arange(1.0, M + 1.0))
OUT = [4, 5, 11, 20]


def saved(data: Measurements, folder: Path) -> Measurements:
    path = folder / "data.csv"
    path.write_text(measurement_text(data))
    return load_measurements(path)


def struck(folder: Path, out: list[int] = OUT) -> Measurements:
    """Without some rows, as a user strikes them out of a file."""
    lines = measurement_text(WHOLE).splitlines()
    (folder / "struck.csv").write_text("\n".join(line for k, line in enumerate(lines) if k - 1 not in out))
    return load_measurements(folder / "struck.csv")


def expected(out: list[int]) -> np.ndarray:
    """Sign of each joint's last motion as far as rows that follow each other show it, row after row."""
    signs = np.ones((M, 3))
    for k in range(1, M):
        step = np.sign(Q[k] - Q[k - 1])
        signs[k] = np.where(step != 0.0, step, signs[k - 1])
        if k - 1 in out:
            signs[k] = 0.0
    return np.delete(signs, out, axis=0)


def test_directions_are_unknown_after_a_gap(tmp_path: Path) -> None:
    assert WHOLE.gaps is None
    data = struck(tmp_path)
    assert data.gaps is not None
    assert (np.flatnonzero(data.gaps) + 1).tolist() == [5, 10, 18]  # rows 7, 13 and 22 of the whole
    found = data.conditions.directions
    np.testing.assert_array_equal(found, expected(OUT))
    moved = found != 0.0
    assert moved.mean() > 0.8
    whole = np.delete(WHOLE.conditions.directions, OUT, axis=0)
    np.testing.assert_array_equal(found[moved], whole[moved])


def test_what_joints_remember_begins_anew_after_a_gap(tmp_path: Path) -> None:
    data = struck(tmp_path)
    past = np.asarray(data.conditions.past)
    later = data.rows(slice(17, None))
    alone = replace(later, directions=None, past=None)
    np.testing.assert_array_equal(past[17:], alone.conditions.past)
    np.testing.assert_array_equal(past[17], np.repeat(data.postures[17][:, None], past.shape[2], axis=1))


def test_files_with_gaps_go_round(tmp_path: Path) -> None:
    data = struck(tmp_path)
    assert "time_s" not in measurement_text(data)
    np.testing.assert_array_equal(saved(data, tmp_path).conditions.directions, data.conditions.directions)
    some = data.rows([3, 5, 9])  # with directions of their own, unknown ones among them
    for again in (saved(some, tmp_path), Measurements.from_frame(some.to_frame())):
        np.testing.assert_array_equal(again.conditions.directions, some.conditions.directions)
    assert 0.0 in some.conditions.directions
    stamps = replace(WHOLE, order=10.0 * np.arange(M))  # seconds, in whole numbers
    assert saved(stamps, tmp_path).gaps is None
    both = saved(replace(stamps, gaps=np.arange(M) == 7), tmp_path)
    np.testing.assert_array_equal(np.flatnonzero(both.gaps), [7])
    np.testing.assert_array_equal(both.order, stamps.order)


def test_gaps_are_those_of_each_session(tmp_path: Path) -> None:
    """Each session counts on where another stopped, or anew: neither is a gap."""
    two = replace(WHOLE, session=np.array(["b"] * 12 + ["a"] * 18))
    assert saved(two, tmp_path).gaps is None
    anew = np.r_[np.arange(12.0), np.arange(18.0)]
    assert saved(replace(two, order=anew), tmp_path).gaps is None
    together = pooled_sessions({"whole": WHOLE, "struck": struck(tmp_path)})
    assert together.gaps is not None
    assert (np.flatnonzero(together.gaps) + 1).tolist() == [M + 5, M + 10, M + 18]


def test_numbers_that_are_left_out_nearly_everywhere_do_not_count(tmp_path: Path) -> None:
    """Every second row, by frame numbers of the instrument: the row before is the one before."""
    thinned = struck(tmp_path, list(range(1, M, 2)))
    assert thinned.gaps is None
    alone = replace(thinned, order=None)
    np.testing.assert_array_equal(thinned.conditions.directions, alone.conditions.directions)
    half = struck(tmp_path, [k for k in range(1, M) if k % 4 == 1])  # 7 of 22 rows: these count
    assert half.gaps is not None


def test_effects_that_need_the_row_before_are_not_looked_for_without_it() -> None:
    thinned = replace(WHOLE.rows(slice(None, None, 2)), directions=None, past=None, gaps=np.r_[0.0, np.ones(14)])
    assert not thinned.conditions.follow
    needs = {*entry("backlash").needs, *entry("joint_hysteresis").needs}
    assert given_by(WHOLE) >= needs
    assert not given_by(thinned) & needs
    (note,) = gap_notes(thinned)
    assert note.startswith("before 14 of 15 rows numbers of order are left out")
    assert gap_notes(WHOLE) == []


def test_a_file_may_say_that_a_direction_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_text("q1_deg,x_mm,y_mm,direction1\n1,2,3,\n4,5,6,-1\n")
    assert load_measurements(tmp_path / "data.csv").conditions.directions.tolist() == [[0.0], [-1.0]]
    (tmp_path / "data.csv").write_text("q1_deg,x_mm,y_mm,direction1\n1,2,3,0\n")
    with pytest.raises(InputError, match=r"allowed: \+1 or -1, empty: unknown"):
        load_measurements(tmp_path / "data.csv")
