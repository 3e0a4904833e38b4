"""Every criterion of a plan, and the observability indices O1 to O5 of the robot calibration literature.

Y. Sun, J. M. Hollerbach, "Observability index selection for robot calibration", ICRA 2008: from the singular values
s_1 >= ... >= s_p of the identification Jacobian of all m runs, here scaled (lengths in mm, angles times link length).
O1 is D-, O3 is E-, O5 is close to A-optimality (of deviations, not variances). Only O1's order of plans is invariant to
units. Larger is better for each; 0 where the plan does not identify all parameters.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from doe.criteria import A, Criterion, D, Ds, DStar, E
from doe.plan.expected_accuracy import plan_jacobians, plan_spectrum
from doe.problem.problem import DesignProblem
from doe.problem.robust import average_error
from identification.arrays import Array


@dataclass(frozen=True)
class Observability:
    """o1: (s_1 ... s_p)^(1/p) / sqrt(m);  o2: s_p / s_1;  o3: s_p;  o4: s_p^2 / s_1;  o5: 1 / sum(1 / s_i)."""

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    def to_json(self) -> dict[str, float]:
        """By name."""
        return asdict(self)


def observability(problem: DesignProblem, postures: Array) -> Observability:
    """The five indices of a plan (m, n), measured postures (`kept`) included."""
    jacobians = plan_jacobians(problem, postures)
    values = np.linalg.svd(jacobians.reshape(-1, problem.parameters), compute_uv=False)
    if plan_spectrum(problem, postures).rank < problem.parameters:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    return Observability(
        float(np.exp(np.mean(np.log(values))) / np.sqrt(len(postures) + len(problem.kept))),
        float(values[-1] / values[0]),
        float(values[-1]),
        float(values[-1] ** 2 / values[0]),
        float(1.0 / np.sum(1.0 / values)),
    )


def criterion_values(problem: DesignProblem, postures: Array) -> dict[str, float | None]:
    """Name -> value of every criterion for a plan (m, n), None where the plan does not identify enough for it.

    I is the error over the `workspace`, Ds that of the parameters in mm where there are others too.
    """
    units = problem.model.parameters.units
    lengths = tuple(k for k, unit in enumerate(units) if unit == "mm")
    criteria: dict[str, Criterion] = {"D": D(), "A": A(), "E": E(), "I": average_error(problem)}
    if 0 < len(lengths) < len(units):
        criteria |= {"Ds": Ds(lengths), "Dstar": DStar.by_unit(units)}
    values = {name: replace(problem, criterion=one).objective(postures) for name, one in criteria.items()}
    return {name: value if np.isfinite(value) else None for name, value in values.items()}
