"""Simulated data sets and their fits: true values of a smaller set of parameters, and fits as they are one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, DHRow, InputError, Measurements, Model, chain_of, estimate, without_prior
from identification.replications import ModelTable, Replications, StudyFile, TruthTable, true_values

ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0)]
CHAIN = replace(chain_of(ROWS), tools={"1": np.array([40.0, 30.0, 20.0])})
ELBOW = Arm(CHAIN, sigma=0.05, name="elbow")
SIZES = {"translation_x:2": 0.4, "translation_y:3": -0.3, "rotation_y:3": 0.1, "base.x": 2.0}
PLANAR = Arm([300.0, 200.0], sigma=0.1)
OFF = TruthTable(name="off", length_errors_mm=[1.0, -0.5], joint_offsets_deg=[0.2, -0.1])


def test_true_values_put_the_point_where_the_truth_does() -> None:
    """Without noise the fitted set, which is smaller than that of the errors, ends at the positions of all of them."""
    model, truth = Model(without_prior(ELBOW)), Model(TruthTable(name="machined", values=SIZES).of(ELBOW))
    assert len(model.names) < len(truth.names)
    postures = np.random.default_rng(5).uniform(-3.0, 3.0, (30, 3))
    found = model.position(postures, true_values(model, truth))
    np.testing.assert_allclose(found, truth.position(postures), atol=1e-5)


def test_fits_are_those_of_every_data_set_by_itself() -> None:
    """With the same noise: `estimate` of each; deviations by eq. 16 at the true values."""
    data_sets = Replications.of(ModelTable(name="geometry").of(PLANAR), OFF.of(PLANAR))
    postures = np.random.default_rng(1).uniform(-3.0, 3.0, (7, 2))
    errors, rss, deviations = data_sets.fits(postures, 0.1, np.random.default_rng(2), 4)
    noise, model = 0.1 * np.random.default_rng(2).standard_normal((4, 7, 2)), data_sets.model
    for k in range(4):
        fit = estimate(model, Measurements(postures, data_sets.truth.position(postures) + noise[k]))
        np.testing.assert_allclose(errors[k, :4], fit.parameters - data_sets.values, rtol=0.0, atol=1e-9)
        assert rss[k] == pytest.approx(float(np.sum(fit.residuals_after**2)))
    jacobian = model.jacobian(postures, data_sets.values).reshape(-1, 4)
    covariance = data_sets.transform @ (0.01 * np.linalg.inv(jacobian.T @ jacobian)) @ data_sets.transform.T
    np.testing.assert_allclose(deviations**2, np.diag(covariance), rtol=1e-7)
    assert [name for name, _, _ in data_sets.reported][4:] == ["orientation_offset:1", "orientation_offset:2"]


def test_a_name_stands_once() -> None:
    with pytest.raises(InputError, match="models: name 'a' is given twice, allowed: once"):
        StudyFile.of({"arms": ["a"], "plans": ["dft"], "models": [{"name": "a"}, {"name": "a"}]})
