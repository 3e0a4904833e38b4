"""Random files: arms, tables that fit them, studies, and what people and programs get wrong in texts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from hypothesis import strategies as st

T = TypeVar("T")
WORDS = (
    *("0", "-0.0", "-1", "3.7", "1e-320", "1e-9", "1e6", "1e308", "1e309", "-1e200", "nan", "inf", "-inf"),
    *("99999999999999999999", "²", "١", "1_000", "0x10", "1,5", "1;5", "true", "null", "", " ", "''", '"', '"x', "[]"),
    *("{}", "[[1.0]]", "é", "\x1b[31m", "\x00", "\ufeff", "\u202e", "a" * 100_000, "../../etc/passwd", "/dev/full"),
    *("<!DOCTYPE r>", "&x;", "]]>", "q1_deg", "--force", "-", "\\", "1980-01-01", "0.1.2", "+5", "5.", ".5", "١٢"),
)
words = st.sampled_from(WORDS)


def pick(draw: st.DrawFn, options: Sequence[T]) -> T:
    return draw(st.sampled_from(options))


def one_in(draw: st.DrawFn, number: int) -> bool:
    """True in one of so many draws."""
    return pick(draw, range(number)) == number - 1


@st.composite
def spoilt(draw: st.DrawFn, text: str) -> str:
    """`text` with one or two changes: a word replaced, a line gone or twice, a character put in, the end cut off."""
    for _ in range(draw(st.integers(1, 2))):
        kind = pick(draw, ["word", "word", "word", "gone", "twice", "put in", "cut off", "swapped"])
        at, lines = draw(st.integers(0, len(text))), text.splitlines(keepends=True) or [""]
        line = draw(st.integers(0, len(lines) - 1))
        if kind == "word" and (parts := list(re.finditer(r"[\w.+-]+", text))):
            part = pick(draw, parts)
            text = text[: part.start()] + draw(words) + text[part.end() :]
        elif kind in ("gone", "twice"):
            text = "".join([*lines[:line], lines[line] * (2 if kind == "twice" else 0), *lines[line + 1 :]])
        elif kind == "put in":
            text = text[:at] + draw(words | st.characters(codec="utf-8")) + text[at:]
        elif kind == "cut off":
            text = text[:at]
        else:
            text = text.replace(*pick(draw, [(",", ";"), (",", "\t"), (".", ","), ("\n", "\r\n"), ("\n", "\r"), "_-"]))
    return text


@st.composite
def mostly_valid(draw: st.DrawFn, text: str) -> str:
    """The text itself, or spoilt in one of seven."""
    return draw(spoilt(text)) if one_in(draw, 7) else text


# -- arms --------------------------------------------------------------------------------------------------------------
NAMES = ("arm", "arm", "a<b>&'c'", "\\u001b[31mred", "[bold]x[/bold]", "{{ 7 * 7 }}", "é" * 300)
CURVE = 'joint_error_curve"\njoint = 1\nfrom_deg = -90.0\nto_deg = 90.0\nvalues_deg = [0.1, 0.0, 0.1, 0.2]'
EFFECTS = (
    *('encoder_eccentricity"\njoint = 2', 'encoder_eccentricity"\njoint = 1\na_deg = 0.05\nb_deg = 0.02'),
    *('gear_ratio"\njoint = 1', 'backlash"\njoint = 2', 'thermal_growth"', 'transmission_ripple"\njoint = 1\nk = 7'),
    *('outliers"\nshare = 0.1\nsize = 10', 'joint_noise"\njoint = 1\nstd_deg = 0.01', 'base_drift"'),
    *('joint_step"\njoint = 1\nat = 0.5', 'serial_correlation"\nrho = 0.5', 'joint_hysteresis"\njoint = 2', CURVE),
    f'{CURVE}\ngeometry = {{"joint_offset:1" = 0.01, "joint_offset:2" = -0.2}}',
)
OF_GRAVITY = ('joint_compliance"', 'gravity_tilt"', 'payload_error"')
OF_PAYLOAD = ('payload_place"', 'payload_place"\nx_mm = 50.0\ny_mm = 0.0\nz_mm = -1e9')
OF_LENGTHS = ('length_offset"', 'length_offset"\nc_mm = 1e6')
OF_PLANAR = ('base_offset"', 'axis_tilt"\njoint = 1', 'axes_skew"')
OF_SPATIAL = ('axis_runout"\njoint = 1', 'bearing_compliance"\njoint = 1')
ODD_EFFECTS = ('none_such"', 'session_base"\nsessions = 2', 'link_bending"')
ODD_EFFECTS += OF_GRAVITY + OF_PAYLOAD + OF_PLANAR + OF_LENGTHS
AT = "\ncenter_mm = [700.0, -200.0, 300.0]"
INSTRUMENTS = (
    *(
        f'distance"{AT}',
        'distance"',
        'distance"\ncenter_mm = [0.0, 0.0, 0.0]',
        'distance"\ncenter_mm = [1e9, 0.0, 0.0]',
    ),
    *('sphere"\nradius_mm = 30.0', 'sphere"\nradius_mm = 1e-6', 'plane"', f'sphere"\nradius_mm = 30.0{AT}'),
)
ODD_INSTRUMENTS = ('plane"\nradius_mm = 5.0', 'distance"\nradius_mm = 5.0', 'none"', f'plane"{AT}')
ODD_INSTRUMENTS += ('sphere"\nradius_mm = -1.0', 'sphere"')
TWO_TOOLS = "[tool.1]\nz_mm = 60.0\n[tool.2]\ny_mm = "
TOOLS = ("", "[tool]\nx_mm = 50.0", "[tool]\ny_mm = 50.0", f"{TWO_TOOLS}100.0", f"{TWO_TOOLS}1e9")
LOAD = "\npayload_at_mm = [10.0, 0.0, 80.0]\npayload_kg = 5"
LOADS = ("", "\npayload_kg = 5.0", "\npayload_at_mm = [0, 0, 80]", LOAD, f"{LOAD}e300")
ELBOW = ((0.0, 90.0, 400.0), (-600.0, 0.0, 0.0), (-500.0, 0.0, 0.0), (0.0, 90.0, 150.0), (0.0, -90.0, 120.0))
LAUGHS = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n'


@dataclass(frozen=True)
class ArmText:
    """A file, the URDF file beside it, and what is known of the arm.

    kinds : of the joints, "deg" or "mm";  lower, upper : (n,) limits in these units
    lengths : (n,) of the links of a planar arm [mm];  reach : [mm]
    """

    text: str
    kinds: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    lengths: np.ndarray
    reach: float
    urdf: str = ""

    @property
    def spatial(self) -> bool:
        return 'kind = "spatial"' in self.text

    @property
    def instrument(self) -> str:
        """Kind of what measures lengths, "": positions are measured."""
        table = re.search(r'\[instrument\]\nkind = "(\w+)"', self.text)
        return table[1] if table and self.spatial else ""

    def positions(self, postures: np.ndarray) -> np.ndarray:
        """(m, d) [mm] of a planar arm's tip at (m, n) [deg]; in space of anything within reach."""
        if self.spatial:
            return np.random.default_rng(len(postures)).uniform(-0.5 * self.reach, 0.5 * self.reach, (len(postures), 3))
        z = np.exp(1j * np.radians(np.cumsum(postures, axis=1))) @ self.lengths
        return np.column_stack([z.real, z.imag])


def numbers(values: object) -> str:
    return "[" + ", ".join(repr(float(v)) for v in np.ravel(np.asarray(values))) + "]"


@st.composite
def arms(draw: st.DrawFn) -> ArmText:
    """Planar, from Denavit-Hartenberg rows (a joint slides now and then), or from a URDF file."""
    kind = pick(draw, ["planar"] * 4 + ["dh", "urdf"])
    n = pick(draw, [2, 3, 3, 4, 1, 12] if kind == "planar" else [3, 2, 4, 5, 1])
    width, middle = pick(draw, [180.0, 100.0, 60.0, 20.0, 1e-6, 5e5]), pick(draw, [0.0, 30.0])
    lower, upper = np.full(n, middle - width), np.full(n, middle + width)
    kinds, urdf, lengths, reach = ["deg"] * n, "", np.zeros(n), 1500.0
    parts, rows = [f'name = "{pick(draw, NAMES)}"', *([] if kind == "planar" else ['kind = "spatial"'])], []
    if kind == "planar":
        odd = [pick(draw, [300.0, 150.0, 80.0, 500.0, 1e-6, 1e-3, 1e6, 1e9]) for _ in range(n)]
        lengths = np.array(odd) if one_in(draw, 5) else 300.0 * 0.8 ** np.arange(n)
        parts.append(f"links_mm = {numbers(lengths)}")
        reach = float(lengths.sum())
    elif kind == "dh":
        rows = [f"[[dh]]\na_mm = {a}\nalpha_deg = {alpha}\nd_mm = {d}" for a, alpha, d in ELBOW[:n]]
        if (slide := pick(draw, [-1, -1, -1, 0, n - 1])) >= 0:
            rows[slide] += '\njoint = "prismatic"'
            kinds[slide], lower[slide], upper[slide] = "mm", 0.0, 400.0
    else:
        lower, upper = np.full(n, -100.0), np.full(n, 100.0)
        urdf = draw(urdfs(n))
        where = pick(draw, ['"robot.urdf"'] * 8 + [f"'''{urdf}'''"] * 4 + ['"../../../etc/passwd"'])
        parts += [f"urdf = {where}", 'base_link = "link_0"', f'tip_link = "link_{n}"']
        urdf = LAUGHS + urdf if one_in(draw, 20) else draw(mostly_valid(urdf))
    if kind != "urdf" and (width != 180.0 or draw(st.booleans())):
        for unit in sorted(set(kinds)):
            of_unit = np.array(kinds) == unit
            bounds = f"lower = {numbers(lower[of_unit])}\nupper = {numbers(upper[of_unit])}"
            parts.append(f"[joint_limits_{unit}]\n{bounds}")
    text = "\n".join([*parts, *rows, *draw(tables_of_arm(n, reach, kind != "planar"))]) + "\n"
    return ArmText(text, tuple(kinds), lower, upper, lengths, reach, urdf)


@st.composite
def tables_of_arm(draw: st.DrawFn, n: int, reach: float, spatial: bool) -> list[str]:
    """Noise, instrument, base, tool, machining, gravity, constraints, effects, calibration."""
    parts, lengths = [], one_in(draw, 3 if spatial else 60)
    if spatial or not one_in(draw, 5):
        parts.append(f"[measurement]\nsigma_mm = {pick(draw, [0.1] * 12 + [0.05, 1e-9, 1e3, 1e9])!r}")
    if spatial and one_in(draw, 30 if lengths else 2):
        parts[-1] += f"\nsigma_deg = {pick(draw, ['0.05', '1e-9', '1e9'])}"
    if lengths:
        instrument = pick(draw, ODD_INSTRUMENTS if one_in(draw, 12) else INSTRUMENTS)
        parts.append(f'[instrument]\nkind = "{instrument}')
    if spatial:
        if "center_mm" not in "".join(parts) and draw(st.booleans()):
            parts.append(f"[base]\nx_mm = 1500.0\nrz_deg = {pick(draw, ['90.0', '1e6'])}")
        parts.append(pick(draw, TOOLS))
        if one_in(draw, 4):
            parts.append(f"[machining]\ntranslation_mm = {pick(draw, ['0.1', '0.3', '1.0', '1e-12', '1e300'])}")
    gravity = one_in(draw, 3 if spatial else 2)
    if gravity:
        down = numbers([0.0, 0.0, -9.81] if spatial else [0.0, -9.81])
        parts.append(f"[gravity]\nacceleration_m_s2 = {down}\nlink_masses_kg = {numbers(np.ones(n))}")
        parts[-1] += pick(draw, LOADS) if spatial else ""
    parts += [draw(constraints(reach, 3 if spatial else 2)) for _ in range(pick(draw, [0] * 6 + [1, 2]))]
    fitting = EFFECTS + (OF_SPATIAL if spatial else OF_PLANAR) + (OF_GRAVITY if gravity else ())
    fitting += (OF_PAYLOAD if gravity and spatial else ()) + (OF_LENGTHS if lengths and spatial else ())
    for _ in range(pick(draw, [0, 0, 0, 0, 0, 1, 1, 2])):
        parts.append(f'[[effects]]\nname = "{pick(draw, ODD_EFFECTS if one_in(draw, 12) else fitting)}')
    if spatial and n > 1 and not one_in(draw, 3):
        name = "base.x" if one_in(draw, 12) else f"translation_x:{n}"  # the base may be known
        parts.append(f'[calibration]\nvalues = {{"{name}" = 0.5}}')
    elif not spatial and not one_in(draw, 4):
        offsets = f"joint_offsets_deg = {numbers(np.linspace(-0.5, 0.5, n))}"
        parts.append(f"[calibration]\nlength_errors_mm = {numbers(np.full(n, 0.3))}\n{offsets}")
    return parts


@st.composite
def constraints(draw: st.DrawFn, reach: float, dimension: int) -> str:
    """With sizes of the arm's, or with absurd ones."""
    size, zeros = reach * pick(draw, [1.0, 0.5, 0.1, 1e-9]), numbers(np.zeros(dimension))
    point, away = numbers(np.full(dimension, size / 2)), numbers(np.full(dimension, 3 * reach))
    shape = "keep_out_circle" if dimension == 2 else "keep_out_sphere"
    kinds = [
        'workspace_box"\n' + "\n".join(f"{axis}_mm = [{-size!r}, {size!r}]" for axis in "xyz"[:dimension]),
        f'{shape}"\ncenter_mm = {point}\nradius_mm = {size / 10!r}',
        f'line_of_sight"\nhalf_angle_deg = 30.0\ntracker_mm = {away}\ntoward_mm = {zeros}',
        f'keep_out_cylinder"\nstart_mm = {point}\nend_mm = {zeros}\nradius_mm = {size / 20!r}',
    ]
    return f'[[constraints]]\nkind = "{pick(draw, kinds[: dimension + 1])}'


@st.composite
def urdfs(draw: st.DrawFn, n: int) -> str:
    """A chain of n joints that turn; masses and a fixed joint now and then."""
    axes = [np.eye(3)[pick(draw, [2, 1, 0])] for _ in range(n)]
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
    return "\n".join([*lines, "</robot>"]) + "\n"


# -- tables ------------------------------------------------------------------------------------------------------------
def csv(draw: st.DrawFn, columns: dict[str, np.ndarray | list[str]]) -> str:
    """The text of a table; of one in eight with semicolons and decimal commas."""
    european = one_in(draw, 8)
    separator, rows = (";" if european else ","), zip(*columns.values(), strict=True)
    lines = [separator.join(cell if isinstance(cell, str) else f"{cell:.9g}" for cell in row) for row in rows]
    text = "\n".join([separator.join(columns), *lines]) + "\n"
    return text.replace(".", ",") if european else text


def drawn_postures(draw: st.DrawFn, arm: ArmText, rows: int) -> np.ndarray:
    """(m, n) within the limits, or equal, or far outside, or of many turns."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    postures = rng.uniform(arm.lower, arm.upper, (rows, len(arm.kinds)))
    kind = pick(draw, ["random"] * 5 + ["same", "repeated", "outside", "turns"])
    if kind in ("same", "repeated"):
        postures = postures[rng.integers(0, max(rows // 3, 1) if kind == "repeated" else 1, rows)]
    return postures * {"outside": 3.0, "turns": 1000.0}.get(kind, 1.0)


def named(arm: ArmText, values: np.ndarray, letter: str = "q") -> dict[str, np.ndarray]:
    return {f"{letter}{j}_{kind}": column for j, (kind, column) in enumerate(zip(arm.kinds, values.T, strict=True), 1)}


def conditions(draw: st.DrawFn, arm: ArmText, rows: int) -> dict[str, np.ndarray]:
    """Columns that a plan may have too."""
    number, signs = np.arange(rows), range(1, len(arm.kinds) + 1)
    every = (
        {"payload_kg": number % 3 * 2.5},
        {"temperature_C": np.linspace(18.0, 25.0, rows)},
        {f"direction{j}": np.where(number % (j + 1), 1, -1) for j in signs},
    )
    return {name: column for columns in every if one_in(draw, 4) for name, column in columns.items()}


@st.composite
def plans(draw: st.DrawFn, arm: ArmText) -> str:
    """With weights now and then."""
    rows = pick(draw, [12, 20, 30, 3, 1])
    weight = {"weight": np.full(rows, 1.0 / rows)} if one_in(draw, 5) else {}
    postures = named(arm, drawn_postures(draw, arm, rows))
    return csv(draw, {"run": np.arange(1, rows + 1), **postures, **conditions(draw, arm, rows), **weight})


@st.composite
def measurements(draw: st.DrawFn, arm: ArmText) -> str:
    """Positions, of planar arms those that they have, with noise and an offset, or lengths, or contacts; and columns
    of any kind."""
    rows = pick(draw, [20, 40, 60, 8, 2])
    angles, rng, number = drawn_postures(draw, arm, rows), np.random.default_rng(rows), np.arange(rows)
    exact = arm.positions(angles + pick(draw, [0.0, 0.1]))
    places = exact + pick(draw, [0.1, 0.1, 0.1, 0.0, 50.0, 1e6]) * rng.standard_normal(exact.shape)
    columns: dict = named(arm, angles) | {f"{axis}_mm": column for axis, column in zip("xyz", places.T, strict=False)}
    if arm.instrument == "distance" and not one_in(draw, 20):
        unit, size = ("m", 1e-3) if one_in(draw, 12) else ("mm", 1.0)
        columns = named(arm, angles) | {f"distance_{unit}": size * np.linalg.norm(places, axis=1)}
    elif arm.instrument and not one_in(draw, 20):
        columns = named(arm, angles)
        if draw(st.booleans()):
            columns["surface"] = [f"side {k % 2}" for k in number]
    every: dict[str, dict] = {
        "order": {"order": number},
        "time": {"time_s": number * 7.5},
        "session": {"session": [f"day {1 + 2 * k // rows}" for k in range(rows)]},
        "posture": {"posture": number // 2},
        "sigma": {"sigma_mm": np.full(rows, 0.1)},
        "commanded": named(arm, angles + 0.01, "commanded"),
        "unknown": {"note": ["a<b>"] * rows},
        "marker": {"marker": [str(1 + k % 2) for k in range(rows)]},
        "angles": {f"r{axis}_deg": rng.uniform(-90.0, 90.0, rows) for axis in "xyz"},
        "quaternion": {f"q{part}": rng.standard_normal(rows) for part in "wxyz"},
    }
    chosen = draw(st.lists(st.sampled_from(list(every)), max_size=3, unique=True))
    for key in [*chosen, *(["marker"] if TWO_TOOLS in arm.text and not one_in(draw, 8) else [])]:
        columns |= every[key]
    return csv(draw, columns | conditions(draw, arm, rows))


@st.composite
def targets(draw: st.DrawFn, arm: ArmText) -> str:
    """Positions within reach and beyond, or postures, or both, with orientations now and then."""
    rows, kind = pick(draw, [5, 1, 12]), pick(draw, ["positions", "postures", "both", "poses"])
    angles = drawn_postures(draw, arm, rows)
    places = arm.positions(angles) * pick(draw, [1.0, 1.0, 0.0, 100.0, 1e295])
    columns: dict = {f"{axis}_mm": column for axis, column in zip("xyz", places.T, strict=False)}
    if kind in ("postures", "both"):
        columns = {**(columns if kind == "both" else {}), **named(arm, angles)}
    if kind == "poses":
        columns |= {f"r{axis}_deg": np.linspace(-90.0, 90.0, rows) for axis in "xyz"}
    return csv(draw, columns)


@st.composite
def studies(draw: st.DrawFn, arm: ArmText) -> str:
    """A small study of one or two plans."""
    plan = ["random", "best_of_random", "plan.csv", "exchange", *(() if arm.spatial else ("dft",))]
    plan = ["none", "../plan.csv"] if one_in(draw, 12) else plan
    chosen = [f'"{pick(draw, plan)}"' for _ in range(draw(st.integers(1, 2)))]
    few = 3 if arm.spatial else 1  # equations of a row make up for the parameters
    runs = ["[1]", "[]"] if one_in(draw, 12) else [f"[{12 * few}]", f"[{10 * few}, {20 * few}]", f"[{8 * few}]"]
    lines = ['arms = ["arm.toml"]', f"plans = [{', '.join(chosen)}]", f"runs = {pick(draw, runs)}"]
    lines += ["solver_seconds = 0.2", f"replications = {pick(draw, ['1', '5', '20'])}"]
    lines += ["sigma_mm = [0.1]"] if draw(st.booleans()) else []
    if one_in(draw, 3):
        of_space = arm.spatial is not one_in(draw, 12)
        planar = f"length_errors_mm = {numbers(np.full(len(arm.kinds), 0.5))}"
        lines.append('[[truths]]\nname = "t"\n' + ('values = {"joint_offset:2" = 0.2}' if of_space else planar))
    if one_in(draw, 3):
        effect = "base_drift" if arm.spatial else "base_offset"
        lines.append(f'[[models]]\nname = "m"\neffects = [{{name = "{effect}"}}]')
    return "\n".join(lines) + "\n"
