"""Effects of installed packages: found by their entry point; a broken one is one line that names it."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import EntryPoint
from unittest.mock import patch

import pytest

from identification import Arm, EffectSpec, InputError, effects
from identification.effects import base, library

pytestmark = pytest.mark.filterwarnings("ignore:armcal.effects of installed packages")
SOURCE = '''
from identification.effects import Effect

class Bump(Effect):
    """A bump."""
    name = "my_bump"
    summary = "bump"

    def define(self):
        return (self.parameter("h", "rad", scale=1.0),)
'''


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    effects.library.cache_clear()
    with patch.dict(base._LIBRARY):
        yield
    effects.library.cache_clear()


def install(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    point = EntryPoint("my_bump", value, "armcal.effects")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == "armcal.effects" else [])


def test_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "bump_package_for_test.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    install(monkeypatch, "bump_package_for_test:Bump")
    assert library()["my_bump"].__name__ == "Bump"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("no_such_package_at_all:Bump", "No module named"),
        ("math:Bump", "no attribute 'Bump'"),
        ("math:sqrt", "allowed: a class under Effect"),
        ("pathlib:Path", "allowed: a class under Effect"),
    ],
)
def test_a_broken_one_is_named(monkeypatch: pytest.MonkeyPatch, value: str, expected: str) -> None:
    install(monkeypatch, value)
    with pytest.raises(InputError, match=f"my_bump = {value}.*{expected}"):
        library()


def test_a_name_of_the_library_cannot_be_taken(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "thief_package_for_test.py").write_text(SOURCE.replace('"my_bump"', '"backlash"'))
    monkeypatch.syspath_prepend(str(tmp_path))
    install(monkeypatch, "thief_package_for_test:Bump")
    with pytest.raises(InputError, match="'backlash' is taken by the library"):
        library()


def test_an_own_effect_may_be_defined_again() -> None:
    one = type("Mine", (base.Effect,), {"name": "mine", "__module__": "notebook"})
    other = type("Mine", (base.Effect,), {"name": "mine", "__module__": "notebook"})
    base.register(one)
    base.register(other)
    assert base._LIBRARY["mine"] is other


def test_an_effect_that_adds_nothing_anywhere_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    bent = type("Bent", (base.Effect,), {"name": "bent", "__module__": "notebook", "deflections": lambda *_: 1.0})
    monkeypatch.setitem(base._LIBRARY, "bent", bent)
    with pytest.raises(InputError, match=r"bent adds nothing, allowed: a method named .* joint_shifts"):
        effects.build(EffectSpec("bent"), Arm([100.0, 100.0]).chain)
