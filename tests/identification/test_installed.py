"""Code of installed packages: named before it runs, refused in one line where it fails."""

from __future__ import annotations

import warnings
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from identification.errors import InputError
from identification.installed import additions


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, source: str) -> None:
    (folder / "addition_for_test.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(__import__("sys").modules, "addition_for_test", raising=False)
    point = EntryPoint("mine", "addition_for_test:thing", "armcal.effects")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point])


def test_named_before_its_code_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The warning of what runs comes before the one that the code itself gives."""
    install(monkeypatch, tmp_path, "import warnings\nwarnings.warn('running')\nthing = 7\n")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert [(name, found) for name, _, found in additions("armcal.effects")] == [("mine", 7)]
    first = "armcal.effects of installed packages, whose code runs now: mine (of no package)"
    assert [str(one.message) for one in said] == [first, "running"]


@pytest.mark.parametrize("source", ["raise RuntimeError('a\\nb')", "1 / 0", "def", "", "import none_such_at_all"])
@pytest.mark.filterwarnings("ignore:armcal.effects of installed packages")
def test_one_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, source: str) -> None:
    install(monkeypatch, tmp_path, source)
    with pytest.raises(
        InputError, match=r"^entry point armcal.effects: mine = addition_for_test:thing: .*, allowed: ."
    ):
        list(additions("armcal.effects"))
