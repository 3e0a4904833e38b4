"""Rows of a validation in groups: by session, time and workspace, and inside or outside the angles identified on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arm import DIAGNOSED, Arm
from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.joint_range import range_of
from identification.kinematics.turns import turned_into
from identification.measurements import Measurements
from identification.model import Model

QUARTERS = 4  # groups by time; the quadrants of the workspace are as many
READ = np.radians(1e-6)  # what the digits of a file take from an angle
ROOM = 0.02  # of a joint's range at either end, left for the corrections of a posture
FEWEST = 3 * QUARTERS  # rows from which groups are formed


def identified(arm: Arm) -> Mapping[str, Any]:
    """What the arm's calibration says of the data it comes from."""
    return {} if arm.calibration is None else arm.calibration.provenance


def check_calibrated(arm: Arm, file: str | None = None) -> None:
    """Raises `InputError` for an arm that has neither a calibration nor known effect values;  file : that it is from"""
    if arm.calibration is None and not any(spec.values for spec in arm.effects):
        lacks = "calibration: the arm has none" if file is None else f"{file}: has no [calibration]"
        raise InputError(f"{lacks}, allowed: an arm file written by `armcal identify --out`")


def extrapolation(arm: Arm, postures: Array) -> str | None:
    """How many postures (m, n) of rows are outside the angles of the identification, in a clause; None: none, or not
    known."""
    out = outside(arm, postures)
    clause = extrapolated(out, "rows")
    beyond = [s.curve for s in arm.effects if s.curve and out is not None and out[:, (s.joint or 1) - 1].any()]
    if clause is None or not beyond:
        return clause
    if any(curve.geometry for curve in beyond):
        return f"{clause}; without its error curves, by the geometry that was fitted alone"
    return f"{clause}; its error curves are zero there, and the geometry of armcal identify alone may be better"


def extrapolated(out: NDArray[np.bool_] | None, what: str) -> str | None:
    """The same of `outside`."""
    if out is None or not out.any():
        return None
    joints = ", ".join(f"joint {j + 1} in {int(out[:, j].sum())}" for j in np.flatnonzero(out.any(axis=0)))
    count = f"{int(out.any(axis=1).sum())} of {len(out)} {what} are outside the angles that the model was identified on"
    return f"{count} ({joints}): there it extrapolates"


def seen_in_words(arm: Arm, postures: Array, model: Array, drawing: Array) -> str | None:
    """What model and drawing leave of rows at angles of the identification, and of the others, in a sentence; None
    where either are few, or the angles are not known.

    postures : (m, n);  model, drawing : (m,) distances [mm]
    """
    out = outside(arm, postures)
    if out is None or not FEWEST <= np.count_nonzero(beyond := out.any(axis=1)) <= len(out) - FEWEST:
        return None
    familiar, elsewhere = (
        f"{np.sqrt(np.mean(model[rows] ** 2)):.3g} mm (drawing {np.sqrt(np.mean(drawing[rows] ** 2)):.3g} mm)"
        for rows in (~beyond, beyond)
    )
    share = f"{100.0 * np.mean(~beyond):.2g} % of these rows lie at joint angles that the calibration has seen"
    return f"{share}: RMS there {familiar}, elsewhere {elsewhere}"


def outside(arm: Arm, postures: Array) -> NDArray[np.bool_] | None:
    """(m, n) True where a joint of postures (m, n) is outside the angles of the identification, whole turns aside; None
    where they are not known."""
    if (limits := identified_range(arm)) is None:
        return None
    (lower, upper), types = limits, Model(arm).joint_types
    q = turned_into(postures, lower, upper, types, READ)
    room = READ * np.maximum(1.0, np.abs(limits))  # a file has nine digits: of a slide's millimetres fewer decimals
    return (q < lower - room[0]) | (q > upper + room[1])


def mostly_outside(arm: Arm, postures: Array) -> bool:
    """Whether more than half of the postures (m, n) are outside the angles of the identification, as far as known, of
    an arm without several settings of one effect at once, as only the library as a prior has."""
    several = len({spec.key for spec in arm.effects}) < len(arm.effects)
    out = outside(arm, postures)
    return not several and out is not None and 2 * int(out.any(axis=1).sum()) > len(out)


def diagnosed(arm: Arm) -> bool:
    """Whether an arm's calibration is that of a diagnosis, or has values of effects beside the place of the base, as a
    diagnosed model has that was identified again."""
    if arm.calibration is None:
        return False
    effects = {p.name for effect in Model(arm).effects if effect.name != "base_offset" for p in effect.parameters}
    return identified(arm).get("source") == DIAGNOSED or not effects.isdisjoint(arm.calibration.values)


def data_hashes(provenance: Mapping[str, Any]) -> list[str]:
    """SHA-256 of the files that measurements come from: of one, or of several that were sessions; empty: not known."""
    hashes = provenance.get("sha256", [])
    return [hashes] if isinstance(hashes, str) else list(hashes)


def identified_range(arm: Arm) -> Array | None:
    """(2, n) least and largest angles of the identification [rad, mm], None where they are not known."""
    return range_of(identified(arm), arm.joint_types)


def familiar_range(arm: Arm) -> tuple[Array, Array]:
    """(n,) least and largest angles of the identification but for `ROOM`, moved by whole turns into the limits; the
    limits themselves where these are not known."""
    if (ends := identified_range(arm)) is None:
        return arm.lower, arm.upper
    middle = ends.mean(axis=0)
    ends = middle + (1.0 - 2.0 * ROOM) * (ends - middle)
    moved = ends + turned_into(middle[None], arm.lower, arm.upper, arm.joint_types)[0] - middle
    lower, upper = np.clip(moved, arm.lower, arm.upper)
    return lower, upper


def row_groups(arm: Arm, measurements: Measurements) -> Iterator[tuple[str, str, NDArray[np.int64]]]:
    """Kind, name and row numbers of every block; none of them is empty."""
    m = len(measurements)
    for name, rows in zip(measurements.sessions, measurements.session_rows, strict=False):
        yield "session", name, rows
    if m < FEWEST:
        return
    if not measurements.sessions:
        for k, rows in enumerate(np.array_split(measurements.sequence, QUARTERS), start=1):
            yield "time", f"quarter {k}", rows
    # of lengths the places computed, in the frame of the base
    measures_places = measurements.dimension > 1
    places = (measurements.positions if measures_places else Model(arm).points(measurements.postures)[:, -1])[:, :2]
    x, y = np.median(places, axis=0)
    right, above = (places > [x, y]).T
    for name, inside in (
        (f"x > {x:.0f}, y > {y:.0f}", right & above),
        (f"x < {x:.0f}, y > {y:.0f}", ~right & above),
        (f"x < {x:.0f}, y < {y:.0f}", ~right & ~above),
        (f"x > {x:.0f}, y < {y:.0f}", right & ~above),
    ):
        if inside.any():
            yield "workspace", name, np.flatnonzero(inside)
    out = outside(arm, measurements.postures)
    if out is not None and 0 < int(out.any(axis=1).sum()) < m:
        yield "range", "inside", np.flatnonzero(~out.any(axis=1))
        yield "range", "outside", np.flatnonzero(out.any(axis=1))
