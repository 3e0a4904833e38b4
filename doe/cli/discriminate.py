"""`armcal discriminate`: the next postures for an ambiguous diagnosis."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

from doe.cli.common import verb, with_collisions
from doe.cli.options import Count, Seconds, written
from identification import InputError, Progress, load_sessions, silent
from identification.document import Answer
from identification.workflow import Written


@verb("armcal discriminate arm.toml data.csv --runs 4 --payloads 0,5 --out next.csv")
def command(
    arm: Path,
    data: tuple[Path, ...],
    *,
    runs: Count,
    payloads: str | None = None,
    seconds: Seconds = 30.0,
    out: Written | None = None,
    force: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Answer:
    """Next postures for an ambiguous diagnosis.

    The next RUNS postures, to distinguish its candidates, and their chance of success. Several files DATA are sessions
    of one arm, as for `armcal diagnose`.

    runs : Number of further measurements K.
    payloads : Payloads to choose from [kg], as 0,5,10; left out: the arm's own.
    seconds : Time budget of the choice, after the diagnosis [s].
    out : Write the next postures (CSV).
    force : Overwrite an existing file.
    """
    from doe.discrimination.t_optimal import discriminate
    from doe.problem.problem import DesignProblem
    from doe.report.design import missing_payload, next_document
    from identification import Model, csv_text, diagnose, load_arm, refuse_contacts

    loaded = load_arm(arm)
    masses = None if payloads is None else payload_list(payloads)
    if masses is not None and loaded.gravity is None:
        raise InputError(f"--payloads: {arm} has no [gravity] table, allowed: with one")
    measurements = load_sessions(data, loaded)
    refuse_contacts(loaded.chain)
    postures, fewest = len(set(measurements.posture_numbers.tolist())), DesignProblem.of(Model(loaded)).fewest_runs
    if postures < fewest:
        counted = f"{len(measurements)} rows of {postures} posture{'s' * (postures != 1)}"
        enough = f"at least {fewest}, which the arm's own parameters need; armcal design --keep {data[-1]} chooses more"
        raise InputError(f"{data[-1]}: {counted}, allowed: {enough}")
    diagnosis = diagnose(loaded, measurements, seed=seed, progress=progress)
    if diagnosis.verdict != "ambiguous":
        sentence = f"nothing to distinguish: the verdict is not ambiguous but {diagnosis.sentence}"
        return Answer({"verdict": diagnosis.verdict, "postures_deg": [], "chance": None}, [sentence])
    end = perf_counter() + seconds

    def late() -> bool:
        left = end - perf_counter()
        progress(5, None, f"choosing the next postures, at most {max(left, 0.0):.0f} s left")
        return left < 0.0

    next_postures = discriminate(loaded, diagnosis, measurements, runs, seed, masses, stop=late)
    lines = [
        f"{line}; measure them and append the rows to {data[-1]}"
        for line in written({out: csv_text(next_postures.columns)}, force, "next postures")
    ]
    shown = [next_document(diagnosis, next_postures), *lines, *missing_payload(loaded, measurements, next_postures)]
    rivals = [list(candidate.effects) for candidate in diagnosis.candidates]
    keys = {"verdict": diagnosis.verdict, "candidates": rivals}
    return with_collisions(Answer(keys | next_postures.to_json(), shown), loaded)


def payload_list(text: str) -> tuple[float, ...]:
    """`0,5,10` as numbers >= 0 [kg]."""
    from identification import LARGEST_MASS

    try:
        masses = tuple(float(word) for word in text.split(","))
    except ValueError:
        masses = (-1.0,)
    if not all(0.0 <= mass <= LARGEST_MASS for mass in masses):
        raise InputError(f"--payloads: {text!r}, allowed: numbers >= 0 [kg] separated by commas, such as 0,5,10")
    return masses
