"""Plans and weights by armcal and by what people use instead, each tool called as its documentation says.

EXACT: each tool offers plans (m, n) [rad] until its time is up. WEIGHTS: each weighs the candidates of a planar grid.
"""

import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from tests.benchmarks.peers.arms import ARMS, LEVER, Planar, Screws
from tests.benchmarks.peers.table import Answer, Tool, processor_seconds

Arm = Planar | Screws
SEED = 0
BETTER = 1e-6  # in log det, of a later plan
LEVELS = 23  # of a joint, for the tool that wants levels
POOL = 1000  # candidates, for the tool that wants a list
TARGET = 1e-4  # gap at which the multiplicative algorithm stops
EVERY = 50  # of its steps between two looks at the gap


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

    yield solve(DesignProblem.of(described(arm)), runs).plan.postures


def described(arm: Arm):
    """The arm as armcal's model."""
    from identification import Arm as Described
    from identification import Model
    from identification.model.placed import minimal
    from tests.doe.six_axis import SIX_AXIS

    if isinstance(arm, Planar):
        return Model(Described(arm.lengths, arm.lower, arm.upper))
    return minimal(Model(SIX_AXIS))


def objective(arm: Arm, runs: int):
    """-log det of the plan as a CasADi function of its postures (n m,), one posture after the other."""
    import casadi as ca

    n, p = len(arm.lower), arm.parameters
    q, information = ca.SX.sym("q", n), ca.SX.sym("M", p, p)
    rows = ca.Function("rows", [q], [symbolic_rows(arm, q)])
    log_det = ca.Function("log_det", [information], [2.0 * ca.sum1(ca.log(ca.diag(ca.chol(information))))])
    plan = ca.MX.sym("plan", n * runs)
    stacked = rows.map(runs)(ca.reshape(plan, n, runs))
    whole = ca.vertcat(*(stacked[:, p * k : p * (k + 1)] for k in range(runs)))
    return plan, -log_det(whole.T @ whole / runs)


def symbolic_rows(arm: Arm, q):
    """`rows` of arms.py for one posture, in CasADi."""
    import casadi as ca

    if isinstance(arm, Planar):
        theta = ca.cumsum(q)
        cosine, sine = ca.cos(theta).T, ca.sin(theta).T
        return ca.vertcat(ca.horzcat(cosine, -sine), ca.horzcat(sine, cosine))
    turned = []
    for j, axis in enumerate(arm.axes):  # Rodrigues' formula
        cross = ca.skew(ca.DM(axis))
        turned.append(ca.SX.eye(3) + ca.sin(q[j]) * cross + (1.0 - ca.cos(q[j])) * (cross @ cross))
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
        solution = ipopt(x0=arm.random(runs, generator).ravel(), lbx=lower, ubx=upper)
        yield solution["x"].full().reshape(runs, -1)


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
        solution = minimize(called, start, jac=True, bounds=bounds, method="SLSQP", options={"maxiter": 500})
        yield solution.x.reshape(runs, -1)


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
        rows = arm.rows(pool)
        chosen = Kept(dict(enumerate(np.einsum("mdp,mdq->mpq", rows, rows))), runs)
        chosen.main_algo()
        yield pool[chosen.kept]


def pyomo_doe(arm: Planar, runs: int) -> Iterator[np.ndarray]:
    """All runs as one experiment whose inputs are the angles; random starts; parameters in units that move the tip by
    a millimetre, and 1 where they are right, as its finite differences are relative to them."""
    import pyomo.environ as pyo
    from pyomo.contrib.doe import DesignOfExperiments
    from pyomo.contrib.parmest.experiment import Experiment

    class Arm(Experiment):
        def __init__(self, postures: np.ndarray) -> None:
            self.postures = postures

        def get_labeled_model(self) -> pyo.ConcreteModel:
            model, limits = pyo.ConcreteModel(), list(zip(arm.lower.tolist(), arm.upper.tolist(), strict=True))
            model.runs, model.links = pyo.RangeSet(0, runs - 1), pyo.RangeSet(0, len(limits) - 1)
            start = self.postures
            model.q = pyo.Var(
                model.runs, model.links, bounds=lambda _, i, j: limits[j], initialize=lambda _, i, j: start[i, j]
            )
            for name in ("length", "offset"):
                model.add_component(name, pyo.Var(model.links, initialize=1.0))
                getattr(model, name).fix()
            for name, function in (("x", pyo.cos), ("y", pyo.sin)):

                def tip(model: pyo.ConcreteModel, i: int, function=function):
                    terms = []
                    for j, length in enumerate(arm.lengths.tolist()):
                        angle = sum(model.q[i, k] for k in range(j + 1)) + (model.offset[j] - 1.0) / length
                        terms.append((length + model.length[j] - 1.0) * function(angle))
                    return sum(terms)

                measured = pyo.Var(model.runs, initialize=lambda model, i, tip=tip: pyo.value(tip(model, i)))
                model.add_component(name, measured)
                rule = pyo.Constraint(model.runs, rule=lambda m, i, tip=tip, at=measured: at[i] == tip(m, i))
                model.add_component(f"{name}_rule", rule)
            outputs = [component[i] for component in (model.x, model.y) for i in model.runs]
            unknown = [component[j] for component in (model.length, model.offset) for j in model.links]
            inputs = [model.q[i, j] for i in model.runs for j in model.links]
            for name, entries in (
                ("experiment_outputs", [(variable, None) for variable in outputs]),
                ("measurement_error", [(variable, 1.0) for variable in outputs]),
                ("unknown_parameters", [(variable, pyo.value(variable)) for variable in unknown]),
                ("experiment_inputs", [(variable, None) for variable in inputs]),
            ):
                suffix = pyo.Suffix(direction=pyo.Suffix.LOCAL)
                model.add_component(name, suffix)
                suffix.update(entries)
            return model

    generator, given = np.random.default_rng(SEED), {}
    if not shutil.which("ipopt"):  # CasADi's, behind one executable file
        script = Path(tempfile.mkdtemp()) / "ipopt"
        script.write_text(f'#!/bin/sh\nexec {sys.executable} {Path(__file__).with_name("ipopt_nl.py")} "$@"\n')
        script.chmod(0o755)
        given["executable"] = str(script)
    while True:
        solver = pyo.SolverFactory("ipopt", **given)
        solver.options["max_iter"] = 3000
        design = DesignOfExperiments(Arm(arm.random(runs, generator)), objective_option="determinant", solver=solver)
        design.run_doe()
        yield np.reshape(design.results["Experiment Design"], (runs, -1))


EXACT = {
    "armcal": Tool(partial(searched, plans=armcal), ("doe.solvers", "identification.model.placed")),
    "CasADi + IPOPT": Tool(partial(searched, plans=casadi_ipopt), ("casadi",)),
    "SciPy SLSQP": Tool(partial(searched, plans=scipy_slsqp), ("scipy.optimize", "casadi")),
    "pyoptex": Tool(partial(searched, plans=pyoptex), ("pyoptex.doe.fixed_structure",)),
    "Pyomo.DoE": Tool(partial(searched, plans=pyomo_doe), ("pyomo.environ", "pyomo.contrib.doe", "casadi")),
    "figaroh Detmax": Tool(
        partial(searched, plans=figaroh_detmax), ("figaroh.optimal.base_optimal_calibration", "picos")
    ),
}


# -- weights on candidates ---------------------------------------------------------------------------------------------
def relaxed(levels: int) -> Answer:
    """armcal's `relax` on the same grid: the weights of all candidates from those of the few that have one."""
    from scipy.spatial import cKDTree

    from doe import DesignProblem
    from doe.bounds.column_generation import relax

    arm = ARMS["4 links"]
    q = arm.grid(levels)  # type: ignore[union-attr]
    plan = relax(DesignProblem.of(described(arm)), q).plan
    weights = np.zeros(len(q))
    np.add.at(weights, cKDTree(q).query(plan.postures)[1], plan.weights)
    return {"weights": weights}


def cvxpy(levels: int, solver: str) -> Answer:
    """One program: log det of the weighted sum, vectorized; the textbook's V diag(w) V' takes gigabytes."""
    import cvxpy as cp

    arm = ARMS["4 links"]
    rows, p = arm.rows(arm.grid(levels)), arm.parameters  # type: ignore[union-attr]
    flat = np.einsum("mdp,mdq->mpq", rows, rows).reshape(len(rows), p * p)
    weights = cp.Variable(len(rows), nonneg=True)
    information = cp.reshape(flat.T @ weights, (p, p), order="C")
    problem = cp.Problem(cp.Maximize(cp.log_det((information + information.T) / 2.0)), [cp.sum(weights) == 1.0])
    problem.solve(solver=solver)
    return {"weights": np.maximum(weights.value, 0.0)}


def multiplicative(levels: int) -> Answer:
    """w <- w d / p, until the gap is small."""
    arm = ARMS["4 links"]
    rows, p = arm.rows(arm.grid(levels)), arm.parameters  # type: ignore[union-attr]
    flat, d = rows.reshape(-1, p), rows.shape[1]
    weights, gap = np.full(len(rows), 1.0 / len(rows)), np.inf
    while gap > TARGET:
        for _ in range(EVERY):
            inverse = np.linalg.inv(flat.T @ (flat * np.repeat(weights, d)[:, None]))
            sensitivity = np.einsum("ij,ij->i", flat @ inverse, flat).reshape(-1, d).sum(axis=1)
            weights *= sensitivity / p
        gap = float(sensitivity.max()) - p
    return {"weights": weights / weights.sum()}


WEIGHTS = {
    "armcal": Tool(relaxed, ("doe.bounds.column_generation", "scipy.spatial")),
    "cvxpy + Clarabel": Tool(partial(cvxpy, solver="CLARABEL"), ("cvxpy", "clarabel")),
    "cvxpy + SCS": Tool(partial(cvxpy, solver="SCS"), ("cvxpy", "scs")),
    "multiplicative, numpy": Tool(multiplicative),
}
