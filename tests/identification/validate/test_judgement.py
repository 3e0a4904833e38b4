"""A model that is offered beside the geometry alone: figures of `validate`, and what no effect gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, Calibration, EffectSpec
from identification.estimation import estimate, estimate_with_prior
from identification.gap.diagnose import diagnose
from identification.gap.library.library_prior import given_by, library_prior
from identification.gap.result import Diagnosis
from identification.measurements import Measurements, distances
from identification.model import Model
from identification.validate import validate
from identification.validate.validation import Offered, identified_geometry, judged, prior_judged
from tests.small_arm import drawn_arm, measured, random_postures, small_arm

ARM = Arm([300.0, 200.0, 150.0], effects=(EffectSpec("base_offset"),), sigma=0.05)


def session(drift: float, backlash: float, seed: int = 3, m: int = 80) -> Measurements:
    """80 rows; the base drifts [mm per session], and joint 2 has play [rad]."""
    rng = np.random.default_rng(seed)
    model = Model(ARM.with_effects(*ARM.effects, EffectSpec("base_drift"), EffectSpec("backlash", 2)))
    values = {"base_drift.vx": drift, "base_drift.vy": -drift, "backlash:2.b": backlash, "length_error:1": 0.8}
    q, order = rng.uniform(-2.5, 2.5, (m, 3)), np.arange(m, dtype=float)
    bare = Measurements(q, np.zeros((m, 2)), order)
    exact = model.position(q, model.parameters.vector(values), bare.conditions)
    return Measurements(q, exact + 0.05 * rng.standard_normal((m, 2)), order)


@pytest.fixture(scope="module")
def drifting() -> tuple[Diagnosis, Measurements, Measurements]:
    data = session(0.6, 6e-4)
    own, held = data.rows(np.arange(80) % 3 > 0), data.rows(np.arange(80) % 3 == 0)
    return judged(diagnose(ARM, own, held), ARM, own, held), own, held


def test_the_figures_are_those_of_validate_on_the_same_rows(
    drifting: tuple[Diagnosis, Measurements, Measurements],
) -> None:
    """With a drift, which belongs to the session: the file has its end, and both say so."""
    found, own, held = drifting
    assert {spec.key for spec in found.named.specs} == {"base_drift", "backlash:2"}
    extended = validate(found.extended_arm(), held)
    assert found.offered is not None
    assert found.offered.rms == pytest.approx(extended.model.rms, rel=1e-9)
    assert found.offered.largest == pytest.approx(extended.model.max, rel=1e-9)
    geometry = validate(replace(ARM, calibration=estimate(Model(ARM), own).calibration()), held)
    assert found.offered.rms_geometry == pytest.approx(geometry.model.rms, rel=1e-9)
    assert found.to_json()["offered"]["rms_mm"] == found.offered.rms
    assert found.gap.held_out_after is not None
    assert found.offered.rms > 1.5 * found.gap.held_out_after  # which had the drift of each row's time
    assert any("base_drift: of this session only" in note for note in found.notes)
    assert any("base_drift" in n and "of the session of the identification only" in n for n in extended.notes)


def worse(found: Diagnosis) -> Diagnosis:
    """The diagnosis with an effect ten times as large as it is."""
    own = found.predicting.calibration
    values = {k: 10.0 * v if k.startswith("backlash") else v for k, v in own.values.items()}
    calibration = Calibration(values, own.parameter_names, own.covariance)
    return replace(found, predicting=replace(found.predicting, calibration=calibration))


def test_a_model_that_is_worse_says_so_first(drifting: tuple[Diagnosis, Measurements, Measurements]) -> None:
    found, own, held = drifting
    spoiled = judged(worse(found), ARM, own, held)
    assert spoiled.offered is not None
    assert not spoiled.offered.better
    assert spoiled.offered.rms > spoiled.offered.rms_geometry
    said = spoiled.sentence.removeprefix("not confirmed: ")
    assert said.startswith(f"no better than the geometry alone: {spoiled.offered.rms:.3g} mm RMS (largest")
    assert spoiled.calibration.provenance["better_than_geometry"] is False


def test_without_a_hold_out_other_postures_say_it() -> None:
    data = session(0.0, 8e-4)
    found = judged(diagnose(ARM, data), ARM, data, None)
    test = next(test for test in found.cross_validation if test.transfer == "other postures")
    assert found.offered is not None
    assert (found.offered.by, found.offered.better) == ("cross-validation", True)
    assert (found.offered.rms, found.offered.rms_geometry) == (test.after, test.before)
    assert test.largest_before > test.before
    assert test.to_json()["max_after_mm"] == test.largest_after
    nothing = session(0.0, 0.0)
    assert judged(diagnose(ARM, nothing), ARM, nothing, None).offered is None


def test_geometry_and_largest_error_of_residuals_by_hand() -> None:
    rng = np.random.default_rng(2)
    data, before, after = session(0.0, 0.0), rng.normal(size=(80, 2)), 0.2 * rng.normal(size=(80, 2))
    found = Offered.of("holdout", before, after, data)
    assert found.better
    assert found.rms == pytest.approx(np.sqrt(np.mean(np.sum(after**2, axis=1))))
    assert (found.largest, found.largest_geometry) == (distances(after).max(), distances(before).max())
    assert not Offered.of("holdout", after, before, data).better
    again = before + 0.01 * rng.normal(size=(80, 2))
    assert not Offered.of("holdout", before, again, data).better  # within chance
    geometry = identified_geometry(ARM, data)
    assert geometry.calibration is not None
    np.testing.assert_allclose([*geometry.calibration.values.values()], estimate(Model(ARM), data).parameters)


@pytest.mark.parametrize("compliant", [True, False])
def test_a_prior_of_further_effects_is_judged_beside_the_geometry(compliant: bool) -> None:
    """Of 24 postures: where the arm sags the library's effects help, where nothing is missing they do not."""
    rng, arm = np.random.default_rng(6), drawn_arm()
    truth = small_arm(rng, compliance=np.array([0.0, 2e-4, 1e-4, 0.0, 0.0, 0.0]) * compliant)
    data = measured(truth, random_postures(24, rng), rng)
    library = library_prior(
        arm, given_by(data), names=["joint_compliance", "backlash", "encoder_eccentricity", "gear_ratio"]
    )
    found = estimate_with_prior(Model(library.arm), data, library.prior)
    offered = prior_judged(lambda: estimate(Model(arm), data), found, data)
    assert offered is not None
    assert (offered.by, offered.rows, offered.better) == ("cross-validation", 72, compliant)
