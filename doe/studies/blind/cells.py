"""The cells of the blind study, and how each of their data sets is drawn. Plain numpy, no model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from doe.studies.blind.hidden_effects import (
    OUTSIDE,
    PHYSICS,
    base_jacobian,
    by_library_name,
    column,
    family,
    key,
    log_uniform,
    many_effects,
    outside_effect,
    parameters_of,
    physics_effect,
    place_of,
    random_effect,
    settings_of,
    wave,
)
from doe.studies.blind.rare_effects import LOADS, RARE_JOINT, RARE_WHOLE
from doe.studies.blind.simulator import (
    Drawn,
    G,
    RowConditions,
    TrueArm,
    measure,
    measure_more,
    noise,
    position,
    random_truth,
    recorded,
    session,
)
from identification.arm import Arm, EffectSpec, Gravity
from identification.arrays import Array
from identification.measurements import Measurements


@dataclass(frozen=True)
class DataSet:
    """Arm and measurements as a user has them, and what is hidden in them.

    effects : keys of the hidden effects that the library has
    outside : name of what is hidden and not in the library;  place : where it sits, alternatives between ` or `; None:
        no place is right
    specs : the hidden effects as an arm file has them, to fit the true model
    wrong_rows : outliers, counted from 1
    values : parameter name -> true value of base and hidden effects [API units], to judge intervals; empty where the
        arm's maker is wrong about it or the library has no such effect
    exact : (200, 2) hold-out without noise [mm], where many effects are hidden or one outside the library
    reachable : RMS distance [mm] from `exact` that a model with what is hidden would have, fitted to these data
    more : (postures, payload or None, directions or None, number) -> the data with further measurements at their end
    """

    arm: Arm
    measurements: Measurements
    holdout: Measurements | None
    effects: tuple[str, ...]
    outside: str | None = None
    place: str | None = None
    specs: tuple[EffectSpec, ...] = ()
    wrong_rows: tuple[int, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    more: Callable[[Array, Array | None, Array | None, int], Measurements] | None = None
    exact: Array | None = None
    reachable: float | None = None


@dataclass(frozen=True)
class CellSpec:
    """What is drawn in a cell of the study."""

    m: int
    lam: float | None = None
    sizes: tuple[float, float] | None = None  # lambda of each effect is drawn between these, instead of `lam`
    effects: int = 1
    noise: str = "white"
    limits: str = "full"  # full, some (narrow joints), paper (the paper's 4-link arm)
    outside: bool = False
    wrong_masses: bool = False
    reported: bool = True  # in the full study; the others can be asked for by name
    families: bool = True  # compliance in all joints at once among the hidden effects
    rare: str = ""  # name of the hidden effect, where the cell is of a rare one
    order: float = 0.0  # periods per turn of the hidden gear ripple, where the cell is of one
    many: str = ""  # kind of `many_effects`
    rows: tuple[int, ...] = ()  # one of them is the number of postures instead of m
    links: tuple[int, int] = (2, 6)  # the least and the most
    physics: str = ""  # name of the hidden effect, where it is one of `PHYSICS`
    reads: int = 1  # of each posture, one after another
    designed: bool = False  # postures of somebody's plan instead of random ones, the same for SAME_ARM sets

    @property
    def hides(self) -> bool:
        """Whether there is a hidden effect."""
        return self.lam is not None or self.sizes is not None


RARE = RARE_WHOLE + RARE_JOINT
WALK = "walk"  # the noise that may be reported as a drift in time
WAVES = (101.0, 202.0, 37.3)
MANY_SIZES, MANY_ROWS = (8.0, 40.0), (50, 100, 200)
SMALL_SIZES, SEVERAL_SIZES, PHYSICS_SIZES = (1.5, 12.0), (5.0, 40.0), (10.0, 40.0)
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
    **{f"{name}, lambda {lam:g}": CellSpec(50, lam, rare=name, reported=False) for name in RARE for lam in (8.0, 10.0)},
    **{f"wave {k:g}, lambda {lam:g}": CellSpec(50, lam, order=k, reported=False) for k in WAVES for lam in (8.0, 10.0)},
    "many effects": CellSpec(50, sizes=MANY_SIZES, many="robot", rows=MANY_ROWS),
    "many effects, harmonics": CellSpec(50, sizes=MANY_SIZES, many="harmonics", rows=MANY_ROWS),
    **{
        f"many small effects, m={m}": CellSpec(m, sizes=SMALL_SIZES, many="small", links=(4, 6), reported=False)
        for m in (50, 100, 300)
    },
    **{
        f"six to nine effects, m={m}": CellSpec(m, sizes=SEVERAL_SIZES, many="several", reported=False)
        for m in (50, 100, 300)
    },
    **{
        f"outside, {name}": CellSpec(100, sizes=PHYSICS_SIZES, physics=name, rows=(50, 100, 300), reported=False)
        for name in PHYSICS
    },
    **{
        f"none, {name}": CellSpec(100, noise=kind, reported=False)
        for name, kind in (("Student t3", "t3"), ("quantized", "quantized"), ("random walk", WALK))
    },
    **{f"none, {kind}, m=100": CellSpec(100, noise=kind, reported=False) for kind in ("serial", "reach", "outliers")},
    "three reads, none": CellSpec(60, noise="posture", reads=3, reported=False),
    "three reads, six to nine effects": CellSpec(
        60, sizes=(15.0, 60.0), noise="posture", reads=3, many="several", reported=False
    ),
}
SAME_ARM = 10  # consecutive sets with one arm and plan where plans are designed, which takes time


def truth_of(spec: CellSpec, rng: np.random.Generator) -> TrueArm:
    if spec.limits != "paper":
        return random_truth(rng, int(rng.integers(spec.links[0], spec.links[1] + 1)), spec.limits)
    truth = random_truth(rng, 4)
    return replace(
        truth,
        lengths=np.array([260.0, 180.0, 120.0, 100.0]),
        masses=np.array([12.0, 8.0, 5.0, 3.0]),
        payload=10.0,
        sigma=0.1,
    )


def hidden(spec: CellSpec, truth: TrueArm, run: RowConditions, rng: np.random.Generator) -> list[Drawn]:
    """The effects of a data set."""
    if spec.sizes and spec.many:
        return many_effects(truth, run, spec.many, spec.sizes, rng)
    if spec.sizes:
        return [physics_effect(truth, run, spec.physics, log_uniform(spec.sizes, rng), rng)]
    effects: list[Drawn] = []
    while spec.lam is not None and len(effects) < spec.effects:
        if spec.outside:
            effects.append(outside_effect(truth, run, spec.lam, rng))
            continue
        if spec.order:
            effects.append(wave(truth, run, spec.order, spec.lam, rng))
            continue
        new = random_effect(truth, run, spec.lam, rng, spec.rare or None)
        if (spec.families or new[0] != "joint_compliance" or new[1]) and family(new) not in map(family, effects):
            effects.append(new)
    return effects


def arm_of(spec: CellSpec, truth: TrueArm, rng: np.random.Generator) -> Arm:
    """The arm as its maker describes it."""
    masses = truth.masses * rng.uniform(0.7, 1.3, truth.n) if spec.wrong_masses else truth.masses
    gravity = Gravity(np.array([0.0, -G]), masses, truth.center, truth.payload)
    known = tuple(EffectSpec(e[0], e[1], {f"c{j}": c for j, c in enumerate(e[2]["c"], 1)}) for e in truth.known)
    return Arm(truth.lengths, truth.lower, truth.upper, truth.sigma, gravity=gravity, effects=known)


def to_be_planned(cell: str, seed: int) -> tuple[Arm, int] | None:
    """Arm and number of postures of a cell whose plan is designed; None where the postures are random."""
    spec = CELLS[cell]
    if not spec.designed:
        return None
    truth = shared_truth(cell, seed)
    return arm_of(spec, truth, np.random.default_rng(0)), max(spec.m, truth.n + 4)


def shared_truth(cell: str, seed: int) -> TrueArm:
    """The arm of SAME_ARM consecutive sets."""
    rng = np.random.default_rng([20261122, list(CELLS).index(cell), seed // SAME_ARM])
    return truth_of(CELLS[cell], rng)


def true_values(truth: TrueArm) -> dict[str, float]:
    """Parameter name -> true value, named as the library names its parameters [API units]."""
    pairs = zip(truth.length_errors, truth.joint_offsets, strict=True)
    base = [(j + 1, float(length), float(offset)) for j, (length, offset) in enumerate(pairs)]
    values = {f"length_error:{j}": length for j, length, _ in base}
    values |= {f"joint_offset:{j}": offset for j, _, offset in base}
    for effect in truth.effects:
        for name, value in parameters_of(effect).items():
            values[f"{key(effect)}.{name}"] = value
    return values


def data_set(cell: str, seed: int, planned: np.ndarray | None = None) -> DataSet:
    """Data set number `seed` of a cell; 200 fresh postures of the same session are held out.

    planned : (m, n) the postures for the arm of `to_be_planned`
    """
    spec = CELLS[cell]
    rng = np.random.default_rng([20261121, list(CELLS).index(cell), seed])
    truth, postures = (shared_truth(cell, seed), planned) if spec.designed else _undesigned(spec, rng)
    assert postures is not None
    run = session(truth, postures, rng)
    if (
        spec.rare in LOADS or spec.physics == "payload_swap"
    ):  # they only show through compliance that the arm's model has
        truth = replace(truth, known=[("joint_compliance", None, {"c": 1e-5 * rng.uniform(0.5, 1.5, truth.n)})])
    truth = replace(truth, effects=hidden(spec, truth, run, rng))
    fresh = session(truth, rng.uniform(truth.lower, truth.upper, (200, truth.n)), rng)
    arm = arm_of(spec, truth, rng)
    named = [by_library_name(e) for e in truth.effects]
    outside = [e for e in named if e[0] in OUTSIDE + PHYSICS]
    inside = [e for e in named if e[0] not in OUTSIDE + PHYSICS]
    error = noise(truth, run, rng, spec.noise)
    data = recorded(truth, run, error)
    if spec.reads > 1:
        data = replace(data, repeats=np.arange(len(data)) // spec.reads)
    wrong = np.flatnonzero(np.abs(error) > 10.0 * truth.sigma) + 1 if spec.noise == "outliers" else ()

    def more(q: np.ndarray, payload: np.ndarray | None, directions: np.ndarray | None, number: int) -> Measurements:
        later = np.random.default_rng([20261123, list(CELLS).index(cell), seed, number])
        return measure_more(truth, run, data, q, payload, directions, later)

    judged = bool(spec.many or outside or spec.reads > 1)
    errors = np.column_stack([error.real, error.imag])
    return DataSet(
        arm,
        data,
        measure(truth, fresh, rng, "posture" if spec.reads > 1 else "white") if spec.hides or spec.reads > 1 else None,
        tuple(key(e) for e in inside),
        outside[0][0] if outside else WALK if spec.noise == WALK else None,
        place_of(outside[0]) if outside else "time" if spec.noise == WALK else None,
        tuple(EffectSpec(e[0], e[1], settings_of(e)) for e in inside),
        tuple(map(int, wrong)),
        {} if spec.wrong_masses or spec.rare or spec.outside or outside else true_values(truth),
        more,
        exact(truth, fresh) if judged else None,
        reachable(fitted_columns(truth, run), fitted_columns(truth, fresh), errors) if judged else None,
    )


def reachable(known: Array, wanted: Array, error: Array) -> float:
    """RMS distance [mm] at fresh postures that these errors (m, d) of the readings leave after a fit by least squares,
    to first order.

    known, wanted : (m d, p) and (k d, p) columns of all that is fitted, at the postures measured and at fresh ones
    """
    scale = np.linalg.norm(known, axis=0)
    moved = (wanted / scale) @ np.linalg.lstsq(known / scale, error.ravel(), rcond=1e-10)[0]
    return float(np.sqrt(error.shape[1] * np.mean(moved**2)))


def fitted_columns(truth: TrueArm, run: RowConditions) -> Array:
    """(2m, p) of the base and of an amplitude of each hidden effect."""
    return np.column_stack([base_jacobian(truth, run), *(column(truth, run, effect) for effect in truth.effects)])


def _undesigned(spec: CellSpec, rng: np.random.Generator) -> tuple[TrueArm, np.ndarray]:
    """An arm, and random postures (m, n) of it."""
    truth = truth_of(spec, rng)
    count = int(rng.choice(spec.rows)) if spec.rows else max(spec.m, truth.n + 4)
    return truth, np.repeat(rng.uniform(truth.lower, truth.upper, (count, truth.n)), spec.reads, axis=0)


def exact(truth: TrueArm, run: RowConditions) -> Array:
    """(m, 2) positions without noise [mm]."""
    p = position(truth, run)
    return np.column_stack([p.real, p.imag])
