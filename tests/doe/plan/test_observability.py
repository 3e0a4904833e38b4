"""Observability indices against the definitions, and their known relations to D and E."""

from __future__ import annotations

import numpy as np
import pytest

from doe.criteria import E
from doe.plan.accuracy import criterion_values, observability
from doe.problem.uncertain import workspace
from tests.doe.arms import FOUR, OFFSET, problem


def test_definitions() -> None:
    case = problem(FOUR, OFFSET)
    plan = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (9, 4))
    jacobian = (case.model.jacobian(plan) / case.model.parameters.scales).reshape(18, 10)
    eigenvalues = np.sort(np.linalg.eigvalsh(jacobian.T @ jacobian))
    s = np.sqrt(eigenvalues)
    found = observability(case, plan)
    assert found["o1"] == pytest.approx(np.prod(s) ** (1 / 10) / 3)
    assert found["o1"] == pytest.approx(np.exp(case.objective(plan) / 20))  # D
    assert found["o2"] == pytest.approx(s[0] / s[-1])
    assert found["o3"] == pytest.approx(np.sqrt(9 * float(E().value(case.information(plan)))))  # E
    assert found["o4"] == pytest.approx(s[0] ** 2 / s[-1])
    assert found["o5"] == pytest.approx(1 / np.sum(1 / s))
    assert set(found) == {"o1", "o2", "o3", "o4", "o5"}


def test_kept_postures_count_and_nothing_is_seen_by_too_few() -> None:
    plan = np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (9, 4))
    assert observability(problem(FOUR, kept=plan[5:]), plan[:5])["o3"] == pytest.approx(
        observability(problem(FOUR), plan)["o3"]
    )
    assert observability(problem(FOUR), plan[:3])["o1"] == 0.0
    assert observability(problem(FOUR), np.zeros((6, 4)))["o2"] == 0.0


def test_every_criterion_from_the_information_matrix() -> None:
    case = problem(FOUR, OFFSET)
    plan = np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (9, 4))
    jacobian = case.model.jacobian(plan) / case.model.parameters.scales
    m = np.einsum("idp,idq->pq", jacobian, jacobian) / 9
    inverse, lengths = np.linalg.inv(m), [unit == "mm" for unit in case.model.parameters.units]
    angles = np.logical_not(lengths)
    poses = case.model.jacobian(workspace(case)) / case.model.parameters.scales
    found = criterion_values(case, plan)
    assert found["D"] == pytest.approx(np.linalg.slogdet(m)[1])
    assert found["A"] == pytest.approx(-np.trace(inverse))
    assert found["E"] == pytest.approx(np.linalg.eigvalsh(m)[0])
    assert found["I"] == pytest.approx(-np.einsum("kdp,pq,kdq->", poses, inverse, poses) / len(poses))
    assert found["Ds"] == pytest.approx(-np.linalg.slogdet(inverse[lengths][:, lengths])[1])
    assert found["Dstar"] == pytest.approx(sum(np.linalg.slogdet(m[k][:, k])[1] for k in (lengths, angles)))
    assert criterion_values(case, plan[:2])["D"] is None
