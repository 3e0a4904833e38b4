"""Strategies of plans, measurements, targets and study files that belong to an arm."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from tests.fuzz.arms import ArmText
from tests.fuzz.instruments import lengths, touching
from tests.fuzz.texts import one_in


def csv(columns: dict[str, np.ndarray | list[str]], european: bool = False) -> str:
    """The text of a table; European: semicolons and decimal commas."""
    separator, rows = (";" if european else ","), zip(*columns.values(), strict=True)
    lines = [separator.join(cell if isinstance(cell, str) else f"{cell:.9g}" for cell in row) for row in rows]
    text = "\n".join([separator.join(columns), *lines]) + "\n"
    return text.replace(".", ",") if european else text


def postures(draw: st.DrawFn, arm: ArmText, rows: int) -> np.ndarray:
    """(m, n) within the limits, or equal, or far outside, or of many turns."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    found = rng.uniform(arm.lower, arm.upper, (rows, len(arm.kinds)))
    kind = draw(st.sampled_from(["random"] * 5 + ["same", "repeated", "outside", "turns"]))
    if kind == "same":
        found[:] = found[0]
    if kind == "repeated":
        found = found[rng.integers(0, max(rows // 3, 1), rows)]
    return found * {"outside": 3.0, "turns": 1000.0}.get(kind, 1.0)


def named(arm: ArmText, values: np.ndarray, letter: str = "q") -> dict[str, np.ndarray]:
    return {f"{letter}{j}_{kind}": column for j, (kind, column) in enumerate(zip(arm.kinds, values.T, strict=True), 1)}


def conditions(draw: st.DrawFn, arm: ArmText, rows: int) -> dict[str, np.ndarray]:
    """Columns that a plan may have too."""
    found: dict[str, np.ndarray] = {}
    if draw(st.sampled_from(range(4))) == 0:
        found["payload_kg"] = np.arange(rows) % 3 * 2.5
    if draw(st.sampled_from(range(4))) == 0:
        found["temperature_C"] = np.linspace(18.0, 25.0, rows)
    if draw(st.sampled_from(range(4))) == 0:
        found |= {f"direction{j}": np.where(np.arange(rows) % (j + 1), 1, -1) for j in range(1, len(arm.kinds) + 1)}
    return found


@st.composite
def plans(draw: st.DrawFn, arm: ArmText) -> str:
    """With weights now and then."""
    rows = draw(st.sampled_from([12, 20, 30, 3, 1]))
    columns = {"run": np.arange(1, rows + 1), **named(arm, postures(draw, arm, rows)), **conditions(draw, arm, rows)}
    if draw(st.sampled_from(range(5))) == 0:
        columns["weight"] = np.full(rows, 1.0 / rows)
    return csv(columns, draw(st.sampled_from(range(8))) == 0)


@st.composite
def measurements(draw: st.DrawFn, arm: ArmText) -> str:
    """Positions that the arm has, with noise and some offsets, or none at all."""
    rows = draw(st.sampled_from([20, 40, 60, 8, 2]))
    angles = postures(draw, arm, rows)
    rng = np.random.default_rng(rows)
    size = draw(st.sampled_from([0.1, 0.1, 0.1, 0.0, 50.0, 1e6]))
    places = arm.positions(angles + draw(st.sampled_from([0.0, 0.1]))) + size * rng.standard_normal(
        (rows, 3 if arm.spatial else 2)
    )
    columns: dict = named(arm, angles) | {f"{a}_mm": c for a, c in zip("xyz", places.T, strict=False)}
    if arm.instrument and not one_in(draw, 20):
        columns = of_lengths(draw, arm, angles, places)
    columns |= conditions(draw, arm, rows) | extras(draw, arm, angles, rng)
    if arm.markers and not one_in(draw, 8):
        columns["marker"] = [str(1 + k % 2) for k in range(rows)]
    return csv(columns, draw(st.sampled_from(range(8))) == 0)


def of_lengths(draw: st.DrawFn, arm: ArmText, angles: np.ndarray, places: np.ndarray) -> dict:
    """Columns of distances, or of contacts with one or two surfaces."""
    if arm.instrument == "distance":
        return named(arm, angles) | lengths(draw, places)
    surface = np.arange(len(angles)) % (1 + draw(st.booleans()))
    columns: dict = named(arm, touching(arm.instrument, arm.positions, angles, surface))
    return columns | ({"surface": [f"side {k}" for k in surface]} if surface.any() or one_in(draw, 2) else {})


def extras(draw: st.DrawFn, arm: ArmText, angles: np.ndarray, rng: np.random.Generator) -> dict:
    """Columns of measurements alone: order, sessions, markers, orientations, commands, sigma."""
    rows = len(angles)
    every = {
        "order": {"order": np.arange(rows)},
        "time": {"time_s": np.arange(rows) * 7.5},
        "session": {"session": [f"day {1 + 2 * k // rows}" for k in range(rows)]},
        "posture": {"posture": np.arange(rows) // 2},
        "sigma": {"sigma_mm": np.full(rows, 0.1)},
        "commanded": named(arm, angles + 0.01, "commanded"),
        "unknown": {"note": ["a<b>"] * rows},
        "marker": {"marker": [str(1 + k % 2) for k in range(rows)]},
        "angles": {f"r{axis}_deg": rng.uniform(-90.0, 90.0, rows) for axis in "xyz"},
        "quaternion": {f"q{part}": rng.standard_normal(rows) for part in "wxyz"},
    }
    chosen = draw(st.lists(st.sampled_from(list(every)), max_size=3, unique=True))
    return {name: column for key in chosen for name, column in every[key].items()}


@st.composite
def targets(draw: st.DrawFn, arm: ArmText) -> str:
    """Positions within reach and beyond, or postures, or both, with orientations now and then."""
    rows = draw(st.sampled_from([5, 1, 12]))
    angles = postures(draw, arm, rows)
    places = arm.positions(angles) * draw(st.sampled_from([1.0, 1.0, 0.0, 100.0, 1e295]))
    columns: dict = {f"{a}_mm": c for a, c in zip("xyz", places.T, strict=False)}
    kind = draw(st.sampled_from(["positions", "postures", "both", "poses"]))
    if kind in ("postures", "both"):
        columns = {**(columns if kind == "both" else {}), **named(arm, angles)}
    if kind == "poses":
        columns |= {f"r{axis}_deg": np.linspace(-90.0, 90.0, rows) for axis in "xyz"}
    return csv(columns)


@st.composite
def studies(draw: st.DrawFn, arm: ArmText) -> str:
    """A small study of one or two plans."""
    known = ["random", "best_of_random", "plan.csv", "exchange", *(() if arm.spatial else ("dft",))]
    plan = st.sampled_from(["fedorov", "none", "../plan.csv"] if one_in(draw, 12) else known)
    lines = [
        'arms = ["arm.toml"]',
        "plans = [" + ", ".join(f'"{draw(plan)}"' for _ in range(draw(st.integers(1, 2)))) + "]",
    ]
    few = 3 if arm.spatial else 1  # equations of a row make up for the parameters
    runs = [f"[{12 * few}]", f"[{10 * few}, {20 * few}]", f"[{8 * few}]"]
    lines += [f"runs = {draw(st.sampled_from(['[1]', '[]'] if one_in(draw, 12) else runs))}", "solver_seconds = 0.2"]
    lines += [f"replications = {draw(st.sampled_from(['1', '5', '20']))}"]
    if draw(st.booleans()):
        lines.append("sigma_mm = [0.1]")
    planar, spatial = (
        f"length_errors_mm = [{', '.join(['0.5'] * len(arm.kinds))}]",
        'values = {"joint_offset:2" = 0.2}',
    )
    if draw(st.sampled_from(range(3))) == 0:
        lines.append(f'[[truths]]\nname = "t"\n{spatial if arm.spatial is not one_in(draw, 12) else planar}')
    if draw(st.sampled_from(range(3))) == 0:
        effect = "base_drift" if arm.spatial else "base_offset"
        lines.append(f'[[models]]\nname = "m"\neffects = [{{name = "{effect}"}}]')
    return "\n".join(lines) + "\n"
