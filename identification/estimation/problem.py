"""The least-squares problem of a fit: data, model and prior, its noise, and where its solution is searched for.

What is known of parameters before the data is a normal distribution, as extra rows of the problem: independent
parameters of zero mean and standard deviations d_k each add one residual (0 - x_k) / d_k, in units of the noise; an
earlier calibration, mean x_0 and covariance L L^T, adds L^-1 (x_0 - x). Noise and sizes of the prior are those of the
largest marginal likelihood, the parameters without a prior integrated out (restricted maximum likelihood, H. D.
Patterson, R. Thompson, "Recovery of inter-block information when block sizes are unequal", 1971), of a problem that is
linear about its solution; sizes are tried from a few values each.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, fdtrc

from identification.arm import Calibration
from identification.arrays import Array, ByValue
from identification.errors import InputError, require
from identification.information import PRODUCT_TOLERANCE, RANK_TOLERANCE, significant, spectrum
from identification.kinematics.chain import BASE, TOOL, PlanarClosedForm
from identification.kinematics.parameters import JOINT_OFFSET, Parameter, ParameterSet
from identification.levenberg_marquardt import ITERATIONS, Index, Linearize, Solution, compressed, levenberg_marquardt
from identification.measurements import Conditions, Measurements
from identification.model import Model

RELIANCE = ("given", "estimated")
# what a fit asks of a model
FITTED = "parameters names scales values prior dimension joints effects sigma reach closed_form position linearize"


# -- the prior ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Prior(ByValue):
    """Independent normal distributions of zero mean, and that of an earlier calibration, with its covariance.

    deviations : parameter name -> standard deviation > 0 [API unit]; parameters that are not named are free, names
        that a model does not have do not matter
    own_error : standard deviation [mm] of one coordinate of a posture's own error, of which other postures say nothing:
        to a fit it is noise
    factors : on `deviations` and `own_error`, of which a fit takes the likeliest: of sizes that are typical, some arms
        have all less or more
    """

    deviations: Mapping[str, float] = field(default_factory=dict)
    earlier: Calibration = field(default_factory=lambda: Calibration({}, (), np.zeros((0, 0))))
    own_error: float = 0.0
    factors: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        variances = np.asarray(self.earlier.covariance).diagonal().tolist()
        of_earlier = dict(zip(self.earlier.parameter_names, variances, strict=True))
        for what, named in (("variance", of_earlier), ("standard deviation", self.deviations)):
            for name, value in named.items():
                require(0.0 < value < np.inf, f"prior: {name} has {what} {value:g}, allowed: a finite number > 0")
        independent = {name: deviation for name, deviation in self.deviations.items() if name not in of_earlier}
        object.__setattr__(self, "deviations", independent)
        super().__post_init__()

    @property
    def names(self) -> frozenset[str]:
        """Of all parameters that have one."""
        return frozenset((*self.deviations, *self.earlier.parameter_names))

    def released(self, names: Collection[str], machining: Mapping[str, float]) -> Prior:
        """Without what the earlier calibration says of these; that of the machining (name -> deviation) stays."""
        kept = self.earlier.about(set(self.earlier.parameter_names) - set(names))
        return Prior({n: size for n, size in machining.items() if n in names} | dict(self.deviations), kept)

    def center(self, parameters: ParameterSet) -> Array:
        """(p,) means, zero where there is no prior."""
        return parameters.vector({n: self.earlier.values[n] for n in self.earlier.parameter_names}, default=0.0)

    def factor(self, parameters: ParameterSet) -> Array:
        """(p, r) F, with the covariance F F^T; zero in the rows of parameters without a prior."""
        deviations = parameters.vector(self.deviations, default=0.0)
        earlier = self.earlier.about(parameters.names)
        covariance = np.asarray(earlier.covariance)
        sizes = np.sqrt(np.diag(covariance))  # combinations known better than rounding are held as well as that
        values, vectors = np.linalg.eigh(covariance / np.outer(sizes, sizes))
        root = np.zeros((len(parameters), len(sizes)))
        root[[parameters.index(name) for name in earlier.parameter_names]] = (
            sizes[:, None] * vectors * np.sqrt(np.maximum(values, PRODUCT_TOLERANCE * values.max(initial=0.0)))
        )
        return np.concatenate([np.diag(deviations)[:, deviations > 0.0], root], axis=1)

    def rows(self, parameters: ParameterSet, noise: float = 1.0) -> Array:
        """(r, p) rows for the Jacobian, F^-1, one for each parameter that has a prior; its residuals are rows @ (center
        - values);  noise : standard deviation of the other residuals, 1 where those are divided by sigma"""
        if not self.names:
            return np.zeros((0, len(parameters)))
        factor = self.factor(parameters)
        held = factor.any(axis=1)
        sizes = np.linalg.norm(factor[held], axis=1)
        rows = np.zeros(factor.T.shape)
        rows[:, held] = noise * np.linalg.inv(factor[held] / sizes[:, None]) / sizes
        return rows


NO_PRIOR = Prior()


# -- the problem -------------------------------------------------------------------------------------------------------
def check_measurements(model: Model, measurements: Measurements, prior: Prior = NO_PRIOR) -> None:
    """Raises `InputError` for other kinds, the wrong number of joints, data that effects lack, too few equations;
    prior : of parameters that need no equation, besides those of the model"""
    if lacking := [name for name in FITTED.split() if not hasattr(model, name)]:
        allowed = f"allowed: a Model, as in Model(arm), or one with {lacking[0]}"
        raise InputError(f"model: found {type(model).__name__}, {allowed}")
    allowed = "allowed: Measurements, as load_measurements(path) gives"
    require(hasattr(measurements, "positions"), f"measurements: found {type(measurements).__name__}, {allowed}")
    check_shape(model, measurements)
    m, p, d = len(measurements), len(model.parameters), measurements.dimension
    require(p > 0, "model: every parameter is known, allowed: at least one to estimate")
    for effect in model.effects:
        arm, in_file = model.arm, "allowed: an arm file with"
        reads = "distance" in arm.chain.instrument.offers
        for need, has, what in (
            ("temperature", measurements.temperature is not None, "the column temperature_C, allowed: rows with it"),
            ("gravity", arm.gravity is not None, f"gravity torques, {in_file} a [gravity] table"),
            ("distance", reads, f"measured distances, {in_file} an [instrument] of kind distance"),
        ):
            require(has or need not in effect.needs, f"effects: {effect.key} needs {what}")
    p -= len({*model.prior, *prior.names} & set(model.names))
    counted = f"{d} m = {d * m} < p = {p}"
    file = measurements.provenance.get("file", "measurements")
    require(d * m >= p, f"{file}: fewer equations than unknowns: {counted}, allowed: m >= {-(-p // d)}")


def check_shape(model: Model, measurements: Measurements) -> None:
    """Raises `InputError` for another number of joints or coordinates than the model has."""
    n, d = model.joints, measurements.dimension
    counted = f"{measurements.links} joints for an arm of {n} links"
    require(measurements.links == n, f"measurements: {counted}, allowed: {n}")
    fits, counted = d in getattr(model, "dimensions", (model.dimension,)), f"positions of {d} coordinates"
    require(fits, f"measurements: {counted}, allowed: {model.dimension} as the model has")


@dataclass(frozen=True, eq=False)
class Problem:
    """min over the parameters of sum_i w_i |measured_i - position_i|^2 (eq. 3, with weights), for K data sets.

    postures : (m, n) [rad] that all data sets share, with their conditions
    positions : (K, m, d) measured [mm]
    weights : (m,) of the rows, 1/sigma_i^2 where sigma is known
    sigma : root mean square over rows [mm] of the standard deviation that the weights are of; None: unknown
    reliance : `given` or `estimated`: what intervals rely on whatever the residuals say; None: they may decide
    tolerance : singular values below this share of the largest do not count; along them nothing is estimated
    prior : of the parameters, r rows more;  noise : standard deviation of weighted residuals, 1 where sigma is known
    """

    model: Model
    postures: Array
    conditions: Conditions
    positions: Array
    weights: Array
    sigma: float | None = None
    reliance: str | None = None
    tolerance: float = RANK_TOLERANCE
    prior: Prior = NO_PRIOR
    noise: float = 1.0

    @classmethod
    def of(
        cls,
        model: Model,
        measurements: Measurements,
        sigma: ArrayLike | str | None = None,
        prior: Prior = NO_PRIOR,
        positions: Array | None = None,
    ) -> Problem:
        """The problem of one data set, or with other positions (K, m, d) at its postures;  sigma : as of `estimate`.
        Which holds: argument, then rows, then arm. Of rows that are copied the first counts, the others have no weight.
        Raises `InputError`."""
        m, data = len(measurements), measurements
        relative = np.ones(m) if positions is not None else np.where(data.originals == np.arange(m), 1.0, 0.0)
        reliance, numbers = (sigma, None) if isinstance(sigma, str) else (None if sigma is None else "given", sigma)
        allowed = f"allowed: numbers [mm], {' or '.join(map(repr, RELIANCE))}"
        require(reliance in (None, *RELIANCE), f"sigma: {sigma!r}, {allowed}")
        stated = next((s for s in (numbers, data.sigma, model.sigma) if s is not None), None)
        rows = data.postures, data.conditions, data.positions[None] if positions is None else positions
        allowed = "measurement.sigma_mm in the arm file, or a column sigma_mm in the measurements"
        require(stated is not None or reliance != "given", f"sigma: 'given', but none is given, allowed: {allowed}")
        if stated is None or reliance == "estimated":
            return cls(model, *rows, relative, None, reliance, prior=prior)
        deviations = np.asarray(stated, dtype=float)
        fits = deviations.shape in ((), (m,)) and bool(np.all(np.isfinite(deviations) & (deviations > 0.0)))
        found = f"shape {deviations.shape}" if deviations.ndim else f"{deviations:g}"
        require(fits, f"sigma_mm: {found}, allowed: one number or ({m},), each finite and > 0")
        mean = float(np.sqrt(np.mean(deviations**2)))
        return cls(model, *rows, relative / deviations**2, mean, reliance, prior=prior)

    @property
    def exact_form(self) -> PlanarClosedForm | None:
        """The model's closed form if that is the solution; None: there is none, or it is a start only."""
        form = self.model.closed_form
        return form if form is not None and form.exact and not self.prior.names else None

    method = property(lambda self: "linear" if self.exact_form else "levenberg_marquardt")  # by which it is solved

    def data_sets(self, index: Index | NDArray[np.bool_] | slice) -> Problem:
        """The problem of some of the data sets."""
        return replace(self, positions=self.positions[index])

    @cached_property
    def root_weights(self) -> Array:
        """(m, 1) square roots of the weights."""
        return np.sqrt(self.weights)[:, None]

    @property
    def equations(self) -> int:
        """Of a data set: coordinates of rows of weight above zero."""
        return self.model.dimension * int(np.count_nonzero(self.weights))

    @cached_property
    def start(self) -> Array:
        """(p,) best known values, moved inside the bounds."""
        return np.clip(self.model.values, self.model.parameters.lower, self.model.parameters.upper)

    @cached_property
    def rounding(self) -> Array:
        """(K,) norms of the weighted residuals that rounding errors make of coordinates as large as those measured or,
        since contacts read nothing, as the arm."""
        # 1e-14 of a coordinate, after a chain of some ten operations
        return 1e-14 * np.sqrt(np.maximum(np.sum(self.positions**2, axis=2), self.model.reach**2) @ self.weights)

    @cached_property
    def prior_rows(self) -> Array:
        """(r, p) rows of the prior in the Jacobian, see `Prior.rows`."""
        return self.prior.rows(self.model.parameters, self.noise)

    @cached_property
    def prior_center(self) -> Array:
        """(p,) means of the prior, see `Prior.center`."""
        return self.prior.center(self.model.parameters)

    def residuals(self, parameters: Array) -> Array:
        """(K, m, d) measured less computed [mm], for parameters (p,) or (K, p)."""
        return self.positions - self.model.position(self.postures, parameters, self.conditions)

    def linearize(self, parameters: Array, index: Index) -> tuple[Array, Array]:
        """(k, m d) weighted residuals of the data sets numbered (k,) and (k, m d, p) weighted Jacobians, without the
        prior, at parameters (k, p)."""
        chosen = self if len(index) == len(self.positions) else self.data_sets(index)
        position, jacobian = self.model.linearize(chosen.postures, parameters, chosen.conditions)
        residuals = self.root_weights * (chosen.positions - position)
        jacobian *= self.root_weights[:, :, None]  # in place: new memory takes as long as the product
        return residuals.reshape(len(residuals), -1), jacobian.reshape(len(residuals), -1, jacobian.shape[-1])

    def rows_about(self, parameters: Array) -> tuple[Array, Array]:
        """Those (m d,) and (m d, p) of the first data set, if there is one, at parameters (p,)."""
        position, jacobian = self.model.linearize(self.postures, parameters, self.conditions)
        residual, jacobian = self.positions[:1] - position, self.root_weights[:, :, None] * jacobian
        return (self.root_weights * residual).reshape(-1), jacobian.reshape(-1, jacobian.shape[-1])

    def linearized(self, parameters: Array) -> tuple[Array, Array]:
        """`rows_about` parameters (p,) in as few rows as say the same."""
        residuals, jacobians = compressed(*(each[None] for each in self.rows_about(parameters)))
        return residuals[0], jacobians[0]

    def starts(self) -> Array:
        """(K, p) for searches: the closed form of the model without its effects, whose global minimiser it is, so that
        any size of joint offset is harmless, or the best known values where those fit better."""
        best_known = np.tile(self.start, (len(self.positions), 1))
        if (form := self.model.closed_form) is None:
            return best_known
        solved = best_known.copy()
        solved[:, form.indices] = form.solver(self.postures, self.weights, self.tolerance)(self.positions)[0]
        if not np.any(self.start):
            return solved  # nothing is known that the closed form does not know
        before, after = (np.einsum("kmd,m->k", self.residuals(x) ** 2, self.weights) for x in (best_known, solved))
        return np.where((before < after)[:, None], best_known, solved)

    def minimized(self, starts: Array, linearize: Linearize | None = None, iterations: int = ITERATIONS) -> Solution:
        """Stationary points within the bounds from starts (K, p);  linearize : rows of the data as this problem's own
        say them, in place of these"""
        rows_of_data, prior, parameters = linearize or self.linearize, self.prior_rows, self.model.parameters

        def rows(x: Array, index: Index) -> tuple[Array, Array]:
            residuals, jacobians = rows_of_data(x, index)
            if len(prior):
                residuals = np.concatenate([residuals, (prior @ (self.prior_center - x)[..., None])[..., 0]], axis=1)
                jacobians = np.concatenate([jacobians, np.broadcast_to(prior, (len(x), *prior.shape))], axis=1)
            return compressed(residuals, jacobians)

        return levenberg_marquardt(
            rows,
            starts,
            lower=parameters.lower,
            upper=parameters.upper,
            scales=self.model.scales,
            rounding=self.rounding,
            tolerance=self.tolerance,
            iterations=iterations,
        )


# -- noise and sizes ---------------------------------------------------------------------------------------------------
def likeliest_noise(target: Array, effects: Array, spare: int, least: float, largest: float) -> tuple[float, float]:
    """Least -2 log of the likelihood, up to a constant, and the noise there between two values, where residuals are
    noise and effects of normal sizes.

    target : (N,) residuals and effects : (N, e) columns times the deviation of their prior, both with the parameters
        without a prior projected out, of which `spare` equations are left
    """
    square, many = float(target @ target), effects.shape[0] < effects.shape[1]
    values, vectors = np.linalg.eigh(effects @ effects.T if many else effects.T @ effects)  # the same, but for zeros
    kept = np.flatnonzero(significant(values, PRODUCT_TOLERANCE))[-spare:]
    # variances of orthogonal combinations of residuals that effects of deviation one make, and squares of these
    values, vectors = values[kept], vectors[:, kept]
    squares = (vectors.T @ target) ** 2 if many else (vectors.T @ (effects.T @ target)) ** 2 / values
    rest, count = max(square - float(squares.sum()), 0.0), spare - len(values)

    def minus_log(logarithm: ArrayLike) -> Array:
        noise = np.exp(logarithm)
        total = values + np.square(noise)[..., None]
        by_direction = np.sum(np.log(total) + squares / total, axis=-1)
        return np.asarray(by_direction + count * 2.0 * np.log(noise) + rest / noise**2)

    low, high = np.log(least), np.log(largest)
    while high - low > 1e-4:  # then the likelihood is a parabola; each pass finds the noise 16 times as closely
        grid = np.linspace(low, high, 33)
        lowest = int(np.argmin(minus_log(grid)))
        low, high = grid[max(lowest - 1, 0)], grid[min(lowest + 1, 32)]
    first, middle, last = minus_log([low, 0.5 * (low + high), high])
    bend = max(first - 2.0 * middle + last, 1e-300)  # of a parabola, whose vertex rounding hardly moves; of none an end
    vertex = np.clip(0.5 * (low + high) + 0.25 * (high - low) * (first - last) / bend, low, high)
    return float(minus_log(vertex)), float(np.exp(vertex))


def likeliest(problem: Problem, x: Array, residual: Array, jacobian: Array) -> tuple[float, tuple[float, ...]]:
    """Noise, no less than a sigma that is given (where intervals rely on that: it), and the widths of the prior of the
    largest likelihood: a factor on the sizes of the machining, a further one on those of joint zeros, and one of
    `Prior.factors`;  residual, jacobian : of `Problem.linearized` about x (p,)"""
    holds, parameters, prior = problem.reliance == "given", problem.model.parameters, problem.prior
    factor = prior.factor(parameters)
    held = factor.any(axis=1)
    sized = problem.model.prior.keys() & prior.deviations.keys()
    machined = np.array([name in sized for name in parameters.names])
    others = np.array([name in prior.deviations.keys() - sized for name in parameters.names])
    zeros = machined & np.array([p.kind == JOINT_OFFSET for p in parameters])
    target = residual + jacobian @ np.where(held, x - problem.prior_center, 0.0)  # all at the center of the prior
    basis = np.linalg.qr(jacobian[:, ~held])[0]
    spare = problem.equations - int(np.count_nonzero(~held))
    target, jacobian = (a - basis @ (basis.T @ a) for a in (target, jacobian[:, held]))
    has_sigma = problem.sigma is not None or holds
    unit = 1.0 if has_sigma else max(float(np.linalg.norm(target)) / np.sqrt(max(spare, 1)), 1e-12)  # without priors
    if spare == 0:
        return unit, (1.0, 1.0, 1.0)
    # as many rows as columns say the same of every width
    jacobian, target = np.split(np.linalg.qr(np.column_stack([jacobian, target]), mode="r"), [-1], axis=1)
    # in units of sigma, or of the scatter of a fit without the parameters that have a prior
    least, largest = unit if has_sigma else unit / 1e3, unit if holds else 1e6 * unit

    def fitted(widths: tuple[float, ...], share: float) -> tuple[float, float]:
        """-2 log of the likelihood, and the noise, from a share of the rows."""
        times = np.where(machined, widths[0], 1.0) * np.where(zeros, widths[1], 1.0) * np.where(others, widths[2], 1.0)
        root, left = np.sqrt(share), max(round(share * spare), 1)
        effects = root * (jacobian * times[held]) @ factor[held]
        value, noise = likeliest_noise(root * target[:, 0], effects, left, least, largest)
        # 4, by which other sizes than those stated must be likelier: chi2 of one degree of freedom, 5 %
        return value + 4.0 * sum(width != 1.0 for width in widths), noise

    # the likelihood is flat over a factor of two; joint zeros are set by hand: to 32 deg
    of_machining, of_zeros = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), (1.0, 4.0, 16.0, 64.0)
    # contacts that do not show the size of an arm fit one that is next to nothing best: the sizes stated hold it
    chosen = machined.any() and not ((chain := problem.model.arm.chain).instrument.contact and chain.size_is_open[0])
    several = [*product(of_machining, of_zeros if zeros.any() else (1.0,), (1.0,))] if chosen else [(1.0, 1.0, 1.0)]
    # of more equations, rows show the same misfits again, and widths are chosen as from so many
    share = min(1.0, 3000 / problem.equations)
    best = several[0] if len(several) == 1 else min(several, key=lambda widths: fitted(widths, share)[0])
    if len(prior.factors) > 1:
        best = min(((*best[:2], factor) for factor in prior.factors), key=lambda widths: fitted(widths, share)[0])
    return fitted(best, 1.0)[1], best


# -- an earlier calibration that the measurements contradict -----------------------------------------------------------
class Contradiction(NamedTuple):
    """A parameter in file units, given the others as the earlier calibration has them: there, and by the measurements.

    instead : parameters that would explain the measurements as well
    """

    name: str
    unit: str
    prior: float
    prior_std: float
    value: float
    std: float
    instead: tuple[str, ...] = ()

    def warning(self, without_prior: Sequence[Parameter]) -> str:
        """In words;  without_prior : parameters without a prior."""
        before = f"{self.prior:.4g} +- {self.prior_std:.2g} {self.unit} in the earlier calibration"
        by_each = f"{self.name} is {before}, {self.value:.4g} +- {self.std:.2g} by these measurements"
        instead = f" (or instead {', '.join(self.instead)}: these rows cannot tell which)" if self.instead else ""
        words = [self.name] + [p.kind if p.kind in (BASE, TOOL) else p.name for p in without_prior]
        do = f"armcal identify with the earlier calibration as ARM and --only {','.join(dict.fromkeys(words))}"
        return (
            f"the measurements contradict the prior: {by_each}{instead} (others as there). The fit is right for "
            f"neither. Either the arm changed and this must be estimated again: {do}; or the model lacks what differs "
            "between the two sets of measurements: armcal diagnose"
        )


def contradicted(problem: Problem, prior: Prior, x: Array) -> Contradiction | None:
    """The parameter whose prior, an earlier calibration, the measurements contradict most clearly; None: none.

    The drop of the weighted squares is chi2 of one degree of freedom if both agree (F where the noise is estimated).
    Several parameters may explain the same change: the one with the largest drop is told, a zero of a joint before an
    error of a frame. Its change d since then is one more unknown, in prior rows F^-1 (x - m - d e), and the fit without
    its prior gives it, from the one with it, x (p,), since an error of degrees is not linear.
    """
    model, alone = problem.model, replace(problem, prior=prior.released(problem.model.names, problem.model.prior))
    residual, jacobian = problem.linearized(x)
    noise = likeliest(alone, x, residual, jacobian)[0]
    decomposed = spectrum(jacobian, model.scales, prior=replace(alone, noise=noise).prior_rows)
    freedom = max(problem.equations - decomposed.determined(jacobian), 0.0)
    if problem.sigma is not None and chdtrc(max(freedom, 1.0), freedom * noise**2) > 0.01:  # sigma, within chance
        noise, freedom = 1.0, np.inf
    if freedom < 1.0 or noise <= 1e-12:  # [mm] data without any
        return None
    drops, earlier = released_drops(replace(problem, noise=noise), x), prior.earlier
    less = max(drops.values()) - np.array([0.0, *drops.values()])
    p_least, *p_less = chdtrc(1.0, less) if np.isinf(freedom) else fdtrc(1.0, freedom, less)
    if p_least * len(drops) >= 0.01:
        return None
    alike = [name for name, p in zip(drops, p_less, strict=True) if p > 0.05]
    name = max(alike, key=lambda each: (each.startswith(JOINT_OFFSET), drops[each]))
    posed = replace(problem, prior=prior.released({name}, model.prior), noise=noise)
    x = posed.minimized(x[None]).parameters[0]
    covariance = noise**2 * spectrum(posed.linearized(x)[1], model.scales, prior=posed.prior_rows).covariance
    p, rows = model.parameters[k := model.names.index(name)], prior.rows(model.parameters)
    precision = rows[:, k] @ rows  # (p,) of the prior, about this parameter
    change, now = precision / precision[k], earlier.values[name]
    value = now + change @ (x - prior.center(model.parameters))
    figures = now, precision[k] ** -0.5, value, np.sqrt(change @ covariance @ change)
    before, before_std, value, std = (float(figure * p.to_file) for figure in figures)
    return Contradiction(name, p.file_unit, before, before_std, value, std, tuple(n for n in alike if n != name))


def released_drops(problem: Problem, x: Array) -> dict[str, float]:
    """Parameter of the earlier calibration -> by how much the weighted squares of measurements and prior, in units of
    the noise, fall where its own prior is released and the others' stay, linear about x (p,).

    Released, a mean of the prior is one more unknown: its column is that of the prior's rows.
    """
    names, (residual, jacobian), rows = problem.model.names, problem.linearized(x), problem.prior_rows
    places = [k for k, name in enumerate(names) if name in problem.prior.earlier.parameter_names]
    whole = np.concatenate([jacobian, rows])
    shifts = np.concatenate([np.zeros((len(jacobian), len(places))), rows[:, places]])
    target = np.concatenate([residual, rows @ (problem.prior_center - x)])
    basis = np.linalg.qr(whole / np.maximum(np.linalg.norm(whole, axis=0), np.finfo(float).tiny))[0]
    left = shifts - basis @ (basis.T @ shifts)
    drops = (left.T @ target) ** 2 / np.maximum(np.sum(left**2, axis=0), np.finfo(float).tiny) / problem.noise**2
    return {names[k]: drop for k, drop in zip(places, drops.tolist(), strict=True)}
