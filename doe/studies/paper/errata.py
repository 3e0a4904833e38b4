"""The paper's mistakes, each shown by numbers: how far the printed statement is from the truth, and how far ours.

The truth comes from finite differences of eq. 1 and 3, from the information matrix itself, or from simulation, never
from the statement under test. An erratum is confirmed when the printed statement is wrong by more than 1 % and the
correction is right to the accuracy of the check.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import polars as pl

from doe.jobs.row_table import frame_of
from doe.studies.paper import equations
from doe.studies.paper.equations import LENGTHENED, TURNED, Erratum, L, distance, optimal_orientations, tips
from doe.studies.paper.tables import LENGTH_ERRORS, SIGMA, joint_offset_std, orientation_std, paper_arm
from identification.arrays import Array
from identification.estimation import estimate_batch
from identification.model import Model


def errata(replications: int = 10_000, seed: int = 0, numbers: Sequence[int] | None = None) -> pl.DataFrame:
    """One row per erratum: the fields of `Erratum`, and `confirmed`. `numbers`: places in `CHECKS`, None: all."""
    chosen = range(len(CHECKS)) if numbers is None else numbers
    found = [CHECKS[k](np.random.default_rng([seed, k]), replications) for k in chosen]
    return frame_of([{**vars(erratum), "confirmed": erratum.confirmed} for erratum in found])


def covariance_of_the_optimum(generator: np.random.Generator, replications: int) -> Erratum:
    """Sample covariance of simulated fits of the optimal plan, against eq. 24."""
    m = 20
    errors = _errors(generator, m, replications)
    sample = np.sqrt(np.diag(np.cov(errors.T)))
    printed = SIGMA * np.sqrt(np.r_[m * L**2, np.ones(4)])
    correct = SIGMA / np.sqrt(m) * np.sqrt(np.r_[LENGTHENED**-2.0, np.ones(4)])
    return Erratum(
        "eq. 24",
        "cov = sigma^2 diag(m L L, I)",
        "sigma^2 / m diag(L^-2, I)",
        float(np.max(np.abs(printed / sample - 1.0))),
        float(np.max(np.abs(correct / sample - 1.0))),
        4.5 / np.sqrt(2.0 * replications),
    )


def deviation_of_the_joint(generator: np.random.Generator, replications: int) -> Erratum:
    """Sample deviations of the joint offsets, against eq. 25 and against those of differences of orientations."""
    m = 20
    errors = np.degrees(_errors(generator, m, replications)[:, :4])
    sample = np.std(np.diff(errors, axis=1), axis=0)
    return Erratum(
        "eq. 25, Tables II and III",
        "sigma_qi = sigma / (sqrt(m) l_i) is the deviation of the joint offset dq_i",
        "of the orientation offset dtheta_i; dq_i has sigma / sqrt(m) sqrt(1/l_i^2 + 1/l_(i-1)^2) for i >= 2",
        float(np.min(np.abs(orientation_std(4, m)[1:] / sample - 1.0))),
        float(np.max(np.abs(joint_offset_std(4, m)[1:] / sample - 1.0))),
        4.5 / np.sqrt(2.0 * replications) + 0.006,  # nominal lengths instead of true ones: 0.6 % for link 1
    )


def _errors(generator: np.random.Generator, m: int, replications: int, n: int = 4) -> Array:
    """(K, 2n) errors of orientation offsets [rad] and length errors [mm] of simulated fits of the optimal plan."""
    theta = optimal_orientations(m, n)
    exact = tips(theta, LENGTHENED[:n], TURNED[:n])
    noise = SIGMA * generator.standard_normal((replications, m, 2))
    positions = np.stack([exact.real, exact.imag], axis=-1) + noise
    fits = estimate_batch(Model(paper_arm(n)), np.diff(theta, axis=1, prepend=0.0), positions).parameters
    return np.hstack([np.cumsum(fits[:, n:], axis=1) - TURNED[:n], fits[:, :n] - LENGTH_ERRORS[:n]])


def length_of_two_links(generator: np.random.Generator, replications: int) -> Erratum:
    """Table III, 2 links, 20 points: simulated deviation of the length errors."""
    sample = float(np.std(_errors(generator, 20, replications, n=2)[:, 2]))
    return Erratum(
        "Table III, 2 links, 20 points",
        "dL = 0.058 mm",
        "sigma / sqrt(20) = 0.022 mm",
        distance(0.058, sample),
        distance(SIGMA / np.sqrt(20.0), sample),
        4.5 / np.sqrt(2.0 * replications),
    )


def lengths_of_the_text(generator: np.random.Generator, replications: int) -> Erratum:
    """Section VI: deviation of a length with 4 and 20 points, simulated."""
    sample = np.array([np.std(_errors(generator, m, replications)[:, 4]) for m in (4, 20)])
    return Erratum(
        "Sec. VI text",
        "0.022 mm -> 0.005 mm as m goes 4 -> 20",
        "0.050 mm -> 0.022 mm (0.005 is the orientation of link 1 in degrees, at m = 20)",
        float(np.min(np.abs(np.array([0.022, 0.005]) / sample - 1.0))),
        float(np.max(np.abs(SIGMA / np.sqrt([4.0, 20.0]) / sample - 1.0))),
        4.5 / np.sqrt(2.0 * replications),
    )


def hundred_experiments(generator: np.random.Generator, replications: int) -> Erratum:
    """Section VI: deviation of a length with 100 points, simulated."""
    sample = float(np.std(_errors(generator, 100, replications)[:, 4]))
    return Erratum(
        "Sec. VI text",
        "100 experiments give 0.001 mm",
        "0.01 mm; 0.001 mm takes (0.1 / 0.001)^2 = 10,000",
        distance(0.001, sample),
        distance(0.01, sample),
        4.5 / np.sqrt(2.0 * replications),
    )


CHECKS: tuple[Callable[[np.random.Generator, int], Erratum], ...] = (
    equations.no_closed_form,
    equations.derivative_of_the_sum,
    equations.last_column_of_the_jacobian,
    equations.size_of_the_noise,
    equations.off_diagonal_blocks,
    equations.scaling_of_the_criterion,
    equations.d_optimality_and_units,
    equations.criterion_without_teeth,
    covariance_of_the_optimum,
    deviation_of_the_joint,
    equations.names_in_table_1,
    length_of_two_links,
    equations.four_links_three_points,
    lengths_of_the_text,
    hundred_experiments,
)
