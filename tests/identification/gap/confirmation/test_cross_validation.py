"""Cross-validation by one step from the fit to all rows, against fits made anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.estimation.prior import Prior
from identification.gap.confirmation.cross_validation import _inverse, cross_validate, cross_validation
from identification.gap.fits.fit import Fit, fit
from identification.gap.fits.whitening import Rows
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0, 150.0], effects=(EffectSpec("base_offset"),))
RIPPLE = EffectSpec("transmission_ripple", 2, {"k": 7.0})
TRUE = {"length_error:1": 0.8, "joint_offset:2": 0.004, "base_offset.x0": 0.5, "transmission_ripple:2.a": 8e-4}
EXTENDED = ARM.with_effects(*ARM.effects, RIPPLE)


def measured(m: int, seed: int, ripple: np.ndarray | float = 1.0) -> Measurements:
    """Noise of 0.1 mm; the ripple (0.2 mm) is there in a part of the rows."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-3.0, 3.0, (m, 3))
    model = Model(EXTENDED)
    positions = model.position(q, model.parameters.vector(TRUE))
    plain = model.position(q, model.parameters.vector(TRUE | {"transmission_ripple:2.a": 0.0}))
    present = np.broadcast_to(ripple, m)[:, None]
    return Measurements(q, present * positions + (1.0 - present) * plain + 0.1 * rng.normal(size=(m, 2)))


def both(data: Measurements) -> tuple[Fit, Fit]:
    rows = Rows.of(data)
    return fit(Model(ARM), rows), fit(Model(EXTENDED), rows)


@pytest.mark.parametrize("prior", [None, Prior({"transmission_ripple:2.a": 3e-4, "base_offset.x0": 0.3})])
def test_one_step_is_a_refit(prior: Prior | None) -> None:
    data, rng = measured(60, 1), np.random.default_rng(2)
    rows = replace(Rows.of(data), spread=rng.uniform(0.5, 2.0, 60)[:, None, None] * np.eye(2))
    found = fit(Model(EXTENDED), rows, prior=prior, noise=0.1)
    folds = rng.integers(0, 5, 60)
    checked = cross_validate(found, folds)
    for fold in range(5):
        part, rest = folds == fold, rows.pick(folds != fold)
        again = fit(Model(EXTENDED), rest, prior=prior, noise=0.1)
        held = rows.positions[part] - again.model.position(rows.postures[part], again.values)
        # second order in the change of the parameters, some 0.03 mm on 300 mm: 1e-5 mm
        np.testing.assert_allclose(checked.residual[part], held, atol=2e-5)
        jacobian = again.model.jacobian(rows.postures[part], again.values)
        left = again.model.position(rest.postures, again.values) - rest.positions
        if prior is None:
            expected = 2.0 * np.sum(left**2) / again.freedom
            expected += np.einsum("mip,pq,miq->m", jacobian, again.covariance(), jacobian)
            np.testing.assert_allclose(checked.predicted[part], np.mean(expected), rtol=1e-3)


def test_combinations_that_the_other_parts_do_not_determine_stay() -> None:
    """Joint 2 moves in one part only, so without it neither its ripple nor its lengths are known."""
    data = measured(40, 3)
    postures = data.postures.copy()
    postures[10:, 1] = 0.4
    model = Model(EXTENDED)
    positions = model.position(postures, model.parameters.vector(TRUE)) + 0.1 * np.random.default_rng(4).normal(
        size=(40, 2)
    )
    found = fit(model, Rows.of(Measurements(postures, positions)))
    checked = cross_validate(found, (np.arange(40) >= 10).astype(np.int64))
    assert np.max(np.abs(checked.residual)) < 5.0


def refuted(data: Measurements) -> list[bool]:
    base, named = both(data)
    tests = cross_validation(base, named, data, np.ones(len(data), dtype=bool), np.random.default_rng(0))
    assert [test.transfer for test in tests] == ["other postures", "another stretch of time"]
    return [test.confirmed is False for test in tests]


def test_what_is_there_everywhere_holds() -> None:
    # each of two transfers is refuted at 2.5 % at most: 4 or more of 40 have probability 0.02
    assert np.sum([refuted(measured(80, seed)) for seed in range(20)]) < 4


def test_what_is_there_for_a_while_does_not_hold() -> None:
    """The ripple is there in the first eighth of the rows only, four times as large."""
    late = [refuted(measured(160, seed, 4.0 * (np.arange(160) < 20)))[1] for seed in range(10)]
    assert sum(late) >= 8


def test_a_column_that_is_in_one_part_alone_does_nothing_to_the_others() -> None:
    """Its products less those of that part are rounding, of either sign."""
    columns = np.random.default_rng(6).normal(size=(40, 3))
    columns[10:, 2] = 0.0
    square = columns[10:].T @ columns[10:]
    whole = np.diag(columns.T @ columns)
    expected = np.zeros((3, 3))
    expected[:2, :2] = np.linalg.inv(square[:2, :2])
    for rounding in (-3e-16, 0.0, 2e-16):
        square[2, 2], square[:2, 2] = rounding * whole[2], 1e-16
        square[2] = square[:, 2]
        np.testing.assert_allclose(_inverse(square, whole), expected, atol=1e-12)
