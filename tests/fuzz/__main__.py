"""`python -m tests.fuzz`: many random inputs, each in a process of its own, and a table of what became of them.

A case follows from its number alone, and its row is kept: the command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import multiprocessing
import os
import pkgutil
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

from hypothesis.errors import StopTest
from hypothesis.internal.conjecture.data import ConjectureData

import doe
import identification
from tests.fuzz.commands import Case, cases
from tests.fuzz.judge import broken, prepare, run_here

LIMIT = 60.0  # [s]
MEMORY = 6 * 2**30  # bytes of addresses that a case may use
KINDS = RESULT, FAILED, BAD_INPUT, HELP, CUT, BROKEN = (
    *("result", "job failed", "bad input", "help", "stopped at 60 s", "promise broken"),
)


def work(case: Case, home: Path, told: Connection) -> None:
    """Runs a case in this process, and tells the kind of its outcome, a broken promise, and the last words."""
    os.setpgid(0, 0)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        outcome = run_here(case, home / "work")
        promise = broken(case, outcome, home / "work")
        kind = HELP if outcome.out.startswith("Usage: ") else KINDS[outcome.code or 0]
        last = (outcome.err.strip().splitlines() or [""])[-1][:300]
        told.send((kind if promise is None else BROKEN, promise or "", last))
    except BaseException as error:  # noqa: BLE001 - what a child says is all there is
        told.send((BROKEN, f"{type(error).__name__}: {error}", ""))
    os._exit(0)


def outcome_of(case: Case, home: Path) -> tuple[str, str, str]:
    """What a process of its own tells, or that it was stopped, or died."""
    shutil.rmtree(home, ignore_errors=True)
    (home / "work").mkdir(parents=True)
    prepare(case, home / "work")
    context = multiprocessing.get_context("fork")
    reading, writing = context.Pipe(duplex=False)
    child = context.Process(target=work, args=(case, home, writing))
    child.start()
    writing.close()
    try:
        return reading.recv() if reading.poll(LIMIT) else (CUT, "", "")
    except EOFError:
        return BROKEN, "died without an outcome", ""
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(int(child.pid or 0), signal.SIGKILL)
        child.join()


def fuzz(out: Path, first: int, number: int) -> None:
    """Those of the cases first, first + 1, .. that are not done, one row each in OUT/rows.jsonl."""
    for name in ("matplotlib.backends.backend_pdf", "matplotlib.backends.backend_svg", "rich.markdown"):
        importlib.import_module(name)
    for package in (doe, identification):  # once here: a case begins in a fork of this process
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    rows = out / "rows.jsonl"
    done = {json.loads(line)[0] for line in rows.read_text().splitlines()} if rows.exists() else set()
    with tempfile.TemporaryDirectory() as home, rows.open("a") as file:
        for seed in sorted({*range(first, first + number)} - done):
            try:
                case = ConjectureData(random=random.Random(str(seed))).draw(cases())
            except StopTest:  # too large
                continue
            began = time.monotonic()
            kind, promise, words = outcome_of(case, Path(home) / "home")
            file.write(json.dumps([seed, case.verb, kind, promise, round(time.monotonic() - began, 2), words]) + "\n")
            file.flush()
            if kind in (BROKEN, CUT):  # to look at: its command, its files
                kept = {"words": case.words, "files": case.files, "what": [kind, promise]}
                (out / f"case-{seed}.json").write_text(json.dumps(kept))


def table(out: Path) -> str:
    """Outcomes per verb, in Markdown."""
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]
    lines = [f"| verb | inputs | {' | '.join(KINDS)} |", "|---" * (len(KINDS) + 2) + "|"]
    for verb in [*sorted({row[1] for row in rows}), "**all**"]:
        counts = Counter(row[2] for row in rows if verb in (row[1], "**all**"))
        lines.append(f"| {verb} | {counts.total():,} | {' | '.join(f'{counts[kind]:,}' for kind in KINDS)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--number", type=int, default=50_000, help="inputs in all")
    parser.add_argument("--first", type=int, default=0, help="number of the first: other numbers, other inputs")
    parser.add_argument("--out", type=Path, default=Path("fuzz-results"), help="folder of finished rows")
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    fuzz(options.out, options.first, options.number)
    sys.stdout.write(table(options.out) + "\n")
