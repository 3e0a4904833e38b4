"""Several sessions of one arm: each with a base of its own, everything else shared."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.errors import InputError
from identification.instruments import IN_PLANE, KINDS
from identification.kinematics.chain import BASE as STAND
from identification.kinematics.chain import TOOL
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet
from identification.measurements import POINT, Measurements
from identification.model import Model
from identification.model.placed import placed_model, session_bases

BASE = ("base_offset.x0", "base_offset.y0", f"{JOINT_OFFSET}:1")  # position and rotation of the base
SESSIONS = "session_base"
PLACES = (STAND, TOOL)


def placing(parameters: ParameterSet) -> list[int]:
    """Numbers of the parameters that say where a spatial arm stands, in every session, and what is measured on it;
    none where all of that is known."""
    if not any(p.kind in PLACES for p in parameters):
        return []
    return [k for k, p in enumerate(parameters) if p.kind in PLACES or p.name.startswith(f"{SESSIONS}.")]


# -- one table of several ----------------------------------------------------------------------------------------------
def pooled_sessions(tables: Mapping[str, Measurements]) -> Measurements:
    """Sessions by name as one table; a table that names sessions of its own keeps them, its name before theirs.

    Columns that not every table has are left out, with a warning (`UserWarning`). Raises `InputError` for tables of
    different arms.
    """
    parts = []
    for name, table in tables.items():
        several = table.sessions if len(table.sessions) > 1 else ()
        labels = [f"{name}/{session}" for session in table.session] if several else np.full(len(table), name)  # type: ignore[union-attr]
        parts.append(replace(table, session=np.array(labels), session_names=()))
    if len({part.dimension for part in parts}) > 1 and {part.dimension for part in parts} <= {3, 6}:
        parts = [replace(part, positions=part.positions[:, POINT], orientations=None) for part in parts]
        warnings.warn("not in all of the data, and left out: orientations", UserWarning, stacklevel=2)
    first = parts[0]
    for name, part in zip(tables, parts, strict=True):
        if (part.links, part.dimension) != (first.links, first.dimension):
            counted = f"found {part.links} joints and {part.dimension} coordinates"
            raise InputError(f"{name}: {counted}, allowed: {first.links} and {first.dimension} as in the other data")
    columns_of_all = frozenset.intersection(*(part.optional_columns for part in parts))
    if missing := sorted(frozenset.union(*(part.optional_columns for part in parts)) - columns_of_all):
        warnings.warn(f"not in all of the data, and left out: {', '.join(missing)}", UserWarning, stacklevel=2)
    columns = {name: [getattr(part, name) for part in parts] for name in ("postures", "positions", *columns_of_all)}
    if "repeats" in columns_of_all:
        # numbered such that no two tables share one
        ends = np.cumsum([0, *(int(np.ptp(repeats)) + 1 for repeats in columns["repeats"])])
        starts = zip(columns["repeats"], ends, strict=False)
        columns["repeats"] = [repeats - repeats.min() + start for repeats, start in starts]
    if any(part.gaps is not None for part in parts):
        columns["gaps"] = [np.zeros(len(part)) if part.gaps is None else part.gaps for part in parts]
    joined: dict[str, Any] = {name: np.concatenate(values) for name, values in columns.items()}
    origins = {key: [str(p.provenance[key]) for p in parts if key in p.provenance] for key in ("file", "sha256")}
    provenance: dict[str, Any] = {"file": ", ".join(origins["file"])} if origins["file"] else {}
    provenance |= {"sha256": origins["sha256"]} if origins["sha256"] else {}
    return Measurements(**joined, provenance=MappingProxyType(provenance))


def of_these_sessions(holdout: Measurements, measurements: Measurements) -> Measurements:
    """A hold-out with the sessions numbered as in the data; raises `InputError` for a session that the data lack."""
    if len(measurements.session_names) < 2:
        return replace(holdout, session=None, session_names=())
    names = measurements.session_names
    for name in holdout.sessions or ("",):
        if name not in names:
            which = f"session {name!r}" if name else "no column session"
            raise InputError(f"holdout: found {which}, allowed: {', '.join(names)}, as in the data; or armcal validate")
    return replace(holdout, session_names=names)


# -- the arm with a base for each session ------------------------------------------------------------------------------
def with_sessions(arm: Arm, measurements: Measurements) -> Arm:
    """The arm with a base offset, and a base for each session after the first, where the data name several; or with a
    target for each, where these stand in the frame of the base.

    Best known values of the bases are those that bring the best known arm nearest to each session's positions. In space
    reflectors of one name are shared by the sessions, those of other names are not.
    """
    count = len(measurements.session_names)
    if arm.chain.instrument.own_targets:
        return placed_model(Model(arm), measurements).arm
    if count < 2:
        return arm
    spec, values = EffectSpec(SESSIONS, values={"sessions": float(count)}), dict[str, float]()
    if not arm.chain.planar:
        # base of session k = that of the first, shifted along the axes of the instrument and turned about its own
        placed = arm if arm.chain.fixed else placed_model(Model(arm), measurements).arm
        chain, bases = session_bases(placed, measurements)
        values |= {} if placed.calibration is None else placed.calibration.values
        hidden_values: dict[str, float] = {}
        for number, base in enumerate(bases[1:], start=2):
            movement, hidden = chain.instrument.between(bases[0], base)
            values |= {f"{SESSIONS}.{short}{number}": value for short, value in movement.items()}
            hidden_values |= {f"{short}{number}": movement[short] for short in hidden}
        spec = replace(spec, values={**spec.values, **hidden_values})
        kept = Calibration(values) if placed.calibration is None else replace(placed.calibration, values=values)
        return replace(placed.with_effects(*placed.effects, spec), chain=chain, calibration=kept)
    wide, model = with_base(arm), Model(with_base_offset(arm))
    start = model.parameters.vector(model.best_known)
    computed = model.position(measurements.postures, start, replace(measurements.conditions, session=None))
    rows_of = dict(zip(measurements.sessions, measurements.session_rows, strict=False))
    for number, session in enumerate(measurements.session_names, start=1):
        moved = start
        if (rows := rows_of.get(session)) is not None:
            moved = start_at_bases(start, model, computed[rows], measurements.positions[rows])
        x, y, turn = (float(moved[model.parameters.index(name)]) for name in BASE)
        if number == 1:
            values = Model(wide).best_known | dict(zip(BASE, (x, y, turn), strict=True)) | dict(Model(wide).fixed)
            continue
        # tip = R(w) (tip of the first session, before its shift) + shift of the first + (x, y)
        first = (values[name] for name in BASE)
        named = {short: a - b for short, a, b in zip("xyw", (x, y, turn), first, strict=True)}
        values |= {f"{SESSIONS}.{short}{number}": value for short, value in named.items()}
    provenance = {} if arm.calibration is None else arm.calibration.provenance
    return replace(wide.with_effects(*wide.effects, spec), calibration=Calibration(values, provenance=provenance))


def without_sessions(calibration: Calibration) -> Calibration:
    """A calibration without the bases of later sessions, and without targets that stand in the frame of the base: the
    arm stands as in the first."""
    dropped = (
        f"{SESSIONS}.",
        *(f"{kind.own_targets}[" for kind in (*KINDS.values(), *IN_PLANE.values()) if kind.own_targets),
    )
    keep = [k for k, name in enumerate(calibration.parameter_names) if not name.startswith(dropped)]
    covariance = calibration.covariance
    return replace(
        calibration,
        values={name: value for name, value in calibration.values.items() if not name.startswith(dropped)},
        parameter_names=tuple(calibration.parameter_names[k] for k in keep),
        covariance=None if covariance is None else covariance[np.ix_(keep, keep)],
    )


def with_base(arm: Arm) -> Arm:
    """The arm with a base offset, its own if it has one; the base of a spatial arm is part of its geometry."""
    stands = not arm.chain.positions_in_plane or any(spec.name == "base_offset" for spec in arm.effects)
    return arm if stands else with_base_offset(arm)


def with_base_offset(arm: Arm) -> Arm:
    """The arm with a base offset among its effects, its value to be estimated."""
    others = tuple(spec for spec in arm.effects if spec.name != "base_offset")
    return arm.with_effects(*others, EffectSpec("base_offset"))


def start_at_bases(start: Array, model: Model, computed: Array, measured: Array) -> Array:
    """(p,) start with the rotation and shift of the base that bring (m, 2) computed tips nearest to measured ones.

    Exact where nothing but the chain depends on where the base stands; otherwise a start for least squares.
    """
    place = {name: model.parameters.index(name) for name in BASE}
    x0, y0, turn = (place[name] for name in BASE)
    from_base = (computed - start[[x0, y0]]) @ [1.0, 1.0j]
    goal = measured @ np.array([1.0, 1.0j])
    angle = float(np.angle(np.vdot(from_base - from_base.mean(), goal - goal.mean())))
    shift = complex(np.mean(goal - np.exp(1.0j * angle) * from_base))
    moved = start.copy()
    moved[turn] += angle
    moved[[x0, y0]] = shift.real, shift.imag
    return moved
