"""Whether measurements are enough: their numbers against the parameters, what these determine, and how sure the arm is.

With few rows the residuals hardly say what the noise is. The accuracy is then that of the sigma that is given, or of
what repeats scatter by; where neither is known, neither is the accuracy.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from identification.document import of_joints
from identification.estimation import Identification, estimate
from identification.estimation.estimate import UNUSUAL
from identification.gap.noise import NoiseFloor
from identification.kinematics.parameters import JOINT_OFFSET, LENGTH_ERROR, Parameter
from identification.measurements import POINT, Measurements

GEOMETRY = {LENGTH_ERROR: "length", JOINT_OFFSET: "zero"}
SOURCES = {"sigma": "for the sigma_mm given", "repeats": "for what repeats scatter by", "residuals": "by the residuals"}


@dataclass(frozen=True)
class Sufficiency:
    """What rows can say of a model.

    numbers, parameters : equations and unknowns;  spare : equations that are left to judge the fit
    held : how many of the parameters have a prior of their own, as the geometry of an arm in space
    identifiable : what is determined, in words;  open : combinations that are not
    weak : (name, standard deviation, unit) of parameters that are estimated, but too uncertain to be of use
    tip, tip_measured : expected error of the tip [mm], over the joint limits and at postures like those measured; None:
        not known
    source : of the noise in it, of `SOURCES`; None: not known
    """

    numbers: int
    parameters: int
    spare: int
    held: int
    identifiable: tuple[str, ...]
    open: tuple[str, ...]
    weak: tuple[tuple[str, float, str], ...]
    tip: float | None
    tip_measured: float | None
    source: str | None

    @property
    def few(self) -> bool:
        """Whether fewer numbers are left over than there are parameters: a good fit says little then."""
        return self.spare < self.parameters - self.held

    @property
    def count(self) -> str:
        """`10 numbers for 8 parameters: 2 left to judge the fit`."""
        held = f" ({self.held} held by [machining])" if self.held else ""
        return f"{self.numbers} numbers for {self.parameters} parameters{held}: {self.spare} left to judge the fit"

    @property
    def accuracy(self) -> str:
        """How far the tip may be off, in words."""
        if self.tip is None or self.tip_measured is None or self.source is None:
            why = "something is not determined" if self.open else "needs sigma_mm, repeats of a posture or more rows"
            return f"not known: {why}"
        inside = f"{self.tip_measured:.3g} mm at the tip at postures like those measured"
        return f"{inside}, {self.tip:.3g} mm over the joint limits (RMS), {SOURCES[self.source]}, if the model is right"

    def to_json(self) -> dict[str, Any]:
        """Keys of `check` (identification/files/README.md, "JSON keys")."""
        return {
            "numbers": self.numbers,
            "parameters": self.parameters,
            "spare_numbers": self.spare,
            "identifiable": self.identifiable,
            "weakly_determined": [{"name": name, "std": std, "unit": unit} for name, std, unit in self.weak],
            "expected_tip_mm": self.tip,
            "expected_tip_measured_mm": self.tip_measured,
            "expected_tip_from": self.source,
        }


def sufficiency(fit: Identification, measurements: Measurements, floor: NoiseFloor) -> Sufficiency:
    """What these rows can say of the model that was fitted to them.

    floor : what repeats scatter by
    """
    held = frozenset(fit.prior.names) if fit.prior is not None else frozenset[str]()
    parameters, spare = len(fit.names), max(fit.dof, 0)
    judged: Identification | None = fit
    source = None if fit.expected_tip is None else "sigma" if fit.uncertainty.kind == "given" else "residuals"
    if spare < parameters - len(held):  # few: the noise has to be known without the fit
        judged, source = None, None
        if fit.sigma_known:
            judged, source = estimate(fit.model, measurements, sigma="given"), "sigma"
        elif floor.value:
            sigma = floor.value / float(np.sqrt(fit.residuals_after[:, POINT].shape[1]))
            judged, source = estimate(fit.model, measurements, sigma=sigma), "repeats"
    weak = _weak(judged or fit)
    return Sufficiency(
        numbers=fit.residuals_after.size,
        parameters=parameters,
        spare=spare,
        held=len(held),
        identifiable=_in_words(fit, held, {name for name, *_ in weak}),
        open=fit.not_identifiable,
        weak=weak,
        tip=None if judged is None else judged.expected_tip,
        tip_measured=None if judged is None else judged.expected_tip_measured,
        source=source,
    )


def _weak(fit: Identification) -> tuple[tuple[str, float, str], ...]:
    """(name, standard deviation, unit) of parameters without a prior, as where base and reflector are, that stay more
    uncertain than the frames of the arm by `UNUSUAL` times, though the machining holds these.

    Where nothing is held, such combinations are not estimated at all (`estimation.estimate`).
    """
    if fit.prior is None or fit.model.arm.chain.planar:
        return ()
    machining = fit.model.arm.machining
    far = {"mm": UNUSUAL * machining.translation, "rad": UNUSUAL * machining.rotation}
    stds = zip(fit.model.parameters, fit.std.tolist(), strict=True)
    free = [(p, std) for p, std in stds if p.name not in fit.prior.names]
    return tuple((p.name, std * p.to_file, p.file_unit) for p, std in free if std > far.get(p.unit, np.inf))


def _in_words(fit: Identification, held: Set[str], weak: Set[str]) -> tuple[str, ...]:
    """`length of links 1 to 3`, `zero of joints 1 to 3`, `base_offset`: what is determined, by kind; of one that is
    partly weak, what is not: `base (x, y, rx, ry, rz)`."""
    kinds: dict[str, list[Parameter]] = {}
    for parameter, determined in zip(fit.model.parameters, fit.identifiable, strict=True):
        if determined:
            kind = parameter.name.partition(".")[0].partition(":")[0]
            kind = GEOMETRY.get(kind, "frame, held by [machining]," if parameter.name in held else kind)
            kinds.setdefault(kind, []).append(parameter)
    words = []
    for kind, parameters in kinds.items():
        sure = [p.short for p in parameters if p.name not in weak]
        if joints := sorted({p.joint for p in parameters if p.joint is not None}):
            which = of_joints(joints)
            name = f"{kind} of {which.replace('joint', 'link') if kind == GEOMETRY[LENGTH_ERROR] else which}"
        else:
            name = kind if len(sure) == len(parameters) else f"{kind} ({', '.join(sure)})"
        words += [name] if sure else []
    return tuple(words)
