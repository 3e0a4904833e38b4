"""Validation: how well a calibrated model predicts other measurements, with nothing refitted but where the arm stands,
beside the drawing refitted in the same way. So a model is judged, too, before it is offered for use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from identification.arm import SESSIONS, Arm
from identification.arrays import Array, ReadOnly, rows_in_words
from identification.document import Document, Documented, in_a_sentence
from identification.documents import identification as shown
from identification.errors import InputError
from identification.estimation import Identification, estimate
from identification.estimation.doubts import FALL, lacking, left_out_residuals
from identification.estimation.problem import Problem, check_shape
from identification.estimation.uncertainty import LEVEL_95, chance_of_gain
from identification.information import spectrum
from identification.inspection.readings import FAR
from identification.kinematics.chain import BASE, TOOL
from identification.kinematics.frames import pose_table
from identification.kinematics.parameters import JOINT_OFFSET, error_names
from identification.measurements import MOST, POINT, Conditions, Measurements, distances, rms_distance
from identification.model import Model
from identification.model.placed import placed_model, start_at_base, with_markers, with_sessions, without_sessions

if TYPE_CHECKING:  # a diagnosis imports this package
    from identification.gap.result import Diagnosis


class Figures(NamedTuple):
    """Of the distances between model and measurement [mm], over rows; `p95` is their 95th percentile."""

    rms: float
    mean: float
    p95: float
    max: float


def figures_of(residuals: Array) -> Figures:
    """Of residuals (m, d) [mm]."""
    off = distances(residuals)
    return Figures(rms_distance(residuals), float(np.mean(off)), float(np.percentile(off, 95.0)), float(np.max(off)))


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Documented, ReadOnly):
    """What a calibrated model leaves of other measurements, beside the drawing.

    refit : what was refitted, `base`, `offsets` or `none`, in each session separately
    refitted : session, name, unit and value of each refitted parameter, in file units
    residuals, nominal_residuals : (m, d) measured less computed [mm], by the model and by the drawing
    refit_nominal : what was refitted for the drawing
    left_open : combinations of what was to be refitted that the rows do not determine
    """

    arm: Arm
    measurements: Measurements
    refit: str
    refitted: tuple[Mapping[str, Any], ...]
    residuals: Array
    nominal_residuals: Array
    refit_nominal: str
    left_open: int = 0

    # over all rows, of the calibrated model, and of the drawing, refitted in the same way
    model = property(lambda self: figures_of(self.residuals))
    nominal = property(lambda self: figures_of(self.nominal_residuals))

    @property
    def promised(self) -> float:
        """RMS distance [mm] that the file promises, with these rows' noise if that is larger; infinite: not known."""
        calibration = self.arm.calibration
        if calibration is None or calibration.scatter is None or shown.unit_key(self.arm):
            return np.inf
        given = 0.0 if self.measurements.sigma is None else float(np.sqrt(np.mean(np.square(self.measurements.sigma))))
        noise = max(calibration.scatter, given) * np.sqrt(self.residuals[:, POINT].shape[1])
        return float(np.hypot(noise, float(self.arm.provenance.get("expected_tip_measured_mm", 0.0))))

    @property
    def rms_angles(self) -> tuple[float, ...]:
        """RMS angles between orientations measured and computed [deg], by model and drawing; empty: none measured."""
        scale = self.arm.chain.angle_scale
        angles = [residuals[:, POINT.stop :] for residuals in (self.residuals, self.nominal_residuals)]
        return tuple(float(np.degrees(rms_distance(a) / scale)) for a in angles if scale and a.size)

    def to_json(self) -> dict[str, Any]:
        """Keys of `validate` (identification/files/README.md, "JSON keys"); `blocks`: rows by session, and by range."""

        def millimetres(figures: Figures, of: str = "") -> dict[str, float]:
            return {f"{name}{of}_mm": value for name, value in figures._asdict().items()}

        of_sessions = zip(self.measurements.sessions, self.measurements.session_rows, strict=False)
        groups = [("session", name, rows) for name, rows in of_sessions]
        out = self.arm.outside(self.measurements.postures)
        beyond = np.zeros(len(self.residuals), dtype=bool) if out is None else np.any(out, axis=1)
        if 0 < np.count_nonzero(beyond) < len(beyond):
            groups += [("range", "inside", np.flatnonzero(~beyond)), ("range", "outside", np.flatnonzero(beyond))]
        blocks = [
            {"kind": kind, "name": name, "rows": len(rows), **millimetres(figures_of(self.residuals[rows]))}
            | {"rms_nominal_mm": rms_distance(self.nominal_residuals[rows])}
            for kind, name, rows in groups
        ]
        return {
            "rows": len(self.residuals),
            "refit": self.refit,
            "refit_nominal": self.refit_nominal,
            **millimetres(self.model),
            **millimetres(self.nominal, "_nominal"),
            **dict(zip(("rms_deg", "rms_nominal_deg"), self.rms_angles, strict=False)),
            "blocks": blocks,
            "refitted": [dict(row) for row in self.refitted],
            "notes": list(self.notes),
            **shown.unit_key(self.arm),
        }

    notes = cached_property(lambda self: tuple(self._remarks()))  # what to know before these figures are believed

    def _remarks(self) -> Iterator[str]:
        arm, measurements, refit = self.arm, self.measurements, self.refit
        after, before = (distances(residuals) for residuals in (self.residuals, self.nominal_residuals))
        # where the squares saved are no more than groups of rows, by time or by region of posture, scatter by
        chance = chance_of_gain(before, after, measurements, len(self.refitted))
        if self.model.rms < self.nominal.rms and chance > LEVEL_95 / 2.0:
            share = 100.0 * self.model.rms / self.nominal.rms
            of_drawing = f"{share:.0f} % of the RMS error of the drawing, refitted in the same way"
            yield f"the model leaves {of_drawing}, which {shown.BY_CHANCE} as far as these rows tell (p = {chance:.2g})"
        times = np.empty_like(after)
        for rows in measurements.session_rows:  # of which one row may move the base; [mm] less is rounding
            times[rows] = after[rows] / max(float(np.median(after[rows])), 1e-6)
        if (astray := times > FAR).any():
            off = f"up to {after[astray].max():.4g} mm off, {times.max():.3g} times the median"
            yield f"{rows_in_words(astray)}: {off}, as of a lost beam or contact: all these figures contain such rows"
        if angles := self.rms_angles:
            yield f"orientations: RMS {angles[0]:.3g} deg, by the drawing {angles[1]:.3g} deg"
        tools, names = arm.chain.tools, () if arm.chain.instrument.own_targets else measurements.marker_names
        fresh = [name for name in names if name not in tools]
        if refit != "none":  # measured points that the calibration does not have are fitted
            if not names and len(tools) > 1:
                alone = "the rows are assumed to be of one reflector; its position was fitted to them"
                yield f"no column marker: {alone}; if there are several, name them in the column marker"
            elif fresh and not len(tools) == 1 == len(names):
                its = "its position was" if len(fresh) == 1 else "their positions were"
                yield f"the calibration has no reflector {', '.join(fresh)}: {its} fitted to these rows"
        if (own := measurements.share_fitted(arm.provenance)) > 0.9:  # convention: a few others or left out rows
            yield shown.FITTED
        elif own > 0.0:
            yield f"about {100.0 * own:.0f} % of these rows are {shown.AMONG}"
        if far := shown.extrapolated(arm.outside(measurements.postures), "rows"):
            yield far
        with suppress(InputError):  # of rows too few to say where the arm stands
            base = self.residuals if refit == "base" else _refitted(arm, measurements, "base")[1]
            left, of_positions = f"{in_a_sentence(rms_distance(base))} mm RMS", arm.chain.instrument.reads_positions
            if refit == "none" and of_positions and _much_less(base, self.residuals, measurements):
                yield f"with the base refitted, as without --refit none, it leaves {left}"
            if own <= 0.9 and rms_distance(base) > FALL * self.promised:
                numbers, freed, _ = _refitted(arm, measurements, "offsets")
                zeros = f"; {in_a_sentence(rms_distance(freed))} mm {shown.ZEROS}"
                zeros *= _much_less(freed, base, measurements, len(numbers))
                yield f"{left} with the base refitted is {shown.BEYOND} ({in_a_sentence(self.promised)} mm){zeros}"
        model = Model(arm)
        if once := [effect.key for effect in model.effects if effect.once and own < MOST]:
            at_end = "the value at the end of the session of the identification is used in all rows"
            again = "these rows are assumed to be that session from beginning to end"
            yield f"{', '.join(once)}: {again if refit == 'none' else at_end}"
        yield from lacking(model, measurements)
        if self.left_open:
            yield "the postures do not determine everything that is refitted; what they leave open stays as in the file"

    def document(self) -> Document:
        """What the model is worth, drawing and model over all rows, then block by block."""
        data = self.to_json()
        notes = [note for note in self.notes if shown.BY_CHANCE not in note and note != shown.FITTED]
        return Document("Validation", [shown.validation_verdict(data), *notes], shown.validation_sections(data))


def _much_less(after: Array, before: Array, measurements: Measurements, fitted: int = 0) -> bool:
    """Whether what is left of (m, d) falls beyond chance, and by more than the numbers refitted take from the noise of
    a few postures (convention: a quarter)."""
    chance = chance_of_gain(distances(before), distances(after), measurements, fitted)
    return rms_distance(after) < 0.75 * rms_distance(before) and chance <= LEVEL_95 / 2.0


def validate(arm: Arm, measurements: Measurements, refit: str = "base") -> Validation:
    """Compares a calibrated arm with measurements that were not used to identify it.

    arm : with a calibration, or with known effect values; all of it stays as it is but for
    refit : `base`, position and rotation of the base (three numbers, the arm may not have had a base offset before; of
        a spatial arm six, and the measured points); `offsets`, that and every joint offset; `none`, nothing. In each
        session separately

    Raises `InputError` for an arm without calibration, another `refit`, or `none` where nothing is measured from where
    the arm stands, data of another arm, too few rows.
    """
    InputError.check_names("refit: unknown name", [refit], shown.DRAWN)
    arm.require_calibrated()
    instrument, several = arm.chain.instrument, len(measurements.sessions) > 1
    if refit == "none" and (instrument.own_targets or (several and not instrument.reads_positions)):
        what = instrument.target or "center"
        raise InputError(f"refit none: no calibrated file says where each {what} is, allowed: base, which finds it")
    refitted, residuals, left_open = _refitted(arm, measurements, refit)
    # a drawing that does not say where it stands is placed: the file's base is of the calibrated geometry
    as_drawn = refit if refit != "none" or arm.chain.settled >= {BASE, TOOL} else "base"
    nominal = _refitted(replace(arm, effects=(), calibration=None), measurements, as_drawn)[1]
    return Validation(arm, measurements, refit, tuple(refitted), residuals, nominal, as_drawn, left_open)


def drawing_residuals(arm: Arm, measurements: Measurements) -> Array:
    """(m, d) residuals [mm] of an arm as it is drawn, without effects and calibration, placed as a fit to these
    measurements places it: a base for each session, one place for a measured point that several sessions share."""
    drawing = replace(arm, chain=replace(arm.chain, fixed=frozenset()), effects=(), calibration=None)
    return placed(with_sessions(drawing, measurements), measurements, measurements.conditions)[2]


def _refitted(arm: Arm, measurements: Measurements, refit: str) -> tuple[list[dict[str, Any]], Array, int]:
    """The refitted parameters (`Validation.refitted`), (m, d) residuals [mm], and how many combinations the data leave
    open.

    The temperature is counted from the mean of the data of the identification, where it is known. In other rows than
    those what happened once in that session is over: a drift or a step has come to its end.
    """
    model, conditions, provenance = Model(arm), measurements.conditions, arm.provenance
    check_shape(model, measurements)
    if refit != "none" and measurements.share_fitted(provenance) < MOST:
        conditions = model.afterwards(conditions, len(measurements))
    if measurements.temperature is not None and (mean := provenance.get("mean_temperature_C")) is not None:
        conditions = replace(conditions, temperature=measurements.temperature - float(mean))
    refitted, residuals, left_open = list[dict[str, Any]](), np.empty_like(measurements.positions), 0
    for name, rows in zip(measurements.sessions or (None,), measurements.session_rows, strict=True):
        model, values, residuals[rows], determined = placed(arm, measurements.rows(rows), conditions.rows(rows), refit)
        left_open += len(values) - determined
        # where base and measured points are, by the names of their parameters, in place of their corrections
        stands, places = model.arm.chain.standing_in(model.parameters.mapping(values)), dict[str, float]()
        for place, frame in {BASE: stands.base, **{f"{TOOL}[{n}]": at for n, at in stands.tools.items()}}.items():
            places |= dict(zip(error_names(place), pose_table(frame).values(), strict=True))
        refitted += [
            {"session": name, "name": p.name, "unit": p.file_unit, "value": places.get(p.name, value * p.to_file)}
            for p, value in zip(model.parameters, values.tolist(), strict=True)
        ]
    return refitted, residuals, left_open


def placed(
    arm: Arm, session: Measurements, conditions: Conditions, refit: str = "base"
) -> tuple[Model, Array, Array, int]:
    """The model of a calibrated arm in the rows of one session, of which only what is refitted is free, its values
    (p,), (m, d) residuals [mm], and how many combinations of the values the rows determine.

    The offsets of the first joint, and of the last where points are to be found, stay: base and points stand for these.
    Raises `InputError` for no more numbers than values.
    """
    chain, named, free = arm.chain, session, set[str]()
    if len(chain.tools) == 1 == len(session.marker_names):
        # it is that which is measured, whatever the data call it
        named = replace(session, marker=None, marker_names=())
    if refit == "none":
        try:
            with_markers(replace(chain, settled=frozenset({BASE, TOOL})), named)
        except InputError as error:
            raise InputError(f"{error}; or --refit base, which finds where they are") from None
        model = Model(replace(arm, chain=with_markers(chain, named)))
    else:
        names = {*named.marker_names}  # where all that is measured is given, it stays there
        is_given = TOOL in chain.settled and names <= {*chain.tools} and (names or len(chain.tools) == 1)
        chain = replace(chain.one_unnamed(names), settled=chain.drawn | ({TOOL} if is_given else set()))
        model = placed_model(Model(replace(arm.with_base(anew=True), chain=chain)), named)
        measured = [name for k, name in enumerate(model.arm.chain.tools) if k in named.numbers("marker")]
        moved = (f"{SESSIONS}.", *(f"{TOOL}[{name}]." for name in measured))
        free = {p.name for p in model.all_parameters if p.kind == BASE or p.name.startswith(moved)} | {*chain.standing}
        if refit == "offsets":
            free |= {f"{JOINT_OFFSET}:{j}" for j in range(2, arm.links + (TOOL in chain.settled))}
    model = replace(model, held={name: value for name, value in model.best_known.items() if name not in free})
    values = start_at_base(model, named, conditions)
    if session.positions.size <= (p := len(values)) > 0:
        place = ": session ".join([str(session.provenance.get("file", "measurements")), *session.sessions])
        allowed = f"allowed: at least {p // session.dimension + 1} rows in each session"
        raise InputError(f"{place}: too few for {p} refitted parameters, {len(session)} in all, {allowed}")
    weights = np.ones(len(session)) if session.sigma is None else session.sigma**-2.0
    problem = Problem(model, session.postures, conditions, session.positions[None], weights)
    determined = spectrum(problem.rows_about(values)[1], model.scales).rank if p else 0
    if determined < p and not (chain.settled or chain.instrument.own_targets):  # what is left open stays as in the file
        stands, here = arm.chain.standing_in(Model(arm).best_known), model.arm.chain
        tools = {name: stands.tools.get(name, at) for name, at in here.tools.items()}
        model = replace(model, arm=replace(model.arm, chain=replace(here, base=stands.base, tools=tools)))
        problem = replace(problem, model=model)
    values = problem.minimized(values[None]).parameters[0] if p else values
    return model, values, problem.residuals(values)[0], determined


# -- judged before it is offered ---------------------------------------------------------------------------------------
def offer(
    by: str, rows: int, model: tuple[float, float], geometry: tuple[float, float], p: float, refitted: bool = False
) -> dict[str, Any]:
    """Key `offered` (identification/files/README.md, "JSON keys"): RMS and largest distance [mm] that the model offered
    and the geometry alone leave, and whether it is better beyond chance;  by : `holdout` or `cross-validation` (each
    posture by a fit to others);  p : one-sided p-value, of no gain;  refitted : where the arm stands was, for both"""
    lengths = {"rms_mm": model[0], "max_mm": model[1], "rms_geometry_mm": geometry[0], "max_geometry_mm": geometry[1]}
    lengths |= {"p_value": p, "refitted": refitted}
    return {"by": by, "rows": rows, **lengths, "better": model[0] < geometry[0] and p <= LEVEL_95 / 2.0}


def beside_geometry(by: str, geometry: Array, model: Array, measurements: Measurements, fitted: int = 0) -> Any:
    """`offer` from residuals (m, d) [mm] of the same rows;  fitted : as of `chance_of_gain`"""
    p_value = chance_of_gain(distances(geometry), distances(model), measurements, fitted)
    alone, whole = ((rms_distance(left), float(np.max(distances(left)))) for left in (geometry, model))
    return offer(by, len(model), whole, alone, p_value, by == "holdout")


def judged(diagnosis: Diagnosis, arm: Arm, measurements: Measurements, holdout: Measurements | None) -> Diagnosis:
    """The diagnosis with what its extended model is worth beside the geometry (`Diagnosis.offered`).

    Where nothing is missing nothing is offered. A hold-out that was measured between the data says it as it confirms
    the model: what happened once, a drift or a step, is in its rows, too. In others both are placed as `validate`
    places them, so that the figures are those that it gives of the files of `diagnose --out` and of `identify --out`.
    Without a hold-out, or with one of too few rows, the cross-validation over postures says it.
    """
    if diagnosis.verdict == "none" or not diagnosis.predicting.specs:
        return diagnosis
    decides = diagnosis.confirmation is not None and diagnosis.confirmation.confirmed is not None
    tests = (diagnosis.confirmation,) if decides else diagnosis.cross_validation
    test = next((test for test in tests if test and test.transfer == "other postures" and not test.refitted), None)
    if test is not None:
        after, before = (test.after_mm, test.max_after_mm), (test.before_mm, test.max_before_mm)
        p_value = 1.0 if test.p_shrinks is None else test.p_shrinks
        return replace(diagnosis, offered=offer(test.by, test.rows, after, before, p_value))
    if holdout is None:
        return diagnosis
    kept = measurements.rows([k for k in range(len(measurements)) if k + 1 not in set(diagnosis.outlier_rows)])
    # as `identify` calibrates it, where it stands in the first session
    geometry = replace(arm, calibration=without_sessions(estimate(Model(with_sessions(arm, kept)), kept).calibration()))
    try:
        alone, extended = (validate(each, holdout) for each in (geometry, diagnosis.extended_arm()))
    except InputError:  # too few rows to place the arm
        return diagnosis
    judges = alone.residuals, extended.residuals, holdout, len(extended.refitted)
    return replace(diagnosis, offered=beside_geometry("holdout", *judges))


def prior_judged(
    geometry: Callable[[], Identification], model: Array | None, measurements: Measurements
) -> dict[str, Any] | None:
    """What a fit with a prior of further effects is worth beside the geometry, each posture predicted from the others;
    None where the rows determine the one or the other not;  model : `left_out_residuals` of that fit"""
    alone = None if model is None else left_out_residuals(geometry(), measurements)
    return None if model is None or alone is None else beside_geometry("cross-validation", alone, model, measurements)
