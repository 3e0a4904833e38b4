"""Expected deviations, against the closed forms of an optimal plan and against simulated least squares."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from doe import DesignProblem, score
from doe.bounds.certificate import Bound
from doe.criteria import NAMES, Ds, DStar, E
from doe.plan.accuracy import (
    ExpectedDeviations,
    TipErrors,
    average_error,
    criterion_of,
    criterion_values,
    error_at_poses,
    missing_effects,
    observability,
    robust_problem,
    tip_beside_random,
    tip_jacobians,
    workspace,
)
from identification import Arm, Array, Calibration, EffectSpec, InputError, Model
from identification.gap.library_prior import library_prior
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem
from tests.doe.six_axis import six_axis


def fourier(runs: int, links: int) -> np.ndarray:
    return np.diff(2 * np.pi * np.outer(np.arange(runs), np.arange(1, links + 1)) / runs, axis=1, prepend=0.0)


@pytest.mark.parametrize("runs", [4, 20])
def test_optimal_plan(runs: int) -> None:
    sigma = 0.1
    arm = Arm(FOUR.lengths, sigma=sigma)
    found = ExpectedDeviations.of(problem(arm), fourier(runs, 4))
    lengths = arm.lengths
    np.testing.assert_allclose(found.length, sigma / np.sqrt(runs))  # eq. 24, corrected
    np.testing.assert_allclose(found.orientation, sigma / np.sqrt(runs) / lengths)
    # identification/README.md, "Covariance and intervals"
    offsets = np.r_[1 / lengths[0], np.hypot(1 / lengths[1:], 1 / lengths[:-1])]
    np.testing.assert_allclose(found.joint_offset, sigma / np.sqrt(runs) * offsets)
    if runs == 20:  # Table III of the paper, to its printed digits
        np.testing.assert_allclose(found.length, 0.022, atol=5e-4)
        np.testing.assert_allclose(np.degrees(found.orientation), [0.005, 0.007, 0.011, 0.013], atol=5e-4)


def test_names_of_criteria() -> None:
    case, poses = problem(FOUR), np.zeros((1, 4))
    for name in NAMES:
        assert criterion_of(case, name, ["length_error:1"], poses).name == name
    assert criterion_of(case, "Dstar") == DStar(((0, 1, 2, 3), (4, 5, 6, 7)))
    assert criterion_of(case, "Ds", ["joint_offset:1"]) == Ds((4,))
    for name, message in {"Dss": "did you mean 'Ds'", "I": "I needs test poses", "Ds": "Ds needs a subset"}.items():
        with pytest.raises(InputError, match=message):
            criterion_of(case, name)


def test_value_of_criterion_i_in_mm() -> None:
    """Root mean over poses of tr(J cov J^T), from unscaled Jacobians of new and measured postures."""
    generator = np.random.default_rng(8)
    plan, kept, poses = (generator.uniform(FOUR.lower, FOUR.upper, (k, 4)) for k in (9, 3, 50))
    plain = problem(FOUR, kept=kept)
    case = replace(plain, criterion=average_error(plain, poses))
    rows = case.model.jacobian(np.concatenate([plan, kept])).reshape(24, 8)
    covariance = 0.1**2 * np.linalg.inv(rows.T @ rows)
    at = case.model.jacobian(poses).reshape(50, 2, 8)
    expected = np.sqrt(np.mean([np.trace(j @ covariance @ j.T) for j in at]))
    found = score(case, plan, Bound(case.objective(plan), "grid")).expected_error
    assert found == pytest.approx({"plan": expected, "bound": expected}, rel=1e-9)
    assert error_at_poses(plain, -1.0, 9) is None  # criterion D
    assert error_at_poses(case, -np.inf, 9) is None
    assert score(plain, plan).to_json()["expected_error_mm"] is None


def test_weights_share_the_runs_out() -> None:
    plan = np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (6, 4))
    shared = ExpectedDeviations.of(problem(FOUR), plan, np.array([3, 1, 1, 1, 1, 1]) / 8)
    repeated = ExpectedDeviations.of(problem(FOUR), plan[[0, 0, 0, 1, 2, 3, 4, 5]])
    # six runs instead of eight, shared out in the same way
    np.testing.assert_allclose(shared.length, repeated.length * np.sqrt(8 / 6))
    np.testing.assert_allclose(shared.joint_offset, repeated.joint_offset * np.sqrt(8 / 6))


def test_none_where_only_rounding_makes_the_information_regular() -> None:
    # two angles half a turn apart tell an eccentric encoder from a joint offset by rounding only, yet numpy inverts M
    plan = np.array(list(product((-1.0, 1.0), (-1.2, np.pi - 1.2), (-1.0, 1.0), (-1.0, 0.5))))
    assert ExpectedDeviations.of(problem(Arm(FOUR.lengths, sigma=0.1), ECCENTRICITY), plan) is None
    assert ExpectedDeviations.of(problem(Arm(FOUR.lengths, sigma=0.1)), plan) is not None
    assert ExpectedDeviations.of(problem(Arm(FOUR.lengths)), fourier(4, 4)) is None  # no sigma


# -- observability -----------------------------------------------------------------------------------------------------
def test_definitions() -> None:
    case = problem(FOUR, OFFSET)
    plan = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (9, 4))
    jacobian = (case.model.jacobian(plan) / case.model.parameters.scales).reshape(18, 10)
    s = np.sqrt(np.sort(np.linalg.eigvalsh(jacobian.T @ jacobian)))
    found = observability(case, plan)
    assert found["o1"] == pytest.approx(np.prod(s) ** (1 / 10) / 3)
    assert found["o1"] == pytest.approx(np.exp(case.objective(plan) / 20))  # D
    assert found["o3"] == pytest.approx(np.sqrt(9 * float(E().value(case.information(plan)))))  # E
    others = s[0] / s[-1], s[0] ** 2 / s[-1], 1 / np.sum(1 / s)
    assert (found["o2"], found["o4"], found["o5"]) == pytest.approx(others)
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
    plain = np.linalg.slogdet(m)[1], -np.trace(inverse), np.linalg.eigvalsh(m)[0]
    assert [found[name] for name in "DAE"] == pytest.approx(plain)
    assert found["I"] == pytest.approx(-np.einsum("kdp,pq,kdq->", poses, inverse, poses) / len(poses))
    assert found["Ds"] == pytest.approx(-np.linalg.slogdet(inverse[lengths][:, lengths])[1])
    assert found["Dstar"] == pytest.approx(sum(np.linalg.slogdet(m[k][:, k])[1] for k in (lengths, angles)))
    assert criterion_values(case, plan[:2])["D"] is None


# -- error of the tip --------------------------------------------------------------------------------------------------
ARM = Arm([300.0, 200.0], np.radians([-170, -100]), np.radians([170, 100]), 0.1)
PLAIN = DesignProblem.of(Model(ARM))
MISSING = missing_effects(PLAIN, ["encoder_eccentricity", "gear_ratio", "base_offset"])
WIDE = robust_problem(PLAIN, MISSING)
POSTURES = np.random.default_rng(3).uniform(ARM.lower, ARM.upper, (6, 2))


def tip_error(problem: DesignProblem, wide: DesignProblem, plan: Array, poses: Array | None = None) -> dict[str, float]:
    at = workspace(problem) if poses is None else poses
    return TipErrors(problem, wide, tip_jacobians(wide, at)).of_plan(plan)


def test_measured_postures_count() -> None:
    kept = [replace(case, kept=POSTURES[:3]) for case in (PLAIN, WIDE)]
    assert tip_error(*kept, POSTURES[3:]) == pytest.approx(tip_error(PLAIN, WIDE, POSTURES), rel=1e-9)


def test_where_no_sizes_are_known_there_is_none() -> None:
    assert TipErrors.of(DesignProblem.of(Model(Arm([300.0, 200.0])))) is None
    assert tip_error(PLAIN, WIDE, POSTURES[:1])["model_right"] == np.inf  # nor of too few runs


def test_of_a_diagnosed_arm_nothing_is_missing() -> None:
    """What is right of it is criterion I of its own model; nothing is promised of effects that it may lack."""
    values = {"encoder_eccentricity:1.a": 1e-3, "encoder_eccentricity:1.b": 0.0}
    own = ARM.with_effects(EffectSpec("encoder_eccentricity", 1))
    case = DesignProblem.of(Model(replace(own, calibration=Calibration(values))))
    found, poses = TipErrors.of(case).of_plan(POSTURES), workspace(case)
    expected = -replace(case, criterion=average_error(case, poses)).objective(POSTURES) * 0.1**2 / len(POSTURES)
    assert found["model_right"] ** 2 == pytest.approx(expected, rel=1e-9)
    assert (found["effects_missing"], found["effects_missing_prior"]) == (np.inf, np.inf)
    assert tip_beside_random(case, POSTURES) == (None, [])


def test_of_a_spatial_arm_with_the_prior_of_its_machining() -> None:
    """The prior as further rows, zero measured with its deviations: least squares of more rows."""
    case = six_axis()
    wide = robust_problem(case, missing_effects(case, ["encoder_eccentricity", "gear_ratio"]))
    postures = np.random.default_rng(5).uniform(case.lower, case.upper, (14, 6))
    found, poses, own = tip_error(case, wide, postures), workspace(case), case.parameters
    spatial_i = replace(case, criterion=average_error(case, poses)).objective(postures)
    assert found["model_right"] ** 2 == pytest.approx(-spatial_i * 0.05**2 / len(postures), rel=1e-9)
    rows, targets = (wide.scaled_jacobians(q).reshape(-1, wide.parameters) for q in (postures, poses))
    known = [case.deviations.get(name, np.inf) for name in case.model.parameters.names]
    held = np.diag(0.05 / (case.model.parameters.scales * known))
    sizes = wide.model.parameters.vector(wide.deviations, default=np.inf)[own:] * wide.model.parameters.scales[own:]
    seen = np.vstack([rows[:, own:] * sizes, np.zeros((own, len(sizes)))])
    taken = np.linalg.lstsq(np.vstack([rows[:, :own], held]), seen, rcond=None)[0]
    bias = np.sum((targets[:, :own] @ taken - targets[:, own:] * sizes) ** 2) / len(poses)
    assert found["effects_missing"] ** 2 == pytest.approx(found["model_right"] ** 2 + bias, rel=1e-6)
    assert found["model_right"] < found["effects_missing_prior"] < found["effects_missing"]
    own_rows = np.vstack([rows[:, :own], held])
    at = targets[:, :own].reshape(len(poses), 3, own)
    squares = 0.05**2 * np.trace(at @ np.linalg.inv(own_rows.T @ own_rows) @ np.swapaxes(at, 1, 2), axis1=1, axis2=2)
    assert found["model_right_worst"] ** 2 == pytest.approx(squares.max(), rel=1e-6)


@pytest.mark.parametrize("runs", [30, 300])
def test_what_no_name_has_is_counted_against_simulated_arms(runs: int) -> None:
    """1,000 arms with everything that may be missing, all waves of their error curves and an own error of each posture
    drawn one by one: fitted by the geometry alone, and by the mode of the posterior of all that may be missing, as
    `identify --library-prior` does. Many runs tell waves that few do not.

    Standard error of the mean square at most sqrt(2 / 1000) = 4.5 %: four of them.
    """
    wide, whole = robust_problem(PLAIN, missing_effects(PLAIN, runs=runs)), library_prior(ARM)
    generator, count, plan = (
        np.random.default_rng(6),
        1000,
        np.random.default_rng(7).uniform(ARM.lower, ARM.upper, (runs, 2)),
    )
    poses = workspace(PLAIN)[:100]
    every = Model(whole.arm)
    sizes = every.parameters.vector(whole.prior.deviations, default=0.0)
    at = np.concatenate([plan, poses])
    drawn = sizes[:, None] * generator.standard_normal((len(sizes), count))
    real = every.jacobian(at).reshape(-1, len(sizes)) @ drawn
    real += whole.prior.own_error * generator.standard_normal(real.shape)
    measured, tips = slice(2 * runs), slice(2 * runs, None)
    data = real[measured] + 0.1 * generator.standard_normal((2 * runs, count))
    columns = PLAIN.model.jacobian(at).reshape(-1, 4)
    left = columns[tips] @ np.linalg.lstsq(columns[measured], data, rcond=None)[0] - real[tips]
    expected = TipErrors(PLAIN, wide, tip_jacobians(wide, poses)).of_plan(plan)
    rows = every.jacobian(at).reshape(-1, len(sizes)) * np.where(sizes > 0.0, sizes, 1e3)
    noise = np.hypot(0.1, whole.prior.own_error)
    gain = np.linalg.solve(rows[measured].T @ rows[measured] + noise**2 * np.eye(len(sizes)), rows[measured].T)
    held = rows[tips] @ gain @ data - real[tips]
    for error, promised in ((left, expected["effects_missing"]), (held, expected["effects_missing_prior"])):
        assert np.sum(error**2) / count / 100 == pytest.approx(promised**2, rel=4.0 * np.sqrt(2.0 / count))


@pytest.mark.parametrize("problem", [PLAIN, WIDE])
def test_a_plan_beside_random_ones(problem: DesignProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the fit that it is meant for, each random plan by itself; the same seed gives the same."""
    judged = TipErrors(problem, WIDE, tip_jacobians(WIDE, workspace(PLAIN))) if problem.fit else TipErrors.of(PLAIN)
    fitted = "effects_missing_prior" if problem.fit else "effects_missing"
    plan, of_plan, errors = judged.of_plan(POSTURES)[fitted], TipErrors.of_plan, list[float]()
    assert judged.of_plan(POSTURES, judged.wide.scaled_jacobians(POSTURES))[fitted] == pytest.approx(plan)
    with monkeypatch.context() as patched:
        patched.setattr(TipErrors, "of_plan", lambda *a: errors.append((each := of_plan(*a))[fitted]) or each)
        said, _ = tip_beside_random(problem, POSTURES, seed=2)
    random, judged_last = np.array(errors[:50]), errors[50]
    assert judged_last == pytest.approx(plan, rel=1e-9)
    assert np.all(random > 0.0)
    figures = judged_last, np.median(random), np.mean(random > judged_last), 50, problem.fit or None
    assert tuple(said.values()) == figures
    assert said == tip_beside_random(problem, POSTURES, seed=2)[0] != tip_beside_random(problem, POSTURES, 3)[0]
    _, worse = tip_beside_random(problem, np.tile(POSTURES[:3], (2, 1)), seed=2)
    assert "hardly better than random postures, if at all" in worse[0]
