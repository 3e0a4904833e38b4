"""The cells of the blind study, in the plane and in space, and how each of their data sets is drawn. No model."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from doe.studies.blind import hidden_effects as drawn
from doe.studies.blind import simulator
from doe.studies.blind.hidden_effects import LIBRARY_JOINT, LIBRARY_WHOLE, SPACE_JOINT, SPACE_WHOLE
from doe.studies.blind.simulator import (
    Drawn,
    RowConditions,
    TrueArm,
    base_jacobian,
    column,
    noise,
    session,
    shift,
    turn,
)
from identification import Arm, Array, DHRow, EffectSpec, Gravity, Measurements, chain_of, planar_chain


@dataclass(frozen=True)
class DataSet:
    """Arm and measurements as a user has them, and what is hidden in them.

    effects : keys of the hidden effects that the library has
    outside : name of what is hidden and not in the library;  place : where it sits, alternatives between ` or `; None:
        no place is right
    specs : the hidden effects as an arm file has them, to fit the true model
    wrong_rows : outliers, counted from 1
    values : parameter name -> true value of hidden effects and, in the plane, of the base [API units], to judge
        intervals; empty where the arm's maker is wrong about it or the library has no such effect
    exact : (200, d) hold-out without noise [mm], where many effects are hidden or one outside the library
    reachable : RMS distance [mm] from `exact` that a model with what is hidden would have, fitted to these data
    further : (postures, payload or None, directions or None, number) -> the data with further measurements at their end
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
    further: Callable[[Array, Array | None, Array | None, int], Measurements] | None = None
    exact: Array | None = None
    reachable: float | None = None


@dataclass(frozen=True)
class CellSpec:
    """What is drawn in a cell of the study; of the cells in cells.toml.

    m : rows;  rows : one of them is the number of rows instead
    lam : size of the hidden effects, None: nothing is hidden;  sizes : each lambda is drawn between these instead
    effects : how many are hidden, of different families;  families : compliance in all joints at once among them
    rare, outside, physics, gravity : the hidden effect is that rare one, one that the library does not have, that one
        of `PHYSICS`, one of gravity;  order : a gear ripple of so many periods per turn;  many : see `many_effects`
    noise : see `noise`;  limits : full, some (narrow joints), paper (the paper's 4-link arm);  links : least and most
    wrong : what the arm file is wrong about: `masses` of the links (by up to 30 %), the mass of the `tool` (missing, a
        parameter), how the base leans (1 to 3 degrees, `tilt`), the `place` of the payload (see `loaded`)
    reflectors : measured points, taking turns;  reads : of each posture, one after another, with an error they share
    designed : postures of somebody's plan instead of random ones, the same for SAME_ARM sets
    reported : in the full study; the others can be asked for by name
    """

    m: int
    lam: float | None = None
    sizes: Sequence[float] = ()
    space: bool = False
    effects: int = 1
    noise: str = "white"
    limits: str = "full"
    outside: bool = False
    wrong: str = ""
    gravity: bool = False
    reported: bool = True
    families: bool = True
    rare: str = ""
    order: float = 0.0
    many: str = ""
    rows: Sequence[int] = ()
    links: Sequence[int] = (2, 6)
    physics: str = ""
    reads: int = 1
    reflectors: int = 1
    designed: bool = False

    @property
    def hides(self) -> bool:
        """Whether there is a hidden effect."""
        return self.lam is not None or bool(self.sizes)


WALK = "walk"  # the noise that may be reported as a drift in time
FRESH = 200  # rows of the hold-out
SAME_ARM = 10  # consecutive sets with one arm and plan where plans are designed, which takes time
TABLE = tomllib.loads(Path(__file__).with_name("cells.toml").read_text())
PLANE = {name: CellSpec(**spec) for name, spec in TABLE["plane"].items()}
CELLS = PLANE | {f"space, {name}": CellSpec(**spec, space=True) for name, spec in TABLE["space"].items()}


# -- arms --------------------------------------------------------------------------------------------------------------
def random_truth(rng: np.random.Generator, n: int | None = None, limits: str = "full") -> TrueArm:
    """A planar arm of n links (None: 2 to 6), its lengths 1 mm and its encoders 8 mrad off."""
    n = int(rng.integers(2, 7)) if n is None else n
    lengths = np.round(rng.uniform(80.0, 400.0, n))
    span, middle = np.full(n, 2 * np.pi), np.zeros(n)
    if limits == "some":
        span = np.concatenate([[2 * np.pi], rng.uniform(np.radians(120), np.radians(300), n - 1)])
        middle = rng.uniform(-0.5, 0.5, n)
    masses, payload = lengths / 100.0 * rng.uniform(1.0, 5.0, n), float(rng.uniform(1.0, 12.0))
    sigma = float(rng.choice([0.02, 0.05, 0.1, 0.2]))
    if limits == "paper":
        lengths, masses, payload, sigma = (
            np.array([260.0, 180.0, 120.0, 100.0]),
            np.array([12.0, 8.0, 5.0, 3.0]),
            10.0,
            0.1,
        )
    errors = rng.normal(0.0, 1.0, n), rng.normal(0.0, 0.008, n)
    reach = {"lower": middle - span / 2, "upper": middle + span / 2}
    return TrueArm.planar(lengths, *errors, masses=masses, payload=payload, sigma=sigma, **reach)


def random_six_axes(rng: np.random.Generator) -> TrueArm:
    """A six-axis arm of one of two common builds, its axes 2 mrad and 0.5 mm off, its encoders 5 mrad."""
    half, lengths = np.pi / 2.0, np.round(rng.uniform([150, 300, 250, 80, 80, 60], [500, 700, 600, 200, 130, 120]))
    rise, upper, fore, *wrist = lengths.tolist()
    if rng.random() < 0.5:  # three parallel axes and an offset wrist
        rows = [(0.0, half, rise), (-upper, 0.0, 0.0), (-fore, 0.0, 0.0), (0.0, half, wrist[0])]
        rows += [(0.0, -half, wrist[1]), (0.0, 0.0, wrist[2])]
    else:  # a wrist whose axes meet
        rows = [(wrist[0], -half, rise), (upper, 0.0, 0.0), (wrist[1], -half, 0.0), (0.0, half, fore)]
        rows += [(0.0, -half, 0.0), (0.0, 0.0, wrist[2])]
    table = np.array(rows)
    span = rng.uniform(1.5, 2.9, 6)
    aside = rng.uniform(30.0, 80.0, (2, 2)) * rng.choice([-1.0, 1.0], (2, 2))
    tools = np.column_stack([aside, rng.uniform(40, 100, 2)])
    base = shift(rng.uniform(-1500.0, 1500.0, 3))
    base[:3, :3] = turn(rng.normal(0.0, 1.0, 3))
    masses = 1.0 + np.hypot(table[:, 0], table[:, 2]) / 100.0 * rng.uniform(1.0, 4.0, 6)
    loads = {"masses": masses, "payload": float(rng.uniform(2.0, 10.0)), "sigma": float(rng.choice([0.02, 0.05, 0.1]))}
    offsets = rng.normal(0.0, 5e-3, 6)
    place = {"base": base, "tools": tools, "lower": -span, "upper": span}
    return TrueArm.built(table, rng, 2e-3, 0.5, offsets=offsets, **place, **loads)


def truth_of(spec: CellSpec, rng: np.random.Generator) -> TrueArm:
    """The arm of a data set."""
    if not spec.space:
        n = 4 if spec.limits == "paper" else int(rng.integers(spec.links[0], spec.links[1] + 1))
        return random_truth(rng, n, spec.limits)
    truth = random_six_axes(rng)
    truth = replace(truth, tools=truth.tools[: spec.reflectors])
    if spec.wrong == "tilt":
        return leaning(truth, rng)
    if spec.wrong == "place":  # 5 to 20 kg hang 150 to 300 mm beside the measured point
        phase = rng.uniform(0.0, 2.0 * np.pi)
        away = rng.uniform(150.0, 300.0) * np.array([np.cos(phase), np.sin(phase), rng.uniform(-0.3, 0.6)])
        return replace(truth, payload=float(rng.uniform(5.0, 20.0)), load=truth.tools[0] + away)
    return truth


def leaning(truth: TrueArm, rng: np.random.Generator) -> TrueArm:
    """The arm on a base that leans by 1 to 3 degrees."""
    angle, phase = np.radians(rng.uniform(1.0, 3.0)), rng.uniform(0.0, 2.0 * np.pi)
    return replace(truth, gravity=turn(angle * np.array([np.cos(phase), np.sin(phase), 0.0])) @ truth.gravity)


def arm_of(spec: CellSpec, truth: TrueArm, rng: np.random.Generator) -> Arm:
    """The arm as its maker describes it, who in space does not know where base and reflectors are."""
    masses = truth.masses * (rng.uniform(0.7, 1.3, truth.n) if spec.wrong == "masses" else 1.0)
    payload = 0.0 if spec.wrong == "tool" else truth.payload
    down = -simulator.G * np.eye(truth.dimension)[-1]
    gravity = Gravity(down, masses, np.full(truth.n, truth.center), payload)
    effects = tuple(EffectSpec(e[0], e[1], {f"c{j}": c for j, c in enumerate(e[2]["c"], 1)}) for e in truth.modelled)
    if truth.in_plane:
        return Arm(planar_chain(truth.lengths), truth.lower, truth.upper, truth.sigma, gravity=gravity, effects=effects)
    limits = zip(truth.lower.tolist(), truth.upper.tolist(), strict=True)
    rows = [DHRow(a, alpha, d, limits=pair) for (a, alpha, d), pair in zip(truth.table.tolist(), limits, strict=True)]
    chain = replace(chain_of(rows), tools={str(k + 1): np.zeros(3) for k in range(len(truth.tools))})
    effects += (EffectSpec("tool_mass"),) if spec.wrong == "tool" else ()
    return Arm(chain, sigma=truth.sigma, gravity=gravity, effects=effects)


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


# -- data sets ---------------------------------------------------------------------------------------------------------
def generator_of(cell: str, seed: int) -> np.random.Generator:
    """Of data set number `seed` of a cell."""
    number = list(CELLS).index(cell)
    return np.random.default_rng(
        [20261125, number - len(PLANE), seed] if CELLS[cell].space else [20261121, number, seed]
    )


def hidden(spec: CellSpec, truth: TrueArm, run: RowConditions, rng: np.random.Generator) -> list[Drawn]:
    """The effects of a data set."""
    if spec.sizes and spec.many:
        return drawn.many_effects(truth, run, spec.many, spec.sizes, rng)
    if spec.sizes:
        return [drawn.physics_effect(truth, run, spec.physics, drawn.log_uniform(spec.sizes, rng), rng)]
    if spec.lam is None:
        return []
    if spec.wrong == "place":
        return drawn.loaded(truth, run, spec.lam, rng)
    names: tuple[str, ...] = SPACE_JOINT + SPACE_WHOLE if spec.space else LIBRARY_JOINT + LIBRARY_WHOLE
    span, settings = base_jacobian(truth, run), {"k": spec.order} if spec.order else {}
    if spec.outside:
        names, span = drawn.SPACE_OUTSIDE if spec.space else drawn.OUTSIDE, drawn.library_columns(truth, run)
    elif spec.rare or spec.order:
        names = (spec.rare or "transmission_ripple",)
    elif spec.gravity:
        names = (*(name for name in simulator.OF_GRAVITY if name in SPACE_JOINT), drawn.EVERY_JOINT)
    effects: list[Drawn] = []
    while len(effects) < spec.effects:
        new = drawn.random_effect(names, truth, run, spec.lam, rng, span, **settings)
        if (spec.families or new[0] != "joint_compliance" or new[1]) and drawn.family(new) not in map(
            drawn.family, effects
        ):
            effects.append(new)
    return effects


def values_of(truth: TrueArm) -> dict[str, float]:
    """Parameter name -> true value, named as the library names its parameters [API units]; in space without those of
    the geometry, which others say differently."""
    values: dict[str, float] = {}
    if truth.in_plane:
        errors = zip(truth.links[:, 0] - truth.lengths, truth.offsets, strict=True)
        for j, (length, offset) in enumerate(errors, start=1):
            values |= {f"length_error:{j}": float(length), f"joint_offset:{j}": float(offset)}
    for effect in truth.effects:
        for name, value in ((name, value) for name, value in effect[2].items() if name not in simulator.SHAPES):
            ends = [""] if np.ndim(value) == 0 else "xyz" if name in "vw" else range(1, len(value) + 1)
            parts = zip(ends, np.atleast_1d(value), strict=False)
            values |= {f"{drawn.key(effect)}.{name}{end}": float(part) for end, part in parts}
    return values


def data_set(cell: str, seed: int, planned: Array | None = None) -> DataSet:
    """Data set number `seed` of a cell; `FRESH` rows of the same session are held out.

    planned : (m, n) the postures for the arm of `to_be_planned`
    """
    spec, rng = CELLS[cell], generator_of(cell, seed)
    truth = shared_truth(cell, seed) if spec.designed else truth_of(spec, rng)

    def measured_at(postures: Array, times: int) -> RowConditions:
        """Each posture is measured at every reflector, and as often as it is read, before the arm goes on."""
        rows = np.repeat(postures, times * spec.reflectors, axis=0)
        return session(truth, rows, rng, spec.reflectors)

    def random(count: int, times: int) -> RowConditions:
        return measured_at(rng.uniform(truth.lower, truth.upper, (count // times // spec.reflectors, truth.n)), times)

    if spec.designed:
        assert planned is not None
        run = measured_at(planned, 1)
    else:
        run = random(int(rng.choice(spec.rows)) if spec.rows else max(spec.m, truth.n + 4), spec.reads)
    if (
        spec.rare in drawn.LOADS or spec.physics == "payload_swap"
    ):  # they only show through compliance that the arm's model has
        truth = replace(truth, modelled=[("joint_compliance", None, {"c": 1e-5 * rng.uniform(0.5, 1.5, truth.n)})])
    if spec.space:  # in this order since the study began
        fresh, arm = random(FRESH, 1), arm_of(spec, truth, rng)
        truth = replace(truth, effects=hidden(spec, truth, run, rng))
    else:
        truth = replace(truth, effects=hidden(spec, truth, run, rng))
        fresh, arm = random(FRESH, 1), arm_of(spec, truth, rng)
    outside = [e for e in truth.effects if e[0] in drawn.NOT_INSIDE]
    inside = [e for e in truth.effects if e[0] not in drawn.NOT_INSIDE]
    error = noise(truth, run, rng, spec.noise)
    data = simulator.recorded(truth, run, error)
    held_out = noise(truth, fresh, rng, "posture" if spec.reads > 1 else "white")
    if spec.reads > 1:
        data = replace(data, repeats=np.arange(len(data)) // spec.reads)
    far = np.linalg.norm(error, axis=1) > 10.0 * truth.sigma if spec.noise == "outliers" else np.zeros(len(error))

    def further(q: Array, payload: Array | None, directions: Array | None, number: int) -> Measurements:
        later = np.random.default_rng([20261123, list(CELLS).index(cell), seed, number])
        return simulator.measure_more(truth, run, data, q, payload, directions, later)

    judged = bool(spec.many or outside or spec.reads > 1)
    return DataSet(
        arm,
        data,
        simulator.recorded(truth, fresh, held_out) if spec.hides or spec.reads > 1 else None,
        tuple(drawn.key(e) for e in inside),
        outside[0][0] if outside else WALK if spec.noise == WALK else None,
        drawn.place_of(outside[0]) if outside else "time" if spec.noise == WALK else None,
        tuple(EffectSpec(e[0], e[1], drawn.settings_of(e)) for e in inside),
        tuple((np.flatnonzero(far) + 1).tolist()),
        {} if spec.wrong or spec.rare or spec.outside or outside else values_of(truth),
        further,
        simulator.position(truth, fresh) if judged else None,
        reachable(fitted_columns(truth, run), fitted_columns(truth, fresh), error) if judged else None,
    )


def reachable(columns: Array, wanted: Array, error: Array) -> float:
    """RMS distance [mm] at fresh postures that these errors (m, d) of the readings leave after a fit by least squares,
    to first order.

    columns, wanted : (m d, p) and (k d, p) of all that is fitted, at the postures measured and at fresh ones
    """
    scale = np.linalg.norm(columns, axis=0)
    moved = (wanted / scale) @ np.linalg.lstsq(columns / scale, error.ravel(), rcond=1e-10)[0]
    return float(np.sqrt(error.shape[1] * np.mean(moved**2)))


def fitted_columns(truth: TrueArm, run: RowConditions) -> Array:
    """(m d, p) of the geometry and of an amplitude of each hidden effect."""
    return np.column_stack([base_jacobian(truth, run), *(column(truth, run, effect) for effect in truth.effects)])
