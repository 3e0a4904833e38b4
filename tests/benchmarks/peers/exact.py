"""Exact plans by armcal and by what people use instead. Each tool offers plans (m, n) [rad] until its time is up."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tests.benchmarks.peers.geometry import ARMS, LEVER, Planar, Screws
from tests.benchmarks.peers.tool import Answer, Tool, processor_seconds

Arm = Planar | Screws
SEED = 0
BETTER = 1e-6  # in log det, of a later plan
LEVELS = 23  # of a joint, for the tool that wants levels
POOL = 1000  # candidates, for the tool that wants a list


def searched(arm_name: str, runs: int, budget: float, plans: Callable[[Arm, int], Iterator[np.ndarray]]) -> Answer:
    """The best of what is offered in so many seconds of processor time, and when it was there."""
    arm, began = ARMS[arm_name], processor_seconds()
    best, answer = -np.inf, {}
    for count, plan in enumerate(plans(arm, runs), start=1):
        spent = processor_seconds() - began
        if (value := arm.log_det(plan)) > best + BETTER:
            best, answer = value, {"plan": plan, "seconds": spent}
        answer["starts"] = count
        if spent > budget:
            break
    return answer


def armcal(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """`solve`, as the README has it; in space for the minimal set of parameters."""
    from doe import DesignProblem, solve
    from identification import Arm as Described
    from identification import Model

    if isinstance(arm, Planar):
        yield solve(DesignProblem.of(Model(Described(arm.lengths, arm.lower, arm.upper))), runs).plan.postures
        return
    from identification.model.minimal import minimal
    from tests.doe.six_axis import SIX_AXIS

    yield solve(DesignProblem.of(minimal(Model(SIX_AXIS))), runs).plan.postures


def objective(arm: Arm, runs: int):
    """-log det of the plan as a CasADi function of its postures (n m,), one posture after the other."""
    import casadi as ca

    n, p = len(arm.lower), arm.parameters
    q, sym = ca.SX.sym("q", n), ca.SX.sym("M", p, p)
    rows = ca.Function("rows", [q], [symbolic_rows(arm, q)])
    log_det = ca.Function("log_det", [sym], [2.0 * ca.sum1(ca.log(ca.diag(ca.chol(sym))))])
    plan = ca.MX.sym("plan", n * runs)
    stacked = rows.map(runs)(ca.reshape(plan, n, runs))
    found = [stacked[:, p * k : p * (k + 1)] for k in range(runs)]
    whole = ca.vertcat(*found)
    return plan, -log_det(whole.T @ whole / runs)


def symbolic_rows(arm: Arm, q):
    """`rows` of geometry.py for one posture, in CasADi."""
    import casadi as ca

    if isinstance(arm, Planar):
        theta = ca.cumsum(q)
        cosine, sine = ca.cos(theta).T, ca.sin(theta).T
        return ca.vertcat(ca.horzcat(cosine, -sine), ca.horzcat(sine, cosine))
    turned = [rotation(axis, q[j]) for j, axis in enumerate(arm.axes)]
    tips = [ca.SX(ca.DM(arm.tip))]
    for turn, point in zip(reversed(turned), arm.points[::-1], strict=True):
        tips.insert(0, ca.DM(point) + turn @ (tips[0] - ca.DM(point)))
    before, columns = ca.SX.eye(3), []
    for j, (turn, axis, point) in enumerate(zip(turned, arm.axes, arm.points, strict=True)):
        across = [ca.DM(direction) for direction in np.linalg.svd(axis[None])[2][1:]]
        columns += [before @ (direction - turn @ direction) for direction in across]
        for direction in across:
            after = turn @ ca.cross(direction, tips[j + 1] - ca.DM(point))
            columns.append(before @ (ca.cross(direction, tips[j] - ca.DM(point)) - after) / LEVER)
        before = before @ turn
    return ca.horzcat(*columns, before)


def rotation(axis: np.ndarray, angle):
    """Rodrigues' formula."""
    import casadi as ca

    cross = ca.skew(ca.DM(axis))
    return ca.SX.eye(3) + ca.sin(angle) * cross + (1.0 - ca.cos(angle)) * (cross @ cross)


def casadi_ipopt(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """Random starts; exact Hessians in the plane, in space limited memory, which is faster there."""
    import casadi as ca

    plan, value = objective(arm, runs)
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    if isinstance(arm, Screws):
        options |= {"ipopt.hessian_approximation": "limited-memory", "ipopt.max_iter": 500}
    ipopt = ca.nlpsol("ipopt", "ipopt", {"x": plan, "f": value}, options)
    lower, upper = np.tile(arm.lower, runs), np.tile(arm.upper, runs)
    generator = np.random.default_rng(SEED)
    while True:
        found = ipopt(x0=arm.random(runs, generator).ravel(), lbx=lower, ubx=upper)["x"]
        yield found.full().reshape(runs, -1)


def scipy_slsqp(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """Random starts, gradients by CasADi."""
    import casadi as ca
    from scipy.optimize import minimize

    plan, value = objective(arm, runs)
    both = ca.Function("both", [plan], [value, ca.gradient(value, plan)])

    def called(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = both(x)
        return float(value), gradient.full().ravel()

    bounds = list(zip(np.tile(arm.lower, runs), np.tile(arm.upper, runs), strict=True))
    generator = np.random.default_rng(SEED)
    while True:
        start = arm.random(runs, generator).ravel()
        found = minimize(called, start, jac=True, bounds=bounds, method="SLSQP", options={"maxiter": 500})
        yield found.x.reshape(runs, -1)


def pyoptex(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """Coordinate exchange over levels of each joint; its own criteria count x and y as two runs, so ours is given."""
    from pyoptex.doe.fixed_structure import Factor, create_fixed_structure_design, create_parameters, default_fn
    from pyoptex.doe.fixed_structure.metric import Metric

    class LogDet(Metric):
        def call(self, Y, X, params):
            return max(arm.log_det(middle + half * X), -1e6)

    middle, half = (arm.upper + arm.lower) / 2.0, (arm.upper - arm.lower) / 2.0
    levels = np.linspace(-1.0, 1.0, LEVELS)
    factors = [Factor(f"q{j}", type="continuous", min=-1, max=1, levels=levels) for j in range(len(half))]
    parameters = create_parameters(factors, default_fn(factors, LogDet(), lambda Y: Y), runs)
    np.random.seed(SEED)  # noqa: NPY002 - it has no generator
    while True:
        yield middle + half * create_fixed_structure_design(parameters, n_tries=1)[0].to_numpy()


def figaroh_detmax(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """Its exchange over a list of random postures."""
    import random

    from figaroh.optimal.base_optimal_calibration import Detmax

    class Kept(Detmax):
        """It returns its criterion only: the last set it judged is the one it ends with."""

        def get_critD(self, set: list[int]) -> float:
            self.kept = list(set)
            return super().get_critD(set)

    random.seed(SEED)
    generator = np.random.default_rng(SEED)
    while True:
        pool = arm.random(POOL, generator)
        chosen = Kept(informations(arm, pool), runs)
        chosen.main_algo()
        yield pool[chosen.kept]


def figaroh_socp(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """Its cone program over a list of random postures, the largest weights taken as it does."""
    from figaroh.optimal.base_optimal_calibration import SOCPOptimizer

    generator = np.random.default_rng(SEED)
    while True:
        pool = arm.random(POOL, generator)
        _, ranked = SOCPOptimizer(informations(arm, pool), {"NbSample": POOL}).solve()
        yield pool[list(ranked)[:runs]]


def informations(arm: Arm, pool: np.ndarray) -> dict[int, np.ndarray]:
    """Its form of a list: number -> (p, p)."""
    rows = arm.rows(pool)
    return dict(enumerate(np.einsum("mdp,mdq->mpq", rows, rows)))


def pyomo_doe(arm: Arm, runs: int) -> Iterator[np.ndarray]:
    """All runs as one experiment whose inputs are the angles; random starts."""
    import pyomo.environ as pyo
    from pyomo.contrib.doe import DesignOfExperiments

    from tests.benchmarks.peers.pyomo_arm import ArmExperiment

    generator = np.random.default_rng(SEED)
    own = [sys.executable, str(Path(__file__).with_name("ipopt_nl.py"))]
    while True:
        solver = pyo.SolverFactory("ipopt") if shutil.which("ipopt") else with_executable(own)
        solver.options["max_iter"] = 3000
        experiment = ArmExperiment(arm, arm.random(runs, generator))
        design = DesignOfExperiments(experiment, objective_option="determinant", solver=solver)
        design.run_doe()
        yield np.reshape(design.results["Experiment Design"], (runs, -1))


def with_executable(command: list[str]):
    """Pyomo's interface to IPOPT with another command, which wants to be one executable file."""
    import tempfile

    import pyomo.environ as pyo

    script = Path(tempfile.mkdtemp()) / "ipopt"
    script.write_text(f'#!/bin/sh\nexec {" ".join(command)} "$@"\n')
    script.chmod(0o755)
    return pyo.SolverFactory("ipopt", executable=str(script))


def job(plans: Callable[[Arm, int], Iterator[np.ndarray]], *modules: str) -> Tool:
    """A tool of this file."""
    return Tool(lambda **given: searched(plans=plans, **given), modules)


TOOLS = {
    "armcal": job(armcal, "doe.solvers", "identification.model.minimal"),
    "CasADi + IPOPT": job(casadi_ipopt, "casadi"),
    "SciPy SLSQP": job(scipy_slsqp, "scipy.optimize", "casadi"),
    "pyoptex": job(pyoptex, "pyoptex.doe.fixed_structure"),
    "Pyomo.DoE": job(pyomo_doe, "pyomo.environ", "pyomo.contrib.doe", "casadi"),
    "figaroh Detmax": job(figaroh_detmax, "figaroh.optimal.base_optimal_calibration", "picos"),
    "figaroh SOCP": job(figaroh_socp, "figaroh.optimal.base_optimal_calibration", "picos"),
}
