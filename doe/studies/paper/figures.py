"""The data of the paper's Figures 1 and 2."""

from __future__ import annotations

import numpy as np
import polars as pl

from doe.jobs.row_table import frame_of
from doe.studies.monte_carlo.plans import dft_postures
from doe.studies.paper.tables import (
    JOINT_OFFSETS_DEG,
    LENGTH_ERRORS,
    REPLICATIONS,
    SIGMA,
    orientation_std,
    paper_arm,
    paper_truth,
)
from identification.arrays import Array
from identification.estimation import estimate_batch, estimate_each
from identification.model import Model

RUNS = tuple(range(4, 21))  # the axis of Figure 2


def figure_1(plans: int = REPLICATIONS, seed: int = 0, runs: int = 10, links: int = 4) -> pl.DataFrame:
    """Figure 1: the determinants of random plans, one row per plan; the optimal plan has 1, 1 and 0.

    `det_d` : of D', the normalised information matrix (eq. 19, = |det H|^2);  `det_c`, `det_s` : of C' and S' (eq. 20,
    divided by m). D* asks for det C' = 1 and det S' = 0. For an odd number of links det S' = 0 for EVERY plan, S being
    antisymmetric: there D* does not see S at all.
    """
    generator = np.random.default_rng([seed, 1])
    theta = np.cumsum(generator.uniform(-np.pi, np.pi, (plans, runs, links)), axis=-1)
    z = np.exp(1j * theta)
    h = np.swapaxes(z.conj(), -1, -2) @ z / runs
    d, c, s = np.abs(np.linalg.det(h)) ** 2, np.linalg.det(h.real), np.linalg.det(h.imag)
    return pl.DataFrame({"plan": np.arange(plans), "det_d": d, "det_c": c, "det_s": s})


def figure_2(replications: int = REPLICATIONS, seed: int = 0, runs: tuple[int, ...] = RUNS) -> pl.DataFrame:
    """Figure 2: deviations of the length and the orientation of every link against m, one row per m and parameter.

    `optimal` : curve 1, eq. 25;  `optimal_simulated` : "x", simulated fits of the optimal plan
    `ordinary` : "o", simulated fits of one random plan, the same links turned at random
    `random_mean` : curve 2, mean over as many random plans of the plan's deviation, from one simulated fit of each:
        sqrt(pi / 2) times the mean size of the error, which for normal errors of deviation s is s. (The root mean
        square would be infinite at m = 4: 1/det H has no mean there.)
    `joint_offset` : of the joint offset, which the paper does not show; null for lengths
    """
    rows = []
    for m in runs:
        generator = np.random.default_rng([seed, 2, m])
        optimal, ordinary = dft_postures(4, m), generator.uniform(-np.pi, np.pi, (m, 4))
        random_plans = generator.uniform(-np.pi, np.pi, (replications, m, 4))
        ideal = np.r_[np.full(4, SIGMA / np.sqrt(m)), orientation_std(4, m)]
        x, o = (_errors(plan, replications, generator) for plan in (optimal, ordinary))
        average = np.sqrt(np.pi / 2.0) * np.mean(np.abs(_errors(random_plans, replications, generator)), axis=0)
        for k in range(8):
            joint = None if k < 4 else float(np.std(x[:, k] - (x[:, k - 1] if k > 4 else 0.0)))
            rows.append(
                {
                    "runs": m,
                    "item": f"{'length_error' if k < 4 else 'orientation_offset'}:{k % 4 + 1}",
                    "unit": "mm" if k < 4 else "deg",
                    "optimal": float(ideal[k]),
                    "optimal_simulated": float(np.std(x[:, k])),
                    "ordinary": float(np.std(o[:, k])),
                    "random_mean": float(average[k]),
                    "joint_offset": joint,
                }
            )
    return frame_of(rows)


def _errors(plans: Array, replications: int, generator: np.random.Generator) -> Array:
    """(K, 8) errors of lengths [mm] and orientation offsets [deg] of fits on one plan (m, 4) or on plans (K, m, 4)."""
    truth, model = Model(paper_truth().of(paper_arm())), Model(paper_arm())
    m = plans.shape[-2]
    exact = truth.position(plans.reshape(-1, 4)).reshape(*plans.shape[:-1], 2)
    positions = exact + SIGMA * generator.standard_normal((replications, m, 2))
    if plans.ndim == 2:
        found = estimate_batch(model, plans, positions).parameters
    else:
        found = estimate_each(model, plans, positions).parameters
    turned = np.cumsum(found[:, 4:] - np.radians(JOINT_OFFSETS_DEG), axis=1)
    turned = (turned + np.pi) % (2.0 * np.pi) - np.pi
    return np.hstack([found[:, :4] - LENGTH_ERRORS, np.degrees(turned)])
