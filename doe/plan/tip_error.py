"""Predicted tip error of a plan: with a correct model, and with effects of typical size missing from it.

The plan is measured with noise sigma. The tip is then computed at test poses, where nothing was measured; its error
is counted against the arm's true position, as root mean square over poses and over arms that the prior may give.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from doe.criteria import I
from doe.problem.model import offers
from doe.problem.postures import listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from doe.problem.robust import missing_effects, robust_problem, tip_jacobians, workspace
from identification.arrays import Array
from identification.information import information_matrix, inverses, spectrum

SPACE = 3  # coordinates of a point
PLANS = 50  # random plans that a plan is compared with
POOL = 2000  # postures that they are drawn from
BETTER = 0.5  # share of them that a plan must be better than to be worth its search


@dataclass(frozen=True)
class TipError:
    """Root mean square distances [mm].

    right : the model lacks nothing, and is fitted by least squares, of a spatial arm with the prior of its machining
    missing : effects of typical size are missing in the model, which is fitted in the same way; infinite where none
        are counted
    with_prior : the same arms, fitted with the effects and their prior (`identify --library-prior`)
    worst : as `right`, at that of the test poses where it is largest
    """

    right: float
    missing: float
    with_prior: float
    worst: float = np.inf

    def to_json(self) -> dict[str, float | None]:
        """Key `tip_error_mm` (identification/files/README.md, "JSON keys"); None where a plan is not enough."""
        errors = {"model_right": self.right, "effects_missing": self.missing, "effects_missing_prior": self.with_prior}
        errors |= {"model_right_worst": self.worst}
        return {name: value if np.isfinite(value) else None for name, value in errors.items()}


@dataclass(frozen=True)
class TipErrors:
    """Expected tip errors of plans.

    problem : of the model as it is, whose parameters may have a prior, as a spatial arm's geometry has
    wide : `robust_problem` of it, whose added parameters come last
    targets : (k, points, c, P) scaled Jacobian of the measured points of `wide` where the tip is needed, see
        `tip_jacobians`
    """

    problem: DesignProblem
    wide: DesignProblem
    targets: Array

    @classmethod
    def of(cls, problem: DesignProblem) -> TipErrors | None:
        """Over the `workspace`; None where there is no sigma to weigh sizes against, or no library for the model, or
        effects may be missing in it already.

        Of a diagnosed arm nothing is missing: what its data could show is in the model, and would have been shown.
        """
        model = problem.model
        if model.sigma is None or not offers(model, "missing_effects") or problem.missing:
            return None
        poses = workspace(problem)  # once: rare postures take long to find
        if getattr(model, "complete", False):
            return cls(problem, problem, tip_jacobians(problem, poses))
        wide = robust_problem(problem, missing_effects(problem), poses=poses)
        return cls(problem, wide, tip_jacobians(wide, poses))

    @cached_property
    def _targets(self) -> Array:
        """(k, d, P) the same, its squares a mean over the measured points, without orientations that are measured too:
        they are no distance."""
        k, points, _, p = self.targets.shape
        return np.asarray(self.targets[:, :, :SPACE].reshape(k, -1, p) / np.sqrt(points))

    @cached_property
    def _weight(self) -> Array:
        """(P, P) mean of the squares of the tip's Jacobian."""
        return information_matrix(self._targets) / len(self._targets)

    def with_prior(self, postures: Array) -> float:
        """Of a plan (m, n) and the postures measured already, fitted with the effects and their prior."""
        return self._with_prior(self._information(postures))

    def missing(self, postures: Array) -> float:
        """The same without the effects, which are there."""
        return self._missing(self._information(postures))

    def of_plan(self, postures: Array) -> TipError:
        """Of a plan (m, n) and the postures measured already; infinite if the model is not identified."""
        p, information = self.problem.parameters, self._information(postures)
        with_prior = self._with_prior(information)
        if not self._identified(postures):
            return TipError(np.inf, np.inf, with_prior)
        posterior = inverses(information[:p, :p] + np.diag(self.problem.precisions))
        targets = self._targets[..., :p]
        right = float(self.problem.model.sigma or 0.0) ** 2 * np.einsum("kdp,kdp->k", targets @ posterior, targets)
        if self.wide.parameters == p:
            return TipError(float(np.sqrt(right.mean())), np.inf, np.inf, float(np.sqrt(right.max())))
        missing = self._missing(information)
        return TipError(float(np.sqrt(right.mean())), missing, with_prior, float(np.sqrt(right.max())))

    def _information(self, postures: Array) -> Array:
        """(P, P) sum of B^T B of the plan and of what is measured already, without any prior."""
        every = np.concatenate([postures, self.problem.kept])
        return self.wide.weighted_information(every, np.ones(len(every)))

    def _identified(self, postures: Array) -> bool:
        p = self.problem.parameters
        rows = self.problem.scaled_jacobians(np.concatenate([postures, self.problem.kept])).reshape(-1, p)
        held = np.diag(np.sqrt(self.problem.precisions))
        return bool(spectrum(np.concatenate([rows, held]), np.ones(p)).rank == p)

    def _with_prior(self, information: Array) -> float:
        posterior = inverses(information + np.diag(self.wide.precisions))
        noise = float(self.wide.model.sigma or 0.0) ** 2
        if np.isinf(posterior[0, 0]):
            return np.inf
        return float(np.sqrt(noise * np.sum(posterior * self._weight) + self.wide.beyond))

    def _missing(self, information: Array) -> float:
        """The fit takes up of each missing effect what the geometry can, and the tip lacks the rest; it takes the noise
        for that of the instrument, which each posture's own error comes on top of."""
        p, wide = self.problem.parameters, self.wide
        posterior = inverses(information[:p, :p] + np.diag(self.problem.precisions))
        if np.isinf(posterior[0, 0]):
            return np.inf
        sigma, noise = float(self.problem.model.sigma or 0.0) ** 2, float(wide.model.sigma or 0.0) ** 2
        spread = sigma * posterior + (noise - sigma) * posterior @ information[:p, :p] @ posterior
        lacking = np.concatenate([posterior @ information[:p, p:], -np.eye(wide.parameters - p)])
        sizes = noise / wide.precisions[p:]  # squared, in scaled parameters
        bias = float(np.sum(np.einsum("ap,ab,bp->p", lacking, self._weight, lacking, optimize=True) * sizes))
        return float(np.sqrt(np.sum(spread * self._weight[:p, :p]) + bias + wide.beyond))


@dataclass(frozen=True)
class ExpectedTip:
    """What a plan promises beside random ones, where the arm may have what its model lacks: RMS distances [mm].

    plan : if fitted as the plan says;  random : (`PLANS`,) of random plans of as many runs, fitted in the same way
    fit : `library-prior`, or empty: least squares
    """

    plan: float
    random: Array
    fit: str

    @property
    def better_than(self) -> float:
        """Share of the random plans that promise less."""
        return float(np.mean(self.random > self.plan))

    def to_json(self) -> dict[str, Any]:
        """Key `expected_tip` (identification/files/README.md, "JSON keys")."""
        figures = {"plan_mm": self.plan, "random_median_mm": float(np.median(self.random))}
        finite = {name: value if np.isfinite(value) else None for name, value in figures.items()}
        return finite | {"better_than": self.better_than, "random_plans": len(self.random), "fit": self.fit or None}

    def __str__(self) -> str:
        """One sentence, or two."""
        fit = f"fitted by armcal identify --{self.fit}" if self.fit else "fitted without them"
        where = f"Expected error of the tip if the arm has effects and error curves that its file does not name ({fit})"
        figures = (
            f"{self.plan:.3g} mm by this plan, {np.median(self.random):.3g} mm by the median of {PLANS} random ones"
        )
        share = f"better than {100.0 * self.better_than:.0f} % of them"
        if self.better_than > BETTER:
            return f"{where}: {figures}; {share}."
        instead = "" if self.fit else " armcal design --robust chooses postures for that."
        return f"{where}: {figures}. In this the plan is no better than postures chosen at random ({share}).{instead}"


def tip_beside_random(problem: DesignProblem, postures: Array, seed: int = 0) -> ExpectedTip | None:
    """What a plan (m, n) promises beside random ones; None where no sizes are known or none are counted, and for more
    runs than `POOL`, of which random plans are all alike.

    problem : that the plan was chosen for, robust or not
    """
    if len(postures) > POOL:
        return None
    if problem.missing:
        at, everywhere = problem.criterion, replace(problem, choices=None) if problem.sampled else problem
        targets = at.jacobians if isinstance(at, I) else tip_jacobians(problem, workspace(everywhere))
        targets = targets if targets.ndim == 4 else targets[:, None]
        errors: TipErrors | None = TipErrors(problem, problem, targets)
    else:
        errors = TipErrors.of(problem)
    if errors is None or not errors.wide.missing:
        return None
    judge = errors.with_prior if problem.fit else errors.missing
    generator, m = np.random.default_rng([seed, len(postures)]), len(postures)
    if problem.choices is not None and not problem.sampled:
        pool = listed_candidates(problem, problem.choices).postures
    else:
        pool = random_postures(problem, min(PLANS * m, POOL), generator)
    plans = [pool[generator.choice(len(pool), m, replace=len(pool) < m)] for _ in range(PLANS)]
    return ExpectedTip(judge(postures), np.array([judge(plan) for plan in plans]), problem.fit)
