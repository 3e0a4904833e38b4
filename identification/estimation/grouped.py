"""Means of rows that are not independent, and what a model gains by them.

Rows of one posture or of one interval of time share errors that no model explains, so the standard error of a mean over
m rows exceeds sigma / sqrt(m). The rows are divided into up to eight groups, by time and by region of posture, and the
group means are compared by Student's t (R. Ibragimov, U. K. Mueller, "t-statistic based correlation and heterogeneity
robust inference", 2010: valid for any dependence within groups). The larger variance of the two groupings is used, and
never less than that of white Gaussian noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from identification.arrays import Array
from identification.measurements import Measurements

# of rows that count as independent, and parts in cross-validation. Convention: the fewest that Ibragimov and Mueller
# advise, since groups must be long to be independent
GROUPS = 8
LEVEL = 0.05  # a 95 % interval for each question

Groups = NDArray[np.int64]


class Mean(NamedTuple):
    """A mean, the variance of this mean, and the degrees of freedom of that variance."""

    value: float
    variance: float
    freedom: float

    def __sub__(self, other: Mean) -> Mean:
        """Difference of two independent means, with Welch's degrees of freedom (B. L. Welch, 1947)."""
        variance = self.variance + other.variance
        parts = sum(m.variance**2 / m.freedom for m in (self, other) if m.variance < np.inf)
        freedom = variance**2 / parts if parts > 0.0 and variance < np.inf else min(self.freedom, other.freedom)
        return Mean(self.value - other.value, variance, freedom)

    def p_above(self) -> float:
        """One-sided p-value: probability of a mean at least this large if the true mean is zero."""
        if not 0.0 < self.variance < np.inf:
            return 1.0 if self.variance else float(self.value <= 0.0)
        return float(stdtr(self.freedom, -self.value / np.sqrt(self.variance)))


def mean_of(values: Array, groupings: Sequence[Groups], least: float = 0.0) -> Mean:
    """Mean of (m,) values with the largest variance over the groupings, and at least the variance `least`."""
    each = []
    for groups in groupings:
        counts = np.bincount(groups)
        means = np.bincount(groups, values) / counts
        variance = float(np.var(means, ddof=1) / len(means)) if len(means) > 1 else np.inf
        each.append(Mean(float(np.mean(values)), variance, max(len(means) - 1.0, 1.0)))
    widest = max(each, key=lambda mean: mean.variance)
    return widest._replace(variance=max(widest.variance, least))


def groups_of(measurements: Measurements, kept: NDArray[np.bool_] | None = None) -> tuple[Groups, Groups]:
    """Groups of rows that count as independent, among the kept rows (None: all): see `groupings`."""
    turn = np.empty(len(measurements))
    turn[measurements.sequence] = np.arange(len(measurements))
    rows = np.ones(len(turn), dtype=bool) if kept is None else kept
    return groupings(measurements.postures[rows], measurements.posture_numbers[rows], turn[rows])


def groupings(postures: Array, repeats: Groups, time: Array) -> tuple[Groups, Groups]:
    """(m,) group of each row by interval of time, and by region of posture: up to `GROUPS` groups of equal size.

    postures : (m, n) [rad];  repeats : (m,) equal numbers mark repeats of one posture;  time : (m,)
    """
    sequence = np.argsort(time, kind="stable")
    stays = np.cumsum(np.diff(repeats[sequence], prepend=repeats[sequence[0]]) != 0)  # at one posture, from 0
    ends = np.unique(np.searchsorted(np.cumsum(np.bincount(stays)), np.arange(1, GROUPS) * len(time) / GROUPS))
    stretches = np.empty(len(time), dtype=np.int64)
    stretches[sequence] = np.searchsorted(ends, stays, side="left")
    _, first, number = np.unique(repeats, return_index=True, return_inverse=True)
    return stretches, regions(postures[first])[number]


def regions(postures: Array) -> Groups:
    """(m,) region of each posture, by repeated bisection at the median of the joint with the widest range."""
    numbers = np.zeros(len(postures), dtype=np.int64)
    for _ in range(int(np.log2(min(GROUPS, len(postures))))):
        halves = np.zeros_like(numbers)
        for region in np.unique(numbers):
            rows = np.flatnonzero(numbers == region)
            widest = int(np.argmax(np.ptp(postures[rows], axis=0)))
            halves[rows[np.argsort(postures[rows, widest], kind="stable")[len(rows) // 2 :]]] = 1
        numbers = 2 * numbers + halves
    return np.asarray(np.unique(numbers, return_inverse=True)[1])


def gained_squares(before: Array, after: Array, measurements: Measurements) -> Mean:
    """Mean of the squares that a model saves in these rows;  before, after : (m,) distances [mm]"""
    return mean_of(before**2 - after**2, groups_of(measurements))
