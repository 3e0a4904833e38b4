"""What an identification found, with its uncertainty."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identification.arm import Arm, Calibration
from identification.arrays import Array, readonly
from identification.data_frames import frame_of_rows
from identification.document import Document
from identification.documents import identification as shown
from identification.estimation.doubts import Contradiction, contradiction_warnings, hardly_determined, tip_of
from identification.estimation.problem import Prior
from identification.estimation.uncertainty import LEVEL, Uncertainty, freedom_kept, freedom_of, limits_95, quantile_95
from identification.kinematics.chain import STANDARD, DHRow, KinematicChain
from identification.kinematics.corrected import CorrectedGeometry, Link, corrected, corrected_links, drawn_links
from identification.kinematics.frames import pose, pose_table
from identification.kinematics.parameters import (
    JOINT_OFFSET,
    JOINT_UNITS,
    LENGTH_ERROR,
    Parameter,
    by_joint,
    orientation_transform,
)
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


# -- corrected values --------------------------------------------------------------------------------------------------
STEP = {"mm": 1e-3, "rad": 1e-6}  # of central differences: exact for shifts, to 1e-12 for angles
LINK = "length of the link"
ZERO = "add to the zero of joint {j}: real position = reading + this; or take it off every command"
FRAME = "frame of joint {j} in that of {before}, as a URDF joint's origin: x, y, z, then roll, pitch, yaw"
TURNED_FRAME = (
    "frame of joint {j} in that of {before}: x, y, z, then how it is turned from the drawing about its own x, y and z "
    "axis; its pitch is near 90 deg, where small turns are large changes of roll and yaw"
)
BASE = "pose of the base for the instrument, turned about its own x, y and z axis"
TOOL = "measured point in the frame of the tip"
STANDS = "where the arm stands: type it into the controller only if the measurements are in the controller's own frame"
TURNED = f"zero of joint 1 with how the arm is turned, {STANDS}"
EFFECT = "no value of a controller: armcal compensate takes it off the commands"
UNITS = {"theta": "deg", "d": "mm", "a": "mm", "alpha": "deg", "beta": "deg"}
MEANING = {
    "theta": "offset: what joint {j} adds to its reading, in the table",
    "d": "along the axis of joint {j}",
    "a": "between the axes of joints {j} and {k}",
    "alpha": "between the axes of joints {j} and {k}",
    "beta": "turn about the new y axis after alpha (Hayati), as axes {j} and {k} are nearly parallel; d stays as drawn",
}


@dataclass(frozen=True)
class CorrectedValue:
    """One row, in file units.

    name : in words;  parameter : that it is made of, None: of several
    nominal : None where nothing is drawn;  corrected : None where it is not estimable
    std, low_95, high_95 : None where the value is held, or nothing can be said
    convention : what the value means, and what to do with it
    prior_std : standard deviation before the measurements, None: nothing was known, or not of all that it is made of
    held_by_prior : the measurements say next to nothing about it: they take less than a tenth of its variance
    """

    name: str
    parameter: str | None
    nominal: float | None
    corrected: float | None
    std: float | None
    low_95: float | None
    high_95: float | None
    unit: str
    convention: str
    prior_std: float | None = None
    held_by_prior: bool = False

    @property
    def weak(self) -> bool:
        """Whether the measurements leave more than half of the standard deviation that it had before."""
        return self.std is not None and self.prior_std is not None and self.std > 0.5 * self.prior_std

    def to_json(self) -> dict[str, Any]:
        """An entry of `corrected_values` (identification/files/README.md, "JSON keys")."""
        return dict(vars(self))


Values = Mapping[str, float]  # parameter name -> value [API unit]


class _Quantity(NamedTuple):
    """A value, and its derivatives by parameters, in file units per API unit."""

    name: str
    parameter: str | None
    nominal: float | None
    value: float
    derivatives: Mapping[str, float]
    unit: str
    convention: str
    bounds: tuple[float, float] = (-np.inf, np.inf)


def corrected_values(
    arm: Arm,
    calibration: Calibration | None = None,
    freedom: Collection[float] | None = None,
    unknown: Collection[str] = (),
    factor: Array | None = None,
    seen: Array | None = None,
) -> tuple[CorrectedValue, ...]:
    """What was estimated or differs from the drawing: geometry, then effects.

    calibration : None: the arm's own calibration
    freedom : degrees of freedom of the variances of `calibration.parameter_names`; None: as its provenance says
    unknown : names of parameters that are not estimable
    factor : (p, r) factor of the covariance of `calibration.parameter_names` before the measurements, 0 where
        there is none; None: that of the arm's machining, where all that it says something of was estimated
    seen : (p, p) covariance by which the measurements say next to nothing; None: that of `calibration`
    """
    model, calibration = Model(arm), calibration or arm.calibration or Calibration({})
    values = {**model.fixed, **calibration.values}
    names = {*calibration.parameter_names, *unknown}
    geometry = _planar(arm, values) if arm.chain.planar else _spatial(arm, arm.chain, values, names)
    spread = freedom_of(calibration) if freedom is None else np.array([*freedom], dtype=float)
    prior = model.prior if {*model.prior} <= {*calibration.parameter_names} else {}
    before = np.diag([prior.get(name, 0.0) for name in calibration.parameter_names]) if factor is None else factor
    seen = calibration.covariance if seen is None else seen
    places = {name: k for k, name in enumerate(calibration.parameter_names)}
    quantities = (*geometry, *_effects(model, values))
    rows = (_row(quantity, calibration, places, spread, unknown, before, seen) for quantity in quantities)
    return tuple(row for row in rows if row.std is not None or row.corrected != row.nominal)


def _row(
    quantity: _Quantity,
    calibration: Calibration,
    places: Mapping[str, int],
    freedom: Array,
    unknown: Collection[str],
    before: Array,
    seen: Array | None,
) -> CorrectedValue:
    # parameters that it depends on, by their places in order, and its derivatives by them
    used = sorted((places[name], slope) for name, slope in quantity.derivatives.items() if slope and name in places)
    at = np.array([place for place, _ in used], dtype=np.intp)
    slope = np.array([slope for _, slope in used], dtype=float)
    undetermined, deviation = any(quantity.derivatives.get(name) for name in unknown), np.nan
    if calibration.covariance is not None and at.size and not undetermined:
        deviation = max(float(slope @ calibration.covariance[np.ix_(at, at)] @ slope), 0.0) ** 0.5
    half = float(quantile_95(freedom[at].min(initial=np.inf))) * deviation
    limits = np.clip([quantity.value - half, quantity.value + half], *quantity.bounds)
    figures = [np.nan if undetermined else quantity.value, deviation, *limits]
    value, std, low, high = (float(figure) if np.isfinite(figure) else None for figure in figures)
    about = quantity.name, quantity.parameter, quantity.nominal
    has_prior = bool(slope.size and np.all(np.any(before[at] != 0.0, axis=1)))
    prior = float(np.linalg.norm(before[at].T @ slope)) if has_prior else None
    held = False
    if std is not None and prior is not None and seen is not None:
        held = bool(slope @ seen[np.ix_(at, at)] @ slope > 0.9 * prior**2)
    return CorrectedValue(*about, value, std, low, high, quantity.unit, quantity.convention, prior, held)


# -- what there is -----------------------------------------------------------------------------------------------------
def _planar(arm: Arm, values: Values) -> Iterator[_Quantity]:
    """Lengths and zeros."""
    for j, length in enumerate(arm.lengths.tolist(), start=1):
        name = f"{LENGTH_ERROR}:{j}"
        value = length + values.get(name, 0.0)
        yield _Quantity(f"length of link {j}", name, length, value, {name: 1.0}, "mm", LINK)
    yield from _own_values(arm, values)
    stands = any(spec.name == "base_offset" for spec in arm.effects)
    hidden = arm.chain.instrument.hidden(arm.chain.base)
    for zero in (zero for zero in _zeros(arm, values) if zero.parameter not in hidden):
        yield zero._replace(convention=TURNED) if stands and zero.name == "zero of joint 1" else zero


def _zeros(arm: Arm, values: Values) -> Iterator[_Quantity]:
    """What each joint adds to what is read, as the controller counts: of coupled joints what both add."""
    shares = np.eye(arm.links) if arm.counting is None else arm.counting.matrix
    for j, kind in enumerate(arm.joint_types, start=1):
        p = Parameter(f"{JOINT_OFFSET}:{j}", JOINT_UNITS[kind])
        slopes = {f"{JOINT_OFFSET}:{i}": x * p.to_file for i, x in enumerate(shares[j - 1].tolist(), start=1) if x}
        value = sum(x * values.get(name, 0.0) for name, x in slopes.items())
        alone = p.name if len(slopes) == 1 else None
        yield _Quantity(f"zero of joint {j}", alone, 0.0, value, slopes, p.file_unit, ZERO.format(j=j))


def _effects(model: Model, values: Values) -> Iterator[_Quantity]:
    """Parameters of effects, their names with the settings."""
    for effect in model.effects:
        convention = STANDS if effect.name == "base_offset" else EFFECT
        for p in effect.parameters:
            name, value = f"{effect.label}.{p.short}", values.get(p.name, 0.0) * p.to_file
            bounds = p.lower * p.to_file, p.upper * p.to_file
            yield _Quantity(name, p.name, 0.0, value, {p.name: p.to_file}, p.file_unit, convention, bounds)


# -- in space ----------------------------------------------------------------------------------------------------------
def _spatial(arm: Arm, chain: KinematicChain, values: Values, names: Collection[str]) -> Iterator[_Quantity]:
    """Zeros of the joints, their frames, base and measured points; derivatives by the parameters `names`."""
    yield from _zeros(arm, values)
    drawn, corrected = _tables(chain, {}), _tables(chain, values)
    steps = {p.name: STEP[p.unit] for p in chain.every_parameter if p.name in names and p.kind != JOINT_OFFSET}
    ends = {
        name: [_tables(chain, {**values, name: values.get(name, 0.0) + sign * step}) for sign in (1.0, -1.0)]
        for name, step in steps.items()
    }
    for place, table in corrected.items():
        convention = BASE if place == "base" else TOOL
        if place.startswith("joint "):
            j, frame = int(place.removeprefix("joint ")), FRAME if "roll_deg" in table else TURNED_FRAME
            convention = frame.format(j=j, before="the base" if j == 1 else f"joint {j - 1}")
        for key, value in table.items():
            slopes = {
                name: _nearest(up[place][key] - down[place][key], 0.0, key) / (2.0 * steps[name])
                for name, (up, down) in ends.items()
                if up[place][key] != down[place][key]
            }
            nominal = drawn[place][key] + 0.0 if place.startswith("joint ") else None  # no -0
            axis, _, unit = key.rpartition("_")
            value = value if nominal is None else _nearest(value, nominal, key)
            yield _Quantity(f"{place} {axis}", None, nominal, value, slopes, unit, convention)
    yield from _own_values(arm, values)


def _own_values(arm: Arm, values: Values) -> Iterator[_Quantity]:
    """Of the instrument, where they were estimated: what the arm file says of them is where fits start."""
    if not all(p.name in values for p in arm.chain.instrument.parameters):
        return
    for name, parameter, value, slopes, unit, convention in arm.chain.instrument.own_values(values):
        yield _Quantity(name, parameter, None, value, slopes, unit, convention)


def _tables(chain: KinematicChain, values: Values) -> dict[str, dict[str, float]]:
    """Place -> its numbers in file units: frame of each joint, base, measured points."""
    geometry = CorrectedGeometry(chain, values)
    tables = geometry.tables()
    rows = {f"joint {row.pop('joint')}": row for row in tables["geometry"]}
    for j, joint in enumerate(chain.joints, start=1):
        # pitched by more, a small turn may be a large roll and yaw (gimbal lock)
        if abs(joint.origin[2, 0]) > np.sin(np.radians(85.0)):
            place, drawn = geometry.origin(j), joint.origin[:3, :3]
            turned = pose_table(pose(place[:3, 3], drawn.T @ place[:3, :3]))
            # as drawn is zero, whatever the product of matrices rounds it to
            rows[f"joint {j}"] = {k: round(v, 12) if k.endswith("_deg") else v for k, v in turned.items()}
    hidden = {f"{name.partition('.')[2]}_deg" for name in chain.instrument.hidden(chain.base)}
    hidden |= {key.replace("_deg", "_mm") for key in hidden}
    base = {} if tables["base"] is None else {"base": {k: v for k, v in tables["base"].items() if k not in hidden}}
    tools = {f"tool {name}": place for name, place in tables["tools"].items()}
    return {place: {k: v for k, v in row.items() if k != "name"} for place, row in (rows | base | tools).items()}


def _nearest(value: float, to: float, key: str) -> float:
    """Of an angle [deg] the equal one that is nearest to another."""
    return value - 360.0 * round((value - to) / 360.0) if key.endswith("_deg") else value


# -- the table of Denavit and Hartenberg -------------------------------------------------------------------------------
class Calibrated(NamedTuple):
    """A geometry that was found: `names` (p,) with covariance (p, p) and degrees of freedom (p,), units by name."""

    geometry: CorrectedGeometry
    names: Sequence[str]
    covariance: Array
    freedom: Array
    units: Mapping[str, str]

    @classmethod
    def of(cls, fit: Identification) -> Calibrated:
        """As a fit in space found it."""
        assert fit.geometry is not None
        units = {p.name: p.unit for p in fit.model.geometry_parameters}
        return cls(fit.geometry, fit.names, fit.covariance, fit.uncertainty.freedom, units)

    @classmethod
    def of_arm(cls, arm: Arm) -> Calibrated | None:
        """As a spatial arm's file has it; None without a calibration and its covariance."""
        if (calibration := arm.calibration) is None or arm.chain.planar or calibration.covariance is None:
            return None
        model = Model(arm)
        geometry = CorrectedGeometry(arm.chain, {**model.fixed, **calibration.values})
        units = {p.name: p.unit for p in model.geometry_parameters}
        return cls(geometry, calibration.parameter_names, calibration.covariance, freedom_of(calibration), units)


def dh_values(calibrated: Calibrated, rows: Sequence[DHRow], convention: str = STANDARD) -> tuple[CorrectedValue, ...]:
    """Nominal and corrected numbers of the links between the axes, those as drawn by definition left out.

    rows, convention : of the arm's drawing. Standard deviations by first derivatives of the covariance; a and alpha of
    the modified convention stand in the row of the next joint. Raises `InputError` as `drawn_links`.
    """
    geometry, drawn = calibrated.geometry, drawn_links(rows, convention)
    start, names = dict(geometry.values), calibrated.names
    numbers, nominal = _numbers(geometry.chain, start, drawn), _flat(drawn)
    slopes = np.zeros((len(names), len(numbers)))
    # effects, hundreds with the library, are not in the table
    for row, name in ((row, name) for row, name in enumerate(names) if name in calibrated.units):
        step = STEP.get(calibrated.units[name], 1e-6)
        up, down = (_numbers(geometry.chain, {**start, name: start[name] + s * step}, drawn) for s in (1.0, -1.0))
        slopes[row] = [(up[key] - down[key]) / (2.0 * step) for key in numbers]
    deviations = np.sqrt(np.einsum("pk,pq,qk->k", slopes, calibrated.covariance, slopes).clip(min=0.0))
    half = float(np.min(quantile_95(calibrated.freedom))) if len(names) else np.nan
    shown = []
    for (key, value), std in zip(numbers.items(), deviations.tolist(), strict=True):
        joint, name = key
        row_number = joint + (convention != STANDARD and name in ("a", "alpha", "beta"))
        meaning = MEANING[name].format(j=joint, k=joint + 1)
        figures = (nominal[key], value, std, value - half * std, value + half * std)
        shown.append(CorrectedValue(f"row {row_number} {name}", None, *figures, UNITS[name], meaning))
    return tuple(shown)


def dh_places(calibrated: Calibrated, rows: Sequence[DHRow], convention: str = STANDARD) -> list[tuple[str, Array]]:
    """Beside the values of `dh_values`: the pose of the base (4, 4), and places (3,) of the measured points for the
    last frame of the table, by name. With them the table says what the fit does."""
    drawn, real = drawn_links(rows, convention), calibrated.geometry.real
    _, first, last = corrected_links(real, drawn)
    _, nominal_first, nominal_last = corrected_links(calibrated.geometry.chain, drawn)
    base = real.base @ first @ np.linalg.inv(nominal_first)
    behind = np.linalg.inv(nominal_last) @ last
    tools = [(f"tool {name}", behind[:3, :3] @ place + behind[:3, 3]) for name, place in real.tools.items()]
    return [("base", base), *tools]


def _numbers(chain: KinematicChain, values: Mapping[str, float], drawn: Sequence[Link]) -> dict[tuple[int, str], float]:
    """Joint and name -> number of the corrected table [mm, deg]."""
    return _flat(corrected_links(corrected(chain, values), drawn)[0])


def _flat(links: Sequence[Link]) -> dict[tuple[int, str], float]:
    """The numbers that are free: of the first joint theta and d belong to the base, of parallel axes d is as drawn."""
    numbers = {}
    for j, link in enumerate(links, start=1):
        names = ["a", "alpha"] if j == 1 else ["theta", "d", "a", "alpha"]
        names = [name for name in names if name != "d" or link.beta is None] + (
            ["beta"] if link.beta is not None else []
        )
        for name in names:
            value = float(getattr(link, name))
            numbers[j, name] = value if UNITS[name] == "mm" else float(np.degrees(value))
    return numbers
