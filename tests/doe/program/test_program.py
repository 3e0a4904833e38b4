"""Programs of controllers, read back by grammars of their languages that the templates know nothing of."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doe.program.program import LANGUAGES, decimal, program
from identification import Arm, DHRow, InputError, Plan, chain_of
from identification.kinematics.counting import Counting
from tests.doe.six_axis import LIMITED, TABLE

NUMBER = r"-?\d+\.\d+"
VIA = np.array([False, True, True, False, False])
POSTURES = np.random.default_rng(3).uniform(-1.0, 1.0, (5, 6))
PLAN = Plan(POSTURES, via=VIA)
SIX = [DHRow(a, np.radians(alpha), d) for a, alpha, d in TABLE]
RAIL = DHRow(0.0, np.pi / 2, 100.0, type="prismatic", limits=(-900.0, 900.0))


def numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(NUMBER, text)]


def read_ur(text: str) -> tuple[np.ndarray, list[tuple[int, int]], list[float]]:
    """Postures, (after how many moves, run) of each pause, and waits, of a strict reading of every line."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    match = re.fullmatch(r"def (\w+)\(\):", lines[0])
    assert lines[-2:] == ["end", f"{match[1]}()"]
    grammar = {
        "move": rf"  movej\(\[({NUMBER}(?:, {NUMBER})*)\], a={NUMBER}, v={NUMBER}\)",
        "wait": rf"  sleep\(({NUMBER})\)",
        "pause": r'  popup\("run (\d+): [\w ,]+", title="\w+", blocking=True\)',
    }
    return read_lines(lines[1:-2], grammar)


def read_abb(text: str) -> tuple[np.ndarray, list[tuple[int, int]], list[float]]:
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("!")]
    assert re.fullmatch(r"MODULE [A-Za-z]\w{0,31}", lines[0])
    assert re.fullmatch(r"PROC [A-Za-z]\w{0,31}\(\)", lines[1])
    assert lines[-2:] == ["ENDPROC", "ENDMODULE"]
    assert all(line.endswith(";") for line in lines[2:-2])
    axis = rf"(?:{NUMBER}|0|9E9)"
    six = rf"\[((?:{axis}, ){{5}}{axis})\]"
    grammar = {
        "move": rf"MoveAbsJ \[{six}, {six}\]\\NoEOffs, vmax, fine, tool0;",
        "wait": rf"WaitTime ({NUMBER});",
        "run": r'TPWrite "run (\d+): [\w ,]+";',
        "pause": r"Stop;",
        "speed": r"VelSet \d+, 5000;",
    }
    return read_lines(lines[2:-2], grammar)


def read_kuka(text: str) -> tuple[np.ndarray, list[tuple[int, int]], list[float]]:
    lines = [re.sub(r"^; run (\d+)$", r"RUN \1", line) for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith((";", "&"))]
    assert re.fullmatch(r"DEF [A-Za-z]\w{0,23}\( \)", lines[0])
    assert lines[-1] == "END"
    grammar = {
        "move": rf"PTP {{(A[1-6] {NUMBER}(?:, A[1-6] {NUMBER})*)}}",
        "wait": rf"WAIT SEC ({NUMBER})",
        "run": r"RUN (\d+)",
        "pause": r"HALT",
        "start": r"BAS \(#\w+,\d+\)",
    }
    for line in lines:
        if line.startswith("PTP"):
            assert re.findall(r"A(\d)", line) == [*map(str, range(1, 1 + line.count("A")))]
    return read_lines(lines[1:-1], grammar)


def read_fanuc(text: str) -> tuple[np.ndarray, list[tuple[int, int]], list[float]]:
    head, body, rest = re.fullmatch(r"(/PROG .*?)/MN\n(.*?)/POS\n(.*?)/END\n", text, re.DOTALL).groups()
    assert re.match(r"/PROG  [A-Z]\w{0,23}\n/ATTR\n", head)
    lines = []
    for number, line in enumerate(body.splitlines(), start=1):
        match = re.fullmatch(r" *(\d+):(.*) ;", line)
        assert int(match[1]) == number
        lines.append(match[2])
    places = {}
    for block in re.findall(r"P\[\d+\]{.*?};\n", rest, re.DOTALL):
        axes = r"((?:\tJ\d = -?\d+\.\d+ (?:deg|mm),?\n)+)"
        match = re.fullmatch(rf"P\[(\d+)\]{{\n   GP1:\n\tUF : 0, UT : 1,\n{axes}}};\n", block)
        rows = match[2].splitlines()
        assert [row.endswith(",") for row in rows] == [True] * (len(rows) - 1) + [False]
        places[match[1]] = ", ".join(str(number) for number in numbers(match[2]))
    assert "".join(re.findall(r"P\[\d+\]{.*?};\n", rest, re.DOTALL)) == rest
    lines = [re.sub(r"^J P\[(\d+)\] \d+% FINE$", lambda m: f"J {places[m[1]]}", line) for line in lines]
    lines = [line for line in lines if not line.startswith("  !")]
    grammar = {
        "move": rf"J ({NUMBER}(?:, {NUMBER})*)",
        "wait": rf"  WAIT ({NUMBER})\(sec\)",
        "run": r"  MESSAGE\[run (\d+): measure\]",
        "pause": r"  PAUSE",
        "frames": r"  U(?:FRAME|TOOL)_NUM=\d",
    }
    return read_lines(lines, grammar)


def read_ros(text: str) -> tuple[np.ndarray, list[tuple[int, int]], list[float]]:
    """A strict reading of the lines that are used of YAML; a point twice is a rest."""
    runs = [int(run) for run in re.findall(r"^  # run (\d+)$", text, re.MULTILINE)]
    lines = [line for line in text.splitlines() if line and not line.lstrip().startswith("#")]
    assert re.fullmatch(r'joint_names: \["[^"]+"(, "[^"]+")*\]', lines[0])
    assert lines[1] == "points:"
    postures, clock, pauses, waits = [], [-1.0], [], []
    for q, v, a, t in zip(*(lines[2 + k :: 4] for k in range(4)), strict=True):
        row = numbers(re.fullmatch(r"  - positions: (\[.*\])", q)[1])
        for key, line in (("velocities", v), ("accelerations", a)):
            assert line == f"    {key}: [{', '.join(['0.0'] * len(row))}]"
        seconds, nanoseconds = re.fullmatch(r"    time_from_start: {sec: (\d+), nanosec: (\d+)}", t).groups()
        assert int(nanoseconds) < 10**9
        clock.append(int(seconds) + int(nanoseconds) / 1e9)
        assert clock[-1] > clock[-2]
        if postures and row == postures[-1]:
            waits.append(round(clock[-1] - clock[-2], 6))
            pauses.append((len(postures), runs[len(pauses)]))
        else:
            postures.append(row)
    return np.array(postures), pauses, waits


def read_lines(lines: list[str], grammar: dict[str, str]) -> tuple[np.ndarray, list[tuple[int, int]], list[float]]:
    postures, pauses, waits, run = [], [], [], 0
    for line in lines:
        kind, match = next((k, m) for k, rule in grammar.items() if (m := re.fullmatch(rule, line)))
        if kind == "move":
            postures.append([n for group in match.groups() for n in numbers(group)])
        elif kind == "wait":
            waits.append(float(match[1]))
        elif kind in ("run", "pause") and match.groups():
            run = int(match[1])
        if kind == "pause":
            pauses.append((len(postures), run))
    return np.array(postures), pauses, waits


READERS = {"ur": read_ur, "abb": read_abb, "kuka": read_kuka, "fanuc": read_fanuc, "ros": read_ros}
FACTORS = {"ur": 1.0, "ros": 1.0, "abb": 180.0 / np.pi, "kuka": 180.0 / np.pi, "fanuc": 180.0 / np.pi}


@pytest.mark.parametrize("robot", LANGUAGES["robots"])
def test_a_program_says_what_the_plan_says(robot: str) -> None:
    """Positions to 1e-7 rad, each measured row with its pause and wait, way-points with neither."""
    text, _ = program(LIMITED, PLAN, robot, settle=1.5)
    postures, pauses, waits = READERS[robot](text)
    np.testing.assert_allclose(postures / FACTORS[robot], POSTURES, rtol=0.0, atol=1e-7)
    assert (pauses, waits) == ([(1, 1), (4, 2), (5, 3)], [1.5] * 3)
    assert text.isascii()
    assert text.count("via") >= 2


def test_joints_are_written_as_the_controller_counts_them() -> None:
    """A FANUC: joint 3 is counted from the horizontal, its axis the other way; one joint with another sign and zero."""
    counting = Counting((1, 1, 1, -1, 1, 1), (0, 0, -2, 0, 0, 0), (0.0, 0.0, 0.0, np.radians(30.0), 0.0, 0.0))
    arm = replace(LIMITED, lower=np.full(6, -2.5), upper=np.full(6, 2.5), counting=counting)
    postures, *_ = read_fanuc(program(arm, PLAN, "fanuc")[0])
    q = np.degrees(POSTURES)
    shown = np.column_stack([q[:, 0], q[:, 1], q[:, 2] - q[:, 1], 30.0 - q[:, 3], q[:, 4], q[:, 5]])
    np.testing.assert_allclose(postures, shown, rtol=0.0, atol=1e-6)


def test_times_are_those_of_a_polynomial_that_keeps_the_speed() -> None:
    """No joint is faster than asked anywhere on 10 s^3 - 15 s^4 + 6 s^5, and one is just so fast."""
    text, made = program(LIMITED, PLAN, "ros", speed=30, settle=0.0)
    arrivals = np.array([move["seconds"] for move in made["moves"]])
    share = np.linspace(0.0, 1.0, 2001)
    shape = 10 * share**3 - 15 * share**4 + 6 * share**5
    for row in range(1, 5):
        taken = arrivals[row] - arrivals[row - 1]
        ways = np.degrees(np.abs(POSTURES[row] - POSTURES[row - 1]))
        fastest = ways.max() * np.abs(np.diff(shape)).max() * 2000 / taken
        assert fastest == pytest.approx(0.3 * 120.0, rel=1e-3)
    assert arrivals[0] >= np.degrees(np.abs(POSTURES[0] + LIMITED.upper).max()) * 15 / 8 / 36.0 - 1e-3
    assert read_ros(text)[1] == []  # without settling there is no rest


@pytest.mark.parametrize(("robot", "acceleration"), {"ur": 80.214, "abb": 400.0, "kuka": 120.0, "fanuc": 400.0}.items())
def test_estimated_times_are_those_of_even_acceleration_to_the_speed(robot: str, acceleration: float) -> None:
    """[deg/s^2] of the slowest joint, integrated in steps: what is left of half the way once the speed is reached."""
    arrivals = [move["seconds"] for move in program(LIMITED, PLAN, robot, speed=30, settle=0.0)[1]["moves"]]
    for row in range(1, 5):
        half, t = np.degrees(np.abs(POSTURES[row] - POSTURES[row - 1])).max() / 2, np.linspace(0.0, 10.0, 100_001)
        gone = np.cumsum(np.minimum(acceleration * t, 36.0)) * 1e-4
        assert arrivals[row] - arrivals[row - 1] == pytest.approx(2.0 * np.interp(half, gone, t), abs=3e-3)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(1e-9, 6, "0.0"), (-1e-9, 6, "0.0"), (-0.1234567, 6, "-0.123457"), (1e7, 6, "10000000.0"), (30.0, 6, "30.0")],
)
def test_numbers_have_no_exponent_and_no_minus_zero(value: float, digits: int, text: str) -> None:
    assert decimal(value, 1.0, digits) == text


NAMES = {
    "plan": "plan",
    "my plan-2": "my_plan_2",
    "2nd": "armcal_2nd",
    "Test": "armcal_Test",  # a statement of RAPID
    "trynext": "armcal_trynext",
    "bas": "armcal_bas",  # which a KUKA's program calls
    "ärger": "rger",
    "": "armcal",
    "x" * 40: "x" * 24,
}


@pytest.mark.parametrize(("name", "made"), NAMES.items())
def test_a_name_is_one_in_every_language(name: str, made: str) -> None:
    for robot in LANGUAGES["robots"]:
        assert program(LIMITED, PLAN, robot, name=name)[1]["name"] == made


@pytest.mark.parametrize("robot", LANGUAGES["robots"])
def test_no_name_of_an_arm_becomes_a_statement(robot: str) -> None:
    """Line ends, quotation marks and brackets in it; comments end where the line does."""
    chain = replace(LIMITED.chain, joints=tuple(replace(j, name='a"]\n: x') for j in LIMITED.chain.joints))
    arm = replace(LIMITED, chain=chain, name='evil\nStop;\r"]}\u2028 Ölarm')
    plain, _ = program(LIMITED, PLAN, robot)
    text, _ = program(arm, PLAN, robot)
    assert text.isascii()
    assert len(text.splitlines()) == len(plain.splitlines())
    np.testing.assert_array_equal(READERS[robot](text)[0], READERS[robot](plain)[0])


def refusal(arm: Arm, robot: str, postures: np.ndarray = POSTURES, **options: object) -> str:
    with pytest.raises(InputError) as caught:
        program(arm, Plan(postures), robot, **options)
    return str(caught.value)


def test_an_arm_that_the_controller_does_not_know() -> None:
    assert refusal(Arm([300.0, 200.0]), "ur", postures=POSTURES[:, :2]).endswith("--robot ur: 2 joints, allowed: 6")
    assert "joint 1 slides" in refusal(Arm(chain_of([RAIL, *SIX[1:]]), sigma=0.05), "ur")
    ten = Arm(chain_of([*SIX, *SIX[:4]]), sigma=0.05)
    assert "10 joints, allowed: 1 to 6" in refusal(ten, "fanuc", postures=np.zeros((5, 10)))
    assert "allowed: 0 to 300" in refusal(LIMITED, "kuka", settle=float("nan"))


def test_postures_listed_for_a_dry_run_name_their_units() -> None:
    sliding = Arm(chain_of([RAIL, *SIX[1:]]), sigma=0.05)
    listed = {"abb": "Joints in mm and deg as", "kuka": "Joints in mm and deg as", "ros": "listed here in deg and mm"}
    for robot, words in listed.items():
        assert words in program(sliding, Plan(POSTURES, joint_types=sliding.joint_types), robot)[0]
    assert "listed here in deg, as PolyScope" in program(LIMITED, PLAN, "ur")[0]


def test_no_row_beyond_the_limits_of_the_controller() -> None:
    """In its own counting: what it shows, and what it allows there."""
    beyond = POSTURES.copy()
    beyond[2, 1] = LIMITED.upper[1] + np.radians(0.5)
    assert refusal(LIMITED, "ur", postures=beyond) == "row 3: joint 2 at 60.5, allowed: -100 to 60"
    counting = Counting((1, -1, 1, 1, 1, 1), (0,) * 6, (0.0, np.radians(10.0), 0.0, 0.0, 0.0, 0.0))
    turned = replace(LIMITED, counting=counting)
    assert refusal(turned, "abb", postures=beyond) == "row 3: joint 2 at -50.5, allowed: -50 to 110"


# -- a template of one's own -------------------------------------------------------------------------------------------
def test_a_template_of_ones_own_knows_what_is_documented(tmp_path: Path) -> None:
    text = """{% for m in moves if m.run %}RUN {{ m.run }} {{ m.joints|join(" ") }}
{% endfor %}{{ name }} {{ robot }} {{ speed }} {{ settle }} {{ units|length }}
{{- postures|length }}"""
    (tmp_path / "mine.j2").write_text(text)
    made, _ = program(LIMITED, PLAN, "abb", speed=7, template=tmp_path / "mine.j2")
    lines = made.splitlines()
    assert [line.split()[1] for line in lines[:3]] == ["1", "2", "3"]
    np.testing.assert_allclose(numbers(lines[2]), np.degrees(POSTURES[4]), atol=1e-6)
    assert lines[3] == "armcal abb 7 2.0 65"


BROKEN = {
    "{{ speeed }}": "'speeed' is undefined",
    "{% for %}": "line 1",
    "{{ 1 / 0 }}": "division by zero",
    "{{ ''.__class__.__mro__ }}": "unsafe",
    "{% include 'x' %}": "no loader",
    "{{ moves[99].run }}": "no element 99",
    "{{ range(10**9) }}": "Range too big",
    "{{ 'a' + 1 }}": "can only concatenate",
    "{{ '%d' % 'x' }}": "number is required",
}


@pytest.mark.parametrize(("text", "said"), BROKEN.items(), ids=str)
def test_a_template_that_does_not_work_takes_one_line(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "bad.j2").write_text(text)
    message = refusal(LIMITED, "ur", template=tmp_path / "bad.j2")
    assert message.startswith(str(tmp_path / "bad.j2"))
    assert said in message
    assert "allowed: a jinja template of the variables name, title, robot, speed" in message
