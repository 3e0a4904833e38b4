"""Where a spatial arm stands and where its measured points are, if the arm file does not say: the start of a fit. What
an arm that is measured by no positions says of these, postures at which it touches something, and a minimal set of its
parameters: as many as measurements can distinguish, the others as drawn. Each session has a base of its own.

Every combination of the geometry's errors that moves the measured points is one of the parameters that are kept (the
continuous and complete set of the literature: L. J. Everett, M. Driels, B. W. Mooring, "Kinematic modelling for robot
calibration", ICRA 1987): four for each revolute joint and two for each prismatic one, and three for each reflector off
the last axis or six for a measured frame; of a six-axis arm 27 with one reflector, 33 with three, 30 with a frame.
Which of several equivalent ones is kept is a choice: those that an engineer looks for first.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import DIAGNOSED, SESSIONS, Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.effects import library
from identification.errors import InputError, require
from identification.instruments import KINDS, TRACKER, Tracker, Unplaced
from identification.instruments.base import AtTargets, registered
from identification.kinematics.chain import BASE, DIMENSION, ROTATION_ERROR, TOOL, TRANSLATION_ERROR, KinematicChain
from identification.kinematics.frames import nearest_rotation, pose
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet, error_names
from identification.measurements import POINT, Conditions, Measurements
from identification.model import Model

DISTINCT = 1e-6  # [mm] RMS change of a coordinate by an error of machining size, beside those kept; rounding is 1e-12
PRACTICAL = 1e-2  # [mm] the same without what measurements hardly determine: below what trackers resolve
Part = tuple[Model, Array, Sequence[Conditions]]
FEWEST = 4  # positions, of which a rigid motion explains half the coordinates


def placed_model(model: Model, measurements: Measurements) -> Model:
    """The model with base and measured points from a closed form on the geometry as best known, the points named as in
    the data, and with targets that stand in the frame of the base; planar arms of which positions are measured stay as
    they are. Of several sessions the first says where the arm stands. Raises `InputError` for measured points that the
    arm does not have."""
    arm = getattr(model, "arm", None)
    if not isinstance(arm, Arm):
        return model
    chain = with_markers(arm.chain, measurements)
    settled, own_targets = chain.settled, chain.instrument.own_targets
    if model.held:  # and those whose parameters are all known to the model
        settled |= {BASE, TOOL} - {p.kind for p in model.geometry_parameters if p.name not in model.held}
    if settled >= {BASE, TOOL} and not own_targets:
        return model if chain is arm.chain else replace(model, arm=replace(arm, chain=chain))
    values: dict[str, float] = {}
    if (calibration := arm.calibration) is not None:
        values = _without(calibration.values, {BASE, TOOL} - settled)
        calibration = replace(calibration, values=values, base=None, tools={})
    drawn, geometry = replace(chain.standing_in(values), settled=settled), _without(values)
    standing = _standing_chain(drawn, spread_rows(measurements, measurements.session_rows[0]), geometry)
    if BASE not in settled:
        chain = replace(chain, base=standing.base)
    if TOOL not in settled:
        as_known = {*(model.held or ())}
        found = {name: at for name, at in standing.tools.items() if as_known.isdisjoint(error_names(f"{TOOL}[{name}]"))}
        chain = replace(chain, tools={**chain.tools, **found})
    if isinstance(chain.instrument, AtTargets):
        frames = standing.tip_frames(measurements.postures, geometry) @ next(iter(standing.tools.values()))
        numbers = np.stack([measurements.numbers(name) for name in ("session", "marker")], axis=1)
        names, readings = (measurements.session_names, measurements.marker_names), measurements.positions
        targets = frames[:, : chain.dimension, 3], readings[:, : chain.instrument.dimension], numbers, names
        chain = replace(chain, instrument=chain.instrument.with_targets(*targets))
    return replace(model, arm=replace(arm, chain=chain, calibration=calibration))


def _without(values: Mapping[str, float], places: Collection[str] = (BASE, TOOL)) -> dict[str, float]:
    """Values but for those of base or measured points, `base.x` and `tool[1].x`."""
    return {name: value for name, value in values.items() if re.split(r"[.\[]", name)[0] not in places}


def spread_rows(measurements: Measurements, rows: NDArray[np.int64]) -> Measurements:
    """As many of these rows as a start needs to be good to far less than the errors of the geometry."""
    return measurements.rows(rows[np.unique(np.linspace(0, len(rows) - 1, 500).astype(int))])


def _standing_chain(chain: KinematicChain, measurements: Measurements, values: Mapping[str, float]) -> KinematicChain:
    """The chain where the closed form finds its base and its measured points or frames, as far as they are not known;
    values : best known errors of the geometry."""
    markers = measurements.numbers("marker")
    most = markers == np.bincount(markers).argmax()
    if chain.instrument.own_targets:  # one measured point, from the rows of the target that is touched most
        measurements, markers, most = measurements.rows(most), np.zeros(int(most.sum()), dtype=np.int64), most[most]
    readings = measurements.positions[:, : chain.instrument.dimension]  # of poses the points
    frames, place = chain.tip_frames(measurements.postures, values), chain.instrument.place
    base, tools = chain.base, dict(chain.tools)
    if BASE not in chain.settled and TOOL in chain.settled:
        at_points = frames @ np.array([*tools.values()])[markers]
        base = place(Unplaced(at_points, readings, chain.reach, tool=np.zeros(3))).base
    elif BASE not in chain.settled:
        near = [*tools.values()][markers[most][0]][:3, 3]
        base = place(Unplaced(frames[most], readings[most], chain.reach, near=near)).base
    for number, name in enumerate(tools if TOOL not in chain.settled else ()):
        if (rows := markers == number).any():
            near, turn = tools[name][:3, 3], tools[name][:3, :3]
            at = place(Unplaced(frames[rows], readings[rows], chain.reach, base, near=near)).tool
            if measurements.orientations is not None:
                tips = np.swapaxes(base[:3, :3] @ frames[rows, :3, :3], -1, -2)
                turn = nearest_rotation((tips @ measurements.orientations[rows]).mean(axis=0))
            tools[name] = pose(at, turn)
    return replace(chain, base=base, tools=tools)


def session_bases(arm: Arm, measurements: Measurements) -> tuple[KinematicChain, list[Array]]:
    """The chain of an arm that stands where the first session finds it, with the points that only later sessions
    measure, and the pose (4, 4) of the base in each session."""
    every = {} if arm.calibration is None else arm.calibration.values
    values, standing, bases = _without(every), arm.chain.standing_in(every), list[Array]()
    parts = dict(zip(measurements.sessions, measurements.session_rows, strict=False))
    first = seen = np.full(len(standing.tools), TOOL in standing.settled)
    for name in measurements.session_names:
        if name in parts:
            rows = spread_rows(measurements, parts[name])
            if bases:  # where these rows find the base, then the points that were not seen before
                old = seen[rows.numbers("marker")]
                held = frozenset({TOOL}) if old.any() else frozenset()
                as_before = rows.rows(old) if old.any() else rows
                standing = _standing_chain(replace(standing, settled=held), as_before, values)
                if old.any() and not old.all():
                    standing = _standing_chain(replace(standing, settled=frozenset({BASE})), rows.rows(~old), values)
            seen = seen | np.isin(np.arange(len(seen)), rows.numbers("marker"))
        first = first if bases else seen
        bases.append(standing.base)
    later = {name: at for (name, at), seen in zip(standing.tools.items(), first.tolist(), strict=True) if not seen}
    return replace(arm.chain, tools={**arm.chain.tools, **later}), bases


def placing(parameters: ParameterSet) -> list[int]:
    """Numbers of the parameters that say where a spatial arm stands, in every session, and what is measured on it;
    none where all of that is known."""
    open_places = any(p.kind in (BASE, TOOL) for p in parameters)
    places = (p.kind in (BASE, TOOL) or p.name.startswith(f"{SESSIONS}.") for p in parameters)
    return [k for k, is_place in enumerate(places) if open_places and is_place]


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
        wide, model = arm.with_base(), Model(arm.with_base(anew=True))
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
        for number, base in enumerate(in_sessions[1:], start=2):
            moved, hidden = chain.instrument.between(in_sessions[0], base)
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


def without_prior_effects(arm: Arm) -> Arm:
    """The arm without the effects that a fit with the library's prior added to it: those of which its calibration has
    values and no covariance, as it has of others; the same arm where there are none."""
    calibration = arm.calibration
    if calibration is None or not calibration.parameter_names or arm.provenance.get("source") == DIAGNOSED:
        return arm
    held = calibration.effects.keys() - set(calibration.parameter_names)
    names = [{p.name for p in effect.parameters} for effect in Model(arm).effects]
    kept = [spec for spec, own in zip(arm.effects, names, strict=True) if not own or not own <= held]
    if len(kept) == len(arm.effects):
        return arm
    values = {name: value for name, value in calibration.values.items() if name not in held}
    return replace(arm, effects=tuple(kept), calibration=replace(calibration, values=values))


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


def with_markers(chain: KinematicChain, measurements: Measurements) -> KinematicChain:
    """The chain with the measured points that the data name, in the order of the data; `InputError` for others. Without
    orientations where the data have none. One point that the arm knows is the one that is measured, whatever the data
    call it."""
    if chain.angle_scale is not None and measurements.dimension == DIMENSION:
        chain = replace(chain, instrument=TRACKER)
    names, tools = () if chain.instrument.own_targets else measurements.marker_names, chain.tools
    if not names:
        missing = "no column marker, and the arm has several measured points"
        require(len(tools) <= 1, f"measurements: {missing}, allowed: one of {', '.join(tools)} in each row")
        return chain
    if tuple(tools)[: len(names)] == names:
        return chain
    if len(tools) == 1 == len(names):
        return replace(chain, tools=dict(zip(names, tools.values(), strict=True)))
    if TOOL not in chain.settled:
        return replace(chain, tools={name: tools.get(name, np.eye(4)) for name in names})
    InputError.check_names("measurements.marker: unknown name", names, tools)
    return replace(chain, tools={name: tools[name] for name in dict.fromkeys((*names, *tools))})


def with_all_markers(arm: Arm, measurements: Measurements) -> Arm:
    """The arm `with_markers`, and behind them, where they are, the measured points that the data do not name."""
    if (calibration := arm.calibration) is None or not calibration.tools:
        return replace(arm, chain=with_markers(arm.chain, measurements))
    tools = arm.chain.standing_in(calibration.values).tools
    chain = with_markers(replace(arm.chain, tools=tools), measurements)
    known = chain.tools if len(tools) == 1 == len(chain.tools) else {name: tools[name] for name in calibration.tools}
    calibration = replace(calibration, values=_without(calibration.values, (TOOL,)), tools=known)
    return replace(arm, chain=replace(chain, tools={**chain.tools, **known}), calibration=calibration)


# -- positions where something else is read ----------------------------------------------------------------------------
def _as_tracker(arm: Arm) -> Arm:
    """The arm as if positions were read in the frame of its instrument, without effects of that."""
    effects = [spec for spec in arm.effects if not library()[spec.name].needs & arm.chain.instrument.offers]
    return replace(arm, chain=replace(arm.chain, instrument=Tracker(arm.chain.angle_scale))).with_effects(*effects)


def of_positions(model: Model) -> Model:
    """The model of the measured point's position with the same parameters, without those of the reading; of an
    instrument that reads positions as it is."""
    if (chain := model.arm.chain).instrument.reads_positions:
        return model
    shown = Model(_as_tracker(model.arm))
    unseen = {*shown.geometry_parameters.names} - {*model.geometry_parameters.names} | (chain.unestimated - chain.fixed)
    held = {name: value for name, value in (model.held or {}).items() if name in shown.all_parameters.names}
    return replace(shown, held={**held, **dict.fromkeys(unseen, 0.0)})


def tip_jacobian(model: Model, postures: ArrayLike, parameters: ArrayLike | None = None) -> Array:
    """(m, d, p) derivative of the measured point's position with respect to the parameters, in the frame of the
    instrument, without orientations, which are no distance; where readings do not say where the arm stands in it, of
    what no rigid motion of all m positions makes up for: the first use of its positions is to find that. Raises
    `InputError` for less than `FEWEST` postures."""
    whole = of_positions(model)
    if whole is model:
        return model.linearize(postures, parameters)[1][:, POINT]
    free = [model.names.index(name) for name in whole.names]
    points, moved = whole.linearize(postures, None if parameters is None else np.asarray(parameters)[..., free])
    jacobian = np.zeros((*moved.shape[:-1], len(model.names)))  # how a length is read moves no point
    jacobian[..., free] = moved
    if model.arm.chain.instrument.places:
        return jacobian
    if (m := len(points)) < FEWEST:
        raise InputError(f"postures: {m} for the error of the tip from lengths, allowed: at least {FEWEST}")
    d = points.shape[1]
    around = np.pad(points - points.mean(axis=0), ((0, 0), (0, 3 - d)))
    turns = np.cross(np.eye(3)[[*model.arm.chain.turning]], around[:, None, :])[..., :d]  # a row of each axis
    rigid = np.concatenate([np.tile(np.eye(d), (m, 1, 1)), np.swapaxes(turns, 1, 2)], axis=2)
    basis = np.linalg.qr(rigid.reshape(d * m, -1))[0]
    flat = jacobian.reshape(d * m, -1)
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(jacobian.shape))


def in_own_frame(arm: Arm) -> Arm:
    """An arm whose readings do not say where it stands as if its positions were measured in the frame of its base, of
    another instrument as if positions were read; one that reads them as it is."""
    if (instrument := arm.chain.instrument).reads_positions:
        return arm
    shown = _as_tracker(arm)
    if instrument.places:
        return shown
    chain, calibration = replace(shown.chain, base=np.eye(4), settled=shown.chain.settled | {BASE}), arm.calibration
    if calibration is not None:
        calibration = replace(calibration, values=_without(calibration.values, (BASE,)), base=None)
    return replace(shown, chain=chain, calibration=calibration)


def led_to_contact(model: Model, postures: Array, goals: Array, units: Array, target: Array | None = None) -> Array:
    """Postures (m, n) led by the shortest steps of Newton's method to where the instrument reads the goals (m, d), most
    of them; limits apart;  units : (n,) what counts as a radian of each joint [rad, mm];  target : (m,) number of what
    each touches, of several that have one; None: the nearest"""
    q = np.array(postures)
    # effort: Newton's method doubles the digits once it is near
    for _ in range(30):
        reading, slopes = model.expressions.posture_jacobian(
            q, model.condition_table(q, Conditions(marker=target)), model.values[None]
        )
        slopes = slopes * units
        across = slopes @ np.swapaxes(slopes, 1, 2)
        # slopes below this share of the largest go nowhere
        across = across + (1e-12 * np.einsum("mdd->m", across)[:, None, None] + 1e-300) * np.eye(across.shape[-1])
        steps = (np.swapaxes(slopes, 1, 2) @ np.linalg.solve(across, (goals - reading[..., 0])[..., None]))[..., 0]
        # at most 0.5 rad at a time, of a prismatic joint that share of its range / (2 pi)
        q = q + steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True) / 0.5, 1.0) * units
    return q


# -- a minimal set of parameters ---------------------------------------------------------------------------------------
def minimal(
    model: Model, least: float = DISTINCT, parts: Sequence[Part] = (), sizes: Mapping[str, float] | None = None
) -> Model:
    """The model of a spatial arm with a minimal set of geometric parameters, free of any prior; the others are zero, or
    what a calibration says.

    least : [mm] what the smallest parameter that counts moves a coordinate by, see `DISTINCT`
    parts : model, postures and conditions of each session, which has a base of its own, where these show less than
        postures inside the limits; none: every measured point at any of these
    sizes : parameter name -> what it can be off by [API unit], where that is not of the machining
    Where the measured points lie decides how many there are: for points that are to be found, of `placed_model`.
    """
    from scipy.linalg import block_diag  # deferred: fits with a prior need none of this

    if not parts:  # three equations each for some forty parameters
        postures = np.random.default_rng(0).uniform(model.arm.lower, model.arm.upper, (100, model.joints))
        markers = np.arange(len(model.arm.chain.tools), dtype=float)[:, None] * np.ones(len(postures))
        parts = [(model, postures, [Conditions(marker=marker) for marker in markers])]
    bases, others = list[Array](), list[Array]()
    off_by = {"mm": model.arm.machining.translation, "rad": model.arm.machining.rotation}
    for shown, postures, conditions in parts:
        parameters = shown.parameters
        first = (BASE, TOOL, JOINT_OFFSET, TRANSLATION_ERROR, ROTATION_ERROR)  # what is kept before what
        order, count = [k for kind in first for k in parameters.indices(kind)], len(parameters.indices(BASE))
        # what they can be off by; where things stand may be anywhere
        usual = [(sizes or {}).get(parameters[k].name, off_by[parameters[k].unit]) for k in order]
        far = [0.1 * shown.reach / parameters[k].scale for k in order]
        wide = np.where([parameters[k].kind in (BASE, TOOL) for k in order], far, usual)
        columns = np.concatenate([shown.jacobian(postures, None, at) for at in conditions])
        columns = columns.reshape(-1, len(parameters))[:, order] * wide
        bases.append(columns[:, :count])
        others.append(columns[:, count:])
    numbers = independent(np.column_stack([block_diag(*bases), np.concatenate(others)]), least)
    further = count * (len(parts) - 1)  # the base stays free where that of each session is
    kept = {order[k - further] for k in numbers if k >= further} | {*(order[:count] if further else ())}
    return _fixing(model, (parameters[k].name for k in order if k not in kept))


def practical(
    arm: Arm, measurements: Measurements, least: float = PRACTICAL, sizes: Mapping[str, float] | None = None
) -> Arm:
    """A spatial arm for fits without a prior: base and measured points where the closed form finds them, and what
    measurements hardly determine at their postures as drawn: of joints that stand still, of a level surface where axes
    lie along it. A planar arm, and a spatial one whose set was chosen, stays as it is;  least, sizes : as of `minimal`
    """
    if not arm.chain.redundant:
        return arm
    model, instrument = Model(arm), arm.chain.instrument
    placed = placed_model(model, measurements)
    # readings that do not show the size of the arm would all the same, where they do not fit, fit an arm better that is
    # next to nothing: the longest step from joint to joint stays as drawn, and what is kept takes its place
    steps, sessions = dict[str, float](), [measurements.rows(index) for index in measurements.session_rows]
    for j, joint in enumerate(arm.chain.joints if placed.arm.chain.size_is_open[0] else (), start=1):
        along = np.abs(joint.origin[:3, :3].T @ joint.origin[:3, 3]).tolist()
        steps |= {name: size for name, size in zip(error_names(j), along, strict=False) if name in placed.names}
    longest = [max(steps, key=steps.__getitem__)] if steps else []
    in_one_frame = instrument.own_targets or not instrument.contact  # wherever that stands in each session
    parts = [
        (_fixing(placed_model(model, rows), longest), rows.postures, [rows.conditions])
        for rows in ([measurements] if in_one_frame else sessions)
    ]
    return minimal(_fixing(placed, longest), least, parts, sizes).arm


def _fixing(model: Model, names: Iterable[str]) -> Model:
    """The model with these parameters as drawn, too."""
    chain = replace(model.arm.chain, fixed=model.arm.chain.fixed | frozenset(names))
    return replace(model, arm=replace(model.arm, chain=chain))


def independent(columns: Array, least: float = DISTINCT) -> list[int]:
    """Numbers of the columns (N, p) of which those kept before leave an RMS above `least` (Gram and Schmidt, twice for
    rounding)."""
    basis, kept = np.zeros((len(columns), 0)), []
    for k, left in enumerate(columns.T):
        for _ in range(2):
            left = left - basis @ (basis.T @ left)
        if (size := float(np.linalg.norm(left))) > least * np.sqrt(len(columns)):
            basis = np.column_stack([basis, left / size])
            kept.append(k)
    return kept
