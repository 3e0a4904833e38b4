"""Test the named model on rows that were not used for the fits: does the gap shrink, and as far as predicted?

Rows of one posture or of one interval of time share errors that no model explains, so the standard error of a mean over
m rows exceeds sigma / sqrt(m). The rows are divided into up to eight groups, by time and by region of posture, and the
group means are compared by Student's t (R. Ibragimov, U. K. Mueller, "t-statistic based correlation and heterogeneity
robust inference", 2010: valid for any dependence within groups). The larger variance of the two groupings is used, and
never less than that of white Gaussian noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from identification.arrays import Array

# reasons: identification/README.md, "Constants"
GROUPS = 8  # of rows that count as independent
LEVEL = 0.05  # convention: of each question, both sides together
POWER = 0.9  # convention: with which a gap of twice the predicted square must be seen

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

    def detects(self, size: float) -> bool:
        """Whether a test at `LEVEL` would detect a true mean of this size with power `POWER`."""
        if not self.variance < np.inf:
            return False
        quantiles = stdtrit(self.freedom, 1.0 - LEVEL / 2.0) + stdtrit(self.freedom, POWER)
        return bool(size >= quantiles * np.sqrt(self.variance))


def mean_of(values: Array, groupings: Sequence[Groups], least: float = 0.0) -> Mean:
    """Mean of (m,) values with the largest variance over the groupings, and at least the variance `least`."""
    found = max((_grouped(values, groups) for groups in groupings), key=lambda mean: mean.variance)
    return found._replace(variance=max(found.variance, least))


def _grouped(values: Array, groups: Groups) -> Mean:
    counts = np.bincount(groups)
    if len(counts) < 2:
        return Mean(float(np.mean(values)), np.inf, 1.0)
    means = np.bincount(groups, values) / counts
    return Mean(float(np.mean(values)), float(np.var(means, ddof=1) / len(means)), len(means) - 1.0)


def groupings(postures: Array, repeats: Groups, time: Array) -> tuple[Groups, Groups]:
    """(m,) group of each row by interval of time, and by region of posture: up to `GROUPS` groups of equal size.

    postures : (m, n) [rad];  repeats : (m,) equal numbers mark repeats of one posture;  time : (m,)
    """
    sequence = np.argsort(time, kind="stable")
    stays = np.cumsum(np.diff(repeats[sequence], prepend=repeats[sequence[0]]) != 0)  # at one posture, from 0
    count, stretches = int(stays[-1]) + 1, np.empty(len(time), dtype=np.int64)
    sizes = np.cumsum(np.bincount(stays))
    ends = np.unique(np.searchsorted(sizes, np.arange(1, GROUPS) * len(time) / GROUPS))
    stretches[sequence] = np.searchsorted(ends, np.arange(count), side="left")[stays]
    first = np.unique(repeats, return_index=True)[1]
    return stretches, regions(postures[first])[np.unique(repeats, return_inverse=True)[1]]


def regions(postures: Array) -> Groups:
    """(m,) region of each posture, by repeated bisection at the median of the joint with the widest range."""
    found = np.zeros(len(postures), dtype=np.int64)
    for _ in range(min(int(np.log2(GROUPS)), int(np.log2(len(postures))))):
        halves = np.zeros_like(found)
        for region in np.unique(found):
            rows = np.flatnonzero(found == region)
            widest = int(np.argmax(np.ptp(postures[rows], axis=0)))
            upper = np.argsort(postures[rows, widest], kind="stable")[len(rows) // 2 :]
            halves[rows[upper]] = 1
        found = 2 * found + halves
    return np.asarray(np.unique(found, return_inverse=True)[1])


@dataclass(frozen=True)
class Confirmation:
    """Result of the test of the named model on rows that were not used for the fit.

    transfer : origin of these rows: `other postures`, `a later time`, `another session` ..
    by : `holdout` or `cross-validation`;  rows, groups : number of rows and of independent groups
    before, after : RMS distance [mm] of base and named model in these rows;  predicted : expected value of `after`
    p_shrinks, p_exceeds : one-sided p-values of "the gap does not shrink" and of "the gap is as predicted"
    shrinks, as_predicted : conclusions; None where the rows are too few
    named : False if no effect was named, so that no gap has to shrink
    file : that the rows come from, where only its order numbers tell that they are another session; else None
    refitted : what was fitted to these rows first, since they are of another set-up: `base`, `reflector C`
    largest_before, largest_after : distances [mm] of the row that is farthest off
    """

    transfer: str
    by: str
    rows: int
    groups: int
    before: float
    after: float
    predicted: float
    p_shrinks: float | None
    p_exceeds: float
    shrinks: bool | None
    as_predicted: bool | None
    named: bool = True
    file: str | None = None
    refitted: tuple[str, ...] = ()
    largest_before: float = np.nan
    largest_after: float = np.nan

    @property
    def where(self) -> str:
        """The rows in words."""
        return self.file or self.transfer

    @property
    def confirmed(self) -> bool | None:
        """Overall conclusion; None where the rows are too few."""
        if self.shrinks is False or self.as_predicted is False:
            return False
        return self.shrinks if self.named else self.as_predicted

    @property
    def answer(self) -> str:
        """The conclusion in words."""
        if self.confirmed is None:
            return f"too few rows to say whether it holds for {self.where}"
        if self.confirmed:
            few = f"the error shrinks for {self.where}; too few independent rows to say whether by as much as expected"
            return f"holds for {self.where}" if self.as_predicted else few
        if self.shrinks:
            return f"for {self.where} the gap shrinks, but by less than predicted"
        grows = ["the gap does not shrink"] if self.shrinks is False else []
        exceeds = ["the gap exceeds the prediction"] if self.as_predicted is False else []
        return f"does not hold for {self.where}, {' and '.join(grows + exceeds)}"

    def __str__(self) -> str:
        kind = "held-out" if self.by == "holdout" else "cross-validated"
        figures = f"{self.before:.4g} mm before, {self.after:.4g} mm after, {self.predicted:.4g} mm predicted"
        other = f"; another set-up, {' and '.join(self.refitted)} refitted to these rows" if self.refitted else ""
        return f"{self.answer}: {figures} ({self.rows} {kind} rows in {self.groups} independent groups{other})"

    def to_json(self) -> dict[str, object]:
        """An entry of `confirmation.tests` (identification/files/README.md, "JSON keys")."""
        lengths = {f"{name}_mm": getattr(self, name) for name in ("before", "after", "predicted")}
        names = (
            "transfer",
            "file",
            "by",
            "rows",
            "groups",
            "p_shrinks",
            "p_exceeds",
            "shrinks",
            "as_predicted",
            "confirmed",
        )
        more = {"max_before_mm": self.largest_before, "max_after_mm": self.largest_after, "refitted": [*self.refitted]}
        return {name: getattr(self, name) for name in names} | lengths | more


class HeldOut(NamedTuple):
    """Squared distances of base and named model in m rows that the fits did not use.

    before, after : (m,) [mm^2];  predicted : expected mean of `after`, with its uncertainty
    moved : (m,) squared distance between the two models [mm^2];  sigma : noise of one of the d coordinates [mm]
    refitted : what was fitted to these rows first, see `Confirmation`
    """

    before: Array
    after: Array
    predicted: Mean
    moved: Array
    sigma: float
    dimension: int
    refitted: tuple[str, ...] = ()


def confirm(
    rows: HeldOut,
    by_groups: Sequence[Groups],
    transfer: str,
    by: str = "holdout",
    level: float = LEVEL,
    named: bool = True,
) -> Confirmation:
    """Test whether the gap shrinks and whether it exceeds the prediction, each one-sided at half of `level`.

    by_groups : groupings of the rows, (m,) each;  transfer, by, named : as in `Confirmation`
    """
    m, variance = len(rows.after), rows.sigma**2
    gained = mean_of(rows.before - rows.after, by_groups, 4.0 * variance * float(np.mean(rows.moved)) / m)
    excess = mean_of(rows.after, by_groups, 2.0 * rows.dimension * variance**2 / m) - rows.predicted
    named = named and bool(np.any(rows.moved > 0.0))
    p_exceeds = excess.p_above()
    exceeds = p_exceeds <= level / 2.0
    return Confirmation(
        transfer,
        by,
        m,
        min(int(groups.max()) + 1 for groups in by_groups),
        float(np.sqrt(np.mean(rows.before))),
        float(np.sqrt(np.mean(rows.after))),
        float(np.sqrt(rows.predicted.value)),
        gained.p_above() if named else None,
        p_exceeds,
        shrinks(gained, rows, level) if named else None,
        False if exceeds else (True if excess.detects(rows.predicted.value) else None),
        named,
        largest_before=float(np.sqrt(rows.before.max())),
        largest_after=float(np.sqrt(rows.after.max())),
    )


def shrinks(gained: Mean, rows: HeldOut, level: float) -> bool | None:
    """Whether the gap shrinks; None where the rows are too few to say.

    gained : mean of `before` less `after`

    If the named model is right, the mean gain of m rows is normal with mean R = mean of `moved` and variance
    4 sigma^2 R / m. The absence of any gain then has probability Phi(-sqrt(m R) / 2 sigma); where that is below the
    level, a gain that is not positive refutes the model.
    """
    if gained.p_above() <= level / 2.0:
        return True
    if gained._replace(value=-gained.value).p_above() <= level / 2.0:
        return False
    sure = np.sqrt(np.sum(rows.moved)) > -2.0 * rows.sigma * ndtri(level / 2.0)
    return False if gained.value <= 0.0 and sure else None
