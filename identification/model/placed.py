"""Where a spatial arm stands and where its measured points are, if the arm file does not say: the start of a fit."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array
from identification.errors import InputError, nearest
from identification.instruments import Unplaced
from identification.kinematics.chain import BASE, DIMENSION, TOOL, KinematicChain
from identification.kinematics.corrected import standing_in
from identification.kinematics.frames import mean_rotation
from identification.measurements import Measurements
from identification.model.arm_model import Model
from identification.vectorize import vectorize

UNNAMED = "1"  # measured point, as an arm file has it that names none
ENOUGH = 500  # rows: a start is good to far less than the errors of the geometry that it leaves out


def placed_model(model: Model, measurements: Measurements) -> Model:
    """The model with base and measured points from a closed form on the geometry as best known, the points named as in
    the data, and with targets that stand in the frame of the base; planar arms of which positions are measured stay as
    they are. Of several sessions the first says where the arm stands.

    Raises `InputError` for measured points that the arm does not have.
    """
    arm = getattr(model, "arm", None)
    if not isinstance(arm, Arm):
        return model
    chain = with_markers(arm.chain, measurements)
    settled, own_targets = chain.settled, chain.instrument.own_targets
    if model.held:  # and those whose parameters are all known to the model
        settled |= {BASE, TOOL} - {p.kind for p in model.geometry_parameters if p.name not in model.held}
    if settled >= {BASE, TOOL} and not own_targets:
        return model if chain is arm.chain else replace(model, arm=replace(arm, chain=chain))
    rows = some(measurements, measurements.session_rows[0])
    values: dict[str, float] = {}
    if (calibration := arm.calibration) is not None:
        values = {name: v for name, v in calibration.values.items() if _place(name) not in {BASE, TOOL} - settled}
        calibration = replace(calibration, values=values, base=None, tools={}, tool_axes={})
    drawn = replace(standing_in(chain, values), settled=settled)
    geometry = {name: value for name, value in values.items() if _place(name) not in (BASE, TOOL)}
    standing = standing_chain(drawn, rows, geometry)
    if BASE not in settled:
        chain = replace(chain, base=standing.base)
    if TOOL not in settled:
        chain = replace(chain, tools=standing.tools, tool_axes=standing.tool_axes)
    if own_targets:
        frames = tip_frames(standing, measurements.postures, geometry)
        points = frames[:, :3, 3] + frames[:, :3, :3] @ next(iter(standing.tools.values()))
        points, names = points[:, : chain.dimension], measurements.marker_names or ("1",)
        readings = measurements.positions[:, : chain.instrument.dimension]
        instrument = chain.instrument.with_targets(points, readings, markers_of(measurements), names)
        chain = replace(chain, instrument=instrument)
    return replace(model, arm=replace(arm, chain=chain, calibration=calibration))


def _place(name: str) -> str:
    """`base` of `base.x`, `tool` of `tool[1].x`."""
    return re.split(r"[.\[]", name)[0]


def some(measurements: Measurements, rows: NDArray[np.int64]) -> Measurements:
    """As many of these rows as a start needs."""
    return measurements.rows(rows[np.unique(np.linspace(0, len(rows) - 1, ENOUGH).astype(int))])


def markers_of(measurements: Measurements) -> NDArray[np.int64]:
    """(m,) number of each row's measured point, 0 where the data name none."""
    numbers = measurements.marker_numbers
    return np.zeros(len(measurements), dtype=np.int64) if numbers is None else numbers


def standing_chain(chain: KinematicChain, measurements: Measurements, values: Mapping[str, float]) -> KinematicChain:
    """The chain where the closed form finds its base and its measured points or frames, as far as they are not known.

    values : best known errors of the geometry
    """
    markers = markers_of(measurements)
    if chain.instrument.own_targets:  # one measured point, from the rows of the target that is touched most
        measurements = measurements.rows(np.flatnonzero(markers == np.bincount(markers).argmax()))
        markers = np.zeros(len(measurements), dtype=np.int64)
    readings = measurements.positions[:, : chain.instrument.dimension]  # of poses the points
    standing = placed_chain(chain, measurements.postures, readings, markers, values)
    if measurements.orientations is None or TOOL in chain.settled:
        return standing
    axes = tool_axes(standing, measurements.postures, measurements.orientations, markers, values)
    return replace(standing, tool_axes=axes)


def session_bases(arm: Arm, measurements: Measurements) -> tuple[KinematicChain, list[Array]]:
    """The chain of an arm that stands where the first session finds it, with the points that only later sessions
    measure, and the pose (4, 4) of the base in each session."""
    every = {} if arm.calibration is None else arm.calibration.values
    values = {name: value for name, value in every.items() if not name.startswith((f"{BASE}.", f"{TOOL}["))}
    parts = dict(zip(measurements.sessions, measurements.session_rows, strict=False))
    standing, bases = standing_in(arm.chain, every), list[Array]()
    first = seen = np.full(len(standing.tools), TOOL in standing.settled)
    for name in measurements.session_names:
        if name in parts:
            rows = some(measurements, parts[name])
            if bases:  # where these rows find the base, then the points that were not seen before
                old = seen[markers_of(rows)]
                held = frozenset({TOOL}) if old.any() else frozenset()
                as_before = rows.rows(old) if old.any() else rows
                standing = standing_chain(replace(standing, settled=held), as_before, values)
                if old.any() and not old.all():
                    standing = standing_chain(replace(standing, settled=frozenset({BASE})), rows.rows(~old), values)
            seen = seen | np.isin(np.arange(len(seen)), markers_of(rows))
        first = first if bases else seen
        bases.append(standing.base)
    later = [name for name, is_seen in zip(standing.tools, first.tolist(), strict=True) if not is_seen]
    tools, axes = ({name: of[name] for name in later if name in of} for of in (standing.tools, standing.tool_axes))
    chain = replace(arm.chain, tools={**arm.chain.tools, **tools}, tool_axes={**arm.chain.tool_axes, **axes})
    return chain, bases


def with_markers(chain: KinematicChain, measurements: Measurements) -> KinematicChain:
    """The chain with the measured points that the data name, in the order of the data; `InputError` for others. Without
    orientations where the data have none.

    One point that the arm knows is the one that is measured, whatever the data call it.
    """
    if chain.angle_scale is not None and measurements.dimension == DIMENSION:
        chain = replace(chain, angle_scale=None)
    names, tools = () if chain.instrument.own_targets else measurements.marker_names, chain.tools
    if not names:
        if len(tools) > 1:
            missing = "no column marker, and the arm has several measured points"
            raise InputError(f"measurements: {missing}, allowed: one of {', '.join(tools)} in each row")
        return chain
    if tuple(tools)[: len(names)] == names:
        return chain
    if len(tools) == 1 == len(names):
        axes = dict(zip(names, chain.tool_axes.values(), strict=False))
        return replace(chain, tools=dict(zip(names, tools.values(), strict=True)), tool_axes=axes)
    if TOOL not in chain.settled:
        return replace(chain, tools={name: tools.get(name, np.zeros(3)) for name in names})
    for name in names:
        if name not in tools:
            raise InputError(f"measurements.marker: unknown name {name!r}, {nearest(name, tools)}")
    return replace(chain, tools={name: tools[name] for name in dict.fromkeys((*names, *tools))})


def one_unnamed(chain: KinematicChain, measurements: Measurements) -> KinematicChain:
    """The chain with one measured point, where it has several and the data name none: one, to be found."""
    if measurements.marker_names or len(chain.tools) == 1:
        return chain
    return replace(chain, tools={UNNAMED: np.zeros(3)}, tool_axes={})


def placed_chain(
    chain: KinematicChain,
    postures: Array,
    readings: Array,
    markers: NDArray[np.int64],
    values: Mapping[str, float] = MappingProxyType({}),
) -> KinematicChain:
    """The chain with base and tools that explain (m, d) readings at (m, n) postures best.

    markers : (m,) number of each row's measured point;  values : best known errors of the geometry
    """
    names, frames, place = list(chain.tools), tip_frames(chain, postures, values), chain.instrument.place
    base, tools = chain.base, {name: np.array(place) for name, place in chain.tools.items()}
    if BASE not in chain.settled and TOOL in chain.settled:
        places = np.array([tools[name] for name in names])[markers]
        at_points = np.array(frames)  # of frames whose origins are the measured points
        at_points[:, :3, 3] += np.einsum("mij,mj->mi", frames[:, :3, :3], places)
        base = place(Unplaced(at_points, readings, chain.reach, tool=np.zeros(3))).base
    elif BASE not in chain.settled:
        most = markers == np.bincount(markers).argmax()
        base = place(Unplaced(frames[most], readings[most], chain.reach)).base
    for number, name in enumerate(names if TOOL not in chain.settled else ()):
        if (of_marker := markers == number).any():
            tools[name] = place(Unplaced(frames[of_marker], readings[of_marker], chain.reach, base)).tool
    return replace(chain, base=base, tools=tools)


def tool_axes(
    chain: KinematicChain,
    postures: Array,
    orientations: Array,
    markers: NDArray[np.int64],
    values: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Array]:
    """Name -> (3, 3) axes of the measured frames in the tip's frame that explain orientations (m, 3, 3) best, where the
    base stands; other arguments as of `placed_chain`."""
    tips = chain.base[:3, :3] @ tip_frames(chain, postures, values)[:, :3, :3]
    turned = np.swapaxes(tips, -1, -2) @ orientations
    rows_of = {number: markers == number for number in range(len(chain.tools))}
    axes = {name: mean_rotation(turned[rows_of[k]]) for k, name in enumerate(chain.tools) if rows_of[k].any()}
    return {**chain.tool_axes, **axes}


def tip_frames(chain: KinematicChain, postures: Array, values: Mapping[str, float] = MappingProxyType({})) -> Array:
    """(m, 4, 4) poses of the tip in the base at postures (m, n), with errors of the geometry by name."""
    return frames_of_tip(chain, values)(postures)


def frames_of_tip(
    chain: KinematicChain, values: Mapping[str, float] = MappingProxyType({})
) -> Callable[[Array], Array]:
    """The function of postures that `tip_frames` evaluates."""
    q = ca.SX.sym("q", len(chain))
    tip = replace(chain, base=np.eye(4)).frames(q, values)[-1]
    compiled = vectorize(ca.Function("tip", [q], [ca.densify(tip.origin), ca.densify(tip.axes)]))

    def evaluate(postures: Array) -> Array:
        origin, axes = compiled(postures)
        frames = np.tile(np.eye(4), (len(postures), 1, 1))
        frames[:, :3, 3], frames[:, :3, :3] = origin[..., 0], axes
        return frames

    return evaluate
