"""The paper's Tables I to III and the figures in its text, computed again: what it prints, what comes out.

Klimchik, Wu, Caro, Pashkevich, "Design of Experiments for Calibration of Planar Anthropomorphic Manipulators". Every
table is one row per printed statement:

`place`, `links`, `runs`, `item`, `unit` : what the statement is about
`printed` : the paper's figure;  `theory` : that of our own derivation (doe/README.md, "Errata")
`simulated`, `standard_error` : the figure from simulated calibrations
`verdict` : "agrees" (to one unit of the last printed digit), "erratum", "not identifiable", or "added" where the paper
    has no figure

`consistent` checks that simulation and theory agree in every row, independently of the paper.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import polars as pl

from doe.bounds.planar_theorem import pair_means as table_1_sums
from doe.jobs.row_table import frame_of
from doe.studies.monte_carlo.plans import dft_postures
from doe.studies.monte_carlo.specification import Study, Truth
from doe.studies.monte_carlo.study import run_study
from identification.arm import Arm
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


def paper_arm(links: int = 4, limited: bool = False) -> Arm:
    """The first links of the paper's arm; `limited`: within the joint limits of doe/README.md, "Planar theorem"."""
    lower, upper = np.radians(LIMITS_DEG[:links]).T if limited else (None, None)
    name = LIMITED if limited else f"{links} links"
    return Arm(np.array(LENGTHS[:links]), lower, upper, SIGMA, name)  # type: ignore[arg-type]


def paper_truth(links: int = 4) -> Truth:
    """The paper's deviations of the first links."""
    return Truth("paper", LENGTH_ERRORS[:links], np.radians(JOINT_OFFSETS_DEG[:links]).tolist())


def orientation_std(links: int, runs: int, sigma: float = SIGMA) -> np.ndarray:
    """(n,) [deg] sigma / (sqrt(m) l_j): eq. 25, which is about the orientation of link j."""
    return np.degrees(sigma / np.sqrt(runs) / np.array(LENGTHS[:links]))


def joint_offset_std(links: int, runs: int, sigma: float = SIGMA) -> np.ndarray:
    """(n,) [deg] of dq_j = dtheta_j - dtheta_(j-1) (identification/README.md, "Covariance and intervals")."""
    own = orientation_std(links, runs, sigma)
    return np.sqrt(own**2 + np.r_[0.0, own[:-1] ** 2])


# -- Table I -----------------------------------------------------------------------------------------------------------
def table_1(runs: int = 20) -> pl.DataFrame:
    """One row per pair of links of the arms with 2, 3 and 4 links: the condition, whether the paper prints it, the
    residual |mean exp(i sum q)| of the plan theta_j = 2 pi i j / m."""
    rows = []
    for links, printed in TABLE_1.items():
        sums = table_1_sums(dft_postures(links, runs))
        for j, k in combinations(range(links), 2):
            name = " + ".join(f"q{i + 1}" for i in range(j + 1, k + 1))
            row = {
                "place": "Table I",
                "links": links,
                "item": f"sum of exp(i ({name})) = 0",
                "printed": name in printed,
            }
            row["residual"] = abs(sums[j + 1, k + 1])
            rows.append(row | {"verdict": "agrees" if name in printed else "erratum"})
    return frame_of(rows)


# -- Table II ----------------------------------------------------------------------------------------------------------
def table_2(runs: int = 20) -> pl.DataFrame:
    """sum J^T J of the optimal plan by the model against diag(m l_1^2, .., m, ..), as printed, in orientation offsets.

    `off_diagonal` : its largest element off the diagonal, scaled;  `diagonal_error` : largest relative error on it
    """
    rows = []
    for links in TABLE_1:
        lengths = np.array(LENGTHS[:links])
        jacobian = Model(paper_arm(links)).jacobian(dft_postures(links, runs))
        # columns by joint offsets are sums of those by orientations (eq. 8): difference them
        by_joint = jacobian[..., links:]
        by_orientation = by_joint - np.concatenate([by_joint[..., 1:], np.zeros_like(by_joint[..., :1])], axis=-1)
        total = information_matrix(np.concatenate([by_orientation, jacobian[..., :links]], axis=-1))
        printed = np.r_[runs * lengths**2, np.full(links, float(runs))]
        scaled = total / np.sqrt(np.outer(printed, printed))
        rows.append(
            {
                "place": "Table II",
                "links": links,
                "runs": runs,
                "item": "sum J^T J = diag(m l^2, m)",
                "diagonal_error": float(np.max(np.abs(np.diag(scaled) - 1.0))),
                "off_diagonal": float(np.max(np.abs(scaled - np.diag(np.diag(scaled))))),
                "verdict": "agrees" if np.allclose(scaled, np.eye(2 * links), atol=1e-12) else "erratum",
            }
        )
    return frame_of(rows)


# -- Table III and the text --------------------------------------------------------------------------------------------
def table_3(replications: int = REPLICATIONS, seed: int = 0, arm_names: Sequence[str] = ARM_NAMES) -> pl.DataFrame:
    """Table III by simulation, and what it leaves out: joint offsets, 4 links with 4 runs, joint limits.

    Theory is eq. 25 with the TRUE lengths l_j + dl_j, which simulation follows: a difference of 0.6 % at most.
    """
    return frame_of([row for arm_name in arm_names for row in _simulated(arm_name, replications, seed)])


def _simulated(arm_name: str, replications: int, seed: int) -> Iterator[dict[str, Any]]:
    """Rows of the arm named `arm_name`."""
    limited, links = arm_name == LIMITED, int(arm_name[0])
    plan, runs = ("exchange_ipopt", [4, 20]) if limited else ("dft", [3, 4, 20])
    arm, truth = paper_arm(links, limited), paper_truth(links)
    found = run_study(Study([arm], [plan], runs, truths=[truth], replications=replications), seed=seed).cells
    place = "joint limits" if limited else "Table III"
    for row in found.iter_rows(named=True):
        common = {"place": place, "links": links, "runs": row["runs"]}
        if row["status"] != "done":
            yield from _not_identifiable(common, row["error"])
            continue
        printed = None if limited else _printed(links, row["runs"], row["parameter"])
        ideal = _ideal(links, row["runs"], row["parameter"])
        yield {
            **common,
            "item": row["parameter"],
            "unit": row["unit"],
            "printed": printed,
            "theory": row["expected_std"],
            "ideal": ideal,
            "simulated": row["std"],
            "standard_error": row["std_se"],
            "verdict": agreement(printed, ideal),
            "note": None,
        }


def _not_identifiable(common: dict[str, Any], reason: str) -> Iterator[dict[str, Any]]:
    """The printed numbers where there are fewer equations than unknowns."""
    links, runs = common["links"], common["runs"]
    names = [f"length_error:{j}" for j in range(1, links + 1)]
    names += [f"orientation_offset:{j}" for j in range(1, links + 1)]
    for name in names:
        unit = "mm" if name.startswith("length") else "deg"
        note = f"{2 * runs} equations, {2 * links} unknowns: {reason}"
        printed = _printed(links, runs, name)
        yield {**common, "item": name, "unit": unit, "printed": printed, "verdict": "not identifiable", "note": note}


def _printed(links: int, runs: int, parameter: str) -> float | None:
    if runs not in PRINTED[links]:
        return None
    name, _, number = parameter.partition(":")
    length, orientations = PRINTED[links][runs]
    return length if name == "length_error" else orientations[int(number) - 1] if name.startswith("orient") else None


def _ideal(links: int, runs: int, parameter: str) -> float:
    """Eq. 25, and its consequence for joint offsets, at the nominal lengths."""
    name, _, number = parameter.partition(":")
    if name == "length_error":
        return SIGMA / float(np.sqrt(runs))
    of = orientation_std if name.startswith("orient") else joint_offset_std
    return float(of(links, runs)[int(number) - 1])


def agreement(printed: float | None, theory: float, digit: float = LAST_DIGIT) -> str:
    """Whether a printed figure is ours to one unit of its last digit: 0.0276 is printed as 0.027 or as 0.028."""
    if printed is None:
        return "added"
    return "agrees" if abs(printed - theory) < digit else "erratum"


def text_figures() -> pl.DataFrame:
    """The numbers of Section VI's text, by eq. 25; simulation confirms the same formula in `table_3`."""
    lengths: list[tuple[str, int, float | None, float]] = [
        ("Sec. VI: 4 points", 4, 0.022, SIGMA / np.sqrt(4)),
        ("Sec. VI: 20 points", 20, 0.005, SIGMA / np.sqrt(20)),
        ("Sec. VI: 100 points", 100, 0.001, SIGMA / np.sqrt(100)),
        ("runs for 0.001 mm", 10_000, None, SIGMA / np.sqrt(10_000)),
    ]
    rows: list[dict[str, Any]] = [
        {"place": place, "links": 4, "runs": m, "item": "length_error", "unit": "mm", "printed": p, "theory": float(t)}
        for place, m, p, t in lengths
    ]
    for j, (printed, theory) in enumerate(zip((0.002, 0.003, 0.005, 0.006), orientation_std(4, 100), strict=True), 1):
        item = {"item": f"orientation_offset:{j}", "unit": "deg", "printed": printed, "theory": float(theory)}
        rows.append({"place": "Sec. VI: 100 points", "links": 4, "runs": 100, **item})
    return frame_of([{**row, "verdict": agreement(row["printed"], row["theory"])} for row in rows])


def consistent(table: pl.DataFrame) -> bool:
    """Whether simulation and theory agree in every row that has both, to `ALERT` standard errors."""
    both = table.drop_nulls(["simulated", "theory"])
    return bool(((both["simulated"] - both["theory"]).abs() <= ALERT * both["standard_error"]).all())
