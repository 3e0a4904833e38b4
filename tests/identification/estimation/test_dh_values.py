"""The corrected Denavit-Hartenberg table of a fit: it computes what the fit does, with deviations of its covariance."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from identification.arm import Arm
from identification.estimation import Identification, estimate
from identification.estimation.corrected_values import Calibrated, dh_places, dh_values
from identification.kinematics.corrected import corrected
from identification.kinematics.corrected_dh import corrected_links, drawn_links
from identification.kinematics.denavit_hartenberg import chain_of
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.kinematics.test_corrected_dh import UR10, elementary


@cache
def fitted() -> Identification:
    arm = Arm(chain_of(UR10), sigma=0.05)
    model, generator = Model(arm), np.random.default_rng(4)
    parameters = model.parameters
    truth = 0.3 * parameters.vector(model.prior, default=0.0) * generator.standard_normal(len(parameters))
    truth[[parameters.index(f"tool[1].{axis}") for axis in "xyz"]] = [60.0, 30.0, 80.0]
    q = generator.uniform(-2.5, 2.5, (40, 6))
    return estimate(model, Measurements(q, model.position(q, truth) + generator.normal(0.0, 0.05, (40, 3))))


def test_table_base_and_tool_say_what_the_fit_does() -> None:
    found = fitted()
    rows = {row.name: row.corrected for row in dh_values(Calibrated.of(found), UR10)}
    places = dict(dh_places(Calibrated.of(found), UR10))
    assert len(rows) == 18  # 27 of a complete set less six of the base and three of the point
    for posture in np.random.default_rng(5).uniform(-2.0, 2.0, (4, 6)):
        at = places["base"]
        for j, (row, q) in enumerate(zip(UR10, posture, strict=True), start=1):
            drawn = {
                "theta": np.degrees(row.offset),
                "d": row.d,
                "a": row.a,
                "alpha": np.degrees(row.alpha),
                "beta": 0.0,
            }
            number = {name: rows.get(f"row {j} {name}", value) for name, value in drawn.items()}
            at = at @ elementary("z", q + np.radians(number["theta"])) @ elementary("Z", number["d"])
            at = at @ elementary("X", number["a"]) @ elementary("x", np.radians(number["alpha"]))
            at = at @ elementary("y", np.radians(number["beta"]))
        there = (at @ np.append(places["tool 1"], 1.0))[:3]
        np.testing.assert_allclose(there, found.model.position(posture[None], found.parameters)[0], rtol=0, atol=1e-6)


def test_deviations_are_those_of_samples_of_the_covariance() -> None:
    """Of 400 samples a standard deviation is known to 1 / sqrt(800) = 3.5 %; five of them."""
    found, generator = fitted(), np.random.default_rng(6)
    drawn, samples = drawn_links(UR10), []
    assert found.geometry is not None
    for values in generator.multivariate_normal(found.parameters, found.covariance, 400):
        named = {**found.geometry.values, **dict(zip(found.names, values, strict=True))}
        links = corrected_links(corrected(found.geometry.chain, named), drawn).links
        samples.append([links[1].a, np.degrees(links[1].beta or 0.0), links[3].d, np.degrees(links[4].theta)])
    rows = {row.name: row for row in dh_values(Calibrated.of(found), UR10)}
    stds = [rows[name].std for name in ("row 2 a", "row 2 beta", "row 4 d", "row 5 theta")]
    assert stds == pytest.approx(np.std(samples, axis=0).tolist(), rel=0.18)
