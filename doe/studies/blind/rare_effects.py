"""Occasional effects of real robot cells, in plain numpy: warm-up, steps in time, loads, hysteresis, a leaning axis.

No model."""

from __future__ import annotations

from typing import Any

import numpy as np

Values = dict[str, Any]
LOADS = ("payload_error", "gravity_tilt")
RARE_JOINT = ("joint_step", "link_step", "axis_tilt", "joint_hysteresis")
RARE_WHOLE = ("thermal_transient", "base_step", *LOADS)
SHAPE = ("at", "tau", "width", "beta")  # values that are no amplitudes


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


def link_growth(name: str, j: int | None, v: Values, t: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """(m, n) what is added to the lengths (n,)."""
    grown = np.zeros((len(t), len(lengths)))
    links = slice(None) if j is None else slice(j - 1, j)
    if name == "thermal_transient":
        grown[:, links] = (v["a"] * (1.0 - np.exp(-(t + 0.5) / v["tau"])))[:, None] * lengths[links]
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
