"""What is promised of every outcome, and which promise an outcome breaks."""

from __future__ import annotations

import json
import os
import re
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import polars as pl
from click.testing import CliRunner, Result

from doe.cli import main
from doe.cli.verb import LONGEST_LINE
from identification import InputError, Plan, load_arm, load_measurements
from identification.files.csv import read_table
from identification.files.urdf import read_urdf
from tests.fuzz.commands import LOOPS, THERE, Case

RESULT, BAD_INPUT, FAILED, HELP = "result", "bad input", "job failed", "help"
PROGRESS = re.compile(r"armcal (warning: |\w+: \d+ s)|armcal: warning: ")
# one of these says what would be right
ALLOWED = ("allowed", "armcal effects lists them", "add to the arm file", "name the columns")


@dataclass(frozen=True)
class Outcome:
    """How a call ended: exit code (None: an exception), the streams, and the files that are new or changed."""

    code: int | None
    out: str
    err: str
    written: tuple[str, ...]
    error: str = ""

    @property
    def helped(self) -> bool:
        return self.out.startswith("Usage: ") or self.err.startswith("Usage: ")

    @property
    def lines(self) -> list[str]:
        """Those on standard error that are neither warnings nor progress."""
        return [line for line in self.err.splitlines() if not PROGRESS.match(line)]

    @property
    def kind(self) -> str:
        """Of an outcome that keeps all promises."""
        return {0: HELP if self.out.startswith("Usage: ") else RESULT, 2: BAD_INPUT}.get(self.code or 0, FAILED)


def prepare(case: Case, folder: Path) -> None:
    """The files of a case."""
    for name, text in {**THERE, **case.files}.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(text.encode(errors="replace"))
    for name, target in LOOPS.items():
        (folder / name).symlink_to(target)


def broken(case: Case, outcome: Outcome, folder: Path) -> str | None:
    """The first promise that the outcome breaks, None: it keeps all."""
    return next(promises(case, outcome, folder), None)


def promises(case: Case, outcome: Outcome, folder: Path) -> Iterator[str]:
    """What is wrong, the worst first."""
    lines, written = outcome.lines, outcome.written
    if outcome.code is None or "Traceback (most recent call last)" in outcome.err:
        yield f"traceback: {outcome.error or outcome.err.strip().splitlines()[-1]}"
    if outcome.code not in (0, 1, 2):
        yield f"exit code {outcome.code}"
    for name, text in (("output", outcome.out), ("errors", outcome.err)):
        if bad := [char for char in text if not (char.isprintable() or char == "\n")]:
            yield f"control character {bad[0]!r} in standard {name}"
    if any(len(line) > LONGEST_LINE + 20 for line in lines):
        yield "a line of errors is too long"
    if outcome.code == 2 and not outcome.helped:
        if len(lines) != 1:
            yield f"{len(lines)} lines of errors: {lines[:3]}"
        if outcome.out and "diagnose" not in case.words:  # a diagnosis is shown even if its files cannot be written
            yield "output beside an error"
        right = ":" in lines[0] and any(words in lines[0] for words in ALLOWED)
        if not right and not lines[0].startswith("Error: "):
            yield f"does not say what is allowed: {lines[0]}"
    if outcome.code == 1 and not lines and not outcome.out:
        yield "exit 1 without a reason"
    if outcome.code in (1, 2) and written:
        yield f"left behind after exit {outcome.code}: {', '.join(written)}"
    if hidden := [name for name in written if "/." in f"/{name}" or name.endswith(".tmp")]:
        yield f"left behind: {hidden}"
    if (touched := [name for name in THERE if name in written]) and "--force" not in case.words:
        yield f"overwrote {touched} without --force"
    if outcome.code == 0:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the command has said them
                if "--json" in case.words and not outcome.helped:
                    json.loads(outcome.out, parse_constant=_refuse)
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
    found: list[Callable[[Path], object]] = [_without_nan, read_table]
    if "arm.toml" in case.words and verb in ("design", "relax"):  # compensate leaves cells empty without a command
        found.append(lambda path: Plan.load(path, load_arm(path.parent / "arm.toml").joint_types))
    if "arm.toml" in case.words and verb == "simulate":
        found.append(lambda path: load_measurements(path, load_arm(path.parent / "arm.toml")))
    return found


def _without_nan(path: Path) -> None:
    if re.search(r"(?i)(^|[,\n])\s*(nan|inf|-inf)\s*([,\n]|$)", path.read_text()):
        raise ValueError("NaN or infinity in a CSV file")


def run_here(case: Case, folder: Path, invoke: Callable[[list[str]], Result] | None = None) -> Outcome:
    """The call in this process, in a prepared folder; without `invoke` its streams are collected."""

    def state() -> dict[str, bytes]:
        paths = [Path(place) / name for place, _, names in os.walk(folder.parent) for name in names]
        texts = (b"" if path.is_symlink() else path.read_bytes() for path in paths)
        return {str(path.relative_to(folder.parent)): text for path, text in zip(paths, texts, strict=True)}

    before, there = state(), Path.cwd()
    os.chdir(folder)
    try:
        done = invoke(case.words) if invoke else CliRunner().invoke(main, case.words, prog_name="armcal")
    finally:
        os.chdir(there)
    error, after = done.exception, state()
    written = sorted(n.removeprefix(folder.name + os.sep) for n in after if after[n] != before.get(n))
    if error is None or isinstance(error, SystemExit | click.exceptions.Exit):
        return Outcome(done.exit_code, done.stdout, done.stderr, tuple(written))
    frames = [f for f in traceback.extract_tb(error.__traceback__) if re.search("/(doe|identification)/", f.filename)]
    place = f"({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = f"{type(error).__name__}: {error} {place}"
    return Outcome(None, done.stdout, done.stderr, tuple(written), text)
