"""Several sessions: pooled tables, and a base for each session, against complex numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.errors import InputError
from identification.estimation import estimate
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.sessions import of_these_sessions, pooled, with_sessions, without_sessions

LENGTHS = np.array([300.0, 200.0, 150.0])
ERRORS, OFFSETS = np.array([1.0, -0.5, 0.3]), np.radians([0.4, -0.6, 0.2])
BASES = [(0.02, 3.0 - 2.0j), (2.5, -400.0 + 900.0j), (-1.2, 80.0 + 10.0j)]  # turn [rad] and shift [mm]


def tip(q: np.ndarray, turn: float, shift: complex) -> np.ndarray:
    z = ((LENGTHS + ERRORS) * np.exp(1j * np.cumsum(q + OFFSETS, axis=1))).sum(axis=1)
    z = np.exp(1j * turn) * z + shift
    return np.column_stack([z.real, z.imag])


def session(number: int, m: int = 20, **columns: object) -> Measurements:
    q = np.random.default_rng(number).uniform(-1.5, 1.5, (m, 3))
    return Measurements(q, tip(q, *BASES[number]), **columns)


def test_each_session_has_a_base_of_its_own() -> None:
    """Bases are recovered by any angle: relative to the first, rotation and shift of the tip in its frame."""
    data = pooled({f"day {k}": session(k) for k in range(3)})
    arm = with_sessions(Arm(LENGTHS), data)
    found = estimate(Model(arm), data)
    assert found.rms_after < 1e-8
    values = dict(zip(found.names, found.parameters, strict=True))
    first = BASES[0]
    np.testing.assert_allclose(found.length_errors, ERRORS, atol=1e-8)
    np.testing.assert_allclose(found.joint_offsets, OFFSETS + np.array([first[0], 0, 0]), atol=1e-10)
    for number in (2, 3):
        turn, shift = BASES[number - 1]
        expected = [turn - first[0], (shift - first[1]).real, (shift - first[1]).imag]
        got = [values[f"session_base.{short}{number}"] for short in "wxy"]
        np.testing.assert_allclose(got, expected, atol=1e-8)


def test_the_calibration_that_is_kept_is_that_of_the_first_session() -> None:
    data = pooled({"a": session(0), "b": session(1)})
    kept = without_sessions(estimate(Model(with_sessions(Arm(LENGTHS), data)), data).calibration())
    assert not [name for name in (*kept.values, *kept.parameter_names) if name.startswith("session_base")]
    assert kept.covariance.shape == (8, 8)
    arm = Arm(LENGTHS, effects=(EffectSpec("base_offset"),), calibration=kept)
    np.testing.assert_allclose(Model(arm).position(session(0).postures), session(0).positions, atol=1e-8)


def test_one_session_changes_nothing() -> None:
    arm = Arm(LENGTHS)
    assert with_sessions(arm, session(0)) is arm
    assert with_sessions(arm, pooled({"only": session(0)})) is arm


def test_a_known_base_stays_known() -> None:
    """Where the arm file says where the base stands, that holds in the first session."""
    shift = BASES[0][1]
    arm = Arm(LENGTHS, effects=(EffectSpec("base_offset", values={"x0": shift.real, "y0": shift.imag}),))
    data = pooled({"a": session(0), "b": session(1)})
    found = estimate(Model(with_sessions(arm, data)), data)
    assert found.rms_after < 1e-8
    assert "base_offset.x0" not in found.names


def test_a_hold_out_has_the_sessions_of_the_data() -> None:
    data = pooled({"a": session(0), "b": session(1)})
    later = replace(session(1, 5), session=np.full(5, "b"))
    np.testing.assert_array_equal(of_these_sessions(later, data).conditions.session, 1.0)
    for other, found in ((session(1), "no column session"), (replace(later, session=np.full(5, "c")), "session 'c'")):
        with pytest.raises(InputError, match=f"holdout: found {found}, allowed: a, b, as in the data"):
            of_these_sessions(replace(other, session_names=()), data)
    assert of_these_sessions(later, session(0)).session is None


def test_some_rows_keep_the_number_of_their_session() -> None:
    data = pooled({"a": session(0), "b": session(1)})
    later = data.rows(data.session == "b")
    assert later.sessions == ("b",)
    assert later.session_names == ("a", "b")
    np.testing.assert_array_equal(later.conditions.session, 1.0)


def test_pooled_tables() -> None:
    one = session(0, 3, repeats=[5, 5, 7], order=[1, 2, 3], sigma=[0.1, 0.1, 0.2])
    two = session(1, 2, repeats=[0, 5], order=[1, 2])
    with pytest.warns(UserWarning, match="left out: sigma"):
        data = pooled({"a": one, "b": two})
    assert data.session.tolist() == ["a"] * 3 + ["b"] * 2
    assert data.repeats[0] == data.repeats[1]
    assert len(set(data.repeats.tolist())) == 4  # 5 in one table is not 5 in the other
    np.testing.assert_array_equal(data.conditions.time, [-0.5, 0.0, 0.5, -0.5, 0.5])
    named = replace(session(2, 2), session=np.array(["x", "y"]))
    assert pooled({"a": session(0, 1), "c": named}).session.tolist() == ["a", "c/x", "c/y"]
    with pytest.raises(InputError, match=r"^b: found 2 joints and 2 coordinates, allowed: 3 and 2"):
        pooled({"a": session(0), "b": Measurements(np.zeros((2, 2)), np.ones((2, 2)))})


def test_what_is_not_said_is_session_one() -> None:
    arm = Arm(LENGTHS, effects=(EffectSpec("session_base", values={"sessions": 2}),))
    q, values = session(0).postures, np.r_[ERRORS, OFFSETS, 5.0, -7.0, 0.3]
    np.testing.assert_allclose(Model(arm).position(q, values), tip(q, 0.0, 0.0), atol=1e-9)
    second = Model(arm).position(q, values, Conditions(session=np.ones(len(q))))
    np.testing.assert_allclose(second, tip(q, 0.3, 5.0 - 7.0j), atol=1e-9)
