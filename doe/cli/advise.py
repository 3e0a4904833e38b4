"""`armcal advise`: how many measurements?"""

from __future__ import annotations

import re
from pathlib import Path

import click

from doe.cli.common import Answer, Session, verb
from doe.cli.options import FILE, Output, Seconds, output_options
from identification.errors import InputError


@verb("armcal advise arm.toml --runs 4:40 --target-mm 0.02 --picture advice.png", "How many measurements are needed?")
@click.argument("arm", type=FILE)
@click.option("--runs", default="4:40", show_default=True, metavar="A:B", help="Numbers of runs, A to B.")
@click.option("--target-mm", type=float, help="Wanted largest std of a link length; in space error of the tip [mm].")
@click.option("--seconds", type=Seconds(), default=2.0, show_default=True, help="Time budget per number of runs [s].")
@output_options(picture="Write the curve as .png, .svg or .pdf.")
def command(session: Session, arm: Path, runs: str, target_mm: float | None, seconds: float, output: Output) -> Answer:
    """Efficiency and expected accuracy against the number of runs; the smallest number for a wanted accuracy."""
    from doe.advise import advise
    from doe.problem.problem import DesignProblem
    from doe.report.advice import advice_figure, advice_tables
    from identification.files.arm import load_arm
    from identification.model import Model

    loaded = load_arm(arm)
    problem = DesignProblem.of(Model(loaded))
    with session.progress("advise") as progress:
        numbers = run_range(runs, problem.fewest_runs)
        advice = advise(problem, numbers, target=target_mm, seed=session.seed, seconds_each=seconds, progress=progress)
    output.draw(lambda: advice_figure(advice))
    return Answer(advice.to_json(), advice_tables(advice))


def run_range(text: str, fewest: int) -> range:
    """`A:B` or `A`, both ends included. The part below the fewest possible runs is left out if B is possible."""
    parts = text.split(":")
    if not 1 <= len(parts) <= 2 or not all(re.fullmatch(r"\s*\d{1,6}\s*", part) for part in parts):
        raise InputError(f"--runs: {text!r}, allowed: A:B or A with whole numbers up to 999999, such as 4:40")
    low, high = int(parts[0]), int(parts[-1])
    if low > high or high < fewest:
        raise InputError(f"--runs: {text!r}, allowed: A <= B, and B >= {fewest} for this arm")
    return range(max(low, fewest), high + 1)
