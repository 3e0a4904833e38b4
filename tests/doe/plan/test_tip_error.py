"""Expected errors of the tip against simulated arms, with the effects of the prior and without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.plan.tip_error import TipError, robust_or_none, tip_error
from doe.problem.bayesian import EnsembleModel
from doe.problem.problem import DesignProblem
from doe.problem.robust import average_error, missing_effects, robust_problem, workspace
from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.model import Model
from tests.doe.six_axis import SIX_AXIS, six_axis

ARM = Arm([300.0, 200.0], np.radians([-170, -100]), np.radians([170, 100]), 0.1)
PLAIN = DesignProblem.of(Model(ARM))
MISSING = missing_effects(PLAIN, ["encoder_eccentricity", "gear_ratio", "base_offset"])
WIDE = robust_problem(PLAIN, MISSING)
POSTURES = np.random.default_rng(3).uniform(ARM.lower, ARM.upper, (6, 2))


def test_against_simulated_arms() -> None:
    """1,000 arms of the prior, measured at the plan, fitted by the linear model without effects: least squares alone.

    A mean square of one direction has the standard error sqrt(2 / 1000) = 4.5 %; four of them.
    """
    generator, count, wide = np.random.default_rng(1), 1000, MISSING.model
    sizes = wide.parameters.vector(MISSING.prior.deviations, default=0.0)
    poses = workspace(PLAIN)[:100]
    found = {}
    for name, size in (("right", 0.0), ("missing", 1.0)):
        truth = size * sizes * generator.standard_normal((count, len(sizes)))
        clean = wide.position(POSTURES, truth) - wide.position(POSTURES, np.zeros(len(sizes)))
        data = (clean + 0.1 * generator.standard_normal(clean.shape)).reshape(count, -1)
        jacobian, at_poses = PLAIN.model.jacobian(POSTURES).reshape(-1, 4), PLAIN.model.jacobian(poses).reshape(-1, 4)
        estimates = np.linalg.lstsq(jacobian, data.T, rcond=None)[0]
        real = (wide.position(poses, truth) - wide.position(poses, np.zeros(len(sizes)))).reshape(count, -1)
        found[name] = float(np.sum((at_poses @ estimates - real.T) ** 2) / count / len(poses))
    expected = tip_error(PLAIN, WIDE, POSTURES, poses)
    assert expected.right**2 == pytest.approx(found["right"], rel=4.0 * np.sqrt(2.0 / count))
    assert expected.missing**2 == pytest.approx(found["missing"], rel=4.0 * np.sqrt(2.0 / count))


def test_with_the_prior_it_is_criterion_i() -> None:
    poses = workspace(PLAIN)
    expected = -replace(WIDE, criterion=average_error(WIDE, poses)).objective(POSTURES) * 0.1**2 / len(POSTURES)
    assert tip_error(PLAIN, WIDE, POSTURES).with_prior ** 2 == pytest.approx(expected, rel=1e-9)


def test_measured_postures_count() -> None:
    kept = [replace(case, kept=POSTURES[:3]) for case in (PLAIN, WIDE)]
    shared = tip_error(*kept, POSTURES[3:]).to_json()
    assert shared == pytest.approx(tip_error(PLAIN, WIDE, POSTURES).to_json(), rel=1e-9)


def test_too_few_runs_have_no_error() -> None:
    assert tip_error(PLAIN, WIDE, POSTURES[:1]) == TipError(np.inf, np.inf, np.inf)


def test_where_no_sizes_are_known_there_is_none() -> None:
    assert robust_or_none(DesignProblem.of(Model(Arm([300.0, 200.0])))) is None
    assert robust_or_none(replace(PLAIN, model=EnsembleModel(PLAIN.model, np.zeros((1, 4))))) is None
    assert robust_or_none(WIDE) is None


def test_of_a_diagnosed_arm_nothing_is_missing() -> None:
    """What is right of it is criterion I of its own model; nothing is promised of effects that it may lack."""
    values = {"encoder_eccentricity:1.a": 1e-3, "encoder_eccentricity:1.b": 0.0}
    own = ARM.with_effects(EffectSpec("encoder_eccentricity", 1))
    case = DesignProblem.of(Model(replace(own, calibration=Calibration(values))))
    wide = robust_or_none(case)
    assert wide is not None
    assert wide.model.parameters.names == case.model.parameters.names
    found, poses = tip_error(case, wide, POSTURES), workspace(case)
    expected = -replace(case, criterion=average_error(case, poses)).objective(POSTURES) * 0.1**2 / len(POSTURES)
    assert found.right**2 == pytest.approx(expected, rel=1e-9)
    said = found.to_json()
    assert (said["effects_missing"], said["effects_missing_prior"]) == (None, None)


def test_of_a_spatial_arm_with_the_prior_of_its_machining() -> None:
    """The prior as further rows, zero measured with its deviations: least squares of more rows."""
    case = six_axis()
    wide = robust_problem(case, missing_effects(case, ["encoder_eccentricity", "gear_ratio"]))
    postures = np.random.default_rng(5).uniform(case.lower, case.upper, (14, 6))
    found, poses, own = tip_error(case, wide, postures), workspace(case), case.parameters
    spatial_i = replace(case, criterion=average_error(case, poses)).objective(postures)
    assert found.right**2 == pytest.approx(-spatial_i * 0.05**2 / len(postures), rel=1e-9)
    rows, targets = (wide.scaled_jacobians(q).reshape(-1, wide.parameters) for q in (postures, poses))
    held = np.diag(0.05 / (case.model.parameters.scales * deviations(case)))
    sizes = wide.model.parameters.vector(wide.deviations, default=np.inf)[own:] * wide.model.parameters.scales[own:]
    seen = np.vstack([rows[:, own:] * sizes, np.zeros((own, len(sizes)))])
    taken = np.linalg.lstsq(np.vstack([rows[:, :own], held]), seen, rcond=None)[0]
    bias = np.sum((targets[:, :own] @ taken - targets[:, own:] * sizes) ** 2) / len(poses)
    assert found.missing**2 == pytest.approx(found.right**2 + bias, rel=1e-6)
    assert found.right < found.with_prior < found.missing
    own_rows = np.vstack([rows[:, :own], held])
    at = targets[:, :own].reshape(len(poses), 3, own)
    squares = 0.05**2 * np.trace(at @ np.linalg.inv(own_rows.T @ own_rows) @ np.swapaxes(at, 1, 2), axis1=1, axis2=2)
    assert found.worst**2 == pytest.approx(squares.max(), rel=1e-6)


def deviations(case: DesignProblem) -> Array:
    """(p,) of the prior [mm, rad], infinite where nothing is known."""
    return np.array([case.deviations.get(name, np.inf) for name in case.model.parameters.names])


def test_several_points_are_a_mean_over_them() -> None:
    """The posterior of all parameters written out: mean over points and poses of what it leaves of each point."""
    chain = replace(SIX_AXIS.chain, tools={"a": np.array([60.0, 40.0, 100.0]), "b": np.array([-50.0, 20.0, 80.0])})
    problem = six_axis(replace(SIX_AXIS, chain=chain))
    wide = robust_or_none(problem)
    assert wide is not None
    poses, plan = (np.random.default_rng(seed).uniform(-2.0, 2.0, (20, 6)) for seed in (4, 5))
    rows, known = wide.scaled_jacobians(plan), np.diag(wide.precisions)
    posterior = 0.05**2 * np.linalg.inv(np.einsum("mda,mdb->ab", rows, rows) + known)
    points = wide.scaled_jacobians(poses).reshape(40, 3, -1)
    expected = np.einsum("mda,ab,mdb->", points, posterior, points) / 40
    assert tip_error(problem, wide, plan, poses).with_prior ** 2 == pytest.approx(expected, rel=1e-6)
