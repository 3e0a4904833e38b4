"""Hidden effects drawn at random with a given size lambda: of the library, rare ones, and physics it does not have.

In the plane and in space. Plain numpy, no model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from doe.studies.blind.simulator import (
    OF_GRAVITY,
    SHAPES,
    Drawn,
    RowConditions,
    TrueArm,
    Values,
    base_jacobian,
    column,
    moments,
    off,
    places,
    scaled_amplitudes,
    wound_up,
)
from identification import Array

EVERY_JOINT = "joint_compliance*"  # stands for the compliance of all joints at once
COMMON = ("encoder_eccentricity", "encoder_second_harmonic", "transmission_ripple", "gear_ratio", "joint_coupling")
LIBRARY_JOINT = ("joint_compliance", *COMMON, "backlash", "gravity_backlash")
LIBRARY_WHOLE = (
    *(EVERY_JOINT, "link_bending", "thermal_growth", "base_offset", "base_drift", "base_rotation_drift"),
    "axes_skew",
)
SPACE_JOINT = ("joint_compliance", "gravity_backlash", "bearing_compliance", *COMMON, "backlash")
SPACE_WHOLE = (EVERY_JOINT, "thermal_growth", "base_drift", "base_rotation_drift")
OUTSIDE = ("free_ripple", "bump", "cubic", "cable_pull", "step_drift")  # when the study began; two are inside by now
SINCE_INSIDE = {"free_ripple": "transmission_ripple", "step_drift": "base_step"}
SPACE_OUTSIDE = ("bump", "cubic", "cable_pull", "axis_wobble")
LOADS = ("payload_error", "gravity_tilt")
RARE_JOINT = ("joint_step", "link_step", "axis_tilt", "joint_hysteresis")
RARE_WHOLE = ("thermal_transient", "base_step", *LOADS)
# not in the library, and in the plane no one effect of it explains half of them
PHYSICS_JOINT = ("memory_hysteresis", "two_joint_cable", "gear_wear", "cross_talk", "stick_slip")
PHYSICS_WHOLE = ("gripper_play", "refraction", "two_warm_ups", "payload_swap", "warm_offset")
PHYSICS = PHYSICS_JOINT + PHYSICS_WHOLE
SPACE_PHYSICS = (*PHYSICS_JOINT, "two_warm_ups", "warm_offset")
OF_ARM = (*LIBRARY_WHOLE, *RARE_WHOLE, *PHYSICS_WHOLE, "step_drift")
NOT_INSIDE = {*OUTSIDE, *SPACE_OUTSIDE, *PHYSICS} - set(SINCE_INSIDE)
COUNTS = {"small": (14, 22), "several": (6, 9)}  # of many effects at once, the least and the most
SEEN = 0.02  # of an effect's length that must be left beside the geometry
EXPLAINED = 0.5  # of the square of an effect outside the library, at most, by any one of it; in 20 draws or never


def directions(truth: TrueArm, name: str, joint: int | None, rng: np.random.Generator) -> Values:
    """A random direction in an effect's parameter space; scaled afterwards."""
    n, reach, space = truth.n, float(truth.lengths.sum()), truth.dimension == 3
    if space and name in ("base_drift", "base_rotation_drift", "warm_offset"):
        direction = rng.normal(0.0, 1.0, 3)
        return {"w" if name == "base_rotation_drift" else "v": direction / np.linalg.norm(direction)}
    if name in ("bearing_compliance", "axis_wobble"):
        return {"c": 1.0}
    if name in PHYSICS:
        return _physics(name, joint, n, reach, rng)
    if name in RARE_JOINT + RARE_WHOLE:
        return _rare(name, 0.0 if joint is None else float(truth.upper[joint - 1] - truth.lower[joint - 1]), rng)
    phase = rng.uniform(0, 2 * np.pi)
    a, b = np.cos(phase), np.sin(phase)
    match name:
        case "encoder_eccentricity" | "encoder_second_harmonic" | "axes_skew" | "axis_runout":
            return {"a": a, "b": b}
        case "transmission_ripple":
            return {"a": a, "b": b, "k": int(rng.integers(3, 65))}
        case "free_ripple":
            return {"a": a, "b": b, "k": rng.uniform(65, 120) if rng.random() < 0.5 else int(rng.integers(3, 60)) + 0.5}
        case "base_offset":
            return {"x0": a, "y0": b}
        case "base_drift":
            return {"v": np.array([a, b])}
        case "step_drift":
            return {"x": a, "y": b, "at": rng.uniform(-0.3, 0.3)}
    sign = rng.choice([-1.0, 1.0])
    of_one_sign: dict[str, Values] = {
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
    return of_one_sign[name]


def _rare(name: str, span: float, rng: np.random.Generator) -> Values:
    """As `directions`;  span : range of the joint [rad]."""
    sign, phase = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)
    at = rng.uniform(-0.35, 0.35)
    drawn: dict[str, Values] = {
        "thermal_transient": {"a": sign, "tau": float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))},
        "joint_step": {"b": sign, "at": at},
        "link_step": {"d": sign, "at": at},
        "base_step": {"x": np.cos(phase), "y": np.sin(phase), "at": at},
        "payload_error": {"d": sign},
        "gravity_tilt": {"angle": sign},
        "axis_tilt": {"square": 1.0, "beta": phase},
        "joint_hysteresis": {"b": sign, "width_deg": float(np.degrees(span * rng.uniform(0.1, 0.4)))},
    }
    return drawn[name]


def _physics(name: str, joint: int | None, n: int, reach: float, rng: np.random.Generator) -> Values:
    """As `directions`, for an arm of n joints and this reach [mm]."""
    sign, phase = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)
    a, b = np.cos(phase), np.sin(phase)
    middle, width = rng.uniform(-1.0, 1.0), rng.uniform(0.5, 1.5)
    start, end = np.sort(rng.choice(np.linspace(-0.4, 0.4, 9), 2, replace=False))
    others = [k for k in range(1, n + 1) if k != joint]
    drawn: dict[str, Values] = {
        "memory_hysteresis": {"h": sign, "at": middle, "width": width},
        "two_joint_cable": {"c": sign, "at": middle},
        "gear_wear": {"h": sign, "at": 2.0 * middle, "width": 0.3 * width},
        "cross_talk": {"a": a, "b": b, "other": int(rng.choice(others))},
        "stick_slip": {"b": sign, "width": 1.0 + width},
        "gripper_play": {"h": 1.0, "beta": phase},
        "refraction": {"c": sign, "at": rng.uniform(0.0, 0.5) * reach * np.array([a, b])},  # from there
        "two_warm_ups": {"a": sign, "b": -sign * rng.uniform(0.7, 1.4), "tau": rng.uniform([0.03, 0.3], [0.08, 0.8])},
        "payload_swap": {"d": sign, "at": (float(start), float(end))},
        "warm_offset": {"v": np.array([a, b])},
    }
    return drawn[name]


# -- sizes -------------------------------------------------------------------------------------------------------------
def sized(truth: TrueArm, run: RowConditions, effect: Drawn, lam: float, span: Array | None = None) -> Drawn | None:
    """The effect so large that off the geometry, or the columns (m d, C) of a span, it is lambda sigma long; None where
    it is unseen. By the name that the library has for it."""
    name, joint, values = SINCE_INSIDE.get(effect[0], effect[0]).rstrip("*"), *effect[1:]
    whole = column(truth, run, (name, joint, values))
    seen = float(np.linalg.norm(off(base_jacobian(truth, run) if span is None else span, whole)))
    if seen <= SEEN * np.linalg.norm(whole):
        return None
    return name, joint, scaled_amplitudes(values, lam * truth.sigma / seen)


def random_effect(
    names: Sequence[str],
    truth: TrueArm,
    run: RowConditions,
    lam: float,
    rng: np.random.Generator,
    span: Array | None = None,
    **settings: float,
) -> Drawn:
    """One effect, its type at random, then its joint, of size lambda as in `sized`."""
    span = base_jacobian(truth, run) if span is None else span
    while True:
        name = str(rng.choice(names))
        first, last = 2 if name in ("joint_coupling", "axis_tilt") else 1, truth.n - (name == "two_joint_cable")
        joint = None if name in OF_ARM else int(rng.integers(first, last + 1))
        direction = directions(truth, name, joint, rng) | settings
        if (effect := sized(truth, run, (name, joint, direction), lam, span)) is not None:
            return effect


def log_uniform(sizes: Sequence[float], rng: np.random.Generator) -> float:
    """A size lambda between two, even on a logarithmic scale."""
    low, high = np.log(sizes)
    return float(np.exp(rng.uniform(low, high)))


def many_effects(
    truth: TrueArm, run: RowConditions, kind: str, sizes: Sequence[float], rng: np.random.Generator
) -> list[Drawn]:
    """What a real robot has at once, each effect of its own size lambda between two.

    kind : `robot`: compliance of all joints, every encoder eccentric, backlash in one joint and a ripple in one, in the
        plane an offset of the base; `harmonics`: first and second harmonic of every encoder; one of `COUNTS`: so many
        effects of the library at random, of gravity one, `small`: one or more in every joint
    """
    listed: list[tuple[str, int | None]] = [("encoder_eccentricity", j + 1) for j in range(truth.n)]
    most = None
    if kind in COUNTS:
        listed = list(_at_random(truth, kind == "small", rng))
        most = int(rng.integers(COUNTS[kind][0], COUNTS[kind][1] + 1))
    elif kind == "harmonics":
        listed += [("encoder_second_harmonic", j + 1) for j in range(truth.n)]
    else:
        listed += [(EVERY_JOINT, None)] + ([("base_offset", None)] if truth.in_plane else [])
        listed += [(name, int(rng.integers(1, truth.n + 1))) for name in ("backlash", "transmission_ripple")]
    span = base_jacobian(truth, run)

    def drawn(name: str, joint: int | None) -> Drawn | None:
        lam = log_uniform(sizes, rng) if truth.in_plane else None  # in this order since the study began
        direction = directions(truth, name, joint, rng)
        return sized(truth, run, (name, joint, direction), lam or log_uniform(sizes, rng), span)

    every = (drawn(name, joint) for name, joint in listed)
    return list(islice((effect for effect in every if effect is not None), most))


def _at_random(truth: TrueArm, everywhere: bool, rng: np.random.Generator) -> Iterator[tuple[str, int | None]]:
    """All effects of the library in a random order, of gravity only the first.

    everywhere : one of each joint comes before the others
    """
    of_joint, of_arm = library_names(truth)
    every = [(name, j) for name in of_joint for j in range(2 if name == "joint_coupling" else 1, truth.n + 1)]
    every += [(name, None) for name in of_arm]  # type: ignore[misc]
    listed = [every[k] for k in rng.permutation(len(every))]
    of_gravity = [place for place in listed if place[0].rstrip("*") in OF_GRAVITY]
    listed = [place for place in listed if place not in of_gravity[1:]]
    first = {j: (name, j) for name, j in reversed(listed) if j is not None} if everywhere else {}
    yield from first.values()
    yield from (place for place in listed if place not in first.values())


def loaded(truth: TrueArm, run: RowConditions, lam: float, rng: np.random.Generator) -> list[Drawn]:
    """Compliance in all joints, such that the payload's place adds lambda sigma off the compliance that would fit best
    without it; and that place."""
    assert truth.load is not None
    c = rng.uniform(0.5, 1.5, truth.n)
    effects = [("joint_compliance", j, {"c": float(one)}) for j, one in enumerate(c, start=1)]
    elsewhere, plain = (
        np.stack([column(arm, run, effect) for effect in effects], axis=1) for arm in (truth, replace(truth, load=None))
    )
    unseen = np.column_stack([base_jacobian(truth, run), plain])
    size = lam * truth.sigma / np.linalg.norm(off(unseen, np.sum(elsewhere - plain, axis=1)))
    place = dict(zip("xyz", (truth.load - truth.tools[0]).tolist(), strict=True))
    return [("joint_compliance", None, {"c": size * c}), ("payload_place", None, place)]


# -- the library's columns ---------------------------------------------------------------------------------------------
def library_names(truth: TrueArm) -> tuple[Sequence[str], Sequence[str]]:
    """Effects of the library that are hidden in such an arm: of a joint, and of the whole arm."""
    return (LIBRARY_JOINT, LIBRARY_WHOLE) if truth.in_plane else (SPACE_JOINT, SPACE_WHOLE)


def probed(truth: TrueArm, run: RowConditions, name: str, joint: int | None, **settings: float) -> Array:
    """(m d, c) columns of each amplitude of an effect."""
    values = directions(truth, name, joint, np.random.default_rng(0)) | settings
    columns = []
    for amplitude in (key for key in values if key not in SHAPES):
        zero = scaled_amplitudes(values, 0.0)
        each = np.eye(np.size(values[amplitude])) if np.ndim(values[amplitude]) else [1.0]
        columns += [column(truth, run, (name, joint, zero | {amplitude: one})) for one in each]
    return np.stack(columns, axis=1)


def library_columns(truth: TrueArm, run: RowConditions) -> Array:
    """(m d, C) of the geometry and of every effect of the library but the ripples."""
    of_joint, of_arm = library_names(truth)
    names = [*of_joint, *(("axis_runout",) if truth.dimension == 3 else ()), *of_arm]
    blocks = [base_jacobian(truth, run)]
    for name in (name for name in names if name not in ("transmission_ripple", EVERY_JOINT)):
        first = 2 if name == "joint_coupling" else 1
        blocks += [probed(truth, run, name, j) for j in ([None] if name in of_arm else range(first, truth.n + 1))]
    return np.hstack(blocks)


def physics_effect(truth: TrueArm, run: RowConditions, name: str, lam: float, rng: np.random.Generator) -> Drawn:
    """One of `PHYSICS`, of size lambda: in space off all of the library at once; in the plane off the geometry, the
    first of some draws of which no effect of the library explains more than `EXPLAINED`, or else that of which it
    explains least."""
    if truth.dimension == 3:
        return random_effect((name,), truth, run, lam, rng, library_columns(truth, run))
    drawn: list[tuple[float, Drawn]] = []
    base, blocks = base_jacobian(truth, run), library_blocks(truth, run)
    ends = np.cumsum([block.shape[1] for block in blocks])[:-1]
    blocks = [np.linalg.qr(block)[0] for block in np.split(off(base, np.hstack(blocks)), ends, axis=1)]
    while not drawn or (drawn[-1][0] > EXPLAINED and len(drawn) < 20):
        effect = random_effect((name,), truth, run, lam, rng, base)
        left = off(base, column(truth, run, effect))
        drawn.append((max(float(np.sum((left @ block) ** 2)) for block in blocks) / float(left @ left), effect))
    return min(drawn, key=lambda one: one[0])[1]


def library_blocks(truth: TrueArm, run: RowConditions) -> list[Array]:
    """(2m, c) columns of each effect of the library by itself, of those with settings at several of them, of a planar
    arm."""
    *frames, tip = places(replace(truth, effects=[], modelled=[]), run)
    torques = np.einsum("mji,ji->mj", moments(truth, run), truth.home[:-1, :3, 2])
    steps = np.stack([1.0 * (run.t > at) for at in np.linspace(-0.4, 0.4, 17)])
    blocks: list[list[Array]] = [[step[:, None] * axis for axis in np.eye(3)[:2]] for step in steps]
    soft: list[Array] = []  # every joint at once
    for j, (q, frame) in enumerate(zip(run.q.T, frames[1:], strict=True)):
        arm = tip[:, :3, 3] - (frame[:, :3, :3] @ truth.points[j] + frame[:, :3, 3])
        lever = np.cross(frame[:, :3, :3] @ truth.axes[j], arm)  # how the joint's angle moves the tip
        shapes = [[np.cos(k * q), np.sin(k * q)] for k in range(1, 65)]
        shapes += [[q], [run.s[:, j]], [np.sign(torques[:, j])], [torques[:, j]], *steps[:, None]]
        shapes += [[run.q[:, j - 1]]] if j else []
        shapes += [
            [wound_up(q, width)] for width in (truth.upper[j] - truth.lower[j]) * np.array([0.05, 0.1, 0.2, 0.4])
        ]
        soft.append(lever * torques[:, j, None])
        blocks += [[lever * shape[:, None] for shape in block] for block in shapes]
        blocks += [[(frame[:, :3, :3] @ truth.links[j]) * step[:, None]] for step in steps]
    stacked = [np.stack([move[:, :2].ravel() for move in block], axis=1) for block in [soft, *blocks]]
    stacked += [probed(truth, run, name, None) for name in LIBRARY_WHOLE if name != EVERY_JOINT]
    stacked += [probed(truth, run, "thermal_transient", None, tau=tau) for tau in (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)]
    return stacked + ([probed(truth, run, name, None) for name in LOADS] if truth.modelled else [])


# -- names -------------------------------------------------------------------------------------------------------------
def key(effect: Drawn) -> str:
    """NAME or NAME:JOINT."""
    return effect[0] if effect[1] is None else f"{effect[0]}:{effect[1]}"


def family(effect: Drawn) -> str:
    """What effects are said to be alike."""
    return "gravity" if effect[0] in OF_GRAVITY else effect[0]


def settings_of(effect: Drawn) -> dict[str, float]:
    """The settings of an effect of the library, as an arm file has them."""
    settings = {name: float(v) for name, v in effect[2].items() if name in ("k", "at", "tau", "width_deg")}
    return settings | ({"side": 1.0} if effect[0] == "base_step" else {})


def place_of(effect: Drawn) -> str | None:
    """Where an effect outside the library may be said to be, alternatives between ` or `; None: nowhere is right."""
    name, joint, v = effect
    if joint is None:
        whole = {"refraction": "workspace", "gripper_play": None, "warm_offset": "temperature or time"}
        return whole.get(name, "time")
    second = {"two_joint_cable": joint + 1, "cross_talk": v.get("other")}.get(name)
    return f"joint:{joint}" + (f" or joint:{second}" if second else "")
