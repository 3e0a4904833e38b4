"""`armcal simulate`: measurements of an arm whose truth is known."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

from doe.cli.common import Answer, CommonOptions, verb
from doe.cli.options import File, OutFile
from identification.errors import InputError
from identification.files.io import write_whole

if TYPE_CHECKING:
    from identification.arm import Arm


@verb("armcal simulate arm.toml plan.csv --truth truth.toml --out data.csv")
def command(common: CommonOptions, arm: File, plan: File, *, truth: File, out: OutFile, force: bool = False) -> Answer:
    """Simulate the measurements of a plan.

    Measure the TRUTH at the postures of a PLAN, with the arm's noise (sigma_mm). The plan may give payload_kg,
    temperature_C and direction1.. of every row.

    truth : Arm file with [calibration] and [[effects]] values.
    out : Measurements CSV to write.
    force : Overwrite an existing file.
    """
    import numpy as np

    from doe.plan.file import load_plan, load_plan_conditions
    from identification.files.arm import load_arm
    from identification.files.measurement import measurement_text
    from identification.simulate import simulate

    loaded, true_arm = load_arm(arm), load_arm(truth)
    if true_arm.links != loaded.links:
        raise InputError(f"{truth}: {true_arm.links} links, allowed: {loaded.links} as in {arm}")
    if true_arm.dimension < loaded.dimension or true_arm.joint_types != loaded.joint_types:
        kinds = [
            f"{'planar' if a.dimension == 2 else 'spatial'}, {', '.join(a.joint_types)}" for a in (true_arm, loaded)
        ]
        raise InputError(f"{truth}: found an arm that is {kinds[0]}, allowed: {kinds[1]} as in {arm}")
    measured_plan = load_plan(plan, loaded.joint_types)
    sigma = true_arm.sigma if true_arm.sigma is not None else loaded.sigma
    if sigma is None:
        raise InputError(f"{arm}: measurement.sigma_mm is missing, allowed: a number > 0 [mm], here or in {truth}")
    for sentence in without_values(true_arm):
        warnings.warn(f"{truth}: {sentence}", UserWarning, stacklevel=2)
    conditions = load_plan_conditions(plan, loaded.joint_types)
    try:
        data = simulate(true_arm, measured_plan.postures, np.random.default_rng(common.seed), sigma=sigma, **conditions)
    except InputError as error:
        raise InputError(f"{truth}: {error}") from None
    instrument = loaded.chain.instrument
    text = measurement_text(replace(data, fit=measured_plan.fit), loaded.joint_types, instrument)
    write_whole(out, text, force=force)
    summary = {"rows": len(data), "links": data.links, "sigma_mm": sigma, "out": out}
    return Answer(summary, [f"{len(data)} measurements, sigma {sigma:g} mm, written to {out}"])


def without_values(truth: Arm) -> list[str]:
    """A sentence for every effect whose values are all zero, in its table and in the calibration."""
    from identification.effects import build_all

    calibrated = {} if truth.calibration is None else truth.calibration.effects
    built = zip(build_all(truth.effects, truth.chain), truth.effects, strict=True)
    return [
        f"{effect.key} has no value and does nothing; it has {', '.join(p.toml_key for p in effect.parameters)}"
        for effect, spec in built
        if not effect.scatter and not any(p.short in spec.values or p.name in calibrated for p in effect.parameters)
    ]
