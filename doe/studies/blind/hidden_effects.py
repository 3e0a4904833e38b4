"""Hidden effects drawn at random with a given size lambda, those of the library and others. Plain numpy, no model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from doe.studies.blind.rare_effects import (
    PHYSICS_JOINT,
    PHYSICS_WHOLE,
    RARE_JOINT,
    RARE_WHOLE,
    SHAPE,
    drawn_physics,
    drawn_values,
    physics_places,
    wound_up,
)
from doe.studies.blind.simulator import Drawn, RowConditions, TrueArm, position, torques

LIBRARY_JOINT = (
    "joint_compliance",
    "encoder_eccentricity",
    "encoder_second_harmonic",
    "transmission_ripple",
    "gear_ratio",
    "joint_coupling",
    "backlash",
    "gravity_backlash",
)
LIBRARY_WHOLE = (
    "joint_compliance*",
    "link_bending",
    "thermal_growth",
    "base_offset",
    "base_drift",
    "base_rotation_drift",
    "axes_skew",
)
OUTSIDE = ("free_ripple", "bump", "cubic", "cable_pull", "step_drift")
SINCE_INSIDE = {"free_ripple": "transmission_ripple", "step_drift": "base_step"}  # drawn as ever, named by now
PHYSICS = PHYSICS_JOINT + PHYSICS_WHOLE
OFFSETS = ("base_offset", "base_drift")
GRAVITY = ("joint_compliance", "link_bending", "gravity_backlash", "bearing_compliance")
COUNTS = {"small": (14, 22), "several": (6, 9)}  # of many effects at once, the least and the most
EXPLAINED = 0.5  # of the square of an effect outside the library, at most, by any one effect of it
DRAWS = 20  # until that is so


def directions_of(name: str, n: int, rng: np.random.Generator) -> dict:
    """A random direction in an effect's parameter space; scaled afterwards."""
    phase = rng.uniform(0, 2 * np.pi)
    pair = (np.cos(phase), np.sin(phase))
    if name in ("encoder_eccentricity", "encoder_second_harmonic", "axes_skew"):
        return dict(zip("ab", pair, strict=True))
    if name == "transmission_ripple":
        return dict(zip("ab", pair, strict=True)) | {"k": int(rng.integers(3, 65))}
    if name == "free_ripple":
        k = rng.uniform(65, 120) if rng.random() < 0.5 else int(rng.integers(3, 60)) + 0.5
        return dict(zip("ab", pair, strict=True)) | {"k": k}
    if name in ("base_offset", "base_drift", "barrel"):
        return dict(zip("xy", pair, strict=True))
    if name == "step_drift":
        return dict(zip("xy", pair, strict=True)) | {"at": rng.uniform(-0.3, 0.3)}
    sign = rng.choice([-1.0, 1.0])
    one_sign: dict[str, dict] = {
        "joint_compliance": {"c": 1.0},
        "joint_compliance*": {"c": rng.uniform(0.5, 1.5, n)},
        "gear_ratio": {"e": sign},
        "joint_coupling": {"c": sign},
        "backlash": {"b": sign},
        "gravity_backlash": {"b": 1.0},
        "link_bending": {"f": 1.0},
        "thermal_growth": {"a": sign},
        "base_rotation_drift": {"w": sign},
        "bump": {"h": sign, "at": rng.uniform(-2.0, 2.0), "width": rng.uniform(0.3, 0.6)},
        "cubic": {"c": sign},
        "cable_pull": {"c": sign},
    }
    return one_sign[name]


def scaled_amplitudes(values: dict, factor: float) -> dict:
    """The amplitudes times a factor; k, at, width and the like are shapes and stay."""
    return {name: (v if name in ("k", *SHAPE) else v * factor) for name, v in values.items()}


def column(truth: TrueArm, run: RowConditions, effect: tuple[str, int | None, dict]) -> np.ndarray:
    """(2m,) derivative of the position with respect to the amplitude of an effect."""
    name, j, v = effect
    h = 1e-6
    up = position(replace(truth, effects=[(name, j, scaled_amplitudes(v, h))]), run)
    down = position(replace(truth, effects=[(name, j, scaled_amplitudes(v, -h))]), run)
    d = (up - down) / (2 * h)
    return np.column_stack([d.real, d.imag]).ravel()


def base_jacobian(truth: TrueArm, run: RowConditions) -> np.ndarray:
    """(2m, 2n) derivative by u_j = l_j exp(i dtheta_j), real and imaginary parts: the base model is linear in them."""
    z = np.exp(1j * np.cumsum(run.q, axis=1))
    both = np.hstack([z, 1j * z])
    return np.stack([both.real, both.imag], axis=1).reshape(2 * len(z), -1)


def off(columns: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return vector - columns @ np.linalg.lstsq(columns, vector, rcond=1e-10)[0]


def values_of(truth: TrueArm, name: str, j: int | None, rng: np.random.Generator) -> dict:
    """A random direction in the parameter space of an effect of the library, of a rare one or of one outside."""
    if name in PHYSICS:
        return drawn_physics(name, j, truth.n, float(truth.lengths.sum()), rng)
    if name in RARE_JOINT + RARE_WHOLE:
        span = 0.0 if j is None else float(truth.upper[j - 1] - truth.lower[j - 1])
        return drawn_values(name, span, rng)
    return directions_of(name, truth.n, rng)


def wave(truth: TrueArm, run: RowConditions, k: float, lam: float, rng: np.random.Generator) -> Drawn:
    """A gear ripple of k per turn at a random joint."""
    phase, j = rng.uniform(0, 2 * np.pi), int(rng.integers(1, truth.n + 1))
    v = {"a": np.cos(phase), "b": np.sin(phase), "k": k}
    seen = np.linalg.norm(off(base_jacobian(truth, run), column(truth, run, ("transmission_ripple", j, v))))
    return "transmission_ripple", j, scaled_amplitudes(v, float(lam * truth.sigma / seen))


def settings_of(effect: Drawn) -> dict[str, float]:
    """The settings of an effect, as an arm file has them."""
    names = {"k": "k", "at": "at", "tau": "tau", "width": "width_deg"}
    units = {"width": 180.0 / np.pi}
    found = {names[n]: float(v) * units.get(n, 1.0) for n, v in effect[2].items() if n in names}
    return found | ({"side": 1.0} if effect[0] == "base_step" else {})


def sized(
    truth: TrueArm,
    run: RowConditions,
    name: str,
    j: int | None,
    lam: float,
    rng: np.random.Generator,
    others: np.ndarray | None = None,
) -> Drawn | None:
    """The effect with amplitude such that |column off the base Jacobian (and `others`)| = lam sigma; None if unseen."""
    v = values_of(truth, name, j, rng)
    real = "joint_compliance" if name == "joint_compliance*" else name
    d = column(truth, run, (real, j, v))
    seen = np.linalg.norm(off(base_jacobian(truth, run) if others is None else others, d))
    if seen < 0.02 * np.linalg.norm(d):
        return None
    return real, j, scaled_amplitudes(v, float(lam * truth.sigma / seen))


def random_effect(
    truth: TrueArm, run: RowConditions, lam: float, rng: np.random.Generator, name: str | None = None
) -> Drawn:
    """One effect of the library, its type at random, then its joint."""
    while True:
        pick = name or str(rng.choice(LIBRARY_JOINT + LIBRARY_WHOLE))
        first = 2 if pick in ("joint_coupling", "axis_tilt") else 1
        j = None if pick in LIBRARY_WHOLE + RARE_WHOLE else int(rng.integers(first, truth.n + 1))
        found = sized(truth, run, pick, j, lam, rng)
        if found is not None:
            return found


def log_uniform(sizes: tuple[float, float], rng: np.random.Generator) -> float:
    """A size lambda between two, even on a logarithmic scale."""
    low, high = np.log(sizes)
    return float(np.exp(rng.uniform(low, high)))


def many_effects(
    truth: TrueArm, run: RowConditions, kind: str, sizes: tuple[float, float], rng: np.random.Generator
) -> list[Drawn]:
    """What a real robot has at once, each effect of its own size lambda between two.

    kind : `robot`: compliance of all joints, an offset of the base, every encoder eccentric, backlash in one joint and
        a ripple in one; `harmonics`: first and second harmonic of every encoder; one of `COUNTS`: so many effects of
        the library at random, of gravity one, `small`: one or more in every joint
    """
    listed: list[tuple[str, int | None]] = [("encoder_eccentricity", j + 1) for j in range(truth.n)]
    most = len(LIBRARY_JOINT) * truth.n
    if kind in COUNTS:
        listed = at_random(LIBRARY_JOINT, LIBRARY_WHOLE, truth.n, kind == "small", rng)
        most = int(rng.integers(COUNTS[kind][0], COUNTS[kind][1] + 1))
    elif kind == "harmonics":
        listed += [("encoder_second_harmonic", j + 1) for j in range(truth.n)]
    else:
        listed += [("joint_compliance*", None), ("base_offset", None)]
        listed += [(name, int(rng.integers(1, truth.n + 1))) for name in ("backlash", "transmission_ripple")]
    drawn = (sized(truth, run, name, j, log_uniform(sizes, rng), rng) for name, j in listed)
    return list(islice((effect for effect in drawn if effect is not None), most))


def at_random(
    of_joint: Sequence[str], of_arm: Sequence[str], joints: int, everywhere: bool, rng: np.random.Generator
) -> list[tuple[str, int | None]]:
    """All effects of these names in a random order, of gravity only the first.

    everywhere : one of each joint comes before the others
    """
    places = [(name, j) for name in of_joint for j in range(2 if name == "joint_coupling" else 1, joints + 1)]
    every = [*places, *((name, None) for name in of_arm)]
    listed = [every[k] for k in rng.permutation(len(every))]
    of_gravity = [place for place in listed if place[0].rstrip("*") in GRAVITY]
    listed = [place for place in listed if place not in of_gravity[1:]]
    if everywhere:
        first = {j: (name, j) for name, j in reversed(listed) if j is not None}
        listed = [*first.values(), *(place for place in listed if place not in first.values())]
    return listed


def library_columns(truth: TrueArm, run: RowConditions) -> np.ndarray:
    """(2m, C) base Jacobian and the columns of every effect of the library but the ripples."""
    pairs = {"encoder_eccentricity": "ab", "encoder_second_harmonic": "ab", "axes_skew": "ab"}
    pairs |= {"base_offset": "xy", "base_drift": "xy"}
    columns = [base_jacobian(truth, run)]
    for name in LIBRARY_JOINT + LIBRARY_WHOLE:
        if name == "transmission_ripple" or name.endswith("*"):
            continue
        first = 2 if name == "joint_coupling" else 1
        for j in [None] if name in LIBRARY_WHOLE else range(first, truth.n + 1):
            if name in pairs:
                probes = [{c: float(c == one) for c in pairs[name]} for one in pairs[name]]
            else:
                probes = [directions_of(name, truth.n, np.random.default_rng(0))]
            columns += [column(truth, run, (name, j, v))[:, None] for v in probes]
    return np.hstack(columns)


def outside_effect(
    truth: TrueArm, run: RowConditions, lam: float, rng: np.random.Generator
) -> tuple[str, int | None, dict]:
    """An effect the library does not have, of size lam outside the span of the library."""
    span = library_columns(truth, run)
    while True:
        name = str(rng.choice(OUTSIDE))
        j = None if name == "step_drift" else int(rng.integers(1, truth.n + 1))
        found = sized(truth, run, name, j, lam, rng, span)
        if found is not None:
            return found


def physics_effect(truth: TrueArm, run: RowConditions, name: str, lam: float, rng: np.random.Generator) -> Drawn:
    """One of `PHYSICS`, of size lam: the first of some draws of which no effect of the library explains more than
    `EXPLAINED`, or else that of which it explains least."""
    drawn: list[tuple[float, Drawn]] = []
    base, blocks = base_jacobian(truth, run), library_blocks(truth, run)
    ends = np.cumsum([block.shape[1] for block in blocks])[:-1]
    blocks = [np.linalg.qr(block)[0] for block in np.split(off(base, np.hstack(blocks)), ends, axis=1)]
    while not drawn or (drawn[-1][0] > EXPLAINED and len(drawn) < DRAWS):
        j = None if name in PHYSICS_WHOLE else int(rng.integers(1, truth.n + (name != "two_joint_cable")))
        effect = sized(truth, run, name, j, lam, rng)
        if effect is not None:
            left = off(base, column(truth, run, effect))
            drawn.append((max(float(np.sum((left @ block) ** 2)) for block in blocks) / float(left @ left), effect))
    return min(drawn, key=lambda one: one[0])[1]


def library_blocks(truth: TrueArm, run: RowConditions) -> list[np.ndarray]:
    """(2m, c) columns of each effect of the library by itself, of those with settings at several of them."""
    tau = torques(truth, run)
    turned = np.exp(1j * np.cumsum(run.q + truth.joint_offsets, axis=1)) * truth.lengths
    lever = 1j * np.cumsum(turned[:, ::-1], axis=1)[:, ::-1]  # of each joint: how its angle moves the tip
    steps = [1.0 * (run.t > at) for at in np.linspace(-0.4, 0.4, 17)]
    moves: list[list[np.ndarray]] = [[lever[:, j] * tau[:, j] for j in range(truth.n)]]
    for j, q in enumerate(run.q.T):
        own = [[np.cos(k * q), np.sin(k * q)] for k in range(1, 65)]
        own += [[q], [run.s[:, j]], [np.sign(tau[:, j])], [tau[:, j]], *([run.q[:, j - 1]] for _ in range(j > 0))]
        own += [[step] for step in steps]
        own += [[wound_up(q, width)] for width in (truth.upper[j] - truth.lower[j]) * np.array([0.05, 0.1, 0.2, 0.4])]
        moves += [[lever[:, j] * shape for shape in shapes] for shapes in own]
        moves += [[turned[:, j] * step] for step in steps]
    moves += [[step + 0j, 1j * step] for step in steps]
    whole: list[tuple[str, list[dict]]] = [(name, [{"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 1.0}]) for name in OFFSETS]
    whole += [("axes_skew", [{"a": 1.0, "b": 0.0}, {"a": 0.0, "b": 1.0}])]
    whole += [("link_bending", [{"f": 1.0}]), ("thermal_growth", [{"a": 1.0}]), ("base_rotation_drift", [{"w": 1.0}])]
    whole += [("thermal_transient", [{"a": 1.0, "tau": tau}]) for tau in (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)]
    whole += [("payload_error", [{"d": 1.0}]), ("gravity_tilt", [{"angle": 1.0}])] if truth.known else []
    stacked = [[np.column_stack([move.real, move.imag]).ravel() for move in block] for block in moves]
    stacked += [[column(truth, run, (name, None, values)) for values in probes] for name, probes in whole]
    return [np.stack(block, axis=1) for block in stacked]


def by_library_name(effect: Drawn) -> Drawn:
    """The effect by the name that the library has for it."""
    return SINCE_INSIDE.get(effect[0], effect[0]), effect[1], effect[2]


def key(effect: tuple[str, int | None, dict]) -> str:
    return effect[0] if effect[1] is None else f"{effect[0]}:{effect[1]}"


def family(effect: tuple[str, int | None, dict]) -> str:
    return "gravity" if effect[0] in GRAVITY else effect[0]


def place_of(effect: tuple[str, int | None, dict]) -> str | None:
    """Where an effect outside the library may be said to be, alternatives between ` or `; None: nowhere is right."""
    if effect[0] in PHYSICS:
        return physics_places(*effect)
    return {"step_drift": "time", "barrel": "workspace"}.get(effect[0], f"joint:{effect[1]}")


def parameters_of(effect: Drawn) -> dict[str, float]:
    """The parameters of an effect of the library by the library's names, without settings."""
    name, joint, values = effect
    if name == "joint_compliance" and joint is None:
        return {f"c{j + 1}": float(c) for j, c in enumerate(values["c"])}
    names = {
        "link_bending": {"f": "flexibility"},
        "base_offset": {"x": "x0", "y": "y0"},
        "base_drift": {"x": "vx", "y": "vy"},
    }.get(name, {})
    return {names.get(own, own): float(value) for own, value in values.items() if own != "k"}
