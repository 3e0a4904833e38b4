"""`armcal simulate`: measurements of an arm whose truth is known."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, verb


@verb("armcal simulate arm.toml plan.csv --truth truth.toml --out data.csv")
@click.argument("arm", type=FILE)
@click.argument("plan", type=FILE)
@click.option("--truth", type=FILE, required=True, help="Arm file with [calibration] and [[effects]] values.")
@click.option("--out", type=FILE, required=True, metavar="FILE", help="Measurements CSV to write.")
@force_option
def command(session: Session, arm: Path, plan: Path, truth: Path, out: Path, force: bool) -> Answer:
    """Measure the TRUTH at the postures of a PLAN, with the arm's noise (sigma_mm).

    The plan may say payload_kg, temperature_C and direction1.. of every row.
    """
    import numpy as np

    from doe.plan_file import load_plan, load_plan_conditions
    from identification.arm_file import load_arm
    from identification.errors import InputError
    from identification.files import write_whole
    from identification.measurement_file import measurement_text
    from identification.simulate import simulate

    loaded, true_arm = load_arm(arm), load_arm(truth)
    if true_arm.links != loaded.links:
        raise InputError(f"{truth}: {true_arm.links} links, allowed: {loaded.links} as in {arm}")
    postures = load_plan(plan, loaded.links).postures
    sigma = true_arm.sigma if true_arm.sigma is not None else loaded.sigma
    conditions = load_plan_conditions(plan, loaded.links)
    data = simulate(true_arm, postures, np.random.default_rng(session.seed), sigma=sigma, **conditions)
    write_whole(out, measurement_text(data), force=force)
    summary = {"rows": len(data), "links": data.links, "sigma_mm": sigma, "out": out}
    return Answer(summary, [f"{len(data)} measurements, sigma {sigma:g} mm, written to {out}"])
