"""IPOPT from several starts, with exact first and second derivatives of the criterion and of the constraints.

    f(q_1, ..., q_m) = Phi(M),   M = (sum_i B_i^T B_i + K) / N

with B_i = B(q_i), K what is known from k runs already (`PriorInformation`), N = m + k. By the chain rule, with
G = dPhi/dM and X_ia = dM/dq_ia,

    df/dq_ia            = (2/N) tr(G B_i^T dB_i/dq_a)
    d2f/dq_ia dq_kb     = D^2 Phi[X_ia, X_kb] + (2/N) [i = k] ( tr(G dB_a^T dB_b) + tr(G B^T d2B_ab) )

B and its derivatives come from `doe.problem.problem`; CasADi calls numpy for them, since Phi is numpy's. Of a criterion
without second derivatives (E) its smooth stand-in is climbed.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.random import Generator

from doe.criteria import information_matrix
from doe.plan.ascent import PlanAscent
from doe.problem.problem import DesignProblem, random_postures
from doe.solvers.solver import Budget, Offer
from identification import Array, require


@dataclass(frozen=True)
class Ipopt:
    """Interior point method from random postures."""

    name: str = "ipopt"

    def starts_for(self, problem: DesignProblem) -> int:
        """Ten per joint."""
        return 10 * max(1, len(problem.searched_joints))

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """One offer per start. Raises `InputError` for a plan of too many variables."""
        most = 5000  # variables, whose second derivatives are dense: 0.2 GB, and 10 s for each step
        many, allowed = runs * len(problem.searched_joints), f"at most {most}; leave --solver out"
        require(many <= most, f"runs: {runs} postures are {many} variables for ipopt, allowed: {allowed}")
        climb = Climber(problem, runs, budget)
        while True:
            yield Offer(climb(random_postures(problem, runs, generator)), 1, independent=True)
            if climb.interrupted:
                raise KeyboardInterrupt


class Climber:
    """IPOPT set up once for a problem; each call improves one plan (m, n) as far as it goes, or until time is up.

    Variables and derivatives are ordered run by run, joint by joint of the searched ones: (m a), (m a, m a).
    interrupted : whether Ctrl-C came during a call, which then returns what there is
    """

    def __init__(self, problem: DesignProblem, runs: int, budget: Budget) -> None:
        self.problem, self.runs, self.ascent, self.interrupted = problem, runs, PlanAscent(problem), False
        self.joints, self.walls = self.ascent.joints, problem.walls
        # IPOPT asks one by one
        self.rise = lru_cache(1)(lambda x: self.ascent.rise(self.postures(np.frombuffer(x))))
        self.margins = lru_cache(1)(lambda x: self.walls.values(self.postures(np.frombuffer(x))).ravel())
        each = self.walls.values(problem.lower[None]).shape[1]
        size, rows = runs * len(self.joints), runs * each
        x, scalar, g = (ca.Sparsity.dense(length, 1) for length in (size, 1, rows))
        point, multipliers = {"x": x, "p": ca.Sparsity(0, 0)}, {"lam_f": scalar, "lam_g": g}
        hessian = {"triu_hess_gamma_x_x": ca.Sparsity.upper(size)}
        lengths = {"f": 1, "x": size, "lam_x": size, "g": rows, "lam_g": rows}
        names = [ca.nlpsol_out(k) for k in range(ca.nlpsol_n_out())]
        state = {name: ca.Sparsity.dense(lengths.get(name, 0), min(lengths.get(name, 0), 1)) for name in names}
        self._callbacks: dict[str, ca.Callback] = {  # CasADi does not keep them alive
            "nlp": NumpyFunction(point, {"f": scalar, "g": g}, self._values),
            "grad_f": NumpyFunction(point, {"f": scalar, "grad_f_x": x}, self._gradient),
            "hess_lag": NumpyFunction(point | multipliers, hessian, self._hessian),
            "iteration_callback": NumpyFunction(
                state, {"ret": scalar}, lambda *_: [np.array([float(self.interrupted or budget.ended())])]
            ),
        }
        if rows:  # a run's constraints depend on its own joints only
            jacobian = ca.diagcat(*[ca.Sparsity.dense(each, len(self.joints))] * runs)
            self._callbacks["jac_g"] = NumpyFunction(point, {"g": g, "jac_g_x": jacobian}, self._jacobian)
        options: dict[str, Any] = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "show_eval_warnings": False,
            "no_nlp_grad": True,
            "ipopt.tol": 1e-10,
            "ipopt.max_iter": 150,
            "ipopt.acceptable_tol": 1e-3,  # optimal plans are often a continuum, along which IPOPT would crawl:
            "ipopt.acceptable_obj_change_tol": 1e-11,  # it stops when the value stands still for some iterations
            "ipopt.acceptable_iter": 4,
            "ipopt.bound_relax_factor": 0.0,  # otherwise bounds are exceeded by 1e-8 and the optimum is "beaten"
        }
        options |= {name: function for name, function in self._callbacks.items() if name != "nlp"}
        self.ipopt = ca.nlpsol("ipopt", "ipopt", self._callbacks["nlp"], options)

    def __call__(self, postures: Array) -> Array:
        """(m, n) a plan at least as good as the one given."""
        start = self.problem.clip(postures)[:, self.joints].ravel()
        if not start.size:  # a single link: every posture is as good as any other
            return self.postures(start)
        lower, upper = (np.tile(limit[self.joints], self.runs) for limit in (self.problem.lower, self.problem.upper))
        with ThreadPoolExecutor(1) as thread:  # within CasADi, which swallows exceptions, Ctrl-C would be lost
            # constraints are kept by more [mm], since IPOPT keeps them to about 1e-8 only
            search = thread.submit(self.ipopt, x0=start, lbx=lower, ubx=upper, lbg=1e-4, ubg=np.inf)
            while not search.done():
                try:
                    wait([search], 0.1)
                except KeyboardInterrupt:  # IPOPT ends after its step
                    self.interrupted = True
        inside = np.clip(np.asarray(search.result()["x"]).ravel(), lower, upper)
        # an interior point method ends this near to a limit that is active; it is put on it
        near = np.tile(1e-5 * self.problem.joint_units[self.joints], self.runs)
        snapped = np.where(inside - lower < near, lower, np.where(upper - inside < near, upper, inside))
        plans = [self.postures(point) for point in (snapped, inside, start)]
        allowed = [plan for plan in plans if self.problem.feasible(plan).all()] or plans[-1:]
        return max(allowed, key=self.problem.objective)

    def postures(self, point: Array) -> Array:
        """(m, n) postures of the (m a,) variables; joints that play no part stay in the middle."""
        plan = np.tile((self.problem.lower + self.problem.upper) / 2.0, (self.runs, 1))
        plan[:, self.joints] = point.reshape(self.runs, -1)
        return plan

    def hessian(self, postures: Array) -> Array:
        """(m a, m a) of f. Raises numpy's `LinAlgError` where the information matrix is singular."""
        jacobian, first = self.ascent.derivatives.first(postures)
        m, a, d, p = first.shape
        total = m + self.problem.prior.runs
        information = self.problem.prior.information(information_matrix(jacobian), m)
        gradient = self.ascent.criterion.gradient(information)
        half = np.swapaxes(jacobian, -1, -2)[:, None] @ first  # B^T dB_a, (m, a, p, p)
        directions = (half + np.swapaxes(half, -1, -2)).reshape(m * a, p, p) / total
        hessian = self.ascent.criterion.curvature(information, directions).reshape(m, a, m, a)
        bend = first.reshape(m, a, d * p) @ np.swapaxes((first @ gradient).reshape(m, a, d * p), -1, -2)
        bend += self.ascent.derivatives.bend(postures, jacobian @ gradient)
        hessian[np.arange(m), :, np.arange(m), :] += (2.0 / total) * bend
        return hessian.reshape(m * a, m * a)

    # -- what CasADi asks for: of -f, which it minimises, and of g
    def _values(self, x: Array, *_: Array) -> list[Array]:
        return [np.array([-self.rise(x.tobytes())[0]]), self.margins(x.tobytes())]

    def _gradient(self, x: Array, *_: Array) -> list[Array]:
        value, slopes = self.rise(x.tobytes())
        return [np.array([-value]), -slopes.ravel()]

    def _jacobian(self, x: Array, *_: Array) -> list[Array]:
        """In the order of CasADi's columns: run, joint, constraint."""
        values, first = self.walls.first(self.postures(x))
        return [values.ravel(), first.ravel()]

    def _hessian(self, x: Array, _p: Array, factor: Array, multipliers: Array) -> list[Array]:
        hessian = -float(factor[0]) * self.hessian(self.postures(x))
        if multipliers.size:
            blocks = hessian.reshape(self.runs, len(self.joints), self.runs, len(self.joints))
            runs = np.arange(self.runs)
            blocks[runs, :, runs, :] += self.walls.bend(self.postures(x), multipliers.reshape(self.runs, -1))
        columns, rows = np.tril_indices(len(hessian))  # CasADi stores the upper triangle column by column
        return [hessian[rows, columns]]


class NumpyFunction(ca.Callback):
    """A numpy function as a CasADi function of named inputs and outputs. Failures become NaN, which IPOPT answers by a
    shorter step."""

    def __init__(
        self, inputs: dict[str, ca.Sparsity], outputs: dict[str, ca.Sparsity], function: Callable[..., list[Array]]
    ) -> None:
        ca.Callback.__init__(self)
        self.inputs, self.outputs, self.function = list(inputs.items()), list(outputs.items()), function
        self.construct("numpy", {})

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
            values = self.function(*(np.asarray(a).ravel() for a in arguments))
            return [ca.DM(sparsity, value) for (_, sparsity), value in zip(self.outputs, values, strict=True)]
        except np.linalg.LinAlgError:
            return [ca.DM(sparsity, np.nan) for _, sparsity in self.outputs]
