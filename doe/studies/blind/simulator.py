"""The oracle: arms as lines in space and what is wrong with them, in plain numpy, from the formulas of the library.

At home, with all joints at zero, an arm is a set of lines in space, points on them and masses; every joint turns all
that lies beyond about its line (R. W. Brockett, "Robotic manipulators and the product of exponentials formula", 1984).
The arm's maker has a Denavit-Hartenberg table; the real lines are a little off. A planar arm has upright lines, and x
and y of its tip are measured. The blind study simulates the truth with this file; the diagnosis fits with
`identification.model`. Nothing here calls the model or its effects, and a test checks that.

Millimetres, radians, kilograms; m rows of a session at once, n joints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from identification import Array, Measurements, spectrum

G = 9.81
UPRIGHT = np.array([0.0, 0.0, 1.0])
Values = dict[str, Any]
Drawn = tuple[str, int | None, Values]  # an effect: its name, its joint from 1 and its values
OF_GRAVITY = ("joint_compliance", "gravity_backlash", "bearing_compliance", "link_bending")
SHAPES = ("k", "at", "tau", "width", "width_deg", "beta", "other")  # values of effects that are no amplitudes


@dataclass(frozen=True)
class TrueArm:
    """The real arm and what its maker says."""

    table: Array  # (n, 3) a, alpha, d of the drawing (standard Denavit-Hartenberg)
    axes: Array  # (n, 3) directions of the real axes at home
    points: Array  # (n, 3) of them
    offsets: Array  # (n,) of the encoders
    base: Array  # (4, 4) pose of the arm in the instrument's frame
    tools: Array  # (K, 3) measured points in the drawing's last frame
    masses: Array  # (n,) of the links
    payload: float
    lower: Array
    upper: Array
    sigma: float
    dimension: int = 3  # 2: x and y of the tip are measured, and no more
    center: float = 0.5  # where along a link its mass is
    gravity: Array = field(default_factory=lambda: -G * UPRIGHT)  # (3,) as it really is in the arm's base
    load: Array | None = None  # (3,) where the payload really hangs in the last frame; None: at the first tool
    effects: list[Drawn] = field(default_factory=list)  # hidden
    modelled: list[Drawn] = field(default_factory=list)  # those that the arm's model has

    @classmethod
    def built(cls, table: Array, rng: np.random.Generator, lean: float, shift: float, **others: Any) -> TrueArm:
        """An arm of this drawing whose axes are off by `lean` [rad] and `shift` [mm] per coordinate."""
        lines = np.zeros((len(table), 3))
        drawn = cls(table, lines, lines, **others)
        axes = drawn.home[:-1, :3, 2] + lean * rng.standard_normal(lines.shape)
        points = drawn.home[:-1, :3, 3] + shift * rng.standard_normal(lines.shape)
        return replace(drawn, axes=axes / np.linalg.norm(axes, axis=1, keepdims=True), points=points)

    @classmethod
    def planar(cls, lengths: Array, length_errors: Array, offsets: Array, **others: Any) -> TrueArm:
        """An arm of links (n,) in a vertical plane, y up."""
        n, table = len(lengths), np.column_stack([lengths, np.zeros((len(lengths), 2))])
        along = np.cumsum([0.0, *(lengths + length_errors)])[:, None] * np.eye(3)[0]
        tip = np.array([[np.sum(length_errors), 0.0, 0.0]])
        others = {"gravity": np.array([0.0, -G, 0.0]), "dimension": 2, "load": np.zeros(3), **others}
        return cls(table, np.tile(UPRIGHT, (n, 1)), along[:-1], offsets, np.eye(4), tip, **others)

    @property
    def in_plane(self) -> bool:
        """Whether x and y of the tip alone are measured."""
        return self.dimension < 3

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.table)

    @cached_property
    def home(self) -> Array:
        """(n + 1, 4, 4) frames of the drawing at home: of each joint, and of the tip."""
        frames = [np.eye(4)]
        for a, alpha, d in self.table:
            link = shift(np.array([a, 0.0, d])) @ screw(turn(np.array([alpha, 0.0, 0.0])), np.zeros(3))
            frames.append(frames[-1] @ link)
        return np.array(frames)

    def at_home(self, points: Array) -> Array:
        """(..., 3) points of the drawing's last frame at home."""
        return points @ self.home[-1, :3, :3].T + self.home[-1, :3, 3]

    @cached_property
    def links(self) -> Array:
        """(n, 3) what grows with the temperature: the links, in the plane the real ones, in space as they are drawn."""
        if self.in_plane:
            return np.diff(np.vstack([self.points, self.at_home(self.tools[0])]), axis=0)
        return np.diff(self.home[:, :3, 3], axis=0)

    @cached_property
    def lengths(self) -> Array:
        """(n,) of the links as drawn."""
        return np.linalg.norm(np.diff(self.home[:, :3, 3], axis=0), axis=1)


@dataclass(frozen=True)
class RowConditions:
    """What each of m rows was measured under."""

    q: Array  # (m, n)
    t: Array  # (m,) -0.5..0.5
    warm: Array  # (m,) temperature less its mean
    s: Array  # (m, n) directions
    payload: Array  # (m,)
    marker: np.ndarray  # (m,) number of the measured point, from 0


def session(truth: TrueArm, q: Array, rng: np.random.Generator, reflectors: int = 1) -> RowConditions:
    """Postures (m, n) measured one after another, reflectors taking turns."""
    m = len(q)
    s = np.vstack([np.ones(truth.n), np.sign(np.diff(q, axis=0))])
    for i in range(1, m):
        s[i] = np.where(s[i] == 0, s[i - 1], s[i])
    walk = 20.0 + 3.0 * np.sin(np.arange(m) / m * 2.5 * np.pi + rng.uniform(0, 6.3)) + rng.normal(0, 1.0, m)
    t, payload, marker = np.arange(m) / (m - 1) - 0.5, np.full(m, truth.payload), np.arange(m) % reflectors
    return RowConditions(q, t, walk - walk.mean(), s, payload, marker)


# -- rigid motions -----------------------------------------------------------------------------------------------------
def turn(vector: Array) -> Array:
    """(..., 3, 3) rotations by vectors (..., 3) (Rodrigues)."""
    angle, half = np.linalg.norm(vector, axis=-1)[..., None, None], np.zeros((*vector.shape, 3))
    half[..., [2, 0, 1], [1, 2, 0]] = vector
    turned = np.sinc(angle / np.pi) * (half - np.swapaxes(half, -1, -2))
    along = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * vector[..., None] * vector[..., None, :]
    return np.asarray(np.cos(angle) * np.eye(3) + turned + along)


def screw(rotation: Array, point: Array) -> Array:
    """(..., 4, 4) rotations (..., 3, 3) about axes through a point (3,)."""
    motion = shift(point - rotation @ point)
    motion[..., :3, :3] = rotation
    return motion


def shift(vector: Array) -> Array:
    """(..., 4, 4) translations by vectors (..., 3)."""
    motion = np.zeros((*vector.shape[:-1], 4, 4))
    motion[..., range(4), range(4)] = 1.0
    motion[..., :3, 3] = vector
    return motion


def at_point(motion: Array, point: Array) -> Array:
    """(..., 3) where motions (..., 4, 4) take a point (3,)."""
    return motion[..., :3, :3] @ point + motion[..., :3, 3]


# -- effects -----------------------------------------------------------------------------------------------------------
def gravity_loads(truth: TrueArm, run: RowConditions) -> tuple[Array, Array, Array]:
    """(m, n, 3) moment of gravity [N m] about the origin of each joint's frame, turned back home; of planar arms (m, n)
    deflection [mm] and slope [rad] of each link's end per unit 1/(EI). All of the drawing, with the loads and the
    gravity that are hidden."""
    m, place, motions = len(run.q), np.broadcast_to(np.eye(4), (len(run.q), 4, 4)), []
    for frame, angle in zip(truth.home, run.q.T, strict=False):  # motions from home of what lies beyond each joint
        place = place @ screw(turn(angle[:, None] * frame[:3, 2]), frame[:3, 3])
        motions.append(place)
    gravity, payload = truth.gravity, run.payload
    for name, _, v in truth.effects:
        if name == "gravity_tilt":  # of the base, in the plane about z
            gravity = turn(np.array([v.get("x", 0.0), v.get("y", 0.0), v.get("angle", 0.0)])) @ gravity
        elif name == "payload_error":
            payload = payload + v["d"]
        elif name == "payload_swap":  # the arm picks up a tool, and lays it down later
            payload = payload + v["d"] * ((run.t > v["at"][0]) & (run.t < v["at"][1]))
    start, end = truth.home[:-1, :3, 3], truth.home[1:, :3, 3]
    load = truth.at_home(truth.tools[0] if truth.load is None else truth.load)
    at_home = np.vstack([start + truth.center * (end - start), load])
    carried = [at_point(motion, point) for motion, point in zip([*motions, motions[-1]], at_home, strict=True)]
    masses, places = np.column_stack([np.tile(truth.masses, (m, 1)), payload]), np.stack(carried, axis=1)

    def moment_of(first: int, motion: Array, point: Array) -> Array:
        """(m, 3) of all masses from this one on, about a point that moves from home."""
        arms = places[:, first:] - at_point(motion, point)[:, None]
        return np.cross(np.einsum("mk,mkd->md", masses[:, first:], arms), gravity) / 1000.0

    turned, deflection, slope = np.zeros((m, truth.n, 3)), np.zeros(run.q.shape), np.zeros(run.q.shape)
    for j, (motion, length) in enumerate(zip(motions, truth.lengths / 1000.0, strict=True)):
        turned[:, j] = np.einsum("mji,mj->mi", motion[:, :3, :3], moment_of(j, motion, start[j]))
        if truth.in_plane:
            force = masses[:, j + 1 :].sum(axis=1) * (motion[:, :3, 1] @ gravity)
            moment = moment_of(j + 1, motion, end[j])[:, 2]
            deflection[:, j] = 1000.0 * (force * length**3 / 3.0 + moment * length**2 / 2.0)
            slope[:, j] = force * length**2 / 2.0 + moment * length
    return turned, deflection, slope


def angle_error(run: RowConditions, name: str, joint: int, v: Values, torque: Array) -> Array:
    """(m,) what an effect of a joint adds to its angle, 0 for those that add none.

    torque : (m, n) of gravity [N m]; the last of the table are not in the library
    """
    q, s = run.q[:, joint - 1], run.s[:, joint - 1]
    neighbor = run.q[:, joint] if joint < run.q.shape[1] else run.q[:, joint - 2]
    shapes: dict[str, Callable[[], Array]] = {
        "joint_compliance": lambda: v["c"] * torque[:, joint - 1],
        "gravity_backlash": lambda: v["b"] * np.sign(torque[:, joint - 1]),
        "encoder_eccentricity": lambda: v["a"] * np.cos(q) + v["b"] * np.sin(q),
        "encoder_second_harmonic": lambda: v["a"] * np.cos(2 * q) + v["b"] * np.sin(2 * q),
        "transmission_ripple": lambda: v["a"] * np.cos(v["k"] * q) + v["b"] * np.sin(v["k"] * q),
        "gear_ratio": lambda: v["e"] * q,
        "joint_coupling": lambda: v["c"] * run.q[:, joint - 2],
        "backlash": lambda: v["b"] * s,
        "joint_step": lambda: v["b"] * (run.t > v["at"]),
        "joint_hysteresis": lambda: v["b"] * wound_up(q, np.radians(v["width_deg"])),
        "bump": lambda: v["h"] * np.exp(-0.5 * (np.angle(np.exp(1j * (q - v["at"]))) / v["width"]) ** 2),
        "cubic": lambda: v["c"] * q**3,
        # a cable along the arm pulls the joint harder the more it and its neighbor wind it
        "cable_pull": lambda: v["c"] * q * neighbor,
        "memory_hysteresis": lambda: v["h"] * relays(q, v["at"], v["width"]),
        # slack until both joints have wound it up, then it pulls both
        "two_joint_cable": lambda: v["c"] * np.maximum(0.0, q + neighbor - v["at"]),
        # a sector of the teeth is worn down evenly
        "gear_wear": lambda: v["h"] / (1.0 + (np.angle(np.exp(1j * (q - v["at"]))) / v["width"]) ** 8),
        # the field of another joint's motor in the encoder
        "cross_talk": lambda: v["a"] * np.cos(run.q[:, v["other"] - 1]) + v["b"] * np.sin(run.q[:, v["other"] - 1]),
        # a short move stops short, a long one slips past
        "stick_slip": lambda: v["b"] * s * (1.0 - 2.0 * np.exp(-np.append(np.inf, np.abs(np.diff(q))) / v["width"])),
    }
    return shapes[name]() if name in shapes else np.zeros(len(q))


def relays(angles: Array, at: float, width: float) -> Array:
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


def wound_up(angles: Array, width: float) -> Array:
    """(m,) wind-up in -1..1 of a joint that goes through these angles, from 0 at the first."""
    state = np.zeros(len(angles))
    for i in range(1, len(angles)):
        state[i] = min(1.0, max(-1.0, state[i - 1] + (angles[i] - angles[i - 1]) / width))
    return state


def position(truth: TrueArm, run: RowConditions) -> Array:
    """(m, d) true positions of the measured points."""
    tip = places(truth, run)[-1][:, : truth.dimension, 3]
    for name, _, v in truth.effects:
        if name == "axes_skew":
            tip = tip + tip @ np.array([[v["a"], v["b"]], [v["b"], -v["a"]]])
        elif name == "refraction":  # outside the library: across the line of sight, as its length squared
            sight = tip - v["at"]
            across = np.column_stack([-sight[:, 1], sight[:, 0]])
            tip = tip + v["c"] * np.linalg.norm(sight, axis=1, keepdims=True) * across / truth.lengths.sum()
    return tip


def places(truth: TrueArm, run: RowConditions) -> list[Array]:
    """n + 2 transformations (m, 4, 4): of the base, of what lies beyond each joint, and the measured point's place."""
    (m, n), home, effects = run.q.shape, truth.home, truth.modelled + truth.effects
    moments, deflection, slope = np.zeros((m, n, 3)), np.zeros((m, n)), np.zeros((m, n))
    if {name for name, *_ in effects} & set(OF_GRAVITY):
        moments, deflection, slope = gravity_loads(truth, run)
    torques = np.einsum("mji,ji->mj", moments, home[:-1, :3, 2])
    drift, rotation = np.zeros((m, 3)), np.zeros((m, 3))  # of the base
    since = run.t + 0.5  # the first row
    for name, _, v in truth.effects:
        if name == "base_offset":
            drift = drift + np.array([v["x0"], v["y0"], 0.0])
        elif name == "base_step":
            drift = drift + (run.t > v["at"])[:, None] * [v["x"], v["y"], 0.0]
        elif name in ("base_drift", "warm_offset"):
            drift[:, : truth.dimension] += (run.t if name == "base_drift" else run.warm)[:, None] * v["v"]
        elif name == "base_rotation_drift":  # in the plane about z
            rotation = rotation + run.t[:, None] * (v["w"] * UPRIGHT if truth.in_plane else np.array(v["w"]))
    frames = [np.asarray(shift(drift) @ truth.base @ screw(turn(rotation), np.zeros(3)))]
    for j, (line, point, link) in enumerate(zip(truth.axes, truth.points, truth.links, strict=True)):
        (x, y, axis), origin, q = home[j, :3, :3].T, home[j, :3, 3], run.q[:, j]
        angle, lean, bend = q + truth.offsets[j], np.zeros(3), np.zeros(m)
        tilt, moved, longer = np.zeros((m, 3)), np.zeros((m, 3)), np.zeros((m, 3))  # of what lies beyond, at home
        for name, joint, v in effects:
            if name == "joint_compliance" and joint is None:
                angle = angle + v["c"][j] * torques[:, j]
            elif joint is not None and (joint == j + 1 or (name == "two_joint_cable" and joint == j)):
                angle = angle + angle_error(run, name, joint, v, torques)
            grows = joint in (None, j + 1)
            if name == "thermal_growth" and grows:
                longer = longer + np.outer(v["a"] * run.warm, link)
            elif name == "thermal_transient" and grows:
                longer = longer + np.outer(v["a"] * (1.0 - np.exp(-since / v["tau"])), link)
            elif name == "link_step" and grows:
                longer = longer + np.outer(v["d"] * (run.t > v["at"]) / float(np.linalg.norm(link)), link)
            elif name == "two_warm_ups" and grows:  # outside the library: fast, and slowly back
                slow = np.exp(-since[:, None] / v["tau"]) @ [-v["a"], -v["b"]] + v["a"] + v["b"]
                longer = longer + np.outer(slow, link)
            elif name == "link_bending":
                longer, bend = longer + v["flexibility"] * np.outer(deflection[:, j], y), v["flexibility"] * slope[:, j]
            elif name == "bearing_compliance" and joint == j + 1:
                tilt = tilt + v["c"] * (moments[:, j] - torques[:, j, None] * axis)
            elif name == "axis_wobble" and joint == j + 1:  # outside the library: twice a turn
                tilt = tilt + v["c"] * np.column_stack([np.cos(2 * q), np.sin(2 * q)]) @ [x, y]
            elif name == "axis_runout" and joint == j + 1:
                circle = (v["a"] + 1j * v["b"]) * np.exp(-1j * q)
                moved = moved + np.column_stack([circle.real, circle.imag]) @ [x, y]
            elif name == "axis_tilt" and joint == j + 1:
                lean = np.sqrt(v["square"]) * (np.cos(v["beta"]) * x + np.sin(v["beta"]) * y)
        place = frames[-1] @ shift(moved) @ screw(turn(lean), point) @ screw(turn(angle[:, None] * line), point)
        place = (place @ screw(turn(tilt), origin) if tilt.any() else place) @ shift(longer)
        frames.append(place @ screw(turn(bend[:, None] * axis), point + link) if bend.any() else place)
    tools = truth.at_home(truth.tools)[run.marker]
    for name, _, v in truth.effects:
        if name == "gripper_play":  # outside the library: what it holds slides to the lower end of a slot
            slot = np.array([np.cos(v["beta"]), np.sin(v["beta"]), 0.0])
            tools = tools - v["h"] * np.sign(frames[-1][:, 1, :3] @ slot)[:, None] * slot
    return [*frames, frames[-1] @ shift(tools)]


# -- derivatives -------------------------------------------------------------------------------------------------------
def scaled_amplitudes(values: Values, factor: float) -> Values:
    """The amplitudes times a factor; k, at, width and the like are shapes and stay."""
    return {name: (v if name in SHAPES else v * factor) for name, v in values.items()}


def column(truth: TrueArm, run: RowConditions, effect: Drawn) -> Array:
    """(m d,) derivative of the position with respect to the amplitude of an effect."""
    name, joint, values = effect
    steps = (1e-6, 0.0 if name == "axis_tilt" else -1e-6)  # which has no negative amplitude
    up, down = (replace(truth, effects=[(name, joint, scaled_amplitudes(values, step))]) for step in steps)
    return np.asarray((position(up, run) - position(down, run)).ravel() / (steps[0] - steps[1]))


def base_jacobian(truth: TrueArm, run: RowConditions) -> Array:
    """(m d, p) columns of all that the geometry of an arm can be wrong about.

    In the plane lengths and angles of the links, in which the position is linear: p = 2n. In space a small displacement
    of the base and of all beyond each joint, and the places of the K measured points: p = 6 (n + 1) + 3K.
    """
    if truth.in_plane:
        _, *frames, _ = places(replace(truth, effects=[], modelled=[]), run)
        return np.concatenate([frame[:, :2, :2] for frame in frames], axis=2).reshape(2 * len(run.q), -1)
    *frames, last = places(truth, run)
    columns = []
    for frame in frames:
        at = np.linalg.solve(frame, last)[:, :3, 3]
        rotation = frame[:, :3, :3]
        columns += [rotation, np.cross(rotation, rotation @ at[:, :, None], axis=1)]
    for k in range(len(truth.tools)):
        columns.append(1.0 * (run.marker == k)[:, None, None] * frames[-1][:, :3, :3])
    return np.concatenate(columns, axis=2).reshape(3 * len(run.q), -1)


def off(columns: Array, vector: Array) -> Array:
    """What a fit by least squares of the columns (N, p) leaves of vectors (N,) or (N, k)."""
    basis = columns @ spectrum(columns, np.ones(columns.shape[1])).root
    return np.asarray(vector - basis @ (basis.T @ vector))


# -- the instrument ----------------------------------------------------------------------------------------------------
def noise(truth: TrueArm, run: RowConditions, rng: np.random.Generator, kind: str = "white") -> Array:
    """(m, d) noise, of sigma in each coordinate where it is white.

    kind : beside those by name: `t3`: Student's t with 3 degrees of freedom and this standard deviation; `walk`: white
        noise and a walk whose RMS about its mean is sigma; `quantized`: white noise, and the display shows steps of
        sigma; `posture`: white noise, and an error of 2 sigma that following rows of one posture share
    """
    m, d, sigma = len(run.q), truth.dimension, truth.sigma
    e = sigma * rng.standard_normal((m, d))
    if kind in ("joint", "reach", "quantized"):
        p, reach = position(truth, run), truth.lengths.sum()
    if kind == "joint":  # joint 1 shakes: perpendicular to the reach and proportional to it
        e += np.column_stack([-p[:, 1], p[:, 0]]) / reach * rng.standard_normal(m)[:, None] * sigma * 3
    elif kind == "reach":
        e *= 0.5 + 1.5 * np.linalg.norm(p, axis=1, keepdims=True) / reach
    elif kind == "outliers":
        worst = rng.choice(m, 3, replace=False)
        angle = 2.0 * np.pi * rng.random(3)
        away = np.column_stack([np.cos(angle), np.sin(angle)]) if d == 2 else rng.standard_normal((3, d))
        e[worst] += 15.0 * sigma * away / np.linalg.norm(away, axis=1, keepdims=True)
    elif kind == "serial":
        for i in range(1, m):
            e[i] = 0.7 * e[i - 1] + np.sqrt(1 - 0.49) * e[i]
    elif kind == "t3":
        e = sigma * rng.standard_t(3.0, (m, d)) / np.sqrt(3.0)
    elif kind == "walk":  # over m rows of unit steps the mean square about the mean is (m^2 - 1) / (6 m)
        walk = sigma * np.cumsum(rng.standard_normal((m, d)), axis=0)
        e += (walk - walk.mean(axis=0)) * np.sqrt(6.0 * m / (m**2 - 1.0))
    elif kind == "quantized":
        e = np.round((p + e) / sigma) * sigma - p
    elif kind == "posture":
        number = np.append(0, np.cumsum(np.any(np.diff(run.q, axis=0) != 0.0, axis=1)))
        e += 2.0 * sigma * rng.standard_normal((m, d))[number]  # one error of the model for each posture
    return e


def recorded(truth: TrueArm, run: RowConditions, error: Array) -> Measurements:
    """What the instrument says."""
    names = tuple(str(k + 1) for k in range(len(truth.tools)))
    marker: dict[str, Any] = {"marker": np.array(names)[run.marker], "marker_names": names} if len(names) > 1 else {}
    order, temperature = np.arange(len(run.q), dtype=float), 20.0 + run.warm
    return Measurements(run.q, position(truth, run) + error, order, temperature=temperature, directions=run.s, **marker)
