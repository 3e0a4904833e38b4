"""Simulated measurements: a true arm, a plan, and noise from an explicit generator."""

from dataclasses import replace
from typing import Any

import numpy as np

from identification.arm import SERVO, Arm, EffectSpec
from identification.arrays import Array, rows_in_words
from identification.effects import build_all
from identification.effects.formulas import Scene
from identification.errors import InputError, require
from identification.information import RANK_TOLERANCE
from identification.kinematics.frames import turned
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import Measurements, directions_from_order
from identification.model import Model
from identification.model.placed import led_to_contact, of_positions


def simulate(
    truth: Arm,
    postures: Array,
    generator: np.random.Generator,
    *,
    sigma: float | None = None,
    payload: Array | None = None,
    temperature: Array | None = None,
    directions: Array | None = None,
) -> Measurements:
    """Measure `truth` once at each posture, in the given order; of several measured points every one, with orientations
    where the truth measures them.

    truth : arm whose calibration and effect values are the true ones; what has no value is zero, but an effect on the
        scatter needs all of its values
    postures : (m, n) commanded joint angles [rad]
    sigma : standard deviation per axis [mm], default the arm's; 0 gives exact positions. Of orientations in the same
        ratio to `sigma_deg` as in the truth
    payload, temperature : (m,) conditions per row, where the truth needs them [kg], [deg C]
    directions : (m, n) of approach, +1 or -1; left out: they follow from the order
    """
    q = np.atleast_2d(np.asarray(postures, dtype=float))
    seated = truth.chain.instrument.contact and truth.chain.instrument.own_targets
    if truth.chain.instrument.contact and not seated:
        kind = f"kind {truth.chain.instrument.kind}: a plan does not say at which postures the surface is touched"
        raise InputError(f"instrument: found {kind}, allowed: distance, or no [instrument]")
    model, order, effects = Model(truth), np.arange(len(q), dtype=float), build_all(truth.effects, truth.chain)
    noise = truth.sigma if sigma is None else sigma
    if noise is None or not 0.0 <= noise < np.inf:
        raise InputError(f"sigma: found {noise}, allowed: a number >= 0 [mm], given here or with the arm")
    noisy = [effect for effect in effects if effect.scatter]
    for effect in noisy:  # without values it would be none
        if missing := [p.toml_key for p in effect.parameters if p.short not in effect.fixed]:
            lacks = f"no value of {', '.join(missing)}"
            raise InputError(f"effects: {effect.spec.key}: {lacks}, allowed: a number for each")
    if "temperature" in model.needs and temperature is None:
        needed = "an effect of the truth needs a temperature per row, none is given"
        raise InputError(f"temperature_C: {needed}, allowed: a plan with it")
    approach = directions_from_order(q) if directions is None else directions
    session = Measurements(q, np.zeros((len(q), model.dimension)), order, payload, temperature, approach)
    if (shift := truth.servo_shift(approach)).any():  # the joints come to rest, and are read, beside their commands
        session = replace(session, postures=q + shift, commanded=q)
    if len(truth.chain.tools) > 1:
        points, rows = tuple(truth.chain.tools), len(session)
        every = session.rows(np.repeat(np.arange(rows), len(points)))  # each row once for each measured point
        session = replace(every, marker=np.tile(points, rows), marker_names=points)
    q = session.postures
    if seated:  # in the nearest target, which the truth has to place, but for the noise; read are the joints alone
        instrument = truth.chain.instrument
        keys = ", ".join(sorted(instrument.keys))
        require(instrument.targets, f"instrument: found none of {keys}, allowed: with the places of what is touched")
        goals = noise * generator.standard_normal((len(session), instrument.dimension))
        q = led_to_contact(model, q, goals, np.ones(session.links))
        left = np.linalg.norm(model.position(q) - goals, axis=1)
        if (lost := ~(left < 1e-6)).any():  # [mm] how near to a target is in it
            state = f"plan: from {rows_in_words(lost)} no {instrument.target} can be reached"
            raise InputError(f"{state}, allowed: postures near to one")
        seats = of_positions(model).position(q)
        apart = [np.linalg.norm(seats - place, axis=1) for place in instrument.targets.values()]
        names = np.array([*instrument.targets])[np.argmin(apart, axis=0)]
        return replace(session, postures=q, marker=names, marker_names=tuple(instrument.targets))
    exact = model.position(q, conditions=session.conditions)
    errors = noise * generator.standard_normal(exact.shape)
    if noisy:
        levers = Model(replace(truth, effects=(), calibration=None)).joint_levers(q, None, session.conditions)
        time = np.zeros(len(q)) if session.conditions.time is None else session.conditions.time
        scene = Scene(exact[:, : truth.dimension], levers, time, noise, generator)
        for effect in noisy:  # in the order of the arm file
            errors = effect.disturb(errors, scene, [effect.fixed[p.short] for p in effect.parameters])
    if (scale := truth.chain.angle_scale) is None:
        return replace(session, positions=exact + errors)
    seen = turned(errors[:, 3:] / scale) @ model.orientations(q, session.conditions)
    return replace(session, positions=(exact + errors)[:, :3], orientations=seen)


# -- servo errors ------------------------------------------------------------------------------------------------------
def with_servo_errors(arm: Arm, measurements: Measurements) -> tuple[Arm, list[dict[str, Any]]]:
    """The arm with the servo errors that the measurements show, instead of its own, and of every joint an entry of
    `servo_error` (identification/files/README.md, "JSON keys"): read less commanded position = offset + reversal s +
    rest by least squares, s the sign of the last motion.

    The arm as it is and no entry where no commands are given or they are the readings.
    """
    signs, entries = measurements.conditions.directions, list[dict[str, Any]]()
    if measurements.commanded is None or signs is None or np.array_equal(measurements.commanded, measurements.postures):
        return arm, entries
    errors, specs = measurements.postures - measurements.commanded, [s for s in arm.effects if s.name != SERVO]
    for j, (kind, error, sign) in enumerate(zip(arm.joint_types, errors.T, signs.T, strict=True), start=1):
        columns = np.column_stack([np.ones(len(error)), sign])
        offset, reversal = np.linalg.lstsq(columns, error, rcond=RANK_TOLERANCE)[0].tolist()
        rms, largest = float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error)))
        figures = {"offset": offset, "reversal": reversal, "rms": rms, "largest": largest}
        figures |= {"rest": float(np.sqrt(np.mean((error - columns @ [offset, reversal]) ** 2)))}
        factor, unit = (180.0 / np.pi, "deg") if kind == REVOLUTE else (1.0, "mm")
        entries.append({"joint": j, "unit": unit, **{name: value * factor for name, value in figures.items()}})
        specs += [EffectSpec(SERVO, j, {"b": offset, "h": reversal})] if largest > 0.0 else []
    return arm.with_effects(*specs), entries
