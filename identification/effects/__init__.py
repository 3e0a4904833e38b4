# ruff: noqa: F401 - the names of this package
"""The effect library: every physical effect is one class (identification/README.md, "Effects").

A user's own effect is a subclass of `Effect` under the decorator `register`, or is found through the entry-point group
`armcal.effects` of an installed package. What the catalogue says of an effect is read off its class, so that a user's
own effects stand in it as well.
"""

import inspect
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import repeat
from types import MappingProxyType
from typing import Any

import numpy as np

from identification.arm import EffectSpec
from identification.effects import formulas, unlisted  # they fill the library
from identification.effects.base import _LIBRARY, ArmState, Effect, Scope, Setting, register, widths
from identification.errors import InputError, close_names, nearest, require, suggestion
from identification.kinematics.chain import KinematicChain, planar_chain
from identification.kinematics.parameters import PRISMATIC, Parameter
from identification.running import additions

# what the arm or the data must have -> how to give it
SUPPLY = {
    "gravity": "[gravity] in the arm file: acceleration_m_s2, link_masses_kg, center_of_mass, payload_kg, ..",
    "distance": '[instrument] with kind = "distance" in the arm file, and the column distance_mm in the measurements',
    "time": "the column order or time_s in the measurements; without it rows count as measured in their order",
    "past": "the column order or time_s in the measurements; without it rows count as measured in their order",
    "directions": "columns direction1, direction2 .. (+1 or -1) in the measurements; if absent: from gapless order",
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


@cache
def library() -> Mapping[str, type[Effect]]:
    """Name -> class of every registered effect, those of installed packages and the user's own included."""
    for _, where, effect in additions("armcal.effects"):
        require(isinstance(effect, type) and issubclass(effect, Effect), f"{where}, allowed: a class under Effect")
        register(effect)
    return MappingProxyType(_LIBRARY)


def effect_named(name: str) -> type[Effect]:
    """The class of an effect. Raises `InputError` for a name that the library has not; it has too many to say them."""
    if name not in library():
        meant = suggestion(close_names(name, library()))
        raise InputError(f"effects: unknown name {name!r}, {meant}armcal effects lists them")
    return library()[name]


def of_dimension(dimension: int) -> Mapping[str, type[Effect]]:
    """Name -> class of the effects defined for arms of this dimension, 2 or 3."""
    return {name: cls for name, cls in library().items() if dimension in cls.dimensions}


def build_all(specs: Sequence[EffectSpec], chain: KinematicChain) -> tuple[Effect, ...]:
    """Build the effects of an arm; where two have the same name and joint, their keys include the settings. Raises
    `InputError` as `build` does, and for two effects with the same name, joint and settings."""
    alike = Counter(spec.key for spec in specs)
    effects = tuple(map(build, specs, repeat(chain), [alike[spec.key] > 1 for spec in specs]))
    for key, times in Counter(effect.key for effect in effects).items():
        require(times == 1, f"effects: {key} is given {times} times, allowed: once")
    return effects


def build(spec: EffectSpec, chain: KinematicChain, tagged: bool = False) -> Effect:
    """Build the effect of one `[[effects]]` entry of an arm file;  tagged : the key includes the settings

    Raises `InputError` for an unknown name, an effect without a method of any place, a joint that is missing, not
    allowed or out of range, an unknown parameter, and an effect not defined for arms of this dimension.
    """
    cls, joint = effect_named(spec.name), spec.joint
    if chain.dimension not in cls.dimensions:
        others = {2: "spatial", 3: "planar"}[chain.dimension]
        raise InputError(
            f"effects: {spec.name} is of {others} arms, {nearest(spec.name, of_dimension(chain.dimension))}"
        )
    if not (cls.scatter or cls.of_commands or any(hasattr(cls, place) for place in widths(chain))):
        raise InputError(f"effects: {spec.name} adds nothing, allowed: a method named {' or '.join(widths(chain))}")
    allowed, whole = f"allowed: {cls.first_joint} to {len(chain)}", f"{spec.name} is of the whole arm, joint = {joint}"
    require(joint is not None or cls.per_joint != "required", f"effects: {spec.name} needs a joint, {allowed}")
    require(joint is None or cls.per_joint != "none", f"effects: {whole} is not allowed")
    if joint is not None:
        require(cls.first_joint <= joint <= len(chain), f"effects: {spec.name} at joint {joint}, {allowed}")
        fits, turn = not cls.of_angle or chain.joint_types[joint - 1] != PRISMATIC, "allowed: at joints that turn"
        require(fits, f"effects: {spec.name} at joint {joint}, which slides, {turn}")
    chosen: dict[str, int | float] = {}
    for name, setting in cls.settings.items():
        value = spec.values.get(name)
        if value is None or not setting.allows(value):
            fault = "is missing" if value is None else f"= {value:g}"
            raise InputError(f"effects: {spec.key}: {name} {fault}, allowed: {setting.allowed}")
        chosen[name] = int(value) if setting.whole else float(value)
    effect = cls(chain, joint, chosen, tagged)
    if cls.tabulated != (spec.curve is not None):
        fault = "has no table of values" if cls.tabulated else "has a table of values"
        raise InputError(f"effects: {spec.key} {fault}, allowed: one for joint_error_curve, none for others")
    effect.curve, effect.fixed = spec.curve, spec.values
    names = {p.short for p in effect.parameters} | set(cls.settings)
    InputError.check_names(f"effects: {spec.key} has no parameter", spec.values, names)
    return effect


# -- the catalogue -----------------------------------------------------------------------------------------------------
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
