"""`armcal advise`: how many measurements?"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from doe.cli.common import stated, verb, with_collisions
from doe.cli.options import Names, Seconds, written
from identification import InputError, Progress, silent
from identification.document import Answer
from identification.workflow import Picture


@verb("armcal advise arm.toml --runs 4:40 --target-mm 0.02 --picture advice.png")
def command(
    arm: Path,
    *,
    runs: Annotated[str, "A:B"] = "4:40",
    only: tuple[Names, ...] = (),
    target_mm: float | None = None,
    seconds: Seconds = 60.0,
    picture: Picture | None = None,
    force: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Answer:
    """How many measurements are needed?

    Efficiency and expected accuracy against the number of runs; the smallest number for a wanted accuracy. With --only
    how few postures are enough to find these parameters again, the others as in ARM, for `identify --only`.

    runs : Numbers of runs, A to B.
    only : Estimate only these, as `identify --only`.
    target_mm : Wanted largest std of a link length; in space, or with no length, error of the tip [mm].
    seconds : Time budget of all numbers of runs together [s].
    picture : Write the curve as .png, .svg or .pdf.
    force : Overwrite an existing file.
    """
    from doe.advise import advise
    from doe.problem.problem import DesignProblem
    from doe.report.design import advice_document
    from identification import Model, load_arm, with_scatter
    from identification.reuse import only as only_these
    from identification.reuse import words_of

    (loaded, given_sigma), words = with_scatter(load_arm(arm)), words_of(only)
    problem = DesignProblem.of(only_these(loaded, words) if words else Model(loaded))
    if words and not stated("runs"):
        runs = f"{problem.fewest_runs}:40"
    numbers = run_range(runs, problem.fewest_runs)
    advice = advise(problem, numbers, target=target_mm, seed=seed, seconds=seconds, progress=progress)
    subset_keys = {"only": words, "fewest_runs": problem.fewest_runs} if words else {}
    fewest = f"{problem.fewest_runs} run{'' if problem.fewest_runs == 1 else 's'}"
    remark = f"identifiable from {fewest} or more at well-chosen postures; how accurately, the table says"
    enough = f"{', '.join(words)} alone: {remark}"
    document = advice_document(advice).plus(*([given_sigma] if given_sigma else []))
    shown = [*([enough] if words else []), document]
    answer = Answer(advice.to_json() | subset_keys, shown, warnings=[given_sigma] if given_sigma else [])

    def draw() -> Any:
        from doe.report.figures import advice_figure  # deferred: matplotlib takes longer to load than a small advice

        return advice_figure(advice)

    written({picture: draw}, force)
    return with_collisions(answer, loaded)


def run_range(text: str, fewest: int) -> range:
    """`A:B` or `A`, both ends included. The part below the fewest possible runs is left out if B is possible."""
    parts = text.split(":")
    if not 1 <= len(parts) <= 2 or not all(re.fullmatch(r"\s*\d{1,6}\s*", part) for part in parts):
        raise InputError(f"--runs: {text!r}, allowed: A:B or A with whole numbers up to 999999, such as 4:40")
    low, high = int(parts[0]), int(parts[-1])
    if low > high or high < fewest:
        raise InputError(f"--runs: {text!r}, allowed: A <= B, and B >= {fewest} for this arm")
    return range(max(low, fewest), high + 1)
