"""The first files of a calibration: an arm file with comments, the columns of the measurements, the steps."""

import html
import json
import re
import tomllib
import warnings
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from identification.arm import MAX_LINKS
from identification.errors import InputError, printable
from identification.files.bodies import collisions, mesh_file, name_beside
from identification.files.io import PathLike
from identification.files.measurement import column_of, posture_columns
from identification.files.schema import ArmFile, validated_arm
from identification.files.urdf import MOVING, read_urdf
from identification.instruments import KINDS, TRACKER
from identification.kinematics.chain import KinematicChain
from identification.kinematics.parameters import REVOLUTE

ARM, DATA, SCHEMA, STEPS = "arm.toml", "measurements.csv", "arm.schema.json", "README.md"
GUIDES = tomllib.loads((Path(__file__).parent / "instruments.toml").read_text("utf-8"))
ENDS = ("tool0", "tcp", "tool", "flange")  # names of tips, the likeliest first


def planar_files(links: str) -> dict[str, str]:
    """Of a planar arm: file name -> text.

    links : how many, a whole number, `3`, or their lengths [mm], `612,572.3,115.7`; one length has a point, `612.0`

    Raises `InputError` for anything else, and where the reader of arm files refuses the lengths, in its words.
    """
    example = re.fullmatch(r"0*([1-9]\d?)", links.strip(), re.ASCII)
    try:
        lengths = [float(word) for word in links.split(",")]
    except ValueError:
        lengths = []
    if example and int(example[1]) <= MAX_LINKS:
        lengths = [float(round(600.0 * 0.8**j)) for j in range(int(example[1]))]
    elif lengths and ("," in links or not links.strip().isdigit()):
        validated_arm({"links_mm": lengths}, "--links: ")
    else:
        allowed = f"allowed: how many, 1 to {MAX_LINKS}, or lengths [mm], one with a point, 13.0, or 612,572.3,115.7"
        raise InputError(f"--links: found {links!r}, {allowed}")
    title = f"a planar arm of {len(lengths)} link{'s' * (len(lengths) != 1)}"
    return _files([REVOLUTE] * len(lengths), "", spatial=False, title=title, lengths=lengths, example=bool(example))


def dh_files(joints: int, instrument: str = "") -> dict[str, str]:
    """Of a spatial arm from a Denavit-Hartenberg table that is to be filled in: file name -> text;  instrument : of
    `KINDS`, "": positions are measured"""
    return _files([REVOLUTE] * joints, instrument, title=f"an arm of {joints} joint{'s' * (joints != 1)}", example=True)


def urdf_files(path: PathLike, base: str | None = None, tip: str | None = None, instrument: str = "") -> dict[str, str]:
    """Of a spatial arm from a URDF file: file name -> text, a copy of the URDF file among them.

    base, tip : links; left out: the root, and an end with the name of a tool, or else the one with the most joints
    instrument : of `KINDS`, "": positions are measured

    Raises `InputError` for a file or links that do not work.
    """
    urdf, file = read_urdf(path), Path(path).name
    base = base or urdf.root
    # the ends that are possible where none is asked for, and how many joints the others have
    chains, refused = dict[str, KinematicChain](), list[tuple[int, str, InputError]]()
    for end in urdf.ends if tip is None else [tip]:
        moving = 0
        try:
            moving = sum(joint.type in MOVING for joint in urdf.joints(base, end))
            if len(chain := urdf.chain(base, end)) <= MAX_LINKS:
                chains[end] = chain
        except InputError as error:  # of a gripper, say; another end may do
            refused.append((moving, end, error))
    if not chains:
        links = "allowed: --base-link, --tip-link"
        raise refused[0][2] if refused else InputError(f"{path}: no chain of 1 to {MAX_LINKS} joints, {links}")
    tip = min(chains, key=lambda end: (ENDS.index(end) if end in ENDS else len(ENDS), -len(chains[end])))
    most, other, why = max(refused, key=itemgetter(0), default=(0, "", None))
    if tip not in ENDS and most > len(chains[tip]):
        warnings.warn(f"the tip is {tip!r}, not {other!r}, which has more joints: {why}", stacklevel=2)
    chain, (masses, centers), name = chains[tip], urdf.masses(base, tip), urdf.robot.get("name")
    if file in (ARM, DATA, SCHEMA, STEPS):
        raise InputError(f"{path}: the name {file} is needed for another file, allowed: another name")
    limits = np.degrees([[j.lower, j.upper] for j in chain.joints if j.type == REVOLUTE]).round(4).reshape(-1, 2)
    several = limits[:, 1] - limits[:, 0] > 1.01 * 360.0  # turns: a plan needs one, and a move of two seldom is free
    limits[several] = np.add(np.mean(limits[several], axis=1, keepdims=True), [-180.0, 180.0])
    others = [end for end, other in chains.items() if end != tip and len(other) == len(chain)]
    values: dict[str, Any] = {
        "name": name or "arm",
        "title": html.escape(printable(" ".join((name or "the arm").split())), quote=False),
        "urdf": file,
        "base": base,
        "tip": tip,
        "others": printable(", ".join(others)),
        "lower": limits[:, 0].tolist(),
        "upper": limits[:, 1].tolist(),
        "several": bool(several.any()),
    }
    if np.any(masses):
        values |= {"massed": True, "masses": [float(f"{mass:.12g}") for mass in masses.tolist()]}
        values["centers"] = (centers.round(3) + 0.0).tolist()
    return _files([joint.type for joint in chain.joints], instrument, **values) | {file: urdf.text}


def mesh_files(path: PathLike, package_dirs: Sequence[PathLike] = ()) -> tuple[dict[str, Path], list[str]]:
    """Meshes of the bodies of a URDF file, by names under which they are found beside a copy of it; and the names of
    those that are not found;  package_dirs : folders that they may be in"""
    urdf, found, missing = read_urdf(path), dict[str, Path](), list[str]()
    try:
        shapes = [shape for link in urdf.links for shape in collisions(urdf, link)]
    except InputError:  # which is said to those who ask for bodies
        return {}, []
    for name in dict.fromkeys(shape.file for shape in shapes if shape.kind == "mesh"):
        file, beside = mesh_file(name, [Path(path).parent, *package_dirs]), name_beside(name)
        if file is None or beside is None:
            missing.append(name)
        else:
            found[str(Path(beside).with_suffix(file.suffix))] = file
    return found, missing


def _files(types: Sequence[str], kind: str, *, spatial: bool = True, **values: Any) -> dict[str, str]:
    """The files of an arm with joints of these types, measured by this kind of instrument, filled in."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    n, arm_kind, guide = len(types), "spatial" if spatial else "planar", GUIDES.get(kind)
    instrument = KINDS["xyz"][kind].of_table(tomllib.loads(guide["table"])) if guide else TRACKER
    axes = instrument.coordinates[: 3 if spatial else 2]
    # its readings, or what is touched
    measured = tuple(column_of(name, quantity) for name, quantity, _ in axes) or (instrument.target,)
    columns = ["order", *posture_columns(np.zeros((1, n)), types), *measured]
    rows = 3 if instrument.dimension == 1 else 1
    usual: dict[str, Any] = {"name": "arm", "example": False, "urdf": None, "massed": False, "masses": [10.0] * n}
    usual |= {"lower": [-170.0] * n, "upper": [170.0] * n, "runs": rows * max(5 * n, 20), "fresh": rows * 12}
    usual |= {"kind": kind, "contact": instrument.contact, "target": instrument.target, "measured": measured}
    usual |= {"guide": guide, "columns": columns, "joints": n, "spatial": spatial}
    loader = PackageLoader("identification.files", "first_files")
    environment = Environment(loader=loader, trim_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined)

    def toml(value: str | list[float]) -> str:
        """As TOML, which accepts the numbers and escapes of JSON and has one more; read back to the last digit."""
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")

    environment.filters |= {"toml": toml, "printable": printable}
    return {
        ARM: environment.get_template(f"arm_{arm_kind}.toml.j2").render(usual | values),
        DATA: ",".join(columns) + "\n",
        SCHEMA: json.dumps(ArmFile.model_json_schema(), indent=1) + "\n",
        STEPS: environment.get_template("steps.j2").render(usual | values),
    }
