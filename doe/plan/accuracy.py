"""What accuracy a plan promises before anything is measured.

*Standard deviations* from the covariance; *every criterion* of a plan, and the *observability indices* O1 to O5 (Y.
Sun, J. M. Hollerbach, "Observability index selection for robot calibration", ICRA 2008): from the singular values s_1
>= ... >= s_p of the identification Jacobian of all m runs, here scaled (lengths in mm, angles times link length). O1 is
D-, O3 is E-, O5 is close to A-optimality (of deviations, not variances). Only O1's order of plans is invariant to
units. Larger is better for each; 0 where the plan does not identify all parameters.

*Error of the tip* at test poses, where nothing was measured, with a correct model, and with effects of typical size
missing from it: root mean square over poses and over arms that the prior may give.

*Designs for an arm whose model may lack something*: doe/README.md, "Robust designs".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from doe.criteria import NAMES, A, Criterion, D, Ds, DStar, E, I, information_matrix, inverses
from doe.problem.model import NEEDS_SIGMA, offered, offers
from doe.problem.problem import DesignProblem, connected, half_at_limits, listed_candidates, random_postures
from identification import Array, InputError, JobError, ParameterSet, require, spectrum


@dataclass(frozen=True)
class ExpectedDeviations:
    """Standard deviations that a plan will give.

    parameters : what they belong to;  values : (p,) of every parameter [mm, rad, or its own unit]
    length, joint_offset : (n,) of the length errors [mm] and joint offsets dq_j [rad], zero where one is not estimated
    orientation : (n,) of the orientation offsets dtheta_j = dq_1 + ... + dq_j of a planar chain [rad]: the paper's
        sigma_q (eq. 25), for j >= 2 smaller than those of dq_j; zero where a joint offset is known
    """

    parameters: ParameterSet
    values: Array
    orientation: Array

    @classmethod
    def of(cls, problem: DesignProblem, postures: Array, weights: Array | None = None) -> Self | None:
        """What the plan will give with the model's sigma; None without one or if the plan is not enough.

        weights : (m,) of an approximate design, for m runs shared out by them; None: one run per posture
        """
        parameters, sigma = problem.model.parameters, problem.model.sigma
        decomposed = spectrum(plan_jacobians(problem, postures, weights), np.ones(len(parameters)))
        if sigma is None or decomposed.rank < len(parameters):
            return None
        per_scale = sigma / parameters.scales
        matrix = per_scale[:, None] * decomposed.covariance * per_scale  # sigma^2 (sum J^T J)^-1, own units
        offsets, orientation = parameters.joint_offsets, np.zeros(problem.joints)
        sums = np.tri(len(offsets))  # dtheta_j = dq_1 + ... + dq_j
        turned = sums @ matrix[np.ix_(offsets, offsets)] @ sums.T
        orientation[[(parameters[j].joint or 0) - 1 for j in offsets.tolist()]] = np.sqrt(np.diag(turned))
        return cls(parameters, np.sqrt(np.diag(matrix)), orientation)

    def of_joints(self, places: NDArray[np.int64]) -> Array:
        """(n,) of the parameters at these places, by joint."""
        by_joint = np.zeros(self.orientation.size)
        by_joint[[(self.parameters[k].joint or 0) - 1 for k in places.tolist()]] = self.values[places]
        return by_joint

    by_link = property(lambda self: self.parameters.by_link)
    length = property(lambda self: self.of_joints(self.parameters.length_errors))
    joint_offset = property(lambda self: self.of_joints(self.parameters.joint_offsets))

    def to_json(self) -> dict[str, Any]:
        """Key `std`: per link, or where there are none per parameter `{"parameters": {name: [deviation, unit]}}`."""
        if not self.by_link:
            pairs = zip(self.parameters, self.values.tolist(), strict=True)
            return {"parameters": {p.name: [value * p.to_file, p.file_unit] for p, value in pairs}}
        angles = {"orientation_deg": self.orientation, "joint_offset_deg": self.joint_offset}
        degrees = {name: np.degrees(values).tolist() for name, values in angles.items()}
        return {"length_mm": self.length.tolist()} | degrees

    def largest(self, unit: str) -> float:
        """Of a length [mm] or an angle [rad] of the arm's geometry; zero where none is estimated."""
        return float(np.max(self.values[[p.unit == unit and not p.of_effect for p in self.parameters]], initial=0.0))


def error_at_poses(problem: DesignProblem, value: float, runs: int) -> float | None:
    """Expected error of the tip [mm], as RMS over the test poses, that a value of criterion I stands for.

    runs : of the plan, those measured already apart;  None for another criterion, without sigma, and where not
    everything is estimable. Of several measured points it is that of one of them.
    """
    criterion, sigma = problem.criterion, problem.model.sigma
    if not isinstance(criterion, I) or sigma is None or not np.isfinite(value):
        return None
    return float(np.sqrt(max(-value, 0.0) / criterion.points / (runs + problem.prior.runs) * sigma**2 + problem.beyond))


def plan_jacobians(problem: DesignProblem, postures: Array, weights: Array | None = None) -> Array:
    """(m + k + r, d, p) scaled Jacobians of m runs, of the k measured already, and of what else is known beforehand.

    The last r are rows that have its information, as a measurement of those parameters would.
    """
    jacobians = problem.scaled_jacobians(postures)
    if weights is not None:
        jacobians = jacobians * np.sqrt(len(jacobians) * weights)[:, None, None]
    d, p = problem.model.dimension, problem.parameters
    rows = np.zeros((-(-p // d) * d, p))
    np.fill_diagonal(rows, np.sqrt(problem.precisions))
    return np.concatenate([jacobians, problem.kept_jacobians, rows.reshape(-1, d, p)])


def indistinct(problem: DesignProblem, postures: Array, weights: Array | None = None) -> tuple[str, ...]:
    """Combinations of parameters that a plan (m, n) does not determine, decided by the singular values as in
    `identify`; it never determines effects at neutral conditions."""
    names, ones = problem.model.parameters.names, np.ones(problem.parameters)
    return spectrum(plan_jacobians(problem, postures, weights), ones).combinations(names, ones)


def check_distinct(problem: DesignProblem, what: str) -> None:
    """Raises `JobError` for parameters that no posture tells apart: none of four times as many random ones as there are
    parameters does, which stand for all, whatever lists and constraints leave of them;  what : is asked for"""
    many = np.random.default_rng(0).uniform(problem.lower, problem.upper, (4 * problem.parameters, problem.joints))
    if lost := problem.without_effect or indistinct(problem, many):
        conditioned = bool(getattr(problem.model, "needs", ()))
        plan = "plan" + " at one payload, temperature, time and approach direction" * conditioned
        hint = "; plan with an arm file without these effects" * conditioned
        if any("base." in name and "tool[" in name for name in lost):  # the axes of a SCARA are parallel
            hint = "; add [tool] or [base] to the arm file"
        sentence = f"no {plan} identifies all {problem.parameters} parameters; no posture distinguishes"
        raise JobError(f"{what}: {sentence}: {'; '.join(lost)}{hint}")


def observability(problem: DesignProblem, postures: Array, weights: Array | None = None) -> dict[str, float]:
    """The five indices of a plan (m, n), measured postures (`kept`) included: `o1` (s_1 ... s_p)^(1/p) / sqrt(m), `o2`
    s_p / s_1, `o3` s_p, `o4` s_p^2 / s_1, `o5` 1 / sum(1 / s_i)."""
    jacobians, p = plan_jacobians(problem, postures, weights), problem.parameters
    if spectrum(jacobians, np.ones(p)).rank < p:
        return dict.fromkeys(("o1", "o2", "o3", "o4", "o5"), 0.0)
    values, runs = np.linalg.svd(jacobians.reshape(-1, p), compute_uv=False), len(postures) + len(problem.kept)
    largest, smallest, mean = values[0], values[-1], np.exp(np.mean(np.log(values)))
    indices = mean / np.sqrt(runs), smallest / largest, smallest, smallest**2 / largest, 1.0 / np.sum(1.0 / values)
    return {f"o{k}": float(value) for k, value in enumerate(indices, start=1)}


def criterion_values(problem: DesignProblem, postures: Array, weights: Array | None = None) -> dict[str, float | None]:
    """Name -> value of every criterion for a plan (m, n), None where the plan does not identify enough for it.

    I is the error over the `workspace`, Ds that of the parameters in mm where there are others too.
    """
    units = problem.model.parameters.units
    lengths = tuple(k for k, unit in enumerate(units) if unit == "mm")
    criteria: dict[str, Criterion] = {"D": D(), "A": A(), "E": E(), "I": average_error(problem)}
    if 0 < len(lengths) < len(units):
        criteria |= {"Ds": Ds(lengths), "Dstar": DStar.by_unit(units)}
    values = {name: replace(problem, criterion=one).objective(postures, weights) for name, one in criteria.items()}
    return {name: value if np.isfinite(value) else None for name, value in values.items()}


def criterion_of(
    problem: DesignProblem, name: str, subset: Sequence[str] = (), poses: Array | None = None
) -> Criterion:
    """The criterion of a name as in `--criterion`.

    subset : names of the parameters that matter, for Ds;  poses : (k, n) test poses [rad], for I
    Raises `InputError` for an unknown name, and where what the criterion needs is missing.
    """
    parameters = problem.model.parameters
    if name == "I":
        found = "criterion: I needs test poses, none are given"
        require(poses is not None and len(poses), f"{found}, allowed: at least one posture (--test-poses)")
        return average_error(problem, poses)
    if name == "Ds":
        require(subset, "criterion: Ds needs a subset (--subset), found none, allowed: one parameter or more")
        InputError.check_names("--subset: unknown parameter", subset, parameters.names)
        return Ds(tuple(map(parameters.index, subset)))
    plain: dict[str, Criterion] = {"D": D(), "A": A(), "E": E(), "Dstar": DStar.by_unit(parameters.units)}
    InputError.check_names("criterion: unknown name", [name], NAMES)
    return plain[name]


# -- arms whose model may lack something -----------------------------------------------------------------------------
def missing_effects(problem: DesignProblem, names: Sequence[str] | None = None, runs: int = 0) -> Any:
    """What a problem's model may lack of what postures can show; what order, time and temperature show is left out.

    names : of effects, None: all;  runs : of a plan, beside those measured already: many tell waves that few do not
    Raises `InputError` for a model that does not know, unknown names, no sigma.
    """
    missing = offered(problem.model, "missing_effects", "robust")
    require(problem.model.sigma is not None, f"--robust {NEEDS_SIGMA}")
    # the order of the fastest wave of an error curve that a plan is to show (doe/README.md, "Robust designs"): a wave
    # has two parameters at each joint
    return missing(names, max(24.0, 0.5 * (runs + len(problem.kept)) * problem.model.dimension / problem.joints))


def robust_problem(problem: DesignProblem, missing: Any = None, poses: Array | None = None) -> DesignProblem:
    """The same design space for an arm that may have these effects too, with criterion I: the mean squared error of the
    tip over `poses`, with the estimated effects in the model.

    missing : None: all that postures can show, `missing_effects`
    poses : (k, n) where the tip is needed, None: the `workspace`
    """
    added = missing_effects(problem) if missing is None else missing
    model, deviations, beyond = offered(problem.model, "with_effects", "robust")(added)
    # what its criterion promises is of a fit with `armcal identify --library-prior`
    wide = replace(problem, model=model, deviations={**problem.deviations, **deviations}, fit="library-prior")
    poses = workspace(wide) if poses is None else poses
    wide = replace(wide, beyond=beyond(poses))
    return replace(wide, criterion=average_error(wide, poses))


def with_choices(problem: DesignProblem, also: Array | None = None) -> DesignProblem:
    """The problem with a list to choose from, its own or one of random allowed postures, half of them at limits.

    also : (k, n) postures that are among them too

    Fast waves give a criterion thousands of local optima over all postures, none much better than the next: a list has
    enough of them to choose from. No proof over a random list says anything of all postures: it is `sampled`.
    """
    listed, sampled = problem.choices, problem.sampled
    if listed is None:
        generator, sampled = np.random.default_rng(0), True
        count = 10**6 // len(workspace(problem))  # of which 1,000 are `connected`
        listed = connected(problem, half_at_limits(problem, count, generator))
    return replace(problem, choices=listed if also is None else np.concatenate([listed, also]), sampled=sampled)


def average_error(problem: DesignProblem, poses: ArrayLike | None = None) -> I:
    """Criterion I at test poses (k, n) [rad]; None: over the `workspace`."""
    return I(tip_jacobians(problem, workspace(problem) if poses is None else poses))


def tip_jacobians(problem: DesignProblem, poses: ArrayLike) -> Array:
    """(k, P, c, p) scaled Jacobians of the positions of P measured points at poses (k, n), whatever is read of them; of
    a model that knows no tip what is measured, as of one point."""
    if not offers(problem.model, "tip_jacobian"):
        return problem.scaled_jacobians(poses)[:, None]
    return np.asarray(offered(problem.model, "tip_jacobian", "tip")(poses) / problem.model.parameters.scales)


def workspace(problem: DesignProblem) -> Array:
    """(k, n) postures where the arm will work: all that may be chosen, or random ones within limits and constraints,
    `connected`, as where a probe is to touch something."""
    if problem.choices is not None and not getattr(problem.model, "tied", False):
        return listed_candidates(problem, problem.choices)
    return connected(problem)


# -- error of the tip --------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class TipErrors:
    """Expected tip errors of plans: root mean square distances [mm], infinite where a plan is not enough.

    problem : of the model as it is, whose parameters may have a prior, as a spatial arm's geometry has
    wide : `robust_problem` of it, whose added parameters come last
    targets : (k, points, c, P) `tip_jacobians` of `wide` where the tip is needed
    """

    problem: DesignProblem
    wide: DesignProblem
    targets: Array

    @classmethod
    def of(cls, problem: DesignProblem, runs: int = 0) -> TipErrors | None:
        """Over the `workspace`, or where criterion I is judged; None without a sigma to weigh sizes by, or a library.

        runs : of the longest plan

        Of a diagnosed arm nothing is missing: what its data could show is in the model, and would have been shown.
        """
        model, at = problem.model, problem.criterion
        if model.sigma is None or not offers(model, "missing_effects"):
            return None
        if problem.missing and isinstance(at, I):
            return cls(problem, problem, at.jacobians)
        poses, wide = workspace(problem), problem  # once: rare postures take long to find
        if not (problem.missing or getattr(model, "complete", False)):
            wide = robust_problem(problem, missing_effects(problem, runs=runs), poses=poses)
        return cls(problem, wide, tip_jacobians(wide, poses))

    def of_plan(self, postures: Array, read: Array | None = None) -> dict[str, float]:
        """Of a plan (m, n) and the postures measured already, by the keys of `tip_error_mm`.

        `model_right` : the model lacks nothing, and is fitted by least squares, of a spatial arm with the prior of its
        machining; `model_right_worst` at that of the test poses where it is largest; `effects_missing` : effects of
        typical size are missing in the model, which is fitted in the same way: the geometry absorbs what it can of
        each, the rest is error of the tip, and each posture has an error of its own beside the instrument's noise;
        `effects_missing_prior` : the same arms, fitted with the effects and their prior (`identify --library-prior`);
        infinite where none are counted;  read : its scaled Jacobians (m, d, P), then for the `fit` of the problem alone
        """
        problem, wide, p = self.problem, self.wide, self.problem.parameters
        sigma, noise = ((model.sigma or 0.0) ** 2 for model in (problem.model, wide.model))
        jacobians = wide.scaled_jacobians(postures) if read is None else read
        information = information_matrix(np.concatenate([jacobians, wide.kept_jacobians]))
        posterior, singular = inverses(information[:p, :p] + np.diag(problem.precisions))
        errors = dict.fromkeys(("model_right", "effects_missing", "effects_missing_prior", "model_right_worst"), np.inf)
        if wide.missing and (read is None or problem.fit):  # of many parameters: what takes the time
            whole, unidentified = inverses(information + np.diag(wide.precisions))
            if not unidentified:
                errors["effects_missing_prior"] = float(np.sqrt(noise * np.sum(whole * self._weight) + wide.beyond))
        if singular or spectrum(plan_jacobians(problem, postures), np.ones(p)).rank < p:
            return errors
        right = sigma * np.einsum("kdp,kdp->k", self._points[..., :p] @ posterior, self._points[..., :p])
        errors |= {"model_right": float(np.sqrt(right.mean())), "model_right_worst": float(np.sqrt(right.max()))}
        if wide.missing:
            spread = sigma * posterior + (noise - sigma) * posterior @ information[:p, :p] @ posterior
            taken = posterior @ information[:p, p:]  # by the geometry, of each effect
            squares = np.sum(taken * (self._weight[:p, :p] @ taken - 2.0 * self._weight[:p, p:]), axis=0)
            squares += np.diag(self._weight)[p:]  # of the tip's error, per scaled parameter
            missing = np.sum(spread * self._weight[:p, :p]) + squares @ (noise / wide.precisions[p:]) + wide.beyond
            errors["effects_missing"] = float(np.sqrt(missing))
        return errors

    @cached_property
    def _points(self) -> Array:
        """(k, d, P) the same as `targets`, its squares a mean over the measured points."""
        k, points, _, p = self.targets.shape
        return np.asarray(self.targets.reshape(k, -1, p) / np.sqrt(points))  # coordinates of a point

    @cached_property
    def _weight(self) -> Array:
        """(P, P) mean of the squares of that."""
        return information_matrix(self._points) / len(self._points)


def tip_beside_random(problem: DesignProblem, postures: Array, seed: int = 0) -> tuple[Any, list[str]]:
    """What a plan (m, n) promises beside 50 random ones, fitted in the same way, where the arm may have what its model
    lacks: RMS distances [mm] as the key `expected_tip` (identification/files/README.md, "JSON keys"), and in words.

    None where no sizes are known or none are counted, and for more runs than 2000, of which random plans are all alike.

    problem : that the plan was chosen for, robust or not
    """
    m, plans, most = len(postures), 50, 2000  # random plans that it is compared with, and postures of all of them
    anywhere = replace(problem, choices=None) if problem.sampled else problem
    errors = TipErrors.of(anywhere, m) if m <= most else None
    if errors is None or not errors.wide.missing:
        return None, []
    fitted = "effects_missing_prior" if problem.fit else "effects_missing"
    generator = np.random.default_rng([seed, m])
    if anywhere.choices is None:
        pool = connected(problem, random_postures(problem, min(plans * m, most), generator))
    else:
        pool = listed_candidates(problem, anywhere.choices)
    drawn = [generator.choice(len(pool), m, replace=len(pool) < m) for _ in range(plans)]
    read = errors.wide.scaled_jacobians(pool)
    random = np.array([errors.of_plan(pool[each], read[each])[fitted] for each in drawn])
    plan = errors.of_plan(postures)[fitted]
    median, better = float(np.median(random)), float(np.mean(random > plan))
    figures = {"plan_mm": plan, "random_median_mm": median}
    data = {name: value if np.isfinite(value) else None for name, value in figures.items()}
    fit = f"fitted by armcal identify --{problem.fit}" if problem.fit else "fitted without them"
    named = "effects of --missing" if "--missing" in problem.fit else "effects and error curves"
    where = f"Expected tip error if the arm has {named} that its file does not name ({fit})"
    others = f"{median:.3g} mm for the median of {plans} random plans"
    sentences = f"{where}: {plan:.3g} mm for this plan, {others}; better than {100.0 * better:.0f} % of them."
    if not plan < 0.95 * median:  # differences below change with the arm
        sentences += " In this respect the plan is hardly better than random postures, if at all."
        sentences += "" if problem.fit else " armcal design --robust chooses postures for this case."
    return data | {"better_than": better, "random_plans": plans, "fit": problem.fit or None}, [sentences]
