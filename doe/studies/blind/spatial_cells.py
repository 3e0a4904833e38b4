"""The cells of the blind study in space, and how each of their data sets is drawn. Plain numpy, no model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from doe.studies.blind.cells import MANY_SIZES, PHYSICS_SIZES, SEVERAL_SIZES, SMALL_SIZES, WAVES, DataSet, reachable
from doe.studies.blind.hidden_effects import key, log_uniform, place_of, settings_of
from doe.studies.blind.simulator import Drawn, RowConditions, model_error, session
from doe.studies.blind.spatial_hidden_effects import (
    ALL_JOINTS,
    OF_ARM,
    OF_JOINT,
    OUTSIDE,
    PHYSICS,
    column,
    drawn_at_random,
    loaded,
    many_effects,
    outside_effect,
    several_effects,
    true_values,
)
from doe.studies.blind.spatial_simulator import OF_GRAVITY, SpatialTruth, base_jacobian, position, shift, turn
from identification.arm import Arm, EffectSpec, Gravity
from identification.arrays import Array
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.measurements import Measurements

FRESH = 200  # rows of the hold-out
MANY_ROWS = (60, 100, 200)
WRONG_ROWS, WRONG = 3, 15.0  # outliers of a set, and how far off they are [sigma]


@dataclass(frozen=True)
class SpatialCell:
    """What is drawn in a cell.

    lam : size of the hidden effect, None: nothing is hidden;  reflectors : measured points, taking turns
    gravity : the hidden effect is one of gravity, and the arm file is wrong about `masses` of the links (by up to
        30 %), the mass of the `tool` (missing, a parameter), how the base leans (1 to 3 degrees, `tilt`), or the
        `place` of the payload (see `with_offset_payload`, `loaded`)
    effects : how many are hidden, of different families;  outside : an effect that the library does not have
    outliers : three rows are 15 sigma off, in a random direction
    sizes : lambda of each effect is drawn between these, instead of `lam`
    many : kind of `many_effects`;  rows : one of them is the number of rows instead of m
    physics : name of the hidden effect, where it is one of `PHYSICS`
    reads : of each posture, one after another, with an error of 2 sigma that they share
    """

    m: int
    lam: float | None = None
    sizes: tuple[float, float] | None = None
    reflectors: int = 1
    gravity: str = ""
    order: float = 0.0  # periods per turn of the hidden gear ripple, where the cell is of one
    effects: int = 1
    outside: bool = False
    outliers: bool = False
    many: str = ""
    rows: tuple[int, ...] = ()
    physics: str = ""
    reads: int = 1
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
    "space, two, lambda 8": SpatialCell(60, 8.0, effects=2),
    "space, two, lambda 8, m=200": SpatialCell(200, 8.0, effects=2),
    "space, three outliers, lambda 8": SpatialCell(60, 8.0, outliers=True),
    "space, outside, lambda 7": SpatialCell(60, 7.0, outside=True),
    "space, outside, lambda 10": SpatialCell(60, 10.0, outside=True),
    "space, many effects": SpatialCell(60, sizes=MANY_SIZES, many="robot", rows=MANY_ROWS),
    **{
        f"space, many small effects, m={m}": SpatialCell(m, sizes=SMALL_SIZES, many="small", reported=False)
        for m in (50, 100, 300)
    },
    **{
        f"space, six to nine effects, m={m}": SpatialCell(m, sizes=SEVERAL_SIZES, many="several", reported=False)
        for m in (50, 100, 300)
    },
    **{
        f"space, outside, {name}": SpatialCell(100, sizes=PHYSICS_SIZES, physics=name, rows=MANY_ROWS, reported=False)
        for name in PHYSICS
    },
    "space, three reads, none": SpatialCell(180, reads=3, reported=False),
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


def measured(truth: SpatialTruth, spec: SpatialCell, run: RowConditions, rng: np.random.Generator) -> Measurements:
    """What the instrument says, reflectors taking turns."""
    marker = markers(spec, run)
    error = rng.standard_normal((len(run.q), 3))
    error = error + model_error(run, 3, rng) if spec.reads > 1 else error
    positions = position(truth, run, marker) + truth.sigma * error
    names = {} if marker is None else {"marker": np.array(["1", "2"])[marker], "marker_names": ("1", "2")}
    order = np.arange(len(run.q), dtype=float)
    return Measurements(run.q, positions, order, temperature=20.0 + run.warm, directions=run.s, **names)


def markers(spec: SpatialCell, run: RowConditions) -> np.ndarray | None:
    """(m,) number of the measured point of each row, None: there is one."""
    return None if spec.reflectors == 1 else np.arange(len(run.q)) % spec.reflectors


def hidden(spec: SpatialCell, truth: SpatialTruth, run: RowConditions, rng: np.random.Generator) -> list[Drawn]:
    """The effects of a data set."""
    if spec.sizes and spec.many:
        return many_effects(truth, run, spec.many, spec.sizes, rng)
    if spec.sizes:
        return [outside_effect(truth, run, log_uniform(spec.sizes, rng), rng, (spec.physics,))]
    if spec.lam is None:
        return []
    if spec.outside:
        return [outside_effect(truth, run, spec.lam, rng)]
    if spec.effects > 1:
        return several_effects(spec.effects, truth, run, spec.lam, rng)
    if spec.gravity == "place":
        return loaded(truth, run, spec.lam, rng)
    names = ("transmission_ripple",) if spec.order else (*OF_GRAVITY, ALL_JOINTS) if spec.gravity else OF_JOINT + OF_ARM
    return [drawn_at_random(names, truth, run, markers(spec, run), spec.lam, rng, order=spec.order)]


def data_set(cell: str, seed: int, _: Array | None = None) -> DataSet:
    """Data set number `seed` of a cell; `FRESH` rows of the same session are held out."""
    spec = CELLS[cell]
    rng = np.random.default_rng([20261125, list(CELLS).index(cell), seed])
    truth = random_truth(spec, rng)
    if spec.gravity == "tilt":
        truth = leaning(truth, rng)
    truth = with_offset_payload(truth, rng) if spec.gravity == "place" else truth
    rows = int(rng.choice(spec.rows)) if spec.rows else spec.m
    run, fresh = (_session(one, truth, count, rng) for one, count in ((spec, rows), (replace(spec, reads=1), FRESH)))
    arm = arm_of(spec, truth, rng)
    truth = replace(truth, effects=hidden(spec, truth, run, rng))
    outside = [effect for effect in truth.effects if effect[0] in OUTSIDE + PHYSICS]
    inside = [effect for effect in truth.effects if effect[0] not in OUTSIDE + PHYSICS]
    data = measured(truth, spec, run, rng)
    error = data.positions - position(truth, run, markers(spec, run))
    judged = bool(spec.many or outside or spec.reads > 1)
    holdout = measured(truth, spec, fresh, rng) if truth.effects or judged else None
    data, wrong = with_outliers(data, truth.sigma, rng) if spec.outliers else (data, ())
    data = replace(data, repeats=np.arange(len(data)) // spec.reads) if spec.reads > 1 else data
    return DataSet(
        arm,
        data,
        holdout,
        tuple(key(e) for e in inside),
        outside=outside[0][0] if outside else None,
        place=place_of(outside[0]) if outside else None,
        specs=tuple(EffectSpec(e[0], e[1], settings_of(e)) for e in inside),
        wrong_rows=wrong,
        values={} if spec.gravity not in ("", "known") or outside else true_values(truth.effects),
        exact=position(truth, fresh) if judged else None,
        reachable=reachable(fitted_in_space(truth, run), fitted_in_space(truth, fresh), error) if judged else None,
    )


def fitted_in_space(truth: SpatialTruth, run: RowConditions) -> Array:
    """(3m, p) of the geometry and of an amplitude of each hidden effect."""
    return np.column_stack([base_jacobian(truth, run), *(column(truth, run, None, effect) for effect in truth.effects)])


def with_outliers(data: Measurements, sigma: float, rng: np.random.Generator) -> tuple[Measurements, tuple[int, ...]]:
    """Rows that are wrong by 15 sigma in a random direction, and their numbers from 1."""
    worst = rng.choice(len(data), WRONG_ROWS, replace=False)
    off = rng.standard_normal((WRONG_ROWS, 3))
    positions = np.array(data.positions)
    positions[worst] += WRONG * sigma * off / np.linalg.norm(off, axis=1, keepdims=True)
    return replace(data, positions=positions), tuple(sorted(int(row) + 1 for row in worst))


def _session(spec: SpatialCell, truth: SpatialTruth, count: int, rng: np.random.Generator) -> RowConditions:
    """Random postures; each is measured at every reflector, and as often as it is read, before the arm goes on."""
    times = spec.reflectors * spec.reads
    q = rng.uniform(truth.lower, truth.upper, (count // times, truth.n))
    return session(truth, np.repeat(q, times, axis=0), rng)  # type: ignore[arg-type]
