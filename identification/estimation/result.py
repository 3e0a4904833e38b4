"""What an identification found, with its uncertainty, and the values to type in.

Corrected values are those that a controller or a kinematic table has, not errors. In space they are functions of
several parameters, their standard deviations by first derivatives (delta method). The corrected Denavit-Hartenberg
table is a complete set of values, none of which is arbitrary.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import remainder
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identification.arm import Arm, Calibration
from identification.arrays import Array, ReadOnly, readonly
from identification.document import Documented
from identification.documents import identification as shown
from identification.errors import InputError
from identification.estimation.doubts import hardly_determined, tips_of
from identification.estimation.problem import NO_PRIOR, Contradiction, Prior
from identification.estimation.uncertainty import LEVEL, Uncertainty, freedom_kept, limits_95, quantile_95
from identification.information import VISIBLE
from identification.kinematics.chain import STANDARD, CorrectedGeometry, KinematicChain, Link, drawn_links
from identification.kinematics.frames import point_table, pose, pose_table
from identification.kinematics.parameters import JOINT_OFFSET, JOINT_UNITS, LENGTH_ERROR, Parameter, by_joint
from identification.measurements import POINT, distances, rms_distance
from identification.model import Model
from identification.running import Status

STEP = {"mm": 1e-3, "rad": 1e-6}  # of central differences: exact for shifts, to 1e-12 for angles
ZERO = "add to the zero of joint {j}: real position = reading + this; or subtract it from every command"
STANDS = "the base pose: enter it in the controller only if the measurements are in the controller's own frame"
FRAME = "frame of joint {j} in that of {before}, as a URDF joint's origin: x, y, z, then roll, pitch, yaw"
TURNED_FRAME = (
    "frame of joint {j} in that of {before}: x, y, z, then its rotation from the drawing about its own x, y and z "
    "axis; its pitch is near 90 deg, where small rotations change roll and yaw much"
)
DH_MEANING = {  # unit, and what the number of a row of the table means
    "theta": ("deg", "offset: what joint {j} adds to its reading, in the table"),
    "d": ("mm", "along the axis of joint {j}"),
    "a": ("mm", "between the axes of joints {j} and {k}"),
    "alpha": ("deg", "between the axes of joints {j} and {k}"),
    "beta": (
        "deg",
        "rotation about the new y axis after alpha (Hayati): axes {j} and {k} are nearly parallel; d stays as drawn",
    ),
}
# keys of the JSON of a fit that a calibration has elsewhere or is read without
NOT_KEPT = "parameters p_value status warnings outlier_rows unexplained_rows clusters base tools geometry joint_offsets"
Values = Mapping[str, float]  # parameter name -> value [API unit]


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Documented, ReadOnly):
    """Estimated parameters of a model, in the order of `model.parameters` and in API units [mm, rad].

    parameters : (p,)
    identifiable : (p,) True where the parameter itself is estimable
    not_identifiable : combinations of parameters that the data do not determine, in words
    sigma : standard deviation of one coordinate [mm] (with sigma per row: their root mean square; with relative
        weights: of a row of weight one), given beforehand or estimated; None if it is unknown
    chi2 : weighted sum of squares in units of sigma^2, None if sigma was not given
    dof : d m equations minus the number of estimable combinations
    residuals_before, residuals_after : (m, d) measured minus computed [mm], with the arm as it was and as identified
    scatter : standard deviation of one coordinate that the residuals show [mm], None without spare equations; with a
        prior no less than a sigma that is given
    postures : (k, n) measured [rad, mm], each once for every marker and session;  inside : `WhiteRows.inside`
    outlier_rows : numbers from 1 of single rows that the model does not explain, but that are in the fit
    unexplained_rows : the same of rows that come together, by posture or joint angle: what the model lacks there
    prior : of the parameters, as it was taken;  machining_factor : on its sizes of [machining], None: it has none
    held : names of parameters that were not estimated, with the covariance of an earlier calibration
    contradiction : parameter whose prior, an earlier calibration, the measurements contradict most
    """

    model: Model
    parameters: Array
    identifiable: NDArray[np.bool_]
    not_identifiable: tuple[str, ...]
    sigma: float | None
    chi2: float | None
    dof: int
    residuals_before: Array
    residuals_after: Array
    method: str
    status: Status
    uncertainty: Uncertainty
    scatter: float | None
    postures: Array
    inside: float
    doubts: tuple[str, ...] = ()
    outlier_rows: tuple[int, ...] = ()
    unexplained_rows: tuple[int, ...] = ()
    prior: Prior = NO_PRIOR
    machining_factor: float | None = None
    held: frozenset[str] = frozenset()
    contradiction: Contradiction | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    # -- parameters and their uncertainty --------------------------------------------------------------------------
    names = property(attrgetter("model.names"))  # (p) of the parameters
    # (p, p), zero along what is not estimable; NaN without sigma and spare equations
    covariance = property(attrgetter("uncertainty.covariance"))
    sigma_known = property(lambda self: self.chi2 is not None)  # whether sigma was given beforehand

    @property
    def arm(self) -> Arm | None:
        """That of the model; None: another model has none."""
        arm = getattr(self.model, "arm", None)
        return arm if isinstance(arm, Arm) else None

    @cached_property
    def std(self) -> Array:
        """(p,) standard deviations; NaN where a parameter is not estimable."""
        return readonly(np.where(self.identifiable, np.sqrt(np.diag(self.covariance)), np.nan))

    @cached_property
    def intervals(self) -> Array:
        """(p, 2) 95 % confidence limits, cut at the physical bounds; NaN where a parameter is not estimable: by the
        normal quantile where they rely on a given sigma, else Student's t."""
        return readonly(limits_95(self.model.parameters, self.parameters, self.std, self.uncertainty.freedom))

    @property
    def p_value(self) -> float | None:
        """Probability of a chi2 at least this large if model and sigma are right; None if sigma was not known."""
        return None if self.chi2 is None or self.dof == 0 else float(chdtrc(self.dof, self.chi2))

    @property
    def times_sigma(self) -> float | None:
        """What the residuals scatter by as a multiple of the sigma given; None where there is none or nothing left."""
        return None if self.chi2 is None or self.dof <= 0 else float(np.sqrt(self.chi2 / self.dof))

    # how far the tip may be from where this fit computes it [mm], RMS over the joint limits, and over further postures
    # like those measured; None: not known. With the error of its own that the prior says each posture has, but in tips
    tips = cached_property(tips_of)
    own_error = property(lambda self: self.prior.own_error * np.sqrt(self.arm.dimension))
    expected_tip = property(lambda self: self.tips and float(np.hypot(self.tips[0], self.own_error)))
    expected_tip_measured = property(lambda self: self.tips and float(np.hypot(self.tips[1], self.own_error)))

    @property
    def misfit(self) -> str | None:
        """What chi2 says where it rejects the model or the sigma given, and what follows for the intervals."""
        if self.p_value is None or self.p_value >= LEVEL or (times := self.times_sigma) is None:
            return None
        scatter = f"{shown.MISFIT} {times:{'.3g' if times < 1000.0 else '.0f'}} times sigma_mm = {self.sigma:.4g}"
        figures = f"chi2 {self.chi2:.4g}, {self.dof} degrees of freedom, {shown.p_value_in_words(self.p_value)}"
        cause, do = "the model is incomplete or sigma_mm too small", "armcal diagnose looks for what is missing"
        if self.rms_angles is not None and self.sigma:
            places, turns = np.split(self.residuals_after, [POINT.stop], axis=1)
            of_places, of_turns = (np.sqrt(np.mean(np.square(each))) / self.sigma for each in (places, turns))
            scatter += f", of positions {of_places:.3g} times, of orientations {of_turns:.3g} times sigma_deg"
            cause = "the model is incomplete, or sigma_mm or sigma_deg too small"
        if self.contradiction:
            cause, do = f"the prior does not hold (above), {cause}", "settle the prior first"
        rely = self.uncertainty.kind == "given"
        follows = "rely on sigma_mm and are too narrow" if rely else "do not rely on sigma_mm"
        return f"{scatter} ({figures}): {cause}. The intervals {follows}; {do}"

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings to be read before the results."""
        without_prior = [p for p in getattr(self.model, "parameters", ()) if p.name not in self.prior.names]
        misfit = [self.contradiction.warning(without_prior)] if self.contradiction else []
        misfit += [self.misfit] if self.misfit else []
        doubts = (*self.doubts, *hardly_determined(self))
        if self.status is Status.iteration_limit:
            return (shown.UNFINISHED, *misfit, *doubts)
        return (*doubts, *misfit) if self.status is Status.implausible else (*misfit, *doubts)

    @cached_property
    def values(self) -> dict[str, float]:
        """Name -> value of every parameter, the known ones included."""
        return dict(self.model.fixed) | self.model.parameters.mapping(self.parameters)

    length_errors = property(lambda self: by_joint(self.values, LENGTH_ERROR))  # (n,) dl_j [mm]
    joint_offsets = property(lambda self: by_joint(self.values, JOINT_OFFSET))  # (n,) dq_j [rad]

    # -- quality of the fit ----------------------------------------------------------------------------------------
    # root mean squares over rows of the distance [mm], arm as it was and as identified
    rms_before = property(lambda self: rms_distance(self.residuals_before))
    rms_after = property(lambda self: rms_distance(self.residuals_after))

    @property
    def largest(self) -> tuple[float, float]:
        """Largest distance over rows [mm], arm as it was and as identified."""
        return float(np.max(distances(self.residuals_before))), float(np.max(distances(self.residuals_after)))

    @property
    def rms_angles(self) -> tuple[float, float] | None:
        """Root mean squares over rows of the angles between measured and computed orientations [rad], arm as it was and
        as identified; None where none are measured."""
        if self.arm is None or (scale := self.arm.chain.angle_scale) is None:
            return None
        before, after = (rms_distance(r[:, POINT.stop :]) for r in (self.residuals_before, self.residuals_after))
        return before / scale, after / scale

    # -- onward ----------------------------------------------------------------------------------------------------
    @cached_property
    def geometry(self) -> CorrectedGeometry | None:
        """A spatial arm's geometry as identified: base, measured points, joints; None in the plane."""
        return None if self.arm is None else corrected_geometry(self.arm.chain, self.values)

    def calibration(self) -> Calibration:
        """What an arm file keeps of this: all values, and the covariance of those that the rows determine."""
        cov = self.covariance if np.all(np.isfinite(self.covariance)) else None
        figures = {k: v for k, v in self._summary().items() if v is not None and k not in NOT_KEPT.split()}
        freedom = freedom_kept(self.names, self.uncertainty.freedom)
        whole = Calibration(self.values, self.names, cov, {**self.provenance, **figures, **freedom})
        calibration = whole.about(np.array(self.names)[self.identifiable])
        return calibration if self.geometry is None else replace(calibration, **self.geometry.places)

    def calibrated_arm(self) -> Arm:
        """The arm with this calibration in it."""
        return replace(self.model.arm, calibration=self.calibration())

    @cached_property
    def corrected_values(self) -> tuple[CorrectedValue, ...]:
        """Values for the controller: nominal and corrected lengths, zeros, frames, effects; empty without an arm."""
        if self.arm is None:
            return ()
        unknown = [name for name, estimable in zip(self.names, self.identifiable, strict=True) if not estimable]
        before = self.prior.factor(self.model.parameters)[self.identifiable]
        return corrected_values(self.arm, self.calibration(), unknown, before)

    @cached_property
    def dh(self) -> tuple[tuple[CorrectedValue, ...], list[str], dict[str, dict[str, float]]]:
        """`dh_lines` of the arm as identified; empty where something is not estimable, and without an arm."""
        whole = self.arm is not None and not self.not_identifiable
        return dh_lines(self.calibrated_arm(), self.corrected_values) if whole else ((), [], {})

    def to_json(self) -> dict[str, Any]:
        """Keys of `identify` (identification/files/README.md, "JSON keys"): file units, null for unknown values."""
        rows, lines, frames = self.dh
        dh = {"dh_table": [row.to_json() for row in rows], "dh_places": lines, "dh_frames": frames} if rows else {}
        return {**self._summary(), "corrected_values": [row.to_json() for row in self.corrected_values], **dh}

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
            **dict(zip(("max_before_mm", "max_after_mm"), self.largest, strict=True)),
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
            **({} if self.geometry is None else self.geometry.to_json(self.model.arm.counting)),
        }

    def rows(self) -> list[dict[str, Any]]:
        """One entry of `parameters` for each parameter estimated, in file units."""
        values = np.where(self.identifiable, self.parameters, np.nan)
        return [
            {"name": p.name, "unit": p.file_unit}
            | {k: float(v * p.to_file) if np.isfinite(v) else None for k, v in zip(shown.COLUMNS, figures, strict=True)}
            for p, *figures in zip(self.model.parameters, values, self.std, *self.intervals.T, strict=True)
            if p.name not in self.held
        ]

    document = shown.identification_document


# -- corrected values --------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class CorrectedValue:
    """One row, in file units.

    name : in words;  parameter : that it is made of, None: of several
    nominal : None where nothing is drawn;  corrected : None where it is not estimable
    std, low_95, high_95 : None where the value is held, or nothing can be said
    convention : what the value means, and what to do with it
    prior_std : standard deviation before the measurements, None: nothing was known, or not of all that it is made of
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

    @property
    def weak(self) -> bool:
        """Whether the measurements leave more than half of the standard deviation that it had before."""
        return self.std is not None and self.prior_std is not None and self.std > 0.5 * self.prior_std

    def to_json(self) -> dict[str, Any]:
        """An entry of `corrected_values` (identification/files/README.md, "JSON keys")."""
        return dict(vars(self))


class _Spread(NamedTuple):
    """What is known of an arm's parameters: values of all; names of those estimated, their covariance (p, p), degrees
    of freedom of the variances (p,), and a factor (p, r) of the covariance before the measurements; and names of those
    that are not estimable."""

    values: Values
    names: tuple[str, ...]
    covariance: Array | None
    freedom: Array
    before: Array
    unknown: Collection[str] = ()

    def row(
        self,
        name: str,
        parameter: str | None,
        nominal: float | None,
        value: float,
        slopes: Values,
        unit: str,
        convention: str,
        bounds: tuple[float, float] = (-np.inf, np.inf),
    ) -> CorrectedValue:
        """A value with what is known of it, in file units;  slopes : its derivatives by parameters [API unit]"""
        slope = np.array([slopes.get(each, 0.0) for each in self.names])
        at, deviation, freedom, prior = np.flatnonzero(slope), np.nan, np.inf, None
        slope, before = slope[at], self.before[at]
        undetermined = any(slopes.get(each) for each in self.unknown)
        if self.covariance is not None and at.size and not undetermined:
            covariance = self.covariance[np.ix_(at, at)]
            deviation = max(float(slope @ covariance @ slope), 0.0) ** 0.5
            parts = np.abs(slope) * np.sqrt(np.diag(covariance))
            freedom = self.freedom[at][parts >= VISIBLE * parts.max()].min()  # less is rounding of differences
        half = float(quantile_95(freedom)) * deviation
        figures = [np.nan if undetermined else value, deviation, *np.clip([value - half, value + half], *bounds)]
        corrected, std, low, high = (float(figure) if np.isfinite(figure) else None for figure in figures)
        if at.size and np.all(np.any(before != 0.0, axis=1)):
            prior = float(np.linalg.norm(before.T @ slope))
        return CorrectedValue(name, parameter, nominal, corrected, std, low, high, unit, convention, prior)

    def slopes(self, table: Any, parameters: Iterable[Parameter]) -> dict[Any, dict[str, float]]:
        """Key of a table of values -> its derivatives by those of the parameters that were to be estimated, of which
        they are not zero, by central differences."""
        slopes: dict[Any, dict[str, float]] = {key: {} for key in table(self.values)}
        for name, step in ((p.name, STEP[p.unit]) for p in parameters if p.name in {*self.names, *self.unknown}):
            up, down = (table({**self.values, name: self.values.get(name, 0.0) + move}) for move in (step, -step))
            for key, of_key in slopes.items():
                if (rise := up[key] - down[key]) != 0.0:
                    of_key[name] = remainder(rise, 360.0) / (2.0 * step)  # whole turns apart; lengths move by less
        return slopes


def corrected_values(
    arm: Arm, calibration: Calibration | None = None, unknown: Collection[str] = (), factor: Array | None = None
) -> tuple[CorrectedValue, ...]:
    """What was estimated or differs from the drawing: lengths and zeros of a planar arm; in space zeros, frames, base
    and measured points; values of the instrument, where they were estimated; parameters of effects that have a name.

    calibration : None: the arm's own;  unknown : names of parameters that are not estimable
    factor : (p, r) factor of the covariance of `calibration.parameter_names` before the measurements, 0 where
        there is none; None: that of the arm's machining, where all that it says something of was estimated
    """
    model, chain, calibration = Model(arm), arm.chain, calibration or arm.calibration or Calibration({})
    names, values = calibration.parameter_names, {**model.fixed, **calibration.values}
    prior = model.prior if {*model.prior} <= {*names} else {}
    before = np.diag([prior.get(name, 0.0) for name in names]) if factor is None else factor
    of = _Spread(values, names, calibration.covariance, calibration.freedom, before, unknown)
    rows = list[CorrectedValue]()
    for j, length in enumerate(arm.lengths.tolist(), start=1):
        if (name := f"{LENGTH_ERROR}:{j}") in model.geometry_parameters.names:
            value = length + values.get(name, 0.0)
            rows.append(of.row(f"length of link {j}", name, length, value, {name: 1.0}, "mm", "length of the link"))
    for j, kind in enumerate(arm.joint_types, start=1):
        p = Parameter(f"{JOINT_OFFSET}:{j}", JOINT_UNITS[kind])
        # what it adds to what is read, as the controller counts: of coupled joints what both add
        shares = enumerate(arm.counting.matrix[j - 1].tolist(), start=1)
        slopes = {f"{JOINT_OFFSET}:{i}": x * p.to_file for i, x in shares if x}
        if not (len(slopes) == 1 and {*slopes} <= {*chain.instrument.hidden(chain.base)}):
            value = sum(x * values.get(name, 0.0) for name, x in slopes.items())
            stands = j == 1 and any(spec.name == "base_offset" for spec in arm.effects)
            meaning = f"zero of joint 1 with the rotation of the base, {STANDS}" if stands else ZERO.format(j=j)
            alone = next(iter(slopes)) if len(slopes) == 1 else None
            rows.append(of.row(f"zero of joint {j}", alone, 0.0, value, slopes, p.file_unit, meaning))
    drawn, corrected_tables = _tables(chain, {}), _tables(chain, values)
    slopes_of = of.slopes(partial(_tables, chain), (p for p in chain.every_parameter if p.kind != JOINT_OFFSET))
    for (place, key), value in corrected_tables.items():
        turned_about, (word, _, number), nominal = ", rotated about its own x, y and z axis", place.partition(" "), None
        meaning = f"measured point in the frame of the tip{turned_about if key.endswith('_deg') else ''}"
        if word == "base":
            meaning = f"pose of the base in the frame of the instrument{turned_about}"
        if word == "joint":
            j = int(number)
            frame = FRAME if (place, "roll_deg") in corrected_tables else TURNED_FRAME
            meaning = frame.format(j=j, before="the base" if j == 1 else f"joint {j - 1}")
            nominal = drawn[place, key] + 0.0  # no -0
        axis, _, unit = key.rpartition("_")
        rows.append(of.row(f"{place} {axis}", None, nominal, value, slopes_of[place, key], unit, meaning))
    # what the arm file says of the instrument is where fits start
    was_fitted = all(p.name in values for p in chain.instrument.parameters)
    for row in chain.instrument.own_values(values) if was_fitted else ():
        rows.append(of.row(row.name, row.parameter, None, row.value, row.slopes, row.unit, row.convention))
    for effect in (e for e in model.effects if not e.unlisted):  # their names with the settings
        meaning = "not a value that a controller takes: armcal compensate corrects the commands for it"
        meaning = STANDS if effect.name == "base_offset" else meaning
        for p in effect.parameters:
            value, bounds = values.get(p.name, 0.0) * p.to_file, (p.lower * p.to_file, p.upper * p.to_file)
            label = f"{effect.label}.{p.short}"
            rows.append(of.row(label, p.name, 0.0, value, {p.name: p.to_file}, p.file_unit, meaning, bounds))
    return tuple(row for row in rows if row.std is not None or row.corrected != row.nominal)


def corrected_geometry(chain: KinematicChain, values: Values) -> CorrectedGeometry | None:
    """Base, measured points and joints where the errors bring them; None where lists of lengths and zeros say all."""
    return None if chain.lists else CorrectedGeometry(chain, values)


def _tables(chain: KinematicChain, values: Values) -> dict[tuple[str, str], float]:
    """Place and key -> number in file units: frame of each joint, base, measured points."""
    if (geometry := corrected_geometry(chain, values)) is None:
        return {}
    tables = geometry.tables()
    rows = {f"joint {row.pop('joint')}": row for row in tables["geometry"]}
    for j, joint in enumerate(chain.joints, start=1):
        # pitched by more, a small turn may be a large roll and yaw (gimbal lock)
        if abs(joint.origin[2, 0]) > np.sin(np.radians(85.0)):
            place, drawn = geometry.origin(j), joint.origin[:3, :3]
            turned = pose_table(pose(place[:3, 3], drawn.T @ place[:3, :3]))
            # as drawn is zero, whatever the product of matrices rounds it to
            rows[f"joint {j}"] = {k: round(v, 12) if k.endswith("_deg") else v for k, v in turned.items()}
    found = {*chain.parameters().names}
    standing = [("base", "base", tables["base"] or {})]
    standing += [(f"tool {name}", f"tool[{name}]", place) for name, place in tables["tools"].items()]
    for word, frame, place in standing:
        rows[word] = {k: v for k, v in place.items() if f"{frame}.{k.partition('_')[0]}" in found}
    return {(place, k): v for place, row in rows.items() for k, v in row.items() if k != "name"}


# -- the table of Denavit and Hartenberg -------------------------------------------------------------------------------
def dh_table(arm: Arm) -> tuple[tuple[CorrectedValue, ...], list[tuple[str, Array]]]:
    """Nominal and corrected numbers of the links between the axes of a calibrated arm, without those drawn by
    definition; and beside them the pose of the base (4, 4), and by name those of the measured frames, places (3,) of
    points, for the last frame of the table: with these it says what the calibration does. Empty without a table that
    `drawn_links` takes, and without a covariance. In the modified convention a and alpha are of the next row.
    """
    calibration, model, drawn = arm.calibration, Model(arm), tuple[Link, ...]()
    with suppress(InputError):
        drawn = drawn_links(arm.chain.rows, arm.chain.convention)
    if calibration is None or calibration.covariance is None or not drawn:
        return (), []
    values = {**model.fixed, **calibration.values}

    def numbers(links: Sequence[Link]) -> dict[tuple[int, str], float]:
        """Joint and name -> number [mm, deg], of parallel axes beta in place of d."""
        return {
            (j, name): value if DH_MEANING[name][0] == "mm" else float(np.degrees(value))
            for j, link in enumerate(links, start=1)
            for name, value in link._asdict().items()
            if value is not None and (j > 1 or name not in ("theta", "d")) and (link.beta is None or name != "d")
        }

    def table(at: Values) -> dict[tuple[int, str], float]:
        return numbers(arm.chain.corrected(at).corrected_links(drawn)[0])

    nominal, now = numbers(drawn), table(values)
    names, listed = calibration.parameter_names, list[CorrectedValue]()
    of = _Spread(values, names, calibration.covariance, calibration.freedom, np.zeros((len(names), 0)))
    slopes = of.slopes(table, arm.chain.every_parameter)  # effects, hundreds with the library, are not in it
    for (j, name), value in now.items():
        row_number = j + (arm.chain.convention != STANDARD and name in ("a", "alpha", "beta"))
        unit, meaning = DH_MEANING[name]
        about = f"row {row_number} {name}", None, nominal[j, name], value, slopes[j, name]
        listed.append(of.row(*about, unit, meaning.format(j=j, k=j + 1)))
    real = arm.chain.corrected(values)
    (_, first, last), (_, drawn_first, drawn_last) = (chain.corrected_links(drawn) for chain in (real, arm.chain))
    behind = np.linalg.inv(drawn_last) @ last
    measured = slice(None) if real.angle_scale is not None else (slice(3), 3)
    tools = [(f"tool {name}", (behind @ at)[measured]) for name, at in real.tools.items()]
    return tuple(listed), [("base", real.base @ first @ np.linalg.inv(drawn_first)), *tools]


def dh_lines(
    arm: Arm, values: Sequence[CorrectedValue]
) -> tuple[tuple[CorrectedValue, ...], list[str], dict[str, dict[str, float]]]:
    """`dh_table` of a calibrated arm, lines of base, measured points and what the instrument has beside it, and by name
    the numbers in these;  values : corrected ones, those of the instrument among them"""
    (rows, places), lines, own = dh_table(arm), list[str](), {p.name for p in arm.chain.instrument.parameters}
    frames = {name: pose_table(at) if at.ndim == 2 else point_table(at) for name, at in places}
    for name, figures in frames.items():
        shown_as = (f"{key.replace('_', ' [')}] {value:z.5f}" for key, value in figures.items())
        lines.append(f"{name}: {', '.join(shown_as)}")
    touched = [f"{v.name} [{v.unit}]: {v.corrected:z.3f} +- {v.std:.3f}" for v in values if v.parameter in own]
    return rows, [*lines, *touched] if rows else [], frames
