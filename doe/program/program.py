"""A plan as a program of the robot's controller: move to each posture, wait, pause for the measurement; drive through
way-points. One template a language beside this file, or a user's own.

Joints are written as the controller counts them, as the columns of a plan are. A move starts and ends at rest. Where
times are given (ROS) joints follow 10 s^3 - 15 s^4 + 6 s^5 of their way, 15/8 as fast at its fastest as on average;
other controllers speed up evenly to the speed v that is asked for and slow down so: it takes v/a more than at v.
"""

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from doe.plan.moves import rows_of, slack_of, unproven
from doe.problem.clearance import ROUNDING, Clearance
from doe.problem.constraints import constraints_of
from identification import Arm, InputError, Plan, require

FULL_SPEED = (120.0, 1000.0)  # [deg/s, mm/s] what 100 % of the speed is taken for: every axis of common arms does that
RAMP = 0.3  # [s] from rest to full speed, of common arms; --robot ur is asked for 1.4 rad/s^2
SPECIAL = re.compile(r"[^ -~]|[\"\\{}\[\];]")  # what a comment, a string or a name in some language cannot have
LANGUAGES = tomllib.loads(Path(__file__).with_name("languages.toml").read_text("utf-8"))
# what templates fail with, beside what jinja finds
FAILURES = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
# of [deg] and [mm], and digits: to 1e-7 deg and 1e-6 mm nothing is lost, and no exponent is needed
UNITS = {"rad": (np.radians(1.0), 9), "deg": (1.0, 6), "m": (1e-3, 9), "mm": (1.0, 6)}


def program(
    arm: Arm,
    plan: Plan,
    robot: str,
    *,
    speed: int = 20,
    settle: float = 2.0,
    name: str = "armcal",
    template: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """The program for the rows of an exact plan, in their order, its way-points (`Plan.via`) among them; and what it
    does, for a dry run, by the keys of files (identification/files/README.md, "JSON keys").

    robot : of languages.toml
    speed : [%] of the speed of joint moves;  settle : [s] from arrival to the measurement
    name : of the program, made one that all languages accept;  template : instead of the language's own

    Raises `InputError` for an arm that the controller does not know, rows that the arm must not be driven to, and a
    template that does not work.
    """
    from jinja2 import StrictUndefined, TemplateError
    from jinja2.sandbox import ImmutableSandboxedEnvironment

    (file, angle, length, least, most), n = LANGUAGES["robots"][robot], arm.links
    allowed = f"{least} to {most}" if least < most else least
    require(least <= n <= most, f"--robot {robot}: {n} joints, allowed: {allowed}")
    require(0.0 <= settle <= 300.0, f"--settle: {settle:g} s, allowed: 0 to 300")  # a FANUC waits 327 s at most
    plan = replace(plan, joint_types=arm.joint_types)
    columns, slides = plan.displayed, np.array([unit == "mm" for unit in plan.units])
    sliding = f"--robot ur: joint {np.argmax(slides) + 1} slides, allowed: joints that turn"
    require(robot != "ur" or not slides.any(), sliding)
    ends = np.where(slides, arm.column_limits, np.degrees(arm.column_limits))  # [deg, mm], NaN where there are none
    for row, j in np.argwhere((columns < ends[0] - 1e-4) | (columns > ends[1] + 1e-4))[:1]:  # beyond rounding of files
        place = f"row {row + 1}: joint {j + 1} at {columns[row, j]:.7g}"
        raise InputError(f"{place}, allowed: {ends[0, j]:.7g} to {ends[1, j]:.7g}")
    constraints = constraints_of(arm)
    for constraint in constraints:
        slack = np.where(plan.is_run[:, None], ROUNDING, slack_of(constraint, constraints))
        for row, k in np.argwhere(constraint.margin(plan.postures) < -slack)[:1]:
            bodies = f" of {' and '.join(constraint.pairs[k])}" if isinstance(constraint, Clearance) else ""
            broken = f"breaks the constraint {constraint.kind}{bodies}"
            raise InputError(f"row {row + 1}: {broken}, allowed: postures that keep it")
    not_free = unproven(constraints, plan.postures)

    # the moves: one from where the arm stands at first, which is not known but within the limits, then row to row
    first = np.nan_to_num(np.abs(columns[0] - ends), nan=360.0).max(axis=0)
    ways = np.abs(np.vstack([first, np.diff(columns, axis=0)]))
    fastest = np.where(slides, FULL_SPEED[1], FULL_SPEED[0]) * speed / 100.0
    moving = (ways / fastest).max(axis=1)  # [s] without speeding up
    if robot == "ros":
        moving = np.maximum(15.0 / 8.0 * moving, 0.5)  # no move without duration
    else:  # KUKA's acceleration is that share of its full one, too; a short way ends before the speed is reached
        ramp = {"ur": speed / 100.0 * np.radians(FULL_SPEED[0]) / 1.4, "kuka": RAMP}.get(robot, speed / 100.0 * RAMP)
        moving = np.where(moving > ramp, moving + ramp, 2.0 * np.sqrt(moving * ramp))
    pauses = settle * plan.is_run
    left = np.cumsum(moving + pauses)
    arrivals, departures = (np.ceil(1000.0 * each).astype(int).tolist() for each in (left - pauses, left))
    units, rows, moves, postures = [length if slide else angle for slide in slides], rows_of(plan), [], []
    doubts = {move["row"]: f", may collide: {' and '.join(move['bodies'])}" for move in not_free}
    for k, (row, q, arrival, departure) in enumerate(zip(rows, columns, arrivals, departures, strict=True), start=1):
        label, row["seconds"] = f"run {row['run']}" if row["run"] else "via", arrival / 1000.0
        move = {
            "run": row["run"] or 0,  # number of the measurement there, 0 at a way-point
            "joints": [decimal(x, *UNITS[unit]) for x, unit in zip(q, units, strict=True)],
            "arrival": arrival,  # [ms] from the start
            "departure": departure,  # after settling
            "comment": label + SPECIAL.sub("?", doubts.get(k, "")),
        }
        moves.append(move)
        postures.append(f"{k:3d} {label:8s}" + "".join(f"{x:10.3f}" for x in q + 0.0))
    identifier = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    is_name = identifier[:1].isalpha() and identifier.lower() not in LANGUAGES["reserved"].split()
    identifier = (identifier if is_name else f"armcal_{identifier}".strip("_"))[:24]
    planned = f"{len(plan.measured)} runs, {speed} % speed, {settle:g} s to settle"
    rest = f"about {departures[-1] / 60e3:.1f} min without measuring"
    variables = {
        "name": identifier,
        "title": SPECIAL.sub("?", f"armcal program: {arm.name}, {planned}, {rest}"),
        "robot": robot,
        "speed": speed,
        "joint_speed": decimal(FULL_SPEED[0] * speed / 100.0, UNITS[angle][0], 6),
        "settle": decimal(settle, 1.0, 3),
        "names": [SPECIAL.sub("_", joint.name) or f"joint_{j}" for j, joint in enumerate(arm.chain.joints, 1)],
        "units": units,
        "postures": postures,  # what the pendant shows, for a dry run
        "moves": moves,
    }
    options: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    environment = ImmutableSandboxedEnvironment(undefined=StrictUndefined, **options)  # for a user's template
    written = template or Path(__file__).with_name(file)
    try:
        text = environment.from_string(written.read_text("utf-8-sig")).render(variables)
    except OSError as error:
        raise InputError(f"{written}: cannot be read ({error.strerror}), allowed: a file that can") from None
    except UnicodeDecodeError:
        raise InputError(f"{written}: is not UTF-8, allowed: a text file in UTF-8") from None
    except (TemplateError, *FAILURES) as error:
        where = f"{written}: line {error.lineno}" if hasattr(error, "lineno") else written
        allowed = f"allowed: a jinja template of the variables {', '.join(variables)}"
        raise InputError(f"{where}: {error}, {allowed}") from None
    return text, {"name": identifier, "moves": rows, "seconds": departures[-1] / 1000.0, "not_free": not_free}


def decimal(value: float, unit: float, digits: int) -> str:
    """A number in a unit, without an exponent and without -0; at least one digit behind the point."""
    return np.format_float_positional(round(float(value) * unit, digits) + 0.0, trim="0")
