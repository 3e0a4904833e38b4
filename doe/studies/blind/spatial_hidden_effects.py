"""Hidden effects of arms in space, drawn at random with a given size lambda. Plain numpy, no model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from doe.studies.blind.hidden_effects import COUNTS, at_random, directions_of, key, log_uniform, off, scaled_amplitudes
from doe.studies.blind.rare_effects import PHYSICS_JOINT, PHYSICS_WHOLE, drawn_physics
from doe.studies.blind.simulator import Drawn, RowConditions
from doe.studies.blind.spatial_simulator import OF_GRAVITY, SpatialTruth, base_jacobian, position

SEEN = 0.02  # of an effect's length that must be left beside the geometry, as in the plane
ALL_JOINTS = "joint_compliance*"
OF_JOINT = (
    *("joint_compliance", "gravity_backlash", "bearing_compliance", "encoder_eccentricity", "encoder_second_harmonic"),
    *("transmission_ripple", "gear_ratio", "joint_coupling", "backlash"),
)
OF_ARM = (ALL_JOINTS, "thermal_growth", "base_drift", "base_rotation_drift")
OUTSIDE = ("bump", "cubic", "cable_pull", "axis_wobble")  # not in the library
PHYSICS = (*PHYSICS_JOINT, "two_warm_ups", "warm_offset")  # not either
PAIRS = ("encoder_eccentricity", "encoder_second_harmonic", "axis_runout")


def directions(name: str, rng: np.random.Generator, joint: int | None = None) -> dict:
    """A random direction in an effect's parameter space; scaled afterwards."""
    if name in ("base_drift", "base_rotation_drift", "warm_offset"):
        direction = rng.normal(0.0, 1.0, 3)
        return {"w" if name == "base_rotation_drift" else "v": direction / np.linalg.norm(direction)}
    if name in PHYSICS:
        return drawn_physics(name, joint, 6, 1.0, rng)
    return {"c": 1.0} if name in ("bearing_compliance", "axis_wobble") else directions_of(name, 6, rng)


def column(truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None, effect: Drawn) -> np.ndarray:
    """(3m,) derivative of the position with respect to the amplitude of an effect."""
    name, joint, values = effect
    up, down = (replace(truth, effects=[(name, joint, scaled_amplitudes(values, step))]) for step in (1e-6, -1e-6))
    return (position(up, run, marker) - position(down, run, marker)).ravel() / 2e-6


def sized(
    truth: SpatialTruth, run: RowConditions, marker: np.ndarray | None, effect: Drawn, lam: float, span: np.ndarray
) -> Drawn | None:
    """The effect so large that off the columns (3m, C) of a span it is lambda sigma long; None where it is unseen."""
    length = column(truth, run, marker, effect)
    seen = np.linalg.norm(off(span, length))
    if seen <= SEEN * np.linalg.norm(length) or not seen:
        return None
    return effect[0], effect[1], scaled_amplitudes(effect[2], float(lam * truth.sigma / seen))


def drawn_at_random(
    names: Sequence[str],
    truth: SpatialTruth,
    run: RowConditions,
    marker: np.ndarray | None,
    lam: float,
    rng: np.random.Generator,
    *,
    order: float = 0.0,
    span: np.ndarray | None = None,
) -> Drawn:
    """One effect, its type at random, then its joint, so large that off the geometry it is lambda sigma long.

    order : periods per turn of a ripple, 0: at random;  span : to be off instead of the geometry, (3m, C)
    """
    own = base_jacobian(truth, run, marker) if span is None else span
    while True:
        pick = str(rng.choice(names))
        first, last = 2 if pick == "joint_coupling" else 1, truth.n - (pick == "two_joint_cable")
        joint = None if pick in (*OF_ARM, *PHYSICS_WHOLE) else int(rng.integers(first, last + 1))
        effect = pick.rstrip("*"), joint, directions(pick, rng, joint) | ({"k": order} if order else {})
        if (found := sized(truth, run, marker, effect, lam, own)) is not None:
            return found


def several_effects(
    count: int, truth: SpatialTruth, run: RowConditions, lam: float, rng: np.random.Generator
) -> list[Drawn]:
    """Effects of the library of different families, each of size lambda, without a thought of the others."""
    found: list[Drawn] = []
    while len(found) < count:
        new = drawn_at_random(OF_JOINT + OF_ARM, truth, run, None, lam, rng)
        if family(new) not in map(family, found):
            found.append(new)
    return found


def family(effect: Drawn) -> str:
    """What effects are said to be alike."""
    return "gravity" if effect[0] in OF_GRAVITY else effect[0]


def many_effects(
    truth: SpatialTruth, run: RowConditions, kind: str, sizes: tuple[float, float], rng: np.random.Generator
) -> list[Drawn]:
    """What a real robot has at once, each effect of its own size lambda between two.

    kind : `robot`: compliance of all joints, every encoder eccentric, backlash in one joint and a ripple in one; one of
        `COUNTS`, as in the plane
    """
    listed: list[tuple[str, int | None]] = [("encoder_eccentricity", j + 1) for j in range(truth.n)]
    most = len(OF_JOINT) * truth.n
    if kind in COUNTS:
        listed = at_random(OF_JOINT, OF_ARM, truth.n, kind == "small", rng)
        most = int(rng.integers(COUNTS[kind][0], COUNTS[kind][1] + 1))
    else:
        listed.append((ALL_JOINTS, None))
        listed += [(name, int(rng.integers(1, truth.n + 1))) for name in ("backlash", "transmission_ripple")]
    span = base_jacobian(truth, run)
    drawn = (
        sized(truth, run, None, (name.rstrip("*"), joint, directions(name, rng)), log_uniform(sizes, rng), span)
        for name, joint in listed
    )
    return list(islice((effect for effect in drawn if effect is not None), most))


def outside_effect(
    truth: SpatialTruth, run: RowConditions, lam: float, rng: np.random.Generator, names: Sequence[str] = OUTSIDE
) -> Drawn:
    """An effect that the library does not have, of size lambda outside the span of the library."""
    return drawn_at_random(names, truth, run, None, lam, rng, span=library_span(truth, run))


def library_span(truth: SpatialTruth, run: RowConditions) -> np.ndarray:
    """(3m, C) of the geometry and of every effect drawn here or in `PAIRS`, ripples left out."""
    names = [name for name in OF_JOINT + OF_ARM if name not in (*PAIRS, "transmission_ripple", ALL_JOINTS)]
    probes: list[tuple[str, dict]] = [(name, {a: 1.0, b: 0.0}) for name in PAIRS for a, b in ("ab", "ba")]
    for name in names:
        short = {"base_drift": "v", "base_rotation_drift": "w"}.get(name)
        values = [{short: axis} for axis in np.eye(3)] if short else [directions(name, np.random.default_rng(0))]
        probes += [(name, value) for value in values]
    joints = [(name, j, v) for name, v in probes if name not in OF_ARM for j in range(1, truth.n + 1)]
    effects = joints + [(name, None, v) for name, v in probes if name in OF_ARM]
    return np.column_stack([base_jacobian(truth, run), *(column(truth, run, None, effect) for effect in effects)])


def loaded(truth: SpatialTruth, run: RowConditions, lam: float, rng: np.random.Generator) -> list[Drawn]:
    """Compliance in all joints, such that the payload's place adds lambda sigma off the compliance that would fit best
    without it; and that place."""
    c = rng.uniform(0.5, 1.5, truth.n)
    effects = [("joint_compliance", j, {"c": float(one)}) for j, one in enumerate(c, start=1)]
    there = np.stack([column(truth, run, None, effect) for effect in effects], axis=1)
    here = np.stack([column(replace(truth, load=None), run, None, effect) for effect in effects], axis=1)
    unseen = np.column_stack([base_jacobian(truth, run), here])
    assert truth.load is not None
    size = lam * truth.sigma / np.linalg.norm(off(unseen, np.sum(there - here, axis=1)))
    place = dict(zip("xyz", (truth.load - truth.tools[0]).tolist(), strict=True))
    return [("joint_compliance", None, {"c": size * c}), ("payload_place", None, place)]


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
