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
from identification.instruments import KINDS
from identification.instruments.base import registered
from identification.kinematics.chain import BASE, TOOL
from identification.kinematics.parameters import ParameterSet
from identification.measurements import POINT, Conditions, Measurements
from identification.model import Model
from identification.model.placed import placed_model, session_bases

SESSIONS = "session_base"


def placing(parameters: ParameterSet) -> list[int]:
    """Numbers of the parameters that say where a spatial arm stands, in every session, and what is measured on it;
    none where all of that is known."""
    open_places = any(p.kind in (BASE, TOOL) for p in parameters)
    places = (p.kind in (BASE, TOOL) or p.name.startswith(f"{SESSIONS}.") for p in parameters)
    return [k for k, is_place in enumerate(places) if open_places and is_place]


# -- one table of several ----------------------------------------------------------------------------------------------
def pooled_sessions(tables: Mapping[str, Measurements]) -> Measurements:
    """Sessions by name as one table; a table that names sessions of its own keeps them, its name before theirs. Columns
    that not every table has are left out, with a warning. Raises `InputError` for tables of different arms."""
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
    count, chain = len(measurements.session_names), arm.chain
    if chain.instrument.own_targets:
        return placed_model(Model(arm), measurements).arm
    if count < 2:
        return arm
    spec, calibration, base_values = {"sessions": float(count)}, arm.calibration, dict[str, float]()
    if chain.standing:
        wide, model = with_base(arm), Model(with_open_base(arm))
        at, conditions = np.tile(model.values, (count, 1)), replace(measurements.conditions, session=None)
        for name, rows in zip(measurements.sessions, measurements.session_rows, strict=True):
            nearest = start_at_base(model, measurements.rows(rows), conditions.rows(rows))
            at[measurements.session_names.index(name)] = nearest
        bases = at[:, [model.parameters.index(name) for name in chain.standing]]
        first = dict(zip(chain.standing, bases[0].tolist(), strict=True))
        values = Model(wide).best_known | first | dict(Model(wide).fixed)
        # tip = R(w) (tip of the first session, before its shift) + shift of the first + (x, y)
        for number, base in enumerate(bases[1:] - [values[name] for name in chain.standing], start=2):
            base_values |= {f"{short}{number}": float(value) for short, value in zip("xyw", base, strict=True)}
        calibration = Calibration({}, provenance={} if calibration is None else calibration.provenance)
    else:
        # base of session k = that of the first, shifted along the axes of the instrument and turned about its own
        wide = arm if chain.fixed else placed_model(Model(arm), measurements).arm
        chain, in_sessions = session_bases(wide, measurements)
        wide, calibration = replace(wide, chain=chain), wide.calibration or Calibration({})
        values = dict(calibration.values)
        for number, pose in enumerate(in_sessions[1:], start=2):
            moved, hidden = chain.instrument.between(in_sessions[0], pose)
            base_values |= {f"{short}{number}": value for short, value in moved.items()}
            spec |= {f"{short}{number}": moved[short] for short in hidden}
    values |= {f"{SESSIONS}.{short}": value for short, value in base_values.items()}
    wide = wide.with_effects(*wide.effects, EffectSpec(SESSIONS, values=spec))
    return replace(wide, calibration=replace(calibration, values=values))


def without_sessions(calibration: Calibration) -> Calibration:
    """A calibration without bases of later sessions and targets in the frame of the base: the arm as in the first."""
    words = [kind.own_targets for kinds in KINDS.values() for kind in kinds.values() if kind.own_targets]
    dropped = (f"{SESSIONS}.", *(f"{word}[" for word in words))
    kept = calibration.about(name for name in calibration.parameter_names if not name.startswith(dropped))
    return replace(kept, values={name: x for name, x in kept.values.items() if not name.startswith(dropped)})


def with_base(arm: Arm) -> Arm:
    """The arm with the effects that say where it stands, its own where it has them."""
    named = [spec.name for spec in arm.effects]
    missing = (EffectSpec(name) for name in arm.chain.standing_effects if name not in named)
    return arm.with_effects(*arm.effects, *missing)


def with_open_base(arm: Arm) -> Arm:
    """The arm with the effects that say where it stands, their values to be estimated."""
    stands = arm.chain.standing_effects
    return arm.with_effects(*(spec for spec in arm.effects if spec.name not in stands), *map(EffectSpec, stands))


def start_at_base(model: Model, measurements: Measurements, conditions: Conditions) -> Array:
    """(p,) best known values, where parameters that the chain names say where it stands with the shift and the rotation
    that bring computed tips nearest to measured ones. Exact where nothing but the chain depends on where the base
    stands; otherwise a start for least squares."""
    standing, moved = model.arm.chain.standing, model.values.copy()
    if standing and {*standing} <= {*model.names}:
        x0, y0, turn = (model.parameters.index(name) for name in standing)
        computed = model.position(measurements.postures, moved, conditions)
        base = registered(computed - moved[[x0, y0]], measurements.positions)
        moved[turn] += np.arctan2(base[1, 0], base[0, 0])
        moved[[x0, y0]] = base[:2, 3]
    return moved
