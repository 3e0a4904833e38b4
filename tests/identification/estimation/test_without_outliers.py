"""Any fit repeated without its outliers: the rows left out, and the fit to the others."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm
from identification.errors import InputError
from identification.estimation import estimate, without_outliers
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.estimation.cases import arm, data, plan, scipy_fit


def test_rows_are_numbered_as_given_and_the_fit_is_that_of_the_others() -> None:
    """Lost beams in rows 3 and 9 and a larger one in row 6 that hides them; oracle: SciPy on the rows without them."""
    model = Model(arm(sigma=0.1))
    measured = data(model, plan(40))
    positions = measured.positions.copy()
    positions[[2, 8]] += [1.0, -0.8]
    positions[5] += [400.0, 0.0]
    calls = []

    def fit(rows: Measurements):
        calls.append(len(rows))
        return estimate(model, rows)

    found, left_out = without_outliers(fit, Measurements(measured.postures, positions))
    assert left_out == (3, 6, 9)
    assert calls == sorted(calls, reverse=True)
    assert calls[-1] == 37
    expected = scipy_fit(model, measured.rows(np.delete(np.arange(40), [2, 5, 8])))
    np.testing.assert_allclose(found.parameters, expected.x, atol=1e-7)


def test_nothing_is_left_out_of_clean_rows_and_what_the_fit_refuses_is_refused() -> None:
    model = Model(Arm([260.0, 180.0], sigma=0.1))
    rows = Measurements(plan(20)[:, :2], np.zeros((20, 2)))
    clean = Measurements(rows.postures, model.position(rows.postures, model.values, rows.conditions))
    assert without_outliers(lambda given: estimate(model, given), clean)[1] == ()
    with pytest.raises(InputError):
        without_outliers(lambda given: estimate(model, given, method="guess"), clean)
