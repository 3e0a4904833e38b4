"""The catalogue against the table of effects that people read, and an effect of one's own in it."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace

import numpy as np

from identification.arm import EffectSpec
from identification.effects import build, library, register
from identification.effects.base import _LIBRARY
from identification.effects.catalogue import GRAVITY, SUPPLY, entries, entry
from identification.files.arm import arm_from_tables
from identification.kinematics.chain import planar_chain


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
        assert build(spec, replace(chain, axes="xyz") if found.arms == ("spatial",) else chain).name == found.name


def test_the_block_of_gravity_is_read_as_it_stands_and_as_it_says_for_space() -> None:
    assert max(map(len, GRAVITY.splitlines())) <= 79  # else a terminal breaks what is to be pasted
    found = arm_from_tables({"links_mm": [3.0, 2.0, 1.0], **tomllib.loads(GRAVITY)}).gravity
    assert found is not None
    assert (found.acceleration.tolist(), found.link_masses.tolist()) == ([0.0, -9.81], [10.0, 8.0, 5.0])
    assert (found.center_of_mass.tolist(), found.payload) == ([0.5] * 3, 0.0)
    (there,) = re.findall(r"in space: (\[.*\])", GRAVITY)
    tables = tomllib.loads(GRAVITY.replace("[0.0, -9.81]", there, 1))
    row = {"a_mm": 1.0, "alpha_deg": 0.0, "d_mm": 0.0}
    in_space = arm_from_tables({"kind": "spatial", "dh": [row] * 3, **tables}).gravity
    assert in_space is not None
    assert in_space.acceleration.tolist() == [0.0, 0.0, -9.81]


def test_what_is_needed_says_how_to_give_it() -> None:
    for found in entries():
        assert set(found.needs) <= set(SUPPLY), found.name
    assert entry("thermal_growth").supply == ("the column temperature_C in the measurements",)
    assert entry("servo_error").supply == (SUPPLY["commands"],)
    assert entry("joint_hysteresis").kind == "looked for"
    assert entry("measurement_scale").alias is not None


def test_a_users_own_effect_is_in_the_list() -> None:
    own = type(
        "Own",
        (library()["backlash"],),
        {"name": "own_play", "summary": "my own play", "__module__": "mine", "__doc__": "Mine."},
    )
    register(own)
    try:
        found = entry("own_play")
        assert (found.own, found.formula, found.place) == (True, "Mine.", "each joint")
    finally:
        del _LIBRARY["own_play"]
    assert "own_play" not in library()
