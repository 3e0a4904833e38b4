"""The next postures that distinguish the remaining explanations of a diagnosis (doe/README.md, "T-optimality").

Postures are added one at a time and then exchanged; the covariance of a rival's parameters and what it has already
given way to the truth are updated like a Kalman filter. All candidates may be wrong: the bound on the probability that
the right one is the only one left is multiplied by their probability together.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from scipy.special import ndtr

from doe.problem.problem import DesignProblem, Stop, never, random_postures
from identification import Array, InputError, Plan, Status, require
from identification.document import Document, Documented


@dataclass(frozen=True, repr=False)
class NextPostures(Documented):
    """The measurements that should distinguish the candidates.

    plan : (K) postures in the order of measurement, and of their conditions `payload` (K,) [kg] where there was a
        choice
    directions : (K, n) of approach, +1 or -1 as the controller counts, where they matter
    chance : upper bound on the probability that only the right candidate is left, as linear models of all predict it:
        what evidence says of a rival's further parameters is not in it
    pairs : (candidate, rival) -> expected lambda between them;  diagnosis : of which the candidates are
    status : `local_optimum`, or what ended it
    """

    plan: Plan
    chance: float
    pairs: dict[tuple[str, str], float]
    diagnosis: Any
    status: Status = Status.local_optimum
    directions: Array | None = None

    @property
    def columns(self) -> dict[str, Array]:
        """Those of the plan file that say how to measure: payload and directions, where they matter."""
        payload = self.plan.conditions.get("payload")
        columns = {} if payload is None else {"payload_kg": payload}
        sides = () if self.directions is None else self.directions.T
        return columns | {f"direction{j}": side for j, side in enumerate(sides, start=1)}

    def to_json(self) -> dict[str, Any]:
        """Keys of `armcal discriminate` beside those of the diagnosis."""
        return {
            **self.plan.to_json(),
            "payload_kg": self.plan.conditions.get("payload"),
            "directions": self.directions,
            "chance": self.chance,
            "status": self.status.name,
            "pairs": [{"candidate": a, "rival": b, "lambda": size} for (a, b), size in self.pairs.items()],
        }

    def document(self) -> Document:
        """The chance, the rivals, the postures, and what to do before their rows can be appended: measurements without
        a payload column mean the arm's own payload."""
        arm, measured, beside = self.diagnosis.arm, self.diagnosis.measurements.conditions, dict[str, list[str]]()
        if (payload := self.plan.conditions.get("payload")) is not None:
            beside["payload_kg"] = [f"{value:g}" for value in payload]
        if self.directions is not None:
            sides = np.where(self.directions > 0.0, "+", "-")
            beside[f"directions 1 to {sides.shape[1]}"] = [" ".join(signs) for signs in sides.tolist()]
        notes = []
        if "payload_kg" in beside and measured.payload is None and arm.gravity is not None:
            notes = [f"note: the measured rows need a column payload_kg too: {arm.gravity.payload:g} in each of them"]
        cut = ", their search was cut" if self.status is not Status.local_optimum else ""
        chance = f"at most {100.0 * self.chance:.0f} %, by a linear estimate"
        verdict = f"{len(self.plan)} postures{cut}; probability that only the right candidate remains: {chance}"
        table = self.plan.sheet("Next postures", beside)
        return Document("Next postures", [verdict], [self.diagnosis.sentence, table, *notes])


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

    @classmethod
    def of(cls, diagnosis: Any, postures: Array, payload: Array | None, directions: Array) -> RivalPredictions:
        """Of every candidate, at postures (N, n), with payloads (N,) [kg] and directions of approach (N, n), as
        `Diagnosis.predictions` has them."""
        positions, jacobians, sigma = [], [], diagnosis.sigma
        for position, jacobian, covariance, scales in diagnosis.predictions(postures, payload, directions):
            values, vectors = np.linalg.eigh(covariance * np.outer(scales, scales))
            root = vectors * np.sqrt(np.maximum(values, 0.0)) / scales[:, None]
            positions.append(position / sigma)
            jacobians.append(jacobian @ root / sigma)
        odds = np.array([candidate.delta_bic for candidate in diagnosis.candidates])
        weights = np.array([candidate.probability or 0.0 for candidate in diagnosis.candidates])
        right = float(weights.sum()) or 1.0
        weights = weights if weights.any() else np.exp(-0.5 * (odds - odds.min()))
        return cls(weights / weights.sum(), odds - odds[:, None], np.array(positions), jacobians, right)

    def noncentrality(self, chosen: list[int]) -> tuple[Array, Array]:
        """(K, K) lambda^2 of the chosen postures, and (K, K, N) what each posture of the pool would add to it."""
        squares, gains = [], []
        for position, jacobian in zip(self.positions, self.jacobians, strict=True):  # of rival j
            measured = jacobian[chosen].reshape(-1, jacobian.shape[2])  # (d k, p), prior covariance of parameters is I
            posterior = np.linalg.inv(np.eye(jacobian.shape[2]) + measured.T @ measured)
            spread = np.einsum("nap,pq,nbq->nab", jacobian, posterior, jacobian, optimize=True)
            spread += np.eye(jacobian.shape[1])
            delta = self.positions - position
            seen = delta[:, chosen].reshape(len(delta), -1)
            moved = seen @ measured @ posterior  # (K, p) what j's parameters give way
            left = delta - np.einsum("nap,kp->kna", jacobian, moved)
            squares.append(np.sum((seen - moved @ measured.T) ** 2, axis=1) + np.sum(moved**2, axis=1))
            gains.append(np.einsum("kna,nab,knb->kn", left, np.linalg.inv(spread), left, optimize=True))
        return np.stack(squares, axis=1), np.stack(gains, axis=1)

    def pair_chance(self, squares: Array) -> Array:
        """(K, K, N) probability that -2 log odds of rival j to truth i exceed the window, of lambda^2."""
        length = np.sqrt(np.maximum(squares, 1e-12))
        # convention: a rival is left within -2 log odds of 6, odds of 20
        return np.asarray(ndtr((squares + self.bic_lead[:, :, None] - 6.0) / (2.0 * length)))

    def best_beside(self, chosen: list[int]) -> int:
        """Row of the pool of the greatest merit: the weighted sum over pairs of the chance to distinguish them, and a
        little of the logarithm of lambda^2."""
        noncentrality, gain = self.noncentrality(chosen)
        squares = noncentrality[:, :, None] + gain
        # effort: the smooth part leads where the probability is still flat
        merit = self.pair_chance(squares) + 1e-2 * np.log1p(squares)
        return int(np.argmax(np.einsum("i,ij,ijn->n", self.weights, 1.0 - np.eye(len(self.weights)), merit)))


def discriminate(
    model: Any, diagnosis: Any, runs: int, seed: int = 0, payloads: tuple[float, ...] | None = None, stop: Stop = never
) -> NextPostures:
    """The `runs` measurements most likely to resolve an ambiguous diagnosis.

    model : an arm, or any other;  diagnosis : what of it has `candidates`, `predictions`, `sigma` and `needs`
    payloads : [kg] that can be hung on the arm, default its own only;  stop : asked before every choice

    Raises `InputError` for a diagnosis that is not ambiguous, or `runs` < 1, or if no posture is allowed.
    """
    require(runs >= 1, f"runs: {runs}, allowed: at least 1")
    if len(diagnosis.candidates) < 2:
        raise InputError(f"diagnosis: the verdict is {diagnosis.verdict}, allowed: ambiguous, with several candidates")
    problem, generator = DesignProblem.of(model), np.random.default_rng(seed)
    pool = random_postures(problem, 1500, generator)  # effort
    # a payload and directions of approach for each posture, at random
    payload = generator.choice(np.array(payloads), len(pool)) if payloads else None
    directions = generator.choice(np.array([-1.0, 1.0]), pool.shape)
    rivals = RivalPredictions.of(diagnosis, pool, payload, directions)
    chosen, status = [rivals.best_beside([])], Status.interrupted
    with suppress(KeyboardInterrupt):
        for k in [*range(1, runs), *range(runs), *range(runs)]:  # effort: after the greedy choice two of exchanges
            if stop():
                break
            chosen[k : k + 1] = [rivals.best_beside(chosen[:k] + chosen[k + 1 :])]
        status = Status.time_limit if stop() else Status.local_optimum
    chosen = [chosen[k % len(chosen)] for k in range(runs)]  # cut: those that are there are taken again, in turn
    squares, _ = rivals.noncentrality(chosen)
    chance = rivals.pair_chance(squares[:, :, None])[:, :, 0]
    np.fill_diagonal(chance, 1.0)
    names = [" + ".join(candidate.effects) for candidate in diagnosis.candidates]
    conditions = {} if payload is None else {"payload": payload[chosen]}
    return NextPostures(
        Plan(pool[chosen], joint_types=problem.model.joint_types, conditions=conditions),
        rivals.right * float(rivals.weights @ chance.min(axis=1)),
        {(names[i], names[j]): float(np.sqrt(squares[i, j])) for i, j in permutations(range(len(names)), 2)},
        diagnosis,
        status,
        directions[chosen] if "directions" in diagnosis.needs else None,
    )
