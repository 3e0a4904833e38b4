"""The effect library as a catalogue: what each effect is, its parameters, and the data that it needs.

Everything is read off the classes, so that a user's own effects stand in the list as well.
"""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import numpy as np

from identification.effects import effect_named, library
from identification.kinematics.chain import KinematicChain, planar_chain
from identification.kinematics.parameters import Parameter

# what the arm or the data must have -> how to give it
SUPPLY = {
    "gravity": "[gravity] in the arm file: acceleration_m_s2, link_masses_kg, center_of_mass, payload_kg, ..",
    "distance": '[instrument] with kind = "distance" in the arm file, and the column distance_mm in the measurements',
    "time": "the column order or time_s in the measurements; without it rows count as measured in their order",
    "past": "the column order or time_s in the measurements; without it rows count as measured in their order",
    "directions": "columns direction1, direction2 .. (+1 or -1) in the measurements; left out: from order without gaps",
    "temperature": "the column temperature_C in the measurements",
    "session": "the column session in the measurements, or one file for each session",
    "commands": "columns commanded1_deg, commanded2_deg .. in the measurements, beside the angles that were read",
}
GRAVITY = """\
[gravity]
acceleration_m_s2 = [0.0, -9.81]  # in space: [0.0, 0.0, -9.81]
link_masses_kg = [10.0, 8.0, 5.0]  # one for each link
center_of_mass = [0.5, 0.5, 0.5]  # from the joint, in link lengths
payload_kg = 0.0  # at the tip"""  # block of an arm file, for three links


class Entry(NamedTuple):
    """An effect of the library, as `armcal effects` lists it."""

    name: str
    summary: str  # one line
    formula: str  # in words
    place: str  # `each joint`, `one joint or all`, `each joint from 2`, `the whole arm`
    arms: tuple[str, ...]  # `planar`, `spatial` or both
    needs: tuple[str, ...]  # as `Effect.needs`, sorted
    settings: dict[str, str]  # name -> range allowed in an arm file
    kind: str  # `looked for` by diagnose, `scatter`, `alias`, `table`, `sessions`, `commands`, `on request` of a file
    alias: str | None  # as `Effect.alias`
    parameters: tuple[Parameter, ...]  # for an arm of three joints
    supply: tuple[str, ...]  # how to give what it needs, one sentence each

    @property
    def example(self) -> str:
        """Example entry of an arm file, with parameters to be estimated."""
        if self.kind == "table":
            return "written by `armcal diagnose --out`"
        lines = ["[[effects]]", f'name = "{self.name}"']
        lines += ["joint = 2"] if self.place.startswith("each joint") else []
        lines += [f"{name} = ...  # {allowed}" for name, allowed in self.settings.items()]
        return "\n".join([*lines, *(["", GRAVITY] if "gravity" in self.needs else [])])

    def to_json(self) -> dict[str, Any]:
        """An entry of `effects` (identification/files/README.md, "JSON keys")."""
        parameters = [
            {"key": p.toml_key, "unit": p.file_unit, "typical": None if p.typical is None else p.typical * p.to_file}
            for p in self.parameters
        ]
        return self._asdict() | {"parameters": parameters}


def entries() -> list[Entry]:
    """All registered effects, the user's own included."""
    return [entry(name) for name in library()]


def entry(name: str) -> Entry:
    """The effect with this name. Raises `InputError` for an unknown name."""
    cls = effect_named(name)
    chosen = {key: int(value.low) if value.whole else value.low for key, value in cls.settings.items()}
    joint = max(cls.first_joint, 1) if cls.per_joint == "required" else None
    chain = planar_chain(np.ones(3))  # one parameter per joint is listed as the first
    if chain.dimension not in cls.dimensions:
        chain = KinematicChain(chain.joints, chain.end)
    each = "each joint" if cls.first_joint <= 1 else f"each joint from {cls.first_joint}"
    kinds = {"table": cls.tabulated, "scatter": cls.scatter, "alias": cls.alias is not None}
    kinds |= {"sessions": "session" in cls.needs, "on request": cls.nuisance, "commands": cls.of_commands}
    wanted = (*sorted(cls.needs), *(["commands"] if cls.of_commands else []))
    return Entry(
        name=name,
        summary=cls.summary,
        formula=" ".join((inspect.getdoc(cls) or cls.summary).split("\n\n")[0].split()),
        place={"none": "the whole arm", "required": each}.get(cls.per_joint, "one joint or all"),
        arms=tuple(word for dimension, word in ((2, "planar"), (3, "spatial")) if dimension in cls.dimensions),
        needs=tuple(sorted(cls.needs)),
        settings={key: value.allowed for key, value in cls.settings.items()},
        kind=next((kind for kind, is_this in kinds.items() if is_this), "looked for"),
        alias=cls.alias,
        parameters=cls(chain, joint, chosen).parameters,
        supply=tuple(dict.fromkeys(SUPPLY.get(need, need) for need in wanted)),
    )
