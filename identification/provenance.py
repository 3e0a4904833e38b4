"""What a calibration says of the data that it comes from: its rows, and the angles that it was identified on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arm import DIAGNOSED, Arm
from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.counting import range_of, turned_into
from identification.measurements import ROW_DIGESTS, Measurements, shared_rows
from identification.model import Model

HELD_FROM = "held_from"  # key of a calibration's provenance
READ = np.radians(1e-6)  # what the digits of a file take from an angle


def provenance_of(arm: Arm) -> Mapping[str, Any]:
    """What the arm's calibration says of the data it comes from."""
    return {} if arm.calibration is None else arm.calibration.provenance


def check_calibrated(arm: Arm, file: str | None = None) -> None:
    """Raises `InputError` for an arm that has neither a calibration nor known effect values;  file : that it is from"""
    if arm.calibration is None and not any(spec.values for spec in arm.effects):
        lacks = "calibration: the arm has none" if file is None else f"{file}: has no [calibration]"
        raise InputError(f"{lacks}, allowed: an arm file written by `armcal identify --out`")


def extrapolated(out: NDArray[np.bool_] | None, what: str) -> str | None:
    """How many rows are outside the angles of the identification, in a clause; None: none, or not known;  out : (m, n)
    of `outside`;  what : the rows are"""
    if out is None or not out.any():
        return None
    joints = ", ".join(f"joint {j + 1} in {int(out[:, j].sum())}" for j in np.flatnonzero(out.any(axis=0)))
    count = f"{int(out.any(axis=1).sum())} of {len(out)} {what} are outside the angles that the model was identified on"
    return f"{count} ({joints}): there it extrapolates"


def outside(arm: Arm, postures: Array) -> NDArray[np.bool_] | None:
    """(m, n) True where a joint is outside the angles of the identification, whole turns aside; None: not known."""
    if (limits := range_of(provenance_of(arm), arm.joint_types)) is None:  # (2, n) [rad, mm]
        return None
    (lower, upper), types = limits, Model(arm).joint_types
    q = turned_into(postures, lower, upper, types, READ)
    room = READ * np.maximum(1.0, np.abs(limits))  # a file has nine digits: of a slide's millimetres fewer decimals
    return (q < lower - room[0]) | (q > upper + room[1])


def diagnosed(arm: Arm) -> bool:
    """Whether an arm's calibration is that of a diagnosis, or has values of effects beside the place of the base, as a
    diagnosed model has that was identified again."""
    if arm.calibration is None:
        return False
    effects = {p.name for effect in Model(arm).effects if effect.name != "base_offset" for p in effect.parameters}
    return provenance_of(arm).get("source") == DIAGNOSED or not effects.isdisjoint(arm.calibration.values)


def without_prior_effects(arm: Arm) -> Arm:
    """The arm without the effects that a fit with the library's prior added to it: those of which its calibration has
    values and no covariance, as it has of others; the same arm where there are none."""
    calibration = arm.calibration
    if calibration is None or not calibration.parameter_names or provenance_of(arm).get("source") == DIAGNOSED:
        return arm
    held = calibration.effects.keys() - set(calibration.parameter_names)
    names = [{p.name for p in effect.parameters} for effect in Model(arm).effects]
    kept = [spec for spec, own in zip(arm.effects, names, strict=True) if not own or not own <= held]
    if len(kept) == len(arm.effects):
        return arm
    values = {name: value for name, value in calibration.values.items() if name not in held}
    return replace(arm, effects=tuple(kept), calibration=replace(calibration, values=values))


def share_fitted(provenance: Mapping[str, Any], measurements: Measurements) -> float:
    """Share of the measurements among the rows that a calibration of this provenance, or what it holds, was fitted to,
    in whatever file; of an earlier version, which does not say which these are, all of its file."""
    if isinstance(text := provenance.get(ROW_DIGESTS), str):
        return shared_rows(text, measurements)[0]
    ours, theirs = ({*np.atleast_1d(one.get("sha256", [])).tolist()} for one in (provenance, measurements.provenance))
    return float(not ours.isdisjoint(theirs))
