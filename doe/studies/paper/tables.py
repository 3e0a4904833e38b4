"""The paper's Tables I to III, Figures 1 and 2 and the numbers in its text, computed again: what it prints, what comes
out.

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
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe.bounds.planar_theorem import pair_means as table_1_sums
from doe.jobs.rows import frame_of
from doe.studies.monte_carlo.specification import Study, Truth
from doe.studies.monte_carlo.study import dft_postures, run_study
from identification import Arm, Array, Model, estimate_batch, estimate_each, information_matrix, planar_chain

PAPER = tomllib.loads(Path(__file__).with_name("paper.toml").read_text())  # what it prints
LENGTHS, LENGTH_ERRORS = tuple(PAPER["lengths_mm"]), tuple(PAPER["length_errors_mm"])
JOINT_OFFSETS_DEG, SIGMA = tuple(PAPER["joint_offsets_deg"]), PAPER["sigma_mm"]
REPLICATIONS = 10_000
LINKS = (2, 3, 4)
LIMITED = "4 links within joint limits"
ARM_NAMES = ("2 links", "3 links", "4 links", LIMITED)  # names of the arms of `table_3`
RUNS = tuple(range(4, 21))  # the axis of Figure 2
ALERT = 4.5  # standard errors between simulation and theory; 100 rows from one fixed seed: 1 in 1,500 by chance


def paper_arm(links: int = 4, limited: bool = False) -> Arm:
    """The first links of the paper's arm; `limited`: within the joint limits of doe/README.md, "Planar theorem"."""
    lower, upper = (np.radians(PAPER["joint_limits_deg"][side][:links]) for side in ("lower", "upper"))
    arm = Arm(planar_chain(LENGTHS[:links]), sigma=SIGMA, name=f"{links} links")
    return Arm(arm.chain, lower, upper, SIGMA, LIMITED) if limited else arm


def paper_truth(links: int = 4) -> Truth:
    """The paper's deviations of the first links."""
    return Truth("paper", LENGTH_ERRORS[:links], np.radians(JOINT_OFFSETS_DEG[:links]).tolist())


def orientation_std(links: int, runs: int) -> Array:
    """(n,) [deg] sigma / (sqrt(m) l_j): eq. 25, which is about the orientation of link j."""
    return np.degrees(SIGMA / np.sqrt(runs) / np.array(LENGTHS[:links]))


def joint_offset_std(links: int, runs: int) -> Array:
    """(n,) [deg] of dq_j = dtheta_j - dtheta_(j-1) (identification/README.md, "Covariance and intervals")."""
    of_link = orientation_std(links, runs)
    return np.sqrt(of_link**2 + np.r_[0.0, of_link[:-1] ** 2])


def ideal_std(links: int, runs: int, parameter: str) -> float:
    """Eq. 25, and its consequence for joint offsets, at the nominal lengths [mm, deg]."""
    name, _, number = parameter.partition(":")
    if name == "length_error":
        return SIGMA / float(np.sqrt(runs))
    of = orientation_std if name.startswith("orient") else joint_offset_std
    return float(of(links, runs)[int(number) - 1])


def agreement(printed: float | None, theory: float) -> str:
    """Whether a printed figure is ours to one unit of its last digit: 0.0276 is printed as 0.027 or as 0.028."""
    if printed is None:
        return "added"
    return "agrees" if abs(printed - theory) < 0.001 else "erratum"  # three decimals are printed


# -- tables ------------------------------------------------------------------------------------------------------------
def table_1(runs: int = 20) -> pl.DataFrame:
    """One row per pair of links of the arms with 2, 3 and 4 links: the condition, whether the paper prints it, the
    residual |mean exp(i sum q)| of the plan theta_j = 2 pi i j / m."""
    rows = []
    for links, printed in zip(LINKS, PAPER["table_1"].values(), strict=True):
        sums = table_1_sums(dft_postures(links, runs))
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
    for links in LINKS:
        jacobian = Model(paper_arm(links)).jacobian(dft_postures(links, runs))
        # columns by joint offsets are sums of those by orientations (eq. 8): difference them
        by_orientation = -np.diff(jacobian[..., links:], axis=-1, append=0.0)
        total = information_matrix(np.concatenate([by_orientation, jacobian[..., :links]], axis=-1))
        printed = np.r_[runs * np.array(LENGTHS[:links]) ** 2, np.full(links, float(runs))]
        scaled = total / np.sqrt(np.outer(printed, printed))
        row = {"place": "Table II", "links": links, "runs": runs, "item": "sum J^T J = diag(m l^2, m)"}
        row["diagonal_error"] = float(np.max(np.abs(np.diag(scaled) - 1.0)))
        row["off_diagonal"] = float(np.max(np.abs(scaled - np.diag(np.diag(scaled)))))
        rows.append(row | {"verdict": "agrees" if np.allclose(scaled, np.eye(2 * links), atol=1e-12) else "erratum"})
    return frame_of(rows)


def table_3(replications: int = REPLICATIONS, seed: int = 0, arm_names: Sequence[str] = ARM_NAMES) -> pl.DataFrame:
    """Table III by simulation, and what it leaves out: joint offsets, 4 links with 4 runs, joint limits.

    Theory is eq. 25 with the TRUE lengths l_j + dl_j, which simulation follows: a difference of 0.6 % at most.
    """
    rows: list[dict[str, Any]] = []
    for arm_name in arm_names:
        limited, links = arm_name == LIMITED, int(arm_name[0])
        plan, runs = ("exchange_ipopt", [4, 20]) if limited else ("dft", [3, 4, 20])
        study = Study([paper_arm(links, limited)], [plan], runs, truths=[paper_truth(links)], replications=replications)
        for row in run_study(study, seed=seed).cells.iter_rows(named=True):
            case = {"place": "joint limits" if limited else "Table III", "links": links, "runs": row["runs"]}
            printed: dict[str, float] = {}
            for entry in PAPER["table_3"] if not limited else ():
                if (entry["links"], entry["runs"]) == (links, row["runs"]):
                    printed |= {f"length_error:{j}": entry["length"] for j in range(1, links + 1)}
                    printed |= {f"orientation_offset:{j}": v for j, v in enumerate(entry["orientations"], start=1)}
            if row["status"] != "done":  # fewer equations than unknowns
                lost: dict[str, Any] = {"note": f"{2 * row['runs']} equations, {2 * links} unknowns: {row['error']}"}
                for item, value in printed.items():
                    unit = "mm" if item.startswith("length") else "deg"
                    lost |= {"item": item, "unit": unit, "printed": value, "verdict": "not identifiable"}
                    rows.append(case | lost)
                continue
            ideal = ideal_std(links, row["runs"], row["parameter"])
            case |= {"item": row["parameter"], "unit": row["unit"], "printed": printed.get(row["parameter"])}
            case |= {"theory": row["expected_std"], "ideal": ideal, "simulated": row["std"]}
            case["standard_error"] = row["std_se"]
            rows.append(case | {"verdict": agreement(case["printed"], ideal), "note": None})
    return frame_of(rows)


def consistent(table: pl.DataFrame) -> bool:
    """Whether simulation and theory agree in every row that has both, to `ALERT` standard errors, independently of the
    paper."""
    rows = table.drop_nulls(["simulated", "theory"])
    return bool(((rows["simulated"] - rows["theory"]).abs() <= ALERT * rows["standard_error"]).all())


def text_figures() -> pl.DataFrame:
    """The numbers of Section VI's text, by eq. 25; simulation confirms the same formula in `table_3`."""
    rows = []
    for entry in PAPER["text"]:
        item, printed, theory = entry["item"], entry.get("printed"), ideal_std(4, entry["runs"], entry["item"])
        row = {"place": entry["place"], "links": 4, "runs": entry["runs"], "item": item}
        row |= {"unit": "mm" if item == "length_error" else "deg", "printed": printed, "theory": theory}
        rows.append(row | {"verdict": agreement(printed, theory)})
    return frame_of(rows)


# -- figures -----------------------------------------------------------------------------------------------------------
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
    frames = []
    for m in runs:
        generator = np.random.default_rng([seed, 2, m])
        ordinary = generator.uniform(-np.pi, np.pi, (m, 4))
        random_plans = generator.uniform(-np.pi, np.pi, (replications, m, 4))
        x, o, every = (_errors(plan, replications, generator) for plan in (dft_postures(4, m), ordinary, random_plans))
        items = [f"{name}:{j}" for name in ("length_error", "orientation_offset") for j in range(1, 5)]
        columns = {
            "item": items,
            "unit": ["mm"] * 4 + ["deg"] * 4,
            "optimal": [ideal_std(4, m, item) for item in items],
        }
        columns |= {"optimal_simulated": np.std(x, axis=0), "ordinary": np.std(o, axis=0)}
        columns["random_mean"] = np.sqrt(np.pi / 2.0) * np.mean(np.abs(every), axis=0)
        columns["joint_offset"] = [None] * 4 + np.std(np.diff(x[:, 4:], axis=1, prepend=0.0), axis=0).tolist()
        frames.append(pl.DataFrame({"runs": [m] * 8, **columns}))
    return pl.concat(frames)


def _errors(plans: Array, replications: int, generator: np.random.Generator) -> Array:
    """(K, 8) errors of lengths [mm] and orientation offsets [deg] of fits on one plan (m, 4) or on plans (K, m, 4)."""
    truth, model = Model(paper_truth().of(paper_arm())), Model(paper_arm())
    exact = truth.position(plans.reshape(-1, 4)).reshape(*plans.shape[:-1], 2)
    positions = exact + SIGMA * generator.standard_normal((replications, plans.shape[-2], 2))
    fits = estimate_batch(model, plans, positions) if plans.ndim == 2 else estimate_each(model, plans, positions)
    turned = np.cumsum(fits.parameters[:, 4:] - np.radians(JOINT_OFFSETS_DEG), axis=1)
    turned = (turned + np.pi) % (2.0 * np.pi) - np.pi
    return np.hstack([fits.parameters[:, :4] - LENGTH_ERRORS, np.degrees(turned)])
