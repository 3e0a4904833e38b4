"""Validation: how well a calibrated model predicts other measurements, with nothing refitted but where the arm stands.

Everything that was identified stays as it is; the drawing, refitted in the same way, is what it is compared with.

Judge a model before it is offered for use: does it predict what it has not seen better than the geometry alone?
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.document import Document
from identification.documents.identification import DRAWN
from identification.documents.use import FITTED, HARDLY, validation_sections, validation_verdict
from identification.errors import InputError, nearest
from identification.estimation import Identification, estimate
from identification.estimation.expected_tip import left_out_residuals
from identification.estimation.levenberg_marquardt import levenberg_marquardt
from identification.estimation.problem import Problem
from identification.gap.confirmation import LEVEL, Offered, gained_squares
from identification.information import spectrum
from identification.measurements import POINT, Conditions, Measurements, distances, rms_distance
from identification.model import Model
from identification.sessions import placing, with_sessions, without_sessions
from identification.validate.reuse import fresh_points, placed_values, refit_model, refit_parameters
from identification.validate.row_groups import (
    check_calibrated,
    data_hashes,
    extrapolation,
    identified,
    row_groups,
    seen_in_words,
)

if TYPE_CHECKING:  # a diagnosis imports this package
    from identification.gap.result import Diagnosis

REFITS = (*DRAWN,)
END = 0.5  # time at the end of a session, -0.5 to 0.5


@dataclass(frozen=True)
class Figures:
    """Of the distances between model and measurement [mm], over rows."""

    rms: float
    mean: float
    p95: float
    max: float

    @classmethod
    def of(cls, distances: Array) -> Figures:
        """Of (m,) distances; `p95` is their 95th percentile."""
        rms, p95 = np.sqrt(np.mean(distances**2)), np.percentile(distances, 95.0)
        return cls(float(rms), float(np.mean(distances)), float(p95), float(np.max(distances)))

    def to_json(self) -> dict[str, float]:
        """`rms_mm, mean_mm, p95_mm, max_mm`."""
        return {f"{name}_mm": value for name, value in vars(self).items()}


@dataclass(frozen=True)
class RowBlock:
    """Some of the rows: a session, a quarter of the time, a quadrant of the workspace, or the postures inside or
    outside the range of angles that the model was identified on.

    kind : `session`, `time`, `workspace` or `range`;  nominal : the drawing, refitted in the same way
    """

    kind: str
    name: str
    rows: int
    model: Figures
    nominal: Figures

    def to_json(self) -> dict[str, Any]:
        """An entry of `blocks` (identification/files/README.md, "JSON keys")."""
        figures = self.model.to_json() | {"rms_nominal_mm": self.nominal.rms}
        return {"kind": self.kind, "name": self.name, "rows": self.rows, **figures}


@dataclass(frozen=True, eq=False)
class Validation:
    """What a calibrated model leaves of other measurements, beside the drawing.

    refit : what was refitted, `base`, `offsets` or `none`, in each session separately
    refitted : for each session the refitted parameters, name -> value [API unit]
    residuals, nominal_residuals : (m, d) measured less computed [mm], by the model and by the drawing
    """

    arm: Arm
    measurements: Measurements
    refit: str
    refitted: tuple[Mapping[str, float], ...]
    residuals: Array
    nominal_residuals: Array
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("residuals", "nominal_residuals"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def model(self) -> Figures:
        """Of the calibrated model, over all rows."""
        return Figures.of(distances(self.residuals))

    @property
    def nominal(self) -> Figures:
        """Of the drawing, refitted in the same way, over all rows."""
        return Figures.of(distances(self.nominal_residuals))

    @property
    def rms_angles(self) -> tuple[float, ...]:
        """RMS of the angles between orientations measured and computed [deg], by the model and by the drawing; empty
        where none are measured."""
        scale = self.arm.chain.angle_scale
        angles = [residuals[:, POINT.stop :] for residuals in (self.residuals, self.nominal_residuals)]
        return tuple(float(np.degrees(rms_distance(a) / scale)) for a in angles if scale and a.size)

    @property
    def blocks(self) -> tuple[RowBlock, ...]:
        """The rows by session, time, workspace, and range of the identification."""
        return tuple(self._block(*group) for group in row_groups(self.arm, self.measurements))

    def _block(self, kind: str, name: str, rows: NDArray[np.int64]) -> RowBlock:
        figures = (Figures.of(distances(r[rows])) for r in (self.residuals, self.nominal_residuals))
        return RowBlock(kind, name, len(rows), *figures)

    def to_json(self) -> dict[str, Any]:
        """Keys of `validate` (identification/files/README.md, "JSON keys")."""
        return {
            "rows": len(self.residuals),
            "refit": self.refit,
            **self.model.to_json(),
            **{f"{name}_nominal_mm": value for name, value in vars(self.nominal).items()},
            **dict(zip(("rms_deg", "rms_nominal_deg"), self.rms_angles, strict=False)),
            "blocks": [block.to_json() for block in self.blocks],
            "refitted": self._refitted_parameters(),
            "notes": list(self.notes),
        }

    def _refitted_parameters(self) -> list[dict[str, Any]]:
        """One entry for each session and parameter, in file units."""
        parameters = {p.name: p for p in refit_parameters(self.arm, self.measurements)}
        sessions = self.measurements.sessions or (None,)
        return [
            {
                "session": session,
                "name": name,
                "unit": parameters[name].file_unit,
                "value": v * parameters[name].to_file,
            }
            for session, values in zip(sessions, self.refitted, strict=True)
            for name, v in values.items()
        ]

    def document(self) -> Document:
        """What the model is worth, drawing and model over all rows, then block by block."""
        data = self.to_json()
        notes = [note for note in self.notes if HARDLY not in note]
        parts = validation_sections(data, "" if self.arm.chain.planar else ", measured points")
        return Document("Validation", [validation_verdict(data), *notes], parts)

    def __str__(self) -> str:
        return str(self.document())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return self.document()._repr_html_()


def validate(arm: Arm, measurements: Measurements, refit: str = "base") -> Validation:
    """Compares a calibrated arm with measurements that were not used to identify it.

    arm : with a calibration, or with known effect values; all of it stays as it is but for
    refit : `base`, position and rotation of the base (three numbers, the arm may not have had a base offset before; of
        a spatial arm six, and the measured points); `offsets`, that and every joint offset; `none`, nothing. In each
        session separately

    Raises `InputError` for an arm without calibration, another `refit`, data of another arm, too few rows.
    """
    if refit not in REFITS:
        raise InputError(f"refit: unknown name {refit!r}, {nearest(refit, REFITS)}")
    check_calibrated(arm)
    check_validation(Model(arm), measurements)
    residuals, refitted, free = np.empty_like(measurements.positions), [], 0
    for rows in measurements.session_rows:
        session, conditions = measurements.rows(rows), conditions_of(arm, measurements, refit).rows(rows)
        values, residuals[rows], determined = _refitted(arm, session, conditions, refit)
        refitted.append(values)
        free += len(values) - determined
    nominal = _drawing_refitted(arm, measurements, refit)
    validation = Validation(arm, measurements, refit, tuple(refitted), residuals, nominal)
    angles = validation.rms_angles
    notes = _hardly_better(validation)
    notes += [f"orientations: RMS {angles[0]:.3g} deg, by the drawing {angles[1]:.3g} deg"] if angles else []
    left = (distances(each) for each in (residuals, nominal))
    notes += [seen] if (seen := seen_in_words(arm, measurements.postures, *left)) else []
    notes += [] if arm.chain.planar or refit == "none" else fresh_points(arm.chain, measurements)
    return replace(validation, notes=(*notes, *_notes(arm, measurements, free, refit)))


def drawing_residuals(arm: Arm, measurements: Measurements) -> Array:
    """(m, d) residuals [mm] of an arm as it is drawn, without effects and calibration, placed as a fit to these
    measurements places it: a base for each session, one place for a measured point that several sessions share."""
    drawing = replace(arm, effects=(), calibration=None)
    if arm.chain.planar or len(measurements.sessions) < 2:
        return _drawing_refitted(arm, measurements, "base")
    check_validation(Model(drawing), measurements)
    drawing = replace(drawing, chain=replace(arm.chain, known=frozenset()))
    model = Model(with_sessions(drawing, measurements))
    free = {model.names[k] for k in placing(model.parameters)}
    held = {name: value for name, value in model.best_known.items() if name not in free}
    return estimate(replace(model, known=held), measurements).residuals_after


def _drawing_refitted(arm: Arm, measurements: Measurements, refit: str) -> Array:
    """(m, d) residuals [mm] of an arm as it is drawn, `refit` as for `validate`."""
    drawing, residuals = replace(arm, effects=(), calibration=None), np.empty_like(measurements.positions)
    for rows in measurements.session_rows:
        conditions = conditions_of(arm, measurements, refit).rows(rows)
        residuals[rows] = _refitted(drawing, measurements.rows(rows), conditions, refit)[1]
    return residuals


def check_validation(model: Model, measurements: Measurements) -> None:
    """Raises `InputError` for measurements of another arm, and for effects without gravity."""
    for what, counted, needed in (
        ("joints", measurements.links, model.joints),
        ("coordinates", measurements.dimension, model.dimension),
    ):
        if counted != needed and (what == "joints" or counted not in model.dimensions):
            raise InputError(f"measurements: found {counted} {what}, allowed: {needed}, as the arm has")
    if "gravity" in model.needs and model.arm.gravity is None:
        raise InputError("gravity: an effect of the arm needs it, allowed: an arm file with a [gravity] table")


# -- refitting where the arm stands ------------------------------------------------------------------------------------
def _refitted(
    arm: Arm, measurements: Measurements, conditions: Conditions, refit: str
) -> tuple[dict[str, float], Array, int]:
    """Values of the refitted parameters, (m, d) residuals, and how many combinations the data determine."""
    model, start = refit_model(arm, measurements, conditions, refit)
    if refit == "none":
        return {}, measurements.positions - model.position(measurements.postures, None, conditions), 0
    names = model.names
    if measurements.positions.size < len(names):
        allowed = f"allowed: at least {-(-len(names) // measurements.dimension)} rows in each session"
        file = measurements.provenance.get("file", "measurements")
        raise InputError(f"{file}: too few for {len(names)} refitted parameters, {len(measurements)} in all, {allowed}")
    weights = np.ones(len(measurements)) if measurements.sigma is None else measurements.sigma**-2.0
    problem = Problem(model, measurements.postures, conditions, measurements.positions[None], weights)
    values = levenberg_marquardt(problem.least_squares, start[None]).parameters[0]
    residuals, jacobian = problem.residuals(values)[0], problem.jacobian(values)
    refitted = model.parameters.mapping(values)
    refitted = placed_values(model.arm.chain, refitted)
    return refitted, residuals, spectrum(jacobian, model.scales).rank


def conditions_of(arm: Arm, measurements: Measurements, refit: str) -> Conditions:
    """Conditions with the temperature counted from the mean of the data of the identification, where it is known.

    Where the arm was set up again (`refit`), what happened once in the session of the identification is over: a drift
    or a step has come to its end.
    """
    conditions, mean = measurements.conditions, identified(arm).get("mean_temperature_C")
    if refit != "none" and any(effect.once for effect in Model(arm).effects):
        conditions = replace(conditions, time=np.full(len(measurements), END))
    if measurements.temperature is None or mean is None:
        return conditions
    return replace(conditions, temperature=measurements.temperature - float(mean))


def _hardly_better(validation: Validation) -> list[str]:
    """Where the squares saved are no more than groups of rows, by time or by region of posture, scatter by."""
    after, before = (distances(residuals) for residuals in (validation.residuals, validation.nominal_residuals))
    gained = gained_squares(before, after, validation.measurements)
    if gained.value <= 0.0 or gained.p_above() <= LEVEL / 2.0:
        return []
    share = 100.0 * validation.model.rms / validation.nominal.rms
    of_drawing = f"{share:.0f} % of the RMS error of the drawing, refitted in the same way"
    return [f"the model leaves {of_drawing}: {HARDLY}, as far as these rows tell (p = {gained.p_above():.2g})"]


def _notes(arm: Arm, measurements: Measurements, undetermined: int, refit: str) -> Iterator[str]:
    """What to know before these figures are believed."""
    provenance = identified(arm)
    hashes = {sha for one in (provenance, *provenance.get("held_from", {}).values()) for sha in data_hashes(one)}
    if not hashes.isdisjoint(data_hashes(measurements.provenance)):
        yield FITTED
    if far := extrapolation(arm, measurements.postures):
        yield far
    model = Model(arm)
    if once := [effect.key for effect in model.effects if effect.once and refit != "none"]:
        yield f"{', '.join(once)}: of the session of the identification only; taken as at its end, in all rows"
    for effect in model.effects:
        for need, column in (("temperature", "temperature_C"), ("time", "order or time_s")):
            missing = measurements.temperature is None if need == "temperature" else measurements.order is None
            if need in effect.needs and missing:
                instead = "the mean temperature" if need == "temperature" else "the order of the rows"
                yield f"{effect.key} needs the column {column}, which the measurements lack: {instead} is taken"
    if undetermined:
        yield "the postures do not determine everything that is refitted; what they leave open stays as in the file"


def judged(diagnosis: Diagnosis, arm: Arm, measurements: Measurements, holdout: Measurements | None) -> Diagnosis:
    """The diagnosis with what its extended model is worth beside the geometry (`Diagnosis.offered`).

    Where nothing is missing nothing is offered. On a hold-out both are placed as `validate` places them, so that the
    figures are those that it gives of the files of `diagnose --out` and of `identify --out`; without one, the
    cross-validation over postures says it.

    arm : as it was diagnosed;  measurements, holdout : as for `diagnose`
    """
    if diagnosis.verdict == "none" or not diagnosis.predicting.specs:
        return diagnosis
    if holdout is None:
        tests = [test for test in diagnosis.cross_validation if test.transfer == "other postures"]
        return replace(diagnosis, offered=Offered.of_test(tests[0])) if tests else diagnosis
    kept = measurements.rows([k for k in range(len(measurements)) if k + 1 not in set(diagnosis.outlier_rows)])
    geometry = identified_geometry(arm, kept)
    try:
        alone, extended = (validate(each, holdout).residuals for each in (geometry, diagnosis.extended_arm()))
    except InputError:  # too few rows to place the arm
        return diagnosis
    return replace(diagnosis, offered=Offered.of("holdout", alone, extended, holdout))


def identified_geometry(arm: Arm, measurements: Measurements) -> Arm:
    """The arm as `identify` calibrates it, where it stands in the first session."""
    fit = estimate(Model(with_sessions(arm, measurements)), measurements)
    return replace(arm, calibration=without_sessions(fit.calibration()))


def prior_judged(
    geometry: Callable[[], Identification], fit: Identification, measurements: Measurements
) -> Offered | None:
    """What a fit with a prior of further effects is worth beside the geometry, each posture predicted from the others;
    None where the rows determine the one or the other not."""
    model = left_out_residuals(fit, measurements)
    alone = None if model is None else left_out_residuals(geometry(), measurements)
    return None if model is None or alone is None else Offered.of("cross-validation", alone, model, measurements)
