"""`armcal study paper`: the paper's Tables I to III, Figures 1 and 2, the numbers in its text and its mistakes,
computed again: what it prints (paper.toml), what comes out.

Klimchik, Wu, Caro, Pashkevich, "Design of Experiments for Calibration of Planar Anthropomorphic Manipulators". Every
table is one row per printed statement:

`place`, `links`, `runs`, `item`, `unit` : what the statement is about
`printed` : the paper's figure;  `theory` : that of our own derivation (doe/README.md, "Errata")
`simulated`, `standard_error` : the figure from simulated calibrations
`verdict` : "agrees" (to one unit of the last printed digit), "erratum", "not identifiable", or "added" where the paper
    has no figure
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.bounds.planar_theorem import pair_means
from doe.criteria import information_matrix
from doe.jobs import Row, frame_of
from doe.studies.monte_carlo import Study, TruthTable, dft_postures, run_study
from identification import (
    Arm,
    Array,
    InputError,
    Measurements,
    Model,
    Progress,
    estimate,
    estimate_batch,
    estimate_each,
    planar_chain,
    silent,
    spectrum,
)

PAPER = tomllib.loads(Path(__file__).with_name("paper.toml").read_text())
LENGTHS, LENGTH_ERRORS = np.array(PAPER["lengths_mm"]), np.array(PAPER["length_errors_mm"])
JOINT_OFFSETS_DEG, SIGMA = PAPER["joint_offsets_deg"], PAPER["sigma_mm"]
LENGTHENED = LENGTHS + LENGTH_ERRORS  # [mm]
TURNED = np.cumsum(np.radians(JOINT_OFFSETS_DEG))  # orientation offsets [rad]
REPLICATIONS = 10_000
RUNS = tuple(range(4, 21))  # the axis of Figure 2


def paper_arm(links: int = 4, limited: bool = False) -> Arm:
    """The first links of the paper's arm; `limited`: within the joint limits of doe/README.md, "Planar theorem"."""
    lower, upper = (np.radians(PAPER["joint_limits_deg"][side][:links]) for side in ("lower", "upper"))
    chain, name = planar_chain(LENGTHS[:links]), f"{links} links"
    if limited:
        return Arm(chain, lower, upper, SIGMA, f"{name} within joint limits")
    return Arm(chain, sigma=SIGMA, name=name)


def paper_truth(links: int = 4) -> dict[str, Any]:
    """The paper's deviations of the first links, as in a study file."""
    errors = {"length_errors_mm": LENGTH_ERRORS, "joint_offsets_deg": JOINT_OFFSETS_DEG}
    return {"name": "paper"} | {key: list(map(float, values[:links])) for key, values in errors.items()}


def ideal_std(links: int, runs: int, parameter: str) -> float:
    """Eq. 25, which is about the orientation of link j, and its consequence for joint offsets, at the nominal lengths
    [mm, deg]: dq_j = dtheta_j - dtheta_(j-1) (identification/README.md, "Covariance and intervals")."""
    name, _, number = parameter.partition(":")
    if name == "length_error":
        return SIGMA / float(np.sqrt(runs))
    of_link = np.degrees(SIGMA / np.sqrt(runs) / LENGTHS[:links])
    if name == "joint_offset":
        of_link = np.sqrt(of_link**2 + np.r_[0.0, of_link[:-1] ** 2])
    return float(of_link[int(number) - 1])


def agreement(printed: float | None, theory: float) -> str:
    """Whether a printed figure is ours to one unit of its last digit: 0.0276 is printed as 0.027 or as 0.028."""
    if printed is None:
        return "added"
    return "agrees" if abs(printed - theory) < 0.001 else "erratum"  # three decimals are printed


# -- tables and figures ------------------------------------------------------------------------------------------------
def table_1(runs: int = 20) -> pl.DataFrame:
    """One row per pair of links of the arms with 2, 3 and 4 links: the condition, whether the paper prints it, the
    residual |mean exp(i sum q)| of the plan theta_j = 2 pi i j / m."""
    rows = []
    for links, printed in zip((2, 3, 4), PAPER["table_1"].values(), strict=True):
        sums = pair_means(dft_postures(links, runs))
        for j, k in combinations(range(1, links + 1), 2):
            name = " + ".join(f"q{i}" for i in range(j + 1, k + 1))
            row = {"place": "Table I", "links": links, "item": f"sum of exp(i ({name})) = 0"}
            row |= {"printed": name in printed, "residual": abs(sums[j, k])}
            rows.append(row | {"verdict": "agrees" if name in printed else "erratum"})
    return frame_of(rows)


def table_2(runs: int = 20) -> pl.DataFrame:
    """sum J^T J of the optimal plan by the model against diag(m l_1^2, .., m, ..), as printed, in orientation offsets.

    `off_diagonal` : its largest element off the diagonal, scaled;  `diagonal_error` : largest relative error on it
    """
    rows = []
    for links in (2, 3, 4):
        jacobian = Model(paper_arm(links)).jacobian(dft_postures(links, runs))
        # columns by joint offsets are sums of those by orientations (eq. 8): difference them
        by_orientation = -np.diff(jacobian[..., links:], axis=-1, append=0.0)
        total = information_matrix(np.concatenate([by_orientation, jacobian[..., :links]], axis=-1))
        printed = np.r_[runs * LENGTHS[:links] ** 2, np.full(links, float(runs))]
        scaled = total / np.sqrt(np.outer(printed, printed))
        row: Row = {"place": "Table II", "links": links, "runs": runs, "item": "sum J^T J = diag(m l^2, m)"}
        row["diagonal_error"] = float(np.max(np.abs(np.diag(scaled) - 1.0)))
        row["off_diagonal"] = float(np.max(np.abs(scaled - np.diag(np.diag(scaled)))))
        rows.append(row | {"verdict": "agrees" if np.allclose(scaled, np.eye(2 * links), atol=1e-12) else "erratum"})
    return frame_of(rows)


def table_3(replications: int = REPLICATIONS, seed: int = 0) -> pl.DataFrame:
    """Table III by simulation, and what it leaves out: joint offsets, 4 links with 4 runs, joint limits.

    Theory is eq. 25 with the TRUE lengths l_j + dl_j, which simulation follows: a difference of 0.6 % at most.
    """
    rows: list[Row] = []
    for links, limited in ((2, False), (3, False), (4, False), (4, True)):
        grid: dict[str, Any] = {"runs": [4, 20] if limited else [3, 4, 20], "truths": [paper_truth(links)]}
        plans = ["exchange_ipopt" if limited else "dft"]
        study = Study.of([paper_arm(links, limited)], plans, replications=replications, **grid)
        for row in run_study(study, seed=seed).cells.iter_rows(named=True):
            case = {"place": "joint limits" if limited else "Table III", "links": links, "runs": row["runs"]}
            printed: dict[str, float] = {}
            for entry in PAPER["table_3"] if not limited else ():
                if (entry["links"], entry["runs"]) == (links, row["runs"]):
                    printed |= {f"length_error:{j}": entry["length"] for j in range(1, links + 1)}
                    printed |= {f"orientation_offset:{j}": v for j, v in enumerate(entry["orientations"], start=1)}
            if row["status"] != "done":  # fewer equations than unknowns
                lost: Row = {"note": f"{2 * row['runs']} equations, {2 * links} unknowns: {row['error']}"}
                for item, value in printed.items():
                    lost |= {"item": item, "unit": "mm" if item.startswith("length") else "deg", "printed": value}
                    rows.append(case | lost | {"verdict": "not identifiable"})
                continue
            ideal = ideal_std(links, row["runs"], row["parameter"])
            case |= {"item": row["parameter"], "unit": row["unit"], "printed": printed.get(row["parameter"])}
            case |= {"theory": row["expected_std"], "ideal": ideal, "simulated": row["std"]}
            case["standard_error"] = row["std_se"]
            rows.append(case | {"verdict": agreement(case["printed"], ideal), "note": None})
    return frame_of(rows)


def consistent(table: pl.DataFrame) -> bool:
    """Whether simulation and theory agree in every row that has both, to 4.5 standard errors, independently of the
    paper: of 100 rows from one fixed seed, one is beyond that by chance once in 1,500 times."""
    rows = table.drop_nulls(["simulated", "theory"])
    return bool(((rows["simulated"] - rows["theory"]).abs() <= 4.5 * rows["standard_error"]).all())


def text_figures() -> pl.DataFrame:
    """The numbers of Section VI's text, by eq. 25; simulation confirms the same formula in `table_3`."""
    rows = []
    for entry in PAPER["text"]:
        item, printed, theory = entry["item"], entry.get("printed"), ideal_std(4, entry["runs"], entry["item"])
        row = {"place": entry["place"], "links": 4, "runs": entry["runs"], "item": item}
        row |= {"unit": "mm" if item == "length_error" else "deg", "printed": printed, "theory": theory}
        rows.append(row | {"verdict": agreement(printed, theory)})
    return frame_of(rows)


def figure_1(plans: int = REPLICATIONS, seed: int = 0, runs: int = 10, links: int = 4) -> pl.DataFrame:
    """Figure 1: the determinants of random plans, one row per plan; the optimal plan has 1, 1 and 0.

    `det_d` : of D', the normalised information matrix (eq. 19, = |det H|^2);  `det_c`, `det_s` : of C' and S' (eq. 20,
    divided by m). D* asks for det C' = 1 and det S' = 0. For an odd number of links det S' = 0 for EVERY plan, S being
    antisymmetric: there D* does not see S at all.
    """
    generator = np.random.default_rng([seed, 1])
    z = np.exp(1j * np.cumsum(generator.uniform(-np.pi, np.pi, (plans, runs, links)), axis=-1))
    h = np.swapaxes(z.conj(), -1, -2) @ z / runs
    d, c, s = np.abs(np.linalg.det(h)) ** 2, np.linalg.det(h.real), np.linalg.det(h.imag)
    return pl.DataFrame({"plan": np.arange(plans), "det_d": d, "det_c": c, "det_s": s})


def figure_2(replications: int = REPLICATIONS, seed: int = 0, runs: Sequence[int] = RUNS) -> pl.DataFrame:
    """Figure 2: deviations of the length and the orientation of every link against m, one row per m and parameter.

    `optimal` : curve 1, eq. 25;  `optimal_simulated` : "x", simulated fits of the optimal plan
    `ordinary` : "o", simulated fits of one random plan, the same links turned at random
    `random_mean` : curve 2, mean over as many random plans of the plan's deviation, from one simulated fit of each:
        sqrt(pi / 2) times the mean size of the error, which for normal errors of deviation s is s. (The root mean
        square would be infinite at m = 4: 1/det H has no mean there.)
    `joint_offset` : of the joint offset, which the paper does not show; null for lengths
    """
    model, truth = Model(paper_arm()), Model(TruthTable(**paper_truth()).of(paper_arm()))

    def errors(plans: Array) -> Array:
        """(K, 8) of lengths [mm] and orientation offsets [deg] of fits on one plan (m, 4) or on plans (K, m, 4)."""
        exact = truth.position(plans.reshape(-1, 4)).reshape(*plans.shape[:-1], 2)
        positions = exact + SIGMA * generator.standard_normal((replications, plans.shape[-2], 2))
        fits = estimate_batch(model, plans, positions) if plans.ndim == 2 else estimate_each(model, plans, positions)
        turned = np.cumsum(fits.parameters[:, 4:] - np.radians(JOINT_OFFSETS_DEG), axis=1)
        turned = (turned + np.pi) % (2.0 * np.pi) - np.pi
        return np.hstack([fits.parameters[:, :4] - LENGTH_ERRORS, np.degrees(turned)])

    frames = []
    for m in runs:
        generator = np.random.default_rng([seed, 2, m])
        ordinary = generator.uniform(-np.pi, np.pi, (m, 4))
        random_plans = generator.uniform(-np.pi, np.pi, (replications, m, 4))
        x, o, every = (errors(plan) for plan in (dft_postures(4, m), ordinary, random_plans))
        items = [f"{name}:{j}" for name in ("length_error", "orientation_offset") for j in range(1, 5)]
        columns: Row = {"item": items, "unit": ["mm"] * 4 + ["deg"] * 4}
        columns |= {"optimal": [ideal_std(4, m, item) for item in items], "optimal_simulated": np.std(x, axis=0)}
        columns |= {"ordinary": np.std(o, axis=0), "random_mean": np.sqrt(np.pi / 2.0) * np.mean(np.abs(every), axis=0)}
        columns["joint_offset"] = [None] * 4 + np.std(np.diff(x[:, 4:], axis=1, prepend=0.0), axis=0).tolist()
        frames.append(pl.DataFrame({"runs": [m] * 8, **columns}))
    return pl.concat(frames)


# -- errata ------------------------------------------------------------------------------------------------------------
# Errors relative to the truth of what is printed, and of its correction, and the tolerance of the latter. The truth is
# from finite differences of eq. 1 and 3, from the information matrix itself, or from simulation, never from the
# statement under test.
Shown = tuple[float, float, float]


def distance(value: Array | float, truth: Array | float) -> float:
    """Largest difference, relative to the largest true value."""
    return float(np.max(np.abs(np.asarray(value) - truth)) / np.max(np.abs(truth)))


def tips(theta: Array, lengths: Array, turned: Array) -> Array:
    """(m,) x + iy of eq. 1 at orientations theta (m, n) [rad]."""
    return np.exp(1j * (theta + turned)) @ lengths


def blocks(theta: Array) -> tuple[Array, Array, Array]:
    """Sum J^T J by its columns (orientations first, as eq. 7), and C, S of eq. 18."""
    x_turn, y_turn = -LENGTHS * np.sin(theta), LENGTHS * np.cos(theta)
    jacobian = np.concatenate([np.hstack([x_turn, np.cos(theta)]), np.hstack([y_turn, np.sin(theta)])])
    difference = theta[:, :, None] - theta[:, None, :]
    return jacobian.T @ jacobian, np.cos(difference).sum(axis=0), np.sin(difference).sum(axis=0)


def by_algebra(place: str, generator: np.random.Generator) -> Shown:
    """Of statements about every plan, by random ones of the paper's arm."""

    def random_plan() -> Array:
        return generator.uniform(-np.pi, np.pi, (6, 4))

    match place:
        # the closed form equals the converged iteration of Section III, on noisy data; in deviations sigma / sqrt(m)
        case "before eq. 6":
            model, truth = Model(paper_arm()), Model(TruthTable(**paper_truth()).of(paper_arm()))
            postures = generator.uniform(-np.pi, np.pi, (20, 4))
            noise = SIGMA * generator.standard_normal((20, 2))
            data = Measurements(postures, truth.position(postures) + noise)
            exact, steps = (estimate(model, data, method=method).parameters for method in ("linear", "paper_steps"))
            # the linearised step that eq. 11 would be without repeating it
            jacobian = model.jacobian(postures).reshape(-1, 8)
            once = np.linalg.lstsq(jacobian, (data.positions - model.position(postures)).ravel(), rcond=None)[0]
            unit = model.scales / (SIGMA / np.sqrt(20.0))
            wrong, right = (float(np.max(np.abs((values - steps) * unit))) for values in (once, exact))
            return wrong, right, 1e-8
        case "eq. 4":  # dF/d dtheta_k by central differences, against a sum over links and against link k alone
            theta = random_plan()
            errors = generator.standard_normal(6) + 1j * generator.standard_normal(6)
            measured = tips(theta, LENGTHENED, TURNED) + errors
            k, step = 1, 1e-5 * np.eye(4)[1]
            up, down = (np.sum(np.abs(tips(theta, LENGTHS, TURNED + h) - measured) ** 2) for h in (step, -step))
            slope = float(up - down) / 2e-5 / 2.0  # eq. 4 leaves the factor 2 out
            links = np.exp(1j * (theta + TURNED)) * LENGTHS
            by_link = np.real(np.conj(1j * links) * (tips(theta, LENGTHS, TURNED) - measured)[:, None]).sum(axis=0)
            return distance(by_link[k:].sum(), slope), distance(by_link[k], slope), 1e-7
        case "eq. 8":  # dy/d dtheta_n by central differences, against l_j cos theta_j for the other links
            theta, step = random_plan(), 1e-5 * np.eye(4)[3]
            column = np.imag(tips(theta, LENGTHS, step) - tips(theta, LENGTHS, -step)) / 2e-5
            entries = LENGTHS * np.cos(theta)
            return min(distance(entries[:, j], column) for j in range(3)), distance(entries[:, 3], column), 1e-8
        case "eq. 15-16":  # length of eps_a = [eps_1 .. eps_m], two coordinates each, of m = 10 points and n = 4 links
            length = float(generator.standard_normal((10, 2)).size)
            return distance(2.0 * 4, length), distance(2.0 * 10, length), 0.0
        case "eq. 17-19":  # the blocks of sum J^T J, against B = L S printed and B = -L S
            total, _, s = blocks(random_plan())
            b, c, ls = total[:4, 4:], total[4:, :4], LENGTHS[:, None] * s
            return min(distance(ls, b), distance(ls, c)), max(distance(-ls, b), distance(s * LENGTHS, c)), 1e-12
        case "eq. 20":  # det C' of the optimal plan must be 1 (Section V); m = 10, n = 4
            _, c, _ = blocks(np.cumsum(dft_postures(4, 10), axis=1))
            by_links, by_runs = (distance(float(np.linalg.det(c / count)), 1.0) for count in (4, 10))
            return by_links, by_runs, 1e-12
        case "Sec. V":  # log det of two plans, in metres and degrees instead of millimetres and radians; their traces
            first, second = (blocks(random_plan())[0] for _ in range(2))
            units = np.diag(np.r_[np.full(4, np.pi / 180.0), np.full(4, 1000.0)])
            gain, converted = (
                np.linalg.slogdet(unit @ first @ unit)[1] - np.linalg.slogdet(unit @ second @ unit)[1]
                for unit in (np.eye(8), units)
            )
            traces = [float(np.trace(np.linalg.inv(total))) for total in (first, second)]  # printed: no difference
            return distance(*traces), distance(converted, gain), 1e-9
        # det D' of a plan of three links with det C' = 1 and det S' = 0; then of one with eq. 21; D-optimal plans have
        # 1. Joint 2 on 30 and 150 degrees, joint 3 on four angles a quarter turn apart, all eight pairs: h_2 = i/2,
        # h_3 = 0, so C' = 1, and S', antisymmetric of odd size, is singular as that of every plan.
        case "eq. 20-23":
            turns = np.radians([[0.0, a, b] for a in (30.0, 150.0) for b in (0.0, 90.0, 180.0, 270.0)])
            z, optimal = (np.exp(1j * np.cumsum(postures, axis=1)) for postures in (turns, dft_postures(3, 8)))
            h, whole = z.conj().T @ z / 8.0, np.linalg.det(optimal.conj().T @ optimal / 8.0).real
            det_c, det_s, det_h = (float(np.linalg.det(part).real) for part in (h.real, h.imag, h))
            best = abs(det_c - 1.0) < 1e-12 and abs(det_s) < 1e-12
            return distance(det_h**2, 1.0) if best else 0.0, distance(whole**2, 1.0), 1e-12
        case "Table I, 4 links":  # c_24 read as its index says, the angle between links that q2 and q4 would be
            theta = random_plan()
            q = np.diff(theta, axis=1, prepend=0.0)
            element = float(blocks(theta)[0][4, 7])  # lengths 1 and 4: sum cos(theta_1 - theta_4)
            wrong, right = (float(np.cos(angle).sum()) for angle in (q[:, 1] + q[:, 3], q[:, 1:].sum(axis=1)))
            return distance(wrong, element), distance(right, element), 1e-10
        case _:  # Table III, 4 links, 3 points: largest rank of the Jacobian over random plans
            model = Model(paper_arm(4))
            plans = generator.uniform(-np.pi, np.pi, (100, 3, 4))
            rank = float(max(spectrum(model.jacobian(plan), model.scales).rank for plan in plans))
            return distance(8.0, rank), distance(6.0, rank), 0.0


Expected = Mapping[tuple[int, str], tuple[float, float]]  # (runs, parameter) -> printed and correct [mm, deg]


def of_length(links: int, printed: Mapping[int, float]) -> Expected:
    """Deviations of the first length, runs -> printed."""
    name = "length_error:1"
    return {(m, name): (wrong, ideal_std(links, m, name)) for m, wrong in printed.items()}


# as eq. 24 has it, and sigma^2 / m diag(L^-2, I)
COVARIANCE = {(20, f"length_error:{j}"): (SIGMA, ideal_std(4, 20, f"length_error:{j}")) for j in range(1, 5)}
for _j, _length in enumerate(LENGTHENED, start=1):
    _scaled = np.degrees([SIGMA * np.sqrt(20.0) * _length, SIGMA / np.sqrt(20.0) / _length])
    COVARIANCE[20, f"orientation_offset:{_j}"] = float(_scaled[0]), float(_scaled[1])
OF_JOINTS = {  # eq. 25 of joint offsets, for which it is printed, and what they have
    (20, f"joint_offset:{j}"): (ideal_std(4, 20, f"orientation_offset:{j}"), ideal_std(4, 20, f"joint_offset:{j}"))
    for j in range(2, 5)
}
# number of the erratum in paper.toml -> links, deviations, more than their scatter that the correct ones may be off
SIMULATED: dict[int, tuple[int, Expected, float]] = {
    8: (4, COVARIANCE, 0.0),
    9: (4, OF_JOINTS, 0.006),  # nominal lengths instead of true ones: 0.6 % for link 1
    11: (2, of_length(2, {20: 0.058}), 0.0),
    13: (4, of_length(4, {4: 0.022, 20: 0.005}), 0.0),
    14: (4, of_length(4, {100: 0.001}), 0.0),
}


def errata(replications: int = REPLICATIONS, seed: int = 0) -> pl.DataFrame:
    """One row per erratum: place, printed, correct, relative distance of what is printed, and of its correction, from
    the truth, `tolerance` of the check, and `confirmed`: the statement is wrong and the correction right."""
    rows = []
    for k, erratum in enumerate(PAPER["errata"]):
        generator = np.random.default_rng([seed, k])
        if k in SIMULATED:  # of deviations of the optimal plan, by simulated calibrations
            links, expected, room = SIMULATED[k]
            grid: dict[str, Any] = {"runs": sorted({runs for runs, _ in expected}), "truths": [paper_truth(links)]}
            study = Study.of([paper_arm(links)], ["dft"], replications=replications, **grid)
            cells = run_study(study, seed=int(generator.integers(2**31))).cells
            simulated = {(row["runs"], row["parameter"]): row["std"] for row in cells.iter_rows(named=True)}
            ratios = np.array([np.array(values) / simulated[place] for place, values in expected.items()])
            every_wrong, every_right = np.abs(ratios - 1.0).T.tolist()
            wrong, right = min(every_wrong), max(every_right)
            tolerance = float(4.5 / np.sqrt(2.0 * replications) + room)
        else:
            wrong, right, tolerance = by_algebra(erratum["place"], generator)
        # rounding in the paper explains less than one per cent
        shown = {"printed_error": wrong, "correct_error": right, "tolerance": tolerance}
        rows.append({**erratum, **shown, "confirmed": bool(wrong > 0.01 and right <= tolerance)})
    return frame_of(rows)


# -- everything together -----------------------------------------------------------------------------------------------
def paper_study(
    replications: int | None = None, *, seed: int = 0, progress: Progress = silent
) -> dict[str, pl.DataFrame]:
    """Everything of the paper by the names of the functions here, `text` for `text_figures`.

    replications : simulated calibrations per table entry. Raises `InputError` for too few to estimate a deviation, or
        more than memory holds.
    """
    (least, most), number = (100, 100_000), replications or REPLICATIONS
    if not least <= number <= most:
        raise InputError(f"--replications: found {number}, allowed for the paper: {least} to {most:,}")
    made: dict[str, Callable[[], pl.DataFrame]] = {
        "table_1": table_1,
        "table_2": table_2,
        "table_3": lambda: table_3(number, seed),
        "text": text_figures,
        "errata": lambda: errata(number, seed),
        "figure_1": lambda: figure_1(number, seed),
        "figure_2": lambda: figure_2(number, seed),
    }
    found = {}
    for k, (name, make) in enumerate(made.items()):
        progress(k, len(made), name)
        found[name] = make()
    return found


def passed(tables: Mapping[str, pl.DataFrame]) -> bool:
    """Whether theory and simulation agree everywhere and every erratum is confirmed."""
    return consistent(tables["table_3"]) and bool(tables["errata"]["confirmed"].all())
