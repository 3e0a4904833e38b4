"""The best upper bound that is known for a problem, for one number of runs or many; and a bound that a plan beats.

What is known beforehand counts the less the more runs follow, so the bound depends on their number m. But the bounds of
`doe.bounds.certificate` ask of a matrix M and its gradient G nothing but g >= tr(G N) for all designs N, and

    max tr(G N) = (max_q tr(G B^T B) + tr(G K) / m) / (1 + k / m)

has the same maximum over postures for every m. So the certificate of one number of runs bounds all others too. It is
tight where it was made and loose by about the square of the change of log m elsewhere: certificates are added where the
lowest is far above the designs that are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from doe.bounds.certificate import ApproximateDesign, Bound
from doe.bounds.column_generation import column_generation, continuous_design, rough_design
from doe.bounds.continuous import ContinuousSet
from doe.bounds.planar_theorem import closed_form_bound
from doe.bounds.weights import POWERS
from doe.problem.postures import listed_candidates
from doe.problem.problem import DesignProblem, Stop, never
from identification import Array, JobError, information_matrix, single_thread

ROUGH = 1e-3  # the same for models of many parameters: some seconds instead of half a minute
LOOSE = 1e-3  # of efficiency: a bound this near to a design needs no certificate of its own


def best_known_bound(problem: DesignProblem, runs: int, stop: Stop = never) -> Bound | None:
    """The closed form if it applies and is tight, otherwise the lower of it and the numerical bound.

    None where the continuous problem cannot be solved; the bound over a list of choices is the relaxation's. Without a
    joint to choose, every plan has the same value. Where `stop` ends the search early the bound holds all the same.
    """
    closed = closed_form_bound(problem)
    if closed is not None and not problem.constraints and problem.choices is None:
        return closed
    if not problem.searched_joints:
        return Bound(problem.objective(np.tile(problem.lower, (runs, 1))), "continuous", rigorous=True)
    try:
        with single_thread():
            numerical = best_design(problem, runs, stop=stop).bound
    except (JobError, np.linalg.LinAlgError):  # the latter: information that is singular to rounding
        return closed
    return min((bound for bound in (closed, numerical) if bound is not None), key=lambda b: b.value, default=None)


def best_design(
    problem: DesignProblem, runs: int, *, also: Array | None = None, stop: Stop = never
) -> ApproximateDesign:
    """Over the choices, exact, within a percent with a prior over many effects, within 0.001 where many parameters are
    measured by one number a run; or over all postures within limits and constraints, of many parameters within the
    limits alone, which holds too. Where the choices are `sampled` the weights are on them and the bound is over all: a
    tangent holds for every design, given the largest sensitivity, here of a multistart.

    also : (k, n) postures that a search over all must start from;  stop : asked now and then
    """
    many = problem.many_parameters
    if problem.choices is None:
        free, gap = (replace(problem, constraints=()), ROUGH) if many else (problem, 1e-8)
        return continuous_design(free, runs=runs, tolerance=gap, proof=gap, also=also, stop=stop)
    candidates = listed_candidates(problem, problem.choices)
    if problem.missing and problem.criterion.name in POWERS:
        listed = rough_design(problem, candidates, runs=runs, stop=stop)
    else:
        rough = many and problem.model.dimension == 1  # one number a run: weights hardly settle
        options = {"tolerance": ROUGH} if rough else {}
        listed = column_generation(problem, candidates, runs=runs, stop=stop, **options)
    if not problem.sampled or listed.bound is None or stop():
        return listed
    starts = np.concatenate([listed.plan.postures[:64], *([] if also is None else [also])])  # those of most weight
    everything = ContinuousSet(replace(problem, choices=None, sampled=False), listed.prior)
    largest = max(listed.largest, float(everything.best(listed.gradient, starts, stop=stop)[1][0]))
    return listed if stop() else replace(listed, largest=largest, candidates=None, rigorous=False)


def bound_that_holds(
    problem: DesignProblem, bound: Bound | None, postures: Array, value: float, stop: Stop = never
) -> Bound | None:
    """The bound, unless a plan (m, n) with this value beats it: then one that its postures helped to find, or None.

    A numerical bound rests on the largest sensitivity that a search found. A better plan proves that the search missed
    a posture, and one of the plan's own has a greater sensitivity (the criterion is concave).
    """
    if bound is None or not _beats(value, bound):
        return bound
    try:
        again = best_design(problem, len(postures), also=postures, stop=stop).bound
    except JobError:
        return None
    return None if again is None or _beats(value, again) else again


def _beats(value: float, bound: Bound) -> bool:
    return value > bound.value + 1e-8 * max(1.0, abs(bound.value))  # more than rounding


# -- many numbers of runs ----------------------------------------------------------------------------------------------
def bounds_of_runs(problem: DesignProblem, runs: Sequence[int], stop: Stop = never) -> dict[int, Bound | None]:
    """Number of runs -> bound, None where none was found; looser ones where `stop` ended the search early.

    Certificates are of the most runs, the fewest, and of numbers in between, until bounds are near to designs all the
    way.
    """
    if problem.prior.empty and problem.searched_joints:
        return dict.fromkeys(runs, best_known_bound(problem, runs[0], stop))
    if problem.criterion.name == "E" or not problem.searched_joints:  # gradients of its own dual program
        return {m: best_known_bound(problem, m, stop) for m in runs}
    fewest, most = min(runs), max(runs)
    try:
        made = [EveryRunCertificate.of(problem, most, stop=stop)]
        waiting = [(fewest, most)] if fewest < most else []
        if waiting and not stop():
            made.append(EveryRunCertificate.of(problem, fewest, made[0].postures, stop))
        while waiting and not stop():
            low, high = waiting.pop(0)
            middle = round(float(np.sqrt(low * high)))
            values, uppers = zip(*(one.at(problem, middle) for one in made), strict=True)
            efficiency = problem.criterion.efficiency(max(values), min(uppers), problem.parameters)
            if low < middle < high and efficiency < 1.0 - LOOSE:
                near = made[int(np.argmax(values))]
                made.append(EveryRunCertificate.of(problem, middle, near.postures, stop))
                waiting += [(low, middle), (middle, high)]
    except (JobError, np.linalg.LinAlgError):
        return dict.fromkeys(runs)
    lowest = {m: min((one.at(problem, m)[1], k) for k, one in enumerate(made)) for m in runs}
    return {m: replace(made[k].bound, value=value) for m, (value, k) in lowest.items()}


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
        optimum = best_design(problem, runs, also=also, stop=stop)
        if optimum.bound is None:
            raise JobError(f"bound: {optimum.status.name}, gap {optimum.gap:.2g}; {optimum.status.value}")
        prior, plan = problem.prior.per_new_run(runs), optimum.plan
        largest = (optimum.level + max(optimum.gap, 0.0)) / prior.new_fraction - np.sum(optimum.gradient * prior.total)
        new = information_matrix(problem.scaled_jacobians(plan.postures), plan.shares)
        return cls(plan.postures, new, optimum.information, optimum.gradient, float(largest), optimum.bound)

    def at(self, problem: DesignProblem, runs: int) -> tuple[float, float]:
        """Value of the design, and upper bound, for another number of runs."""
        prior = problem.prior.per_new_run(runs)
        largest = float(prior.mixed(np.array(self.largest), self.gradient))
        upper = problem.criterion.upper_bound(self.information, largest)
        return float(problem.criterion.value(prior.information(self.new))), upper
