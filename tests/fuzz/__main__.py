"""`python -m tests.fuzz`: many random inputs, each in a process of its own, and a table of what became of them.

A block of cases follows from its number alone; finished blocks are kept, so the command goes on where it was stopped,
and several may work in one folder.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import json
import os
import pkgutil
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from click.testing import CliRunner, Result
from hypothesis.errors import StopTest
from hypothesis.internal.conjecture.data import ConjectureData

import doe
import identification
from doe.cli import main as verbs
from tests.fuzz.commands import Case, cases
from tests.fuzz.judge import BAD_INPUT, FAILED, HELP, RESULT, broken, kind, prepare, run_here

SIZE = 100  # cases of a block
STREAMS = ("stdout", "stderr")
WORD, LIMIT = 12.0, 60.0  # [s] without a word, and in all
MEMORY = 6 * 2**30  # bytes of addresses that a case may use
CUT, SILENT, BROKEN = "stopped at 60 s", "silent for 10 s", "promise broken"
KINDS = (RESULT, BAD_INPUT, FAILED, HELP, CUT, SILENT, BROKEN)


def block_of(number: int, size: int, text: str = "") -> Iterator[Case]:
    """The cases of a block: drawn one by one, as hypothesis would mutate the ones before; only those of which a file
    holds the text, out of as many more."""
    for position in range(size):
        seeds = (f"{number}:{position}:{again}" for again in itertools.count()) if text else (f"{number}:{position}",)
        found = (case for seed in seeds if (case := drawn(seed)) is not None)
        yield from itertools.islice((case for case in found if holds(case, text)), 1)


def drawn(seed: str) -> Case | None:
    """The case of a seed; None: too large."""
    try:
        return ConjectureData(random=random.Random(seed)).draw(cases())
    except StopTest:
        return None


def holds(case: Case, text: str) -> bool:
    """Whether one of its files does; every case holds an empty text."""
    return not text or any(text in content for content in case.files.values())


def outcome_of(case: Case, home: Path) -> tuple[str, str, str]:
    """Kind and, where a promise is broken, which."""
    shutil.rmtree(home, ignore_errors=True)
    folder = home / "work"
    folder.mkdir(parents=True)
    prepare(case, folder)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _child(case, folder, writing)
    os.close(writing)
    try:
        return _wait(case, child, reading, home)
    finally:
        os.close(reading)


def _child(case: Case, folder: Path, writing: int) -> None:
    """Runs a case, tells the outcome, and ends the process."""
    os.setpgid(0, 0)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    found = (BROKEN, "no outcome", "")
    try:
        outcome = run_here(case, folder, partial(by_files, *(folder.parent.parent / name for name in STREAMS)))
        promise = broken(case, outcome, folder)
        words = (outcome.err.strip().splitlines() or [""])[-1][:300]
        found = (kind(case, outcome), "", words) if promise is None else (BROKEN, promise, words)
    except BaseException as error:  # noqa: BLE001 - what a child says is all there is
        found = (BROKEN, f"{type(error).__name__}: {error}", "")
    finally:
        os.write(writing, json.dumps(found).encode()[:60_000])
        os._exit(0)


def by_files(out: Path, err: Path, words: list[str]) -> Result:
    """A call whose streams are files, so that what it says is seen while it works."""
    for stream, path in ((1, out), (2, err)):
        file = os.open(path, os.O_CREAT | os.O_TRUNC | os.O_RDWR)
        os.dup2(file, stream)
    error: BaseException | None = None
    try:
        verbs.main(words, prog_name="armcal")
    except BaseException as raised:  # noqa: BLE001 - a traceback is an outcome
        error = raised
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    code = error.code if isinstance(error, SystemExit) and isinstance(error.code, int) else 0 if error is None else 1
    info = None if error is None else (type(error), error, error.__traceback__)
    return Result(CliRunner(), out.read_bytes(), err.read_bytes(), b"", None, code, error, info)  # type: ignore[arg-type]


def _wait(case: Case, child: int, reading: int, home: Path) -> tuple[str, str, str]:
    """What the child tells, or that it was silent too long, or stopped, or died."""
    spoken = home.parent / STREAMS[1]
    try:
        for limit in (WORD, LIMIT - WORD):
            if select.select([reading], [], [], limit)[0]:
                told = b""
                while part := os.read(reading, 65_536):
                    told += part
                return tuple(json.loads(told)) if told else (BROKEN, "died without an outcome", "")  # type: ignore[return-value]
            if limit == WORD and "--quiet" not in case.words and not (spoken.exists() and spoken.stat().st_size):
                return SILENT, "", ""
        return CUT, "", spoken.read_text(errors="replace")[-300:]
    finally:
        for group in (lambda: os.killpg(child, signal.SIGKILL), lambda: os.waitpid(child, 0)):
            try:
                group()
            except (ProcessLookupError, ChildProcessError, PermissionError):
                continue


def import_all() -> None:
    """Once here: a case begins in a fork of this process."""
    for name in ("matplotlib.backends.backend_pdf", "matplotlib.backends.backend_svg", "rich.markdown"):
        importlib.import_module(name)
    for package in (doe, identification):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)


def work(out: Path, first: int, blocks: int, size: int, text: str = "") -> None:
    """The blocks that nobody has done or is doing."""
    import_all()
    for number in range(first, first + blocks):
        file, mine = out / f"{number:06}.json", out / f"{number:06}.lock"
        if file.exists():
            continue
        try:
            os.close(os.open(mine, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            continue
        rows = []
        for position, case in enumerate(block_of(number, size, text)):
            home = Path(tempfile.gettempdir()) / f"armcal-fuzz-{os.getpid()}" / "home"
            started = time.monotonic()
            what, promise, said = outcome_of(case, home)
            rows.append([case.verb, what, promise, round(time.monotonic() - started, 2), said])
            if what in (BROKEN, CUT, SILENT):
                keep(out / "found" / f"{number:06}-{position}", case, what, promise, home)
        file.write_text(json.dumps(rows))
        mine.unlink()


def keep(place: Path, case: Case, what: str, promise: str, home: Path) -> None:
    """A case that broke a promise, to look at: its command, its files."""
    place.mkdir(parents=True, exist_ok=True)
    (place / "case.json").write_text(json.dumps({"words": case.words, "files": case.files, "what": [what, promise]}))


def table(out: Path) -> str:
    """Outcomes per verb, in Markdown."""
    counts: dict[str, Counter[str]] = {}
    for file in sorted(out.glob("*.json")):
        for verb, what, *_ in json.loads(file.read_text()):
            counts.setdefault(verb, Counter())[what] += 1
    lines = [f"| verb | inputs | {' | '.join(KINDS)} |", "|---" * (len(KINDS) + 2) + "|"]
    total: Counter[str] = sum(counts.values(), Counter())
    for verb, found in [*sorted(counts.items()), ("**all**", total)]:
        lines.append(f"| {verb} | {found.total():,} | {' | '.join(f'{found[k]:,}' for k in KINDS)} |")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--number", type=int, default=50_000, help="inputs in all")
    parser.add_argument("--first", type=int, default=0, help="block to begin with: other blocks, other inputs")
    parser.add_argument("--out", type=Path, default=Path("fuzz-results"), help="folder of finished blocks")
    parser.add_argument("--holding", default="", metavar="TEXT", help="only inputs of which a file holds this text")
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    work(options.out, options.first, -(-options.number // SIZE), SIZE, options.holding)
    sys.stdout.write(table(options.out) + "\n")


if __name__ == "__main__":
    main()
