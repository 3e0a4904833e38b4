"""Random files: what armcal wrote of small arms, with what people add to it, change in it and get wrong."""

import csv
import json
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import chdir
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar
from unittest.mock import patch

from click.testing import CliRunner
from hypothesis import strategies as st

from doe.cli import main
from identification.effects import Effect, of_dimension

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


# -- campaigns ---------------------------------------------------------------------------------------------------------
NOISE = "[measurement]\nsigma_mm = 0.1\n"
ROWS = "".join(
    f"[[dh]]\na_mm = {a}\nalpha_deg = {alpha}\nd_mm = {d}\n" for a, alpha, d in ((0.0, 90.0, 400.0), (-600.0, 0.0, 0.0))
)
SLIDES = '[[dh]]\na_mm = 0.0\nalpha_deg = 90.0\nd_mm = 100.0\njoint = "prismatic"\n'
SLIDES += "[joint_limits_mm]\nlower = [0.0]\nupper = [400.0]\n"
URDF = '<robot name="r"><link name="link_0"/>' + "".join(
    f'<link name="link_{j}"><inertial><mass value="2.5"/></inertial></link><joint name="j{j}" type="revolute">'
    f'<origin xyz="0.1 0 0.3" rpy="0 0 0"/><parent link="link_{j - 1}"/><child link="link_{j}"/>'
    f'<axis xyz="{axis}"/><limit lower="-1.745" upper="1.745" effort="1" velocity="1"/></joint>\n'
    for j, axis in enumerate(("0 0 1", "0 1 0", "0 1 0"), start=1)
)
URDF += (
    '<link name="tool0"/><joint name="end" type="fixed"><parent link="link_3"/><child link="tool0"/></joint></robot>'
)
SPACE = f'kind = "spatial"\n{NOISE}[tool]\nx_mm = 0.0\ny_mm = 60.0\nz_mm = 80.0\n'
BAR = '[instrument]\nkind = "distance"\ncenter_mm = [500.0, -200.0, 300.0]\n'
LIMITS = "[joint_limits_deg]\nlower = [-70.0, -50.0, -100.0]\nupper = [130.0, 110.0, 20.0]\n"
ARMS = {  # kind -> its file
    "planar": f"links_mm = [260.0, 180.0]\n{NOISE}",
    "limited": f'name = "a<b>"\nlinks_mm = [300.0, 240.0, 190.0]\n{NOISE}{LIMITS}',
    "spatial": SPACE + ROWS,
    "sliding": SPACE + ROWS + SLIDES,
    "bar": SPACE + ROWS + BAR,
    "urdf": f'urdf = "robot.urdf"\nbase_link = "link_0"\ntip_link = "tool0"\n{SPACE}',
}
PLANAR = ("planar", "limited")
ECCENTRIC = '[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.08\nb_deg = 0.02\n'
STEPS = (
    "design arm.toml --runs 40 --solver random --seconds 0.2 --out plan.csv",
    "simulate arm.toml plan.csv --truth truth.toml --out data.csv",
    "identify arm.toml data.csv --out calibrated.toml",
)


def written_by_armcal() -> dict[str, dict[str, str]]:
    """Kind of arm -> name -> text of each file of its campaign."""
    campaigns = {}
    for kind, arm in ARMS.items():
        count, spatial = 3 if kind == "limited" else 2, kind not in PLANAR
        truth = f"length_errors_mm = {[0.5] * count}\njoint_offsets_deg = {[0.2] * count}\n"
        truth = 'values = {"joint_offset:2" = 0.3}\n' if spatial else truth
        files = {"arm.toml": arm, "truth.toml": f"{arm}[calibration]\n{truth}{ECCENTRIC}", "robot.urdf": URDF}
        aside = patch(
            "doe.plan.accuracy.tip_beside_random", return_value=(None, [])
        )  # takes most of the time, changes no file
        with TemporaryDirectory() as folder, chdir(folder), aside:
            for name, text in files.items():
                Path(name).write_text(text)
            for line in STEPS:
                done = CliRunner().invoke(main, [*line.split(), "--quiet"], catch_exceptions=False)
                assert done.exit_code == 0, done.stderr
            campaigns[kind] = {path.name: path.read_text() for path in sorted(Path().iterdir())}
        campaigns[kind]["extended.toml"] = campaigns[kind]["calibrated.toml"] + ECCENTRIC
    return campaigns


@cache
def campaigns() -> dict[str, dict[str, str]]:
    """All of `written_by_armcal`, by one process of its own, as cases are forks of this one."""
    done = subprocess.run([sys.executable, "-m", __name__], capture_output=True, check=True)
    return dict(json.loads(done.stdout))


# -- arms --------------------------------------------------------------------------------------------------------------
CURVE = '[[effects]]\nname = "joint_error_curve"\njoint = 1\nfrom_deg = -90.0\nto_deg = 90.0\n'
CURVE += "values_deg = [0.1, 0.0, 0.1, 0.2]\n"
CONSTRAINTS = (
    *('workspace_box"\nx_mm = [-500.0, 900.0]', 'keep_out_circle"\ncenter_mm = [300.0, 100.0]\nradius_mm = 40.0'),
    'line_of_sight"\nhalf_angle_deg = 30.0\ntracker_mm = [2000.0, 0.0]\ntoward_mm = [0.0, 0.0]',
    'keep_out_sphere"\ncenter_mm = [300.0, 100.0, 200.0]\nradius_mm = 40.0',
    'line_of_sight"\nhalf_angle_deg = 30.0\ntracker_mm = [2e3, 0.0, 9e2]\ntoward_mm = [0.0, 0.0, 0.0]',
    'keep_out_cylinder"\nstart_mm = [300.0, 100.0, 0.0]\nend_mm = [300.0, 100.0, 500.0]\nradius_mm = 40.0',
)
INSTRUMENTS = (
    'distance"',
    'sphere"\nradius_mm = 30.0',
    'plane"',
    'socket"',
    'sphere"',
    'plane"\nradius_mm = 5.0',
    'x"',
)
EITHER = [CURVE, f'{CURVE}geometry = {{"joint_offset:1" = 0.01, "joint_offset:2" = -0.2}}\n']
TABLES = {  # number of axes of space -> tables of an arm in it
    2: [
        *(f'[[constraints]]\nkind = "{text}\n' for text in CONSTRAINTS[:3]),
        "[gravity]\nacceleration_m_s2 = [0.0, -9.81]\nlink_masses_kg = [1.0, 1.0]\n",
        "[calibration]\nlength_errors_mm = [0.3, 0.3]\njoint_offsets_deg = [-0.5, 0.5]\n",
    ],
    3: [
        *(f'[[constraints]]\nkind = "{text}\n' for text in CONSTRAINTS[3:]),
        "[gravity]\nacceleration_m_s2 = [0.0, 0.0, -9.81]\nlink_masses_kg = [1.0, 1.0]\npayload_kg = 5.0\n",
        "[gravity]\nacceleration_m_s2 = [0.0, 0.0, -9.81]\nlink_masses_kg = [1, 1]\npayload_at_mm = [10, 0, 80]\n",
        *("[base]\nx_mm = 1500.0\nrz_deg = 90.0\n", "[machining]\ntranslation_mm = 0.1\n"),
        '[calibration]\nvalues = {"translation_x:2" = 0.5}\n',
    ],
}
ODD = ['[[effects]]\nname = "none_such"\n', "[tool.1]\nz_mm = 60.0\n[tool.2]\ny_mm = 100.0\n"]
ODD += [f'[instrument]\nkind = "{text}\n' for text in INSTRUMENTS]
SIZES = ("0.0", "1e-9", "1e-3", "30.0", "1e3", "1e6", "1e9", "1e300", "-1.0")


def effect(cls: type[Effect]) -> str:
    """An entry with the lowest of its settings."""
    settings = "".join(f"{name} = {setting.low:g}\n" for name, setting in cls.settings.items())
    return f'[[effects]]\nname = "{cls.name}"\n{"joint = 2" if cls.per_joint == "required" else ""}\n{settings}'


@st.composite
def arms(draw: st.DrawFn, kind: str) -> str:
    """The file of a kind of arm with some further tables, and now and then with a number of another size."""
    text = campaigns()[kind]["arm.toml"]
    dimension = 2 if kind in PLANAR else 3
    fitting = [*EITHER, *TABLES[dimension], *map(effect, of_dimension(dimension).values())]
    odd = [*ODD, *TABLES[5 - dimension], *map(effect, of_dimension(5 - dimension).values())]
    for _ in range(pick(draw, [0, 0, 1, 1, 2, 3])):
        text += pick(draw, odd if one_in(draw, 12) else fitting)
    if one_in(draw, 4):
        number = pick(draw, list(re.finditer(r"-?\d+\.\d+", text)))
        text = text[: number.start()] + pick(draw, SIZES) + text[number.end() :]
    return text.replace("sigma_mm = 0.1", "sigma_mm = 0.1\nsigma_deg = 0.05") if one_in(draw, 12) else text


# -- tables ------------------------------------------------------------------------------------------------------------
Number = Callable[[int], object]
# columns that tables may have besides: of each a function of the row's number
FURTHER: dict[str, dict[str, Number]] = {
    "order": {"order": lambda k: k},
    "time": {"time_s": lambda k: 7.5 * k},
    "session": {"session": lambda k: f"day {1 + k // 20}"},
    "posture": {"posture": lambda k: k // 2},
    "sigma": {"sigma_mm": lambda k: 0.1},
    "payload": {"payload_kg": lambda k: k % 3 * 2.5},
    "temperature": {"temperature_C": lambda k: 18.0 + 0.1 * k},
    "directions": {f"direction{j}": lambda k, j=j: 1 if k % (j + 1) else -1 for j in (1, 2, 3)},  # type: ignore[misc]
    "commanded": {f"commanded{j}_deg": lambda k, j=j: 7.0 * k % (90.0 * j) for j in (1, 2)},  # type: ignore[misc]
    "unknown": {"note": lambda k: "a<b>"},
    "marker": {"marker": lambda k: 1 + k % 2},
    "surface": {"surface": lambda k: f"side {k % 2}"},
    "weight": {"weight": lambda k: 0.025},
    "angles": {f"r{axis}_deg": lambda k: 9.0 * k % 90.0 for axis in "xyz"},
    "quaternion": {f"q{part}": lambda k: 0.5 for part in "wxyz"},
}


@st.composite
def tables(draw: st.DrawFn, text: str) -> str:
    """A table of armcal's with other rows, sizes and columns, and with semicolons and decimal commas now and then."""
    first, *lines = csv.reader(line for line in text.splitlines() if not line.startswith("#"))
    kept = pick(draw, [range(40)] * 6 + [range(8), range(1), [0] * 20, [k // 3 for k in range(30)]])
    rows = [lines[k] for k in kept if k < len(lines)]
    columns = dict(zip(first, zip(*rows, strict=True), strict=True))
    for start, factors in (
        ("q", [1.0] * 8 + [3.0, 1e3]),
        (("x_", "y_", "z_", "dist"), [1.0] * 8 + [0.0, 1.1, 1e-3, 1e6]),
    ):
        if (factor := pick(draw, factors)) != 1.0:
            columns |= {
                name: tuple(repr(factor * float(cell)) for cell in cells)
                for name, cells in columns.items()
                if name.startswith(start)
            }
    for further in draw(st.lists(st.sampled_from(list(FURTHER)), max_size=3, unique=True)):
        columns |= {name: tuple(str(of(k)) for k in range(len(rows))) for name, of in FURTHER[further].items()}
    if one_in(draw, 12):
        del columns[pick(draw, list(columns))]
    european = one_in(draw, 8)
    separator = ";" if european else ","
    text = "\n".join(map(separator.join, [list(columns), *zip(*columns.values(), strict=True)])) + "\n"
    return text.replace(".", ",") if european else text


@st.composite
def studies(draw: st.DrawFn, spatial: bool) -> str:
    """A small study of one or two plans."""
    plans = ["none", "../plan.csv"] if one_in(draw, 12) else ["random", "best_of_random", "plan.csv", "exchange", "dft"]
    lines = [
        'arms = ["arm.toml"]',
        f"plans = {json.dumps(draw(st.lists(st.sampled_from(plans), min_size=1, max_size=2)))}",
    ]
    lines += [f"runs = {pick(draw, ['[12]', '[36]', '[30, 60]', '[1]', '[]'])}", "solver_seconds = 0.2"]
    lines += [f"replications = {pick(draw, ['1', '5', '20'])}", *(["sigma_mm = [0.1]"] if draw(st.booleans()) else [])]
    if one_in(draw, 3):
        planar = "length_errors_mm = [0.5, 0.5]\njoint_offsets_deg = [0.1, 0.1]"
        lines.append('[[truths]]\nname = "t"\n' + ('values = {"joint_offset:2" = 0.2}' if spatial else planar))
    if one_in(draw, 3):
        lines.append(f'[[models]]\nname = "m"\neffects = [{{name = "{"base_drift" if spatial else "base_offset"}"}}]')
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.stdout.write(json.dumps(written_by_armcal()))
