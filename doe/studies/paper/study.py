"""`armcal study paper`: everything of the paper, in parts that run on any workers and are kept as they finish; and the
paper's mistakes, each shown by numbers: how far the printed statement is from the truth, and how far ours.

The truth comes from finite differences of eq. 1 and 3, from the information matrix itself, or from simulation, never
from the statement under test (doe/README.md, "Errata").
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from doe.jobs.rows import Key, Row, frame_of, parquet
from doe.jobs.running import Job, Workers
from doe.studies.monte_carlo.specification import Study
from doe.studies.monte_carlo.study import dft_postures, run_study
from doe.studies.paper import tables
from doe.studies.paper.tables import (
    JOINT_OFFSETS_DEG,
    LENGTH_ERRORS,
    LENGTHS,
    PAPER,
    SIGMA,
    ideal_std,
    paper_arm,
    paper_truth,
)
from identification import Array, InputError, JobError, Model, Progress, estimate, silent, spectrum
from identification.files.io import check_writable, write_together
from identification.simulate import simulate

L = np.array(LENGTHS)
LENGTHENED = L + LENGTH_ERRORS  # [mm]
TURNED = np.cumsum(np.radians(JOINT_OFFSETS_DEG))  # orientation offsets [rad]


class Shown(NamedTuple):
    """Relative distance of what is printed, and of its correction, from the truth; accuracy of the check."""

    printed_error: float
    correct_error: float
    tolerance: float

    @property
    def confirmed(self) -> bool:
        """True if the numbers show both that the statement is wrong and that the correction is right."""
        # rounding in the paper explains less than one per cent
        return bool(self.printed_error > 0.01 and self.correct_error <= self.tolerance)


Check = Callable[[np.random.Generator, int], Shown]  # by random plans, or so many simulated calibrations


def distance(value: Array | float, truth: Array | float) -> float:
    """Largest difference, relative to the largest true value."""
    return float(np.max(np.abs(np.asarray(value) - truth)) / np.max(np.abs(truth)))


def optimal_orientations(runs: int, links: int = 4) -> Array:
    """(m, n) theta_j = 2 pi i j / m [rad] of the optimal plan."""
    return np.cumsum(dft_postures(links, runs), axis=1)


def random_orientations(generator: np.random.Generator) -> Array:
    """(6, 4) [rad]"""
    return generator.uniform(-np.pi, np.pi, (6, 4))


def tips(theta: Array, lengths: Array, turned: Array) -> Array:
    """(m,) x + iy of eq. 1 at orientations theta (m, n) [rad]."""
    return np.exp(1j * (theta + turned)) @ lengths


def blocks(theta: Array) -> tuple[Array, Array, Array]:
    """Sum J^T J by its columns (orientations first, as eq. 7), and C, S of eq. 18."""
    x_turn, y_turn = -L * np.sin(theta), L * np.cos(theta)
    jacobian = np.concatenate([np.hstack([x_turn, np.cos(theta)]), np.hstack([y_turn, np.sin(theta)])])
    difference = theta[:, :, None] - theta[:, None, :]
    return jacobian.T @ jacobian, np.cos(difference).sum(axis=0), np.sin(difference).sum(axis=0)


# (runs, parameter) -> as eq. 24 has it, and sigma^2 / m diag(L^-2, I)
COVARIANCE = {(20, f"length_error:{j}"): (SIGMA, ideal_std(4, 20, f"length_error:{j}")) for j in range(1, 5)}
for _j, _length in enumerate(LENGTHENED, start=1):
    _scaled = SIGMA * np.sqrt(20.0) * _length, SIGMA / np.sqrt(20.0) / _length
    COVARIANCE[20, f"orientation_offset:{_j}"] = float(np.degrees(_scaled[0])), float(np.degrees(_scaled[1]))
OF_JOINTS = {  # eq. 25 of joint offsets, for which it is printed, and what they have
    (20, f"joint_offset:{j}"): (ideal_std(4, 20, f"orientation_offset:{j}"), ideal_std(4, 20, f"joint_offset:{j}"))
    for j in range(2, 5)
}


def deviations(links: int, expected: Mapping[tuple[int, str], tuple[float, float]], room: float = 0.0) -> Check:
    """The check of deviations of the optimal plan, (runs, parameter) -> printed and correct [mm, deg], by simulated
    calibrations;  room : more than their scatter that the correct ones may be off."""

    def check(generator: np.random.Generator, replications: int) -> Shown:
        runs, truth = sorted({runs for runs, _ in expected}), paper_truth(links)
        study = Study([paper_arm(links)], ["dft"], runs, truths=[truth], replications=replications)
        cells = run_study(study, seed=int(generator.integers(2**31))).cells
        simulated = {(row["runs"], row["parameter"]): row["std"] for row in cells.iter_rows(named=True)}
        ratios = np.array([np.array(values) / simulated[place] for place, values in expected.items()])
        wrong, right = np.abs(ratios - 1.0).T.tolist()
        return Shown(min(wrong), max(right), 4.5 / np.sqrt(2.0 * replications) + room)

    return check


def no_closed_form(generator: np.random.Generator, replications: int) -> Shown:
    """The closed form equals the converged iteration of Section III, on noisy data of the paper's arm; both errors here
    in standard deviations sigma / sqrt(m)."""
    model, truth = Model(paper_arm()), paper_truth().of(paper_arm())
    postures = generator.uniform(-np.pi, np.pi, (20, 4))
    data = simulate(truth, postures, generator)
    exact, steps = (estimate(model, data, method=method).parameters for method in ("linear", "paper_steps"))
    # the linearised step that eq. 11 would be without repeating it
    jacobian = model.jacobian(postures).reshape(-1, 8)
    once = np.linalg.lstsq(jacobian, (data.positions - model.position(postures)).ravel(), rcond=None)[0]
    unit = model.scales / (SIGMA / np.sqrt(20.0))
    wrong, right = (float(np.max(np.abs((values - steps) * unit))) for values in (once, exact))
    return Shown(wrong, right, 1e-8)


def derivative_of_the_sum(generator: np.random.Generator, replications: int) -> Shown:
    """dF/d dtheta_k by central differences, against eq. 4 (a sum over links) and against link k alone."""
    theta = random_orientations(generator)
    measured = tips(theta, LENGTHENED, TURNED) + generator.standard_normal(6) + 1j * generator.standard_normal(6)
    k, step = 1, 1e-5 * np.eye(4)[1]
    up, down = (np.sum(np.abs(tips(theta, L, TURNED + sign * step) - measured) ** 2) for sign in (1.0, -1.0))
    truth = float(up - down) / 2e-5 / 2.0  # eq. 4 leaves the factor 2 out
    links = np.exp(1j * (theta + TURNED)) * L
    rest = tips(theta, L, TURNED) - measured
    by_link = np.real(np.conj(1j * links) * rest[:, None]).sum(axis=0)
    return Shown(distance(by_link[k:].sum(), truth), distance(by_link[k], truth), 1e-7)


def last_column_of_the_jacobian(generator: np.random.Generator, replications: int) -> Shown:
    """dy/d dtheta_n by central differences, against l_j cos theta_j for the other links."""
    theta = random_orientations(generator)
    step = 1e-5 * np.eye(4)[3]
    truth = np.imag(tips(theta, L, step) - tips(theta, L, -step)) / 2e-5
    entries = L * np.cos(theta)
    return Shown(min(distance(entries[:, j], truth) for j in range(3)), distance(entries[:, 3], truth), 1e-8)


def size_of_the_noise(generator: np.random.Generator, replications: int) -> Shown:
    """Length of eps_a = [eps_1 .. eps_m], two coordinates each."""
    m, n = 10, 4
    length = float(generator.standard_normal((m, 2)).size)
    return Shown(distance(2.0 * n, length), distance(2.0 * m, length), 0.0)


def off_diagonal_blocks(generator: np.random.Generator, replications: int) -> Shown:
    """The blocks of sum J^T J, against B = L S printed and B = -L S."""
    total, _, s = blocks(random_orientations(generator))
    b, c, ls = total[:4, 4:], total[4:, :4], L[:, None] * s
    return Shown(min(distance(ls, b), distance(ls, c)), max(distance(-ls, b), distance(s * L, c)), 1e-12)


def scaling_of_the_criterion(generator: np.random.Generator, replications: int) -> Shown:
    """det C' of the optimal plan must be 1 (Section V); m = 10, n = 4."""
    _, c, _ = blocks(optimal_orientations(10))
    by_links, by_runs = (distance(float(np.linalg.det(c / count)), 1.0) for count in (4, 10))
    return Shown(by_links, by_runs, 1e-12)


def d_optimality_and_units(generator: np.random.Generator, replications: int) -> Shown:
    """Difference of log det between two plans, in metres and degrees instead of millimetres and radians."""
    first, second = (blocks(random_orientations(generator))[0] for _ in range(2))
    units = np.diag(np.r_[np.full(4, np.pi / 180.0), np.full(4, 1000.0)])

    def gain(a: Array, b: Array) -> float:
        return float(np.linalg.slogdet(a)[1] - np.linalg.slogdet(b)[1])

    traces = [float(np.trace(np.linalg.inv(total))) for total in (first, second)]  # printed: no difference
    converted = gain(units @ first @ units, units @ second @ units)
    return Shown(distance(traces[0], traces[1]), distance(converted, gain(first, second)), 1e-9)


def criterion_without_teeth(generator: np.random.Generator, replications: int) -> Shown:
    """det D' of a plan of three links with det C' = 1 and det S' = 0; then of one with eq. 21. D-optimal plans have 1.

    Joint 2 on 30 and 150 degrees, joint 3 on four angles a quarter turn apart, all eight pairs: h_2 = i/2, h_3 = 0, so
    C' = 1, and S', antisymmetric of odd size, is singular as that of every plan.
    """
    q2, q3 = np.meshgrid(np.radians([30.0, 150.0]), np.radians([0.0, 90.0, 180.0, 270.0]), indexing="ij")
    satisfied = np.cumsum(np.stack([np.zeros(8), q2.ravel(), q3.ravel()], axis=1), axis=1)

    def determinants(theta: Array) -> tuple[float, ...]:
        h = np.exp(-1j * theta).T @ np.exp(1j * theta) / len(theta)
        return tuple(float(np.linalg.det(part).real) for part in (h.real, h.imag, h))

    det_c, det_s, det_h = determinants(satisfied)
    best = abs(det_c - 1.0) < 1e-12 and abs(det_s) < 1e-12
    optimal = determinants(optimal_orientations(8, 3))[2]
    return Shown(distance(det_h**2, 1.0) if best else 0.0, distance(optimal**2, 1.0), 1e-12)


def names_in_table_1(generator: np.random.Generator, replications: int) -> Shown:
    """Row "4 links": c_24 read as its index says, the angle between links that q2 and q4 (or q2 + q4) would be."""
    theta = random_orientations(generator)
    q = np.diff(theta, axis=1, prepend=0.0)
    element = float(blocks(theta)[0][4, 7])  # lengths 1 and 4: sum cos(theta_1 - theta_4)
    wrong, right = (float(np.cos(angle).sum()) for angle in (q[:, 1] + q[:, 3], q[:, 1:].sum(axis=1)))
    return Shown(distance(wrong, element), distance(right, element), 1e-10)


def four_links_three_points(generator: np.random.Generator, replications: int) -> Shown:
    """Largest rank of the Jacobian of 4 links over random plans with 3 points."""
    model = Model(paper_arm(4))
    plans = generator.uniform(-np.pi, np.pi, (100, 3, 4))
    rank = float(max(spectrum(model.jacobian(plan), model.scales).rank for plan in plans))
    return Shown(distance(8.0, rank), distance(6.0, rank), 0.0)


ONE_LENGTH = "length_error:1"
# of the errata in paper.toml, in their order
CHECKS: tuple[Check, ...] = (
    no_closed_form,
    derivative_of_the_sum,
    last_column_of_the_jacobian,
    size_of_the_noise,
    off_diagonal_blocks,
    scaling_of_the_criterion,
    d_optimality_and_units,
    criterion_without_teeth,
    deviations(4, COVARIANCE),
    deviations(4, OF_JOINTS, room=0.006),  # nominal lengths instead of true ones: 0.6 % for link 1
    names_in_table_1,
    deviations(2, {(20, ONE_LENGTH): (0.058, ideal_std(2, 20, ONE_LENGTH))}),
    four_links_three_points,
    deviations(
        4, {(m, ONE_LENGTH): (printed, ideal_std(4, m, ONE_LENGTH)) for m, printed in ((4, 0.022), (20, 0.005))}
    ),
    deviations(4, {(100, ONE_LENGTH): (0.001, ideal_std(4, 100, ONE_LENGTH))}),
)


def errata(replications: int = 10_000, seed: int = 0, numbers: Sequence[int] | None = None) -> pl.DataFrame:
    """One row per erratum: place, printed, correct, the fields of `Shown`, and `confirmed`. `numbers`: places in
    `CHECKS`, None: all."""
    rows = []
    for k in range(len(CHECKS)) if numbers is None else numbers:
        shown = CHECKS[k](np.random.default_rng([seed, k]), replications)
        rows.append({**PAPER["errata"][k], **shown._asdict(), "confirmed": shown.confirmed})
    return frame_of(rows)


# -- everything together -----------------------------------------------------------------------------------------------
# what takes long comes in pieces
PIECES: dict[str, Any] = {
    **dict.fromkeys(("table_1", "table_2"), (None,)),
    "table_3": tables.ARM_NAMES,
    "text": (None,),
    "errata": range(len(CHECKS)),
    "figure_1": (None,),
    "figure_2": tables.RUNS,
}
PARTS = "parts.parquet"
ALLOWED = 100, 100_000  # replications


@dataclass(frozen=True)
class PaperStudy:
    """Everything of the paper, computed again.

    tables : by the names in `PIECES`
    """

    tables: dict[str, pl.DataFrame]

    @property
    def passed(self) -> bool:
        """Whether theory and simulation agree everywhere and every erratum is confirmed."""
        return tables.consistent(self.tables["table_3"]) and bool(self.tables["errata"]["confirmed"].all())


def paper_study(
    replications: int | None = None,
    folder: Path | None = None,
    workers: Workers | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> PaperStudy:
    """Everything of the paper.

    replications : simulated calibrations per table entry;  folder : for a Parquet file of each table
    Raises `InputError` for too few replications to estimate a deviation, or more than memory holds; `JobError` with the
    reason if a part failed.
    """
    least, most = ALLOWED
    if replications is not None and not least <= replications <= most:
        raise InputError(f"--replications: found {replications}, allowed for the paper: {least} to {most:,}")
    common = {"replications": replications or tables.REPLICATIONS, "seed": seed}
    keys: list[Key] = [{"table": name, "piece": piece, **common} for name, pieces in PIECES.items() for piece in pieces]
    rows: dict[str, list[Row]] = {name: [] for name in PIECES}
    options: dict[str, Any] = {"seed": seed, "resume": resume, "force": force, "progress": progress}
    with Job.open(folder, (PARTS,), workers, **options) as job:
        for name in PIECES if folder is not None else ():
            check_writable(folder / f"{name}.parquet", resume or force)  # type: ignore[operator]
        table = job.tables[PARTS]
        table.rows = {key: done for key, done in table.rows.items() if done[0]["status"] == "done"}
        for row in job.run(part, keys, PARTS).iter_rows(named=True):
            if row["status"] != "done":
                raise JobError(f"{row['table']}: {row['error']}; go on with --resume")
            rows[row["table"]] += json.loads(row["rows"])
    frames = {name: frame_of(entries) for name, entries in rows.items()}
    if folder is not None:
        files: dict[Path, str | bytes] = {folder / f"{name}.parquet": parquet(frame) for name, frame in frames.items()}
        write_together(files, force=True)
    return PaperStudy(frames)


def part(key: dict[str, Any], _: np.random.SeedSequence) -> list[Row]:
    """A piece of a table as one row: its own rows as JSON, as tables differ in their columns."""
    number, seed, piece = key["replications"], key["seed"], (key["piece"],)
    made = {
        "table_1": tables.table_1,
        "table_2": tables.table_2,
        "table_3": lambda: tables.table_3(number, seed, piece),
        "text": tables.text_figures,
        "errata": lambda: errata(number, seed, piece),
        "figure_1": lambda: tables.figure_1(number, seed),
        "figure_2": lambda: tables.figure_2(number, seed, piece),
    }
    return [{"rows": json.dumps(made[key["table"]]().to_dicts())}]
