"""The first files of a calibration: an arm file with comments, the columns of the measurements, the steps."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from identification.arm import MAX_LINKS
from identification.errors import InputError, printable
from identification.files.io import PathLike
from identification.files.measurement import UNITS
from identification.files.schema import json_schema, validated_arm
from identification.files.urdf import Urdf, read_urdf
from identification.instruments import KINDS, TRACKER
from identification.kinematics.chain import KinematicChain
from identification.kinematics.parameters import REVOLUTE

ARM, DATA, SCHEMA, STEPS = "arm.toml", "measurements.csv", "arm.schema.json", "README.md"
ENDS = ("tool0", "tcp", "tool", "flange")  # names of tips, the likeliest first


def planar_files(links: str) -> dict[str, str]:
    """Of a planar arm: file name -> text.

    links : how many, a whole number, `3`, or their lengths [mm], `612,572.3,115.7`; one length has a point, `612.0`

    Raises `InputError` for anything else, and where the reader of arm files refuses the lengths, in its words.
    """
    whole = links.strip().isascii() and links.strip().isdigit()
    example = whole and links.strip().lstrip("0") in map(str, range(1, MAX_LINKS + 1))
    try:
        lengths = [] if whole else [float(word) for word in links.split(",")]
    except ValueError:
        lengths = []
    if example:
        lengths = [float(round(600.0 * 0.8**j)) for j in range(int(links))]
    elif lengths:
        validated_arm({"links_mm": lengths}, "--links: ")
    else:
        allowed = f"allowed: how many, 1 to {MAX_LINKS}, or lengths [mm], one with a point, 13.0, or 612,572.3,115.7"
        raise InputError(f"--links: found {links!r}, {allowed}")
    values = {"name": "arm", "title": f"a planar arm of {len(lengths)} links", "lengths": lengths, "example": example}
    return _files(values, [REVOLUTE] * len(lengths), ("x_mm", "y_mm"), spatial=False)


def dh_files(joints: int, instrument: str = "") -> dict[str, str]:
    """Of a spatial arm from a Denavit-Hartenberg table that is to be filled in: file name -> text.

    instrument : of `KINDS`, "": positions are measured
    """
    values = {"name": "arm", "title": f"an arm of {joints} joints", "example": True, "kind": instrument}
    return _files(values, [REVOLUTE] * joints, _columns(instrument))


def urdf_files(path: PathLike, base: str | None = None, tip: str | None = None, instrument: str = "") -> dict[str, str]:
    """Of a spatial arm from a URDF file: file name -> text, a copy of the URDF file among them.

    base, tip : links; left out: the root, and an end with the name of a tool, or else the one with the most joints
    instrument : of `KINDS`, "": positions are measured

    Raises `InputError` for a file or links that do not work.
    """
    urdf, file = read_urdf(path), Path(path).name
    base = base or urdf.root
    chains = _chains(urdf, base, tip)
    tip = min(chains, key=lambda end: (ENDS.index(end) if end in ENDS else len(ENDS), -len(chains[end])))
    chain, masses = chains[tip], urdf.masses(base, tip)
    if file in (ARM, DATA, SCHEMA, STEPS):
        raise InputError(f"{path}: the name {file} is needed for another file, allowed: another name")
    limits = np.degrees([[j.lower, j.upper] for j in chain.joints if j.type == REVOLUTE]).round(4).reshape(-1, 2)
    others = [end for end, other in chains.items() if end != tip and len(other) == len(chain)]
    values = {
        "name": urdf.robot.get("name") or "arm",
        "title": html.escape(printable(" ".join((urdf.robot.get("name") or "the arm").split())), quote=False),
        "kind": instrument,
        "urdf": file,
        "base": base,
        "tip": tip,
        "others": printable(", ".join(others)),
        "lower": limits[:, 0].tolist(),
        "upper": limits[:, 1].tolist(),
        "massed": any(masses),
    }
    values |= {"masses": [float(f"{mass:.12g}") for mass in masses]} if any(masses) else {}
    return _files(values, [joint.type for joint in chain.joints], _columns(instrument)) | {file: urdf.text}


def _chains(urdf: Urdf, base: str, tip: str | None) -> dict[str, KinematicChain]:
    """End -> chain; of the ends that are possible where none is asked for. Raises `InputError` without any."""
    if tip is not None:
        return {tip: urdf.chain(base, tip)}
    chains, reason = {}, None
    for end in urdf.ends:
        try:
            if len(chain := urdf.chain(base, end)) <= MAX_LINKS:
                chains[end] = chain
        except InputError as error:  # of a gripper, say; another end may do
            reason = reason or error
    if not chains:
        links = "allowed: --base-link, --tip-link"
        raise reason or InputError(f"{urdf.path}: no chain of 1 to {MAX_LINKS} joints, {links}")
    return chains


def _columns(kind: str) -> tuple[str, ...]:
    """Of a measurement file, those that an instrument in space needs: its readings, or what is touched."""
    instrument = KINDS[kind]() if kind else TRACKER
    readings = (f"{name}_{next(iter(UNITS[quantity]))}" for name, quantity, _ in instrument.coordinates)
    return tuple(readings) or (instrument.target,)


def _files(
    values: dict[str, Any], types: Sequence[str], measured: Sequence[str], *, spatial: bool = True
) -> dict[str, str]:
    """The files of an arm with joints of these types, filled in."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    n, kind = len(types), values.get("kind", "")
    columns = ["order", *(f"q{j}_{'deg' if t == REVOLUTE else 'mm'}" for j, t in enumerate(types, start=1)), *measured]
    usual: dict[str, Any] = {
        "example": False,
        "urdf": None,
        "massed": False,
        "lower": [-170.0] * n,
        "upper": [170.0] * n,
    }
    instrument = KINDS[kind]() if kind else TRACKER
    rows = 3 if instrument.dimension == 1 else 1
    usual |= {"runs": rows * max(5 * n, 20), "fresh": rows * 12, "masses": [10.0] * n, "contact": instrument.contact}
    usual |= {"guide": instrument.guide if kind else None, "measured": measured, "target": instrument.target}
    values = {**usual, "kind": kind, "columns": columns, "joints": n, "spatial": spatial, **values}
    loader = PackageLoader("identification.files", "first_files")
    environment = Environment(loader=loader, trim_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined)

    def toml(value: str | list[float]) -> str:
        """As TOML, which accepts the numbers and escapes of JSON and has one more; read back to the last digit."""
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")

    environment.filters |= {"toml": toml, "printable": printable}
    arm = f"arm_{'spatial' if spatial else 'planar'}.toml.j2"
    schema = json_schema("spatial" if spatial else "planar")
    return {
        ARM: environment.get_template(arm).render(values),
        DATA: ",".join(columns) + "\n",
        SCHEMA: json.dumps(schema, indent=1) + "\n",
        STEPS: environment.get_template("steps.j2").render(values),
    }
