"""What is promised of every outcome, and which promise an outcome breaks."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import click
from click.testing import CliRunner, Result

from doe.cli import main
from identification.errors import LONGEST_LINE, InputError
from tests.fuzz.commands import LOOPS, THERE, Case

RESULT, BAD_INPUT, FAILED, HELP = "result", "bad input", "job failed", "help"
PROGRESS = re.compile(r"armcal (warning: |\w+: \d+ s)|armcal: warning: ")
USAGE = "Error: "
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


def prepare(case: Case, folder: Path) -> None:
    """The files of a case."""
    for name, text in {**THERE, **case.files}.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(text.encode(errors="replace"))
    for name, target in LOOPS.items():
        (folder / name).symlink_to(target)


def state(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with its content."""
    found = {}
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place) / name
            found[str(path.relative_to(folder))] = b"" if path.is_symlink() else path.read_bytes()
    return found


def broken(case: Case, outcome: Outcome, folder: Path) -> str | None:
    """The first promise that the outcome breaks, None: it keeps all."""
    for promise in PROMISES:
        if (found := promise(case, outcome, folder)) is not None:
            return found
    return None


def kind(case: Case, outcome: Outcome) -> str:
    """Of an outcome that keeps all promises."""
    if outcome.code == 0:
        return HELP if outcome.out.startswith("Usage: ") else RESULT
    return BAD_INPUT if outcome.code == 2 else FAILED


def no_exception(case: Case, outcome: Outcome, folder: Path) -> str | None:
    if outcome.code is None or "Traceback (most recent call last)" in outcome.err:
        return f"traceback: {outcome.error or outcome.err.strip().splitlines()[-1]}"
    return None if outcome.code in (0, 1, 2) else f"exit code {outcome.code}"


def printable(case: Case, outcome: Outcome, folder: Path) -> str | None:
    for name, text in (("output", outcome.out), ("errors", outcome.err)):
        bad = next((char for char in text if not (char.isprintable() or char == "\n")), None)
        if bad is not None:
            return f"control character {bad!r} in standard {name}"
    return None


def said(outcome: Outcome) -> list[str]:
    """The lines on standard error that are neither warnings nor progress."""
    return [line for line in outcome.err.splitlines() if not PROGRESS.match(line)]


def one_line(case: Case, outcome: Outcome, folder: Path) -> str | None:
    """Exit 2: where, what was found, and what is allowed; nothing else."""
    lines = said(outcome)
    if any(len(line) > LONGEST_LINE + 20 for line in lines):
        return "a line of errors is too long"
    if outcome.code != 2 or outcome.out.startswith("Usage: ") or outcome.err.startswith("Usage: "):
        return None
    if len(lines) != 1:
        return f"{len(lines)} lines of errors: {lines[:3]}"
    if outcome.out and "diagnose" not in case.words:  # a diagnosis is shown even if its files cannot be written
        return "output beside an error"
    sentence = lines[0]
    if sentence.startswith(USAGE):
        return None
    right = ":" in sentence and any(words in sentence for words in ALLOWED)
    return None if right else f"does not say what is allowed: {sentence}"


def reason(case: Case, outcome: Outcome, folder: Path) -> str | None:
    """Exit 1: a line that says why, or an answer that does."""
    if outcome.code == 1 and not said(outcome) and not outcome.out:
        return "exit 1 without a reason"
    return None


def nothing_left(case: Case, outcome: Outcome, folder: Path) -> str | None:
    if outcome.code in (1, 2) and outcome.written:
        return f"left behind after exit {outcome.code}: {', '.join(outcome.written)}"
    hidden = [
        name for name in outcome.written if Path(name).name.startswith(".") or name.endswith((".tmp", ".journal"))
    ]
    return f"left behind: {hidden}" if hidden else None


def own_files(case: Case, outcome: Outcome, folder: Path) -> str | None:
    touched = [name for name in THERE if name in outcome.written]
    return f"overwrote {touched} without --force" if touched and "--force" not in case.words else None


def json_only(case: Case, outcome: Outcome, folder: Path) -> str | None:
    if "--json" not in case.words or outcome.code != 0 or outcome.out.startswith("Usage: "):
        return None

    def refuse(text: str) -> None:
        raise ValueError(f"holds {text}")

    try:
        json.loads(outcome.out, parse_constant=refuse)
    except ValueError as error:
        return f"JSON: {error}"
    return None


def read_again(case: Case, outcome: Outcome, folder: Path) -> str | None:
    """Whatever is written, our own reader reads."""
    if outcome.code != 0:
        return None
    for name in outcome.written:
        for read in readers(case, name):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # the command has said them
                    read(folder / name)
            except (InputError, ValueError, OSError) as error:
                return f"written, not read again: {error}"
    return None


def readers(case: Case, name: str) -> Iterator[Callable[[Path], object]]:
    """Of a file that a verb has written, by what the verb writes under its options."""
    from doe.plan.plan import load_plan
    from identification.files.arm import load_arm
    from identification.files.csv import read_table
    from identification.files.urdf import read_urdf
    from identification.measurements import load_measurements

    given = {
        option: value for option, value in zip(case.words, case.words[1:], strict=False) if option.startswith("--")
    }
    base = next((option for option, value in given.items() if value == name), "--out")
    verb = case.verb
    arm = None
    if base in ("--picture", "--aliases", "--report") or verb == "report":  # whatever its name
        return
    if verb in ("demo", "init", "study", "compare"):
        if name.endswith(".parquet"):
            yield _rows
        elif name.endswith("arm.toml"):
            yield load_arm
        elif name.endswith(".urdf"):
            yield read_urdf
        return
    if base == "--urdf":
        yield read_urdf
        return
    if verb in ("identify", "diagnose") and base == "--out":
        yield load_arm
        return
    yield _without_nan
    if base == "--curves":  # a header alone where no joint has a curve
        return
    yield read_table
    if verb not in ("identify", "diagnose"):
        arm = next((word for word in case.words if word == "arm.toml"), None)
    if arm is not None and verb in ("design", "relax"):  # compensate leaves cells empty where there is no command
        yield lambda path: load_plan(path, load_arm(path.parent / arm).joint_types)
    if arm is not None and verb == "simulate":
        yield lambda path: load_measurements(path, load_arm(path.parent / arm))


def _rows(path: Path) -> object:
    import polars

    return polars.read_parquet(path)


def _without_nan(path: Path) -> None:
    if re.search(r"(?i)(^|[,\n])\s*(nan|inf|-inf)\s*([,\n]|$)", path.read_text()):
        raise ValueError("NaN or infinity in a CSV file")


PROMISES = (no_exception, printable, one_line, reason, nothing_left, own_files, json_only, read_again)


def run_here(case: Case, folder: Path, invoke: Callable[[list[str]], Result]) -> Outcome:
    """The call in this process, in a prepared folder."""
    before, there = state(folder.parent), Path.cwd()
    os.chdir(folder)
    try:
        done = invoke(case.words)
    finally:
        os.chdir(there)
    error = done.exception
    failed = error is not None and not isinstance(error, SystemExit | click.exceptions.Exit)
    after = state(folder.parent)
    within = folder.name + os.sep
    written = tuple(sorted(name.removeprefix(within) for name in after if after[name] != before.get(name)))
    text = f"{type(error).__name__}: {error} {place(done.exc_info)}" if failed else ""
    return Outcome(None if failed else done.exit_code, done.stdout, done.stderr, written, text)


def by_runner(words: list[str]) -> Result:
    """With streams that are collected."""
    return CliRunner().invoke(main, words, prog_name="armcal")


def place(info: object) -> str:
    """Where an exception comes from: the last of our own lines."""
    import traceback

    if not isinstance(info, tuple):
        return ""
    frames = [f for f in traceback.extract_tb(info[2]) if "/doe/" in f.filename or "/identification/" in f.filename]
    return f"({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
