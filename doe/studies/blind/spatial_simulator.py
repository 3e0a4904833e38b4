"""A second implementation of arms in space and their effects: products of exponentials, in plain numpy.

At home, with all joints at zero, the arm is a set of lines in space, points on them and masses; every joint turns all
that lies beyond about its line (R. W. Brockett, "Robotic manipulators and the product of exponentials formula", 1984).
The arm's maker has a Denavit-Hartenberg table, the real lines are a little off. Nothing here calls the model or its
effects, and a test checks that. Millimetres, radians, kilograms; all rows of a session at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from doe.studies.blind.rare_effects import warm_up
from doe.studies.blind.simulator import Drawn, G, RowConditions, angle_error

OF_GRAVITY = ("joint_compliance", "gravity_backlash", "bearing_compliance")


@dataclass
class SpatialTruth:
    """The real arm and what its maker says.

    table : (n, 3) a, alpha, d of the drawing (standard Denavit-Hartenberg)
    axes, points : (n, 3) directions and points of the real axes at home;  offsets : (n,) of the encoders
    base : (4, 4) pose of the arm in the instrument's frame;  tools : (K, 3) measured points in the drawing's last frame
    masses, payload : of links and tool;  share : where along a link its mass is
    gravity : (3,) as it really is in the arm's base;  load : (3,) where the payload really hangs in the drawing's last
        frame, None: at the first measured point
    """

    table: np.ndarray
    axes: np.ndarray
    points: np.ndarray
    offsets: np.ndarray
    base: np.ndarray
    tools: np.ndarray
    masses: np.ndarray
    payload: float
    lower: np.ndarray
    upper: np.ndarray
    sigma: float
    share: float = 0.5
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -G]))
    load: np.ndarray | None = None
    effects: list[Drawn] = field(default_factory=list)

    @property
    def n(self) -> int:
        return len(self.table)

    @property
    def home(self) -> np.ndarray:
        """(n + 1, 4, 4) frames of the drawing at home: of each joint, and of the tip."""
        frames = [np.eye(4)]
        for a, alpha, d in self.table:
            frames.append(
                frames[-1] @ shift(np.array([a, 0.0, d])) @ screw(turn(np.array([alpha, 0.0, 0.0])), np.zeros(3))
            )
        return np.array(frames)

    @property
    def measured(self) -> np.ndarray:
        """(K, 3) the measured points at home."""
        return self.at_home(self.tools)

    def at_home(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) points of the drawing's last frame at home."""
        return points @ self.home[-1, :3, :3].T + self.home[-1, :3, 3]


def turn(vector: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotations by vectors (..., 3) (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)
    whole = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + whole[0] * cross + whole[1] * cross @ cross


def screw(rotation: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(..., 4, 4) rotations (..., 3, 3) about axes through a point (3,)."""
    found = np.zeros((*rotation.shape[:-2], 4, 4))
    found[..., :3, :3], found[..., 3, 3] = rotation, 1.0
    found[..., :3, 3] = point - rotation @ point
    return found


def shift(vector: np.ndarray) -> np.ndarray:
    """(..., 4, 4) translations by vectors (..., 3)."""
    found = np.zeros((*vector.shape[:-1], 4, 4))
    found[..., range(4), range(4)] = 1.0
    found[..., :3, 3] = vector
    return found


def link_motions(axes: np.ndarray, points: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
    """n transformations (m, 4, 4) of what lies beyond each joint, from home to the postures (m, n)."""
    place, found = np.broadcast_to(np.eye(4), (len(q), 4, 4)), []
    for axis, point, angle in zip(axes, points, q.T, strict=True):
        place = place @ screw(turn(angle[:, None] * axis), point)
        found.append(place)
    return found


def moments(truth: SpatialTruth, run: RowConditions) -> np.ndarray:
    """(m, n, 3) moment of gravity [N m] about the origin of each joint's frame, of the drawing, turned back home."""
    home = truth.home
    places = link_motions(home[:-1, :3, 2], home[:-1, :3, 3], run.q)
    start, end = home[:-1, :3, 3], home[1:, :3, 3]
    loads = [
        (mass, place, at)
        for mass, place, at in zip(truth.masses, places, start + truth.share * (end - start), strict=True)
    ]
    more = sum(v["d"] for name, _, v in truth.effects if name == "payload_error")
    loads.append((run.payload + more, places[-1], truth.at_home(truth.tools[0] if truth.load is None else truth.load)))
    lean = [v["angle"] for name, _, v in truth.effects if name == "gravity_tilt"]
    gravity = turn(np.array([*lean[0], 0.0])) @ truth.gravity if lean else truth.gravity
    found = np.zeros((len(run.q), truth.n, 3))
    for j, (own, origin) in enumerate(zip(places, start, strict=True)):
        here = own @ np.append(origin, 1.0)
        for mass, place, at in loads[j:]:
            arm = (place @ np.append(at, 1.0) - here)[:, :3]
            force = np.broadcast_to(mass, len(arm))[:, None] * gravity
            found[:, j] += (own[:, :3, :3].transpose(0, 2, 1) @ np.cross(arm / 1000.0, force)[:, :, None])[:, :, 0]
    return found


@dataclass
class Errors:
    """What effects add: angles (m, n), growth (m, n) of the links, tilts and shifts (m, n, 3) of the axes, at home."""

    angles: np.ndarray
    growth: np.ndarray
    tilts: np.ndarray
    shifts: np.ndarray


def errors(truth: SpatialTruth, run: RowConditions) -> Errors:
    """Of all effects of an arm."""
    m, n, home = len(run.q), truth.n, truth.home[:-1]
    found = Errors(*(np.zeros((m, n)) for _ in range(2)), *(np.zeros((m, n, 3)) for _ in range(2)))
    lengths = np.linalg.norm(np.diff(truth.home[:, :3, 3], axis=0), axis=1)
    load = moments(truth, run) if {name for name, *_ in truth.effects} & set(OF_GRAVITY) else np.zeros((m, n, 3))
    torques = np.einsum("mji,ji->mj", load, home[:, :3, 2])
    for name, joint, v in truth.effects:
        j = 0 if joint is None else joint - 1
        if name == "joint_compliance":
            found.angles[:, slice(None) if joint is None else j] += (
                v["c"] * torques[:, slice(None) if joint is None else j]
            )
        elif name == "gravity_backlash":
            found.angles[:, j] += v["b"] * np.sign(torques[:, j])
        elif name == "bearing_compliance":
            axis = home[j, :3, 2]
            found.tilts[:, j] += v["c"] * (load[:, j] - torques[:, j, None] * axis)
        elif name == "axis_runout":
            circle = (v["a"] + 1j * v["b"]) * np.exp(-1j * run.q[:, j])
            found.shifts[:, j] += circle.real[:, None] * home[j, :3, 0] + circle.imag[:, None] * home[j, :3, 1]
        elif name == "axis_wobble":  # outside the library: the axis leans, and goes round twice a turn
            twice = v["c"] * np.exp(2j * run.q[:, j])
            found.tilts[:, j] += twice.real[:, None] * home[j, :3, 0] + twice.imag[:, None] * home[j, :3, 1]
        elif name == "thermal_growth":
            found.growth += v["a"] * run.warm[:, None] * lengths
        elif name == "two_warm_ups":
            found.growth += warm_up(v, run.t)[:, None] * lengths
        elif joint is not None:
            found.angles += angle_error(truth, run, run, name, joint, v)  # type: ignore[arg-type]
    return found


def position(truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None = None) -> np.ndarray:
    """(m, 3) true positions of the measured points, by their numbers (m,) from 0; None: of the first."""
    return places(truth, run, marker)[-1][:, :3, 3]


def places(truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None = None) -> list[np.ndarray]:
    """n + 2 transformations (m, 4, 4): of the base, of what lies beyond each joint, and the measured point's place."""
    error, home = errors(truth, run), truth.home[:, :3, 3]
    links = np.diff(home, axis=0)
    links = links / np.maximum(np.linalg.norm(links, axis=1, keepdims=True), 1e-9)
    found = [_base(truth, run)]
    for j, (axis, point) in enumerate(zip(truth.axes, truth.points, strict=True)):
        angle = (run.q[:, j] + truth.offsets[j] + error.angles[:, j])[:, None] * axis
        place = found[-1] @ shift(error.shifts[:, j]) @ screw(turn(angle), point)
        found.append(place @ screw(turn(error.tilts[:, j]), home[j]) @ shift(error.growth[:, j, None] * links[j]))
    points = truth.measured[np.zeros(len(run.q), dtype=int) if marker is None else marker]
    return [*found, found[-1] @ shift(points)]


def _base(truth: SpatialTruth, run: RowConditions) -> np.ndarray:
    """(m, 4, 4) where the arm's base is in each row."""
    values = {name: v for name, _, v in truth.effects}
    drift = np.array(values.get("base_drift", {"v": np.zeros(3)})["v"]) * run.t[:, None]
    drift = drift + np.array(values.get("warm_offset", {"v": np.zeros(3)})["v"]) * run.warm[:, None]
    rotation = np.array(values.get("base_rotation_drift", {"w": np.zeros(3)})["w"]) * run.t[:, None]
    return shift(drift) @ truth.base @ screw(turn(rotation), np.zeros(3))


def base_jacobian(truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None = None) -> np.ndarray:
    """(3m, 6 (n + 1) + 3K) derivative by a small displacement of the base and of all beyond each joint, and by the
    places of the measured points: all that the geometry of an arm can be wrong about."""
    *frames, last = places(truth, run, marker)
    columns = []
    for frame in frames:
        at = np.linalg.solve(frame, last)[:, :3, 3]
        rotation = frame[:, :3, :3]
        columns += [rotation, np.cross(rotation, rotation @ at[:, :, None], axis=1)]
    for k in range(len(truth.tools)):
        own = np.ones(len(run.q)) if marker is None else 1.0 * (marker == k)
        columns.append(own[:, None, None] * frames[-1][:, :3, :3])
    return np.concatenate(columns, axis=2).reshape(3 * len(run.q), -1)
