"""What returns in another session: simulated in complex numbers, judged as a reader of the definition would."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from identification.arm import Arm, EffectSpec
from identification.gap.diagnose import diagnose
from identification.gap.fit import Rows, fit
from identification.gap.sessions.replicate import replications
from identification.gap.sessions.replication import Replication, replication_clauses
from identification.gap.sessions.shared_fit import SessionRows, SharedFit
from identification.measurements import Measurements
from identification.model import Model
from identification.sessions import pooled_sessions, with_sessions

LENGTHS, SIGMA, K = np.array([300.0, 200.0]), 0.1, 5
BASES = [(0.0, 0.0), (0.7, 100.0 - 50.0j), (-2.0, 30.0j)]


def session(number: int, size: complex, m: int = 60) -> Measurements:
    """A wave of 5 per turn in joint 2, a cos + b sin with a + ib = `size` [rad]."""
    generator = np.random.default_rng(number)
    q = generator.uniform(-np.pi, np.pi, (m, 2))
    bent = q + np.array([0.001, -0.002])
    bent[:, 1] += size.real * np.cos(K * q[:, 1]) + size.imag * np.sin(K * q[:, 1])
    turn, shift = BASES[number]
    z = np.exp(1j * turn) * (LENGTHS * np.exp(1j * np.cumsum(bent, axis=1))).sum(axis=1) + shift
    return Measurements(q, np.column_stack([z.real, z.imag]) + generator.normal(0.0, SIGMA, (m, 2)))


def found(*sizes: complex) -> tuple[Replication, Measurements]:
    data = pooled_sessions({f"day {k + 1}": session(k, size) for k, size in enumerate(sizes)})
    arm = with_sessions(Arm(LENGTHS), data)
    spec = EffectSpec("transmission_ripple", 2, {"k": K})
    rows = Rows.of(data)
    fitted = fit(Model(arm.with_effects(*arm.effects, spec)), rows)
    label = f"transmission_ripple:2[k={K}]"
    (one,) = replications(fitted, data, np.ones(len(data), dtype=bool), (label,))
    return one, data


SIZE = 0.001 - 0.0005j  # some 0.2 mm at the tip of a link of 200 mm


@pytest.mark.parametrize(
    ("sizes", "answer", "each"),
    [
        ((SIZE, SIZE), True, (True, True)),
        ((SIZE, SIZE, SIZE), True, (True, True, True)),
        ((SIZE, -SIZE), False, (False, False)),  # what one session says is wrong by twice the effect in the other
        ((SIZE, 0.0j), False, (None, False)),  # of nothing the other session can learn nothing
    ],
)
def test_what_returns_and_what_does_not(
    sizes: tuple[complex, ...], answer: bool, each: tuple[bool | None, ...]
) -> None:
    one, _ = found(*sizes)
    assert one.replicates is answer
    assert tuple(s.returns for s in one.sessions) == each
    assert (one.p_equal < 1e-3) is not answer
    for there, size in zip(one.sessions, sizes, strict=True):
        errors = (np.radians(there.values) - [size.real, size.imag]) / np.radians(there.deviations)
        assert np.all(np.abs(errors) < 5.0)
    assert list(replication_clauses((one,))) == [
        f"{'replicates' if answer else 'does not replicate'} across sessions: {one.effect}"
    ]


def test_the_same_without_noise_explains_everything() -> None:
    one, _ = found(20.0 * SIZE, 20.0 * SIZE)
    assert all(s.explained > 0.99 for s in one.sessions)
    assert one.to_json()["sessions"][1]["parameters"][0]["name"] == "transmission_ripple:2.a"


def test_p_equal_is_the_f_test_of_separate_values() -> None:
    one, data = found(SIZE, 1.3 * SIZE)
    q, second = data.postures, data.session == "day 2"
    links = LENGTHS * np.exp(1j * np.cumsum(q, axis=1))
    # in the frame of each session; a linear model is enough for errors of 0.1 % of the reach
    turned = np.where(second, np.exp(1j * BASES[1][0]), 1.0)[:, None]
    links = links * turned
    lever = 1j * links[:, 1:]
    wave = lever * np.column_stack([np.cos(K * q[:, 1]), np.sin(K * q[:, 1])])
    tip, there = links.sum(axis=1, keepdims=True), second[:, None]
    ones = np.ones((len(q), 1))
    shared = np.hstack(
        [links, 1j * tip, 1j * lever / 1j, ones, 1j * ones, 1j * tip * there, there * ones, 1j * there * ones]
    )
    shift = np.where(second, BASES[1][1], 0.0)
    rest = data.positions @ [1.0, 1.0j] - shift - links.sum(axis=1)

    def squares(columns: np.ndarray) -> float:
        tall, response = (np.concatenate([z.real, z.imag]) for z in (columns, rest))
        return float(np.sum((response - tall @ np.linalg.lstsq(tall, response, rcond=None)[0]) ** 2))

    one_set, two_sets = squares(np.hstack([shared, wave])), squares(np.hstack([shared, wave * there, wave * ~there]))
    freedom = 2 * len(q) - shared.shape[1] - 4
    f = (one_set - two_sets) / 2.0 / (two_sets / freedom)
    assert one.p_equal == pytest.approx(stats.f.sf(f, 2, freedom), rel=0.05)


def test_one_session_has_nothing_to_compare() -> None:
    data = session(0, SIZE)
    rows = Rows.of(data)
    fitted = fit(Model(Arm(LENGTHS, effects=(EffectSpec("gear_ratio", 1),))), rows)
    assert replications(fitted, data, np.ones(len(data), dtype=bool), ("gear_ratio:1",)) == ()


def bumpy(number: int, sign: float, width: float) -> Measurements:
    """Two bumps in the error of joint 2, which turns by `width` to both sides."""
    generator = np.random.default_rng(20 + number)
    q = generator.uniform(-np.pi, np.pi, (70, 2))
    q[:, 1] *= width / np.pi
    bent, turn = q.copy(), BASES[number]
    for center in (-0.6, 0.5):
        bent[:, 1] += sign * 0.004 * np.exp(-0.5 * ((q[:, 1] - center) / 0.2) ** 2)
    z = np.exp(1j * turn[0]) * (LENGTHS * np.exp(1j * np.cumsum(bent, axis=1))).sum(axis=1) + turn[1]
    return Measurements(q, np.column_stack([z.real, z.imag]) + generator.normal(0.0, SIGMA, (70, 2)))


@pytest.mark.parametrize(("sign", "answer"), [(1.0, True), (-1.0, False)])
def test_a_curve_returns_where_both_sessions_have_measured(sign: float, answer: bool) -> None:
    """One session covers a part of the angles of the other; its curve has another level there."""
    data = pooled_sessions({"wide": bumpy(0, 1.0, np.pi), "narrow": bumpy(1, sign, 1.2)})
    diagnosis = diagnose(Arm(LENGTHS), data)
    curve = next((r for r in diagnosis.replication if r.effect == "joint_error_curve:2"), None)
    if answer:
        assert curve is not None
        assert curve.p_equal is None
        assert curve.to_json()["sessions"][0]["parameters"] == []
    assert (curve.replicates if curve else False) is answer


def test_without_common_angles_nothing_is_said() -> None:
    """Joint 2 turned to one side only in each session: no row of one is within the angles of the other."""
    generator = np.random.default_rng(30)
    q = generator.uniform(-np.pi, np.pi, (60, 2))
    q[:, 1] = np.where(np.arange(60) < 30, 1.0, -1.0) * generator.uniform(0.1, 1.0, 60)
    z = (LENGTHS * np.exp(1j * np.cumsum(q, axis=1))).sum(axis=1)
    data = Measurements(q, np.column_stack([z.real, z.imag]) + generator.normal(0.0, SIGMA, (60, 2)))
    fitted = fit(Model(Arm(LENGTHS, effects=(EffectSpec("gear_ratio", 2),))), Rows.of(data))
    sides = [SessionRows(name, np.arange(30) + 30 * k, (np.arange(30) % 8,)) for k, name in enumerate("ab")]
    shared = SharedFit.of(fitted, tuple(sides))
    carried = shared.carried(0, shared.columns_of(fitted.model.effects[0]), joint=2)
    assert carried.unsure
    assert (len(carried.part), len(carried.gains), carried.explained) == (0, 0, 0.0)
