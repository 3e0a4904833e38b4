"""URDF files: the chain of joints from a base to a tip link, and a corrected chain written back.

Read and written by the standard library; declarations of a document type or of entities are refused. URDF speaks metres
and radians (http://wiki.ros.org/urdf/XML/joint).
"""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from identification.arrays import Array
from identification.errors import InputError, printable, require
from identification.files.io import PathLike, read_text
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import from_roll_pitch_yaw, pose, roll_pitch_yaw
from identification.kinematics.parameters import PRISMATIC, REVOLUTE

METER = 1000.0  # [mm]
MOVING = {"revolute": REVOLUTE, "continuous": REVOLUTE, "prismatic": PRISMATIC}
FIXED = "fixed"
MIMIC = "allowed: joints of their own, stages of a telescope that move together as one prismatic joint"
BASE_LINK, TIP = "base_link", "tip"  # of files written here


class UrdfJoint(NamedTuple):
    """A `<joint>` and what it connects."""

    name: str
    type: str
    parent: str
    child: str
    element: ElementTree.Element


@dataclass(frozen=True)
class Urdf:
    """A file that was read: its joints by the name of the link that they carry."""

    path: str
    text: str
    robot: ElementTree.Element = field(compare=False)
    links: Mapping[str, ElementTree.Element] = field(compare=False)
    by_child: Mapping[str, UrdfJoint] = field(compare=False)

    @property
    def root(self) -> str:
        """The link that is no joint's child; the first of several."""
        return next((link for link in self.links if link not in self.by_child), next(iter(self.links)))

    @property
    def ends(self) -> tuple[str, ...]:
        """The links that carry no joint, in the order of the file."""
        parents = {joint.parent for joint in self.by_child.values()}
        return tuple(link for link in self.links if link not in parents)

    # -- chains ----------------------------------------------------------------------------------------------------
    def joints(self, base: str, tip: str) -> list[UrdfJoint]:
        """Those from a base link to a tip link. Raises `InputError` where there is no such way."""
        ends = (end for joint in self.by_child.values() for end in (joint.parent, joint.child))
        InputError.check_names(f"{self.path}: there is no link", (base, tip, *ends), self.links)
        joints, link = list[UrdfJoint](), tip
        while link != base:
            if link not in self.by_child or len(joints) > len(self.by_child):
                raise InputError(f"{self.path}: link {tip!r} is not below {base!r}, allowed: a tip below the base")
            joints.append(self.by_child[link])
            link = joints[-1].parent
        return joints[::-1]

    def chain(self, base: str, tip: str, limited: Collection[str] = ()) -> KinematicChain:
        """The chain of moving joints; fixed joints between them belong to the next one's origin;  limited : types of
        joints whose limits are given elsewhere, and may be missing here"""
        joints, before = list[Joint](), np.eye(4)
        for joint in self.joints(base, tip):
            before = before @ self.origin(joint.element)
            if joint.type == FIXED:
                continue
            name, kind, limit = joint.name, joint.type, joint.element.find("limit")
            axis = self.numbers(joint.element.find("axis"), f"joint {name!r}: axis", "xyz", (1.0, 0.0, 0.0))
            bounded = limit is not None and None not in (limit.get("lower"), limit.get("upper"))
            free = kind == "continuous" or MOVING.get(kind) in limited
            without = f"or a chain without it: tip link {joint.parent!r}, or base link {joint.child!r}"
            of_type = f"is of type {kind!r}, allowed: {', '.join(MOVING)} and {FIXED}"
            for wrong, sentence in (
                (kind not in MOVING, f" of the chain {of_type}, {without}"),
                (joint.element.find("mimic") is not None, f" of the chain mimics another, {MIMIC}, {without}"),
                (not np.any(axis), ": axis 0 0 0, allowed: a direction"),
                (not free and not bounded, f": limit, lower or upper is missing, allowed: both for a {kind} joint"),
            ):
                require(not wrong, f"{self.path}: joint {name!r}{sentence}")
            lower, upper = -np.pi, np.pi
            if not free:
                ends = (self.numbers(limit, f"joint {name!r}: limit", end, None, 1) for end in ("lower", "upper"))
                lower, upper = np.concatenate([*ends]) * (METER if kind == "prismatic" else 1.0)
                limits = f"limits {lower:g} to {upper:g}, allowed: lower < upper"
                require(lower < upper, f"{self.path}: joint {name!r}: {limits}")
            joints.append(Joint(name, before, axis, MOVING[kind], float(lower), float(upper)))
            before = np.eye(4)
        require(joints, f"{self.path}: no joint moves between {base!r} and {tip!r}, allowed: at least one")
        return KinematicChain(tuple(joints), before)

    def with_origins(self, base: str, tip: str, origins: Sequence[Array]) -> str:
        """The file's text with the moving joints at other origins, by the angles nearest to its own; comments stay;
        origins : (4, 4) [mm] pose of each joint's frame in that of the moving joint before, as in `KinematicChain`"""
        above = re.match(r"(\s*(<\?.*?\?>|<!--.*?-->))*\s*", self.text, re.DOTALL)
        parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
        robot = ElementTree.fromstring(self.text.lstrip(), parser)
        elements = {element.get("name"): element for element in robot.findall("joint")}
        remaining, fixed = list(origins), np.eye(4)
        for joint in self.joints(base, tip):
            if joint.type == FIXED:
                fixed = fixed @ self.origin(joint.element)
                continue
            element = elements[joint.name]
            origin = element.find("origin")
            place = _origin(np.linalg.inv(fixed) @ remaining.pop(0), self.angles(element))
            (ElementTree.SubElement(element, "origin") if origin is None else origin).attrib.update(place)
            fixed = np.eye(4)
        return (above[0] if above else "") + ElementTree.tostring(robot, encoding="unicode") + "\n"

    # -- links -----------------------------------------------------------------------------------------------------
    def links_on(self, base: str, tip: str) -> dict[str, tuple[int, Array, bool]]:
        """Link -> number of the joint of a chain that it moves with, 0: none; its pose (4, 4) [mm] in the frame of that
        joint after it moved, of joint 0 in that of the base; whether a joint that is not of the chain lies between,
        which then stands at zero."""
        places, number, before = {base: (0, np.eye(4), False)}, 0, np.eye(4)
        for joint in self.joints(base, tip):
            before = before @ self.origin(joint.element)
            if joint.type != FIXED:
                number, before = number + 1, np.eye(4)
            places[joint.child] = number, before, False
        for link in (reached := list(places)):  # which grows: down to the ends, and up from the base to the root
            number, place, aside = places[link]
            for joint in self.by_child.values():
                for near, far in ((joint.parent, joint.child), (joint.child, joint.parent)):
                    if near == link and far not in places:
                        down = self.origin(joint.element)
                        step = down if far == joint.child else np.linalg.inv(down)
                        places[far] = number, place @ step, aside or joint.type != FIXED
                        reached.append(far)
        return places

    def masses(self, base: str, tip: str) -> tuple[Array, Array]:
        """(n,) [kg] of all links that move with a joint of a chain and not with the next, zero where the file gives
        none; (n, 3) [mm] their center of mass in the frame of that joint, of one without a place half the way on."""
        steps = np.array([step[:3, 3] for step in self.chain(base, tip).link_poses[1:]])
        masses, moments = np.zeros(len(steps)), np.zeros(steps.shape)
        for name, (number, place, _) in self.links_on(base, tip).items():
            inertial = self.links[name].find("inertial")
            if number and inertial is not None and (element := inertial.find("mass")) is not None:
                mass, half = self.numbers(element, "mass", "value", None, 1).item(), 0.5 * steps[number - 1]
                center = (place @ self.origin(inertial, f"link {name!r}: inertial"))[:3, 3]
                masses[number - 1] += mass
                moments[number - 1] += mass * (half if inertial.find("origin") is None else center)
        return masses, moments / np.where(masses > 0.0, masses, 1.0)[:, None]

    def neighbours(self) -> frozenset[frozenset[str]]:
        """Pairs of links with bodies that one joint connects, or one that moves and fixed ones, by way of others."""
        solid = {name for name, link in self.links.items() if link.find("collision") is not None}
        pairs = set[frozenset[str]]()
        for link in solid & self.by_child.keys():
            way = [self.by_child[link]]
            while (above := way[-1].parent) in self.by_child.keys() - solid and len(way) < len(self.by_child):
                way.append(self.by_child[above])
            if sum(joint.type != FIXED for joint in way) <= 1 and above in solid - {link}:
                pairs.add(frozenset((link, above)))
        return frozenset(pairs)

    # -- attributes ------------------------------------------------------------------------------------------------
    def origin(self, element: ElementTree.Element, where: str = "") -> Array:
        """(4, 4) [mm] of a joint, or of another element;  where : its name in messages"""
        here = f"{where or 'joint ' + repr(element.get('name')) + ':'} origin"
        place = self.numbers(element.find("origin"), here, "xyz", (0.0, 0.0, 0.0)) * METER
        return pose(place, from_roll_pitch_yaw(*self.angles(element, here)))

    def angles(self, element: ElementTree.Element, where: str = "origin") -> Array:
        """(3,) roll, pitch and yaw [rad] of a joint."""
        return self.numbers(element.find("origin"), where, "rpy", (0.0, 0.0, 0.0))

    def numbers(
        self, element: ElementTree.Element | None, where: str, key: str, usual: Sequence[float] | None, count: int = 3
    ) -> Array:
        """(count,) numbers of an attribute;  usual : where it is left out, None: it may not be"""
        text = None if element is None else element.get(key)
        if text is None and usual is not None:
            return np.array(usual)
        try:
            values = np.array([float(word) for word in (text or "").split()])
        except ValueError:
            values = np.array([np.nan])
        if len(values) != count or not np.all(np.isfinite(values)):
            allowed = f"{count} number{'s' if count > 1 else ''}"
            raise InputError(f"{self.path}: {where} {key} has {text!r}, allowed: {allowed}")
        return values


def read_urdf(path: PathLike, text: str = "") -> Urdf:
    """A URDF file, or its text. Raises `InputError` for a missing file, text that is no XML or has a document type,
    equal names, links with two parents."""
    text = text or read_text(path)
    root = xml_root(text, path, "a URDF file")
    require(root.tag == "robot", f"{path}: the root element is <{root.tag}>, allowed: <robot>")
    macros = [each.tag.rpartition("}")[2] for each in root.iter() if "/xacro}" in each.tag]
    expand = f"allowed: the URDF file that xacro makes of it (ROS: xacro {Path(path).name} > robot.urdf)"
    for macro in macros[:1]:
        raise InputError(f"{path}: found <xacro:{macro}>, {expand}")
    named = {what: [(str(each.get("name")), each) for each in root.findall(what)] for what in ("joint", "link")}
    require(named["link"], f"{path}: there is no <link>, allowed: at least 1")
    by_child = dict[str, UrdfJoint]()
    for name, element in named["joint"]:
        parts = {tag: element.find(tag) for tag in ("parent", "child")}
        ends = {tag: None if part is None else part.get("link") for tag, part in parts.items()}
        for tag in (tag for tag in ("child", "parent") if ends[tag] is None):
            raise InputError(f"{path}: joint {name!r} has no {tag} link, allowed: one")
        joint = UrdfJoint(name, str(element.get("type")), str(ends["parent"]), str(ends["child"]), element)
        require(joint.child not in by_child, f"{path}: link {joint.child!r} has two parent joints, allowed: one")
        by_child[joint.child] = joint
    for what, each in named.items():
        for name, times in Counter(name for name, _ in each).items():
            require(times <= 1, f"{path}: {what} {name!r} is there {times} times, allowed: once")
    return Urdf(str(path), text, root, dict(named["link"]), by_child)


def xml_root(text: str, path: PathLike, what: str) -> ElementTree.Element:
    """The root of XML text. Raises `InputError` for a document type, and what is no XML;  what : the text is allowed to
    be"""
    if declared := re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise InputError(f"{path}: found {declared.group()}, allowed: XML without document types and entities")
    try:
        return ElementTree.fromstring(text.lstrip())  # nothing may be before the declaration of XML
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: not XML: {error}, allowed: {what}") from None


def urdf_text(chain: KinematicChain, name: str) -> str:
    """A URDF file of bare links and joints, `base_link`, `link_1`, .., `tip`, of a chain that comes from none."""
    robot, before = ElementTree.Element("robot", name=printable(name)), BASE_LINK
    ElementTree.SubElement(robot, "link", name=before)
    for j, joint in enumerate([*chain.joints, None], start=1):
        link = TIP if joint is None else f"link_{j}"
        ElementTree.SubElement(robot, "link", name=link)
        kind, called = (FIXED, f"joint_{j}_fixed") if joint is None else (joint.type, printable(joint.name))
        element = ElementTree.SubElement(robot, "joint", name=called, type=kind)
        ElementTree.SubElement(element, "parent", link=before)
        ElementTree.SubElement(element, "child", link=link)
        ElementTree.SubElement(element, "origin", _origin(chain.end if joint is None else joint.origin))
        if joint is not None:
            unit = METER if joint.type == PRISMATIC else 1.0
            ends = {"lower": _numbers(joint.lower / unit), "upper": _numbers(joint.upper / unit)}
            ElementTree.SubElement(element, "axis", xyz=_numbers(*joint.axis))
            ElementTree.SubElement(element, "limit", ends | {"effort": "0", "velocity": "0"})
        before = link
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def _origin(matrix: Array, near: Array | None = None) -> dict[str, str]:
    """Attributes of an `origin` element, by the angles that are nearest to some."""
    return {"xyz": _numbers(*matrix[:3, 3] / METER), "rpy": _numbers(*roll_pitch_yaw(matrix[:3, :3], near))}


def _numbers(*values: float) -> str:
    return " ".join(f"{float(x):.17g}" for x in values)
