"""A second implementation of the arm and its effects, from identification/README.md, "Effects", in plain numpy.

The blind study simulates the truth with this file; diagnosis fits with `identification.model`. Nothing here calls the
model or its effects. Positions are complex numbers x + iy in millimetres.

The study that uses it: armcal study blind.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from doe.studies.blind.case import Case
from identification.arm import Arm, EffectSpec, Gravity
from identification.measurements import Measurements

G = 9.81
Drawn = tuple[str, int | None, dict]  # name, joint, values of an effect


@dataclass
class Truth:
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

    @property
    def n(self) -> int:
        return len(self.lengths)


@dataclass
class Session:
    """What a row was measured under."""

    q: np.ndarray  # (m, n)
    t: np.ndarray  # (m,) -0.5..0.5
    warm: np.ndarray  # (m,) temperature less its mean
    s: np.ndarray  # (m, n) directions
    payload: np.ndarray  # (m,)


def random_truth(rng: np.random.Generator, n: int | None = None, limits: str = "full") -> Truth:
    n = int(rng.integers(2, 7)) if n is None else n
    lengths = np.round(rng.uniform(80.0, 400.0, n))
    if limits == "full":
        lower, upper = np.full(n, -np.pi), np.full(n, np.pi)
    else:
        span = np.concatenate([[2 * np.pi], rng.uniform(np.radians(120), np.radians(300), n - 1)])
        middle = rng.uniform(-0.5, 0.5, n)
        lower, upper = middle - span / 2, middle + span / 2
    return Truth(
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


def session(truth: Truth, q: np.ndarray, rng: np.random.Generator) -> Session:
    m = len(q)
    change = np.sign(np.diff(q, axis=0))
    s = np.vstack([np.ones(truth.n), change])
    for i in range(1, m):
        s[i] = np.where(s[i] == 0, s[i - 1], s[i])
    walk = 20.0 + 3.0 * np.sin(np.arange(m) / m * 2.5 * np.pi + rng.uniform(0, 6.3)) + rng.normal(0, 1.0, m)
    return Session(q, np.arange(m) / (m - 1) - 0.5, walk - walk.mean(), s, np.full(m, truth.payload))


def joints_xy(lengths_m: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(m, n+1) nominal positions of the joints and the tip [m]."""
    steps = lengths_m * np.exp(1j * theta)
    return np.hstack([np.zeros((len(theta), 1)), np.cumsum(steps, axis=1)])


def torques(truth: Truth, run: Session) -> np.ndarray:
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


def bending(truth: Truth, run: Session) -> tuple[np.ndarray, np.ndarray]:
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
        for k in range(j + 1, n):
            M = M - G * truth.masses[k] * (centers[:, k] - points[:, j + 1]).real
        deflection[:, j] = 1000.0 * (F * L**3 / 3 + M * L**2 / 2)
        slope[:, j] = F * L**2 / 2 + M * L
    return deflection, slope


def angle_error(truth: Truth, run: Session, name: str, j: int | None, v: dict) -> np.ndarray:
    """(m, n) what an effect adds to the joint angles."""
    out = np.zeros(run.q.shape)
    if name == "joint_compliance" and j is None:
        return np.asarray(v["c"]) * torques(truth, run)
    if j is None:
        return out
    q = run.q[:, j - 1]
    if name == "joint_compliance":
        out[:, j - 1] = v["c"] * torques(truth, run)[:, j - 1]
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
        out[:, j - 1] = v["b"] * np.sign(torques(truth, run)[:, j - 1])
    # outside the library
    elif name == "bump":
        out[:, j - 1] = v["h"] * np.exp(-0.5 * (np.angle(np.exp(1j * (q - v["at"]))) / v["width"]) ** 2)
    elif name == "cubic":
        out[:, j - 1] = v["c"] * q**3
    elif name == "cable_pull":  # a cable along the arm pulls joint j harder the more joint j and its neighbour wind it
        other = run.q[:, j] if j < truth.n else run.q[:, j - 2]
        out[:, j - 1] = v["c"] * q * other
    return out


def position(truth: Truth, run: Session) -> np.ndarray:
    """(m,) complex true positions."""
    q = run.q + truth.joint_offsets
    lengths = (truth.lengths + truth.length_errors) * np.ones(q.shape)
    deflection, slope = np.zeros(q.shape), np.zeros(q.shape)
    for name, j, v in truth.effects:
        q = q + angle_error(truth, run, name, j, v)
        if name == "thermal_growth":
            lengths = lengths + lengths * v["a"] * run.warm[:, None]
        if name == "link_bending":
            d, s = bending(truth, run)
            deflection, slope = deflection + v["f"] * d, slope + v["f"] * s
    theta = np.cumsum(q, axis=1)
    before = np.cumsum(slope, axis=1) - slope
    p = np.sum((lengths + 1j * deflection) * np.exp(1j * (theta + before)), axis=1)
    for name, _, v in truth.effects:
        if name == "base_rotation_drift":
            p = p * np.exp(1j * v["w"] * run.t)
    for name, _, v in truth.effects:
        if name == "base_offset":
            p = p + v["x"] + 1j * v["y"]
        elif name == "base_drift":
            p = p + (v["x"] + 1j * v["y"]) * run.t
        elif name == "step_drift":
            p = p + (v["x"] + 1j * v["y"]) * (run.t > v["at"])
    for name, _, v in truth.effects:
        if name == "axes_skew":
            p = p + (v["a"] + 1j * v["b"]) * np.conj(p)
        elif name == "barrel":  # outside the library: the instrument is bent in a corner of the workspace
            reach = truth.lengths.sum()
            p = p + (v["x"] + 1j * v["y"]) * (np.abs(p) / reach) ** 2 * (p.real / reach)
    return p


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


def scaled(values: dict, factor: float) -> dict:
    """The amplitudes times a factor; k, at and width are shapes and stay."""
    return {name: (v if name in ("k", "at", "width") else v * factor) for name, v in values.items()}


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


def column(truth: Truth, run: Session, effect: tuple[str, int | None, dict]) -> np.ndarray:
    """(2m,) derivative of the position by the amplitude of an effect."""
    name, j, v = effect
    h = 1e-6
    up = position(replace(truth, effects=[(name, j, scaled(v, h))]), run)
    down = position(replace(truth, effects=[(name, j, scaled(v, -h))]), run)
    d = (up - down) / (2 * h)
    return np.column_stack([d.real, d.imag]).ravel()


def base_jacobian(truth: Truth, run: Session) -> np.ndarray:
    """(2m, 2n) derivative by u_j = l_j exp(i dtheta_j), real and imaginary parts: the base model is linear in them."""
    z = np.exp(1j * np.cumsum(run.q, axis=1))
    both = np.hstack([z, 1j * z])
    return np.stack([both.real, both.imag], axis=1).reshape(2 * len(z), -1)


def off(columns: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return vector - columns @ np.linalg.lstsq(columns, vector, rcond=1e-10)[0]


def sized(
    truth: Truth,
    run: Session,
    name: str,
    j: int | None,
    lam: float,
    rng: np.random.Generator,
    others: np.ndarray | None = None,
) -> Drawn | None:
    """The effect with amplitude such that |column off the base Jacobian (and `others`)| = lam sigma; None if unseen."""
    v = directions_of(name, truth.n, rng)
    real = "joint_compliance" if name == "joint_compliance*" else name
    d = column(truth, run, (real, j, v))
    seen = np.linalg.norm(off(base_jacobian(truth, run) if others is None else others, d))
    if seen < 0.02 * np.linalg.norm(d):
        return None
    return real, j, scaled(v, float(lam * truth.sigma / seen))


def random_effect(truth: Truth, run: Session, lam: float, rng: np.random.Generator, name: str | None = None) -> Drawn:
    """One effect of the library, its type at random, then its joint."""
    while True:
        pick = name or str(rng.choice(LIBRARY_JOINT + LIBRARY_WHOLE))
        j = None if pick in LIBRARY_WHOLE else int(rng.integers(2 if pick == "joint_coupling" else 1, truth.n + 1))
        found = sized(truth, run, pick, j, lam, rng)
        if found is not None:
            return found


def key(effect: tuple[str, int | None, dict]) -> str:
    return effect[0] if effect[1] is None else f"{effect[0]}:{effect[1]}"


def noise(truth: Truth, run: Session, rng: np.random.Generator, kind: str = "white") -> np.ndarray:
    """(m,) complex noise."""
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
    return e


# -- cases for the study ----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class CellSpec:
    """What is drawn in a cell of the study."""

    m: int
    lam: float | None = None
    effects: int = 1
    noise: str = "white"
    limits: str = "full"  # full, some (narrow joints), paper (the paper's 4-link arm)
    outside: bool = False
    wrong_masses: bool = False
    reported: bool = True  # in the full study; the others can be asked for by name
    families: bool = True  # compliance in all joints at once among the hidden effects
    designed: bool = False  # postures of somebody's plan instead of random ones, the same for SAME_ARM sets


CELLS = {
    "none m=20": CellSpec(20),
    "none m=50": CellSpec(50),
    "none m=200": CellSpec(200),
    "none, joint noise": CellSpec(50, noise="joint"),
    "none, reach noise": CellSpec(50, noise="reach"),
    "none, serial correlation": CellSpec(50, noise="serial"),
    "one, lambda 6, m=50": CellSpec(50, 6.0),
    "one, lambda 6, m=200": CellSpec(200, 6.0),
    "one, lambda 6, 4 links": CellSpec(50, 6.0, limits="paper"),
    "one, lambda 6, no family": CellSpec(50, 6.0, families=False, reported=False),
    "one, lambda 8, m=50": CellSpec(50, 8.0),
    "one, lambda 8, no family": CellSpec(50, 8.0, families=False, reported=False),
    "one, lambda 8, m=20": CellSpec(20, 8.0),
    "one, lambda 20, m=50": CellSpec(50, 20.0),
    "one, lambda 400, m=50": CellSpec(50, 400.0, reported=False),
    "one, lambda 8, narrow joints": CellSpec(50, 8.0, limits="some"),
    "one, lambda 8, wrong masses": CellSpec(50, 8.0, wrong_masses=True),
    "two, lambda 8": CellSpec(50, 8.0, effects=2),
    "two, lambda 8, no family": CellSpec(50, 8.0, effects=2, families=False, reported=False),
    "outside, lambda 7": CellSpec(50, 7.0, outside=True),
    "outside, lambda 10": CellSpec(50, 10.0, outside=True, reported=False),
    "three outliers, lambda 8": CellSpec(50, 8.0, noise="outliers"),
    "one, lambda 6, discriminating plan": CellSpec(50, 6.0, designed=True),
    "one, lambda 8, discriminating plan": CellSpec(50, 8.0, designed=True),
}
SAME_ARM = 10  # sets in a row that share arm and plan where plans are designed: a good one takes its time

GRAVITY = ("joint_compliance", "link_bending", "gravity_backlash")


def family(effect: tuple[str, int | None, dict]) -> str:
    return "gravity" if effect[0] in GRAVITY else effect[0]


def truth_of(spec: CellSpec, rng: np.random.Generator) -> Truth:
    if spec.limits != "paper":
        return random_truth(rng, None, spec.limits)
    truth = random_truth(rng, 4)
    return replace(
        truth,
        lengths=np.array([260.0, 180.0, 120.0, 100.0]),
        masses=np.array([12.0, 8.0, 5.0, 3.0]),
        payload=10.0,
        sigma=0.1,
    )


def hidden(spec: CellSpec, truth: Truth, run: Session, rng: np.random.Generator) -> list[tuple[str, int | None, dict]]:
    """The effects of a case."""
    effects: list[tuple[str, int | None, dict]] = []
    while spec.lam is not None and len(effects) < spec.effects:
        if spec.outside:
            effects.append(outside_effect(truth, run, spec.lam, rng))
            continue
        new = random_effect(truth, run, spec.lam, rng)
        if (spec.families or new[0] != "joint_compliance" or new[1]) and family(new) not in map(family, effects):
            effects.append(new)
    return effects


def library_columns(truth: Truth, run: Session) -> np.ndarray:
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


def outside_effect(truth: Truth, run: Session, lam: float, rng: np.random.Generator) -> tuple[str, int | None, dict]:
    """An effect the library does not have, of size lam outside the span of the library."""
    span = library_columns(truth, run)
    while True:
        name = str(rng.choice(OUTSIDE))
        j = None if name == "step_drift" else int(rng.integers(1, truth.n + 1))
        found = sized(truth, run, name, j, lam, rng, span)
        if found is not None:
            return found


def place_of(effect: tuple[str, int | None, dict]) -> str:
    return {"step_drift": "time", "barrel": "workspace"}.get(effect[0], f"joint:{effect[1]}")


def measure(truth: Truth, run: Session, rng: np.random.Generator, kind: str) -> Measurements:
    return recorded(truth, run, noise(truth, run, rng, kind))


def recorded(truth: Truth, run: Session, error: np.ndarray) -> Measurements:
    """What the instrument says."""
    p = position(truth, run) + error
    order = np.arange(len(run.q), dtype=float)
    xy = np.column_stack([p.real, p.imag])
    return Measurements(run.q, xy, order, temperature=20.0 + run.warm, directions=run.s)


def measure_more(
    truth: Truth,
    run: Session,
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
    added = Session(
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


def arm_of(spec: CellSpec, truth: Truth, rng: np.random.Generator) -> Arm:
    """The arm as its maker describes it."""
    masses = truth.masses * rng.uniform(0.7, 1.3, truth.n) if spec.wrong_masses else truth.masses
    gravity = Gravity(np.array([0.0, -G]), masses, truth.center, truth.payload)
    return Arm(truth.lengths, truth.lower, truth.upper, truth.sigma, gravity=gravity)


def to_be_planned(cell: str, seed: int) -> tuple[Arm, int] | None:
    """Arm and number of postures of a cell whose plan is designed; None where the postures are random."""
    spec = CELLS[cell]
    if not spec.designed:
        return None
    truth = shared_truth(cell, seed)
    return arm_of(spec, truth, np.random.default_rng(0)), max(spec.m, truth.n + 4)


def shared_truth(cell: str, seed: int) -> Truth:
    """The arm that SAME_ARM sets in a row share."""
    rng = np.random.default_rng([20261122, list(CELLS).index(cell), seed // SAME_ARM])
    return truth_of(CELLS[cell], rng)


def case(cell: str, seed: int, planned: np.ndarray | None = None) -> Case:
    """The case of a cell; 200 fresh postures of the same session are held out.

    planned : (m, n) the postures for the arm of `to_be_planned`
    """
    spec = CELLS[cell]
    rng = np.random.default_rng([20261121, list(CELLS).index(cell), seed])
    if spec.designed:
        assert planned is not None
        truth, postures = shared_truth(cell, seed), planned
    else:
        truth = truth_of(spec, rng)
        postures = rng.uniform(truth.lower, truth.upper, (max(spec.m, truth.n + 4), truth.n))
    run = session(truth, postures, rng)
    truth = replace(truth, effects=hidden(spec, truth, run, rng))
    fresh = session(truth, rng.uniform(truth.lower, truth.upper, (200, truth.n)), rng)
    arm = arm_of(spec, truth, rng)
    outside = [e for e in truth.effects if e[0] in OUTSIDE]
    inside = [e for e in truth.effects if e[0] not in OUTSIDE]
    error = noise(truth, run, rng, spec.noise)
    data = recorded(truth, run, error)
    wrong = np.flatnonzero(np.abs(error) > 10.0 * truth.sigma) + 1 if spec.noise == "outliers" else ()

    def more(q: np.ndarray, payload: np.ndarray | None, directions: np.ndarray | None, number: int) -> Measurements:
        later = np.random.default_rng([20261123, list(CELLS).index(cell), seed, number])
        return measure_more(truth, run, data, q, payload, directions, later)

    return Case(
        arm,
        data,
        measure(truth, fresh, rng, "white") if spec.lam is not None else None,
        tuple(key(e) for e in inside),
        place_of(outside[0]) if outside else None,
        tuple(EffectSpec(e[0], e[1], {"k": float(e[2]["k"])} if "k" in e[2] else {}) for e in inside),
        tuple(map(int, wrong)),
        more,
    )
