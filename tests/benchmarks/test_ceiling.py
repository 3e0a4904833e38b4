"""What nobody can do better: `pytest -m benchmark -s tests/benchmarks/test_ceiling.py`.

How well could anybody name the hidden effects of the blind study? The Bayes classifier knows what no user knows: sigma,
the size lambda of each effect, the distributions from which the simulator drew phases, orders and stiffnesses, and how
many effects there are. With the most probable name it is right more often than any other rule can be (on average over
the simulator's draws), so its shares are the ceiling for `armcal study blind`, whose very data it is given. For effects
with unit columns u_s off the base Jacobian, s drawn as the simulator draws them, the likelihood of the whitened
residual r against no effect is mean_s exp(r . x_s - |x_s|^2 / 2), x_s = lambda u_s, or for two effects the sum of two
such columns.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pytest
from scipy.special import logsumexp

from doe import DesignProblem
from doe.discrimination.design import discrimination_design
from doe.studies.blind import cells, simulator
from doe.studies.blind.simulator import TrueArm, column, session
from identification import Model

pytestmark = pytest.mark.benchmark
COUNT = 400
PHASES = np.arange(24) * 2.0 * np.pi / 24
CIRCLE = np.vstack([np.cos(PHASES), np.sin(PHASES)])
STIFFNESSES = 200
PAIRS = ("encoder_eccentricity", "encoder_second_harmonic", "axes_skew", "transmission_ripple")  # of two parameters
SAGGING = ("joint_compliance", "gravity_backlash", "link_bending")  # of one sign only
NAMES = cells.LIBRARY_JOINT + cells.LIBRARY_WHOLE
ONE = ("lambda 6, m=50", "lambda 6, m=200", "lambda 6, discriminating plan", "lambda 8, m=50", "lambda 8, m=20")
CELLS = [*(f"one, {cell}" for cell in (*ONE, "lambda 8, discriminating plan")), "two, lambda 8"]


class Possible(NamedTuple):
    """One effect that might be hidden: key, class, log prior, (2m, S) sampled unit columns off the base Jacobian."""

    key: str
    family: str
    prior: float
    columns: np.ndarray


def log_mean(x: np.ndarray) -> float:
    return float(logsumexp(x) - np.log(x.size))


def directions(bare: TrueArm, run: simulator.RowConditions, name: str, j: int | None) -> Iterator[np.ndarray]:
    """(2m, S) sampled columns of an effect, one array per order of a ripple."""
    if name in PAIRS:
        for k in range(3, 65) if name == "transmission_ripple" else [None]:
            both = [{c: float(c == one) for c in "ab"} | ({"k": k} if k else {}) for one in "ab"]
            yield np.column_stack([column(bare, run, (name, j, values)) for values in both]) @ CIRCLE
    elif name in ("base_offset", "base_drift"):
        yield cells.probed(bare, run, name, None) @ CIRCLE
    elif name == "joint_compliance*":
        each = [column(bare, run, ("joint_compliance", i + 1, {"c": 1.0})) for i in range(bare.n)]
        yield np.column_stack(each) @ np.random.default_rng(1).uniform(0.5, 1.5, (bare.n, STIFFNESSES))
    else:
        values = cells.directions(bare, name, j, np.random.default_rng(0))
        one = column(bare, run, (name, j, values))[:, None]
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
    rng = spec.generator(seed)
    plan = postures = planned(cell, seed // cells.SAME_ARM * cells.SAME_ARM)
    truth = cells.truth_of(spec, rng) if plan is None else cells.shared_truth(cell, seed)
    if postures is None:
        postures = rng.uniform(truth.lower, truth.upper, (max(*spec.rows, truth.n + 4), truth.n))
    run = session(truth, postures, rng)
    truth = replace(truth, effects=cells.hidden(spec, truth, run, rng))
    bare = replace(truth, effects=[])
    measured = cells.data_set(cell, seed, plan).measurements.positions  # the same noise
    miss = (measured - simulator.position(bare, run)).ravel() / truth.sigma
    basis = np.linalg.qr(simulator.base_jacobian(truth, run))[0]
    possible = []
    for name in NAMES:
        first = 2 if name == "joint_coupling" else 1
        joints = [None] if name in cells.LIBRARY_WHOLE else list(range(first, truth.n + 1))
        for j in joints:
            columns = np.hstack(list(directions(bare, run, name, j)))
            off = columns - basis @ (basis.T @ columns)
            norms = np.linalg.norm(off, axis=0)
            seen = norms >= 0.02 * np.linalg.norm(columns, axis=0)  # what cannot be seen is drawn again
            effect, prior = (name.rstrip("*"), j, {}), -np.log(len(NAMES)) - np.log(len(joints))
            if seen.any():
                units = off[:, seen] / norms[seen]
                possible.append(Possible(cells.key(effect), cells.family(effect), float(prior), units))
    assert spec.lam is not None
    return miss - basis @ (basis.T @ miss), possible, spec.lam, truth


def posterior(
    residual: np.ndarray, possible: list[Possible], lam: float, count: int
) -> Iterator[tuple[list[Possible], float]]:
    """Sets of one or two effects of the size `lam`, with their log posterior against no effect."""
    scores = [lam * (residual @ one.columns) - lam**2 / 2.0 for one in possible]
    share = Counter[str]()
    for one, score in zip(possible, scores, strict=True):
        share[one.family] += np.exp(one.prior)
        if count == 1:
            yield [one], log_mean(score) + one.prior
    for (a, one), (b, two) in combinations(enumerate(possible), 2) if count == 2 else ():
        if one.family != two.family:  # the second is drawn until its class is another one
            both = scores[a][:, None] + scores[b][None, :] - lam**2 * (one.columns.T @ two.columns)
            order = np.log(1.0 / (1.0 - share[one.family]) + 1.0 / (1.0 - share[two.family]))
            yield [one, two], log_mean(both) + one.prior + two.prior + float(order)


@pytest.mark.parametrize("cell", CELLS)
def test_names(cell: str) -> None:
    rows = []
    for seed in range(COUNT):
        residual, possible, lam, truth = drawn(cell, seed)
        names, families = dict[tuple[str, ...], float](), dict[tuple[str, ...], float]()
        for effects, value in posterior(residual, possible, lam, len(truth.effects)):
            names[tuple(sorted(one.key for one in effects))] = value
            family = tuple(sorted(one.family for one in effects))
            families[family] = float(np.logaddexp(families.get(family, -np.inf), value))
        hidden, classes = (tuple(sorted(map(f, truth.effects))) for f in (cells.key, cells.family))
        near = [name for name, value in names.items() if value > max(names.values()) - 3.0]  # odds of 20
        best, best_class = max(names, key=names.__getitem__), max(families, key=families.__getitem__)
        rows.append((best == hidden, best_class == classes, hidden in near, len(near)))
    exact, right, inside, size = np.mean(rows, axis=0)
    print(f"\n{cell}: exact {exact:.3f}, class {right:.3f}, in the set {inside:.3f}, size {size:.2f}")
    assert right > 0.9  # the classifier itself works
