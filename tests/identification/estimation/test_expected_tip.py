"""How far the tip may be off: against complex exponentials written out, against repeated experiments, and said; and
postures left out by leverages, against fits without them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Measurements, Model, estimate, load_arm, load_measurements
from identification.estimation.doubts import expected_tip, left_out_residuals
from identification.estimation.problem import NO_PRIOR, Prior
from identification.measurements import rms_distance
from tests.identification.estimation.cases import LENGTHS, SIGMA, arm, data, plan, truth

UR10 = Path(__file__).parents[2] / "data" / "ur10"


def limited(sigma: float | None = SIGMA) -> Arm:
    return replace(arm(sigma=sigma), lower=np.full(4, -2.0), upper=np.full(4, 2.0))


def test_the_covariance_is_carried_to_the_tip() -> None:
    """Oracle: of z = sum l_j exp(i theta_j) the derivative is exp(i theta_j) by l_j, i sum_(k>=j) l_k exp(i theta_k) by
    q_j; the variance of both coordinates is the sum over p, q of C_pq Re(conj(d_p) d_q)."""
    model, rng = Model(limited()), np.random.default_rng(4)
    postures, root = plan(7, seed=3), rng.normal(size=(8, 8)) * np.r_[np.full(4, 0.1), np.full(4, 1e-3)][:, None]
    errors = truth(model)
    covariance, total = root @ root.T, 0.0
    lengths = np.array(LENGTHS) + errors[:4]
    for q in postures + errors[4:]:
        unit = np.exp(1j * np.cumsum(q))
        slopes = np.r_[unit, [1j * np.sum((lengths * unit)[j:]) for j in range(4)]]
        total += sum(covariance[a, b] * (slopes[a].conj() * slopes[b]).real for a in range(8) for b in range(8))
    assert expected_tip(model, errors, covariance, postures) == pytest.approx(np.sqrt(total / 7.0), rel=1e-10)


def test_few_measurements_are_said_and_many_are_not() -> None:
    model = Model(limited())
    near = np.random.default_rng(5).normal(0.0, 0.1, (5, 4))  # five postures, nearly the same
    alike, many = (estimate(model, data(model, postures), sigma=SIGMA) for postures in (near, plan(30)))
    assert alike.expected_tip > 10.0 * many.expected_tip
    assert [said.partition(" the tip may be ")[0] for said in alike.warnings] == ["away from the postures measured"]
    again = estimate(Model(many.calibrated_arm()), data(model, plan(6)), sigma=SIGMA)
    assert again.expected_tip_measured > 0.5 * again.rms_before
    assert again.warnings == ()  # the arm was right before: what it was off is noise
    few = estimate(model, data(model, plan(4)), sigma=60.0 * SIGMA)
    assert [said.partition(":")[0] for said in few.warnings] == ["too few measurements"]
    assert (many.warnings, many.to_json()["expected_tip_mm"]) == ((), many.expected_tip)
    assert many.to_json()["expected_tip_measured_mm"] == pytest.approx(many.expected_tip, rel=0.2)  # nearly all angles


def test_limits_of_half_a_turn_are_limits_as_any_others() -> None:
    """Rows of 12 degrees to either side leave millimetres open elsewhere; a tenth of a degree of the limits is nothing,
    though an arm file that gives none has half a turn."""
    model, near = Model(arm(sigma=SIGMA)), 0.1 * plan(12)
    found = estimate(model, data(model, near), sigma=SIGMA)
    narrow = replace(arm(sigma=SIGMA), lower=np.full(4, -np.pi + 0.002), upper=np.full(4, np.pi - 0.002))
    less = estimate(Model(narrow), data(model, near), sigma=SIGMA)
    assert found.expected_tip == pytest.approx(less.expected_tip, rel=0.01)
    assert found.expected_tip > 5.0 * found.expected_tip_measured


def test_postures_like_those_measured_fill_no_box_of_angles() -> None:
    """Joints that move together, as on a grid of places or along paths: new postures drawn as the rows were are
    predicted as well as is said, of 60 plans of 12 rows; random angles of the same ranges far worse."""
    model, said, off, box = Model(arm(sigma=SIGMA)), [], [], []

    def postures(generator: np.random.Generator, count: int) -> np.ndarray:
        return generator.uniform(-2.0, 2.0, (count, 1)) * [1.0, -0.8, 0.5, 0.3] + generator.normal(0.0, 0.2, (count, 4))

    for seed in range(60):
        generator = np.random.default_rng([13, seed])
        q, fresh = postures(generator, 12), postures(generator, 50)
        found = estimate(model, data(model, q, seed=seed), sigma=SIGMA)
        said.append(found.expected_tip_measured**2)
        for there, errors in ((fresh, off), (generator.uniform(q.min(axis=0), q.max(axis=0), (50, 4)), box)):
            difference = model.position(there, found.parameters) - model.position(there, truth(model))
            errors.append(np.mean(np.sum(difference**2, axis=1)))
    assert np.mean(said) == pytest.approx(np.mean(off), abs=4.0 * np.std(off) / np.sqrt(60.0))
    assert np.mean(box) > 2.0 * np.mean(off)


def test_few_random_postures_promise_what_holds_of_all_that_they_are_drawn_from() -> None:
    """The range of ten random angles is 9 / 11 of that, in the mean, and the tip in it a sixth less uncertain."""
    model, ratios, generator = Model(limited()), [], np.random.default_rng(8)
    for _ in range(40):
        found = estimate(model, data(model, generator.uniform(-1.0, 1.0, (10, 4))), sigma=SIGMA)
        fresh = expected_tip(model, found.parameters, found.covariance, generator.uniform(-1.0, 1.0, (2000, 4)))
        ratios.append(found.expected_tip_measured / fresh)
    assert np.median(ratios) == pytest.approx(1.0, abs=3.0 * np.std(ratios) / np.sqrt(40.0))


@pytest.mark.filterwarnings("ignore:.*columns are not used")  # orientations
def test_a_real_robot_is_off_by_what_is_said() -> None:
    """40 rows of a sample of a session of the UR10, three times, against the fit of the others: what is said is right
    to a third. Random angles within those measured would be 4 times as far off: its postures fill no box of angles."""
    robot = load_arm(UR10 / "ur10.toml")
    rows, model = load_measurements(UR10 / "series_A.csv", robot), Model(robot)
    generator, said, off = np.random.default_rng(15), [], []
    for _ in range(3):
        order = generator.permutation(len(rows))
        few, rest = rows.rows(np.sort(order[:40])), rows.rows(np.sort(order[40:]))
        found, best = estimate(model, few), estimate(model, rest)
        left = [fit.model.position(rest.postures, fit.parameters, rest.conditions)[:, :3] for fit in (found, best)]
        said.append(found.expected_tip_measured**2)
        off.append(np.mean(np.sum((left[0] - left[1]) ** 2, axis=1)))
    assert np.sqrt(np.mean(said) / np.mean(off)) == pytest.approx(1.0, abs=1.0 / 3.0)


# -- postures left out -------------------------------------------------------------------------------------------------
ARM = Arm([260.0, 180.0], sigma=0.1)
MODEL = Model(ARM)


def few_rows(m: int, seed: int, noise: float = 0.1) -> Measurements:
    generator = np.random.default_rng(seed)
    q = generator.uniform(-2.0, 2.0, (m, 2))
    truth = np.array([1.0, -0.5, 0.01, -0.008])
    return Measurements(q, MODEL.position(q, truth) + noise * generator.standard_normal((m, 2)))


def refitted(rows: Measurements, groups: list[list[int]], prior: Prior = NO_PRIOR) -> float:
    """Each group predicted by a fit to the others."""
    squares = []
    for group in groups:
        fit = estimate(MODEL, rows.rows(np.setdiff1d(np.arange(len(rows)), group)), prior=prior, sigma="given")
        there = MODEL.position(rows.postures[group], fit.parameters)
        squares += np.sum((rows.positions[group] - there) ** 2, axis=1).tolist()
    return float(np.sqrt(np.mean(squares)))


ROWS = {
    "each posture": (few_rows(8, 1), NO_PRIOR, 2e-3),
    "with a prior": (few_rows(4, 4), Prior({"length_error:1": 0.3, "joint_offset:2": 1e-3}), 5e-3),
    "own weights": (replace(few_rows(9, 5), sigma=np.where(np.arange(9) < 4, 0.05, 0.4)), NO_PRIOR, 5e-3),
}


@pytest.mark.parametrize("name", ROWS)
def test_each_posture_as_a_fit_without_it_predicts_it(name: str) -> None:
    """In the plane the model is linear in l_j cos and l_j sin of its angles: for small errors to second order in them,
    1e-2 rad here, of a change of the fit of 0.1 mm."""
    rows, prior, near = ROWS[name]
    fit = estimate(MODEL, rows, prior=prior, sigma="given")
    found = rms_distance(left_out_residuals(fit, rows))
    assert found == pytest.approx(refitted(rows, [[k] for k in range(len(rows))], prior), rel=near)
    assert found > fit.rms_after


def test_repeats_of_a_posture_are_left_out_together() -> None:
    once, twice = few_rows(6, 2), np.repeat(np.arange(6), 2)
    noise = 0.1 * np.random.default_rng(3).standard_normal((12, 2))
    rows = Measurements(once.postures[twice], once.positions[twice] + noise)
    found = rms_distance(left_out_residuals(estimate(MODEL, rows), rows))
    assert found == pytest.approx(refitted(rows, [[2 * k, 2 * k + 1] for k in range(6)]), rel=2e-3)


def test_none_where_a_posture_alone_determines_something() -> None:
    same = few_rows(5, 7).rows(np.zeros(5, dtype=int))  # four equations for four unknowns; one posture five times
    for rows in (few_rows(2, 6), same):
        assert left_out_residuals(estimate(MODEL, rows), rows) is None
