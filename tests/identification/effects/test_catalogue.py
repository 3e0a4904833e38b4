"""The library as a whole: its catalogue, typical sizes, columns of every effect; effects of one's own and of installed
packages, found by their entry point; a broken one is one line that names it."""

import inspect
import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from identification import Arm, EffectSpec, InputError, Measurements, Model, effects, estimate
from identification.effects import SUPPLY, Effect, base, build, entry, example, formulas, library
from identification.gap.blocks import hypotheses
from identification.kinematics.chain import KinematicChain, planar_chain

PLANE = planar_chain([300.0, 200.0, 150.0])
CHAINS = {2: PLANE, 3: KinematicChain(PLANE.joints, PLANE.end)}
SHIPPED = {name: cls for name, cls in library().items() if cls.__module__.startswith("identification.effects")}


@pytest.mark.parametrize("name", SHIPPED)
def test_every_effect_stands_in_the_catalogue_and_can_be_read_from_its_example(name: str) -> None:
    """Once its settings are given; what it needs says how to give it; every typical size has a reason beside it."""
    row, cls = entry(name), SHIPPED[name]
    assert {*row["needs"]} <= {*SUPPLY}
    assert ("each joint" in row["place"]) == (cls.per_joint == "required")
    assert row["place"].endswith(f"from {cls.first_joint}") == (cls.first_joint > 1)
    chain = CHAINS[max(cls.dimensions) if row["arms"] == ["spatial"] else 2]
    if row["kind"] != "table":
        table = tomllib.loads(re.sub(r"= \.\.\.  # a (whole )?number ([-\d.]+) to .*", r"= \2", example(row)))
        assert ("gravity" in table) is ("gravity" in row["needs"])
        (given,) = table["effects"]
        values = {key: value for key, value in given.items() if key not in ("name", "joint")}
        effect = build(EffectSpec(given["name"], given.get("joint"), values), chain)
        assert effect.name == name
        declaration = re.search(rf'\n\w+\((  # .*)?\n    "{name}",\n(.*\n)*?\)\n', inspect.getsource(formulas))
        assert declaration is not None
        assert "# typical: " in declaration.group()
        assert all(0.0 < (parameter.typical or 0.0) < np.inf for parameter in effect.parameters)


@pytest.mark.parametrize(
    ("name", "joint", "message"),
    [
        ("backlash", None, "backlash needs a joint, allowed: 1 to 3"),
        ("joint_coupling", 1, "joint_coupling at joint 1, allowed: 2 to 3"),
        ("backlash", 4, "backlash at joint 4, allowed: 1 to 3"),
        ("base_drift", 2, "base_drift is of the whole arm, joint = 2 is not allowed"),
        ("axis_runout", 2, "axis_runout is of spatial arms"),
        ("baklash", 2, "unknown name 'baklash', did you mean 'backlash'"),
    ],
)
def test_what_an_arm_cannot_have(name: str, joint: int | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        build(EffectSpec(name, joint), PLANE)


def test_kinds_and_supplies() -> None:
    assert entry("thermal_growth")["supply"] == ["the column temperature_C in the measurements"]
    assert entry("servo_error")["supply"] == [SUPPLY["commands"]]
    kinds = {
        name: entry(name)["kind"] for name in ("joint_hysteresis", "outliers", "session_base", "joint_error_curve")
    }
    assert list(kinds.values()) == ["looked for", "scatter", "sessions", "table"]
    assert entry("measurement_scale")["alias"] is not None


# -- one's own, and those of installed packages ------------------------------------------------------------------------
SOURCE = '''
from identification.effects import Effect

class Bump(Effect):
    """A bump."""
    name = "my_bump"
    summary = "bump"

    def define(self):
        return (self.parameter("h", "rad", scale=1.0),)
'''
installed = pytest.mark.filterwarnings("ignore:armcal.effects of installed packages")


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """A folder of packages; the library is as before afterwards."""
    monkeypatch.syspath_prepend(str(tmp_path))
    effects.library.cache_clear()
    with patch.dict(base._LIBRARY):
        yield tmp_path
    effects.library.cache_clear()


def install(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    point = EntryPoint("my_bump", value, "armcal.effects")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == "armcal.effects" else [])


@installed
def test_effects_by_their_entry_point(monkeypatch: pytest.MonkeyPatch, packages: Path) -> None:
    """A name of the library cannot be taken."""
    (packages / "bump_package_for_test.py").write_text(SOURCE)
    install(monkeypatch, "bump_package_for_test:Bump")
    assert library()["my_bump"].__name__ == "Bump"
    effects.library.cache_clear()
    (packages / "thief_package_for_test.py").write_text(SOURCE.replace('"my_bump"', '"backlash"'))
    install(monkeypatch, "thief_package_for_test:Bump")
    with pytest.raises(InputError, match="'backlash' is taken by the library"):
        library()


@installed
@pytest.mark.usefixtures("packages")
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


@pytest.mark.usefixtures("packages")
def test_an_own_effect_may_be_defined_again_but_must_add_something() -> None:
    one, other = (type("Mine", (Effect,), {"name": "mine", "__module__": "notebook", "bends": 1.0}) for _ in range(2))
    base.register(one)
    base.register(other)
    assert base._LIBRARY["mine"] is other
    with pytest.raises(InputError, match=r"mine adds nothing, allowed: a method named .* joint_shifts"):
        build(EffectSpec("mine"), Arm([100.0, 100.0]).chain)


# -- several of one name at one joint ----------------------------------------------------------------------------------
RIPPLE = "transmission_ripple"
LENGTHS = [300.0, 200.0, 100.0]


def ripple(joint: int, k: int, **values: float) -> EffectSpec:
    return EffectSpec(RIPPLE, joint, {"k": float(k), **values})


ARM = Arm(LENGTHS, effects=(ripple(1, 20), ripple(2, 18), ripple(1, 29)))
PLACES = (f"{RIPPLE}:1[k=20]", f"{RIPPLE}:2", f"{RIPPLE}:1[k=29]")  # the setting is said only where it must be


def test_names_say_the_setting_only_where_they_must_and_all_are_estimated() -> None:
    assert Model(ARM).names[6:] == tuple(f"{place}.{short}" for place in PLACES for short in "ab")
    assert [p.short for p in Model(ARM).parameters[6:]] == ["a", "b"] * 3
    alone = Model(ARM.with_effects(ripple(1, 20), EffectSpec("encoder_eccentricity", 1)))
    assert alone.names[6:8] == (f"{RIPPLE}:1.a", f"{RIPPLE}:1.b")
    with pytest.raises(InputError, match=r"transmission_ripple:1\[k=20\] is given 2 times, allowed: once"):
        _ = Model(ARM.with_effects(ripple(1, 20), ripple(1, 20))).effects
    values = {(1, 20): (1e-3, 2e-3), (2, 18): (-2e-3, 0.0), (1, 29): (0.0, 3e-3)}
    truth = ARM.with_effects(*(ripple(j, k, a=a, b=b) for (j, k), (a, b) in values.items()))
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (40, 3))
    fitted = estimate(Model(ARM), Measurements(q, Model(truth).position(q)))
    np.testing.assert_allclose(fitted.parameters[6:], np.ravel([*values.values()]), atol=1e-10)
    fixed = Model(ARM.with_effects(ripple(1, 20, a=1e-3), ripple(1, 29)))
    assert dict(fixed.fixed) == {f"{PLACES[0]}.a": 1e-3}
    assert fixed.names[6:] == (f"{PLACES[0]}.b", f"{PLACES[2]}.a", f"{PLACES[2]}.b")


def test_only_the_same_setting_is_not_tried_again() -> None:
    effects = [block.effect for block in hypotheses(ARM, frozenset()).members]
    tried = {(effect.joint, effect.chosen["k"]) for effect in effects if effect.name == RIPPLE}
    assert tried == {(j, float(k)) for j in (1, 2, 3) for k in range(3, 65)} - {(1, 20.0), (1, 29.0), (2, 18.0)}
    alone = hypotheses(Arm(LENGTHS, effects=(EffectSpec("base_offset"),)), frozenset())
    assert alone.skipped["base_offset"] == "already in the arm's model"
