"""Strategies of arm files, planar and spatial, with the positions that their tips have (in plain numpy)."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from tests.fuzz.instruments import instruments
from tests.fuzz.texts import mostly_valid, one_in

Positions = Callable[[np.ndarray], np.ndarray]  # (m, n) [deg, mm] -> (m, d) [mm]

SIZES = st.sampled_from([300.0, 150.0, 80.0, 500.0, 1e-6, 1e-3, 1e6, 1e9])
SIGMAS = st.sampled_from([0.1, 0.05, 1e-9, 1e3, 1e9])
EFFECTS = (
    'name = "encoder_eccentricity"\njoint = 2',
    'name = "encoder_eccentricity"\njoint = 1\na_deg = 0.05\nb_deg = 0.02',
    'name = "gear_ratio"\njoint = 1',
    'name = "backlash"\njoint = 2',
    'name = "thermal_growth"',
    'name = "transmission_ripple"\njoint = 1\nk = 7',
    'name = "outliers"\nshare = 0.1\nsize = 10',
    'name = "joint_noise"\njoint = 1\nstd_deg = 0.01',
    'name = "base_drift"',
    'name = "joint_step"\njoint = 1\nat = 0.5',
    'name = "joint_error_curve"\njoint = 1\nfrom_deg = -20.0\nto_deg = 20.0\nvalues_deg = [0.1, 0.0, 0.1, 0.2]',
    'name = "joint_error_curve"\njoint = 1\nfrom_deg = -90.0\nto_deg = 90.0\nvalues_deg = [0.1, 0.0, 0.1, 0.2]\n'
    'geometry = {"joint_offset:1" = 0.01, "joint_offset:2" = -0.2}',
    'name = "serial_correlation"\nrho = 0.5',
    'name = "joint_hysteresis"\njoint = 2',
)
OF_GRAVITY = ('name = "joint_compliance"', 'name = "tool_mass"', 'name = "gravity_tilt"', 'name = "payload_error"')
OF_PLANAR = ('name = "base_offset"', 'name = "axis_tilt"\njoint = 1', 'name = "axes_skew"')
OF_PAYLOAD = ('name = "payload_place"', 'name = "payload_place"\nx_mm = 50.0\ny_mm = 0.0\nz_mm = -1e9')
OF_LENGTHS = ('name = "length_offset"', 'name = "length_offset"\nc_mm = 1e6')
OF_SPATIAL = ('name = "axis_runout"\njoint = 1', 'name = "bearing_compliance"\njoint = 1')
ODD = (
    'name = "none_such"',
    'name = "session_base"\nsessions = 2',
    'name = "link_bending"',
    *OF_GRAVITY,
    *OF_PAYLOAD,
    *OF_PLANAR,
    *OF_LENGTHS,
)


@dataclass(frozen=True)
class ArmText:
    """A file, its other files, and what is known of the arm.

    kinds : of the joints, "deg" or "mm";  lower, upper : (n,) limits in these units
    """

    text: str
    kinds: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    positions: Positions
    spatial: bool = False
    files: tuple[tuple[str, str], ...] = ()
    masses: bool = False

    @property
    def markers(self) -> bool:
        """Whether several points are measured."""
        return TOOLS in self.text

    @property
    def instrument(self) -> str:
        """Kind of what measures lengths, "": positions are measured."""
        found = re.search(r'\[instrument\]\nkind = "(\w+)"', self.text)
        return found[1] if found and self.spatial else ""


def numbers(values: object) -> str:
    return "[" + ", ".join(repr(float(v)) for v in np.ravel(np.asarray(values))) + "]"


@st.composite
def arms(draw: st.DrawFn) -> ArmText:
    """Of either kind."""
    return draw(spatial_arms() if one_in(draw, 3) else planar_arms())


@st.composite
def planar_arms(draw: st.DrawFn) -> ArmText:
    """One to four links, seldom twelve."""
    n = draw(st.sampled_from([2, 3, 3, 4, 1, 12]))
    usual = draw(st.sampled_from(range(5))) > 0
    links = np.array([draw(SIZES) for _ in range(n)]) if not usual else 300.0 * 0.8 ** np.arange(n)
    lower, upper = draw(limits(n))
    parts = [f"links_mm = {numbers(links)}", _name(draw)]
    parts += _limit_table(draw, lower, upper)
    parts += ([] if one_in(draw, 5) else ["[measurement]\nsigma_mm = 0.1"]) if usual else [_sigma(draw)]
    gravity = draw(st.booleans())
    if gravity:
        parts.append(f"[gravity]\nacceleration_m_s2 = [0.0, -9.81]\nlink_masses_kg = {numbers(np.ones(n))}")
    parts += _constraints(draw, float(links.sum()), 2)
    parts += _effects(draw, OF_PLANAR + (OF_GRAVITY if gravity else ()))
    parts += [draw(instruments())] if one_in(draw, 60) else []
    if not one_in(draw, 4):
        parts.append(f"[calibration]\nlength_errors_mm = {numbers(0.001 * links)}")
        parts.append(f"joint_offsets_deg = {numbers(np.linspace(-0.5, 0.5, n))}")

    def positions(postures: np.ndarray) -> np.ndarray:
        angles = np.cumsum(np.radians(postures), axis=1)
        return np.stack([np.cos(angles) @ links, np.sin(angles) @ links], axis=1)

    return ArmText("\n".join(parts) + "\n", ("deg",) * n, lower, upper, positions, masses=gravity)


@st.composite
def limits(draw: st.DrawFn, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) lower and upper [deg]."""
    width = draw(st.sampled_from([180.0, 100.0, 60.0, 20.0, 1e-6, 5e5]))
    middle = draw(st.sampled_from([0.0, 30.0]))
    return np.full(n, middle - width), np.full(n, middle + width)


def _name(draw: st.DrawFn) -> str:
    name = draw(
        st.sampled_from(["arm", "arm", "a<b>&'c'", "\\u001b[31mred", "[bold]x[/bold]", "{{ 7 * 7 }}", "é" * 300])
    )
    return f'name = "{name}"'


def _limit_table(draw: st.DrawFn, lower: np.ndarray, upper: np.ndarray) -> list[str]:
    if abs(lower[0]) == 180.0 and draw(st.booleans()):
        return []
    return [f"[joint_limits_deg]\nlower = {numbers(lower)}\nupper = {numbers(upper)}"]


def _sigma(draw: st.DrawFn) -> str:
    return f"[measurement]\nsigma_mm = {draw(SIGMAS)!r}"


def _constraints(draw: st.DrawFn, reach: float, dimension: int) -> list[str]:
    """None mostly; one or two with sizes of the arm's, or with absurd ones."""
    found = []
    for _ in range(draw(st.sampled_from([0, 0, 0, 0, 0, 0, 1, 2]))):
        size = reach * draw(st.sampled_from([1.0, 0.5, 0.1, 1e-9]))
        kind = draw(
            st.sampled_from(["box", "round", "sight", "cylinder"] if dimension == 3 else ["box", "round", "sight"])
        )
        point = numbers(np.full(dimension, size / 2))
        if kind == "box":
            sides = "\n".join(f"{axis}_mm = [{-size!r}, {size!r}]" for axis in "xyz"[:dimension])
            found.append(f'[[constraints]]\nkind = "workspace_box"\n{sides}')
        elif kind == "round":
            shape = "keep_out_circle" if dimension == 2 else "keep_out_sphere"
            found.append(f'[[constraints]]\nkind = "{shape}"\ncenter_mm = {point}\nradius_mm = {size / 10!r}')
        elif kind == "cylinder":
            ends = f"start_mm = {point}\nend_mm = {numbers(np.zeros(dimension))}"
            found.append(f'[[constraints]]\nkind = "keep_out_cylinder"\n{ends}\nradius_mm = {size / 20!r}')
        else:
            seen = f"tracker_mm = {numbers(np.full(dimension, 3 * reach))}\ntoward_mm = {numbers(np.zeros(dimension))}"
            found.append(f'[[constraints]]\nkind = "line_of_sight"\nhalf_angle_deg = 30.0\n{seen}')
    return found


def _effects(draw: st.DrawFn, more: tuple[str, ...]) -> list[str]:
    """None mostly; those of every arm and `more`, seldom one that this arm cannot have."""
    number = draw(st.sampled_from([0, 0, 0, 0, 0, 1, 1, 2]))
    return [f"[[effects]]\n{draw(st.sampled_from(ODD if one_in(draw, 12) else EFFECTS + more))}" for _ in range(number)]


# -- in space ----------------------------------------------------------------------------------------------------------
TOOLS = "[tool.1]\nz_mm = 60.0\n[tool.2]\ny_mm = "  # two measured points
LOAD = "\npayload_at_mm = [10.0, 0.0, 80.0]\npayload_kg = 5"
ELBOW = ((0.0, 90.0, 400.0), (-600.0, 0.0, 0.0), (-500.0, 0.0, 0.0), (0.0, 90.0, 150.0), (0.0, -90.0, 120.0))


def turn(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(m, 4, 4) rotations about a direction by angles (m,) [rad], by Rodrigues' formula."""
    x, y, z = axis / (np.linalg.norm(axis) or 1.0)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    found = np.tile(np.eye(4), (len(angles), 1, 1))
    found[:, :3, :3] += np.sin(angles)[:, None, None] * cross + (1 - np.cos(angles))[:, None, None] * cross @ cross
    return found


def moved(place: np.ndarray) -> np.ndarray:
    """(m, 4, 4) translations by (m, 3)."""
    found = np.tile(np.eye(4), (len(place), 1, 1))
    found[:, :3, 3] = place
    return found


@st.composite
def spatial_arms(draw: st.DrawFn) -> ArmText:
    """From Denavit-Hartenberg rows or from a URDF file."""
    return draw(urdf_arms() if one_in(draw, 2) else dh_arms())


def _spatial_tables(draw: st.DrawFn, n: int) -> list[str]:
    """What both have in common: base, tool, machining, noise, constraints, effects, calibration."""
    parts = [_sigma(draw) if draw(st.sampled_from(range(5))) == 0 else "[measurement]\nsigma_mm = 0.1"]
    of_lengths = one_in(draw, 3)
    if one_in(draw, 30 if of_lengths else 2):
        parts[-1] += "\nsigma_deg = " + draw(st.sampled_from(["0.05", "1e-9", "1e9"]))
    parts += [draw(instruments())] if of_lengths else []
    if "center_mm" not in parts[-1] and draw(st.booleans()):
        parts.append("[base]\nx_mm = 1500.0\nrz_deg = " + draw(st.sampled_from(["90.0", "1e6"])))
    tools = ("", "[tool]\nx_mm = 50.0", "[tool]\ny_mm = 50.0", f"{TOOLS}100.0", f"{TOOLS}1e9")
    tool = draw(st.sampled_from(tools))
    parts += [tool] if tool else []
    if draw(st.sampled_from(range(4))) == 0:
        sizes = ["0.1", "0.3", "1.0", "1e-12", "1e300"]
        parts.append("[machining]\ntranslation_mm = " + draw(st.sampled_from(sizes)))
    gravity = draw(st.sampled_from(range(3))) == 0
    if gravity:
        parts.append(f"[gravity]\nacceleration_m_s2 = [0.0, 0.0, -9.81]\nlink_masses_kg = {numbers(np.ones(n))}")
        parts[-1] += draw(
            st.sampled_from(("", "\npayload_kg = 5.0", "\npayload_at_mm = [0, 0, 80]", LOAD, f"{LOAD}e300"))
        )
    parts += _constraints(draw, 1500.0, 3)
    of_gravity = OF_GRAVITY + OF_PAYLOAD if gravity else ()
    parts += _effects(draw, OF_SPATIAL + of_gravity + (OF_LENGTHS if of_lengths else ()))
    if n > 1 and not one_in(draw, 3):
        name = "base.x" if one_in(draw, 12) else f"translation_x:{n}"  # the base may be known
        parts.append('[calibration]\nvalues = {"' + name + '" = 0.5}')
    return parts


@st.composite
def dh_arms(draw: st.DrawFn) -> ArmText:
    """One to five joints of an elbow arm, one of them sliding now and then."""
    n, slide = draw(st.sampled_from([3, 2, 4, 5, 1])), draw(st.sampled_from([-1, -1, -1, 0, 1]))
    lower, upper = draw(limits(n))
    rows = [f"[[dh]]\na_mm = {a}\nalpha_deg = {alpha}\nd_mm = {d}" for a, alpha, d in ELBOW[:n]]
    kinds = tuple("mm" if j == slide else "deg" for j in range(n))
    parts = ['kind = "spatial"', _name(draw)]
    turning = [j for j in range(n) if kinds[j] == "deg"]
    if turning:
        parts.append(f"[joint_limits_deg]\nlower = {numbers(lower[turning])}\nupper = {numbers(upper[turning])}")
    if "mm" in kinds:
        rows[slide] += '\njoint = "prismatic"'
        lower[slide], upper[slide] = 0.0, 400.0
        parts.append("[joint_limits_mm]\nlower = [0.0]\nupper = [400.0]")
    text = "\n".join([*parts, *rows, *_spatial_tables(draw, n)]) + "\n"

    def positions(postures: np.ndarray) -> np.ndarray:
        pose, z, x = np.eye(4), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        for j, (a, alpha, d) in enumerate(ELBOW[:n]):
            angle = np.zeros(len(postures)) if kinds[j] == "mm" else np.radians(postures[:, j])
            along = postures[:, j] if kinds[j] == "mm" else np.zeros(len(postures))
            pose = pose @ turn(z, angle) @ moved(np.outer(d + along, z)) @ moved(np.outer(a + 0 * along, x))
            pose = pose @ turn(x, np.full(len(postures), np.radians(alpha)))
        return pose[:, :3, 3]

    return ArmText(text, kinds, lower, upper, positions, spatial=True)


@st.composite
def urdf_arms(draw: st.DrawFn) -> ArmText:
    """With the file of `urdfs` beside it, its text in it, or the name of a file elsewhere."""
    n = draw(st.sampled_from([3, 2, 4, 6, 1]))
    urdf, axes = draw(urdfs(n))
    where = draw(st.sampled_from(["beside"] * 8 + ["inside"] * 4 + ["elsewhere"]))
    name = {"beside": '"robot.urdf"', "inside": f"'''{urdf}'''", "elsewhere": '"../../../etc/passwd"'}[where]
    parts = ['kind = "spatial"', f"urdf = {name}", 'base_link = "link_0"', f'tip_link = "link_{n}"', _name(draw)]
    text = "\n".join([*parts, *_spatial_tables(draw, n)]) + "\n"

    def positions(postures: np.ndarray) -> np.ndarray:
        pose = np.eye(4)
        for j, axis in enumerate(axes):
            pose = pose @ moved(np.array([[100.0, 0.0, 300.0]])) @ turn(axis, np.radians(postures[:, j]))
        return pose[:, :3, 3]

    spoilt_file = LAUGHS + urdf if one_in(draw, 20) else draw(mostly_valid(urdf))
    return ArmText(
        text, ("deg",) * n, np.full(n, -100.0), np.full(n, 100.0), positions, True, (("robot.urdf", spoilt_file),)
    )


LAUGHS = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n'


@st.composite
def urdfs(draw: st.DrawFn, n: int) -> tuple[str, list[np.ndarray]]:
    """A chain of n joints that turn, and their axes; masses, fixed joints and other elements now and then."""
    axes = [np.array(draw(st.sampled_from([(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]))) for _ in range(n)]
    mass = '<inertial><mass value="2.5"/></inertial>' if draw(st.booleans()) else ""
    lines = ["<?xml version='1.0'?>", '<robot name="r">', '<link name="link_0"/>']
    for j, axis in enumerate(axes, start=1):
        ends = f'<parent link="link_{j - 1}"/><child link="link_{j}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
        limit = '<limit lower="-1.745" upper="1.745" effort="1" velocity="1"/>'
        lines.append(f'<link name="link_{j}">{mass}</link>')
        lines.append(f'<joint name="j{j}" type="revolute"><origin xyz="0.1 0 0.3" rpy="0 0 0"/>{ends}{limit}</joint>')
    if draw(st.booleans()):
        lines.append('<link name="tool0"/><joint name="end" type="fixed">')
        lines.append(f'<parent link="link_{n}"/><child link="tool0"/></joint>')
    return "\n".join([*lines, "</robot>"]) + "\n", axes
