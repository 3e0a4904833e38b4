"""A few hundred random inputs: files, and commands that take little time. Many more: `python -m tests.fuzz`."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from doe.studies.monte_carlo import Study
from identification import Arm, InputError, Plan, load_arm, load_measurements
from identification.files.csv import read_table
from identification.files.measurement import Targets
from tests.fuzz.commands import Case, cases
from tests.fuzz.inputs import ArmText, arms, measurements, mostly_valid, plans, spoilt, studies, targets
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


@few(100)
@given(arm=arms(), data=st.data())
def test_arm_files(tmp_path_factory: pytest.TempPathFactory, arm: ArmText, data: st.DataObject) -> None:
    """Read or refused."""
    folder = tmp_path_factory.mktemp("arm")
    prepare(Case([], {"arm.toml": data.draw(mostly_valid(arm.text)), "robot.urdf": arm.urdf}), folder)
    refused_or_read(load_arm, folder / "arm.toml")


READERS = {
    "plan": (plans, lambda path, types: Plan.load(path, types)),
    "measurements": (measurements, load_measurements),
    "targets": (targets, lambda path, links: Targets.load(path, Arm(np.ones(links)))),
    "study": (studies, lambda path, _: Study.load(path)),
    "table": (measurements, lambda path, _: read_table(path)),
}


@pytest.mark.parametrize("kind", READERS)
@few(40)
@given(data=st.data())
def test_other_files(tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject) -> None:
    strategy, read = READERS[kind]
    arm, path = data.draw(arms()), tmp_path_factory.mktemp(kind) / f"{kind}.csv"
    path.write_bytes(data.draw(spoilt(data.draw(strategy(arm)))).encode(errors="replace"))
    refused_or_read(read, path, len(arm.kinds))


@few(15)
@given(case=cases(QUICK))
def test_quick_commands(tmp_path_factory: pytest.TempPathFactory, case: Case) -> None:
    """Each keeps every promise: see `judge`."""
    folder = tmp_path_factory.mktemp("home") / "work"
    folder.mkdir()
    prepare(case, folder)
    outcome = run_here(case, folder)
    assert broken(case, outcome, folder) is None, (case.words, outcome)


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
