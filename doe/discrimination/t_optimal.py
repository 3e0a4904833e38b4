"""The next postures that distinguish the remaining explanations of a diagnosis.

A criterion related to T-optimality (Atkinson & Fedorov 1975) for several rivals. Let delta be the difference between
the new measurements predicted by i and by j, both fitted to the data at hand. If i is true and j is refitted to old and
new data together, its residual sum of squares, in units of the noise variance, grows by (noise apart)

    lambda_ij^2 = delta^T (sigma^2 I + J_j C_j J_j^T)^-1 delta

with C_j the covariance of rival j's parameters from the data at hand, J_j its Jacobian at the new postures. Postures
are added one at a time and then exchanged; C_j and what j has already given way to i are updated like a Kalman filter.
-2 log odds of j to i grow by a normal variable of mean lambda^2 and variance 4 lambda^2, which gives an upper
bound on the probability that the right candidate is the only one left within the window of the ambiguity set. All
candidates may be wrong: the bound is multiplied by their probability together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from doe.plan.ascent import IN_TIME
from doe.plan.plan import Plan
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.problem.spatial import refuse_contacts
from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.gap.result import Candidate, Diagnosis
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.status import Status

# reasons: doe/README.md, "T-optimality"
POOL = 1500  # random postures to choose from
SWEEPS = 2  # exchange passes after the greedy choice
WINDOW = 6.0  # -2 log odds, within which a rival is left: odds of 20
NUDGE = 1e-2  # weight of the smooth part of the merit, which leads where the probability is still flat


@dataclass(frozen=True)
class NextPostures:
    """The measurements that should distinguish the candidates.

    plan : (K) postures in the order of measurement
    payload : (K,) [kg], None if there was no choice;  directions : (K, n) of approach, None if they do not matter
    chance : upper bound on the predicted probability that only the right candidate is left
    pairs : (candidate, rival) -> expected lambda between them
    joint_types : (n) of the arm, empty: all revolute;  status : `local_optimum` or `time_limit`
    """

    plan: Plan
    payload: Array | None
    directions: Array | None
    chance: float
    pairs: dict[tuple[str, str], float]
    joint_types: tuple[str, ...] = ()
    status: Status = Status.local_optimum

    def __str__(self) -> str:
        cut = ", their search was cut" if self.status is Status.time_limit else ""
        chance = f"at most {100.0 * self.chance:.0f} %"
        return f"{len(self.plan)} postures{cut}; probability of resolving the ambiguity: {chance}"


@dataclass(frozen=True)
class _Options:
    """The pool: postures with the conditions under which they could be measured."""

    postures: Array  # (N, n)
    conditions: Conditions


@dataclass(frozen=True)
class RivalPredictions:
    """What is known of K candidates, and what they predict at the N postures of the pool.

    weights : (K,) probabilities if one of them is right;  right : probability that one is
    bic_lead : (K, K) BIC_j - BIC_i of rival j over truth i
    positions : (K, N, d) in units of sigma
    jacobians : K times (N, d, p_j) in units of sigma, parameters scaled such that their covariance is the identity
    """

    weights: Array
    bic_lead: Array
    positions: Array
    jacobians: list[Array]
    right: float = 1.0


def discriminate(
    arm: Arm,
    diagnosis: Diagnosis,
    measurements: Measurements,
    runs: int,
    seed: int = 0,
    payloads: tuple[float, ...] | None = None,
    pool: Array | None = None,
    stop: Callable[[], bool] = IN_TIME,
) -> NextPostures:
    """The `runs` measurements most likely to resolve an ambiguous diagnosis.

    payloads : [kg] that can be hung on the arm, default its own only;  pool : (N, n) [rad] to choose from, default
        random postures that are allowed;  stop : asked before every choice, see `t_optimal`

    Raises `InputError` for a diagnosis that is not ambiguous, or `runs` < 1, or if no posture is allowed.
    """
    if runs < 1:
        raise InputError(f"runs: {runs}, allowed: at least 1")
    if len(diagnosis.candidates) < 2:
        raise InputError(
            f"diagnosis: the verdict is {diagnosis.verdict}, allowed: ambiguous, with candidates to distinguish"
        )
    generator = np.random.default_rng(seed)
    if pool is None:
        refuse_contacts(arm.chain)
        pool = random_postures(DesignProblem.of(Model(arm)), POOL, generator)
    options = _pool(arm, pool, generator, payloads)
    rivals = _rivals(diagnosis, measurements, options)
    found = _result(diagnosis, rivals, options, t_optimal(rivals, runs, stop), payloads)
    return replace(found, status=Status.time_limit) if stop() else found


def t_optimal(rivals: RivalPredictions, runs: int, stop: Callable[[], bool] = IN_TIME) -> list[int]:
    """Rows of the pool, added one at a time and then exchanged, that distinguish the rivals best.

    Where `stop` comes before the last is added, those that are there are taken again, in turn.
    """
    chosen = [_best(rivals, [])]
    while len(chosen) < runs and not stop():
        chosen.append(_best(rivals, chosen))
    chosen = [chosen[k % len(chosen)] for k in range(runs)]
    for _ in range(SWEEPS):
        before = list(chosen)
        for k in range(runs):
            if stop():
                return chosen
            chosen[k] = _best(rivals, chosen[:k] + chosen[k + 1 :])
        if chosen == before:
            break
    return chosen


def _pool(arm: Arm, postures: Array, generator: np.random.Generator, payloads: tuple[float, ...] | None) -> _Options:
    """Postures, each with a payload and directions of approach."""
    count = len(postures)
    own = 0.0 if arm.gravity is None else arm.gravity.payload
    payload = generator.choice(np.array(payloads or (own,)), count)
    directions = generator.choice(np.array([-1.0, 1.0]), (count, arm.links))
    return _Options(postures, Conditions(payload, None, np.full(count, 0.5), directions))


def _rivals(diagnosis: Diagnosis, measurements: Measurements, options: _Options) -> RivalPredictions:
    """Predictions of every candidate, fitted to the data at hand, over the pool."""
    sigma = diagnosis.sigma
    positions, jacobians = [], []
    for candidate in diagnosis.candidates:
        model = Model(diagnosis.extended_arm(candidate))
        position, jacobian = model.linearize(options.postures, None, options.conditions)
        positions.append(position / sigma)
        jacobians.append(jacobian @ _root(candidate, model) / sigma)
    delta = np.array([candidate.delta_bic for candidate in diagnosis.candidates])
    weights = np.array([candidate.probability or 0.0 for candidate in diagnosis.candidates])
    right = float(weights.sum()) or 1.0
    weights = np.exp(-0.5 * delta) if weights.sum() == 0.0 else weights
    return RivalPredictions(
        weights / weights.sum(), delta[None, :] - delta[:, None], np.array(positions), jacobians, right
    )


def _root(candidate: Candidate, model: Model) -> Array:
    """(p, p) with root root^T the covariance of the candidate's parameters, in the model's order."""
    order = [candidate.calibration.parameter_names.index(name) for name in model.names]
    if candidate.calibration.covariance is None:
        raise InputError("diagnosis: a candidate has no covariance, allowed: the result of diagnose()")
    covariance = candidate.calibration.covariance[np.ix_(order, order)]
    scaled = covariance * np.outer(model.scales, model.scales)
    values, vectors = np.linalg.eigh(scaled)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)) / model.scales[:, None])


def _noncentrality(rivals: RivalPredictions, chosen: list[int]) -> tuple[Array, Array]:
    """(K, K) lambda^2 of the chosen postures, and (K, K, N) what each posture of the pool would add to it."""
    each = [_beside(rivals.positions, j, jacobian, chosen) for j, jacobian in enumerate(rivals.jacobians)]
    return np.stack([known for known, _ in each], axis=1), np.stack([gain for _, gain in each], axis=1)


def _beside(positions: Array, j: int, jacobian: Array, chosen: list[int]) -> tuple[Array, Array]:
    """(K,) lambda^2 of every rival beside rival j, whose Jacobian is (N, d, p), and (K, N) what a posture would add."""
    given = jacobian[chosen].reshape(-1, jacobian.shape[2])  # (d k, p), prior covariance of the parameters is I
    posterior = np.linalg.inv(np.eye(jacobian.shape[2]) + given.T @ given)
    spread = np.eye(jacobian.shape[1]) + np.einsum("nap,pq,nbq->nab", jacobian, posterior, jacobian, optimize=True)
    delta = positions - positions[j]
    known = delta[:, chosen].reshape(len(delta), -1)
    moved = known @ given @ posterior  # (K, p) what j's parameters give way
    left = delta - np.einsum("nap,kp->kna", jacobian, moved)
    gain = np.einsum("kna,nab,knb->kn", left, np.linalg.inv(spread), left, optimize=True)
    rest = known - moved @ given.T
    return np.sum(rest**2, axis=1) + np.sum(moved**2, axis=1), gain


def _best(rivals: RivalPredictions, chosen: list[int]) -> int:
    noncentrality, gain = _noncentrality(rivals, chosen)
    return int(np.argmax(_merit(rivals, noncentrality[:, :, None] + gain)))


def _merit(rivals: RivalPredictions, squares: Array) -> Array:
    """(N,) weighted sum over pairs of the chance to distinguish them, and a little of the logarithm of lambda^2."""
    chance = _pair_chance(rivals, squares)
    count = len(rivals.weights)
    off = 1.0 - np.eye(count)
    value = chance + NUDGE * np.log1p(squares)
    return np.asarray(np.einsum("i,ij,ijn->n", rivals.weights, off, value))


def _pair_chance(rivals: RivalPredictions, squares: Array) -> Array:
    """(K, K, N) probability that -2 log odds of rival j to truth i exceed the window."""
    length = np.sqrt(np.maximum(squares, 1e-12))
    return np.asarray(ndtr((squares + rivals.bic_lead[:, :, None] - WINDOW) / (2.0 * length)))


def _result(
    diagnosis: Diagnosis,
    rivals: RivalPredictions,
    options: _Options,
    chosen: list[int],
    payloads: tuple[float, ...] | None,
) -> NextPostures:
    noncentrality, _ = _noncentrality(rivals, chosen)
    chance = _pair_chance(rivals, noncentrality[:, :, None])[:, :, 0]
    np.fill_diagonal(chance, 1.0)
    names = [" + ".join(c.effects) for c in diagnosis.candidates]
    pairs = {
        (names[i], names[j]): float(np.sqrt(noncentrality[i, j]))
        for i in range(len(names))
        for j in range(len(names))
        if i != j
    }
    needs = frozenset().union(*(Model(diagnosis.extended_arm(c)).needs for c in diagnosis.candidates))
    conditions = options.conditions.rows(chosen)
    return NextPostures(
        Plan(options.postures[chosen]),
        readonly(conditions.payload) if payloads and conditions.payload is not None else None,
        readonly(conditions.directions) if "directions" in needs and conditions.directions is not None else None,
        rivals.right * float(rivals.weights @ chance.min(axis=1)),
        pairs,
        diagnosis.arm.joint_types,
    )
