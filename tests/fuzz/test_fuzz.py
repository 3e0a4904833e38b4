"""A few hundred random inputs: files, and commands that take little time. Many more: `python -m tests.fuzz`."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from doe.plan.plan import load_plan
from doe.studies.monte_carlo.specification import load_study
from identification.errors import InputError
from identification.files.arm import dump_arm, load_arm
from identification.files.csv import read_table
from identification.files.measurement import load_targets
from identification.measurements import load_measurements
from tests.fuzz.arms import ArmText, arms
from tests.fuzz.commands import Case, cases
from tests.fuzz.judge import Outcome, broken, by_runner, prepare, run_here
from tests.fuzz.tables import measurements, plans, studies, targets
from tests.fuzz.texts import mostly_valid, spoilt

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
    assert "allowed" in sentence, sentence
    return None


@few(100)
@given(arm=arms(), data=st.data())
def test_arm_files(tmp_path_factory: pytest.TempPathFactory, arm: ArmText, data: st.DataObject) -> None:
    """Read or refused; what is read is written so that it is read again."""
    folder = tmp_path_factory.mktemp("arm")
    prepare(Case([], {"arm.toml": data.draw(mostly_valid(arm.text)), **dict(arm.files)}), folder)
    found = refused_or_read(load_arm, folder / "arm.toml")
    if found is not None:
        text = refused_or_read(dump_arm, found)
        assert text is not None
        (folder / "again.toml").write_text(str(text))
        again = refused_or_read(load_arm, folder / "again.toml")
        assert again is not None
        assert again.links == found.links  # type: ignore[attr-defined]


READERS = {
    "plan": (plans, lambda path, types: load_plan(path, types)),
    "measurements": (measurements, load_measurements),
    "targets": (targets, load_targets),
    "study": (studies, lambda path, _: load_study(path)),
    "table": (measurements, lambda path, _: read_table(path)),
}


@pytest.mark.parametrize("kind", READERS)
@few(40)
@given(data=st.data())
def test_other_files(tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject) -> None:
    strategy, read = READERS[kind]
    folder = tmp_path_factory.mktemp(kind)
    arm = data.draw(arms())
    path = folder / f"{kind}.csv"
    path.write_bytes(data.draw(spoilt(data.draw(strategy(arm)))).encode(errors="replace"))
    refused_or_read(read, path, len(arm.kinds))


@few(30)
@given(case=cases(QUICK))
def test_quick_commands(tmp_path_factory: pytest.TempPathFactory, case: Case) -> None:
    """Each keeps every promise: see `judge`."""
    folder = tmp_path_factory.mktemp("home") / "work"
    folder.mkdir()
    prepare(case, folder)
    outcome = run_here(case, folder, by_runner)
    assert broken(case, outcome, folder) is None, (case.words, outcome)


def test_the_judge_sees_what_is_broken(tmp_path: Path) -> None:
    """Each promise by an outcome that breaks it."""
    case, good = Case(["design"]), "armcal: arm.toml: no such file, allowed: an existing one\n"
    for outcome, found in (
        (Outcome(2, "", good, ()), None),
        (Outcome(None, "", "", (), "ValueError: x"), "traceback"),
        (Outcome(1, "", "Traceback (most recent call last)\nValueError", ()), "traceback"),
        (Outcome(2, "", "armcal: a\x1b: x, allowed: y\n", ()), "control character"),
        (Outcome(2, "", good + good, ()), "2 lines"),
        (Outcome(2, "", "armcal: arm.toml: no such file\n", ()), "allowed"),
        (Outcome(2, "", f"armcal: {'x ' * 5000}\n", ()), "too long"),
        (Outcome(2, "", good, ("out.csv",)), "left behind"),
        (Outcome(0, "", "", ("out.csv.journal",)), "left behind"),
        (Outcome(0, "", "", ("there.csv",)), "overwrote"),
        (Outcome(1, "", "", ()), "without a reason"),
    ):
        what = broken(case, outcome, tmp_path)
        assert what is None if found is None else found in str(what)
    (tmp_path / "out.csv").write_text("a,b\n1,NaN\n")
    assert "NaN" in str(broken(Case(["design", "--out", "out.csv"]), Outcome(0, "", "", ("out.csv",)), tmp_path))
    assert "holds NaN" in str(broken(Case(["score", "--json"]), Outcome(0, '{"a": NaN}', "", ()), tmp_path))
