"""Turn the ambiguity set and the tests of single effects into results: `Candidate` and `Trial`."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from identification.arm import Calibration
from identification.estimation.intervals import freedom_kept, limits_95
from identification.estimation.uncertainty import Uncertainty
from identification.gap.candidate import Candidate, Estimate
from identification.gap.fits.fit import Fit
from identification.gap.result import Trial
from identification.gap.selection.certainty import certainty
from identification.gap.selection.search import Choice, HypothesisSearch
from identification.gap.selection.selection import trial_of
from identification.gap.workflow import Findings
from identification.kinematics.joint_range import joint_range
from identification.validate.row_groups import DIAGNOSED


def candidate_list(found: Findings, draws: int, generator: np.random.Generator) -> tuple[Candidate, ...]:
    """The ambiguity set as results; where an unknown effect was found, only the effects named beside it."""
    rivals = found.selection.rivals
    if found.unknown.place is not None:
        rivals = ((found.unknown.chosen, 0.0),) if found.unknown.chosen else ()
    searches = found.search, found.fits
    return tuple(candidate(*searches, chosen, delta, draws, generator) for chosen, delta in rivals)


def candidate(
    search: HypothesisSearch,
    fits: HypothesisSearch,
    chosen: Choice,
    delta: float,
    draws: int,
    generator: np.random.Generator,
) -> Candidate:
    """A set of effects as a result.

    search : provides the tests;  fits : provides the fits, possibly to more rows;  delta : BIC less the lowest BIC
    draws, generator : of the bootstrap
    """
    found = fits.fit(chosen)
    test = trial_of(search, chosen, draws, generator)
    return candidate_of(found, len(chosen), test, certainty(fits, found), delta)


def candidate_of(found: Fit, added: int, test: tuple[float, float], sure: Uncertainty, delta: float = 0.0) -> Candidate:
    """The last `added` effects of a fitted model as a result.

    test : F statistic and adjusted p-value;  sure : covariance and degrees of freedom of the estimates
    delta : BIC less the lowest BIC
    """
    own = len(found.model.effects) - added  # the arm's own come first
    effects, specs = found.model.effects[own:], found.model.arm.effects
    ranges = joint_range(found.rows.postures, found.model.joint_types)
    origin = {"source": DIAGNOSED, **ranges, "scatter_mm": found.sigma}
    origin |= freedom_kept(found.model.names, sure.freedom)
    return Candidate(
        tuple(effect.label for effect in effects),
        specs[len(specs) - added :],
        tuple(sorted({effect.family for effect in effects})),
        delta,
        *test,
        estimates(found, sure, {p.name for effect in effects for p in effect.parameters}),
        Calibration(found.by_name, found.model.names, sure.covariance, MappingProxyType(origin)),
        intervals=sure.kind,
        reliance=sure.sentence,
        freedom=tuple(sure.freedom.tolist()),
    )


def estimates(found: Fit, sure: Uncertainty, names: set[str]) -> tuple[Estimate, ...]:
    """Estimates and 95 % intervals of the parameters with these names."""
    parameters, deviations = found.model.parameters, np.sqrt(np.diag(sure.covariance))
    limits = limits_95(parameters, found.values, deviations, sure.freedom)
    figures = np.column_stack([found.values, deviations, limits])
    rows = zip(parameters, figures, strict=True)
    return tuple(Estimate(p.name, p.file_unit, *(row * p.to_file).tolist()) for p, row in rows if p.name in names)


def trial_list(found: Findings) -> tuple[Trial, ...]:
    """Every effect tested against the base model, lowest BIC first; of a scanned setting only the best value."""
    test = found.selection.first
    best: dict[str, Trial] = {}
    for k, h in enumerate(test.members):
        trial = Trial(
            h.label,
            float(test.omnibus_test.f[k]),
            float(test.omnibus_test.p[k]),
            float(test.omnibus_test.adjusted[k]),
            float(test.change[k]),
        )
        if h.key not in best or trial.delta_bic < best[h.key].delta_bic:
            best[h.key] = trial
    return tuple(sorted(best.values(), key=lambda t: t.delta_bic))
