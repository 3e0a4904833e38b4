"""The cells of the blind study, in the plane and in space: how arm, postures, noise and hidden effects of each data set
are drawn. Plain numpy, no model."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from doe.studies.blind import simulator
from doe.studies.blind.simulator import Drawn, RowConditions, TrueArm, Values, base_jacobian, column, off, session
from identification import Arm, Array, EffectSpec, Measurements, load_arm, spectrum

TABLE = tomllib.loads(Path(__file__).with_name("cells.toml").read_text())
EVERY_JOINT = "joint_compliance*"  # stands for the compliance of all joints at once
LIBRARY_JOINT, LIBRARY_WHOLE = (tuple(TABLE["names"][key]) for key in ("library_joint", "library_whole"))
SPACE_JOINT, SPACE_WHOLE = (tuple(TABLE["names"][key]) for key in ("space_joint", "space_whole"))
OUTSIDE, SPACE_OUTSIDE = (tuple(TABLE["names"][key]) for key in ("outside", "space_outside"))
PHYSICS_WHOLE = tuple(TABLE["names"]["physics_whole"])
PHYSICS = (*TABLE["names"]["physics_joint"], *PHYSICS_WHOLE)
SINCE_INSIDE = {"free_ripple": "transmission_ripple", "step_drift": "base_step"}  # of `OUTSIDE`
OF_ARM = (*LIBRARY_WHOLE, *PHYSICS_WHOLE, "step_drift")
NOT_INSIDE = {*OUTSIDE, *SPACE_OUTSIDE, *PHYSICS} - set(SINCE_INSIDE)
COUNTS = {"small": (14, 22), "several": (6, 9)}  # of many effects at once, the least and the most
EXPLAINED = 0.5  # of the square of an effect outside the library, at most, by any one of it; in 20 draws or never
WALK = "walk"  # the noise that may be reported as a drift in time
FRESH = 200  # rows of the hold-out
SAME_ARM = 10  # consecutive sets with one arm and plan where plans are designed, which takes time


@dataclass(frozen=True)
class DataSet:
    """Arm and measurements as a user has them, and what is hidden in them."""

    arm: Arm
    measurements: Measurements
    holdout: Measurements | None
    effects: tuple[str, ...]  # keys of the hidden effects that the library has
    outside: str | None  # name of what is hidden and not in the library
    place: str | None  # where that sits, alternatives between ` or `; None: no place is right
    specs: tuple[EffectSpec, ...]  # the hidden effects as an arm file has them, to fit the true model
    wrong_rows: tuple[int, ...]  # outliers, counted from 1
    # parameter name -> true value of hidden effects and, in the plane, of the base [API units], to judge intervals;
    # empty where the library has no such effect
    values: Mapping[str, float]
    exact: Array | None  # (200, d) hold-out without noise [mm], where many effects are hidden or one outside
    reachable: float | None  # RMS [mm] from `exact` of a model with what is hidden, fitted to these data
    further: Callable[[Array, Array | None], Measurements]  # the data and those at postures (K, n), with directions


@dataclass(frozen=True)
class CellSpec:
    """What is drawn in a cell of the study; of the cells in cells.toml."""

    rows: Sequence[int]  # one of them is the number of rows
    number: int = 0  # of the cell, in the seeds of its data
    lam: float | None = None  # size of the hidden effects, None: nothing is hidden
    sizes: Sequence[float] = ()  # each lambda is drawn between these instead
    space: bool = False
    effects: int = 1  # how many are hidden, of different families
    noise: str = "white"  # see `noise`
    outside: bool = False  # the hidden effect is one that the library does not have
    reported: bool = True  # in the full study; the others can be asked for by name
    many: str = ""  # a key of `COUNTS`: as many effects of the library, drawn at random, one of gravity
    links: Sequence[int] = (2, 6)  # least and most, in the plane
    physics: str = ""  # the hidden effect is that one of `PHYSICS`
    sets: int = 400  # in a study
    reads: int = 1  # of each posture, one after another, with an error they share
    reflectors: int = 1  # measured points, taking turns
    designed: bool = False  # postures of somebody's plan instead of random ones, the same for SAME_ARM sets

    def generator(self, seed: int) -> np.random.Generator:
        """Of data set number `seed`."""
        return np.random.default_rng([20261125 if self.space else 20261121, self.number, seed])


CELLS = {name: CellSpec(**spec) for name, spec in TABLE["plane"].items()}
# in space a diagnosis takes ten times as long
CELLS |= {f"space, {name}": CellSpec(**spec, space=True, sets=100) for name, spec in TABLE["space"].items()}


# -- arms --------------------------------------------------------------------------------------------------------------
def random_truth(rng: np.random.Generator, n: int) -> TrueArm:
    """A planar arm of n links, its lengths 1 mm and its encoders 8 mrad off."""
    lengths = np.round(rng.uniform(80.0, 400.0, n))
    masses, payload = lengths / 100.0 * rng.uniform(1.0, 5.0, n), float(rng.uniform(1.0, 12.0))
    loads: Values = {"masses": masses, "payload": payload, "sigma": float(rng.choice([0.02, 0.05, 0.1, 0.2]))}
    errors, limit = (rng.normal(0.0, 1.0, n), rng.normal(0.0, 0.008, n)), np.full(n, np.pi)
    return TrueArm.planar(lengths, *errors, lower=-limit, upper=limit, **loads)


def truth_of(spec: CellSpec, rng: np.random.Generator) -> TrueArm:
    """The arm of a data set, in space of six axes and one of two common builds, its axes 2 mrad and 0.5 mm off, its
    encoders 5 mrad."""
    if not spec.space:
        return random_truth(rng, int(rng.integers(spec.links[0], spec.links[1] + 1)))
    half, lengths = np.pi / 2.0, np.round(rng.uniform([150, 300, 250, 80, 80, 60], [500, 700, 600, 200, 130, 120]))
    rise, upper, fore, *wrist = lengths.tolist()
    if rng.random() < 0.5:  # three parallel axes and an offset wrist
        rows = [(0.0, half, rise), (-upper, 0.0, 0.0), (-fore, 0.0, 0.0), (0.0, half, wrist[0])]
        rows += [(0.0, -half, wrist[1]), (0.0, 0.0, wrist[2])]
    else:  # a wrist whose axes meet
        rows = [(wrist[0], -half, rise), (upper, 0.0, 0.0), (wrist[1], -half, 0.0), (0.0, half, fore)]
        rows += [(0.0, -half, 0.0), (0.0, 0.0, wrist[2])]
    table = np.array(rows)
    span = rng.uniform(1.5, 2.9, 6)
    aside = rng.uniform(30.0, 80.0, (2, 2)) * rng.choice([-1.0, 1.0], (2, 2))
    tools = np.column_stack([aside, rng.uniform(40, 100, 2)])[: spec.reflectors]
    base = simulator.shift(rng.uniform(-1500.0, 1500.0, 3))
    base[:3, :3] = simulator.turn(rng.normal(0.0, 1.0, 3))
    masses = 1.0 + np.hypot(table[:, 0], table[:, 2]) / 100.0 * rng.uniform(1.0, 4.0, 6)
    loads = {"masses": masses, "payload": float(rng.uniform(2.0, 10.0)), "sigma": float(rng.choice([0.02, 0.05, 0.1]))}
    offsets = rng.normal(0.0, 5e-3, 6)
    place = {"base": base, "tools": tools, "lower": -span, "upper": span}
    return TrueArm.built(table, rng, 2e-3, 0.5, offsets=offsets, **place, **loads)


def arm_of(truth: TrueArm) -> Arm:
    """The arm as its maker describes it, who in space does not know where base and reflectors are."""
    gravity = {
        "acceleration_m_s2": (-simulator.G * np.eye(truth.dimension)[-1]).tolist(),
        "link_masses_kg": truth.masses.tolist(),
        "center_of_mass": [truth.center] * truth.n,
        "payload_kg": truth.payload,
    }
    limits = {side: np.degrees(getattr(truth, side)).tolist() for side in ("lower", "upper")}
    tables = {"joint_limits_deg": limits, "measurement": {"sigma_mm": truth.sigma}, "gravity": gravity}
    if truth.in_plane:
        arm = load_arm(tables | {"links_mm": truth.lengths.tolist()})
    else:
        rows = [{"a_mm": a, "alpha_deg": float(np.degrees(alpha)), "d_mm": d} for a, alpha, d in truth.table.tolist()]
        arm = load_arm(tables | {"kind": "spatial", "dh": rows})
        arm = replace(arm, chain=replace(arm.chain, tools={str(k + 1): np.zeros(3) for k in range(len(truth.tools))}))
    return arm.with_effects(*(EffectSpec(e[0], e[1], numbered(e[2])) for e in truth.modelled))


def to_be_planned(cell: str, seed: int) -> tuple[Arm, int]:
    """Arm and number of postures of a cell whose plan is designed."""
    truth = shared_truth(cell, seed)
    return arm_of(truth), max(*CELLS[cell].rows, truth.n + 4)


def shared_truth(cell: str, seed: int) -> TrueArm:
    """The arm of SAME_ARM consecutive sets."""
    return truth_of(CELLS[cell], np.random.default_rng([20261122, CELLS[cell].number, seed // SAME_ARM]))


# -- data sets ---------------------------------------------------------------------------------------------------------
def data_set(cell: str, seed: int, planned: Array | None = None) -> DataSet:
    """Data set number `seed` of a cell; `FRESH` rows of the same session are held out.

    planned : (m, n) the postures for the arm of `to_be_planned`
    """
    spec = CELLS[cell]
    rng = spec.generator(seed)
    truth = shared_truth(cell, seed) if spec.designed else truth_of(spec, rng)

    def measured_at(postures: Array | None, count: int, times: int) -> RowConditions:
        """Each posture (None: random ones) is measured at every reflector, and as often as it is read, before the arm
        goes on."""
        if postures is None:
            postures = rng.uniform(truth.lower, truth.upper, (count // times // spec.reflectors, truth.n))
        return session(truth, np.repeat(postures, times * spec.reflectors, axis=0), rng, spec.reflectors)

    m = max(int(rng.choice(spec.rows)) if len(spec.rows) > 1 else spec.rows[0], truth.n + 4)
    run = measured_at(planned, m, spec.reads)
    if spec.physics == "payload_swap":  # it only shows through compliance that the model has
        truth = replace(truth, modelled=[("joint_compliance", None, {"c": 1e-5 * rng.uniform(0.5, 1.5, truth.n)})])
    fresh = measured_at(None, FRESH, 1) if spec.space else None  # in this order since the study began
    truth = replace(truth, effects=hidden(spec, truth, run, rng))
    fresh = fresh or measured_at(None, FRESH, 1)
    outside = next((e for e in truth.effects if e[0] in NOT_INSIDE), None)
    inside = [e for e in truth.effects if e[0] not in NOT_INSIDE]
    error = simulator.noise(truth, run, rng, spec.noise)
    data = simulator.recorded(truth, run, error)
    held_out = simulator.noise(truth, fresh, rng, "posture" if spec.reads > 1 else "white")
    if spec.reads > 1:
        data = replace(data, repeats=np.arange(m) // spec.reads)
    far = np.linalg.norm(error, axis=1) > 10.0 * truth.sigma if spec.noise == "outliers" else np.zeros(m)

    def further(q: Array, directions: Array | None) -> Measurements:
        """The same session goes on, its first rows as they were."""
        later, count = np.random.default_rng([20261123, spec.number, seed, len(q)]), len(q)
        s = session(truth, np.vstack([data.postures, q]), later).s[m:] if directions is None else directions
        t, warm = 0.5 + np.arange(1, count + 1) / (m - 1), later.normal(0.0, 1.0, count)
        later_rows = RowConditions(q, t, warm, s, np.full(count, truth.payload), np.zeros(count, dtype=int))
        whole = RowConditions(*map(np.concatenate, zip(vars(run).values(), vars(later_rows).values(), strict=True)))
        error = np.vstack([data.positions - simulator.position(truth, run), simulator.noise(truth, later_rows, later)])
        return replace(simulator.recorded(truth, whole, error), payload=whole.payload)

    exact = reachable = None
    if spec.many or outside or spec.reads > 1:  # by least squares of all that is hidden, to first order
        # the geometry and an amplitude of each hidden effect
        columns, at_fresh = (
            np.column_stack([base_jacobian(truth, rows), *(column(truth, rows, effect) for effect in truth.effects)])
            for rows in (run, fresh)
        )
        root = spectrum(columns, np.ones(columns.shape[1])).root
        exact, wrong = simulator.position(truth, fresh), root @ ((columns @ root).T @ error.ravel())
        reachable = float(np.sqrt(truth.dimension * np.mean((at_fresh @ wrong) ** 2)))
    values: dict[str, float] = {}  # in space without the geometry, which others say differently
    if not (spec.outside or outside):
        if truth.in_plane:
            errors = {"length_error": truth.links[:, 0] - truth.lengths, "joint_offset": truth.offsets}
            values = {f"{name}:{j + 1}": float(error[j]) for j in range(truth.n) for name, error in errors.items()}
        for effect in truth.effects:
            values |= {f"{key(effect)}.{name}": value for name, value in numbered(effect[2]).items()}
    return DataSet(
        arm=arm_of(truth),
        measurements=data,
        holdout=simulator.recorded(truth, fresh, held_out) if truth.effects or spec.reads > 1 else None,
        effects=tuple(key(e) for e in inside),
        outside=outside[0] if outside else WALK if spec.noise == WALK else None,
        place=place_of(outside) if outside else "time" if spec.noise == WALK else None,
        specs=tuple(EffectSpec(name, joint, settings(name, values)) for name, joint, values in inside),
        wrong_rows=tuple((np.flatnonzero(far) + 1).tolist()),
        values=values,
        exact=exact,
        reachable=reachable,
        further=further,
    )


def settings(name: str, values: Values) -> dict[str, float]:
    """Of an effect as an arm file has it, what is not estimated."""
    return {s: float(values[s]) for s in ("k", "at") if s in values} | ({"side": 1.0} if name == "base_step" else {})


def numbered(values: Values) -> dict[str, float]:
    """Amplitudes of an effect, named as the library names its parameters: `v` of a drift is vx, vy; `c` c1, c2, .."""
    named: dict[str, float] = {}
    for name in (name for name in values if name not in simulator.SHAPES):
        parts = np.atleast_1d(values[name]).tolist()
        ends = [""] if np.ndim(values[name]) == 0 else "xyz" if name in "vw" else range(1, len(parts) + 1)
        named |= {f"{name}{end}": part for end, part in zip(ends, parts, strict=False)}
    return named


def key(effect: Drawn) -> str:
    """NAME or NAME:JOINT."""
    return effect[0] if effect[1] is None else f"{effect[0]}:{effect[1]}"


def family(effect: Drawn) -> str:
    """What effects are said to be alike."""
    return "gravity" if effect[0] in simulator.OF_GRAVITY else effect[0]


def place_of(effect: Drawn) -> str | None:
    """Where an effect outside the library may be said to be, alternatives between ` or `; None: nowhere is right."""
    name, joint, v = effect
    if joint is None:
        whole = {"refraction": "workspace", "gripper_play": None, "warm_offset": "temperature or time"}
        whole |= {"payload_swap": "time or payload"}
        return whole.get(name, "time")
    second = {"two_joint_cable": joint + 1, "cross_talk": v.get("other")}.get(name)
    return f"joint:{joint}" + (f" or joint:{second}" if second else "")


# -- hidden effects ----------------------------------------------------------------------------------------------------
def joints_of(name: str, n: int) -> Sequence[int | None]:
    """Joints of n, from 1, that an effect of this name can be of; (None,): it is of the whole arm."""
    return (None,) if name in OF_ARM else range(1 + (name == "joint_coupling"), n + (name != "two_joint_cable"))


def hidden(spec: CellSpec, truth: TrueArm, run: RowConditions, rng: np.random.Generator) -> list[Drawn]:
    """The effects of a data set."""
    effects: list[Drawn] = []
    names: tuple[str, ...] = SPACE_JOINT + SPACE_WHOLE if spec.space else LIBRARY_JOINT + LIBRARY_WHOLE
    if spec.many:  # what a real robot has at once, each effect of its own size
        listed = [(name, joint) for name in names for joint in joints_of(name, truth.n)]
        listed = [listed[k] for k in rng.permutation(len(listed))]
        of_gravity = [place for place in listed if place[0].rstrip("*") in simulator.OF_GRAVITY]
        listed = [place for place in listed if place not in of_gravity[1:]]
        if spec.many == "small":  # one or more in every joint
            first = {j: (name, j) for name, j in reversed(listed) if j is not None}
            listed = [*first.values(), *(place for place in listed if place not in first.values())]
        (fewest, most), limits = COUNTS[spec.many], np.log(spec.sizes)
        count, span = int(rng.integers(fewest, most + 1)), base_jacobian(truth, run)
        for name, joint in listed:
            lam = None if spec.space else rng.uniform(*limits)  # in this order since the study began
            direction = directions(truth, name, joint, rng)
            size = float(np.exp(rng.uniform(*limits) if lam is None else lam))
            if (effect := sized(truth, run, (name, joint, direction), size, span)) is not None:
                effects.append(effect)
            if len(effects) == count:
                break
        return effects
    if spec.physics:
        return [physics_effect(truth, run, spec.physics, float(np.exp(rng.uniform(*np.log(spec.sizes)))), rng)]
    if spec.lam is None:
        return []
    if spec.outside:
        names = SPACE_OUTSIDE if spec.space else OUTSIDE
    span = library_columns(truth, run) if spec.outside else base_jacobian(truth, run)
    while len(effects) < spec.effects:
        new = random_effect(names, truth, run, spec.lam, rng, span)
        if family(new) not in map(family, effects):
            effects.append(new)
    return effects


def directions(truth: TrueArm, name: str, joint: int | None, rng: np.random.Generator) -> Values:
    """A random direction in an effect's parameter space; scaled afterwards."""
    n, reach = truth.n, float(truth.lengths.sum())
    shapes: dict[str, Values]  # all of them are drawn, of which one is used
    if not truth.in_plane and name in ("base_drift", "base_rotation_drift", "warm_offset"):
        direction = rng.normal(0.0, 1.0, 3)
        return {"w" if name == "base_rotation_drift" else "v": direction / np.linalg.norm(direction)}
    if name in ("bearing_compliance", "axis_wobble"):
        return {"c": 1.0}
    if name in PHYSICS:
        sign, phase = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)
        a, b = np.cos(phase), np.sin(phase)
        middle, width = rng.uniform(-1.0, 1.0), rng.uniform(0.5, 1.5)
        start, end = np.sort(rng.choice(np.linspace(-0.4, 0.4, 9), 2, replace=False))
        others, fast, slow = [k for k in range(1, n + 1) if k != joint], [0.03, 0.3], [0.08, 0.8]
        shapes = {
            "memory_hysteresis": {"h": sign, "at": middle, "width": width},
            "two_joint_cable": {"c": sign, "at": middle},
            "gear_wear": {"h": sign, "at": 2.0 * middle, "width": 0.3 * width},
            "cross_talk": {"a": a, "b": b, "other": int(rng.choice(others))},
            "stick_slip": {"b": sign, "width": 1.0 + width},
            "gripper_play": {"h": 1.0, "beta": phase},
            "refraction": {"c": sign, "at": rng.uniform(0.0, 0.5) * reach * np.array([a, b])},  # from there
            "two_warm_ups": {"a": sign, "b": -sign * rng.uniform(0.7, 1.4), "tau": rng.uniform(fast, slow)},
            "payload_swap": {"d": sign, "at": (float(start), float(end))},
            "warm_offset": {"v": np.array([a, b])},
        }
        return shapes[name]
    phase = rng.uniform(0, 2 * np.pi)
    a, b = np.cos(phase), np.sin(phase)
    if name == "transmission_ripple":
        return {"a": a, "b": b, "k": int(rng.integers(3, 65))}
    if name == "free_ripple":
        return {"a": a, "b": b, "k": rng.uniform(65, 120) if rng.random() < 0.5 else int(rng.integers(3, 60)) + 0.5}
    if name == "step_drift":
        return {"x": a, "y": b, "at": rng.uniform(-0.3, 0.3)}
    if name in ("encoder_eccentricity", "encoder_second_harmonic", "axes_skew", "axis_runout"):
        return {"a": a, "b": b}
    if name in ("base_offset", "base_drift"):
        return {"x0": a, "y0": b} if name == "base_offset" else {"v": np.array([a, b])}
    sign = rng.choice([-1.0, 1.0])
    shapes = {
        "joint_compliance": {"c": 1.0},
        EVERY_JOINT: {"c": rng.uniform(0.5, 1.5, n)},
        "gear_ratio": {"e": sign},
        "joint_coupling": {"c": sign},
        "backlash": {"b": sign},
        "gravity_backlash": {"b": 1.0},
        "link_bending": {"flexibility": 1.0},
        "thermal_growth": {"a": sign},
        "base_rotation_drift": {"w": sign},
        "bump": {"h": sign, "at": rng.uniform(-2.0, 2.0), "width": rng.uniform(0.3, 0.6)},
        "cubic": {"c": sign},
        "cable_pull": {"c": sign},
    }
    return shapes[name]


def sized(truth: TrueArm, run: RowConditions, effect: Drawn, lam: float, span: Array | None = None) -> Drawn | None:
    """The effect so large that off the geometry, or the columns (m d, C) of a span, it is lambda sigma long; None where
    it is unseen. By the name that the library has for it."""
    name, joint, values = SINCE_INSIDE.get(effect[0], effect[0]).rstrip("*"), *effect[1:]
    whole = column(truth, run, (name, joint, values))
    seen = float(np.linalg.norm(off(base_jacobian(truth, run) if span is None else span, whole)))
    if seen <= 0.02 * np.linalg.norm(whole):  # hardly anything of its length is left
        return None
    return name, joint, simulator.scaled_amplitudes(values, lam * truth.sigma / seen)


def random_effect(
    names: Sequence[str], truth: TrueArm, run: RowConditions, lam: float, rng: np.random.Generator, span: Array
) -> Drawn:
    """One effect, its type at random, then its joint, of size lambda as in `sized`."""
    while True:
        name = str(rng.choice(names))
        joints = joints_of(name, truth.n)
        joint = None if joints[0] is None else int(rng.integers(joints[0], joints[0] + len(joints)))
        if (effect := sized(truth, run, (name, joint, directions(truth, name, joint, rng)), lam, span)) is not None:
            return effect


def probed(truth: TrueArm, run: RowConditions, name: str, joint: int | None, values: Values | None = None) -> Array:
    """(m d, c) columns of each amplitude of an effect;  values : with its shapes, left out: drawn"""
    values = values or directions(truth, name, joint, np.random.default_rng(0))
    columns, zero = [], simulator.scaled_amplitudes(values, 0.0)
    for amplitude in (key for key in values if key not in simulator.SHAPES):
        each = np.eye(np.size(values[amplitude])) if np.ndim(values[amplitude]) else [1.0]
        columns += [column(truth, run, (name, joint, zero | {amplitude: one})) for one in each]
    return np.stack(columns, axis=1)


def library_columns(truth: TrueArm, run: RowConditions) -> Array:
    """(m d, C) of the geometry and of every effect of the library but the ripples."""
    names = LIBRARY_JOINT + LIBRARY_WHOLE if truth.in_plane else (*SPACE_JOINT, "axis_runout", *SPACE_WHOLE)
    others = [name for name in names if name not in ("transmission_ripple", EVERY_JOINT)]
    blocks = [probed(truth, run, name, joint) for name in others for joint in joints_of(name, truth.n)]
    return np.hstack([base_jacobian(truth, run), *blocks])


def physics_effect(truth: TrueArm, run: RowConditions, name: str, lam: float, rng: np.random.Generator) -> Drawn:
    """One of `PHYSICS`, of size lambda: in space off all of the library at once; in the plane off the geometry, the
    first of some draws of which no effect of the library explains more than `EXPLAINED`, or else that of which it
    explains least; effects with settings at several of them."""
    if not truth.in_plane:
        return random_effect((name,), truth, run, lam, rng, library_columns(truth, run))
    n, base = truth.n, base_jacobian(truth, run)
    # how the length and the angle of each link move the tip: (m, 2, n); a joint's angle turns all links beyond
    along, across = np.moveaxis(base.reshape(-1, 2, n, 2), -1, 0)
    lever = np.cumsum((across * truth.links[:, 0])[..., ::-1], axis=-1)[..., ::-1]
    torques = np.einsum("mji,ji->mj", simulator.gravity_loads(truth, run)[0], truth.home[:-1, :3, 2])
    steps = np.stack([1.0 * (run.t > at) for at in np.linspace(-0.4, 0.4, 17)])
    moves = [lever * torques[:, None]]  # every joint at once
    moves += [step[:, None, None] * np.eye(2) for step in steps]
    for j, q in enumerate(run.q.T):
        wound = [simulator.wound_up(q, share * (truth.upper[j] - truth.lower[j])) for share in (0.05, 0.1, 0.2, 0.4)]
        shapes = [np.column_stack([np.cos(k * q), np.sin(k * q)]) for k in range(1, 65)]
        alone = [q, run.s[:, j], np.sign(torques[:, j]), torques[:, j], *steps, *wound]
        shapes += [shape[:, None] for shape in (*alone, *([run.q[:, j - 1]] if j else []))]
        moves += [lever[:, :, j, None] * shape[:, None] for shape in shapes]
        moves += [(along[:, :, j] * step[:, None])[:, :, None] for step in steps]
    blocks = [move.reshape(2 * len(run.q), -1) for move in moves]
    blocks += [probed(truth, run, whole, None) for whole in LIBRARY_WHOLE if whole != EVERY_JOINT]
    taus = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
    blocks += [probed(truth, run, "thermal_transient", None, {"a": 1.0, "tau": tau}) for tau in taus]
    loads = {"payload_error": {"d": 1.0}, "gravity_tilt": {"angle": 1.0}} if truth.modelled else {}
    blocks += [probed(truth, run, load, None, values) for load, values in loads.items()]
    ends = np.cumsum([block.shape[1] for block in blocks])[:-1]
    blocks = [np.linalg.qr(block)[0] for block in np.split(off(base, np.hstack(blocks)), ends, axis=1)]
    drawn: list[tuple[float, Drawn]] = []
    while not drawn or (drawn[-1][0] > EXPLAINED and len(drawn) < 20):
        effect = random_effect((name,), truth, run, lam, rng, base)
        left = off(base, column(truth, run, effect))
        drawn.append((max(float(np.sum((left @ block) ** 2)) for block in blocks) / float(left @ left), effect))
    return min(drawn, key=lambda one: one[0])[1]
