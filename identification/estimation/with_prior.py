"""Least squares with a normal prior of some parameters, against noise that the data may show to be larger than sigma.

The minimum is the mode of the posterior. What the noise amounts to decides how far the data may move what has a prior:
it is the variance of the largest marginal likelihood, the parameters without a prior integrated out (restricted maximum
likelihood, H. D. Patterson, R. Thompson 1971), and no less than a sigma that is given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import Machining
from identification.arrays import Array
from identification.estimation.checks import Noise, check_measurements, weighting
from identification.estimation.contradictions import with_contradictions
from identification.estimation.levenberg_marquardt import ITERATIONS, Index, LeastSquares, Solution, levenberg_marquardt
from identification.estimation.methods import starts
from identification.estimation.outcome import Spread, identification
from identification.estimation.prior import Prior, effective_count
from identification.estimation.problem import Problem
from identification.estimation.restricted_likelihood import LARGEST, Restricted
from identification.estimation.result import Identification
from identification.estimation.uncertainty import Uncertainty
from identification.information import spectrum
from identification.inspection.readings import placed_with_zeros
from identification.kinematics.parameters import JOINT_OFFSET
from identification.measurements import Measurements
from identification.model import Model
from identification.status import Status
from identification.threads import single_thread

FIRST = 2  # steps before the noise is estimated again: the model is nearly linear
ROUNDS = 10  # of fit and noise: the model is nearly linear, so that the second changes little
STEADY = 1e-4  # relative change of the noise, far below its own uncertainty
WIDTHS = tuple(2.0**k for k in range(6))  # factors on the machining's sizes; the likelihood is flat over a step
ZERO_WIDTHS = (1.0, 4.0, 16.0, 64.0)  # of joint zeros besides, which are set by hand: to 32 deg
TOGETHER = tuple(2.0**k for k in range(7))  # settings of an effect at once; the likelihood is flat over a step
UNUSUAL = 8.0  # times the machining's sizes, from which a mistake is likelier than such an arm
CREDIBLE = 4.0  # difference of -2 log likelihood from the sizes as stated: chi2 of one degree of freedom, 5 %
ENOUGH = 3000  # equations: of more, rows show the same misfits again, and widths are chosen as from so many


class Widths(NamedTuple):
    """What the likelihood says of the sizes of a prior.

    machining : factor on those of the machining;  zeros : one more on those of joint zeros
    together : how many settings of an effect are there at once (`Prior.alternatives`)
    """

    machining: float = 1.0
    zeros: float = 1.0
    together: float = 1.0


AS_STATED = Widths()


@single_thread()
def estimate_with_prior(
    model: Model,
    measurements: Measurements,
    prior: Prior,
    sigma: ArrayLike | Literal["given", "estimated"] | None = None,
    weights: ArrayLike | None = None,
) -> Identification:
    """Estimates of all parameters, those with a prior as far as the data move them, with intervals of the posterior.

    model, measurements, weights : as of `estimate`
    sigma : numbers or "given": the noise is what is given; "estimated": of the largest marginal likelihood; left out:
        the latter, but no less than what is given

    The sizes of the machining are those of the model or, where the data say that the arm is farther from its drawing,
    a common multiple of them, and one of the joint zeros', likeliest together with the noise; `doubts` say so.

    Raises `InputError` for data that do not fit the model, and fewer equations than parameters without a prior.
    """
    model, zeros = placed_with_zeros(model, measurements)
    prior = replace(prior, deviations={**model.prior, **prior.deviations})
    check_measurements(model, measurements, prior)
    noise = weighting(model, measurements, sigma, weights)
    whole = replace(Problem.of(model, measurements, noise.weights), prior=prior)
    problem, solution, widths, jacobian = _solved(whole, noise, zeros)
    parameters = solution.parameters[0]
    decomposed = spectrum(np.concatenate([jacobian, problem.prior_rows]), model.scales, problem.tolerance)
    effective = effective_count(jacobian, problem.prior_rows)
    dof = round(model.dimension * np.count_nonzero(problem.weights) - effective)
    made = _uncertainty(problem, decomposed.covariance, float(dof), noise)
    spread = Spread(made, problem.noise * (noise.sigma or 1.0), float(problem.squares(parameters)[0]), dof)
    found = identification(problem, measurements, "gauss_newton", solution, decomposed, noise, spread)
    found = replace(found, prior=problem.prior, machining_factor=widths.machining if model.prior else None)
    found = replace(found, doubts=(*found.doubts, *far_from_drawing(model.arm.machining, widths)))
    if prior.earlier is None:
        return found

    def again(known: Mapping[str, float]) -> Identification:
        held = replace(model, known={**model.fixed, **known})
        return estimate_with_prior(held, measurements, replace(prior, earlier=None), sigma, weights)

    return with_contradictions(found, problem, noise, again)


def far_from_drawing(machining: Machining, widths: Widths) -> list[str]:
    """What is doubtful about an arm whose errors are so many times those of its machining."""
    rotation = f"{np.degrees(machining.rotation):g} deg"
    width, zeros, sizes = widths.machining, widths.zeros, f"{machining.translation:g} mm and {rotation}"
    ask = "; are units, order and signs of joints and coordinates right? armcal check tells" if width >= UNUSUAL else ""
    said = f"the arm is farther from its drawing than [machining] says ({sizes}): taken {width:g} times as large{ask}"
    why = f"taken as {width * zeros:g} times as large, as where a motor was changed or a drawing counts from elsewhere"
    of_zeros = f"zeros of joints are farther from the drawing than [machining] says ({rotation}): {why}"
    return [sentence for factor, sentence in ((width, said), (zeros, of_zeros)) if factor != 1.0]


def _solved(problem: Problem, noise: Noise, zeros: Mapping[str, float]) -> tuple[Problem, Solution, Widths, Array]:
    """The problem with the noise that was found, its solution, the widths of the machining's sizes, and the Jacobian
    without the prior; in turns until the noise stays.

    zeros : parameters to start from elsewhere than at the best known values
    """
    given, linearized = noise.reliance == "given", _Linearizations(replace(problem, prior=None))

    def solved(at: Array, most: int) -> tuple[Problem, Solution, Widths]:
        scale, widths = likeliest(LinearizedProblem.of(problem, at, *linearized.at(at)), noise, given)
        found = replace(problem, noise=scale, prior=widened(problem, widths))
        return found, levenberg_marquardt(replace(linearized.with_prior(found), iterations=most), at[None]), widths

    parameters = problem.model.parameters
    elsewhere, values = [p.name in zeros for p in parameters], parameters.vector(zeros, default=0.0)
    start = np.where(elsewhere, values, starts(problem)[0])
    found, solution, widths = solved(start, ITERATIONS if given else FIRST)
    most = ITERATIONS
    for _ in range(0 if given else ROUNDS):
        before, steps = found.noise, solution.iterations
        found, solution, widths = solved(solution.parameters[0], most)
        solution = replace(solution, iterations=solution.iterations + steps)
        if most == 0 or abs(found.noise - before) <= STEADY * before:
            break
        most = 0 if solution.status[0] is Status.iteration_limit else ITERATIONS  # the noise there, no further steps
    return found, solution, widths, linearized.at(solution.parameters[0])[1]


@dataclass
class _Linearizations:
    """Triangles of a problem without its prior, each made once: fits of other noise pass through the same points."""

    problem: Problem
    known: dict[bytes, tuple[Array, Array]] = field(default_factory=dict)

    def at(self, x: Array) -> tuple[Array, Array]:
        """(N,) residuals and (N, p) Jacobian at x (p,)."""
        if (key := x.tobytes()) not in self.known:
            residuals, jacobians = self.problem.least_squares.linearize(x[None], np.arange(1))
            self.known[key] = residuals[0], jacobians[0]
        return self.known[key]

    def with_prior(self, problem: Problem) -> LeastSquares:
        """The same problem with the prior."""
        rows = problem.prior_rows

        def linearize(x: Array, _: Index) -> tuple[Array, Array]:
            residual, jacobian = self.at(x[0])
            left = rows @ (problem.prior_center - x[0])
            return np.concatenate([residual, left])[None], np.concatenate([jacobian, rows])[None]

        return replace(problem.least_squares, linearize=linearize)


def _uncertainty(problem: Problem, covariance: Array, dof: float, noise: Noise) -> Uncertainty:
    """`given` where the noise is sigma; else `scatter`, with Student's t."""
    given = noise.sigma is not None and problem.noise == 1.0
    freedom = np.full(len(covariance), np.inf if given else max(dof, 1.0))
    return Uncertainty("given" if given else "scatter", problem.noise**2 * covariance, freedom)


class LinearizedProblem(NamedTuple):
    """A problem without its prior, linear about values x of its parameters, in as few rows as say the same.

    target : (N,) weighted residuals if all parameters with a prior were at its center;  jacobian : (N, p)
    equations : of the data;  factor : (p, r) of the prior's covariance, see `Prior.factor`
    machined : (p,) those with the prior of the machining;  zeros : (p,) joint offsets among them
    alternatives : (p,) settings that their effect may have, 1 where it has but one
    """

    target: Array
    jacobian: Array
    equations: int
    factor: Array
    machined: NDArray[np.bool_]
    zeros: NDArray[np.bool_]
    alternatives: Array

    @classmethod
    def of(cls, problem: Problem, x: Array, residual: Array, jacobian: Array) -> LinearizedProblem:
        """About x (p,), where the problem without its prior has these residuals (N,) and this Jacobian (N, p)."""
        parameters, prior = problem.model.parameters, problem.prior
        factor = np.zeros((len(parameters), 0)) if prior is None else prior.factor(parameters)
        target = residual + jacobian @ np.where(factor.any(axis=1), x - problem.prior_center, 0.0)
        equations = problem.model.dimension * int(np.count_nonzero(problem.weights))
        own = {} if prior is None else problem.model.prior.keys() & prior.deviations.keys()
        machined = np.array([name in own for name in parameters.names])
        zeros = machined & np.array([p.kind == JOINT_OFFSET for p in parameters])
        alternatives = parameters.vector({} if prior is None else prior.alternatives, default=1.0)
        return cls(target, jacobian, equations, factor, machined, zeros, alternatives)

    def sizes(self, widths: Widths) -> Array:
        """(p,) factors on the deviations of the prior."""
        machined = np.where(self.zeros, widths.zeros, 1.0) * np.where(self.machined, widths.machining, 1.0)
        return np.asarray(machined * np.sqrt(np.minimum(widths.together, self.alternatives)))

    @property
    def spare(self) -> int:
        """Equations that are left over by the parameters without a prior."""
        return self.equations - self.free.shape[1]

    @property
    def free(self) -> Array:
        """(N, f) columns without a prior."""
        return self.jacobian[:, ~self.factor.any(axis=1)]

    @property
    def scatter(self) -> float:
        """Of a fit of the parameters without a prior alone."""
        left = self.target - self.free @ np.linalg.lstsq(self.free, self.target, rcond=None)[0]
        return max(float(np.linalg.norm(left)) / np.sqrt(max(self.spare, 1)), 1e-12)


def likeliest(problem: LinearizedProblem, noise: Noise, given: bool) -> tuple[float, Widths]:
    """Noise, no less than a given one (`given`: that one), and the widths of the prior of the largest likelihood."""
    unit = 1.0 if (known := noise.sigma is not None) or given else problem.scatter
    if problem.spare == 0:
        return unit, AS_STATED
    basis = np.linalg.qr(problem.free)[0]
    target, jacobian = (a - basis @ (basis.T @ a) for a in (problem.target, problem.jacobian))

    alike = bool(problem.machined[problem.factor.any(axis=1)].all())  # their sizes have one factor

    @cache
    def likelihood(widths: Widths, share: float) -> Restricted:
        effects, spare = (jacobian * problem.sizes(widths)) @ problem.factor, max(round(share * problem.spare), 1)
        return Restricted.of(np.sqrt(share) * target, basis[:, :0], np.sqrt(share) * effects, spare)

    def fitted(widths: Array, other: Widths, share: float) -> tuple[Array, Array]:
        """-2 log of the likelihood for each width of the machining (w,), and the noise, from a share of the rows."""
        least = unit if known else unit / LARGEST
        if alike:
            found = [likelihood(other, share).likeliest(least, LARGEST * unit, widths, given)]
        else:
            each = [likelihood(other._replace(machining=width), share) for width in widths.tolist()]
            found = [one.likeliest(least, LARGEST * unit, np.ones(1), given) for one in each]
        values, noises = np.concatenate(found, axis=1)
        return values + CREDIBLE * (np.not_equal(widths, 1.0) + np.count_nonzero(np.not_equal(other, 1.0))), noises

    def best(widths: Array, others: Sequence[Widths]) -> Widths:
        values = np.array([fitted(widths, other, min(1.0, ENOUGH / problem.equations))[0] for other in others])
        row, column = divmod(int(np.argmin(values)), len(widths))
        return others[row]._replace(machining=float(widths[column]))

    several = [n for n in TOGETHER if n < 2.0 * problem.alternatives.max()]
    own = best(np.ones(1), [Widths(together=n) for n in several])
    zeros = ZERO_WIDTHS if problem.zeros.any() else ZERO_WIDTHS[:1]
    own = best(np.array(WIDTHS if problem.machined.any() else WIDTHS[:1]), [own._replace(zeros=z) for z in zeros])
    return float(fitted(np.array([own.machining]), own._replace(machining=1.0), 1.0)[1][0]), own


def widened(problem: Problem, widths: Widths) -> Prior | None:
    """The problem's prior with the sizes of the machining so many times as large, and so many settings at once."""
    if problem.prior is None or widths == AS_STATED:
        return problem.prior
    prior, machined = problem.prior.with_together(widths.together), problem.model.prior
    factors = {p.name: widths[p.kind == JOINT_OFFSET] for p in problem.model.parameters if p.name in machined}
    return replace(prior, deviations={name: own * factors.get(name, 1.0) for name, own in prior.deviations.items()})
