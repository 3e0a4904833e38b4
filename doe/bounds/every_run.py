"""Upper bounds for many numbers of runs at once: the certificate of one number of runs bounds all others too.

What is known beforehand counts the less the more runs follow, so the bound depends on their number m. But the bounds of
`doe.bounds.equivalence` ask of a matrix M and its gradient G nothing but g >= tr(G N) for all designs N, and

    max tr(G N) = (max_q tr(G B^T B) + tr(G K) / m) / (1 + k / m)

has the same maximum over postures for every m. The bound is tight where the certificate was made and loose by about the
square of the change of log m elsewhere: certificates are added where it is far above the designs that are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from doe.bounds.approximate_design import SparseDesign
from doe.bounds.best_known import best_design, best_known_bound
from doe.bounds.bound import Bound
from doe.problem.problem import DesignProblem, Stop, never
from identification.arrays import Array
from identification.errors import JobError
from identification.information import information_matrix

LOOSE = 1e-3  # of efficiency: a bound this near to a design needs no certificate of its own


@dataclass(frozen=True)
class EveryRunCertificate:
    """What a design for some number of runs proves of all numbers of them.

    postures : (k, n) with weight;  new : (p, p) weighted mean of B^T B;  information, gradient : (p, p) M and G
    largest : max tr(G B^T B) over the design space;  bound : for its own number of runs
    """

    postures: Array
    new: Array
    information: Array
    gradient: Array
    largest: float
    bound: Bound

    @classmethod
    def of(
        cls, problem: DesignProblem, runs: int, also: Array | None = None, stop: Stop = never
    ) -> EveryRunCertificate:
        """Of the optimal design. Raises `JobError` where it was not reached."""
        found = best_design(problem, runs, also=also, stop=stop)
        if found.bound is None:
            raise JobError(f"bound: {found.status.name}, gap {found.gap:.2g}; {found.status.value}")
        prior = problem.prior.per_new_run(runs)
        design = SparseDesign(problem, prior, found.plan)
        largest = (design.level + max(found.gap, 0.0)) / prior.new_fraction - np.sum(design.gradient * prior.total)
        new = information_matrix(problem.scaled_jacobians(found.plan.postures), found.plan.shares)
        return cls(found.plan.postures, new, design.information, design.gradient, float(largest), found.bound)

    def at(self, problem: DesignProblem, runs: int) -> tuple[float, float]:
        """Value of the design, and upper bound, for another number of runs."""
        prior = problem.prior.per_new_run(runs)
        largest = float(prior.mixed(np.array(self.largest), self.gradient))
        upper = problem.criterion.upper_bound(self.information, largest)
        return float(problem.criterion.value(prior.information(self.new))), upper


def bounds_of_runs(problem: DesignProblem, runs: Sequence[int], stop: Stop = never) -> dict[int, Bound | None]:
    """Number of runs -> bound, None where none was found; looser ones where `stop` ended the search early."""
    if problem.prior.empty and problem.searched_joints:
        return dict.fromkeys(runs, best_known_bound(problem, runs[0], stop))
    if problem.criterion.name == "E" or not problem.searched_joints:  # gradients of its own dual program
        return {m: best_known_bound(problem, m, stop) for m in runs}
    try:
        made = certificates(problem, min(runs), max(runs), stop)
    except (JobError, np.linalg.LinAlgError):
        return dict.fromkeys(runs)
    return {m: lowest(problem, made, m) for m in runs}


def certificates(problem: DesignProblem, fewest: int, most: int, stop: Stop = never) -> list[EveryRunCertificate]:
    """Of the most runs, the fewest, and of numbers in between, until bounds are near to designs all the way."""
    made = [EveryRunCertificate.of(problem, most, stop=stop)]
    waiting = [(fewest, most)] if fewest < most else []
    if waiting and not stop():
        made.append(EveryRunCertificate.of(problem, fewest, made[0].postures, stop))
    while waiting and not stop():
        low, high = waiting.pop(0)
        middle = round(float(np.sqrt(low * high)))
        value, upper = max(c.at(problem, middle)[0] for c in made), min(c.at(problem, middle)[1] for c in made)
        if low < middle < high and problem.criterion.efficiency(value, upper, problem.parameters) < 1.0 - LOOSE:
            near = max(made, key=lambda c: c.at(problem, middle)[0])
            made.append(EveryRunCertificate.of(problem, middle, near.postures, stop))
            waiting += [(low, middle), (middle, high)]
    return made


def lowest(problem: DesignProblem, made: Sequence[EveryRunCertificate], runs: int) -> Bound:
    """The bound for so many runs: the lowest of all certificates'."""
    value, best = min((c.at(problem, runs)[1], k) for k, c in enumerate(made))
    return replace(made[best].bound, value=value)
