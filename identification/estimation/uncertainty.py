"""Covariance of estimates: from a sigma that the residuals do not contradict, from their scatter, or robustly.

The robust one holds where the model is incomplete (clustered sandwich, corrected for few rows). Rows are grouped so
that what is left unexplained may be of any size and any correlation within a group, and is independent between groups.
With the whitened Jacobian J_g and residuals r_g of group g, B = (J^T J)^-1 and the leverage H_gg = J_g B J_g^T
(B. A. Pustejovsky, E. Tipton, 2018: CR2, after R. M. Bell, D. F. McCaffrey, 2002)

    cov = B [ sum_g J_g^T A_g r_g r_g^T A_g J_g ] B,     A_g = (I - H_gg)^(-1/2),

which is unbiased if the model is complete and the noise white. With a prior, whose rows R are whitened as J is, the
estimates are those of the posterior's mode, B = (J^T J + R^T R)^-1, and the prior adds s^2 R^T R in the middle, s^2
being the variance of white noise: its part of the errors is as the prior says. Intervals are Student's, with the
degrees of freedom of the chi-square that has the same first two moments as the variance (Satterthwaite), for each
parameter its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, fdtrc, ndtri, stdtrit

from identification.arm import Calibration
from identification.arrays import Array
from identification.estimation.problem import Problem
from identification.information import ALONE, Spectrum
from identification.kinematics.parameters import ParameterSet
from identification.measurements import Measurements

# reasons: identification/README.md, "Covariance and intervals"
BELIEVED = (0.1, 0.99)  # p-values of chi2 between which intervals rely on the sigma that is given
LEVEL = 0.01  # of misfit that is said, of lack of fit and of serial correlation
FEWEST = 2.0  # degrees of freedom: with no more, Student's t has no variance
FREEDOM = "interval_dof"  # key of a calibration's provenance


@dataclass(frozen=True)
class WhiteRows:
    """What a fit leaves of m rows of d whitened coordinates, and the linear model about it.

    jacobian : (m, d, p);  residual : (m, d);  rank : number of combinations estimated, with a prior by the data alone
    sequence : (m,) row numbers in the order of measurement
    postures, repeats : (m,) `Measurements.posture_numbers` and `repeat_numbers`, from 0
    pull : (p,) R^T R (center - values) of a prior's rows R, None: no prior
    """

    jacobian: Array
    residual: Array
    rank: float
    sequence: NDArray[np.int64]
    postures: NDArray[np.int64]
    repeats: NDArray[np.int64]
    pull: Array | None = None

    @classmethod
    def of(cls, problem: Problem, data: Measurements, parameters: Array, rank: float) -> WhiteRows:
        """Of the rows of weight above zero, linear about parameters (p,)."""
        kept = problem.weights > 0.0
        position, jacobian = problem.model.linearize(problem.postures, parameters, problem.conditions)
        residual = problem.root_weights * (problem.positions[0] - position)
        weighted = problem.root_weights[:, :, None] * jacobian
        postures, repeats = (
            np.unique(numbers[kept], return_inverse=True)[1] for numbers in (data.posture_numbers, data.repeat_numbers)
        )
        sequence = np.cumsum(kept)[data.sequence[kept[data.sequence]]] - 1
        prior = problem.prior_rows
        pull = prior.T @ (prior @ (problem.prior_center - parameters)) if len(prior) else None
        return cls(weighted[kept], residual[kept], rank, sequence, postures, repeats, pull)

    @property
    def freedom(self) -> float:
        """Equations less combinations estimated."""
        return self.residual.size - self.rank

    @property
    def squares(self) -> float:
        """Sum of squared whitened residuals."""
        return float(np.sum(self.residual**2))

    @property
    def p_value(self) -> float | None:
        """Probability of a sum of squares at least this large, if noise is white with variance one."""
        return float(chdtrc(self.freedom, self.squares)) if self.freedom > 0 else None

    @property
    def several(self) -> bool:
        """Whether a posture has several rows, which share what is left unexplained there."""
        return int(self.postures.max()) + 1 < len(self.postures)

    def of_postures(self, root: Array) -> tuple[float, float]:
        """Sum of squares of what the rows of each posture have in common, their sum over the root of their number; and
        its expectation if noise is white with variance one, the degrees of freedom.

        root : (p, rank), root @ root.T = (J^T J + R^T R)^-1
        """
        share = 1.0 / np.sqrt(np.bincount(self.postures))[self.postures, None]
        columns = np.concatenate([self.residual[:, :, None], self.jacobian @ root], axis=2) * share[:, :, None]
        sums = np.zeros((int(self.postures.max()) + 1, *columns.shape[1:]))
        np.add.at(sums, self.postures, columns)
        squares = np.sum(sums**2, axis=(0, 1))
        return float(squares[0]), float(sums[:, :, 0].size - squares[1:].sum())


@dataclass(frozen=True)
class Uncertainty:
    """How sure estimates are.

    kind : `given` (sigma is known), `scatter` (of the residuals, taken as white), `sandwich` (robust)
    covariance : (p, p);  freedom : (p,) degrees of freedom of Student's t, infinite where sigma is given
    clusters, count : what is taken as independent (`rows`, `postures`, `stretches` of time), and how many of them
    """

    kind: str
    covariance: Array
    freedom: Array
    clusters: str | None = None
    count: int = 0

    @property
    def sentence(self) -> str:
        """Where the intervals come from, in words."""
        if self.kind == "given":
            return "from the sigma given"
        if self.kind == "scatter":
            return "from the scatter of the residuals"
        what = "stretches of time" if self.clusters == "stretches" else self.clusters
        return f"from the scatter, robust to what is left unexplained (sandwich over {self.count} {what})"


def uncertainty(
    rows: WhiteRows,
    decomposed: Spectrum,
    *,
    sigma_given: bool,
    reliance: str | None = None,
    doubtful: bool = False,
    noise: float | None = None,
) -> Uncertainty:
    """The covariance that holds, and the degrees of freedom of its intervals.

    sigma_given : the rows are divided by a sigma that is given
    reliance : `given` or `estimated`: what the intervals rely on, whatever the residuals say; None: the sigma given as
        long as chi2 does not contradict it, that of the rows and that of what the rows of each posture have in common;
        else the scatter, robustly where postures have several rows or something is left unexplained
    doubtful : something is known to be left unexplained, or the noise to be no constant
    noise : with a prior, the standard deviation of the whitened rows that the prior was weighed against; None: no prior
    """
    p, plain = rows.p_value, decomposed.covariance
    trusted = p is None or BELIEVED[0] <= p <= BELIEVED[1] if noise is None else noise == 1.0
    if trusted and rows.several:
        squares, freedom = rows.of_postures(decomposed.root)
        trusted = freedom < 1.0 or float(chdtrc(freedom, squares)) >= BELIEVED[0]
    if sigma_given and (reliance == "given" or (reliance is None and trusted)):
        return Uncertainty("given", plain, np.full(len(plain), np.inf))
    variance = noise**2 if noise else rows.squares / rows.freedom if rows.freedom > 0 else np.nan
    freedom = rows.freedom if noise is None else max(rows.freedom, 1.0)
    if reliance is None and p is not None:
        misfit = doubtful or (sigma_given and p < BELIEVED[0] and noise is None)
        if rows.several or not (sigma_given and p > BELIEVED[1]):
            robust = _robust(rows, decomposed.root, misfit, variance)
            if robust is not None:
                return robust
        if rows.several:  # too few postures for a sandwich: what their rows have in common, as one row each
            squares, spare = rows.of_postures(decomposed.root)
            if spare >= 1.0 and squares / spare > variance:
                variance, freedom = squares / spare, spare
    return Uncertainty("scatter", variance * plain, np.full(len(plain), float(freedom)))


def _robust(rows: WhiteRows, root: Array, misfit: bool, variance: float) -> Uncertainty | None:
    """The widest sandwich over rows, postures or, where rows are correlated in time, stretches of time; None with too
    few rows, where nothing asks for it, and where the rows determine no parameter.

    root : (p, rank), as of `WhiteRows.of_postures`;  variance : of white noise
    """
    if not root.shape[1]:
        return None
    # an active bound hides what is behind it, and residuals that the parameters could explain would count as misfit: so
    # those that the linear model leaves without bounds
    columns = rows.jacobian @ root
    slope = np.einsum("mdr,md->r", columns, rows.residual) + (0.0 if rows.pull is None else root.T @ rows.pull)
    rows = replace(rows, residual=rows.residual - columns @ slope)
    length = correlated(rows, root)
    if not (misfit or rows.several or length > 1 or lack_of_fit(rows.residual, rows.repeats, rows.rank)[1] < LEVEL):
        return None

    kind, groups, groupings = "postures" if rows.several else "rows", rows.postures, []
    while True:
        made = sandwich(rows.jacobian, rows.residual, root, groups, variance)
        enough = made is not None and made.freedom.min() >= FEWEST
        groupings += [(kind, groups, made)] if made is not None and enough else []
        if length <= 1 or (kind == "stretches" and enough):
            break
        kind, groups, length = "stretches", stretches(rows.sequence, length), length // 2
    plain = np.sum(root**2, axis=1)

    def width(made: Sandwich) -> float:
        """Mean logarithm of the variances over those of white noise."""
        ratio = np.diag(made.covariance)[plain > 0.0] / plain[plain > 0.0]
        return float(np.mean(np.log(np.maximum(ratio, np.finfo(float).tiny))))

    if not groupings:
        return None
    kind, groups, widest = max(groupings, key=lambda each: width(each[2]))
    return Uncertainty("sandwich", widest.covariance, widest.freedom, kind, int(groups.max()) + 1)


def correlated(rows: WhiteRows, root: Array) -> int:
    """Number of successive rows to be taken together: 1 where what they say of the parameters is uncorrelated.

    The lag-1 correlation of the scores Q_i^T r_i, with its standard error if their signs were random. The length is
    that of E. Carlstein (1986) for a first-order autoregression, m^(1/3) (2 rho / (1 - rho^2))^(2/3), and no less than
    leaves 40 stretches: Student's quantile is then within 4 % of the normal one.
    """
    scores = np.einsum("mdr,md->mr", rows.jacobian @ root, rows.residual)[rows.sequence]
    products = np.sum(scores[1:] * scores[:-1], axis=1)
    error = float(np.sqrt(np.sum(products**2)))
    if error == 0.0 or products.sum() <= 2.3263478740408408 * error:  # one-sided normal quantile of `LEVEL`
        return 1
    rho, m = min(float(products.sum() / np.sum(scores**2)), 0.99), len(scores)
    carlstein = m ** (1.0 / 3.0) * (2.0 * rho / (1.0 - rho**2)) ** (2.0 / 3.0)
    return int(np.ceil(max(carlstein, m / 40)))


def stretches(sequence: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    """(m,) number of the stretch of time of each row: as many stretches of about `length` successive rows as fit."""
    m = len(sequence)
    groups = np.empty(m, dtype=np.int64)
    groups[sequence] = np.arange(m) * max(m // length, 1) // m
    return groups


def pure_error(residual: Array, repeats: NDArray[np.int64]) -> tuple[float, int]:
    """Sum of squares of residuals (m, d) about the means of the rows with equal numbers (m,), and its degrees of
    freedom."""
    numbers, counts = np.unique(repeats, return_inverse=True, return_counts=True)[1:]
    means = np.stack([np.bincount(numbers, column) for column in residual.T], axis=1) / counts[:, None]
    return float(np.sum((residual - means[numbers]) ** 2)), residual.shape[1] * (len(residual) - len(counts))


def lack_of_fit(residual: Array, repeats: NDArray[np.int64], rank: float) -> tuple[float, float]:
    """F of the lack of fit against the scatter of repeats, and its p-value; 0 and 1 where too few are repeated.

    residual : (m, d) of a fit of this rank;  repeats : (m,) equal numbers mark repeats
    """
    pure, freedom = pure_error(residual, repeats)
    fit_freedom = residual.size - freedom - rank
    if freedom < 1 or fit_freedom < 1 or pure == 0.0:
        return 0.0, 1.0
    ratio = max((float(np.sum(residual**2)) - pure) / fit_freedom / (pure / freedom), 0.0)
    return ratio, float(fdtrc(fit_freedom, freedom, ratio))


# -- the sandwich -----------------------------------------------------------------------------------------------------
class Sandwich(NamedTuple):
    """covariance : (p, p);  freedom : (p,) degrees of freedom of each variance, infinite where it is zero by force."""

    covariance: Array
    freedom: Array


def sandwich(
    jacobian: Array, residual: Array, root: Array, groups: NDArray[np.int64], variance: float = 1.0
) -> Sandwich | None:
    """The covariance of least-squares estimates; None where one group alone determines a combination of parameters.

    jacobian : (m, d, p) and residual : (m, d), whitened;  root : (p, rank), root @ root.T = (J^T J + R^T R)^-1
    groups : (m,) number of the group of each row, 0, 1, ...;  variance : of white noise, beside a prior
    """
    columns = jacobian @ root
    leverages, vectors, scores = decomposed_groups(columns, residual, groups)
    if leverages.max() > 1.0 - ALONE:
        return None
    factors = 1.0 / np.sqrt(1.0 - np.maximum(leverages, 0.0))
    # (p, G): what each group adds to the estimates
    corrected = root @ (vectors @ (factors * scores)[:, :, None])[:, :, 0].T
    held = np.eye(root.shape[1]) - np.einsum("mdr,mds->rs", columns, columns, optimize=True)  # R^T R; without it zero
    held = root @ held @ root.T
    held_variances = np.maximum(np.diag(held), 0.0)
    freedom = np.array(
        [_freedom(row @ vectors, leverages, factors, vectors, k) for row, k in zip(root, held_variances, strict=True)]
    )
    return Sandwich(corrected @ corrected.T + variance * held, freedom)


def decomposed_groups(columns: Array, residual: Array, groups: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Of columns Q (m, d, r), Q_g^T Q_g = V diag(l) V^T: (G, k) l, (G, r, k) V and (G, k) V^T Q_g^T r_g, zero where a
    group has fewer than k directions;  groups as large as each other at a time, small ones by Q_g Q_g^T."""
    d, r = columns.shape[1:]
    order, counts = np.argsort(groups, kind="stable"), np.bincount(groups)
    starts, most = np.cumsum(counts) - counts, min(r, d * int(counts.max()))
    values, vectors = np.zeros((len(counts), most)), np.zeros((len(counts), r, most))
    scores = np.zeros((len(counts), most))
    for size in np.unique(counts):
        of_size, columns_used = np.flatnonzero(counts == size), slice(min(r, d * int(size)))
        rows = order[starts[of_size, None] + np.arange(size)]
        q = columns[rows].reshape(len(of_size), -1, r)
        across = np.swapaxes(q, 1, 2)
        if q.shape[1] < r:
            eigenvalues, left = np.linalg.eigh(q @ across)
            # leverages below 1e-15 are rounding
            directions = across @ left / np.sqrt(np.where(eigenvalues > 1e-15, eigenvalues, np.inf))[:, None, :]
        else:
            eigenvalues, directions = np.linalg.eigh(across @ q)
        values[of_size, columns_used], vectors[of_size, :, columns_used] = eigenvalues, directions
        projected = np.swapaxes(directions, 1, 2) @ (across @ residual[rows].reshape(len(of_size), -1, 1))
        scores[of_size, columns_used] = projected[:, :, 0]
    return values, vectors, scores


def _freedom(turned: Array, leverages: Array, factors: Array, vectors: Array, held: float) -> float:
    """Satterthwaite's degrees of freedom of one variance, 2 E^2 / var, under white noise of variance one.

    The variance is |P^T e|^2 of white e with P^T P = diag(d) - W W^T: d_g = |A_g Q_g a|^2 and W_g = Q_g^T A_g Q_g a.
    turned : (G, r) a in the eigenvectors of each group;  held : the prior's part of the variance
    """
    diagonal = np.sum(leverages * np.square(factors * turned), axis=1)
    inner = (vectors @ (leverages * factors * turned)[:, :, None])[:, :, 0]
    lengths = np.sum(inner**2, axis=1)
    if min(inner.shape) > 200:  # groups, and combinations: what two groups share through the fit is left out
        squares = np.sum(lengths**2)
    else:
        squares = np.sum(np.square(inner.T @ inner if inner.shape[0] > inner.shape[1] else inner @ inner.T))
    first = diagonal.sum() - lengths.sum()
    second = np.sum(diagonal**2) - 2.0 * np.sum(diagonal * lengths) + squares
    return float((first + held) ** 2 / second) if second > 0.0 else float("inf")


# -- intervals --------------------------------------------------------------------------------------------------------
def quantile_95(freedom: ArrayLike) -> Array:
    """Half the width of a 95 % interval in standard deviations, of the shape of `freedom`.

    freedom : degrees of freedom of Student's t, from which a variance is estimated: infinite where it is known (the
        normal distribution), not a number where there are none
    """
    dof = np.asarray(freedom, dtype=float)
    student = stdtrit(np.where(np.isfinite(dof) & (dof > 0.0), dof, 1.0), 0.975)
    return np.where(np.isposinf(dof), ndtri(0.975), np.where(dof > 0.0, student, np.nan))


def freedom_kept(names: Sequence[str], freedom: Array) -> dict[str, Any]:
    """What a calibration's provenance keeps of the degrees of freedom (p,) of its variances: nothing where all are
    infinite, a number where they are equal, else one for each of the parameters `names`."""
    if np.all(np.isinf(freedom)):
        return {}
    values = [float(f"{value:.6g}") for value in freedom]
    return {FREEDOM: values[0] if len(set(values)) == 1 else dict(zip(names, values, strict=True))}


def freedom_of(calibration: Calibration) -> Array:
    """(p,) degrees of freedom of the variances of its `parameter_names`; infinite where it does not say."""
    kept = calibration.provenance.get(FREEDOM)
    stated = [kept.get(name) if isinstance(kept, Mapping) else kept for name in calibration.parameter_names]
    return np.array([x if isinstance(x, int | float) and x > 0.0 else np.inf for x in stated], dtype=float)


def limits_95(parameters: ParameterSet, values: Array, deviations: Array, freedom: ArrayLike) -> Array:
    """(p, 2) confidence limits, cut at the physical bounds;  values, deviations, freedom : (p,), see `quantile_95`."""
    half = quantile_95(freedom) * deviations
    limits = values[:, None] + half[:, None] * np.array([-1.0, 1.0])
    return np.clip(limits, parameters.lower[:, None], parameters.upper[:, None])
