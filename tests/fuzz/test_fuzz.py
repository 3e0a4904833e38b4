"""A few hundred random inputs: files, and commands that take little time; every verb: `pytest -m slow tests/fuzz`, as
many inputs as the profile says, and with `--hypothesis-show-statistics` a table of what became of them."""

import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from doe.studies.monte_carlo import Study
from identification import Arm, InputError, Plan, load_arm, load_measurements
from identification.files.csv import read_table
from identification.files.measurement import load_targets
from tests.fuzz.commands import Case, cases
from tests.fuzz.inputs import ARMS, arms, campaigns, mostly_valid, spoilt, studies, tables
from tests.fuzz.judge import Outcome, broken, prepare, run_here

QUICK = frozenset({"check", "compensate", "effects", "help", "identify", "init", "simulate", "validate"})


def few(number: int) -> settings:
    """So many examples, however long each takes."""
    return settings(max_examples=number, deadline=None, suppress_health_check=list(HealthCheck))


def refused_or_read(read: Callable[..., object], *arguments: object) -> object | None:
    """What is read; None where it is refused in a sentence that says what is allowed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read(*arguments)
        except InputError as error:
            sentence = str(error)
    assert "allowed" in sentence
    return None


READERS = {
    "arm.toml": lambda path, types: load_arm(path),
    "plan.csv": Plan.load,
    "data.csv": load_measurements,
    "targets.csv": lambda path, links: load_targets(path, Arm(np.ones(links))),
    "study.toml": lambda path, _: Study.load(path),
    "table.csv": lambda path, _: read_table(path),
}


@pytest.mark.parametrize("name", READERS)
@few(40)
@given(data=st.data())
def test_files(tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject) -> None:
    """Each is read or refused."""
    kind, folder = data.draw(st.sampled_from(list(ARMS))), tmp_path_factory.mktemp("files")
    if name.endswith("csv"):
        text = data.draw(tables(campaigns()[kind]["plan.csv" if name == "plan.csv" else "data.csv"]))
    else:
        text = data.draw(arms(kind) if name == "arm.toml" else studies(kind == "spatial"))
    text = data.draw(mostly_valid(text) if name == "arm.toml" else spoilt(text))
    prepare(Case([], {"robot.urdf": campaigns()[kind]["robot.urdf"], name: text}), folder)
    refused_or_read(READERS[name], folder / name, 3 if kind in ("limited", "sliding", "urdf") else 2)


def keeps_every_promise(case: Case, folder: Path) -> None:
    """See `judge`."""
    folder.mkdir()
    prepare(case, folder)
    with cut_after(60):
        outcome = run_here(case, folder)
    event(f"{case.verb}: {'help' if outcome.out.startswith('Usage: ') else f'exit code {outcome.code}'}")
    assert broken(case, outcome, folder) is None, (case.words, outcome)


@contextmanager
def cut_after(seconds: int) -> Iterator[None]:
    """Ends what takes longer as Ctrl-C does."""
    before = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@few(15)
@given(case=cases(QUICK))
def test_quick_commands(tmp_path_factory: pytest.TempPathFactory, case: Case) -> None:
    keeps_every_promise(case, tmp_path_factory.mktemp("home") / "work")


@pytest.mark.slow
@few(settings.default.max_examples)  # type: ignore[union-attr]
@given(case=cases())
def test_commands(tmp_path_factory: pytest.TempPathFactory, case: Case) -> None:
    keeps_every_promise(case, tmp_path_factory.mktemp("home") / "work")


GOOD = "armcal: arm.toml: no such file, allowed: an existing one\n"


@pytest.mark.parametrize(
    ("outcome", "promise"),
    [
        (Outcome(2, "", GOOD, ()), "None"),
        (Outcome(None, "", "", (), "ValueError: x"), "traceback"),
        (Outcome(1, "", "Traceback (most recent call last)\nValueError", ()), "traceback"),
        (Outcome(2, "", "armcal: a\x1b: x, allowed: y\n", ()), "control character"),
        (Outcome(2, "", GOOD + GOOD, ()), "2 lines"),
        (Outcome(2, "", "armcal: arm.toml: no such file\n", ()), "allowed"),
        (Outcome(2, "", f"armcal: {'x ' * 5000}\n", ()), "too long"),
        (Outcome(2, "", GOOD, ("out.csv",)), "left behind"),
        (Outcome(0, "", "", ("there.csv",)), "overwrote"),
        (Outcome(1, "", "", ()), "without a reason"),
        (Outcome(0, "{}", "", ("out.csv",)), "NaN"),
        (Outcome(0, '{"a": NaN}', "", ()), "holds NaN"),
    ],
)
def test_the_judge_sees_what_is_broken(tmp_path: Path, outcome: Outcome, promise: str) -> None:
    (tmp_path / "out.csv").write_text("a,b\n1,NaN\n")
    assert promise in str(broken(Case(["design", "--json", "--out", "out.csv"]), outcome, tmp_path))
