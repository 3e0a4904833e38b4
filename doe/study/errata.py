"""The paper's mistakes, each shown by numbers: how far the printed statement is from the truth, and how far ours.

Truth comes from finite differences of eq. 1 and 3, from the information matrix itself, or from simulation; never from
the statement that is tested. An erratum is confirmed when what is printed is wrong by more than 1 % and what stands in
its place is right to the accuracy of the check.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from doe.rows import frame_of
from doe.study.paper import (
    JOINT_OFFSETS_DEG,
    LENGTH_ERRORS,
    LENGTHS,
    SIGMA,
    joint_offset_std,
    orientation_std,
    paper_arm,
    paper_truth,
)
from identification.estimation import estimate, estimate_batch
from identification.information import identifiability
from identification.model import Model
from identification.simulate import simulate

if TYPE_CHECKING:
    import polars

    from identification.arm import Array

WRONG = 0.01  # relative: no rounding of the paper explains more
L = np.array(LENGTHS)
LENGTHENED = L + LENGTH_ERRORS  # [mm]
TURNED = np.cumsum(np.radians(JOINT_OFFSETS_DEG))  # orientation offsets [rad]


@dataclass(frozen=True)
class Erratum:
    """One mistake.

    printed_error, correct_error : relative distance of what is printed, and of its correction, from the truth
    tolerance : accuracy of the check that `correct_error` must reach
    """

    place: str
    printed: str
    correct: str
    printed_error: float
    correct_error: float
    tolerance: float

    @property
    def confirmed(self) -> bool:
        """True if the numbers show the mistake, and that its correction is none."""
        return self.printed_error > WRONG and self.correct_error <= self.tolerance


def errata(replications: int = 10_000, seed: int = 0, numbers: Sequence[int] | None = None) -> polars.DataFrame:
    """One row per erratum: the fields of `Erratum`, and `confirmed`. `numbers`: places in `CHECKS`, None: all."""
    chosen = range(len(CHECKS)) if numbers is None else numbers
    found = [CHECKS[k](np.random.default_rng([seed, k]), replications) for k in chosen]
    return frame_of([{**vars(erratum), "confirmed": erratum.confirmed} for erratum in found])


def distance(found: Array | float, truth: Array | float) -> float:
    """Largest difference, relative to the largest true value."""
    return float(np.max(np.abs(np.asarray(found) - truth)) / np.max(np.abs(truth)))


def tips(theta: Array, lengths: Array, turned: Array) -> Array:
    """(m,) x + iy of eq. 1 at orientations theta (m, n) [rad]."""
    return np.exp(1j * (theta + turned)) @ lengths


def no_closed_form(generator: np.random.Generator, replications: int) -> Erratum:
    """The closed form equals the converged iteration of Section III, on noisy data of the paper's arm; both errors here
    in standard deviations sigma / sqrt(m)."""
    model, truth = Model(paper_arm()), paper_truth().of(paper_arm())
    postures = generator.uniform(-np.pi, np.pi, (20, 4))
    data = simulate(truth, postures, generator)
    exact, steps = (estimate(model, data, method=method).parameters for method in ("linear", "paper_steps"))
    # the linearised step that eq. 11 would be without repeating it
    jacobian = model.jacobian(postures).reshape(-1, 8)
    once = np.linalg.lstsq(jacobian, (data.positions - model.position(postures)).ravel(), rcond=None)[0]
    return Erratum(
        "before eq. 6",
        "no general analytical solution; eq. 11 once",
        "linear in u_j = (l_j + dl_j) exp(i dtheta_j): one complex least-squares problem",
        float(np.max(np.abs((once - steps) * model.scales))) / (SIGMA / np.sqrt(20.0)),
        float(np.max(np.abs((exact - steps) * model.scales))) / (SIGMA / np.sqrt(20.0)),
        1e-8,
    )


def derivative_of_the_sum(generator: np.random.Generator, replications: int) -> Erratum:
    """dF/d dtheta_k by central differences, against eq. 4 (a sum over links) and against link k alone."""
    theta = generator.uniform(-np.pi, np.pi, (6, 4))
    measured = tips(theta, LENGTHENED, TURNED) + generator.standard_normal(6) + 1j * generator.standard_normal(6)
    k, step = 1, 1e-5

    def cost(turned: Array) -> float:
        return float(np.sum(np.abs(tips(theta, L, turned) - measured) ** 2))

    shift = step * np.eye(4)[k]
    truth = (cost(TURNED + shift) - cost(TURNED - shift)) / (2.0 * step) / 2.0  # eq. 4 leaves the factor 2 out
    links = np.exp(1j * (theta + TURNED)) * L
    rest = tips(theta, L, TURNED) - measured
    by_link = np.real(np.conj(1j * links) * rest[:, None]).sum(axis=0)
    return Erratum(
        "eq. 4",
        "derivative by dtheta_k: sums over links k..n (printed l = i..n)",
        "link k alone, as in eq. 8; the sum over k..n is the derivative by the joint offset dq_k",
        distance(by_link[k:].sum(), truth),
        distance(by_link[k], truth),
        1e-7,
    )


def last_column_of_the_jacobian(generator: np.random.Generator, replications: int) -> Erratum:
    """dy/d dtheta_n by central differences, against l_j cos theta_j for the other links."""
    theta = generator.uniform(-np.pi, np.pi, (6, 4))
    shift = 1e-5 * np.eye(4)[3]
    truth = np.imag(tips(theta, L, shift) - tips(theta, L, -shift)) / 2e-5
    entries = L * np.cos(theta)
    return Erratum(
        "eq. 8",
        "last entry of J_yq: l_j cos theta_j",
        "l_n cos theta_n",
        min(distance(entries[:, j], truth) for j in range(3)),
        distance(entries[:, 3], truth),
        1e-8,
    )


def size_of_the_noise(generator: np.random.Generator, replications: int) -> Erratum:
    """Length of eps_a = [eps_1 .. eps_m], two coordinates each."""
    m, n = 10, 4
    length = generator.standard_normal((m, 2)).size
    return Erratum(
        "eq. 15-16",
        "E(eps eps^T) is 2n x 2n",
        "2m x 2m",
        distance(2.0 * n, float(length)),
        distance(2.0 * m, float(length)),
        0.0,
    )


def _blocks(theta: Array) -> tuple[Array, Array, Array]:
    """Sum J^T J by its columns (orientations first, as eq. 7), and C, S of eq. 18."""
    x_turn, y_turn = -L * np.sin(theta), L * np.cos(theta)
    jacobian = np.concatenate([np.hstack([x_turn, np.cos(theta)]), np.hstack([y_turn, np.sin(theta)])])
    difference = theta[:, :, None] - theta[:, None, :]
    return jacobian.T @ jacobian, np.cos(difference).sum(axis=0), np.sin(difference).sum(axis=0)


def off_diagonal_blocks(generator: np.random.Generator, replications: int) -> Erratum:
    """The blocks of sum J^T J, against B = L S printed and B = -L S."""
    total, _, s = _blocks(generator.uniform(-np.pi, np.pi, (6, 4)))
    b, c = total[:4, 4:], total[4:, :4]
    ls = L[:, None] * s
    return Erratum(
        "eq. 17-19",
        "B = C = [l_j s_jk]",
        "B = -L S, and the lower left block is its transpose S L (S is antisymmetric)",
        min(distance(ls, b), distance(ls, c)),
        max(distance(-ls, b), distance(s * L, c)),
        1e-12,
    )


def scaling_of_the_criterion(generator: np.random.Generator, replications: int) -> Erratum:
    """det C' of the optimal plan must be 1 (Section V); m = 10, n = 4."""
    m, n = 10, 4
    theta = 2.0 * np.pi * np.outer(np.arange(m), np.arange(1, n + 1)) / m
    _, c, _ = _blocks(theta)
    return Erratum(
        "eq. 20",
        "C' = [c_jk / n], S' = [s_jk / n]",
        "divided by m: det C' = 1 for the optimal plan, as the text says",
        distance(float(np.linalg.det(c / n)), 1.0),
        distance(float(np.linalg.det(c / m)), 1.0),
        1e-12,
    )


def d_optimality_and_units(generator: np.random.Generator, replications: int) -> Erratum:
    """Difference of log det between two plans, in metres and degrees instead of millimetres and radians."""
    first, second = (_blocks(generator.uniform(-np.pi, np.pi, (6, 4)))[0] for _ in range(2))
    units = np.diag(np.r_[np.full(4, np.pi / 180.0), np.full(4, 1000.0)])

    def gain(a: Array, b: Array) -> float:
        return float(np.linalg.slogdet(a)[1] - np.linalg.slogdet(b)[1])

    traces = [float(np.trace(np.linalg.inv(total))) for total in (first, second)]
    return Erratum(
        "Sec. V",
        "A: the trace of the information matrix is constant; D is not applicable because of units",
        "A minimises the trace of the INVERSE, which differs between plans; D ranks plans alike in all units",
        distance(traces[0], traces[1]),  # printed: zero
        distance(gain(units @ first @ units, units @ second @ units), gain(first, second)),
        1e-9,
    )


def covariance_of_the_optimum(generator: np.random.Generator, replications: int) -> Erratum:
    """Sample covariance of simulated fits of the optimal plan, against eq. 24."""
    m = 20
    errors = _orientation_errors(generator, m, replications)
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
    errors = np.degrees(_orientation_errors(generator, m, replications)[:, :4])
    sample = np.std(np.diff(errors, axis=1), axis=0)
    return Erratum(
        "eq. 25, Tables II and III",
        "sigma_qi = sigma / (sqrt(m) l_i) is the deviation of the joint offset dq_i",
        "of the orientation offset dtheta_i; dq_i has sigma / sqrt(m) sqrt(1/l_i^2 + 1/l_(i-1)^2) for i >= 2",
        float(np.min(np.abs(orientation_std(4, m)[1:] / sample - 1.0))),
        float(np.max(np.abs(joint_offset_std(4, m)[1:] / sample - 1.0))),
        4.5 / np.sqrt(2.0 * replications) + 0.006,  # nominal lengths instead of true ones: 0.6 % for link 1
    )


def _orientation_errors(generator: np.random.Generator, m: int, replications: int) -> Array:
    """(K, 8) errors of orientation offsets [rad] and length errors [mm] of simulated fits of the optimal plan."""
    theta = 2.0 * np.pi * np.outer(np.arange(m), np.arange(1, 5)) / m
    postures = np.diff(theta, axis=1, prepend=0.0)
    exact = tips(theta, LENGTHENED, TURNED)
    noise = SIGMA * generator.standard_normal((replications, m, 2))
    positions = np.stack([exact.real, exact.imag], axis=-1) + noise
    fits = estimate_batch(Model(paper_arm()), postures, positions).parameters
    return np.hstack([np.cumsum(fits[:, 4:], axis=1) - TURNED, fits[:, :4] - LENGTH_ERRORS])


def names_in_table_1(generator: np.random.Generator, replications: int) -> Erratum:
    """Row "4 links": c_24 read as its index says, the angle between links that q2 and q4 (or q2 + q4) would be."""
    theta = generator.uniform(-np.pi, np.pi, (6, 4))
    q = np.diff(theta, axis=1, prepend=0.0)
    total, _, _ = _blocks(theta)
    element = total[4, 7]  # lengths 1 and 4: sum cos(theta_1 - theta_4)
    return Erratum(
        "Table I, 4 links",
        "c_24, s_24 (as c_23 is of q2 + q3): q2 + q4",
        "c_234, s_234 of q2 + q3 + q4, as the notation column has it; the six sums are q2, q3, q4, q2+q3, q3+q4, "
        "q2+q3+q4 (and the second s_3i of row 3 is s_23i)",
        distance(float(np.cos(q[:, 1] + q[:, 3]).sum()), float(element)),
        distance(float(np.cos(q[:, 1:].sum(axis=1)).sum()), float(element)),
        1e-10,
    )


def length_of_two_links(generator: np.random.Generator, replications: int) -> Erratum:
    """Table III, 2 links, 20 points: simulated deviation of the length errors."""
    model = Model(paper_arm(2))
    theta = 2.0 * np.pi * np.outer(np.arange(20), np.arange(1, 3)) / 20
    exact = tips(theta, LENGTHENED[:2], TURNED[:2])
    positions = np.stack([exact.real, exact.imag], axis=-1)
    positions = positions + SIGMA * generator.standard_normal((replications, 20, 2))
    fits = estimate_batch(model, np.diff(theta, axis=1, prepend=0.0), positions).parameters
    sample = float(np.std(fits[:, 0]))
    return Erratum(
        "Table III, 2 links, 20 points",
        "dL = 0.058 mm",
        "sigma / sqrt(20) = 0.022 mm",
        distance(0.058, sample),
        distance(SIGMA / np.sqrt(20.0), sample),
        4.5 / np.sqrt(2.0 * replications),
    )


def four_links_three_points(generator: np.random.Generator, replications: int) -> Erratum:
    """Largest rank of the Jacobian of 4 links over random plans with 3 points."""
    model = Model(paper_arm(4))
    plans = generator.uniform(-np.pi, np.pi, (100, 3, 4))
    ranks = [identifiability(model.jacobian(plan), model.names, model.scales).rank for plan in plans]
    return Erratum(
        "Table III, 4 links, 3 points",
        "8 parameters identified",
        "6 equations tell 6 of 8 combinations: not identifiable, m >= n is needed",
        distance(8.0, float(max(ranks))),
        distance(6.0, float(max(ranks))),
        0.0,
    )


def lengths_of_the_text(generator: np.random.Generator, replications: int) -> Erratum:
    """Section VI: deviation of a length with 4 and 20 points, simulated."""
    sample = np.array([np.std(_orientation_errors(generator, m, replications)[:, 4]) for m in (4, 20)])
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
    sample = float(np.std(_orientation_errors(generator, 100, replications)[:, 4]))
    return Erratum(
        "Sec. VI text",
        "100 experiments give 0.001 mm",
        "0.01 mm; 0.001 mm takes (0.1 / 0.001)^2 = 10,000",
        distance(0.001, sample),
        distance(0.01, sample),
        4.5 / np.sqrt(2.0 * replications),
    )


CHECKS: tuple[Callable[[np.random.Generator, int], Erratum], ...] = (
    no_closed_form,
    derivative_of_the_sum,
    last_column_of_the_jacobian,
    size_of_the_noise,
    off_diagonal_blocks,
    scaling_of_the_criterion,
    d_optimality_and_units,
    covariance_of_the_optimum,
    deviation_of_the_joint,
    names_in_table_1,
    length_of_two_links,
    four_links_three_points,
    lengths_of_the_text,
    hundred_experiments,
)
