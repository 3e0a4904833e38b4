"""The catalogue, an effect of one's own in it, and the typical sizes of missing effects."""

from __future__ import annotations

import inspect
import re
import tomllib

import numpy as np
import pytest

from identification import EffectSpec
from identification.effects import Effect, build, formulas, library
from identification.effects.catalogue import SUPPLY, entry
from identification.effects.catalogue import example as example_of
from identification.kinematics.chain import KinematicChain, planar_chain


def test_every_effect_can_be_read_from_the_example_once_its_settings_are_given() -> None:
    for found in map(entry, library()):
        if found["kind"] == "table":
            continue
        filled = re.sub(r"= \.\.\.  # a (whole )?number ([-\d.]+) to .*", r"= \2", example_of(found))
        example = tomllib.loads(filled)
        assert ("gravity" in example) is ("gravity" in found["needs"])
        (table,) = example["effects"]
        values = {key: value for key, value in table.items() if key not in ("name", "joint")}
        spec = EffectSpec(table["name"], table.get("joint"), values)
        chain = planar_chain(np.ones(3))
        chain = KinematicChain(chain.joints, chain.end) if found["arms"] == ["spatial"] else chain
        assert build(spec, chain).name == found["name"]


def test_what_is_needed_says_how_to_give_it() -> None:
    for found in map(entry, library()):
        assert {*found["needs"]} <= {*SUPPLY}, found["name"]
    assert entry("thermal_growth")["supply"] == ["the column temperature_C in the measurements"]
    assert entry("servo_error")["supply"] == [SUPPLY["commands"]]
    assert entry("joint_hysteresis")["kind"] == "looked for"
    assert entry("measurement_scale")["alias"] is not None


SHIPPED = {name: cls for name, cls in library().items() if cls.__module__.startswith("identification.effects")}
SOURCE = inspect.getsource(formulas)
OWN = {name: cls for name, cls in SHIPPED.items() if not cls.tabulated}  # a table has no parameters


def example(cls: type[Effect]) -> Effect:
    """The effect at joint 2 of an arm with two links where it needs a joint, with its smallest settings."""
    settings = {name: allowed.low for name, allowed in cls.settings.items()}
    spec = EffectSpec(cls.name, 2 if cls.per_joint == "required" else None, settings)
    chain = planar_chain([300.0, 200.0])
    return build(spec, chain if 2 in cls.dimensions else KinematicChain(chain.joints, chain.end))


@pytest.mark.parametrize("name", [name for name in OWN if not OWN[name].unlisted])
def test_every_effect_has_typical_sizes_and_a_reason(name: str) -> None:
    declaration = re.search(rf'\n\w+\((  # .*)?\n    "{name}",\n(.*\n)*?\)\n', SOURCE)
    assert declaration is not None
    assert "# typical: " in declaration.group()
    for parameter in example(OWN[name]).parameters:
        assert parameter.typical is not None
        assert 0.0 < parameter.typical < np.inf
