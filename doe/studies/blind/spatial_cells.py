"""The cells of the blind study in space, and how each of their data sets is drawn. Plain numpy, no model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from doe.studies.blind.cells import WAVES, DataSet
from doe.studies.blind.hidden_effects import directions_of, key, off, scaled_amplitudes, settings_of
from doe.studies.blind.simulator import Drawn, RowConditions, session
from doe.studies.blind.spatial_simulator import OF_GRAVITY, SpatialTruth, base_jacobian, position, shift, turn
from identification.arm import Arm, EffectSpec, Gravity
from identification.arrays import Array
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.measurements import Measurements

SEEN = 0.02  # of an effect's length that must be left beside the geometry, as in the plane
FRESH = 200  # rows of the hold-out
ALL_JOINTS = "joint_compliance*"
OF_JOINT = (
    *("joint_compliance", "gravity_backlash", "bearing_compliance", "encoder_eccentricity", "encoder_second_harmonic"),
    *("transmission_ripple", "gear_ratio", "joint_coupling", "backlash"),
)
OF_ARM = (ALL_JOINTS, "thermal_growth", "base_drift", "base_rotation_drift")


@dataclass(frozen=True)
class SpatialCell:
    """What is drawn in a cell.

    lam : size of the hidden effect, None: nothing is hidden;  reflectors : measured points, taking turns
    gravity : the hidden effect is one of gravity, and the arm file is wrong about `masses` of the links (by up to
        30 %), the mass of the `tool` (missing, a parameter), how the base leans (1 to 3 degrees, `tilt`), or the
        `place` of the payload (see `with_offset_payload`, `loaded`)
    """

    m: int
    lam: float | None = None
    reflectors: int = 1
    gravity: str = ""
    order: float = 0.0  # periods per turn of the hidden gear ripple, where the cell is of one
    reported: bool = True  # in the full study; the others can be asked for by name


CELLS = {
    "space, none, m=60": SpatialCell(60),
    "space, none, m=200": SpatialCell(200),
    "space, none, two reflectors": SpatialCell(60, reflectors=2),
    "space, lambda 8, m=60": SpatialCell(60, 8.0),
    "space, lambda 8, m=200": SpatialCell(200, 8.0),
    "space, lambda 8, two reflectors": SpatialCell(60, 8.0, reflectors=2),
    "space, gravity, lambda 8": SpatialCell(60, 8.0, gravity="known"),
    "space, gravity, wrong masses": SpatialCell(60, 8.0, gravity="masses"),
    "space, gravity, unknown tool mass": SpatialCell(60, 8.0, gravity="tool"),
    "space, gravity, tilted base": SpatialCell(60, 8.0, gravity="tilt"),
    "space, gravity, load elsewhere": SpatialCell(60, 8.0, gravity="place"),
    **{f"space, wave {k:g}, lambda 8": SpatialCell(60, 8.0, order=k, reported=False) for k in WAVES},
}


def random_truth(spec: SpatialCell, rng: np.random.Generator) -> SpatialTruth:
    """A six-axis arm of one of two common builds, its axes 2 mrad and 0.5 mm off, its encoders 5 mrad."""
    table = _table(rng)
    lengths = np.hypot(table[:, 0], table[:, 2])
    span = rng.uniform(1.5, 2.9, len(table))
    tools = np.column_stack(
        [rng.uniform(30.0, 80.0, (2, 2)) * rng.choice([-1.0, 1.0], (2, 2)), rng.uniform(40, 100, 2)]
    )
    base = shift(rng.uniform(-1500.0, 1500.0, 3))
    base[:3, :3] = turn(rng.normal(0.0, 1.0, 3))
    lines = np.zeros((len(table), 3))
    masses = 1.0 + lengths / 100.0 * rng.uniform(1.0, 4.0, len(table))
    payload, sigma = float(rng.uniform(2.0, 10.0)), float(rng.choice([0.02, 0.05, 0.1]))
    offsets = rng.normal(0.0, 5e-3, len(table))
    truth = SpatialTruth(table, lines, lines, offsets, base, tools, masses, payload, -span, span, sigma)
    home = truth.home[:-1]
    axes = home[:, :3, 2] + 2e-3 * rng.standard_normal(lines.shape)
    points = home[:, :3, 3] + 0.5 * rng.standard_normal(lines.shape)
    return replace(truth, axes=axes / np.linalg.norm(axes, axis=1, keepdims=True), points=points)


def _table(rng: np.random.Generator) -> np.ndarray:
    """(6, 3) a, alpha, d: three parallel axes and an offset wrist, or a wrist whose axes meet."""
    half, lengths = np.pi / 2.0, np.round(rng.uniform([150, 300, 250, 80, 80, 60], [500, 700, 600, 200, 130, 120]))
    rise, upper, fore, *wrist = lengths.tolist()
    if rng.random() < 0.5:
        rows = [(0.0, half, rise), (-upper, 0.0, 0.0), (-fore, 0.0, 0.0), (0.0, half, wrist[0])]
        return np.array([*rows, (0.0, -half, wrist[1]), (0.0, 0.0, wrist[2])])
    rows = [(wrist[0], -half, rise), (upper, 0.0, 0.0), (wrist[1], -half, 0.0), (0.0, half, fore)]
    return np.array([*rows, (0.0, -half, 0.0), (0.0, 0.0, wrist[2])])


def directions(name: str, rng: np.random.Generator) -> dict:
    """A random direction in an effect's parameter space; scaled afterwards."""
    if name in ("base_drift", "base_rotation_drift"):
        direction = rng.normal(0.0, 1.0, 3)
        return {"v" if name == "base_drift" else "w": direction / np.linalg.norm(direction)}
    return {"c": 1.0} if name == "bearing_compliance" else directions_of(name, 6, rng)


def column(truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None, effect: Drawn) -> np.ndarray:
    """(3m,) derivative of the position with respect to the amplitude of an effect."""
    name, joint, values = effect
    up, down = (replace(truth, effects=[(name, joint, scaled_amplitudes(values, step))]) for step in (1e-6, -1e-6))
    return (position(up, run, marker) - position(down, run, marker)).ravel() / 2e-6


def random_effect(
    spec: SpatialCell, truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None, rng: np.random.Generator
) -> Drawn:
    """One effect, its type at random, then its joint, so large that off the geometry it is lambda sigma long."""
    own = ("transmission_ripple",) if spec.order else (*OF_GRAVITY, ALL_JOINTS) if spec.gravity else OF_JOINT + OF_ARM
    geometry = base_jacobian(truth, run, marker)
    assert spec.lam is not None
    while True:
        pick = str(rng.choice(own))
        joint = None if pick in OF_ARM else int(rng.integers(2 if pick == "joint_coupling" else 1, truth.n + 1))
        effect = pick.rstrip("*"), joint, directions(pick, rng) | ({"k": spec.order} if spec.order else {})
        length = column(truth, run, marker, effect)
        seen = np.linalg.norm(off(geometry, length))
        if seen > SEEN * np.linalg.norm(length) > 0.0:
            return effect[0], joint, scaled_amplitudes(effect[2], float(spec.lam * truth.sigma / seen))


def arm_of(spec: SpatialCell, truth: SpatialTruth, rng: np.random.Generator) -> Arm:
    """The arm as its maker describes it, who does not know where base and reflectors are."""
    limits = zip(truth.lower.tolist(), truth.upper.tolist(), strict=True)
    rows = [DHRow(a, alpha, d, limits=own) for (a, alpha, d), own in zip(truth.table.tolist(), limits, strict=True)]
    chain = replace(chain_of(rows), tools={str(k + 1): np.zeros(3) for k in range(spec.reflectors)})
    masses = truth.masses * (rng.uniform(0.7, 1.3, truth.n) if spec.gravity == "masses" else 1.0)
    payload = 0.0 if spec.gravity == "tool" else truth.payload
    gravity = Gravity(np.array([0.0, 0.0, -9.81]), masses, np.full(truth.n, truth.share), payload)
    effects = (EffectSpec("tool_mass"),) if spec.gravity == "tool" else ()
    return Arm.of_chain(chain, sigma=truth.sigma, gravity=gravity, effects=effects)


def leaning(truth: SpatialTruth, rng: np.random.Generator) -> SpatialTruth:
    """The arm on a base that leans by 1 to 3 degrees."""
    angle, phase = np.radians(rng.uniform(1.0, 3.0)), rng.uniform(0.0, 2.0 * np.pi)
    return replace(truth, gravity=turn(angle * np.array([np.cos(phase), np.sin(phase), 0.0])) @ truth.gravity)


def with_offset_payload(truth: SpatialTruth, rng: np.random.Generator) -> SpatialTruth:
    """The arm with a payload of 5 to 20 kg that hangs 150 to 300 mm beside the first measured point."""
    phase = rng.uniform(0.0, 2.0 * np.pi)
    away = rng.uniform(150.0, 300.0) * np.array([np.cos(phase), np.sin(phase), rng.uniform(-0.3, 0.6)])
    return replace(truth, payload=float(rng.uniform(5.0, 20.0)), load=truth.tools[0] + away)


def loaded(spec: SpatialCell, truth: SpatialTruth, run: RowConditions, rng: np.random.Generator) -> list[Drawn]:
    """Compliance in all joints, such that the payload's place adds lambda sigma off the compliance that would fit best
    without it; and that place."""
    c = rng.uniform(0.5, 1.5, truth.n)
    effects = [("joint_compliance", j, {"c": float(one)}) for j, one in enumerate(c, start=1)]
    there = np.stack([column(truth, run, None, effect) for effect in effects], axis=1)
    here = np.stack([column(replace(truth, load=None), run, None, effect) for effect in effects], axis=1)
    unseen = np.column_stack([base_jacobian(truth, run), here])
    assert spec.lam is not None and truth.load is not None  # noqa: PT018
    size = spec.lam * truth.sigma / np.linalg.norm(off(unseen, np.sum(there - here, axis=1)))
    place = dict(zip("xyz", (truth.load - truth.tools[0]).tolist(), strict=True))
    return [("joint_compliance", None, {"c": size * c}), ("payload_place", None, place)]


def measured(truth: SpatialTruth, spec: SpatialCell, run: RowConditions, rng: np.random.Generator) -> Measurements:
    """What the instrument says, reflectors taking turns."""
    marker = markers(spec, run)
    positions = position(truth, run, marker) + truth.sigma * rng.standard_normal((len(run.q), 3))
    names = {} if marker is None else {"marker": np.array(["1", "2"])[marker], "marker_names": ("1", "2")}
    order = np.arange(len(run.q), dtype=float)
    return Measurements(run.q, positions, order, temperature=20.0 + run.warm, directions=run.s, **names)


def markers(spec: SpatialCell, run: RowConditions) -> np.ndarray | None:
    """(m,) number of the measured point of each row, None: there is one."""
    return None if spec.reflectors == 1 else np.arange(len(run.q)) % spec.reflectors


def true_values(effects: list[Drawn]) -> Mapping[str, float]:
    """Parameter name -> true value, named as the library names its parameters [API units]."""
    found: dict[str, float] = {}
    for name, joint, values in effects:
        for short, value in values.items():
            if short in ("v", "w"):
                own = {f"{'v' if name == 'base_drift' else 'w'}{axis}": value[k] for k, axis in enumerate("xyz")}
            elif np.ndim(value):
                own = {f"{short}{j}": one for j, one in enumerate(value, start=1)}
            else:
                own = {short: value}
            found |= {f"{key((name, joint, values))}.{s}": float(v) for s, v in own.items() if s != "k"}
    return found


def data_set(cell: str, seed: int, _: Array | None = None) -> DataSet:
    """Data set number `seed` of a cell; `FRESH` rows of the same session are held out."""
    spec = CELLS[cell]
    rng = np.random.default_rng([20261125, list(CELLS).index(cell), seed])
    truth = random_truth(spec, rng)
    if spec.gravity == "tilt":
        truth = leaning(truth, rng)
    truth = with_offset_payload(truth, rng) if spec.gravity == "place" else truth
    run, fresh = (_session(spec, truth, count, rng) for count in (spec.m, FRESH))
    arm = arm_of(spec, truth, rng)
    if spec.gravity == "place":
        truth = replace(truth, effects=loaded(spec, truth, run, rng))
    elif spec.lam is not None:
        truth = replace(truth, effects=[random_effect(spec, truth, run, markers(spec, run), rng)])
    return DataSet(
        arm,
        measured(truth, spec, run, rng),
        measured(truth, spec, fresh, rng) if spec.lam is not None else None,
        tuple(key(e) for e in truth.effects),
        specs=tuple(EffectSpec(e[0], e[1], settings_of(e)) for e in truth.effects),
        values={} if spec.gravity not in ("", "known") else true_values(truth.effects),
    )


def _session(spec: SpatialCell, truth: SpatialTruth, count: int, rng: np.random.Generator) -> RowConditions:
    """Random postures; each is measured at every reflector before the arm goes on."""
    q = rng.uniform(truth.lower, truth.upper, (count // spec.reflectors, truth.n))
    return session(truth, np.repeat(q, spec.reflectors, axis=0), rng)  # type: ignore[arg-type]
