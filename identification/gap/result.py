"""`Diagnosis`, the result of `diagnose`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.data_frames import frame_of_rows
from identification.gap import summary
from identification.gap.candidate import Candidate
from identification.gap.choice_validation import ChoiceValidation
from identification.gap.confirmation import Confirmation
from identification.gap.curve import Curve
from identification.gap.detectability import Detectability, Size
from identification.gap.holdout import Gap
from identification.gap.library_prior import LibraryPrior
from identification.gap.misfit import Misfit
from identification.gap.noise import Finding
from identification.gap.order_range import OrderRange
from identification.gap.probabilities import Probabilities
from identification.gap.replication import Replication
from identification.gap.rounds import Round
from identification.minimal import placed_calibration


@dataclass(frozen=True)
class Trial:
    """One effect against the base model: F, its p-value alone and adjusted for all effects tried, change of BIC."""

    effect: str
    f: float
    p: float
    p_adjusted: float
    delta_bic: float


@dataclass(frozen=True)
class Residuals:
    """(m, d) residuals [mm] of base and named model over all rows, and (m,) what to draw them against, by name."""

    before: Array
    after: Array
    against: Mapping[str, Array]
    positions: Array


@dataclass(frozen=True)
class Diagnosis:
    """Whether model and data disagree, where, which effect is missing, and what is left with it in the model.

    verdict : `none`, `named`, `ambiguous` or `unknown`;  where : place of an unknown effect, with the shape seen there
    rounds : what each round of naming added, and the gap it left
    shapes : named waves that the range of their joint cannot tell from their neighbors
    replication : of several sessions, what each named effect is in each
    warnings : what is doubtful about the fit, to be read before the verdict is believed
    curves : error curves of joints that are part of the best set
    prior : what is held by it beside the named effects, None without;  data : `file` and `sha256` of the rows, if known
    trials : every effect against the base model;  detectability : what the plan could show
    misfit : what is left against the sigma given, None without one;  confirmation : by held-out rows, None without
    choice : the effects chosen anew without a part of the rows; None where that was not tried
    cross_validation : whether the named model holds for other postures, and for another stretch of time
    """

    arm: Arm
    verdict: str
    candidates: tuple[Candidate, ...]
    named: Candidate
    aliases: tuple[tuple[str, str, float], ...]
    where: str | None
    shape: str | None
    scatter: tuple[Finding, ...]
    outlier_rows: tuple[int, ...]
    gap: Gap
    trials: tuple[Trial, ...]
    detectability: Detectability
    residuals: Residuals
    sigma: float
    probabilities: Probabilities
    choice: ChoiceValidation | None = None
    misfit: Misfit | None = None
    confirmation: Confirmation | None = None
    cross_validation: tuple[Confirmation, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    shapes: tuple[OrderRange, ...] = ()
    rounds: tuple[Round, ...] = ()
    replication: tuple[Replication, ...] = ()
    curves: tuple[Curve, ...] = ()
    prior: LibraryPrior | None = None
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the best set; empty if nothing is named."""
        return self.named.effects

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of the best set."""
        return self.named.classes

    @property
    def excluded(self) -> Mapping[str, Size]:
        """Effect -> smallest size that these data would have shown."""
        return self.detectability.detectable

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        return summary.sentence(self)

    @property
    def probability(self) -> dict[str, float]:
        """Of `none`, of every candidate (its title) and of `unknown`, which is anything else; they sum to 1.

        Curves that describe what is unknown are no name for it: their set has 0, and `unknown` has what they explain.
        """
        found = {"none": self.probabilities.none} | {c.title: c.probability or 0.0 for c in self.candidates}
        return found | {"unknown": max(0.0, 1.0 - sum(found.values()))}

    @property
    def likely(self) -> str:
        """The probabilities in one line, with the sets of effects that are no candidates but not unlikely."""
        other = ", ".join(f"{name} {p:.2f}" for name, p in self.other_sets.items())
        short = {c.title: "what is named" for c in self.candidates[:1] if len(c.title) > summary.SHORT}
        text = ", ".join(f"{short.get(name, name)} {p:.2f}" for name, p in self.probability.items() if p >= 0.005)
        tries = "the tries without a fifth of the rows"
        again = f"; chosen again in {100.0 * self.choice.again:.0f} % of {tries}" if self.choice else ""
        curves = ", a cause without a name, which the curves describe" if summary.described(self) else ""
        return f"probability: {text}{curves}" + (f" (of that {other})" if other else "") + again

    @property
    def other_sets(self) -> dict[str, float]:
        """Sets of effects that are no candidates but not unlikely: parts of the probability of `unknown`."""
        beside = self.probabilities.beside(c.keys for c in self.candidates)
        return {self.probabilities.title(names): p for names, p in beside.items()}

    @property
    def credible_set(self) -> dict[str, float]:
        """The fewest explanations that together have a probability of 90 %, likeliest first."""
        titles = {tuple(sorted(c.keys)): c.title for c in self.candidates}
        titles |= {(): "none"}
        found = self.probabilities.credible.items()
        return {"unknown" if n is None else titles.get(n) or self.probabilities.title(n): p for n, p in found}

    @property
    def tests(self) -> tuple[Confirmation, ...]:
        """What rows that were not used for the fits say: the hold-out, and cross-validation."""
        return (() if self.confirmation is None else (self.confirmation,)) + self.cross_validation

    @property
    def confirmed(self) -> bool | None:
        """Whether the hold-out confirms the verdict; None where it has too few rows.

        Without a hold-out False where cross-validation refutes it, else None: the effects were chosen with all rows.
        """
        if self.confirmation is not None:
            return self.confirmation.confirmed
        return False if any(test.confirmed is False for test in self.cross_validation) else None

    def extended_arm(self, candidate: Candidate | None = None) -> Arm:
        """The arm with the effects of the best set (or of `candidate`) in its model, to be estimated, and the fitted
        values as its calibration."""
        chosen = candidate or self.named
        calibration = self.calibration if candidate is None else chosen.calibration
        return replace(self.arm, effects=(*self.arm.effects, *chosen.specs, *chosen.held), calibration=calibration)

    @property
    def calibration(self) -> Calibration:
        """Everything estimated with the best set, and where it comes from: verdict, rivals, what confirms it."""
        said: dict[str, Any] = {**self.data, "verdict": self.verdict, "sentence": self.sentence}
        if self.confirmed is not None:
            said["confirmed"] = self.confirmed
        said |= {name: value for name, value in self.gap.to_json().items() if value is not None}
        said["delta_bic"] = {c.title: c.delta_bic for c in self.candidates if c.effects}
        said["probability"] = self.probability
        named = self.named.calibration
        named = replace(named, provenance=MappingProxyType({**named.provenance, **said}))
        return placed_calibration(self.arm, named)

    def to_json(self) -> dict[str, Any]:
        """Keys of `diagnose` (identification/files/README.md, "JSON keys")."""
        return {
            "verdict": self.verdict,
            "sentence": self.sentence,
            "warnings": list(self.warnings),
            "effects": list(self.effects),
            "named": self.named.to_json(),
            "candidates": [c.to_json() for c in self.candidates],
            "probabilities": self.probability,
            "credible_set": list(self.credible_set),
            "chosen_again": None if self.choice is None else self.choice.again,
            "other_sets": [{"effects": name.split(" + "), "probability": p} for name, p in self.other_sets.items()],
            "classes": list(self.classes),
            "aliases": [{"effect": a, "like": b, "likeness": c} for a, b, c in self.aliases],
            "where": self.where,
            "shape": self.shape,
            "shapes": [shape.to_json() for shape in self.shapes],
            "replication": [effect.to_json() for effect in self.replication],
            "curves": [curve.to_json() for curve in self.curves],
            "scatter": [{"finding": f.name, "p": f.p, "size": f.size} for f in self.scatter],
            "outlier_rows": list(self.outlier_rows),
            "excluded": {name: vars(size) for name, size in self.excluded.items()},
            "gap": self.gap.to_json(),
            "confirmed": self.confirmed,
            "confirmation": None if self.confirmation is None else self.confirmation.to_json(),
            "cross_validation": [test.to_json() for test in self.cross_validation],
            "misfit": None if self.misfit is None else self.misfit.to_json(),
            "rows": len(self.residuals.before),
            "sigma_mm": self.sigma,
            "degrees_of_freedom": self.detectability.freedom,
            "trials": [vars(t) for t in self.trials],
            "rounds": [one.to_json() for one in self.rounds],
            "notes": list(self.notes),
        } | ({} if self.prior is None else {"prior": self.prior.to_json()})

    def to_frame(self, kind: str = "polars") -> Any:
        """A row for each parameter of each candidate set of effects, polars or pandas."""
        sets = [({"effects": c.title, "probability": c.probability}, c.parameters) for c in self.candidates]
        return frame_of_rows([{**said, **vars(p)} for said, parameters in sets for p in parameters], kind)

    def __str__(self) -> str:
        return summary.text(self)

    def _repr_html_(self) -> str:
        return summary.html(self)
