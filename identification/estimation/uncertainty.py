"""Covariance of estimates, rows that a model does not explain, and means of rows that are not independent.

The covariance is that of a sigma that the residuals do not contradict, of their scatter, or a clustered sandwich, CR2
with Satterthwaite's degrees of freedom (R. M. Bell, D. F. McCaffrey, 2002; J. E. Pustejovsky, E. Tipton, 2018): see
identification/README.md, "Covariance and intervals". With a prior, whose rows R are whitened as the Jacobian J is, the
estimates are those of the posterior's mode, B = (J^T J + R^T R)^-1, and the prior adds s^2 R^T R in the middle, s^2
being the variance of white noise: its part of the errors is as the prior says.

Means are compared over up to eight groups of rows, by time and by region of posture, by Student's t (R. Ibragimov,
U. K. Mueller, "t-statistic based correlation and heterogeneity robust inference", 2010: valid for any dependence within
groups), with the larger variance of the two groupings, and never less than that of white Gaussian noise.
"""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import svd
from scipy.special import chdtrc, chdtri, fdtrc, gammaln, ndtri, pdtrc, stdtr, stdtrit

from identification.arm import FREEDOM
from identification.arrays import Array
from identification.estimation.problem import Problem
from identification.information import ALONE, PRODUCT_TOLERANCE, Spectrum, spectrum
from identification.kinematics.parameters import ParameterSet
from identification.measurements import Measurements

# reasons: identification/README.md, "Covariance and intervals"
LEVEL = 0.01  # of misfit that is said, of lack of fit and of serial correlation
# of rows that count as independent, and parts in cross-validation. Convention: the fewest that Ibragimov and Mueller
# advise, since groups must be long to be independent
GROUPS = 8
LEVEL_95 = 0.05  # a 95 % interval for each question
Groups = NDArray[np.int64]


# -- what the covariance relies on -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class WhiteRows:
    """What a fit leaves of m rows of d whitened coordinates, and the linear model about it.

    jacobian : (m, d, p);  residual : (m, d);  decomposed : of the Jacobian and the rows R of a prior
    rank : number of combinations estimated, with a prior by the data alone
    sequence : (m,) row numbers in the order of measurement
    postures, repeats : (m,) `Measurements.posture_numbers` and `repeat_numbers`, from 0
    pull : (p,) R^T R (center - values) of a prior
    """

    jacobian: Array
    residual: Array
    decomposed: Spectrum
    rank: float
    sequence: Groups
    postures: Groups
    repeats: Groups
    pull: Array | float = 0.0

    @classmethod
    def of(cls, problem: Problem, data: Measurements, parameters: Array) -> Self:
        """Of the rows of weight above zero, linear about parameters (p,)."""
        kept, prior, shape = problem.weights > 0.0, problem.prior_rows, problem.positions.shape[1:]
        residual, jacobian = problem.rows_about(parameters)
        decomposed = spectrum(jacobian, problem.model.scales, problem.tolerance, prior)
        rank = decomposed.determined(jacobian) if len(prior) else decomposed.rank
        rows = jacobian.reshape(*shape, -1)[kept], residual.reshape(shape)[kept]
        postures = np.unique(data.posture_numbers[kept], return_inverse=True)[1]
        repeats = np.unique(data.repeat_numbers[kept], return_inverse=True)[1]
        sequence = np.cumsum(kept)[data.sequence[kept[data.sequence]]] - 1
        pull = prior.T @ (prior @ (problem.prior_center - parameters))
        return cls(*rows, decomposed, rank, sequence, postures, repeats, pull)

    @cached_property
    def columns(self) -> Array:
        """(m, d, rank) Q = J @ root, where root @ root.T = (J^T J + R^T R)^-1."""
        return self.jacobian @ self.decomposed.root

    # (rank,) what columns of a prior's rows, orthonormal together with Q, times their residuals are
    moment = property(lambda self: self.decomposed.root.T @ (self.pull * np.ones(self.jacobian.shape[2])))
    freedom = property(lambda self: self.residual.size - self.rank)  # equations less combinations estimated
    squares = property(lambda self: float(np.sum(self.residual**2)))  # sum of squared whitened residuals

    @property
    def correlated(self) -> int:
        """Number of successive rows to be taken together: 1 where what they say of the parameters is uncorrelated.

        The lag-1 correlation of the scores Q_i^T r_i, with its standard error if their signs were random. The length is
        that of E. Carlstein (1986) for a first-order autoregression, m^(1/3) (2 rho / (1 - rho^2))^(2/3), and no less
        than leaves 40 stretches: Student's quantile is then within 4 % of the normal one.
        """
        scores = np.einsum("mdr,md->mr", self.columns, self.residual)[self.sequence]
        products = np.sum(scores[1:] * scores[:-1], axis=1)
        error = float(np.sqrt(np.sum(products**2)))
        if error == 0.0 or products.sum() <= float(ndtri(1.0 - LEVEL)) * error:
            return 1
        rho, m = min(float(products.sum() / np.sum(scores**2)), 0.99), len(scores)
        return int(np.ceil(max(m ** (1.0 / 3.0) * (2.0 * rho / (1.0 - rho**2)) ** (2.0 / 3.0), m / 40)))

    @property
    def of_postures(self) -> tuple[float, float]:
        """Sum of squares of what the rows of each posture have in common, their sum over the root of their number; and
        its expectation if noise is white with variance one, the degrees of freedom."""
        share = 1.0 / np.sqrt(np.bincount(self.postures))[self.postures, None]
        columns = np.concatenate([self.residual[:, :, None], self.columns], axis=2) * share[:, :, None]
        sums = np.zeros((int(self.postures.max()) + 1, *columns.shape[1:]))
        np.add.at(sums, self.postures, columns)
        squares = np.sum(sums**2, axis=(0, 1))
        return float(squares[0]), float(sums[:, :, 0].size - squares[1:].sum())

    @property
    def inside(self) -> float:
        """Squared error expected of the fit at its own postures as a share of that at others drawn as they were.

        What the leverages l leave of 1, by their own weighted mean: sum l (1 - l) / sum l. They are those of postures,
        the eigenvalues of Q_g Q_g^T for the rows g of each (repeats and reflectors). Where all N are equal, 1 - p / N
        (G. H. Golub, M. Heath, G. Wahba, "Generalized cross-validation", 1979).
        """
        order, squares = np.argsort(self.postures, kind="stable"), 0.0
        columns, groups = self.columns[order], self.postures[order]
        for k in range(int(np.bincount(groups).max())):  # sum l^2 = |Q_g Q_g^T|^2, row by row with the k-th after it
            alike = groups[k:] == groups[: len(groups) - k]
            products = columns[k:][alike] @ np.swapaxes(columns[: len(columns) - k][alike], 1, 2)
            squares += (1.0 + (k > 0)) * float(np.sum(np.square(products)))
        share = 1.0 - squares / float(np.sum(np.square(self.columns))) if self.columns.any() else 1.0
        return max(share, np.finfo(float).eps)  # of no equation more than unknowns it is rounding


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
        what = "stretches of time" if self.clusters == "stretches" else self.clusters
        return {
            "given": "from the sigma given",
            "scatter": "from the scatter of the residuals",
            "sandwich": f"from the scatter, robust to what is left unexplained (sandwich over {self.count} {what})",
        }[self.kind]


def uncertainty(
    rows: WhiteRows,
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
    p, plain = float(chdtrc(rows.freedom, rows.squares)) if rows.freedom > 0 else None, rows.decomposed.covariance
    several = int(rows.postures.max()) + 1 < len(rows.postures)  # which share what is left unexplained there
    least, most = 0.1, 0.99  # p-values of chi2 between which intervals rely on the sigma that is given
    trusted = p is None or least <= p <= most if noise is None else noise == 1.0
    common, spare = rows.of_postures if several else (0.0, 0.0)
    if trusted and spare >= 1.0:
        trusted = float(chdtrc(spare, common)) >= least
    if sigma_given and (reliance == "given" or (reliance is None and trusted)):
        return Uncertainty("given", plain, np.full(len(plain), np.inf))
    variance = noise**2 if noise else rows.squares / rows.freedom if rows.freedom > 0 else np.nan
    freedom = rows.freedom if noise is None else max(rows.freedom, 1.0)
    if reliance is None and p is not None:
        misfit = doubtful or (sigma_given and p < least and noise is None)
        asked = several or not (sigma_given and p > most)
        if asked and (robust := _robust(rows, misfit, several, variance)) is not None:
            return robust
        # too few postures for a sandwich: what their rows have in common, as one row each
        if spare >= 1.0 and common / spare > variance:
            variance, freedom = common / spare, spare
    return Uncertainty("scatter", variance * plain, np.full(len(plain), float(freedom)))


def _robust(rows: WhiteRows, misfit: bool, several: bool, variance: float) -> Uncertainty | None:
    """The widest sandwich over rows, postures or, where rows are correlated in time, stretches of time; None with too
    few rows, where nothing asks for it, and where the rows determine no parameter;  variance : of white noise"""
    if not (root := rows.decomposed.root).shape[1]:
        return None
    # an active bound hides what is behind it, and residuals that the parameters could explain would count as misfit: so
    # those that the linear model leaves without bounds
    slope = np.einsum("mdr,md->r", rows.columns, rows.residual) + rows.moment
    rows = replace(rows, residual=rows.residual - rows.columns @ slope)
    length = rows.correlated
    if not (misfit or several or length > 1 or lack_of_fit(rows.residual, rows.repeats, rows.rank)[1] < LEVEL):
        return None
    kind, groups, candidates = "postures" if several else "rows", rows.postures, list[tuple[float, Uncertainty]]()
    plain = np.sum(root**2, axis=1)
    while True:
        made = sandwich(rows.jacobian, rows.residual, root, groups, variance)
        enough = made is not None and made[1].min() >= 2.0  # with fewer, Student's t has no variance
        if made is not None and enough:
            ratio = np.diag(made[0])[plain > 0.0] / plain[plain > 0.0]  # of the variances to those of white noise
            width = float(np.mean(np.log(np.maximum(ratio, np.finfo(float).tiny))))
            candidates.append((width, Uncertainty("sandwich", *made, kind, int(groups.max()) + 1)))
        if length <= 1 or (kind == "stretches" and enough):
            return max(candidates, key=lambda each: each[0])[1] if candidates else None
        # as many stretches of time of about so many successive rows as fit
        m, kind = len(rows.sequence), "stretches"
        groups, length = (np.arange(m) * max(m // length, 1) // m)[np.argsort(rows.sequence)], length // 2


def pure_error(residual: Array, repeats: Groups) -> tuple[float, int]:
    """Sum of squares of residuals (m, d) about the means of the rows with equal numbers (m,), and its degrees of
    freedom."""
    numbers, counts = np.unique(repeats, return_inverse=True, return_counts=True)[1:]
    means = np.stack([np.bincount(numbers, column) for column in residual.T], axis=1) / counts[:, None]
    return float(np.sum((residual - means[numbers]) ** 2)), residual.shape[1] * (len(residual) - len(counts))


def lack_of_fit(residual: Array, repeats: Groups, rank: float) -> tuple[float, float]:
    """F of the lack of fit against the scatter of repeats, and its p-value; 0 and 1 where too few are repeated;
    residual : (m, d) of a fit of this rank;  repeats : (m,) equal numbers mark repeats"""
    pure, freedom = pure_error(residual, repeats)
    fit_freedom = residual.size - freedom - rank
    if freedom < 1 or fit_freedom < 1 or pure == 0.0:
        return 0.0, 1.0
    ratio = max((float(np.sum(residual**2)) - pure) / fit_freedom / (pure / freedom), 0.0)
    return ratio, float(fdtrc(fit_freedom, freedom, ratio))


# -- the sandwich ------------------------------------------------------------------------------------------------------
def sandwich(
    jacobian: Array, residual: Array, root: Array, groups: Groups, variance: float = 1.0
) -> tuple[Array, Array] | None:
    """(p, p) covariance of least-squares estimates and (p,) degrees of freedom of each variance, infinite where it is
    zero by force; None where one group alone determines a combination of parameters.

    jacobian : (m, d, p) and residual : (m, d), whitened;  root : (p, rank), root @ root.T = (J^T J + R^T R)^-1
    groups : (m,) number of the group of each row, 0, 1, ...;  variance : of white noise, beside a prior
    """
    columns, adds = jacobian @ root, list[Array]()
    diagonals, lengths, turns = list[Array](), list[Array](), list[Array]()  # of groups as large as each other
    count = int(groups.max()) + 1
    for _, leverages, vectors, scores in decomposed_groups(columns, residual, groups):
        if leverages.max() > 1.0 - ALONE:
            return None
        factors = 1.0 / np.sqrt(1.0 - np.maximum(leverages, 0.0))
        adds.append(((factors * scores)[:, None, :] @ vectors)[:, 0])
        # 2 E^2 / var of the variance |P^T e|^2 of a parameter under white noise e of variance one,
        # P^T P = diag(d) - W W^T: d_g = |A_g Q_g a|^2 and W_g = Q_g^T A_g Q_g a, which is V_g w_g with orthonormal V_g
        turned = (root @ vectors.reshape(-1, root.shape[1]).T).reshape(len(root), *leverages.shape)
        weights = leverages * factors * turned  # (p, g, k)
        diagonals.append(np.sum(weights * factors * turned, axis=2))
        lengths.append(np.sum(weights**2, axis=2))
        if count <= 1000:  # of more groups what two of them share through the fit changes t by less than a third digit
            turns.append((weights[:, :, None, :] @ vectors)[:, :, 0])
    corrected = root @ np.concatenate(adds).T  # (p, G): what each group adds to the estimates
    held = np.eye(root.shape[1]) - np.einsum("mdr,mds->rs", columns, columns, optimize=True)  # R^T R; without it zero
    held = root @ held @ root.T
    diagonal, length = np.concatenate(diagonals, axis=1), np.concatenate(lengths, axis=1)  # (p, G)
    if turns:
        grams = (w.T @ w if w.shape[0] > w.shape[1] else w @ w.T for w in np.concatenate(turns, axis=1))
        squares = np.array([np.sum(np.square(gram)) for gram in grams])
    else:
        squares = np.sum(length**2, axis=1)
    first = np.sum(diagonal - length, axis=1) + np.maximum(np.diag(held), 0.0)
    second = np.sum(diagonal * (diagonal - 2.0 * length), axis=1) + squares
    freedom = np.where(second > 0.0, first**2 / np.where(second > 0.0, second, 1.0), np.inf)
    return corrected @ corrected.T + variance * held, freedom


def decomposed_groups(columns: Array, residual: Array, groups: Groups) -> Iterator[tuple[Groups, Array, Array, Array]]:
    """Of columns Q (m, d, r), Q_g^T Q_g = V diag(l) V^T: of the groups of each size their numbers (g,), (g, k) l,
    (g, k, r) V^T and (g, k) V^T Q_g^T r_g;  groups : (m,) number of each row's, from 0"""
    order, counts = np.argsort(groups, kind="stable"), np.bincount(groups)
    starts = np.cumsum(counts) - counts
    for size in np.unique(counts):
        of_size = np.flatnonzero(counts == size)
        rows = order[starts[of_size, None] + np.arange(size)]
        tall = columns[rows].reshape(len(of_size), -1, columns.shape[2])
        try:
            left, singular, right = np.linalg.svd(tall, full_matrices=False)
        except np.linalg.LinAlgError:  # divide and conquer does not always converge, as of UR10 rows on some processors
            each = (svd(one, full_matrices=False, lapack_driver="gesvd") for one in tall)
            left, singular, right = map(np.array, zip(*each, strict=True))
        projected = np.swapaxes(left, 1, 2) @ residual[rows].reshape(len(of_size), -1, 1)
        yield of_size, singular**2, right, singular * projected[:, :, 0]


# -- intervals ---------------------------------------------------------------------------------------------------------
def quantile_95(freedom: ArrayLike) -> Array:
    """Half the width of a 95 % interval in standard deviations for degrees of freedom of Student's t, from which a
    variance is estimated: infinite where it is known (the normal distribution), not a number where there are none."""
    dof = np.asarray(freedom, dtype=float)
    student = stdtrit(np.where(np.isfinite(dof) & (dof > 0.0), dof, 1.0), 0.975)
    return np.where(np.isposinf(dof), ndtri(0.975), np.where(dof > 0.0, student, np.nan))


def freedom_kept(names: Sequence[str], freedom: Array) -> dict[str, Any]:
    """What a calibration's provenance keeps of the degrees of freedom (p,) of its variances: nothing where all are
    infinite, a number where they are equal, else one for each of the parameters `names` where it is finite."""
    each = {n: float(f"{dof:.6g}") for n, dof in zip(names, freedom.tolist(), strict=True) if np.isfinite(dof)}
    equal = len(each) == len(names) and len(set(each.values())) == 1
    return {FREEDOM: each[names[0]] if equal else each} if each else {}


def limits_95(parameters: ParameterSet, values: Array, deviations: Array, freedom: ArrayLike) -> Array:
    """(p, 2) confidence limits, cut at the physical bounds;  values, deviations, freedom : (p,), see `quantile_95`."""
    limits = values[:, None] + (quantile_95(freedom) * deviations)[:, None] * np.array([-1.0, 1.0])
    return np.clip(limits, parameters.lower[:, None], parameters.upper[:, None])


# -- outliers ----------------------------------------------------------------------------------------------------------
def outlying(residual: Array, blocks: Array, moment: Array | float = 0.0) -> NDArray[np.bool_]:
    """(m,) rows whose residual (m, d), whitened, the model does not explain.

    The worst row is taken out and the linear model fitted again, until none is farther off than a limit: studentised
    squared residuals of d coordinates, over their robust scale, are chi-square with d degrees of freedom.

    blocks, moment : see `studentised`
    """
    m, d = residual.shape
    # as unlikely as 6 standard deviations in a plane: at most 3 in 10,000 clean data sets of 8 to 200 rows lose a row;
    # at 4 it would be 3 to 70 in 1,000, at 3 from 4 % to 89 %
    kept, limit = np.ones(m, dtype=bool), float(chdtri(d, chdtrc(2, 6.0**2)))
    fits, out = studentised(residual, blocks, moment), None
    while np.mean(kept) >= 0.75:  # derived: the robust scale is then 1.26 times too large; more is structure
        squares = fits.send(out)
        worst = np.argsort(squares)[-(1 + m // 1000) :]  # several at once only to save effort
        if squares[worst[-1]] <= limit:
            return ~kept
        out = worst[squares[worst] > limit]
        kept[out] = False
    return np.zeros(m, dtype=bool)


def left_out(columns: Array, values: Array, numbers: Groups, used: NDArray[np.bool_]) -> Array:
    """(m, d) values less those that a fit puts there to the rows of all other groups that are used.

    columns : (m, d, k) orthonormal in the rows used, together with rows of a prior around zero
    numbers : (m,) group of each row
    """
    own, (d, k) = columns * used[:, None, None], columns.shape[1:]
    left, counts = values - columns @ np.einsum("mdk,md->k", own, values), np.bincount(numbers)
    for size in np.unique(counts[counts > 0]).tolist():
        rows = np.flatnonzero(counts[numbers] == size)
        rows = rows[np.argsort(numbers[rows], kind="stable")]
        some, off = own[rows].reshape(-1, size * d, k), left[rows].reshape(-1, size * d, 1)
        if size * d <= k:  # either way is the same; matrices are smaller in one of them
            moved = some.mT @ np.linalg.solve((1.0 + 1e-9) * np.eye(size * d) - some @ some.mT, off)
        else:
            moved = np.linalg.solve((1.0 + 1e-9) * np.eye(k) - some.mT @ some, some.mT @ off)
        left[rows] += (columns[rows].reshape(-1, size * d, k) @ moved).reshape(-1, d)
    return left


def studentised(residual: Array, blocks: Array, moment: Array | float = 0.0) -> Generator[Array, Groups | None]:
    """Yields (m,) squared residuals of rows of residual (m, d) in units of their own covariance and of the robust scale
    of the kept rows, after a fit to these; 0 of the others. Rows whose numbers are sent are taken out.

    blocks : (m, d, k) columns that are orthonormal together with rows of a prior
    moment : (k,) of these rows, times their residuals; 0: no prior
    """
    (m, d, k), kept = blocks.shape, np.ones(len(residual), dtype=bool)
    inverse, moment = np.eye(k), np.einsum("mdk,md->k", blocks, residual) + moment
    rest = (1.0 + 1e-6) * np.eye(d) - blocks @ blocks.transpose(0, 2, 1)
    while True:
        off, squares = (residual - blocks @ (inverse @ moment))[kept], np.zeros(m)
        each = np.einsum("mi,mi->m", off, np.linalg.solve(rest[kept], off[..., None])[..., 0])
        squares[kept] = each / max(np.median(each) / chdtri(d, 0.5), 1e-300)  # the median of chi-square is kept
        out = yield squares
        # all rows together are orthonormal: of the normal matrix the part of some is taken off (M. A. Woodbury, 1950)
        kept[out], lost = False, blocks[out].reshape(-1, k)
        taken = inverse @ lost.T
        left, turns = np.linalg.eigh(np.eye(len(lost)) - lost @ taken)  # 0 where no other row says anything
        gain = (turns / np.where(left > PRODUCT_TOLERANCE, left, np.inf)) @ turns.T
        moved = blocks @ taken
        rest, inverse = rest - moved @ gain @ moved.transpose(0, 2, 1), inverse + taken @ gain @ taken.T
        moment = moment - residual[out].reshape(-1) @ lost


def together(outlier: NDArray[np.bool_], postures: Array, numbers: Groups) -> NDArray[np.bool_]:
    """(m,) those of the outliers that come together, as rows that are wrong by accident do not.

    If as many outliers fall on rows independently of each other, their number in a group of rows is hypergeometric, and
    the number of groups with x or more of them about Poisson (a little wider than it is, since groups compete for the
    outliers). Groups are the rows of one posture (reflectors, repeats), and the postures in a stretch of a joint's
    angles, with an outlier or without; x is 2, 3, 5, 9 .. Of data sets whose outliers are independent 1 in 1,000 may be
    called structure; postures and stretches have half of that each, and their p-values Bonferroni's correction. One
    posture alone is none: a joint that was misread is wrong in all rows of it.

    outlier : (m,) rows that a fit does not explain;  postures : (m, n);  numbers : (m,) posture of each row
    """
    if not outlier.any():
        return outlier
    _, first, posture = np.unique(numbers, return_index=True, return_inverse=True)
    of_posture = np.bincount(posture, outlier) > 0.0
    # up to 16, of eight rows or more: effects of a narrower part of a joint's angles are rare
    parts = max(min(16, len(first) // 8), 1)
    ranks = [np.argsort(np.argsort(angles, kind="stable")) for angles in postures[first].T]
    alike = [np.zeros(len(outlier), dtype=bool)]
    several = np.count_nonzero(np.bincount(posture, outlier) > 1.0) > 1
    for wrong, groupings_of, to_rows in (
        (outlier, [posture] if several else [], np.arange(len(outlier))),
        (of_posture, [rank * parts // len(first) for rank in ranks], posture),
    ):
        crowds = []
        for groups in groupings_of:
            sizes, wrong_in_group, x = np.bincount(groups), np.bincount(groups, wrong), 2
            while x <= wrong_in_group.max():
                few = np.arange(x)[:, None]
                chances = log_choose(wrong.sum(), few) + log_choose(len(wrong) - wrong.sum(), sizes - few)
                fewer = np.sum(np.exp(chances - log_choose(len(wrong), sizes)), axis=0)
                expected = float(np.sum(np.maximum(1.0 - fewer, 0.0)))
                crowds.append((pdtrc(np.sum(wrong_in_group >= x) - 1, expected), (wrong_in_group >= x)[groups]))
                x = 2 * x - 1
        alike += [rows[to_rows] for p, rows in crowds if p <= 0.5e-3 / len(crowds)]
    return np.any(alike, axis=0) & outlier


def log_choose(many: ArrayLike, few: ArrayLike) -> Array:
    """Log of the number of ways to choose a few of many, -inf where there is none."""
    return np.asarray(gammaln(np.add(many, 1.0)) - gammaln(np.add(few, 1.0)) - gammaln(np.subtract(many, few) + 1.0))


# -- means of rows that are not independent ----------------------------------------------------------------------------
class Mean(NamedTuple):
    """A mean, the variance of this mean, and the degrees of freedom of that variance."""

    value: float
    variance: float
    freedom: float

    def __sub__(self, other: Self) -> Self:
        """Difference of two independent means, with Welch's degrees of freedom (B. L. Welch, 1947)."""
        variance = self.variance + other.variance
        parts = sum(m.variance**2 / m.freedom for m in (self, other) if m.variance < np.inf)
        freedom = variance**2 / parts if parts > 0.0 and variance < np.inf else min(self.freedom, other.freedom)
        return type(self)(self.value - other.value, variance, freedom)

    def p_above(self) -> float:
        """One-sided p-value: probability of a mean at least this large if the true mean is zero."""
        if not 0.0 < self.variance < np.inf:
            return 1.0 if self.variance else float(self.value <= 0.0)
        return float(stdtr(self.freedom, -self.value / np.sqrt(self.variance)))


def mean_of(values: Array, groupings: Sequence[Groups], least: float = 0.0) -> Mean:
    """Mean of (m,) values with the largest variance over the groupings, and at least the variance `least`."""
    each = []
    for groups in groupings:
        means = np.bincount(groups, values) / np.bincount(groups)
        variance = float(np.var(means, ddof=1) / len(means)) if len(means) > 1 else np.inf
        each.append(Mean(float(np.mean(values)), variance, max(len(means) - 1.0, 1.0)))
    widest = max(each, key=lambda mean: mean.variance)
    return widest._replace(variance=max(widest.variance, least))


def groups_of(measurements: Measurements, kept: NDArray[np.bool_] | None = None) -> tuple[Groups, Groups]:
    """Of the kept rows (None: all) those that count as independent: (m,) group of each by interval of time, and by
    region of posture (repeated bisection at the median of the joint with the widest range): up to `GROUPS` groups of
    equal size."""
    rows = np.ones(len(measurements), dtype=bool) if kept is None else kept
    postures, repeats = measurements.postures[rows], measurements.posture_numbers[rows]
    sequence = np.cumsum(rows)[measurements.sequence[rows[measurements.sequence]]] - 1
    stays = np.cumsum(np.diff(repeats[sequence], prepend=repeats[sequence[0]]) != 0)  # at one posture, from 0
    ends = np.unique(np.searchsorted(np.cumsum(np.bincount(stays)), np.arange(1, GROUPS) * len(stays) / GROUPS))
    intervals = np.empty(len(stays), dtype=np.int64)
    intervals[sequence] = np.searchsorted(ends, stays, side="left")
    _, first, number = np.unique(repeats, return_index=True, return_inverse=True)
    q, regions = postures[first], np.zeros(len(first), dtype=np.int64)
    for _ in range(int(np.log2(min(GROUPS, len(q))))):
        halves = np.zeros_like(regions)
        for region in np.unique(regions):
            rows = np.flatnonzero(regions == region)
            widest = int(np.argmax(np.ptp(q[rows], axis=0)))
            halves[rows[np.argsort(q[rows, widest], kind="stable")[len(rows) // 2 :]]] = 1
        regions = 2 * regions + halves
    return intervals, np.unique(regions, return_inverse=True)[1][number]


def chance_of_gain(before: Array, after: Array, measurements: Measurements, fitted: int = 0) -> float:
    """One-sided p-value of the squares that a model saves in these rows, as a share of what it and the other leave in
    each group: of squares themselves, which differ tenfold between rows, Student's t sees little.

    before, after : (m,) distances [mm];  fitted : numbers that were fitted to these rows in both, which make what is
        left of few rows alike: 1 where less than two whole rows are left
    """
    chances = [float(measurements.positions.size - fitted < 2 * measurements.dimension)]
    for groups in groups_of(measurements):
        was, left = (np.bincount(groups, distance**2) for distance in (before, after))
        shares = (was - left) / np.maximum(was + left, np.finfo(float).tiny)
        chances.append(mean_of(shares, (np.arange(len(shares)),)).p_above())
    return max(chances)
