"""What is promised of every outcome, and which promise an outcome breaks."""

import json
import os
import re
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir
from pathlib import Path
from typing import NamedTuple

import click
import polars as pl
from click.testing import CliRunner

from doe.cli import main
from doe.cli.verb import LONGEST_LINE
from identification import InputError, Plan, load_arm, load_measurements
from identification.files.csv import read_table
from identification.files.urdf import read_urdf
from tests.fuzz.commands import LOOPS, THERE, Case

PROGRESS = re.compile(r"armcal (warning: |\w+: \d+ s)|armcal: warning: ")
# one of these says what would be right
ALLOWED = ("allowed", "armcal effects lists them", "add to the arm file", "name the columns")


class Outcome(NamedTuple):
    """How a call ended: exit code (None: an exception), the streams, and the files that are new or changed."""

    code: int | None
    out: str
    err: str
    written: tuple[str, ...]
    error: str = ""


def prepare(case: Case, folder: Path) -> None:
    """The files of a case."""
    for name, text in {**THERE, **case.files}.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(text.encode(errors="replace"))
    for name, target in LOOPS.items():
        (folder / name).symlink_to(target)


def run_here(case: Case, folder: Path) -> Outcome:
    """The call in this process, in a prepared folder."""

    def state() -> dict[Path, bytes]:
        paths = [Path(place) / name for place, _, names in os.walk(folder.parent) for name in names]
        return {path: b"" if path.is_symlink() else path.read_bytes() for path in paths}

    before = state()
    with chdir(folder):
        done = CliRunner().invoke(main, case.words, prog_name="armcal")
    written = tuple(os.path.relpath(p, folder) for p, text in sorted(state().items()) if text != before.get(p))
    error = done.exception
    if error is None or isinstance(error, SystemExit | click.exceptions.Exit):
        return Outcome(done.exit_code, done.stdout, done.stderr, written)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if re.search("/(doe|identification)/", f.filename)]
    place = f"({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return Outcome(None, done.stdout, done.stderr, written, f"{type(error).__name__}: {error} {place}")


def broken(case: Case, outcome: Outcome, folder: Path) -> str | None:
    """The first promise that the outcome breaks, None: it keeps all."""
    return next(promises(case, outcome, folder), None)


def promises(case: Case, outcome: Outcome, folder: Path) -> Iterator[str]:
    """What is wrong, the worst first."""
    code, out, err, written, error = outcome
    helped = out.startswith("Usage: ") or err.startswith("Usage: ")
    lines = [line for line in err.splitlines() if not PROGRESS.match(line)]
    if code is None or "Traceback (most recent call last)" in err:
        yield f"traceback: {error or err.strip().splitlines()[-1]}"
    if code not in (0, 1, 2):
        yield f"exit code {code}"
    for name, text in (("output", out), ("errors", err)):
        if bad := [char for char in text if not (char.isprintable() or char == "\n")]:
            yield f"control character {bad[0]!r} in standard {name}"
    if any(len(line) > LONGEST_LINE + 20 for line in lines):
        yield "a line of errors is too long"
    if code == 2 and not helped:
        if len(lines) != 1:
            yield f"{len(lines)} lines of errors: {lines[:3]}"
        if out and "diagnose" not in case.words:  # a diagnosis is shown even if its files cannot be written
            yield "output beside an error"
        right = ":" in lines[0] and any(words in lines[0] for words in ALLOWED)
        if not right and not lines[0].startswith("Error: "):
            yield f"does not say what is allowed: {lines[0]}"
    if code == 1 and not lines and not out:
        yield "exit 1 without a reason"
    if code in (1, 2) and written:
        yield f"left behind after exit {code}: {', '.join(written)}"
    if hidden := [name for name in written if "/." in f"/{name}" or name.endswith(".tmp")]:
        yield f"left behind: {hidden}"
    if (touched := [name for name in THERE if name in written]) and "--force" not in case.words:
        yield f"overwrote {touched} without --force"
    if code == 0:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the command has said them
                if "--json" in case.words and not helped:
                    json.loads(out, parse_constant=_refuse)
                for name in written:
                    for read in readers(case, name):
                        read(folder / name)
        except (InputError, ValueError, OSError) as error:
            yield f"written, not read again: {error}"


def _refuse(text: str) -> None:
    raise ValueError(f"holds {text}")


def readers(case: Case, name: str) -> list[Callable[[Path], object]]:
    """Our own readers of a file that a verb has written, by what the verb writes under its options."""
    verb, given = case.verb, dict(zip(case.words[1:], case.words, strict=False))
    option = given.get(name, "") if given.get(name, "").startswith("--") else "--out"
    if option in ("--picture", "--report") or verb in ("report", "program"):  # whatever its name
        return []
    if verb in ("demo", "init", "study", "compare"):
        ends = {".parquet": pl.read_parquet, "arm.toml": load_arm, ".urdf": read_urdf}
        return [read for end, read in ends.items() if name.endswith(end)]
    if option == "--urdf" or (verb in ("identify", "diagnose") and option == "--out"):
        return [read_urdf if option == "--urdf" else load_arm]
    tables: list[Callable[[Path], object]] = [_without_nan, read_table]
    if "arm.toml" in case.words and verb in ("design", "relax"):  # compensate leaves cells empty without a command
        tables.append(lambda path: Plan.load(path, load_arm(path.parent / "arm.toml").joint_types))
    if "arm.toml" in case.words and verb == "simulate":
        tables.append(lambda path: load_measurements(path, load_arm(path.parent / "arm.toml")))
    return tables


def _without_nan(path: Path) -> None:
    if re.search(r"(?i)(^|[,\n])\s*(nan|inf|-inf)\s*([,\n]|$)", path.read_text()):
        raise ValueError("NaN or infinity in a CSV file")
