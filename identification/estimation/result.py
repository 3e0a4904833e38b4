"""What an identification found, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identification.arm import Arm, Calibration
from identification.arrays import Array, readonly
from identification.data_frames import frame_of_rows
from identification.document import Document
from identification.documents import identification as shown
from identification.estimation.corrected_values import CorrectedValue, corrected_values
from identification.estimation.doubts import Contradiction, contradiction_warnings
from identification.estimation.expected_tip import hardly_determined, tip_of
from identification.estimation.prior import Prior
from identification.estimation.uncertainty import LEVEL, Uncertainty, freedom_kept, limits_95
from identification.kinematics.corrected import CorrectedGeometry
from identification.kinematics.parameters import JOINT_OFFSET, LENGTH_ERROR, by_joint, orientation_transform
from identification.measurements import POINT, distances, rms_distance
from identification.model import Model
from identification.status import Status


@dataclass(frozen=True, eq=False)
class Identification:
    """Estimated parameters of a model, in the order of `model.parameters` and in API units [mm, rad].

    parameters : (p,) estimates; along what is not estimable, values of the size of the others (from the nominal arm and
        the model without effects), good for computing positions and for nothing else
    covariance : (p, p) sigma^2 (sum J^T W J)^-1 (eq. 16) or the one that holds with misfit (see `uncertainty`), zero
        along what is not estimable; NaN if sigma is unknown and no equation is left over to estimate it
    identifiable : (p,) True where the parameter itself is estimable from the data
    not_identifiable : combinations of parameters that the data do not determine, in words
    sigma : standard deviation of one coordinate [mm] (with sigma per row: their root mean square; with relative
        weights: of a row of weight one); None if it is unknown
    sigma_known : given beforehand, or else estimated as sqrt(weighted sum of squares / dof)
    chi2 : weighted sum of squares in units of sigma^2, None if sigma was not known
    dof : d m equations minus the number of estimable combinations
    residuals_before, residuals_after : (m, d) measured minus computed [mm], with the arm as it was and as identified
    uncertainty : what covariance and intervals rely on: the sigma given, the scatter, or a sandwich that is robust to
        what is left unexplained
    scatter : standard deviation of one coordinate that the residuals show [mm], None without spare equations
    postures : (k, n) measured [rad, mm], each once for every marker and session;  determined : how many combinations
        the data determine, the effective number of parameters
    doubts : what is doubtful about the fit, in sentences
    outlier_rows : numbers from 1 of single rows that the model does not explain, which are in the fit all the same
    unexplained_rows : the same of rows that come together, by posture or joint angle: what the model lacks there
    prior : of the parameters, as it was taken;  machining_factor : on the sizes of [machining] in it, None: not in it
    contradictions : parameters whose prior, an earlier calibration, the measurements contradict
    flange_turns : (3,) see `expected_tip.flange_turns`, of a fit of both base and measured points; None: of others
    covariance_seen : (p, p) with the noise that is there without that prior; None: no such prior
    """

    model: Model
    parameters: Array
    covariance: Array
    identifiable: NDArray[np.bool_]
    not_identifiable: tuple[str, ...]
    sigma: float | None
    sigma_known: bool
    chi2: float | None
    dof: int
    residuals_before: Array
    residuals_after: Array
    method: str
    status: Status
    uncertainty: Uncertainty
    scatter: float | None
    postures: Array
    determined: float
    doubts: tuple[str, ...] = ()
    outlier_rows: tuple[int, ...] = ()
    unexplained_rows: tuple[int, ...] = ()
    prior: Prior | None = None
    machining_factor: float | None = None
    contradictions: tuple[Contradiction, ...] = ()
    covariance_seen: Array | None = None
    flange_turns: Array | None = None
    iterations: int = 1
    provenance: MappingProxyType[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        for name in ("parameters", "covariance", "residuals_before", "residuals_after", "postures"):
            object.__setattr__(self, name, readonly(getattr(self, name)))
        self.identifiable.setflags(write=False)

    # -- parameters and their uncertainty --------------------------------------------------------------------------
    @property
    def names(self) -> tuple[str, ...]:
        """(p) names of the parameters."""
        return self.model.names

    @cached_property
    def std(self) -> Array:
        """(p,) standard deviations; NaN where a parameter is not estimable."""
        return readonly(np.where(self.identifiable, np.sqrt(np.diag(self.covariance)), np.nan))

    @cached_property
    def intervals(self) -> Array:
        """(p, 2) 95 % confidence limits, cut at the physical bounds; NaN where a parameter is not estimable.

        Normal quantile where they rely on a given sigma, else Student's t.
        """
        return readonly(limits_95(self.model.parameters, self.parameters, self.std, self.uncertainty.freedom))

    @property
    def p_value(self) -> float | None:
        """Probability of a chi2 at least this large if model and sigma are right; None if sigma was not known."""
        return None if self.chi2 is None or self.dof == 0 else float(chdtrc(self.dof, self.chi2))

    @cached_property
    def expected_tip(self) -> float | None:
        """How far the tip may be from where this fit computes it [mm], RMS over the joint limits; None: not known."""
        return tip_of(self, measured=False)

    @cached_property
    def expected_tip_measured(self) -> float | None:
        """The same over further postures like those measured."""
        return tip_of(self, measured=True)

    @property
    def misfit(self) -> str | None:
        """What chi2 says where it rejects the model or the sigma given, and what follows for the intervals."""
        if self.p_value is None or self.p_value >= LEVEL or self.scatter is None or not self.sigma:
            return None
        return shown.misfit_sentence(self, self.p_value, self.scatter / self.sigma)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings to be read before the results."""
        prior = () if self.prior is None else self.prior.names
        without_prior = [p for p in getattr(self.model, "parameters", ()) if p.name not in prior]
        misfit = (*contradiction_warnings(self.contradictions, without_prior), *((self.misfit,) if self.misfit else ()))
        doubts = (*self.doubts, *hardly_determined(self))
        if self.status is Status.iteration_limit:
            return (shown.UNFINISHED, *misfit, *doubts)
        return (*doubts, *misfit) if self.status is Status.implausible else (*misfit, *doubts)

    @cached_property
    def shown_names(self) -> tuple[str, ...]:
        """(p) names for people, in which an effect always has its settings: `transmission_ripple:2[k=17].a`."""
        full = {p.name: f"{effect.label}.{p.short}" for effect in self.model.effects for p in effect.parameters}
        return tuple(full.get(name, name) for name in self.names)

    @cached_property
    def _everything(self) -> dict[str, float]:
        """Name -> value of every parameter, the known ones included."""
        return dict(self.model.fixed) | self.model.parameters.mapping(self.parameters)

    @cached_property
    def length_errors(self) -> Array:
        """(n,) dl_j [mm]."""
        return by_joint(self._everything, LENGTH_ERROR)

    @cached_property
    def joint_offsets(self) -> Array:
        """(n,) dq_j [rad]."""
        return by_joint(self._everything, JOINT_OFFSET)

    @cached_property
    def joint_offset_std(self) -> Array:
        """(n,) standard deviations of dq_j [rad]; zero where known, NaN where not estimable."""
        every = self.model.all_parameters
        return readonly(every.vector(self.model.parameters.mapping(self.std), default=0.0)[every.indices(JOINT_OFFSET)])

    @cached_property
    def orientation_std(self) -> Array:
        """(n,) standard deviations of dtheta_j [rad], the paper's sigma_q (eq. 25); NaN where not estimable."""
        every = self.model.all_parameters
        transform = orientation_transform(every)[:, [every.index(name) for name in self.names]]
        variance = np.einsum("jk,kl,jl->j", transform, self.covariance, transform)
        estimable = np.all((transform == 0.0) | self.identifiable, axis=1)
        return readonly(np.where(estimable, np.sqrt(np.maximum(variance, 0.0)), np.nan))

    # -- quality of the fit ----------------------------------------------------------------------------------------
    @property
    def rms_before(self) -> float:
        """Root mean square over rows of the distance [mm], arm as it was."""
        return rms_distance(self.residuals_before)

    @property
    def rms_after(self) -> float:
        """Root mean square over rows of the distance [mm], arm as identified."""
        return rms_distance(self.residuals_after)

    @property
    def max_before(self) -> float:
        """Largest distance over rows [mm], arm as it was."""
        return float(np.max(distances(self.residuals_before)))

    @property
    def max_after(self) -> float:
        """Largest distance over rows [mm], arm as identified."""
        return float(np.max(distances(self.residuals_after)))

    @property
    def rms_angles(self) -> tuple[float, float] | None:
        """Root mean squares over rows of the angles between measured and computed orientations [rad], arm as it was and
        as identified; None where none are measured."""
        arm = getattr(self.model, "arm", None)
        if arm is None or (scale := arm.chain.angle_scale) is None:
            return None
        before, after = (rms_distance(r[:, POINT.stop :]) for r in (self.residuals_before, self.residuals_after))
        return before / scale, after / scale

    # -- onward ----------------------------------------------------------------------------------------------------
    def calibration(self) -> Calibration:
        """What an arm file keeps of this: all of `parameters`, and the known values."""
        cov = self.covariance if np.all(np.isfinite(self.covariance)) else None
        figures = {k: v for k, v in self._summary().items() if v is not None and k not in _NOT_KEPT}
        freedom = freedom_kept(self.names, self.uncertainty.freedom)
        provenance = MappingProxyType({**self.provenance, **figures, **freedom})
        calibration = Calibration(self._everything, self.names, cov, provenance)
        if (geometry := self.geometry) is None:
            return calibration
        return replace(calibration, base=geometry.base, tools=geometry.tools, tool_axes=geometry.tool_axes)

    @cached_property
    def geometry(self) -> CorrectedGeometry | None:
        """A spatial arm's geometry as identified: base, measured points, joints; None in the plane."""
        arm = getattr(self.model, "arm", None)
        if arm is None or arm.chain.planar:
            return None
        return CorrectedGeometry(arm.chain, self._everything, arm.counting)

    def calibrated_arm(self) -> Arm:
        """The arm with this calibration in it."""
        return replace(self.model.arm, calibration=self.calibration())

    def to_json(self) -> dict[str, Any]:
        """Keys of `identify` (identification/files/README.md, "JSON keys"): file units, null for unknown values."""
        return {**self._summary(), "corrected_values": [row.to_json() for row in self.corrected_values]}

    def _summary(self) -> dict[str, Any]:
        return {
            "parameters": self.rows(),
            "not_identifiable": list(self.not_identifiable),
            "sigma_mm": self.sigma,
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "rms_before_mm": self.rms_before,
            "rms_after_mm": self.rms_after,
            "max_before_mm": self.max_before,
            "max_after_mm": self.max_after,
            "expected_tip_mm": self.expected_tip,
            "expected_tip_measured_mm": self.expected_tip_measured,
            **dict(zip(("rms_before_deg", "rms_after_deg"), np.degrees(self.rms_angles or ()).tolist(), strict=False)),
            "method": self.method,
            "status": self.status.name,
            "warnings": list(self.warnings),
            "outlier_rows": list(self.outlier_rows),
            "unexplained_rows": list(self.unexplained_rows),
            "scatter_mm": self.scatter,
            **({} if self.machining_factor is None else {"machining_factor": self.machining_factor}),
            "intervals": self.uncertainty.kind,
            "clusters": self.uncertainty.clusters
            and {"kind": self.uncertainty.clusters, "count": self.uncertainty.count},
            **({} if self.geometry is None else self.geometry.to_json()),
        }

    @cached_property
    def corrected_values(self) -> tuple[CorrectedValue, ...]:
        """Values for the controller: nominal and corrected lengths, zeros, frames, effects; empty without an arm."""
        if not isinstance(getattr(self.model, "arm", None), Arm):
            return ()
        calibration = Calibration(self._everything, self.names, self.covariance)
        unknown = [name for name, estimable in zip(self.names, self.identifiable, strict=True) if not estimable]
        prior_factor = None if self.prior is None else self.prior.factor(self.model.parameters)
        return corrected_values(
            self.model.arm, calibration, self.uncertainty.freedom, unknown, prior_factor, self.covariance_seen
        )

    def to_frame(self, kind: str = "polars") -> Any:
        """`corrected_values` as a frame, polars or pandas."""
        return frame_of_rows([row.to_json() for row in self.corrected_values], kind)

    def rows(self) -> list[dict[str, Any]]:
        """One entry of `parameters` for each parameter, in file units."""
        values = np.where(self.identifiable, self.parameters, np.nan)
        rows = zip(self.model.parameters, values, self.std, *self.intervals.T, strict=True)
        return [
            {"name": p.name, "unit": p.file_unit}
            | {k: float(v * p.to_file) if np.isfinite(v) else None for k, v in zip(shown.COLUMNS, figures, strict=True)}
            for p, *figures in rows
        ]

    @property
    def outcome(self) -> str:
        """How the fit ended, in a sentence."""
        closed = self.method == "linear" and self.status is Status.converged
        return "Closed form, the exact global minimum." if closed else self.status.value

    def document(self) -> Document:
        """The parameters with their intervals, and how well the model fits."""
        return shown.parameters_document(self)

    def __str__(self) -> str:
        return str(self.document())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return self.document()._repr_html_()


# by a calibration, which has them elsewhere or is read without them
_NOT_KEPT = (
    "parameters",
    "p_value",
    "status",
    "warnings",
    "outlier_rows",
    "unexplained_rows",
    "clusters",
    "base",
    "tools",
    "geometry",
    "joint_offsets",
    "strict_table",
)
