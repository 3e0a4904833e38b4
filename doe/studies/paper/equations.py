"""Mistakes in the paper's equations and conditions, each shown by algebra on random plans (doe/README.md, "Errata")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.studies.paper.tables import JOINT_OFFSETS_DEG, LENGTH_ERRORS, LENGTHS, SIGMA, paper_arm, paper_truth
from identification.arrays import Array
from identification.estimation import estimate
from identification.information import spectrum
from identification.model import Model
from identification.simulate import simulate

WRONG = 0.01  # relative; rounding in the paper explains less
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
        """True if the numbers show both that the statement is wrong and that the correction is right."""
        return self.printed_error > WRONG and self.correct_error <= self.tolerance


def distance(found: Array | float, truth: Array | float) -> float:
    """Largest difference, relative to the largest true value."""
    return float(np.max(np.abs(np.asarray(found) - truth)) / np.max(np.abs(truth)))


def optimal_orientations(runs: int, links: int = 4) -> Array:
    """(m, n) theta_j = 2 pi i j / m [rad] of the optimal plan."""
    return np.asarray(2.0 * np.pi * np.outer(np.arange(runs), np.arange(1, links + 1)) / runs)


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
        "derivative with respect to dtheta_k: sums over links k..n (printed l = i..n)",
        "link k alone, as in eq. 8; the sum over k..n is the derivative with respect to the joint offset dq_k",
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
    _, c, _ = _blocks(optimal_orientations(m, n))
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


def criterion_without_teeth(generator: np.random.Generator, replications: int) -> Erratum:
    """det D' of a plan of three links with det C' = 1 and det S' = 0; then of one with eq. 21. D-optimal plans have 1.

    Joint 2 on 30 and 150 degrees, joint 3 on four angles a quarter turn apart, all eight pairs: h_2 = i/2, h_3 = 0, so
    C' = 1, and S', antisymmetric of odd size, is singular as that of every plan.
    """
    q2, q3 = np.meshgrid(np.radians([30.0, 150.0]), np.radians([0.0, 90.0, 180.0, 270.0]), indexing="ij")
    satisfied = np.cumsum(np.stack([np.zeros(8), q2.ravel(), q3.ravel()], axis=1), axis=1)

    def criteria(theta: Array) -> tuple[float, float, float]:
        h = np.exp(-1j * theta).T @ np.exp(1j * theta) / len(theta)
        return tuple(float(np.linalg.det(part).real) for part in (h.real, h.imag, h))  # type: ignore[return-value]

    det_c, det_s, det_h = criteria(satisfied)
    best = abs(det_c - 1.0) < 1e-12 and abs(det_s) < 1e-12
    return Erratum(
        "eq. 20-23",
        "D*, det C' = 1 and det S' = 0, 'ensures agreement with the D-optimality'",
        "for 2 links; from 3 links on S' may be singular without being zero, for odd n it always is. Eq. 21 is "
        "sufficient, and D alone (det D' = |det(C' + iS')|^2) asks for it",
        distance(det_h**2, 1.0) if best else 0.0,
        distance(criteria(optimal_orientations(8, 3))[2] ** 2, 1.0),
        1e-12,
    )


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


def four_links_three_points(generator: np.random.Generator, replications: int) -> Erratum:
    """Largest rank of the Jacobian of 4 links over random plans with 3 points."""
    model = Model(paper_arm(4))
    plans = generator.uniform(-np.pi, np.pi, (100, 3, 4))
    ranks = [spectrum(model.jacobian(plan), model.scales).rank for plan in plans]
    return Erratum(
        "Table III, 4 links, 3 points",
        "8 parameters identified",
        "6 equations determine 6 of 8 combinations: not identifiable, m >= n is needed",
        distance(8.0, float(max(ranks))),
        distance(6.0, float(max(ranks))),
        0.0,
    )
