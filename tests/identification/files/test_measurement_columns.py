"""Measurements from data frames and Parquet files, against the same table as CSV; frames of results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from identification.errors import InputError
from identification.files.csv import table_of_frame
from identification.files.measurement import measurement_text
from identification.measurements import Measurements, load_measurements

M = 7


def measured() -> Measurements:
    generator = np.random.default_rng(1)
    return Measurements(
        generator.uniform(-3.0, 3.0, (M, 2)),
        generator.uniform(-300.0, 300.0, (M, 2)),
        order=np.arange(M, dtype=float),
        temperature=20.0 + generator.random(M),
        session=np.array(["monday"] * 4 + ["friday"] * 3),
        repeats=np.array([1, 1, 2, 3, 4, 5, 6]),
    )


class PandasLike:
    """What `from_frame` needs of a pandas frame: names, and columns with numpy's types."""

    def __init__(self, frame: pl.DataFrame) -> None:
        self.columns = np.array(frame.columns, dtype=object)
        self._frame = frame

    def __getitem__(self, name: str) -> np.ndarray:
        return self._frame[name].to_numpy()


def assert_same(found: Measurements, wanted: Measurements) -> None:
    np.testing.assert_allclose(found.postures, wanted.postures, rtol=0, atol=1e-14)
    for name in ("positions", "order", "temperature", "session", "repeats"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_frames_go_round() -> None:
    wanted = measured()
    frame = wanted.to_frame()
    assert frame.columns[:4] == ["q1_deg", "q2_deg", "x_mm", "y_mm"]
    assert frame.height == M
    assert_same(Measurements.from_frame(frame), wanted)
    assert_same(Measurements.from_frame(PandasLike(frame)), wanted)
    assert_same(Measurements.from_frame(frame.to_dict(as_series=False)), wanted)
    assert "q1_deg" in wanted._repr_html_()


def test_pandas_where_it_is_installed() -> None:
    pandas = pytest.importorskip("pandas")
    frame = measured().to_frame("pandas")
    assert isinstance(frame, pandas.DataFrame)
    assert_same(Measurements.from_frame(frame), measured())


def test_parquet_is_read_as_the_same_csv(tmp_path: Path) -> None:
    wanted = measured()
    (tmp_path / "data.csv").write_text(measurement_text(wanted))
    wanted.to_frame().write_parquet(tmp_path / "data.parquet")
    text, binary = (load_measurements(tmp_path / f"data.{kind}", 2) for kind in ("csv", "parquet"))
    assert_same(binary, text)
    assert binary.provenance["file"] == "data.parquet"
    assert binary.provenance["sha256"] != text.provenance["sha256"]
    (tmp_path / "half.parquet").write_bytes((tmp_path / "data.parquet").read_bytes()[:200])
    with pytest.raises(InputError, match=r"half.parquet: not a whole Parquet file, allowed: CSV or Parquet"):
        load_measurements(tmp_path / "half.parquet")


def test_errors_name_row_and_column() -> None:
    frame = measured().to_frame()
    hole = frame.with_columns(pl.when(pl.int_range(M) == 2).then(None).otherwise(pl.col("x_mm")).alias("x_mm"))
    with pytest.raises(InputError, match=r"frame: row 3, column x_mm: found an empty cell"):
        Measurements.from_frame(hole)
    nan = frame.with_columns(pl.when(pl.int_range(M) == 1).then(float("inf")).otherwise(pl.col("y_mm")).alias("y_mm"))
    with pytest.raises(InputError, match=r"frame: row 2, column y_mm: found 'inf'"):
        Measurements.from_frame(nan)
    with pytest.raises(InputError, match="column 'y_mm' is missing"):
        Measurements.from_frame(frame.drop("y_mm"))
    with pytest.raises(InputError, match="frame: int, allowed: a data frame"):
        table_of_frame(3)
    with pytest.raises(InputError, match="there are no rows"):
        Measurements.from_frame(frame.head(0))
    with pytest.raises(InputError, match="columns of different lengths"):
        table_of_frame({"a": [1, 2], "b": [1]})
