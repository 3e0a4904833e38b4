"""IPOPT from several starts, with exact first and second derivatives of the criterion and of the constraints."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from doe.problem import DesignProblem
from doe.solvers.base import Budget, Offer, free_values, random_postures
from doe.solvers.derivatives import PlanFunction
from identification.arm import Array

NEAR_LIMIT = 1e-5  # [rad] an interior point method ends this near to a limit that is active; it is put on it

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "show_eval_warnings": False}


@dataclass(frozen=True)
class Ipopt:
    """Interior point method from random postures.

    tolerance : of IPOPT's optimality error;  iterations : at most, per start
    warm : True: stay near the start (it is nearly optimal already), False: first move away from the limits
    """

    tolerance: float = 1e-10
    iterations: int = 300
    warm: bool = False
    name: str = "ipopt"

    def starts_for(self, problem: DesignProblem) -> int:
        """Ten per joint."""
        return 10 * max(1, len(problem.searched_joints))

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One offer per start."""
        climb = Climber(problem, runs, self, budget)
        while True:
            yield Offer(climb(random_postures(problem, runs, generator)), 1, independent=True)

    @property
    def options(self) -> dict[str, Any]:
        """Options of `casadi.nlpsol`."""
        warm = {"ipopt.mu_init": 1e-4, "ipopt.bound_push": 1e-6, "ipopt.bound_frac": 1e-6} if self.warm else {}
        return {
            **QUIET,
            **warm,
            "ipopt.tol": self.tolerance,
            "ipopt.max_iter": self.iterations,
            "ipopt.bound_relax_factor": 0.0,  # otherwise bounds are exceeded by 1e-8 and the optimum is "beaten"
        }


class Climber:
    """IPOPT set up once for a problem; each call improves one plan (m, n) as far as it goes, or until time is up."""

    def __init__(self, problem: DesignProblem, runs: int, settings: Ipopt, budget: Budget) -> None:
        self.function = PlanFunction(problem, runs, problem.searched_joints)
        self.problem = problem
        self.budget = budget
        self.base = np.tile(free_values(problem), (runs, 1))
        self.joints = list(self.function.joints)
        self.lower, self.upper = (np.tile(limit[self.joints], runs) for limit in (problem.lower, problem.upper))
        self.interrupted = False
        self._expansion: tuple[bytes, tuple[float, Array, Array]] | None = None
        self._callbacks = self._build()
        nlp, gradient, hessian, stop = self._callbacks
        options = {"grad_f": gradient, "hess_lag": hessian, "iteration_callback": stop, "no_nlp_grad": True}
        self.ipopt = ca.nlpsol("ipopt", "ipopt", nlp, settings.options | options)

    def __call__(self, postures: Array) -> Array:
        """(m, n) a plan at least as good as the one given."""
        start = self.problem.clip(postures)[:, self.joints].ravel()
        if not start.size:  # a single link: every posture is as good as any other
            return self.postures(start)
        found = np.asarray(self.ipopt(x0=start, lbx=self.lower, ubx=self.upper)["x"]).ravel()
        if self.interrupted:
            self.interrupted = False
            raise KeyboardInterrupt
        ended = np.clip(found, self.lower, self.upper)
        snapped = np.where(ended - self.lower < NEAR_LIMIT, self.lower, ended)
        snapped = np.where(self.upper - ended < NEAR_LIMIT, self.upper, snapped)
        plans = [self.postures(x) for x in (snapped, ended, start)]
        return max(plans, key=self.problem.objective)

    def postures(self, point: Array) -> Array:
        """(m, n) postures of the (m a,) variables."""
        plan = self.base.copy()
        plan[:, self.joints] = point.reshape(len(plan), -1)
        return plan

    def expand(self, point: Array) -> tuple[float, Array, Array]:
        """Value, gradient, Hessian; the last point's are kept, since IPOPT asks for them one by one."""
        key = point.tobytes()
        if self._expansion is None or self._expansion[0] != key:
            self._expansion = (key, self.function.expand(self.postures(point)))
        return self._expansion[1]

    def _build(self) -> tuple[ca.Callback, ...]:
        size = self.function.size
        x, scalar, none = ca.Sparsity.dense(size, 1), ca.Sparsity.dense(1, 1), ca.Sparsity(0, 1)
        parameters = {"x": x, "p": ca.Sparsity(0, 0)}
        upper = ca.Sparsity.upper(size)
        columns, rows = np.tril_indices(size)  # CasADi stores the upper triangle column by column

        def objective(x: Array, *_: Array) -> list[Any]:
            return [-self.function.value(self.postures(x)), ca.DM(none)]

        def gradient(x: Array, *_: Array) -> list[Any]:
            value, slope, _hessian = self.expand(x)
            return [-value, ca.DM(-slope)]

        def hessian(x: Array, _p: Array, factor: Array, *_: Array) -> list[Any]:
            return [ca.DM(upper, -float(factor[0]) * self.expand(x)[2][rows, columns])]

        multipliers = {"lam_f": scalar, "lam_g": none}
        return (
            Guarded("nlp", parameters, {"f": scalar, "g": none}, objective, self),
            Guarded("grad_f", parameters, {"f": scalar, "grad_f_x": x}, gradient, self),
            Guarded("hessian", parameters | multipliers, {"triu_hess_gamma_x_x": upper}, hessian, self),
            Stop(size, 0, self),
        )


class Guarded(ca.Callback):
    """A numpy function as a CasADi function. Failures become NaN, which IPOPT answers by a shorter step."""

    def __init__(
        self,
        name: str,
        inputs: dict[str, ca.Sparsity],
        outputs: dict[str, ca.Sparsity],
        function: Callable[..., list[Any]],
        owner: Climber,
    ) -> None:
        ca.Callback.__init__(self)
        self.inputs, self.outputs, self.function, self.owner = (
            list(inputs.items()),
            list(outputs.items()),
            function,
            owner,
        )
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self.inputs)

    def get_n_out(self) -> int:
        return len(self.outputs)

    def get_name_in(self, i: int) -> str:
        return self.inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self.outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self.inputs[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self.outputs[i][1]

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        try:
            return self.function(*(np.asarray(a).ravel() for a in arguments))
        except np.linalg.LinAlgError:
            pass
        except KeyboardInterrupt:  # an exception would be lost inside CasADi
            self.owner.interrupted = True
        return [ca.DM(sparsity, np.nan) for _, sparsity in self.outputs]


class Stop(ca.Callback):
    """Ends IPOPT when time is up or the user pressed Ctrl-C."""

    def __init__(self, size: int, constraints: int, owner: Climber) -> None:
        ca.Callback.__init__(self)
        self.size, self.constraints, self.owner = size, constraints, owner
        self.construct("stop", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return ca.nlpsol_out(i)

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        rows = {"f": 1, "x": self.size, "lam_x": self.size, "g": self.constraints, "lam_g": self.constraints}
        count = rows.get(ca.nlpsol_out(i), 0)
        return ca.Sparsity.dense(count, 1) if count else ca.Sparsity(0, 0)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        return [float(self.owner.interrupted or self.owner.budget.out_of_time)]
