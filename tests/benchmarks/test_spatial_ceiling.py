"""How well could anybody name an effect of gravity on a base that leans? The Bayes classifier that knows the simulator.

    .venv/bin/pytest -m benchmark -s tests/benchmarks/test_spatial_ceiling.py

It knows sigma, the size lambda, where the axes really are and how the simulator draws effects; what it believes of the
base is the question: that it stands as the arm file says, or that it leans by 1 to 3 degrees to any side. Likelihoods
are those of tests/benchmarks/test_blind_ceiling.py, with the direction of gravity sampled as the effect's amplitudes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind import cells
from doe.studies.blind.cells import CELLS, EVERY_JOINT, SEEN, SPACE_JOINT, SPACE_WHOLE, directions, key
from doe.studies.blind.simulator import (
    OF_GRAVITY,
    RowConditions,
    TrueArm,
    base_jacobian,
    column,
    gravity_loads,
    position,
)
from doe.studies.blind.simulator import session as session_of
from tests.benchmarks.test_blind_ceiling import CIRCLE, log_mean

CELL = "space, gravity, tilted base"
COUNT, LEANS = 60, 100
PAIRS = ("encoder_eccentricity", "encoder_second_harmonic", "transmission_ripple")
Columns = Iterator[tuple[str, int | None, np.ndarray]]  # type, joint, (3m, S) sampled columns of effects


def drawn(seed: int) -> tuple[TrueArm, RowConditions, np.ndarray]:
    """The truth of data set number `seed`, its session, and what is measured beside the bare arm [sigma], (3m,)."""
    spec, rng = CELLS[CELL], cells.generator_of(CELL, seed)
    truth = cells.truth_of(spec, rng)
    q = (rng.uniform(truth.lower, truth.upper, (count, truth.n)) for count in (spec.m, cells.FRESH))
    run, _ = (session_of(truth, postures, rng) for postures in q)
    cells.arm_of(spec, truth, rng)
    hidden = replace(truth, effects=cells.hidden(spec, truth, run, rng))
    data = cells.data_set(CELL, seed)
    return hidden, run, (data.measurements.positions - position(truth, run)).ravel() / truth.sigma


def lever(truth: TrueArm, run: RowConditions, joint: int) -> np.ndarray:
    """(3m,) derivative of the position by the angle of a joint."""
    h = 1e-6 * np.eye(truth.n)[joint - 1]
    up, down = (position(replace(truth, offsets=truth.offsets + step), run).ravel() for step in (h, -h))
    return (up - down) / 2e-6


def of_gravity(
    truth: TrueArm, run: RowConditions, directions: np.ndarray
) -> Iterator[tuple[str, int | None, np.ndarray]]:
    """Type, joint and (3m, S) columns of every effect of gravity, for (S, 3) directions of gravity."""
    along = [replace(truth, gravity=axis) for axis in np.eye(3)]
    axes = truth.home[:-1, :3, 2]
    torques = np.stack([np.einsum("mji,ji->mj", gravity_loads(one, run)[0], axes) for one in along], axis=-1)
    whole = np.zeros((3 * len(run.q), len(directions)))
    stiffness = np.random.default_rng(1).uniform(0.5, 1.5, (truth.n, len(directions)))
    for j in range(1, truth.n + 1):
        for name in ("joint_compliance", "bearing_compliance"):
            parts = np.column_stack([column(one, run, (name, j, {"c": 1.0})) for one in along])
            yield name, j, parts @ directions.T
            whole += stiffness[j - 1] * (parts @ directions.T) if name == "joint_compliance" else 0.0
        signs = np.sign(torques[:, j - 1] @ directions.T)
        yield "gravity_backlash", j, lever(truth, run, j)[:, None] * np.repeat(signs, 3, axis=0)
    yield EVERY_JOINT, None, whole


def others(truth: TrueArm, run: RowConditions) -> Columns:
    """The same of the library's other common effects."""
    for name in (*SPACE_JOINT, *SPACE_WHOLE):
        if name in (*OF_GRAVITY, EVERY_JOINT):
            continue
        for j in [None] if name in SPACE_WHOLE else range(2 if name == "joint_coupling" else 1, truth.n + 1):
            if name in PAIRS:
                joint = j or 1
                arm = lever(truth, run, joint)[:, None]
                for k in range(3, 65) if name == "transmission_ripple" else [PAIRS.index(name) + 1]:
                    angle = k * run.q[:, joint - 1]
                    both = np.repeat(np.column_stack([np.cos(angle), np.sin(angle)]), 3, axis=0)
                    yield name, j, arm * both @ CIRCLE
            elif name in ("base_drift", "base_rotation_drift"):
                short = "v" if name == "base_drift" else "w"
                each = [column(truth, run, (name, j, {short: axis})) for axis in np.eye(3)]
                yield name, j, np.column_stack(each) @ np.random.default_rng(2).normal(0.0, 1.0, (3, 100))
            else:
                one = column(truth, run, (name, j, directions(truth, name, j, np.random.default_rng(0))))
                yield name, j, np.column_stack([one, -one])


def scores(residual: np.ndarray, basis: np.ndarray, parts: Columns, lam: float) -> dict[str, float]:
    """Log likelihood of each effect against none, with the simulator's prior of the joint."""
    found: dict[str, list[np.ndarray]] = {}
    for name, j, columns in parts:
        off = columns - basis @ (basis.T @ columns)
        norms = np.linalg.norm(off, axis=0)
        keep = norms > SEEN * np.linalg.norm(columns, axis=0)
        if keep.any():
            like = lam * (residual @ (off[:, keep] / norms[keep])) - 0.5 * lam**2
            found.setdefault(key((name.rstrip("*"), j, {})), []).append(like)
    return {name: log_mean(np.concatenate(like)) - np.log(6.0) * (":" in name) for name, like in found.items()}


@pytest.mark.benchmark
def test_ceiling_on_a_base_that_leans() -> None:
    right = {"leans, gravity": 0, "leans, library": 0, "as the file says, library": 0}
    at_first, missed = [], Counter[str]()
    for seed in range(COUNT):
        truth, run, miss = drawn(seed)
        bare = replace(truth, effects=[])
        basis = np.linalg.qr(base_jacobian(bare, run))[0]
        residual = miss - basis @ (basis.T @ miss)
        rng = np.random.default_rng([5, seed])
        level = replace(bare, gravity=np.array([0.0, 0.0, -9.81]))
        leans = np.array([cells.leaning(level, rng).gravity for _ in range(LEANS)])
        lam = CELLS[CELL].lam or 0.0
        sagging = scores(residual, basis, of_gravity(bare, run, leans), lam)
        stiff = scores(residual, basis, of_gravity(bare, run, level.gravity[None]), lam)
        rest = scores(residual, basis, others(bare, run), lam)
        name = key(truth.effects[0])
        for what, found in zip(right, (sagging, rest | sagging, rest | stiff), strict=True):
            right[what] += max(found, key=lambda k: found[k]) == name
        missed.update([name] * (max(rest | sagging, key=(rest | sagging).__getitem__) != name))
        at_first.append(name in ("joint_compliance:1", "gravity_backlash:1"))
    print("\n", {what: count / COUNT for what, count in right.items()}, "at joint 1", sum(at_first), "missed", missed)
    assert right["leans, gravity"] > 0.8 * COUNT
