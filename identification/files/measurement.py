"""Measurement files: CSV or Parquet in millimetres and degrees <-> `Measurements` in millimetres and radians."""

from __future__ import annotations

from typing import TYPE_CHECKING

from identification.arm import Arm
from identification.files.csv import read_table
from identification.files.io import PathLike
from identification.files.measurement_columns import JointTypes, csv_text, measurement_columns, measurement_fields
from identification.measurements import Measurements

if TYPE_CHECKING:
    from identification.instruments import Instrument


def load_measurements(path: PathLike, links: int | Arm | None = None) -> Measurements:
    """The measurements of a CSV or Parquet file, of an arm with `links` links if given.

    links : or the arm itself: a spatial one has positions of three coordinates, markers, and may have sliding joints

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    return Measurements(**measurement_fields(read_table(path), links))


def measurement_text(
    measurements: Measurements, joint_types: JointTypes = None, instrument: Instrument | None = None
) -> str:
    """The text of a measurement file; `load_measurements` reads the same from it, to rounding (1e-14 rad).

    instrument : that measured; None: one of positions or lengths
    """
    return csv_text(measurement_columns(measurements, joint_types, instrument), measurements.fit)
