"""The catalogue, an effect of one's own in it, and the typical sizes of missing effects."""

from __future__ import annotations

import inspect
import re
import tomllib

import numpy as np
import pytest

from identification.arm import EffectSpec
from identification.effects import Effect, Parameter, Setting, build, formulas, library
from identification.effects.catalogue import SUPPLY, entries, entry
from identification.kinematics.chain import KinematicChain, planar_chain
from identification.kinematics.parameters import ParameterSet, chain_parameters


def test_every_effect_can_be_read_from_the_example_once_its_settings_are_given() -> None:
    for found in entries():
        if found.kind == "table":
            continue
        filled = re.sub(r"= \.\.\.  # a (whole )?number ([-\d.]+) to .*", r"= \2", found.example)
        example = tomllib.loads(filled)
        assert ("gravity" in example) is ("gravity" in found.needs)
        (table,) = example["effects"]
        values = {key: value for key, value in table.items() if key not in ("name", "joint")}
        spec = EffectSpec(table["name"], table.get("joint"), values)
        chain = planar_chain(np.ones(3))
        assert (
            build(spec, KinematicChain(chain.joints, chain.end) if found.arms == ("spatial",) else chain).name
            == found.name
        )


def test_what_is_needed_says_how_to_give_it() -> None:
    for found in entries():
        assert set(found.needs) <= set(SUPPLY), found.name
    assert entry("thermal_growth").supply == ("the column temperature_C in the measurements",)
    assert entry("servo_error").supply == (SUPPLY["commands"],)
    assert entry("joint_hysteresis").kind == "looked for"
    assert entry("measurement_scale").alias is not None


SHIPPED = {name: cls for name, cls in library().items() if cls.__module__.startswith("identification.effects")}
SOURCE = inspect.getsource(formulas)
OWN = {name: cls for name, cls in SHIPPED.items() if not cls.tabulated}  # a table has no parameters


def example(cls: type[Effect]) -> Effect:
    """The effect at joint 2 of an arm with two links where it needs a joint, with its smallest settings."""
    settings = {name: Setting.of(allowed).low for name, allowed in cls.settings.items()}
    spec = EffectSpec(cls.name, 2 if cls.per_joint == "required" else None, settings)
    chain = planar_chain([300.0, 200.0])
    return build(spec, chain if 2 in cls.dimensions else KinematicChain(chain.joints, chain.end))


@pytest.mark.parametrize("name", OWN)
def test_every_effect_has_typical_sizes_and_a_reason(name: str) -> None:
    declaration = re.search(rf'\n\w+\((  # .*)?\n    "{name}",\n(.*\n)*?\)\n', SOURCE)
    assert declaration is not None
    assert "# typical: " in declaration.group()
    for parameter in example(OWN[name]).parameters:
        assert parameter.typical is not None
        assert 0.0 < parameter.typical < np.inf


def test_sizes_follow_from_their_reasons() -> None:
    """Within the factor of three that they claim; here within 30 %."""
    sizes = {(name, p.short): p.typical for name, effect in OWN.items() for p in example(effect).parameters}
    arcmin = np.radians(1.0 / 60.0)
    tube = np.pi / 64.0 * (0.09**4 - 0.078**4) * 70e9  # [N m^2] aluminium
    reasons = {
        ("joint_compliance", "c1"): 1.0 / 1e5,
        ("encoder_eccentricity", "a"): 0.02 / 40.0,
        ("encoder_second_harmonic", "a"): 0.008 / 40.0,
        ("transmission_ripple", "a"): arcmin / 2.0 / np.sqrt(2.0),
        ("gear_ratio", "e"): 0.0075 / 75.0,
        ("backlash", "b"): arcmin / 2.0,
        ("gravity_backlash", "b"): arcmin / 2.0,
        ("link_bending", "flexibility"): 1.0 / tube,
        ("base_rotation_drift", "w"): sizes["base_drift", "vx"] / 1000.0,
        ("base_rotation", "angle"): sizes["base_offset", "x0"] / 1000.0,
        ("joint_noise", "std"): 0.05 / 1000.0,
    }
    np.testing.assert_allclose([sizes[key] for key in reasons], list(reasons.values()), rtol=0.3)


def test_not_known_is_infinite() -> None:
    known = Parameter("own.a", "1", typical=0.5)
    assert ParameterSet([*chain_parameters([100.0]), known]).typical.tolist() == [np.inf, np.inf, 0.5]
