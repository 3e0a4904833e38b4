"""Occasional effects of real robot cells, in plain numpy: warm-up, steps in time, loads, hysteresis, a leaning axis.

And physics that the library does not have. No model."""

from __future__ import annotations

from typing import Any

import numpy as np

Values = dict[str, Any]
LOADS = ("payload_error", "gravity_tilt")
RARE_JOINT = ("joint_step", "link_step", "axis_tilt", "joint_hysteresis")
RARE_WHOLE = ("thermal_transient", "base_step", *LOADS)
# not in the library, and no one effect of it explains half of them (see `hidden_effects.by_one_of_library`)
PHYSICS_JOINT = ("memory_hysteresis", "two_joint_cable", "gear_wear", "cross_talk", "stick_slip")
PHYSICS_WHOLE = ("gripper_play", "refraction", "two_warm_ups", "payload_swap", "warm_offset")
SHAPE = ("at", "tau", "width", "beta", "other")  # values that are no amplitudes


def drawn_values(name: str, span: float, rng: np.random.Generator) -> Values:
    """A random direction in an effect's parameter space;  span : range of the joint [rad]."""
    sign, phase = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)
    at = rng.uniform(-0.35, 0.35)
    found: dict[str, Values] = {
        "thermal_transient": {"a": sign, "tau": float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))},
        "joint_step": {"b": sign, "at": at},
        "link_step": {"d": sign, "at": at},
        "base_step": {"x": np.cos(phase), "y": np.sin(phase), "at": at},
        "payload_error": {"d": sign},
        "gravity_tilt": {"angle": sign},
        "axis_tilt": {"square": 1.0, "beta": phase},
        "joint_hysteresis": {"b": sign, "width": span * rng.uniform(0.1, 0.4)},
    }
    return found[name]


def drawn_physics(name: str, joint: int | None, n: int, reach: float, rng: np.random.Generator) -> Values:
    """A random direction in the parameter space of an effect of `PHYSICS_JOINT` or `PHYSICS_WHOLE`, of an arm of n
    joints and this reach [mm]."""
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
        "refraction": {"c": sign, "at": rng.uniform(0.0, 0.5) * reach * (a + 1j * b)},  # from there
        "two_warm_ups": {"a": sign, "b": -sign * rng.uniform(0.7, 1.4), "tau": rng.uniform([0.03, 0.3], [0.08, 0.8])},
        "payload_swap": {"d": sign, "at": (float(start), float(end))},
        "warm_offset": {"x": a, "y": b},
    }
    return drawn[name]


def physics_places(name: str, joint: int | None, v: Values) -> str | None:
    """Where each of these may be said to be, alternatives between ` or `; None: nowhere that is right."""
    whole = {"refraction": "workspace", "two_warm_ups": "time", "payload_swap": "time", "gripper_play": None}
    if joint is None:
        return whole.get(name, "temperature or time")
    second = {"two_joint_cable": joint + 1, "cross_talk": v.get("other")}.get(name)
    return f"joint:{joint}" + (f" or joint:{second}" if second else "")


def relays(angles: np.ndarray, at: float, width: float) -> np.ndarray:
    """(m,) mean of three relays in -1..1, less their mean curve: each switches up above at + w, down below at - w, and
    between them stays as it was last switched, however long ago (F. Preisach, 1935); w a half, one and one and a half
    times the width."""
    total = np.zeros(len(angles))
    for half in (0.5 * width, width, 1.5 * width):
        state = 1.0
        for i, angle in enumerate(angles - at):
            state = 1.0 if angle > half else -1.0 if angle < -half else state
            total[i] += state * (abs(angle) <= half) / 3.0
    return total


def joint_physics(q: np.ndarray, s: np.ndarray, name: str, j: int, v: Values) -> np.ndarray:
    """(m, n) what an effect of `PHYSICS_JOINT` adds to the joint angles (m, n);  s : directions (m, n)"""
    out = np.zeros(q.shape)
    if name == "memory_hysteresis":
        out[:, j - 1] = v["h"] * relays(q[:, j - 1], v["at"], v["width"])
    elif name == "two_joint_cable":  # slack until both joints have wound it up, then it pulls both
        out[:, j - 1] = out[:, j] = v["c"] * np.maximum(0.0, q[:, j - 1] + q[:, j] - v["at"])
    elif name == "gear_wear":  # a sector of the teeth is worn down evenly
        away = np.angle(np.exp(1j * (q[:, j - 1] - v["at"])))
        out[:, j - 1] = v["h"] / (1.0 + (away / v["width"]) ** 8)
    elif name == "cross_talk":  # the field of another joint's motor in the encoder
        other = q[:, v["other"] - 1]
        out[:, j - 1] = v["a"] * np.cos(other) + v["b"] * np.sin(other)
    elif name == "stick_slip":  # a short move stops short, a long one slips past
        moved = np.append(np.inf, np.abs(np.diff(q[:, j - 1])))
        out[:, j - 1] = v["b"] * s[:, j - 1] * (1.0 - 2.0 * np.exp(-moved / v["width"]))
    return out


def warm_up(v: Values, t: np.ndarray) -> np.ndarray:
    """(m,) growth of the links that warm up twice: fast, and slowly back."""
    fast, slow = (1.0 - np.exp(-(t + 0.5) / tau) for tau in v["tau"])
    return np.asarray(v["a"] * fast + v["b"] * slow)


def refracted(p: np.ndarray, v: Values, reach: float) -> np.ndarray:
    """(m,) what the air's bending of the line of sight adds to complex positions: across it, as its length squared."""
    sight = p - v["at"]
    return 1j * v["c"] * np.abs(sight) * sight / reach


def link_growth(name: str, j: int | None, v: Values, t: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """(m, n) what is added to the lengths (n,)."""
    grown = np.zeros((len(t), len(lengths)))
    links = slice(None) if j is None else slice(j - 1, j)
    if name == "thermal_transient":
        grown[:, links] = (v["a"] * (1.0 - np.exp(-(t + 0.5) / v["tau"])))[:, None] * lengths[links]
    elif name == "two_warm_ups":
        grown[:, links] = warm_up(v, t)[:, None] * lengths[links]
    elif name == "link_step":
        grown[t > v["at"], links] = v["d"]
    return grown


def wound_up(angles: np.ndarray, width: float) -> np.ndarray:
    """(m,) wind-up in -1..1 of a joint that goes through these angles, from 0 at the first."""
    state = np.zeros(len(angles))
    for i in range(1, len(angles)):
        state[i] = min(1.0, max(-1.0, state[i - 1] + (angles[i] - angles[i - 1]) / width))
    return state


def leaning_tip(q: np.ndarray, lengths: np.ndarray, j: int, square: float, beta: float) -> np.ndarray:
    """(m,) tip x + iy of a chain in space whose axis j leans by sqrt(square) [rad] about a direction in the plane.

    beta : of that direction, against link j - 1. A negative square is the mirror image of a positive one.
    """
    straight = np.exp(1j * np.cumsum(q, axis=1)) @ lengths
    lean = np.sqrt(abs(square))
    along = np.array([np.cos(beta), np.sin(beta), 0.0])
    cross = np.array([[0.0, 0.0, along[1]], [0.0, 0.0, -along[0]], [-along[1], along[0], 0.0]])
    turn = np.eye(3) + np.sin(lean) * cross + (1.0 - np.cos(lean)) * cross @ cross  # Rodrigues
    tip = np.empty((len(q), 3))
    for i, angles in enumerate(q):
        frame, point = np.eye(3), np.zeros(3)
        for k, angle in enumerate(angles):
            frame = frame @ (turn if k == j - 1 else np.eye(3)) @ _about_z(angle)
            point = point + frame @ np.array([lengths[k], 0.0, 0.0])
        tip[i] = point
    leaning = tip[:, 0] + 1j * tip[:, 1]
    return leaning if square >= 0.0 else 2.0 * straight - leaning


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
