"""`Diagnosis`: the result of `diagnose`, with its JSON keys and its extended arm; and the verdict, which follows from
the probabilities of explanations (identification/README.md, "Verdict and predicting model").
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.arm import DIAGNOSED, Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.document import Documented, html
from identification.documents import diagnosis as words
from identification.documents.identification import unit_key
from identification.errors import InputError
from identification.estimation.repeats import Finding, Misfit
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.estimation.uncertainty import Uncertainty, WhiteRows, freedom_kept, limits_95, uncertainty
from identification.gap.average import Curve
from identification.gap.confirmation import Confirmation, Gap
from identification.gap.detectability import Detectability, Size
from identification.gap.fit import Fitted
from identification.gap.search import CREDIBLE, MOST, NEGLIGIBLE, Posterior
from identification.information import spectrum
from identification.kinematics.chain import CorrectedGeometry
from identification.kinematics.counting import joint_range
from identification.measurements import Conditions, Measurements, repeats_of, rms_distance
from identification.model import Model
from identification.model.placed import without_sessions

Names = tuple[str, ...]


# -- probabilities and verdict -----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Probabilities:
    """Posterior probabilities of all explanations, and the verdict that follows from them.

    explanations : sorted keys of a set of effects, () of nothing missing, None of something outside the library -> its
        probability, with sum 1
    places : place -> probability of something outside the library there, as part of the likeliest explanation
    titles : sorted keys -> title with the most probable settings, `base_offset + transmission_ripple:2[k=17]`
    """

    explanations: Mapping[Names | None, float]
    places: Mapping[str, float]
    titles: Mapping[Names, str] = field(default_factory=dict)

    def title(self, names: Names | None) -> str:
        """Title of an explanation."""
        return "unknown" if names is None else self.titles.get(names) or " + ".join(names) or "none"

    def of(self, keys: Iterable[str] | None) -> float:
        """Probability of an explanation; of effects by their keys in any order."""
        return self.explanations.get(None if keys is None else tuple(sorted(keys)), 0.0)

    @property
    def credible(self) -> dict[Names | None, float]:
        """Credible set: explanations with a total probability of about `CREDIBLE`, most probable first.

        The last one is included if more than half of its probability is needed, so that over many data sets the set
        contains the truth about as often as stated.
        """
        credible_set: dict[Names | None, float] = {}
        for names, p in sorted(self.explanations.items(), key=lambda pair: -pair[1]):
            if credible_set and sum(credible_set.values()) + 0.5 * p >= CREDIBLE:
                break
            credible_set[names] = p
        return credible_set

    @cached_property
    def sets(self) -> dict[Names, float]:
        """Sets of effects and their probabilities, likeliest first."""
        pairs = ((names, p) for names, p in self.explanations.items() if names)
        return dict(sorted(pairs, key=lambda pair: (round(pair[1], 9), pair[0]), reverse=True))

    @property
    def best(self) -> Names:
        """The likeliest set of effects, empty without any."""
        return next(iter(self.sets), ())

    @property
    def verdict(self) -> str:
        """`none`, `named`, `ambiguous` or `unknown`."""
        totals = {"none": self.of(()), "named": sum(self.sets.values()), "unknown": self.of(None)}
        likeliest = max(totals, key=lambda kind: round(totals[kind], 9))
        return "ambiguous" if likeliest == "named" and self.sets[self.best] < 0.5 else likeliest

    @property
    def rivals(self) -> list[Names]:
        """Candidates: sets of effects that are not much less likely than the likeliest, this first."""
        if self.verdict not in ("named", "ambiguous"):
            return []
        many = sum(p >= LEVEL * self.sets[self.best] for p in self.sets.values())
        return [*self.sets][: max(2 if self.verdict == "ambiguous" else 1, min(MOST, many))]

    @property
    def place(self) -> str | None:
        """Where something outside the library is likelier than not, if it exists; None: it may be anywhere."""
        place = max(self.places, key=lambda p: (round(self.places[p], 9), p), default=None)
        return None if place is None or self.places[place] < 0.5 * self.of(None) else place

    def not_none(self, p: float) -> Probabilities:
        """Where noise cannot leave so much with more than probability p: nothing is as much less likely."""
        nothing: dict[Names | None, float] = {(): self.of(()) * p, None: self.of(None) + self.of(()) * (1.0 - p)}
        return replace(self, explanations={**self.explanations, **nothing})


def probabilities(posterior: Posterior) -> Probabilities:
    """Probabilities of explanations, noise models and settings summed over."""
    totals, places, titles = defaultdict[Names | None, float](float), defaultdict[str, float](float), dict[Names, str]()
    for one in posterior.explanations:
        totals[one.named] += one.probability
        for place in {block.place for block in one.outside}:
            places[place] += one.probability
        if one.named is not None:
            titles.setdefault(one.named, " + ".join(b.label for b in one.effects))
    return Probabilities({names: min(p, 1.0) for names, p in totals.items()}, places, titles)


# -- estimates of named effects ----------------------------------------------------------------------------------------
class Estimate(NamedTuple):
    """Estimate of one parameter with its 95 % interval in the unit of files; NaN where the rows do not determine it."""

    name: str
    unit: str
    value: float
    std: float
    low_95: float
    high_95: float


@dataclass(frozen=True)
class Candidate:
    """A set of effects as a result.

    effects : labels such as `transmission_ripple:2[k=17]`;  classes : their classes, sorted
    specs : entries of an arm file in the same order (settings, no estimates)
    calibration : all estimates with their covariance;  parameters : those of the effects, for people
    limits_95 : name of a parameter of base or effects -> its 95 % interval [API units], cut at physical bounds
    uncertainty : of these estimates, the basis of the 95 % intervals
    rms : of what they leave of the rows that they were fitted to [mm]
    probability : that exactly these effects are missing, None where it is not that of these names
    delta_bic : -2 log odds to the best set
    """

    effects: Names
    classes: Names
    specs: tuple[EffectSpec, ...]
    calibration: Calibration
    parameters: tuple[Estimate, ...]
    limits_95: Mapping[str, tuple[float, float]]
    uncertainty: Uncertainty
    rms: float
    probability: float | None = None
    delta_bic: float = 0.0

    @classmethod
    def of(cls, fitted: Fitted, added: int, given: float | None = None, doubtful: bool = False) -> Self:
        """The last `added` effects of a fitted model as a result, with intervals as if no bound were active.

        given : sigma of the arm file;  doubtful : a noise model was estimated, so that the sandwich covariance is used
        """
        model, rows, sigma = fitted.model, fitted.rows, None if doubtful else fitted.rows.sigma or given
        jacobian, residual = fitted.jacobian / (sigma or 1.0), fitted.residual / (sigma or 1.0)
        tall = jacobian.reshape(len(rows), rows.dimension, -1), residual.reshape(len(rows), rows.dimension)
        at = rows.conditions
        repeats = repeats_of(rows.posture_numbers, at.marker, at.session, at.payload)
        parts = spectrum(jacobian, model.scales)
        table = WhiteRows(*tall, parts, parts.rank, rows.sequence, rows.posture_numbers, repeats)
        sure = uncertainty(table, sigma_given=sigma is not None, doubtful=doubtful)
        effects = model.effects[len(model.effects) - added :]  # the arm's own come first
        names = {p.name for effect in effects for p in effect.parameters}
        deviations = np.sqrt(np.maximum(np.diag(sure.covariance), 0.0))  # of a perfect fit
        # gravity has no moment about a vertical axis
        values, deviations = np.where(parts.identifiable, [fitted.values, deviations], np.nan)
        limits = limits_95(model.parameters, values, deviations, sure.freedom)
        figures = zip(model.parameters, np.column_stack([values, deviations, limits]), strict=True)
        return cls(
            tuple(effect.label for effect in effects),
            tuple(sorted({effect.family for effect in effects})),
            model.arm.effects[len(model.arm.effects) - added :],
            as_calibration(fitted, sure.covariance, sure.freedom, rows.postures),
            tuple(Estimate(p.name, p.file_unit, *(row * p.to_file).tolist()) for p, row in figures if p.name in names),
            dict(zip(model.names, map(tuple, limits.tolist()), strict=True)),
            sure,
            rms_distance(fitted.errors),
        )

    @property
    def title(self) -> str:
        """All effects with their settings: `axes_skew + transmission_ripple:2[k=18]`."""
        return " + ".join(self.effects)

    @property
    def keys(self) -> Names:
        """Names and joints without settings: `transmission_ripple:2`."""
        return tuple(spec.key for spec in self.specs)

    def to_json(self) -> dict[str, Any]:
        """An entry of `candidates` (identification/files/README.md, "JSON keys")."""
        entry = {name: getattr(self, name) for name in ("probability", "delta_bic")}
        owners, settings = {p.name.rpartition(".")[0] for p in self.parameters}, dict[str, float]()
        for label, spec in zip(self.effects, self.specs, strict=True):
            # `transmission_ripple:2.k` -> 17: under the name that the effect's parameters have
            owner = label if label in owners else spec.key
            settings |= {f"{owner}.{name}": value for name, value in spec.values.items()}
        return entry | {
            "intervals": self.uncertainty.kind,
            "effects": list(self.effects),
            "classes": list(self.classes),
            "p_adjusted": 1.0 - (self.probability or 0.0),
            "parameters": [p._asdict() for p in self.parameters],
            "settings": settings,
        }


def as_calibration(fitted: Fitted, covariance: Array, freedom: Array, postures: Array) -> Calibration:
    """Estimates (p,) as an arm file has them, with the postures (m, n) and the scatter [mm] that they come from."""
    names, joints = fitted.model.names, joint_range(postures, fitted.model.joint_types)
    origin = {"source": DIAGNOSED, **joints, "scatter_mm": fitted.sigma, **freedom_kept(names, freedom)}
    return Calibration(fitted.by_name, names, covariance, MappingProxyType(origin))


# -- everything together -----------------------------------------------------------------------------------------------
@dataclass(frozen=True, repr=False)
class Diagnosis(Documented):
    """Whether model and data disagree, where, which effect is missing, and the gap with that effect in the model.

    shape : best one of an unknown effect
    candidates, named : ambiguity set, and best set of effects;  predicting : the posterior's average, or the geometry
        alone where that predicts other rows better;  aliases : triples (effect, effect like it, likeness)
    measurements, residuals_before, residuals_after : the rows without copies, and (m, d) [mm] what base and predicting
        model leave;  kept : (m,) those that are no outliers;  scatter : significant properties of the noise
    outlier_rows, unexplained_rows : numbers in the data, from 1, of the rows left out, and of rows that the best set
        does not explain either, but that come together and stay in
    gap : RMS distances before and after;  sigma : noise of one coordinate estimated from the residuals [mm]
    detectability : smallest detectable sizes in these data
    misfit : test against the given sigma, None without one;  confirmation : on held-out rows, None without
    cross_validation : for other postures, and for another interval of time
    replication : entries of that key, one for each named effect;  curves : error curves of joints in the best set
    warnings : doubts about data and fit, to be read before the verdict;  notes : remarks
    offered : the extended model beside the geometry alone, None where it was not judged (`validate.judged`)
    in_sessions : the arm as it was fitted, with the bases of all sessions where there are several
    """

    arm: Arm
    in_sessions: Arm
    measurements: Measurements
    residuals_before: Array
    residuals_after: Array
    kept: NDArray[np.bool_]
    candidates: tuple[Candidate, ...]
    named: Candidate
    predicting: Candidate
    aliases: tuple[tuple[str, str, float], ...]
    shape: str | None
    scatter: tuple[Finding, ...]
    outlier_rows: tuple[int, ...]
    gap: Gap
    detectability: Detectability
    sigma: float
    probabilities: Probabilities
    misfit: Misfit | None = None
    confirmation: Confirmation | None = None
    cross_validation: tuple[Confirmation, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    replication: tuple[Mapping[str, Any], ...] = ()
    curves: tuple[Curve, ...] = ()
    unexplained_rows: tuple[int, ...] = ()
    offered: Mapping[str, Any] | None = None

    @property
    def verdict(self) -> str:
        """That of the probabilities."""
        return self.probabilities.verdict

    @property
    def where(self) -> str | None:
        """Place of an unknown effect."""
        return self.probabilities.place if self.verdict == "unknown" else None

    @property
    def effects(self) -> Names:
        """Labels of the best set; empty if nothing is named."""
        return self.named.effects

    @property
    def excluded(self) -> Mapping[str, Size]:
        """Effect -> smallest size that a test of these data would have shown with 90 % power."""
        return self.detectability.detectable

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        return str(self.to_json()["sentence"])

    @property
    def probability(self) -> dict[str, float]:
        """Probability of `none`, of each candidate (by title), of `unknown`, something outside the library, and of
        `other sets` of effects, with sum 1."""
        shares = {"none": self.probabilities.of(())}
        shares |= {c.title: self.probabilities.of(c.keys) for c in self.candidates if self.verdict != "unknown"}
        shares["unknown"] = self.probabilities.of(None)
        rest = 1.0 - sum(shares.values())
        return shares | ({"other sets": rest} if rest > 1e-9 else {})

    @property
    def confirmed(self) -> bool | None:
        """Whether the hold-out confirms the verdict; None without one, if it has too few rows, or if what is left of
        the data or of the hold-out is more than the given sigma explains: then more is missing than was found."""
        if (test := self.confirmation) is None:
            return None
        unexplained = test.beyond_sigma or (self.misfit is not None and self.misfit.significant)
        return None if test.confirmed and unexplained else test.confirmed

    def extended_arm(self, candidate: Candidate | None = None, in_sessions: bool = False) -> Arm:
        """The arm with the effects of the predicting model (or of `candidate`) added, calibrated by it: all estimates,
        with the verdict, its rivals and its confirmation as provenance; where it stood in the first session, or in all
        of them."""
        chain = replace(self.arm.chain, tools=self.in_sessions.chain.tools)  # later sessions may have further points
        chosen, arm = candidate or self.predicting, self.in_sessions if in_sessions else replace(self.arm, chain=chain)
        fitted = chosen.calibration if in_sessions else without_sessions(chosen.calibration)
        entries: dict[str, Any] = {name: value for name, value in self.measurements.origin.items() if name != "rows"}
        entries |= {"verdict": self.verdict, "sentence": self.sentence}
        better, gap = None if self.offered is None else self.offered["better"], self.gap
        optional = {"confirmed": self.confirmed, "better_than_geometry": better, **gap.to_json()}
        if candidate is not None:  # nothing else is known of it
            optional = Gap(gap.rms_before, candidate.rms, gap.floor).to_json()
        entries |= {name: value for name, value in optional.items() if value is not None}
        entries["delta_bic"] = {c.title: c.delta_bic for c in self.candidates if c.effects}
        entries["probability"] = self.probability
        provenance = MappingProxyType({**fitted.provenance, **entries})
        # with the values that a fit of a `practical` spatial arm took as they were, and where base and points are
        kept = {} if arm.calibration is None else arm.calibration.values
        values = {name: kept.get(name, 0.0) for name in sorted(arm.chain.fixed)} | dict(fitted.values)
        places = CorrectedGeometry(arm.chain, values).places
        calibration = replace(fitted, provenance=provenance, values=values, **places)
        return replace(arm, effects=(*arm.effects, *chosen.specs), calibration=calibration)

    def predictions(
        self, postures: Array, payload: Array | None, directions: Array
    ) -> Iterator[tuple[Array, Array, Array, Array]]:
        """What each candidate predicts at postures (N, n) at the end of the last session, with payloads (N,) [kg],
        None: that of the arm, and directions of approach (N, n) as the controller counts: positions (N, d), Jacobians
        (N, d, p), the covariance (p, p) of the parameters, fitted to the data at hand, and their scales (p,)."""
        last = np.full(len(postures), self.measurements.numbers("session").max())
        of_joints = np.nan_to_num(self.arm.counting.signs_of_columns(directions, back=True))  # as a file says
        conditions = Conditions(payload, None, np.full(len(postures), 0.5), of_joints, last.astype(float))
        for candidate in self.candidates:
            model, fit = Model(self.extended_arm(candidate, in_sessions=True)), candidate.calibration
            if fit.covariance is None:
                raise InputError("diagnosis: a candidate has no covariance, allowed: the result of diagnose()")
            order = [fit.parameter_names.index(name) for name in model.names]
            yield *model.linearize(postures, None, conditions), fit.covariance[np.ix_(order, order)], model.scales

    @property
    def needs(self) -> frozenset[str]:
        """What the effects of all candidates need of arm and data."""
        return frozenset().union(*(Model(self.extended_arm(one)).needs for one in self.candidates))

    def to_json(self) -> dict[str, Any]:
        """Keys of `diagnose` (identification/files/README.md, "JSON keys")."""
        # further sets of effects that are not negligible
        listed, likely = {tuple(sorted(c.keys)) for c in self.candidates}, self.probabilities
        others = {names: p for names, p in likely.sets.items() if p >= NEGLIGIBLE and names not in listed}
        lists = ("warnings", "effects", "outlier_rows", "unexplained_rows", "notes")
        data: dict[str, Any] = {name: getattr(self, name) for name in ("verdict", "where", "shape", "confirmed")}
        data |= {name: list(getattr(self, name)) for name in lists}
        data |= {
            "named": self.named.to_json(),
            "candidates": [c.to_json() for c in self.candidates],
            "probabilities": self.probability,
            "credible_set": [likely.title(names) for names in likely.credible],
            "other_sets": [{"effects": likely.title(n).split(" + "), "probability": p} for n, p in others.items()],
            "classes": list(self.named.classes),
            "aliases": [{"effect": a, "like": b, "likeness": c} for a, b, c in self.aliases],
            "replication": list(self.replication),
            "curves": [curve.to_json() for curve in self.curves],
            "scatter": [{"finding": f.name, "p": f.p, "size": f.size} for f in self.scatter],
            "excluded": {name: size._asdict() for name, size in self.excluded.items()},
            "gap": self.gap.to_json(),
            "offered": self.offered,
            "confirmation": self.confirmation and self.confirmation.to_json(),
            "cross_validation": [test.to_json() for test in self.cross_validation],
            "misfit": self.misfit and self.misfit._asdict(),
            "rows": len(self.measurements),
            "sigma_mm": self.sigma,
            "degrees_of_freedom": self.detectability.freedom,
            "predicting": [spec.key for spec in self.predicting.specs],
            **unit_key(self.arm),
        }
        return data | {"sentence": " ".join([*words.diagnosis_verdict(data), *words.findings(data)])}

    document = words.diagnosis_document

    def _repr_html_(self) -> str:
        return html(self.document(), picture=None)
