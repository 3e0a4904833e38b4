"""The effect library as a catalogue: what each effect is, its parameters, and the data that it needs.

Everything is read off the classes, so that a user's own effects stand in the list as well.
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from identification.effects import effect_named
from identification.kinematics.chain import KinematicChain, planar_chain

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


def entry(name: str) -> dict[str, Any]:
    """What `armcal effects` says of an effect (identification/files/README.md, "JSON keys"): `place` is `each joint`,
    `one joint or all`, `each joint from 2` or `the whole arm`; `kind` is `looked for` by diagnose, `scatter`, `alias`,
    `table`, `sessions`, `commands` or `on request` of a file; `parameters` are of an arm of three joints; `supply` says
    how to give what it needs. Raises `InputError` for an unknown name."""
    cls = effect_named(name)
    chosen = {key: int(value.low) if value.whole else value.low for key, value in cls.settings.items()}
    joint = max(cls.first_joint, 1) if cls.per_joint == "required" else None
    chain = planar_chain(np.ones(3))  # one parameter per joint is listed as the first
    if chain.dimension not in cls.dimensions:
        chain = KinematicChain(chain.joints, chain.end)
    each = "each joint" if cls.first_joint <= 1 else f"each joint from {cls.first_joint}"
    kinds = {"table": cls.tabulated or cls.unlisted, "scatter": cls.scatter, "alias": cls.alias is not None}
    kinds |= {"sessions": "session" in cls.needs, "on request": cls.nuisance, "commands": cls.of_commands}
    wanted = (*sorted(cls.needs), *(["commands"] if cls.of_commands else []))
    return {
        "name": name,
        "summary": cls.summary,
        "formula": " ".join((inspect.getdoc(cls) or cls.summary).split("\n\n")[0].split()),
        "place": {"none": "the whole arm", "required": each}.get(cls.per_joint, "one joint or all"),
        "arms": [word for dimension, word in ((2, "planar"), (3, "spatial")) if dimension in cls.dimensions],
        "needs": sorted(cls.needs),
        "settings": {key: value.allowed for key, value in cls.settings.items()},
        "kind": next((kind for kind, is_this in kinds.items() if is_this), "looked for"),
        "alias": cls.alias,
        "parameters": [
            {"key": p.toml_key, "unit": p.file_unit, "typical": None if p.typical is None else p.typical * p.to_file}
            for p in cls(chain, joint, chosen).parameters
        ],
        "supply": list(dict.fromkeys(SUPPLY.get(need, need) for need in wanted)),
    }


def example(entry: dict[str, Any]) -> str:
    """An entry of an arm file, with parameters to be estimated."""
    if entry["kind"] == "table":
        return "written by `armcal diagnose --out`"
    lines = ["[[effects]]", f'name = "{entry["name"]}"']
    lines += ["joint = 2"] if entry["place"].startswith("each joint") else []
    lines += [f"{name} = ...  # {allowed}" for name, allowed in entry["settings"].items()]
    return "\n".join([*lines, *(["", GRAVITY] if "gravity" in entry["needs"] else [])])
