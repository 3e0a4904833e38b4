"""Plans that are (nearly) D-optimal AND can distinguish missing effects (doe/README.md, "Misidentification").

Starting from the best plan, runs are swapped for postures that lower the bound on the probability of a wrong name, at
the cost of as much D-efficiency as is allowed. The order of measurement matters to backlash and drift only: the best of
many shuffles is kept.

*Swaps.* Runs are exchanged for postures of a pool: random ones of the design space and neighbors of the plan's own. The
first derivative of the criterion says which swaps to try, the criterion itself which is best; near the least
D-efficiency the derivative is mixed with that of the base model's log det. The pool is drawn again as long as that
helps. Every plan that is taken keeps the constraints and the least value, recomputed from the base problem.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.special import ndtr

from doe.criteria import information_matrix, log_determinants
from doe.plan.spacing import allowed_value
from doe.problem.model import DesignModel, offered
from doe.problem.problem import information_of_each, listed_candidates, random_postures
from doe.solvers import Solver, solve
from doe.solvers.solver import LONG_PLAN, LONG_PLAN_SECONDS, Budget
from identification import Array, Plan, Progress, Status, design_model, require, spectrum
from identification.document import Document, Documented

if TYPE_CHECKING:
    from doe.design import Design
    from doe.problem.problem import DesignProblem
    from identification import Arm

MOST_SEEN = 10_000  # postures; memory: of more, the columns of all effects take gigabytes
CLOUD = 512  # effort: postures
# length on random postures; any plan tells much larger effects apart, none much smaller ones
LAMBDA = 8.0
LOSS = 0.05  # convention: share of the D-efficiency that may be given up


@dataclass(frozen=True)
class EffectLibrary:
    """Rival effects: what a plan is to distinguish.

    base : p, parameters of the model that is to be identified; they come first in the models below
    shown_by_postures : the model with every effect that postures alone can show, K parameters more
    bases : per effect (K, s), the combinations of the K scaled parameters that it may take
    weights : (H,) how likely each effect is, in any unit
    jacobian_by_order : postures (m, n) in their order -> (m, d, p + L) scaled sensitivities with the effects that the
        order of measurement shows, as backlash and drift; None: there are none
    preflight : plan -> what measuring it could show of every effect; None: not needed
    """

    base: int
    shown_by_postures: DesignModel
    bases: Sequence[Array]
    weights: Array
    jacobian_by_order: Callable[[Array], Array] | None = None
    preflight: Callable[[Plan], Any] | None = None

    @classmethod
    def of(cls, arm: Arm) -> EffectLibrary:
        """The effects of the library that an arm can have, besides its own; without the rare ones."""
        return cls(*offered(design_model(arm), "rival_effects", "discriminating")())

    def in_order(self, postures: Array, generator: Generator, budget: Budget) -> Array:
        """(m, n) the order of many that shows backlash and drift best beside the model's parameters: by log det of what
        the data tell of the order's effects, beyond what the others explain; effort: it has a second in any case."""
        deadline = max(budget.deadline, perf_counter() + 1.0)
        shuffles = [generator.permutation(len(postures)) for _ in range(200)]  # effort
        scores, base, jacobian_of = list[float](), self.base, self.jacobian_by_order
        for order in shuffles:
            if jacobian_of is None or (scores and perf_counter() >= deadline):
                break
            jacobian = jacobian_of(postures[order])
            information = information_matrix(jacobian)
            cross = information[:base, base:]
            explained = cross.T @ spectrum(jacobian[..., :base], np.ones(base)).covariance @ cross
            scores.append(float(log_determinants(information[base:, base:] - explained)))
        return postures[shuffles[int(np.argmax(scores or [0.0]))]]


class MisidentificationBound:
    """The bound on the mean probability of a wrong name, of a plan's information matrix. -log of it is maximised.

    No criterion of optimality: it is no concave function of M, so there is no certificate for it.

    library : the effects, by `base`, `bases` and `weights`
    reference : (p + K, p + K) information per run of random postures
    """

    def __init__(self, library: EffectLibrary, reference: Array) -> None:
        self.base, self.reference = library.base, reference
        schur, whole = self._off_base(reference)[0], np.diag(reference)[self.base :]
        directions, owners, shares = list[Array](), list[int](), list[float]()
        for number, basis in enumerate(library.bases):
            axes = np.eye(basis.shape[1])  # unit vectors, and along the sum and the difference of every two
            mixes = [*axes, *((a + sign * b) / np.sqrt(2.0) for a, b in combinations(axes, 2) for sign in (1.0, -1.0))]
            lengths = ((v, float(v @ schur @ v)) for v in (basis @ mix for mix in mixes))
            # numerical: no plan is judged by a direction that hardly leaves the base model
            shown = [v * (LAMBDA / np.sqrt(length)) for v, length in lengths if length > 1e-9 * float(v**2 @ whole)]
            directions += shown
            owners += [number] * len(shown)
            shares += [float(library.weights[number]) / len(shown) for _ in shown]
        # (D, K) effects, each `LAMBDA` long on random postures, in the scaled parameters
        self.directions, probabilities = np.array(directions), np.array(shares) / np.sum(shares)
        # of each rival its basis (K, s), a ridge that keeps the inverse of one that a plan hides, and (D,) how probable
        # the others are; the first explains nothing, and what the base model explains on any plan is no rival
        self.rivals = [(np.empty((len(schur), 0)), 0.0, probabilities)]
        for number in dict.fromkeys(owners):
            basis, others = library.bases[number], probabilities * (np.array(owners) != number)
            self.rivals.append((basis, 1e-12 * max(float(np.trace(basis.T @ schur @ basis)), 1e-300), others))

    def wrong(self, information: Array) -> Array:
        """(...) bound on the mean probability of a wrong name; infinite where the base model's part is singular."""
        p = self.base
        usable = np.isfinite(log_determinants(information[..., :p, :p]))
        schur = self._off_base(np.where(usable[..., None, None], information, self.reference))[0]
        lengths = np.sum((self.directions @ schur) * self.directions, axis=-1)
        total = np.zeros(usable.shape)
        for probabilities, shown, _, fitted in self._explained(schur):
            d = np.sqrt(np.maximum(lengths - np.sum(shown * fitted, axis=-1), 0.0))
            total += ndtr(-0.5 * d) @ probabilities
        return np.where(usable, total, np.inf)

    def gradient(self, information: Array) -> Array:
        """(p + K, p + K) derivative of -log of `wrong`: each pair adds its residual's u u^T (envelope theorem)."""
        schur, base = self._off_base(information)
        total = np.zeros(schur.shape)
        for probabilities, _, basis, fitted in self._explained(schur):
            u = self.directions - fitted @ basis.T
            # numerical: the gradient is infinite where two effects are the same, d = 0; the value itself is exact
            d = np.maximum(np.sqrt(np.maximum(np.sum((u @ schur) * u, axis=1), 0.0)), 0.05)
            slopes = probabilities * np.exp(-(d**2) / 8.0) / (4.0 * d * np.sqrt(2.0 * np.pi))
            total += (u * slopes[:, None]).T @ u
        lift = np.vstack([base, np.eye(len(schur))])
        return np.asarray(lift @ total @ lift.T / self.wrong(information))

    def _off_base(self, information: Array) -> tuple[Array, Array]:
        """S (..., K, K), and (..., p, K) what the base parameters must do to leave that."""
        p = self.base
        cross = information[..., :p, p:]
        base = np.asarray(-np.linalg.solve(information[..., :p, :p], cross), float)
        return information[..., p:, p:] + np.swapaxes(cross, -1, -2) @ base, base

    def _explained(self, schur: Array) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Per rival (D,) probabilities, (..., D, s) B^T S v, B, and its parameters nearest to each v (..., D, s)."""
        seen = self.directions @ schur
        for basis, ridge, probabilities in self.rivals:
            gram, shown = basis.T @ schur @ basis, seen @ basis
            yield probabilities, shown, basis, shown @ np.linalg.inv(gram + ridge * np.eye(basis.shape[1]))


# -- the plan ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, repr=False)
class Discrimination(Documented):
    """What a plan distinguishes, what it loses for that against the best one, and what it cannot see.

    design : judged by the criterion of the problem;  best : the best plan without regard to missing effects
    swaps : what judges both
    random_wrong : the median of `Swaps.wrong` of many plans of as many random postures
    """

    design: Design
    best: Design
    swaps: Swaps
    random_wrong: float

    judged = cached_property(lambda self: self.swaps.judged(self.design.plan))
    best_judged = cached_property(lambda self: self.swaps.judged(self.best.plan))
    sees = property(lambda self: self.judged[0])
    wrong = property(lambda self: self.judged[1])
    best_sees = property(lambda self: self.best_judged[0])
    best_wrong = property(lambda self: self.best_judged[1])

    @property
    def relative_efficiency(self) -> float:
        """D-efficiency relative to the best plan found."""
        criterion, p = self.design.problem.criterion, self.design.problem.parameters
        return criterion.efficiency(self.design.value, self.best.value, p)

    def to_json(self) -> dict[str, Any]:
        """The keys that `--discriminating` adds to those of a design.

        `not_visible`: effects of which less than a hundredth of a column's norm is left for the tests to see.
        """
        invisible = [
            [] if sees is None else [n for n, left in zip(sees.names, sees.norm_fractions, strict=True) if left < 0.01]
            for sees in (self.sees, self.best_sees)
        ]
        wrong = {"plan": self.wrong, "best_plan": self.best_wrong, "random_postures": self.random_wrong}
        return {
            "relative_efficiency": self.relative_efficiency,
            "wrong_name_at_most": wrong,
            "preflight": None if self.sees is None else self.sees.to_json(),
            "not_visible": invisible[0],
            "not_visible_in_best_plan": invisible[1],
        }

    def document(self) -> Document:
        """The plan, the efficiency that it gives up, and what it can detect in return."""
        parts: list[Any] = [
            f"D-efficiency relative to the best plan found: {self.relative_efficiency:.4f}",
            f"probability that a missing effect gets a wrong name: at most {self.wrong:.3f} "
            f"(the best plan: {self.best_wrong:.3f}, random postures: {self.random_wrong:.3f})",
            f"  for effects whose total shift (root sum of squares) at as many random postures is {LAMBDA:g} sigma; "
            "gear ripple, backlash and drift are left out",
        ]
        if self.sees is not None and self.best_sees is not None:
            data = self.to_json()
            clear, blind = (", ".join(data[f"not_visible{which}"]) or "none" for which in ("", "_in_best_plan"))
            parts += [f"effects that it cannot show: {clear} (the best plan: {blind})", *self.sees.document().parts]
        elif len(self.design.plan) > MOST_SEEN:
            parts.append(f"what a plan of more than {MOST_SEEN:,} runs can detect is not computed")
        return self.design.document().plus(*parts)


def discrimination_design(
    problem: DesignProblem,
    effects: Arm | EffectLibrary,
    runs: int,
    *,
    solver: Solver | str | None = None,
    seed: int = 0,
    starts: int | None = None,
    seconds: float | None = None,
    progress: Progress = Progress(),
) -> Discrimination:
    """The plan of `runs` measurements that shows missing effects best, at a D-efficiency within `LOSS` of the best.

    effects : which may be missing: those of the library that this arm can have, or others
    solver, starts : of the search for the best plan, as in `solve`
    seconds : for both searches together, half of it for the best plan; left out: none up to 100 runs, 60 s for more
    Raises `InputError` for a criterion other than D, and too few runs (4 residual degrees of freedom are needed).
    Ctrl-C returns the plan so far, status `interrupted`.
    """
    require(problem.criterion.name == "D", f"criterion: {problem.criterion.name} for a discriminating plan, allowed: D")
    began = perf_counter()
    library = effects if isinstance(effects, EffectLibrary) else EffectLibrary.of(effects)
    if runs > LONG_PLAN and starts is None and seconds is None:
        seconds = 2.0 * LONG_PLAN_SECONDS
    budget = Budget(1, began + (np.inf if seconds is None else seconds))
    half = None if seconds is None else seconds / 2.0
    # from searched postures: those of theory are at few angles, which hide effects
    best = solve(problem, runs, solver or "exchange", seed=seed, starts=starts, seconds=half, progress=progress)
    generator, state = np.random.default_rng(seed), Swaps(problem, library)
    chosen, status = np.array(best.plan.postures), best.status
    if status is not Status.interrupted:
        allowed = problem.parameters * float(-np.log1p(-LOSS))
        try:
            for postures in state.improved(chosen, best.value - allowed, generator, budget, progress):
                chosen = postures
            status = Status.time_limit if budget.ended() else Status.local_optimum
        except KeyboardInterrupt:
            status = Status.interrupted
    plan = replace(best.plan, postures=library.in_order(chosen, generator, budget))
    design = replace(best, plan=plan, solver="discriminating", status=status, seconds=perf_counter() - began)

    # as many random postures, the median of many plans; effort: fewer plans of thousands of runs, which are much alike
    dice, many = np.random.default_rng(0), max(1, min(25, 100_000 // runs))
    cloud = pool_of(state.extended, many * runs, dice)
    at_random = float(np.median([state.wrong(dice.permutation(cloud)[:runs]) for _ in range(many)]))
    return Discrimination(design, best, state, min(1.0, at_random))


# -- swaps -------------------------------------------------------------------------------------------------------------
def pool_of(problem: DesignProblem, count: int, generator: Generator) -> Array:
    """(count, n) random postures of the design space; all of a list that is shorter."""
    if problem.choices is None:
        return random_postures(problem, count, generator)
    return generator.permutation(np.unique(listed_candidates(problem, problem.choices), axis=0))[:count]


class Swaps:
    """A design space with every effect in the model that postures alone can show, and the bound on wrong names there.

    problem : for the model that is to be identified;  extended : with the effects, whose parameters come last
    """

    def __init__(self, problem: DesignProblem, library: EffectLibrary) -> None:
        # as tests see it: in space with a minimal set of parameters, which has no prior
        shown = set(library.shown_by_postures.parameters.names) if library.base == problem.parameters else ()
        deviations = {name: size for name, size in problem.deviations.items() if name in shown}
        self.problem, self.library = problem, library
        self.extended = replace(problem, model=library.shown_by_postures, deviations=deviations)
        cloud = pool_of(problem, CLOUD, np.random.default_rng(0))
        reference = information_matrix(self.extended.scaled_jacobians(cloud)) / len(cloud)
        self.bound = MisidentificationBound(library, reference)

    def wrong(self, postures: Array) -> float:
        """Bound on the mean probability of a wrong name that a plan leaves, see `MisidentificationBound.wrong`."""
        return float(self.bound.wrong(self.extended.information(postures)))

    def judged(self, plan: Plan) -> tuple[Any, float]:
        """Pre-flight of a plan (`Detectability`), with the postures measured already, None where the library has none,
        and of more than `MOST_SEEN` postures; and what the mean probability of a wrong name is at most, for effects
        that postures show and that are `LAMBDA` long on random ones."""
        kept, sides, preflight = self.problem.kept, plan.conditions.get("directions"), self.library.preflight
        if sides is not None:  # of those by their order
            sides = np.vstack([np.sign(np.diff(kept, axis=0, prepend=kept[:1])), sides])
        every = replace(plan, postures=np.vstack([kept, plan.postures]), conditions={"directions": sides})
        sees = None if preflight is None or len(every) > MOST_SEEN else preflight(every)
        return sees, min(1.0, self.wrong(plan.postures))

    def pool(self, plan: Array, generator: Generator) -> Array:
        """(k, n) random postures, and neighbors of those of the plan."""
        drawn = 1500  # effort
        pool = pool_of(self.problem, drawn, generator)
        if self.problem.choices is not None:
            return pool
        near = plan[generator.integers(len(plan), size=drawn)]
        width = 0.15 * (self.problem.upper - self.problem.lower)  # effort: neighbors by this part of a range
        near = self.problem.clip(near + width * generator.uniform(-1.0, 1.0, near.shape))
        return np.concatenate([pool, near[self.problem.feasible(near)]])

    def improved(
        self, postures: Array, least: float, generator: Generator, budget: Budget, progress: Progress = Progress()
    ) -> Iterator[Array]:
        """(m, n) the plan, and it after every swap, better and better;  least : of the base problem's criterion

        Each is the best of the swaps of a few runs and postures whose derivatives promise most; little of log det is
        left to lose in the end, so its derivative is mixed in.
        """
        yield postures
        problem, p, total = self.problem, self.bound.base, len(postures) + self.problem.prior.runs
        plan, jacobians = np.array(postures), self.extended.scaled_jacobians(postures)
        value, kept = float(-np.log(self.wrong(plan))), allowed_value(problem, plan)
        rounds, gain, outs, ins = 5, 1e-3, 30, 8  # effort: of pools; of the criterion, below which swaps end; of a swap
        for number in range(rounds):
            before, pool, swapped = value, self.pool(plan, generator), True
            columns, free = self.extended.scaled_jacobians(pool), np.ones(len(pool), dtype=bool)
            if problem.choices is not None and problem.minimum_distance > 0.0:  # no place for what is in the plan
                free = ~np.any(np.all(pool[:, None] == plan, axis=-1), axis=1)
            while swapped and not budget.ended():
                information, pairs, swapped = self.extended.information(plan), list[NDArray[np.intp]](), False
                for multiplier in (0.0, 2.0, 10.0):
                    gradient = self.bound.gradient(information)
                    gradient[:p, :p] += multiplier * np.linalg.inv(information[:p, :p])
                    losses = np.sum((jacobians @ gradient) * jacobians, axis=(1, 2))
                    slopes = np.where(free, np.sum((columns @ gradient) * columns, axis=(1, 2)), -np.inf)
                    runs, places = np.argsort(losses)[:outs], np.argsort(-slopes)[: min(ins, int(free.sum()))]
                    pairs.append(np.stack(np.meshgrid(runs, places, indexing="ij"), axis=-1).reshape(-1, 2))
                runs, places = np.unique(np.concatenate(pairs), axis=0).T
                change = information_of_each(columns[places]) - information_of_each(jacobians[runs])
                after = information + change / total
                lost = np.linalg.slogdet(information[:p, :p])[1] - np.linalg.slogdet(after[:, :p, :p])[1]
                added = np.where(lost <= kept - least, -np.log(self.bound.wrong(after)) - value, -np.inf)
                for k in np.argsort(-added)[: int(np.sum(added > gain))].tolist():
                    run, place, trial = runs[k], places[k], np.array(plan)
                    trial[run], free[place] = pool[place], False
                    # the plan keeps its least value and its distances; else the posture is not tried again
                    if (reached := allowed_value(problem, trial)) >= least:
                        plan, kept, value, swapped = trial, reached, value + float(added[k]), True
                        jacobians[run] = columns[place]
                        yield plan
                        progress(number, rounds, f"wrong names at most {float(np.exp(-value)):.3f}")
                        break
            if budget.ended() or value < before + 10.0 * gain:
                break
