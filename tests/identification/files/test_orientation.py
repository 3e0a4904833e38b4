"""Orientation columns: angles, radians, quaternions, and what is said of others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification.errors import InputError
from identification.files.csv import read_table
from identification.files.measurement import angle_columns, orientation_columns, read_orientations
from identification.kinematics.frames import from_own_axes

ANGLES = np.array([[10.0, -20.0, 30.0], [0.0, 45.0, 170.0]])
MATRICES = [from_own_axes(*row) for row in np.radians(ANGLES)]


def table(folder: Path, header: str, rows: list[str]):  # type: ignore[no-untyped-def]
    (folder / "data.csv").write_text("\n".join([header, *rows]) + "\n")
    return read_table(folder / "data.csv")


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_angles(tmp_path: Path, unit: str) -> None:
    rows = [",".join(map(repr, row)) for row in (ANGLES if unit == "deg" else np.radians(ANGLES)).tolist()]
    read = table(tmp_path, f"rx_{unit},ry_{unit},rz_{unit}", rows)
    found = read_orientations(read)
    assert found is not None
    np.testing.assert_allclose(found, MATRICES, atol=1e-14)
    assert orientation_columns(read) == [f"r{axis}_{unit}" for axis in "xyz"]
    written = angle_columns(found)
    np.testing.assert_allclose(np.column_stack([written[f"r{axis}_deg"] for axis in "xyz"]), ANGLES, atol=1e-11)


def test_quaternions(tmp_path: Path) -> None:
    """Of a quarter turn about z, to three digits as some trackers write it."""
    found = read_orientations(table(tmp_path, "qw,qx,qy,qz", ["0.707,0,0,0.707"]))
    assert found is not None
    np.testing.assert_allclose(found[0], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


def test_none(tmp_path: Path) -> None:
    assert read_orientations(table(tmp_path, "x_mm", ["1"])) is None


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        ("rx_deg,ry_deg", "1,2", "column 'rz_deg' is missing"),
        ("rx_deg,ry_rad,rz_deg", "1,2,3", "found rx_deg, ry_rad, rz_deg, allowed: three angles of one unit"),
        ("rx_deg,ry_deg,rz_deg,qw", "1,2,3,1", "allowed: three angles of one unit, or a quaternion"),
        ("qw,qx,qy", "1,0,0", "column 'qz' is missing"),
        ("qw,qx,qy,qz", "2,0,0,0", "row 1 (line 2), column qw..qz: found a quaternion of length 2, allowed: length 1"),
        (
            "rx_deg,ry_deg,rz_deg",
            "1,,3",
            "row 1 (line 2), column ry_deg: found an empty cell, allowed: a finite angle, up to 1e+06",
        ),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, header: str, row: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_orientations(table(tmp_path, header, [row]))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
