"""IPOPT from several starts, with exact first and second derivatives of the criterion and of the constraints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from doe.plan.replicate_spacing import free_values
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.derivatives import ConstraintFunction, PlanFunction
from doe.solvers.ipopt_callbacks import Guarded, Stop, interrupts_noted
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array
from identification.errors import InputError

MOST = 5000  # variables, whose second derivatives are dense: 0.2 GB, and 10 s for each step
POLISHED = 1500  # variables, beyond which what other solvers found is left as it is

NEAR_LIMIT = 1e-5  # joint unit: an interior point method ends this near to a limit that is active; it is put on it

MARGIN = 1e-4  # [mm] constraints are kept by this much, since IPOPT keeps them to about 1e-8 only

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "show_eval_warnings": False}


@dataclass(frozen=True)
class Ipopt:
    """Interior point method from random postures.

    tolerance : of IPOPT's optimality error;  iterations : at most, per start
    warm : True: stay near the start (it is nearly optimal already), False: first move away from the limits
    """

    tolerance: float = 1e-10
    iterations: int = 150
    warm: bool = False
    name: str = "ipopt"

    def starts_for(self, problem: DesignProblem) -> int:
        """Ten per joint."""
        return 10 * max(1, len(problem.searched_joints))

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One offer per start. Raises `InputError` for a plan of too many variables."""
        if (many := variables(problem, runs)) > MOST:
            raise InputError(
                f"runs: {runs} postures are {many} variables for ipopt, allowed: at most {MOST}; leave --solver out"
            )
        climb = Climber(problem, runs, self, budget)
        while True:
            yield Offer(climb(random_postures(problem, runs, generator)), 1, independent=True)
            climb.pass_on_interrupt()

    @property
    def options(self) -> dict[str, Any]:
        """Options of `casadi.nlpsol`."""
        warm = {"ipopt.mu_init": 1e-4, "ipopt.bound_push": 1e-6, "ipopt.bound_frac": 1e-6} if self.warm else {}
        return {
            **QUIET,
            **warm,
            "ipopt.tol": self.tolerance,
            "ipopt.max_iter": self.iterations,
            "ipopt.acceptable_tol": 1e-3,  # optimal plans are often a continuum, along which IPOPT would crawl:
            "ipopt.acceptable_obj_change_tol": 1e-11,  # it stops when the value stands still for some iterations
            "ipopt.acceptable_iter": 4,
            "ipopt.bound_relax_factor": 0.0,  # otherwise bounds are exceeded by 1e-8 and the optimum is "beaten"
        }


def variables(problem: DesignProblem, runs: int) -> int:
    """Joint angles that IPOPT moves."""
    return runs * len(problem.searched_joints)


def polishes(problem: DesignProblem, runs: int) -> bool:
    """Whether IPOPT improves what other solvers found: not where that takes longer than to search on."""
    return variables(problem, runs) <= POLISHED


class Climber:
    """IPOPT set up once for a problem; each call improves one plan (m, n) as far as it goes, or until time is up."""

    def __init__(self, problem: DesignProblem, runs: int, settings: Ipopt, budget: Budget) -> None:
        self.function = PlanFunction(problem, runs, problem.searched_joints)
        self.constraints = ConstraintFunction(problem, self.function.joints)
        self.problem = problem
        self.budget = budget
        self.base = np.tile(free_values(problem), (runs, 1))
        self.joints = list(self.function.joints)
        self.lower, self.upper = (np.tile(limit[self.joints], runs) for limit in (problem.lower, problem.upper))
        self.near_limit = np.tile(NEAR_LIMIT * problem.joint_units[self.joints], runs)
        self.interrupted = False
        self.expand, self.values = lru_cache(1)(self._expand), lru_cache(1)(self._values)  # IPOPT asks one by one
        self._callbacks = self._build()
        nlp = self._callbacks.pop("nlp")
        self.ipopt = ca.nlpsol("ipopt", "ipopt", nlp, settings.options | self._callbacks | {"no_nlp_grad": True})
        self._callbacks["nlp"] = nlp  # CasADi does not keep them alive

    def __call__(self, postures: Array) -> Array:
        """(m, n) a plan at least as good as the one given."""
        start = self.problem.clip(postures)[:, self.joints].ravel()
        if not start.size:  # a single link: every posture is as good as any other
            return self.postures(start)
        with interrupts_noted(self):
            ended = self.ipopt(x0=start, lbx=self.lower, ubx=self.upper, lbg=MARGIN, ubg=np.inf)
        found = np.asarray(ended["x"]).ravel()
        inside = np.clip(found, self.lower, self.upper)
        snapped = np.where(inside - self.lower < self.near_limit, self.lower, inside)
        snapped = np.where(self.upper - inside < self.near_limit, self.upper, snapped)
        plans = [self.postures(x) for x in (snapped, inside, start)]
        allowed = [plan for plan in plans if self.problem.feasible(plan).all()] or plans[-1:]
        return max(allowed, key=self.problem.objective)

    def pass_on_interrupt(self) -> None:
        """Raises the `KeyboardInterrupt` that came while IPOPT ran, now that its plan so far has been offered."""
        if self.interrupted:
            self.interrupted = False
            raise KeyboardInterrupt

    def postures(self, point: Array) -> Array:
        """(m, n) postures of the (m a,) variables."""
        plan = self.base.copy()
        plan[:, self.joints] = point.reshape(len(plan), -1)
        return plan

    def _build(self) -> dict[str, ca.Callback]:
        """Functions for `casadi.nlpsol`: f and g, grad f, jac g, the Hessian of the Lagrangian, and the stop."""
        size, rows = self.function.size, self.function.runs * self.constraints.rows
        x, scalar = ca.Sparsity.dense(size, 1), ca.Sparsity.dense(1, 1)
        g = ca.Sparsity.dense(rows, 1) if rows else ca.Sparsity(0, 1)
        point, multipliers = {"x": x, "p": ca.Sparsity(0, 0)}, {"lam_f": scalar, "lam_g": g}
        jacobian, upper = self.constraints.sparsity(self.function.runs), ca.Sparsity.upper(size)
        made = {
            "nlp": Guarded("nlp", point, {"f": scalar, "g": g}, self._objective),
            "grad_f": Guarded("grad_f", point, {"f": scalar, "grad_f_x": x}, self._gradient),
            "hess_lag": Guarded("hessian", point | multipliers, {"triu_hess_gamma_x_x": upper}, self._hessian),
            "iteration_callback": Stop(size, rows, self),
        }
        if rows:
            made["jac_g"] = Guarded("jac_g", point, {"g": g, "jac_g_x": jacobian}, self._jacobian)
        return made

    def _plan(self, point: bytes) -> Array:
        return self.postures(np.frombuffer(point))

    def _expand(self, point: bytes) -> tuple[float, Array, Array]:
        """Value, gradient, Hessian."""
        return self.function.expand(self._plan(point))

    def _values(self, point: bytes) -> list[Array]:
        """-f and g."""
        plan = self._plan(point)
        values = self.constraints.values(plan) if self.constraints.rows else np.empty(0)
        return [np.array([-self.function.value(plan)]), values]

    def _objective(self, x: Array, *_: Array) -> list[Array]:
        return self.values(x.tobytes())

    def _gradient(self, x: Array, *_: Array) -> list[Array]:
        value, slope, _hessian = self.expand(x.tobytes())
        return [np.array([-value]), -slope]

    def _jacobian(self, x: Array, *_: Array) -> list[Array]:
        plan = self.postures(x)
        return [self.constraints.values(plan), self.constraints.jacobian(plan)]

    def _hessian(self, x: Array, _p: Array, factor: Array, multipliers: Array) -> list[Array]:
        hessian = -float(factor[0]) * self.expand(x.tobytes())[2] + self.constraints.hessian(
            self.postures(x), multipliers
        )
        columns, rows = np.tril_indices(len(hessian))  # CasADi stores the upper triangle column by column
        return [hessian[rows, columns]]
