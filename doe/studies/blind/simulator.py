"""A second implementation of the arm and its effects in plain numpy, written from the formulas of the effect library.

The blind study simulates the truth with this file; the diagnosis fits with `identification.model`. Nothing here calls
the model or its effects, and a test checks that. Positions are complex numbers x + iy in millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from doe.studies.blind.rare_effects import PHYSICS_JOINT, joint_physics, leaning_tip, link_growth, refracted, wound_up
from identification.measurements import Measurements

G = 9.81
MODEL_ERROR = 2.0  # [sigma] of a coordinate, of each posture, with noise `posture`
Drawn = tuple[str, int | None, dict]  # name, joint, values of an effect


@dataclass
class TrueArm:
    """The real arm: what is drawn, what is hidden."""

    lengths: np.ndarray  # (n,) nominal [mm]
    masses: np.ndarray  # (n,) [kg]
    center: np.ndarray  # (n,) fraction
    payload: float  # [kg]
    lower: np.ndarray
    upper: np.ndarray
    sigma: float
    length_errors: np.ndarray
    joint_offsets: np.ndarray
    effects: list[tuple[str, int | None, dict]] = field(default_factory=list)
    known: list[tuple[str, int | None, dict]] = field(default_factory=list)  # effects that the arm's model has

    @property
    def n(self) -> int:
        return len(self.lengths)


@dataclass
class RowConditions:
    """What a row was measured under."""

    q: np.ndarray  # (m, n)
    t: np.ndarray  # (m,) -0.5..0.5
    warm: np.ndarray  # (m,) temperature less its mean
    s: np.ndarray  # (m, n) directions
    payload: np.ndarray  # (m,)


def random_truth(rng: np.random.Generator, n: int | None = None, limits: str = "full") -> TrueArm:
    n = int(rng.integers(2, 7)) if n is None else n
    lengths = np.round(rng.uniform(80.0, 400.0, n))
    if limits == "full":
        lower, upper = np.full(n, -np.pi), np.full(n, np.pi)
    else:
        span = np.concatenate([[2 * np.pi], rng.uniform(np.radians(120), np.radians(300), n - 1)])
        middle = rng.uniform(-0.5, 0.5, n)
        lower, upper = middle - span / 2, middle + span / 2
    return TrueArm(
        lengths=lengths,
        masses=lengths / 100.0 * rng.uniform(1.0, 5.0, n),
        center=np.full(n, 0.5),
        payload=float(rng.uniform(1.0, 12.0)),
        lower=lower,
        upper=upper,
        sigma=float(rng.choice([0.02, 0.05, 0.1, 0.2])),
        length_errors=rng.normal(0.0, 1.0, n),
        joint_offsets=rng.normal(0.0, 0.008, n),
    )


def session(truth: TrueArm, q: np.ndarray, rng: np.random.Generator) -> RowConditions:
    m = len(q)
    change = np.sign(np.diff(q, axis=0))
    s = np.vstack([np.ones(truth.n), change])
    for i in range(1, m):
        s[i] = np.where(s[i] == 0, s[i - 1], s[i])
    walk = 20.0 + 3.0 * np.sin(np.arange(m) / m * 2.5 * np.pi + rng.uniform(0, 6.3)) + rng.normal(0, 1.0, m)
    return RowConditions(q, np.arange(m) / (m - 1) - 0.5, walk - walk.mean(), s, np.full(m, truth.payload))


def joints_xy(lengths_m: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(m, n+1) nominal positions of the joints and the tip [m]."""
    steps = lengths_m * np.exp(1j * theta)
    return np.hstack([np.zeros((len(theta), 1)), np.cumsum(steps, axis=1)])


def torques(truth: TrueArm, run: RowConditions) -> np.ndarray:
    """(m, n) gravity torque about each joint [N m]: weight times horizontal distance, downwards."""
    theta = np.cumsum(run.q, axis=1)
    points = joints_xy(truth.lengths / 1000.0, theta)
    n = truth.n
    centers = points[:, :n] + truth.center * (points[:, 1:] - points[:, :n])
    tau = np.zeros(run.q.shape)
    for j in range(n):
        for k in range(j, n):
            tau[:, j] -= G * truth.masses[k] * (centers[:, k] - points[:, j]).real
        tau[:, j] -= G * run.payload * (points[:, n] - points[:, j]).real
    return tau


def bending(truth: TrueArm, run: RowConditions) -> tuple[np.ndarray, np.ndarray]:
    """(m, n) deflection [mm] and slope [rad] of each link's tip per unit 1/(EI)."""
    theta = np.cumsum(run.q, axis=1)
    n = truth.n
    points = joints_xy(truth.lengths / 1000.0, theta)
    centers = points[:, :n] + truth.center * (points[:, 1:] - points[:, :n])
    deflection, slope = np.zeros(theta.shape), np.zeros(theta.shape)
    for j in range(n):
        L = truth.lengths[j] / 1000.0
        weight = truth.masses[j + 1 :].sum() + run.payload
        F = -G * weight * np.cos(theta[:, j])
        M = -G * run.payload * (points[:, n] - points[:, j + 1]).real
        M = M - G * (centers[:, j + 1 :] - points[:, j + 1, None]).real @ truth.masses[j + 1 :]
        deflection[:, j] = 1000.0 * (F * L**3 / 3 + M * L**2 / 2)
        slope[:, j] = F * L**2 / 2 + M * L
    return deflection, slope


def weighed(run: RowConditions, effects: list[Drawn]) -> RowConditions:
    """The session as gravity sees it: with the true payload, and turned against a base that leans."""
    values = {name: v for name, _, v in effects}
    q = run.q.copy()
    q[:, 0] -= values.get("gravity_tilt", {"angle": 0.0})["angle"]
    more = values.get("payload_error", {"d": 0.0})["d"]
    if (swap := values.get("payload_swap")) is not None:  # the arm picks up a tool, and lays it down later
        more = more + swap["d"] * ((run.t > swap["at"][0]) & (run.t < swap["at"][1]))
    return replace(run, q=q, payload=run.payload + more)


def angle_error(
    truth: TrueArm, run: RowConditions, heavy: RowConditions, name: str, j: int | None, v: dict
) -> np.ndarray:
    """(m, n) what an effect adds to the joint angles;  heavy : the session as gravity sees it."""
    out = np.zeros(run.q.shape)
    if name == "joint_compliance" and j is None:
        return np.asarray(v["c"]) * torques(truth, heavy)
    if j is None:
        return out
    q = run.q[:, j - 1]
    if name == "joint_compliance":
        out[:, j - 1] = v["c"] * torques(truth, heavy)[:, j - 1]
    elif name in ("encoder_eccentricity", "encoder_second_harmonic", "transmission_ripple", "free_ripple"):
        k = {"encoder_eccentricity": 1, "encoder_second_harmonic": 2}.get(name) or v["k"]
        out[:, j - 1] = v["a"] * np.cos(k * q) + v["b"] * np.sin(k * q)
    elif name == "gear_ratio":
        out[:, j - 1] = v["e"] * q
    elif name == "joint_coupling":
        out[:, j - 1] = v["c"] * run.q[:, j - 2]
    elif name == "backlash":
        out[:, j - 1] = v["b"] * run.s[:, j - 1]
    elif name == "gravity_backlash":
        out[:, j - 1] = v["b"] * np.sign(torques(truth, heavy)[:, j - 1])
    elif name == "joint_step":
        out[:, j - 1] = v["b"] * (run.t > v["at"])
    elif name == "joint_hysteresis":
        out[:, j - 1] = v["b"] * wound_up(q, v["width"])
    # outside the library
    elif name == "bump":
        out[:, j - 1] = v["h"] * np.exp(-0.5 * (np.angle(np.exp(1j * (q - v["at"]))) / v["width"]) ** 2)
    elif name == "cubic":
        out[:, j - 1] = v["c"] * q**3
    elif name == "cable_pull":  # a cable along the arm pulls joint j harder the more joint j and its neighbor wind it
        other = run.q[:, j] if j < truth.n else run.q[:, j - 2]
        out[:, j - 1] = v["c"] * q * other
    elif name in PHYSICS_JOINT:
        out += joint_physics(run.q, run.s, name, j, v)
    return out


def position(truth: TrueArm, run: RowConditions) -> np.ndarray:
    """(m,) complex true positions."""
    q = run.q + truth.joint_offsets
    lengths = (truth.lengths + truth.length_errors) * np.ones(q.shape)
    deflection, slope = np.zeros(q.shape), np.zeros(q.shape)
    heavy = weighed(run, truth.effects)
    for name, j, v in truth.known + truth.effects:
        q = q + angle_error(truth, run, heavy, name, j, v)
        lengths = lengths + link_growth(name, j, v, run.t, truth.lengths + truth.length_errors)
        if name == "thermal_growth":
            lengths = lengths + lengths * v["a"] * run.warm[:, None]
        if name == "link_bending":
            d, s = bending(truth, heavy)
            deflection, slope = deflection + v["f"] * d, slope + v["f"] * s
    theta = np.cumsum(q, axis=1)
    before = np.cumsum(slope, axis=1) - slope
    p = np.sum((lengths + 1j * deflection) * np.exp(1j * (theta + before)), axis=1)
    for name, _, v in truth.effects:
        if name == "gripper_play":  # what the gripper holds slides to the lower end of a slot
            along = np.exp(1j * (theta[:, -1] + v["beta"]))
            p = p - v["h"] * along * np.sign(along.imag)
    for name, j, v in truth.effects:
        if name == "axis_tilt" and j is not None:
            q, lengths = run.q + truth.joint_offsets, truth.lengths + truth.length_errors
            p = p + leaning_tip(q, lengths, j, v["square"], v["beta"]) - np.exp(1j * np.cumsum(q, axis=1)) @ lengths
    for name, _, v in truth.effects:
        if name == "base_rotation_drift":
            p = p * np.exp(1j * v["w"] * run.t)
    for name, _, v in truth.effects:
        if name == "base_offset":
            p = p + v["x"] + 1j * v["y"]
        elif name == "base_drift":
            p = p + (v["x"] + 1j * v["y"]) * run.t
        elif name in ("step_drift", "base_step"):
            p = p + (v["x"] + 1j * v["y"]) * (run.t > v["at"])
        elif name == "warm_offset":
            p = p + (v["x"] + 1j * v["y"]) * run.warm
    for name, _, v in truth.effects:
        if name == "axes_skew":
            p = p + (v["a"] + 1j * v["b"]) * np.conj(p)
        elif name == "barrel":  # outside the library: the instrument is bent in a corner of the workspace
            reach = truth.lengths.sum()
            p = p + (v["x"] + 1j * v["y"]) * (np.abs(p) / reach) ** 2 * (p.real / reach)
        elif name == "refraction":
            p = p + refracted(p, v, truth.lengths.sum())
    return p


def noise(truth: TrueArm, run: RowConditions, rng: np.random.Generator, kind: str = "white") -> np.ndarray:
    """(m,) complex noise, of sigma in each coordinate where it is white.

    kind : beside those by name: `t3`: Student's t with 3 degrees of freedom and this standard deviation; `walk`: white
        noise and a walk whose RMS about its mean is sigma; `quantized`: white noise, and the display shows steps of
        sigma; `posture`: white noise, and an error of 2 sigma that following rows of one posture share
    """
    m = len(run.q)
    e = rng.standard_normal((m, 2)) @ np.array([1, 1j]) * truth.sigma
    p = position(truth, run)
    reach = truth.lengths.sum()
    if kind == "joint":  # joint 1 shakes: perpendicular to the reach and proportional to it
        e = e + 1j * p / reach * rng.standard_normal(m) * truth.sigma * 3
    elif kind == "reach":
        e = e * (0.5 + 1.5 * np.abs(p) / reach)
    elif kind == "outliers":
        worst = rng.choice(m, 3, replace=False)
        e[worst] += 15 * truth.sigma * np.exp(2j * np.pi * rng.random(3))
    elif kind == "serial":
        for i in range(1, m):
            e[i] = 0.7 * e[i - 1] + np.sqrt(1 - 0.49) * e[i]
    elif kind == "t3":
        e = rng.standard_t(3.0, (m, 2)) @ np.array([1, 1j]) * truth.sigma / np.sqrt(3.0)
    elif kind == "walk":  # over m rows of unit steps the mean square about the mean is (m^2 - 1) / (6 m)
        walk = np.cumsum(rng.standard_normal((m, 2)) @ np.array([1, 1j])) * truth.sigma
        e = e + (walk - walk.mean()) * np.sqrt(6.0 * m / (m**2 - 1.0))
    elif kind == "quantized":
        shown = np.round((p + e).view(float) / truth.sigma) * truth.sigma
        e = shown.view(complex) - p
    elif kind == "posture":
        e = e + model_error(run, 2, rng) @ np.array([1, 1j]) * truth.sigma
    return e


def model_error(run: RowConditions, d: int, rng: np.random.Generator) -> np.ndarray:
    """(m, d) errors in units of sigma that following rows of one posture share."""
    number = np.append(0, np.cumsum(np.any(np.diff(run.q, axis=0) != 0.0, axis=1)))
    return np.asarray(MODEL_ERROR * rng.standard_normal((len(number), d))[number])


def recorded(truth: TrueArm, run: RowConditions, error: np.ndarray) -> Measurements:
    """What the instrument says."""
    p = position(truth, run) + error
    order = np.arange(len(run.q), dtype=float)
    xy = np.column_stack([p.real, p.imag])
    return Measurements(run.q, xy, order, temperature=20.0 + run.warm, directions=run.s)


def measure(truth: TrueArm, run: RowConditions, rng: np.random.Generator, kind: str) -> Measurements:
    return recorded(truth, run, noise(truth, run, rng, kind))


def measure_more(
    truth: TrueArm,
    run: RowConditions,
    data: Measurements,
    postures: np.ndarray,
    payload: np.ndarray | None,
    directions: np.ndarray | None,
    rng: np.random.Generator,
) -> Measurements:
    """The same session goes on: the data with (K) further postures at their end."""
    m, count = len(data), len(postures)
    q = np.vstack([data.postures, postures])
    s = session(truth, q, rng).s[m:] if directions is None else directions
    added = RowConditions(
        postures,
        0.5 + np.arange(1, count + 1) / (m - 1),
        rng.normal(0.0, 1.0, count),
        s,
        np.full(count, truth.payload) if payload is None else payload,
    )
    p = position(truth, added) + noise(truth, added, rng)
    return Measurements(
        q,
        np.vstack([data.positions, np.column_stack([p.real, p.imag])]),
        np.arange(m + count, dtype=float),
        temperature=20.0 + np.concatenate([run.warm, added.warm]),
        directions=np.vstack([np.asarray(data.directions), s]),
        payload=np.concatenate([run.payload, added.payload]),
    )
