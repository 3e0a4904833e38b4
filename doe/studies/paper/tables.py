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

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import polars as pl

from doe.bounds.planar_theorem import pair_means as table_1_sums
from doe.jobs.row_table import frame_of
from doe.studies.monte_carlo.specification import Study, Truth
from doe.studies.monte_carlo.study import dft_postures, run_study
from identification.arm import Arm
from identification.arrays import Array
from identification.estimation import estimate_batch, estimate_each
from identification.information import information_matrix
from identification.model import Model

LENGTHS = (260.0, 180.0, 120.0, 100.0)  # [mm]
LENGTH_ERRORS = (1.5, -0.6, -0.4, 0.7)  # [mm]
JOINT_OFFSETS_DEG = (0.5, -0.5, 0.7, -0.3)
SIGMA = 0.1  # [mm]
REPLICATIONS = 10_000
LIMITED = "4 links within joint limits"
LIMITS_DEG = ((-180.0, 180.0), (-120.0, 120.0), (-100.0, 60.0), (-90.0, 90.0))  # doe/README.md, "Planar theorem"
ARM_NAMES = ("2 links", "3 links", "4 links", LIMITED)  # names of the arms of `table_3`
RUNS = tuple(range(4, 21))  # the axis of Figure 2
LAST_DIGIT = 0.001  # Table III and the text print three decimals
ALERT = 4.5  # standard errors between simulation and theory; 100 rows from one fixed seed: 1 in 1,500 by chance

# Table III as printed: links -> runs -> (length [mm] of every link, orientation [deg] of link 1, 2, ...)
PRINTED: dict[int, dict[int, tuple[float, tuple[float, ...]]]] = {
    2: {3: (0.058, (0.013, 0.018)), 20: (0.058, (0.005, 0.007))},
    3: {3: (0.058, (0.013, 0.018, 0.027)), 20: (0.022, (0.005, 0.007, 0.011))},
    4: {3: (0.058, (0.013, 0.018, 0.027, 0.033)), 20: (0.022, (0.005, 0.007, 0.011, 0.013))},
}
# Table I as printed: the sums of joint angles whose cosines and sines must add up to zero
TABLE_1 = {
    2: {"q2"},
    3: {"q2", "q3", "q2 + q3"},
    4: {"q2", "q3", "q4", "q2 + q3", "q2 + q3 + q4", "q3 + q4"},
}
# the numbers of Section VI's text: place, parameter, runs, as printed
TEXT: tuple[tuple[str, str, int, float | None], ...] = (
    ("Sec. VI: 4 points", "length_error", 4, 0.022),
    ("Sec. VI: 20 points", "length_error", 20, 0.005),
    ("Sec. VI: 100 points", "length_error", 100, 0.001),
    ("runs for 0.001 mm", "length_error", 10_000, None),
    *(("Sec. VI: 100 points", f"orientation_offset:{j}", 100, 0.001 * k) for j, k in enumerate((2, 3, 5, 6), 1)),
)


def paper_arm(links: int = 4, limited: bool = False) -> Arm:
    """The first links of the paper's arm; `limited`: within the joint limits of doe/README.md, "Planar theorem"."""
    lower, upper = np.radians(LIMITS_DEG[:links]).T if limited else (None, None)
    name = LIMITED if limited else f"{links} links"
    return Arm(np.array(LENGTHS[:links]), lower, upper, SIGMA, name)  # type: ignore[arg-type]


def paper_truth(links: int = 4) -> Truth:
    """The paper's deviations of the first links."""
    return Truth("paper", LENGTH_ERRORS[:links], np.radians(JOINT_OFFSETS_DEG[:links]).tolist())


def orientation_std(links: int, runs: int) -> Array:
    """(n,) [deg] sigma / (sqrt(m) l_j): eq. 25, which is about the orientation of link j."""
    return np.degrees(SIGMA / np.sqrt(runs) / np.array(LENGTHS[:links]))


def joint_offset_std(links: int, runs: int) -> Array:
    """(n,) [deg] of dq_j = dtheta_j - dtheta_(j-1) (identification/README.md, "Covariance and intervals")."""
    own = orientation_std(links, runs)
    return np.sqrt(own**2 + np.r_[0.0, own[:-1] ** 2])


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
    return "agrees" if abs(printed - theory) < LAST_DIGIT else "erratum"


# -- tables ------------------------------------------------------------------------------------------------------------
def table_1(runs: int = 20) -> pl.DataFrame:
    """One row per pair of links of the arms with 2, 3 and 4 links: the condition, whether the paper prints it, the
    residual |mean exp(i sum q)| of the plan theta_j = 2 pi i j / m."""
    rows = []
    for links, printed in TABLE_1.items():
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
    for links in TABLE_1:
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
            length, orientations = PRINTED[links].get(row["runs"], (None, ())) if not limited else (None, ())
            printed = {f"length_error:{j}": length for j in range(1, links + 1)}
            printed |= {f"orientation_offset:{j}": value for j, value in enumerate(orientations, start=1)}
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
    both = table.drop_nulls(["simulated", "theory"])
    return bool(((both["simulated"] - both["theory"]).abs() <= ALERT * both["standard_error"]).all())


def text_figures() -> pl.DataFrame:
    """The numbers of Section VI's text, by eq. 25; simulation confirms the same formula in `table_3`."""
    rows = []
    for place, item, runs, printed in TEXT:
        unit, theory = "mm" if item == "length_error" else "deg", ideal_std(4, runs, item)
        row = {"place": place, "links": 4, "runs": runs, "item": item, "unit": unit, "printed": printed}
        rows.append(row | {"theory": theory, "verdict": agreement(printed, theory)})
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
