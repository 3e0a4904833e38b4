"""The first files of a calibration: an arm file with comments, the columns of the measurements, the steps."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from identification.arm import MAX_LINKS
from identification.errors import InputError, printable
from identification.files.io import PathLike
from identification.files.schema import json_schema, validated_arm
from identification.files.urdf import Urdf, read_urdf
from identification.kinematics.instrument import CONTACTS
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.spatial import SpatialChain

ARM, DATA, SCHEMA, STEPS = "arm.toml", "measurements.csv", "arm.schema.json", "README.md"
INSTRUMENTS = ("distance", *CONTACTS)  # that measure no positions, as `[instrument]` names them
SCATTER = {"": "coordinate of the instrument", "distance": "distance", "sphere": "touch", "plane": "touch"}
COLUMNS = {"": ("x_mm", "y_mm", "z_mm"), "distance": ("distance_mm",), "sphere": ("surface",), "plane": ("surface",)}
CENTER = (700.0, 0.0, 300.0)  # [mm] an example
ENDS = ("tool0", "tcp", "tool", "flange")  # names of tips, the likeliest first
# a, alpha, d of the first joints of an elbow manipulator with a wrist, of round numbers
ELBOW = (
    (0.0, 90.0, 400.0),
    (-600.0, 0.0, 0.0),
    (-500.0, 0.0, 0.0),
    (0.0, 90.0, 150.0),
    (0.0, -90.0, 120.0),
    (0.0, 0.0, 100.0),
)
DEFAULTS = {"urdf": None, "spatial": False, "massed": False, "kind": "", "contact": False}  # of the templates
WRIST = (0.0, 90.0, 200.0)  # of every further joint


def planar_files(links: str) -> dict[str, str]:
    """Of a planar arm: file name -> text.

    links : how many, a whole number, `3`, or their lengths [mm], `612,572.3,115.7`; one length has a point, `612.0`

    Raises `InputError` for anything else, and where the reader of arm files refuses the lengths, in its words.
    """
    lengths, example = _lengths(links)
    n = len(lengths)
    values = {
        "name": _text("arm"),
        "lengths": _numbers(lengths),
        "example": example,
        **_limits([-170.0] * n, [170.0] * n),
        "masses": _numbers([10.0] * n),
        "centers": _numbers([0.5] * n),
    }
    columns = ["order", *(f"q{j}_deg" for j in range(1, n + 1)), "x_mm", "y_mm"]
    about = {
        "title": f"a planar arm of {n} links",
        "joints": n,
        "example": example,
        "runs": max(5 * n, 20),
        "fresh": 12,
    }
    return _files(_filled("arm_planar.toml.j2", values), columns, "planar", about)


def dh_files(joints: int, instrument: str = "") -> dict[str, str]:
    """Of a spatial arm from a Denavit-Hartenberg table that is to be filled in: file name -> text.

    instrument : of `INSTRUMENTS`, "": positions are measured
    """
    rows = [*ELBOW, *[WRIST] * MAX_LINKS][:joints]
    limits = _limits([-170.0] * joints, [170.0] * joints)
    values = {"name": _text("arm"), "rows": rows, **limits, "masses": _numbers([10.0] * joints)}
    about = {"title": f"an arm of {joints} joints", "example": True, "kind": instrument}
    return _spatial(values, ["revolute"] * joints, about)


def urdf_files(path: PathLike, base: str | None = None, tip: str | None = None, instrument: str = "") -> dict[str, str]:
    """Of a spatial arm from a URDF file: file name -> text, a copy of the URDF file among them.

    base, tip : links; left out: the root, and an end with the name of a tool, or else the one with the most joints
    instrument : of `INSTRUMENTS`, "": positions are measured

    Raises `InputError` for a file or links that do not work.
    """
    urdf = read_urdf(path)
    base = base or urdf.root
    chains = _chains(urdf, base, tip)
    tip = min(chains, key=lambda end: (ENDS.index(end) if end in ENDS else len(ENDS), -len(chains[end])))
    chain, file = chains[tip], Path(path).name
    others = [end for end, other in chains.items() if end != tip and len(other) == len(chain)]
    if file in (ARM, DATA, SCHEMA, STEPS):
        raise InputError(f"{path}: the name {file} is needed for another file, allowed: another name")
    masses = urdf.masses(base, tip)
    degrees = [np.degrees([j.lower, j.upper]) for j in chain.joints if j.type == REVOLUTE]
    values = {
        "name": _text(urdf.robot.get("name") or "arm"),
        "urdf": _text(file),
        "base": _text(base),
        "base_name": printable(base),
        "tip": _text(tip),
        "others": printable(", ".join(others)),
        **_limits([low for low, _ in degrees], [high for _, high in degrees]),
        "massed": any(masses),
        "masses": _numbers([float(f"{mass:.12g}") for mass in masses] if any(masses) else [10.0] * len(chain)),
    }
    title = html.escape(printable(" ".join((urdf.robot.get("name") or "the arm").split())), quote=False)
    about = {"title": title, "example": False, "urdf": file, "kind": instrument}
    return _spatial(values, [joint.type for joint in chain.joints], about) | {file: urdf.text}


def _chains(urdf: Urdf, base: str, tip: str | None) -> dict[str, SpatialChain]:
    """End -> chain; of the ends that are possible where none is asked for. Raises `InputError` without any."""
    if tip is not None:
        return {tip: urdf.chain(base, tip)}
    found, reason = {}, None
    for end in urdf.ends:
        try:
            if len(chain := urdf.chain(base, end)) <= MAX_LINKS:
                found[end] = chain
        except InputError as error:  # of a gripper, say; another end may do
            reason = reason or error
    if not found:
        raise reason or InputError(
            f"{urdf.path}: no chain of 1 to {MAX_LINKS} joints, allowed: --base-link, --tip-link"
        )
    return found


def _spatial(values: Mapping[str, Any], types: Sequence[str], about: Mapping[str, Any]) -> dict[str, str]:
    n, kind = len(types), about["kind"]
    joints = [f"q{j}_{'deg' if joint == REVOLUTE else 'mm'}" for j, joint in enumerate(types, start=1)]
    measured = {"kind": kind, "contact": kind in CONTACTS, "point": "measured point" if kind else "reflector"}
    rows = 3 if kind else 1  # of one number each instead of three
    steps = {**about, **measured, "joints": n, "spatial": True, "runs": rows * max(5 * n, 20), "fresh": rows * 12}
    named = {**values, **measured, "scatter": SCATTER[kind], "center": _numbers(CENTER)}
    columns = ["order", *joints, *COLUMNS[kind]]
    return _files(_filled("arm_spatial.toml.j2", named), columns, "spatial", steps)


def _files(arm: str, columns: Sequence[str], arms: str, about: Mapping[str, Any]) -> dict[str, str]:
    schema = json.dumps(json_schema(arms), indent=1) + "\n"
    steps = _filled("steps.j2", {"columns": columns, **about})
    return {ARM: arm, DATA: ",".join(columns) + "\n", SCHEMA: schema, STEPS: steps}


def _lengths(links: str) -> tuple[list[float], bool]:
    """Lengths [mm], and whether they are made up."""
    whole = links.strip().isascii() and links.strip().isdigit()
    if whole and (count := links.strip().lstrip("0")) in map(str, range(1, MAX_LINKS + 1)):
        return [float(round(600.0 * 0.8**j)) for j in range(int(count))], True
    try:
        lengths = [float(word) for word in ([] if whole else links.split(","))]
    except ValueError:
        lengths = []
    if not lengths:
        allowed = f"allowed: how many, 1 to {MAX_LINKS}, or lengths [mm], one with a point, 13.0, or 612,572.3,115.7"
        raise InputError(f"--links: found {links!r}, {allowed}")
    validated_arm({"links_mm": lengths}, "--links: ")
    return lengths, False


def _filled(template: str, values: Mapping[str, Any]) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("doe.report", "first_files")
    environment = Environment(loader=loader, trim_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined)
    return environment.get_template(template).render({**DEFAULTS, **values})


def _limits(lower: Sequence[float], upper: Sequence[float]) -> dict[str, str]:
    """Of angles, converted from radians: to 1e-4 deg."""
    return {key: _numbers([round(float(x), 4) for x in values]) for key, values in (("lower", lower), ("upper", upper))}


def _numbers(values: Sequence[float]) -> str:
    """As they are read back, to the last digit."""
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _text(value: str) -> str:
    """The text as a TOML string: TOML accepts the escapes of JSON and has one more."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
