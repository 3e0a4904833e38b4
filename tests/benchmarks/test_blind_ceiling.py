"""How well could anybody name the hidden effects of the blind study? The Bayes classifier that knows the simulator.

    .venv/bin/pytest -m benchmark -s tests/benchmarks/test_blind_ceiling.py

It knows what no user knows: sigma, the size lambda of each effect, the distributions from which the simulator drew
phases, orders and stiffnesses, and how many effects there are. With the most probable name it is right more often than
any other rule can be (on average over the simulator's draws), so its shares are the ceiling for `armcal study blind`,
whose very data it is given, noise included: set by set the two can be compared.

For effects with unit columns u_s off the base Jacobian, s drawn as the simulator draws them, the likelihood of the
whitened residual r against no effect is mean_s exp(r . x_s - |x_s|^2 / 2), x_s = lambda u_s, or for two effects the sum
of two such columns.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, product

import numpy as np
import pytest

from doe.discrimination.design import discrimination_design
from doe.problem.problem import DesignProblem
from doe.studies.blind import cells, simulator
from doe.studies.blind.simulator import TrueArm, column
from identification.effects.formulas import RARE
from identification.gap.search import log_odds_of_count
from identification.model import Model

COUNT = 400
PHASES = np.arange(24) * 2.0 * np.pi / 24
CIRCLE = np.vstack([np.cos(PHASES), np.sin(PHASES)])
STIFFNESSES = 200
SIZES = 4.0 * 1.5 ** np.arange(6)  # 4 to 30, evenly on a logarithmic scale: what a user knows of the size of an effect
FAR = 25.0
PAIRS = {"encoder_eccentricity": "ab", "encoder_second_harmonic": "ab", "axes_skew": "ab", "transmission_ripple": "ab"}
SAGGING = ("joint_compliance", "gravity_backlash", "link_bending")  # of one sign only
NAMES = cells.LIBRARY_JOINT + cells.LIBRARY_WHOLE
ONE = {"payload_error": {"d": 1.0}, "gravity_tilt": {"angle": 1.0}}  # wrong loads, of one parameter
CELLS = [
    "one, lambda 6, m=50",
    "one, lambda 6, m=200",
    "one, lambda 6, discriminating plan",
    "one, lambda 8, m=50",
    "one, lambda 8, m=20",
    "one, lambda 8, discriminating plan",
    "two, lambda 8",
]


@dataclass(frozen=True, eq=False)  # each is its own key
class Possible:
    """One effect that might be hidden: key, class, log prior, (2m, S) sampled unit columns off the base Jacobian."""

    key: str
    family: str
    prior: float
    columns: np.ndarray


def log_mean(x: np.ndarray) -> float:
    return float(x.max() + np.log(np.mean(np.exp(x - x.max()))))


def directions(bare: TrueArm, run: simulator.RowConditions, name: str, j: int | None) -> Iterator[np.ndarray]:
    """(2m, S) sampled columns of an effect, one array per order of a ripple."""

    def probe(values: dict) -> np.ndarray:
        return column(bare, run, (name.rstrip("*"), j, values))

    if name in ONE:
        one = column(bare, run, (name, None, ONE[name]))[:, None]
        yield np.hstack([one, -one])
    elif name in PAIRS:
        for k in range(3, 65) if name == "transmission_ripple" else [None]:
            order = {} if k is None else {"k": k}
            both = [probe({c: float(c == one) for c in PAIRS[name]} | order) for one in PAIRS[name]]
            yield np.column_stack(both) @ CIRCLE
    elif name in ("base_offset", "base_drift"):
        yield cells.probed(bare, run, name, None) @ CIRCLE
    elif name == "joint_compliance*":
        each = [column(bare, run, ("joint_compliance", i + 1, {"c": 1.0})) for i in range(bare.n)]
        yield np.column_stack(each) @ np.random.default_rng(1).uniform(0.5, 1.5, (bare.n, STIFFNESSES))
    else:
        one = probe(cells.directions(bare, name, j, np.random.default_rng(0)))[:, None]
        yield one if name in SAGGING else np.hstack([one, -one])


@cache
def planned(cell: str, seed: int) -> np.ndarray | None:
    """The plan that the sets of a block share; None where postures are random."""
    if not cells.CELLS[cell].designed:
        return None
    arm, runs = cells.to_be_planned(cell, seed)
    return discrimination_design(DesignProblem.of(Model(arm)), arm, runs).design.plan.postures


def drawn(cell: str, seed: int) -> tuple[np.ndarray, list[Possible], float, TrueArm]:
    """Whitened residual off the base model (2m,), what might be hidden, lambda and the truth of one data set."""
    spec = cells.CELLS[cell]
    assert spec.lam is not None
    rng = cells.generator_of(cell, seed)
    plan = postures = planned(cell, seed // cells.SAME_ARM * cells.SAME_ARM)
    truth = cells.truth_of(spec, rng) if plan is None else cells.shared_truth(cell, seed)
    if postures is None:
        postures = rng.uniform(truth.lower, truth.upper, (max(spec.m, truth.n + 4), truth.n))
    run = simulator.session(truth, postures, rng)
    if spec.rare:
        truth = replace(truth, modelled=[("joint_compliance", None, {"c": 1e-5 * rng.uniform(0.5, 1.5, truth.n)})])
    truth = replace(truth, effects=cells.hidden(spec, truth, run, rng))
    bare = replace(truth, effects=[])
    measured = cells.data_set(cell, seed, plan).measurements.positions  # the same noise
    miss = (measured - simulator.position(bare, run)) / truth.sigma
    basis = np.linalg.qr(simulator.base_jacobian(truth, run))[0]

    def off(columns: np.ndarray) -> np.ndarray:
        return columns - basis @ (basis.T @ columns)

    found = []
    for name in (*NAMES, *(ONE if spec.rare else ())):
        whole = name in (*cells.LIBRARY_WHOLE, *ONE)
        joints = [None] if whole else list(range(2 if name == "joint_coupling" else 1, truth.n + 1))
        for j in joints:
            columns = np.hstack([_unit(part, off) for part in directions(bare, run, name, j)])
            effect = (name.rstrip("*"), j, {})
            prior = -np.log(len(NAMES)) - np.log(len(joints))
            if columns.shape[1]:
                found.append(Possible(cells.key(effect), cells.family(effect), float(prior), columns))
    return off(miss.ravel()), found, spec.lam, truth


def _unit(columns: np.ndarray, off: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    seen = off(columns)
    norms = np.linalg.norm(seen, axis=0)
    keep = norms >= 0.02 * np.linalg.norm(columns, axis=0)  # the simulator draws again what cannot be seen
    return seen[:, keep] / norms[keep]


def posterior(cell: str, seed: int) -> tuple[dict[tuple[Possible, ...], float], TrueArm]:
    """Set of effects -> log posterior (up to a constant) for one data set, and the truth."""
    residual, possible, lam, truth = drawn(cell, seed)
    return among(residual, possible, lam, len(truth.effects)), truth


def among(residual: np.ndarray, possible: list[Possible], lam: float, count: int) -> dict[tuple[Possible, ...], float]:
    """Set of one or two effects of the size `lam` -> log posterior, against no effect."""
    scores = [lam * (residual @ one.columns) - lam**2 / 2.0 for one in possible]
    if count == 1:
        return {(one,): log_mean(s) + one.prior for one, s in zip(possible, scores, strict=True)}
    share = {
        one.family: sum(np.exp(other.prior) for other in possible if other.family == one.family) for one in possible
    }
    found: dict[tuple[Possible, ...], float] = {}
    for (a, one), (b, two) in combinations(enumerate(possible), 2):
        if one.family == two.family:  # the second is drawn until its class is another one
            continue
        both = scores[a][:, None] + scores[b][None, :] - lam**2 * (one.columns.T @ two.columns)
        order = np.log(1.0 / (1.0 - share[one.family]) + 1.0 / (1.0 - share[two.family]))
        found[one, two] = log_mean(both) + one.prior + two.prior + float(order)
    return found


def of_any_size(
    found: dict[tuple[Possible, ...], float], residual: np.ndarray, lam: float
) -> dict[tuple[Possible, ...], float]:
    """Log posterior of pairs, given that with sizes `lam`, where each of the two may have any of `SIZES`.

    Pairs less likely by exp(-`FAR`) at `lam` are left out: other sizes take less than that from the log likelihood.
    """
    best = max(found.values())
    averaged: dict[tuple[Possible, ...], float] = {}
    for (one, two), value in found.items():
        if value < best - FAR:
            continue
        a, b, common = one.columns.T @ residual, two.columns.T @ residual, one.columns.T @ two.columns

        def factor(x: float, y: float, a: np.ndarray = a, b: np.ndarray = b, c: np.ndarray = common) -> float:
            return log_mean(x * a[:, None] + y * b[None, :] - x * y * c) - (x**2 + y**2) / 2.0

        of_sizes = np.array([factor(x, y) for x, y in product(SIZES, SIZES)])
        averaged[one, two] = value + log_mean(of_sizes) - factor(lam, lam)
    return averaged


def of_any_number(
    pairs: dict[tuple[Possible, ...], float], residual: np.ndarray, possible: list[Possible]
) -> dict[tuple[Possible, ...], float]:
    """Log posterior of none, one and two effects of any of `SIZES`, with the prior odds that `diagnose` has."""
    found: dict[tuple[Possible, ...], float] = {(): 0.0}
    for one in possible:
        of_sizes = np.array([log_mean(x * (residual @ one.columns)) - x**2 / 2.0 for x in SIZES])
        found[(one,)] = log_mean(of_sizes) + one.prior + log_odds_of_count(1)
    two = log_odds_of_count(2) - float(np.log(2.0))  # a pair's prior counts both orders
    return found | {both: value + two for both, value in pairs.items()}


@pytest.mark.benchmark
@pytest.mark.parametrize("cell", CELLS)
def test_ceiling(cell: str) -> None:
    exact, classes, inside, sizes = [], [], [], []
    for seed in range(COUNT):
        found, truth = posterior(cell, seed)
        names = {tuple(sorted(one.key for one in effects)): value for effects, value in found.items()}
        hidden = tuple(sorted(map(cells.key, truth.effects)))
        best = max(names, key=lambda name: names[name])
        families: dict[tuple[str, ...], float] = {}
        for effects, value in found.items():
            family = tuple(sorted(one.family for one in effects))
            families[family] = float(np.logaddexp(families.get(family, -np.inf), value))
        near = [name for name, value in names.items() if value > names[best] - 3.0]  # odds of 20
        exact.append(best == hidden)
        classes.append(
            max(families, key=lambda family: families[family]) == tuple(sorted(map(cells.family, truth.effects)))
        )
        inside.append(hidden in near)
        sizes.append(len(near))
    shares = [float(np.mean(values)) for values in (exact, classes, inside, sizes)]
    print(f"\n{cell}: exact {shares[0]:.3f}, class {shares[1]:.3f}, in the set {shares[2]:.3f}, size {shares[3]:.2f}")
    assert shares[1] > 0.9  # the classifier itself works


@pytest.mark.benchmark
def test_ceiling_of_two_effects_with_what_is_known() -> None:
    """The classifier that knows sizes and number, without the sizes, and without both, as `diagnose`, which does not
    know sigma either."""
    rights = []
    for seed in range(COUNT):
        rights.append([best_name(found) == truth for found, truth in with_less(seed)])
    shares = np.mean(rights, axis=0)
    said = ("sizes and number known", "number known", "neither")
    print(f"\ntwo, lambda 8, {len(rights)} sets:", *(f"{s:.3f} {name}" for s, name in zip(shares, said, strict=True)))
    assert shares[-1] > 0.7  # the classifier itself works


def with_less(seed: int) -> Iterator[tuple[dict[tuple[Possible, ...], float], set[str]]]:
    """Log posteriors of a set of two effects: sizes and number known, number known, neither; and what is hidden."""
    residual, possible, lam, truth = drawn("two, lambda 8", seed)
    hidden = set(map(cells.key, truth.effects))
    known = among(residual, possible, lam, 2)
    averaged = of_any_size(known, residual, lam)
    yield from ((found, hidden) for found in (known, averaged, of_any_number(averaged, residual, possible)))


def best_name(found: dict[tuple[Possible, ...], float]) -> set[str]:
    return {one.key for one in max(found, key=lambda effects: found[effects])}


@pytest.mark.benchmark
@pytest.mark.parametrize("weight", [1.0, RARE])
@pytest.mark.parametrize("name", ONE)
def test_ceiling_of_wrong_loads(name: str, weight: float) -> None:
    """Their prior beside the common effects is 1, or what the library says (`RARE`), which costs names."""
    named: Counter[str] = Counter()
    inside = 0
    for seed in range(COUNT // 2):
        residual, possible, lam, _ = drawn(f"{name}, lambda 8", seed)
        rare = np.log([weight if one.key in ONE else 1.0 for one in possible])
        found = [log_mean(lam * (residual @ one.columns) - lam**2 / 2.0) + one.prior for one in possible] + rare
        scores = {one.key: float(score) for one, score in zip(possible, found, strict=True)}
        best = max(scores, key=lambda key: scores[key])
        named[best.split(":")[0]] += 1
        inside += scores[name] > scores[best] - 3.0
    shares = {key: round(count / named.total(), 3) for key, count in named.most_common(4)}
    print(f"\n{name}, prior {weight:g}: named {shares}, in the set {inside / named.total():.3f}")
    assert inside > 0.9 * named.total()
