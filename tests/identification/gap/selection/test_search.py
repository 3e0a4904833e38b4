"""Sets of effects: the linear short cut of many rows against fits of their own."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec, Gravity
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet, hypotheses
from identification.gap.selection.search import HypothesisSearch, _turn
from identification.measurements import Measurements
from identification.model import Model
from tests.small_arm import drawn_arm, measured, random_postures, small_arm

ARM = Arm([300.0, 200.0, 150.0], effects=(EffectSpec("base_offset"),))
LIBRARY = hypotheses(ARM, frozenset())
NAMES = ("encoder_eccentricity:2", "transmission_ripple:1[k=7]")


def searched() -> tuple[HypothesisSearch, tuple[Hypothesis, ...]]:
    """120 rows with an eccentric encoder and a ripple of some 0.3 mm, noise of 0.05 mm."""
    rng = np.random.default_rng(21)
    chosen = tuple(h for name in NAMES for h in LIBRARY.members if h.label == name)
    model = Model(ARM.with_effects(*ARM.effects, *(h.spec for h in chosen)))
    truth = model.parameters.vector(
        {"base_offset.x0": 1.0, "encoder_eccentricity:2.a": 1e-3, "encoder_eccentricity:2.b": -5e-4}
        | {name: 6e-4 for name in model.names if "ripple" in name}
    )
    q = rng.uniform(-2.5, 2.5, (120, 3))
    positions = model.position(q, truth) + 0.05 * rng.normal(size=(120, 2))
    return HypothesisSearch(LIBRARY, Rows.of(Measurements(q, positions))), chosen


def test_with_the_columns_of_the_base_fit_the_figures_are_nearly_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters move by some 1e-3 rad, columns by as much relatively: statistics by less than 1 %."""
    search, chosen = searched()
    exact = search.state(chosen)
    monkeypatch.setattr("identification.gap.selection.search.SAME_COLUMNS", 100)
    linear = search.state(chosen)
    assert [h.label for h in linear.members] == [h.label for h in exact.members]
    assert linear.squares == pytest.approx(exact.squares, rel=1e-5)
    np.testing.assert_allclose(linear.reductions, exact.reductions, rtol=0.01, atol=0.01 * exact.squares / 200)


def test_a_member_left_out_without_a_fit_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    search, chosen = searched()
    monkeypatch.setattr("identification.gap.selection.search.SAME_COLUMNS", 100)
    short = search.state_without(chosen, chosen[0])
    assert frozenset({chosen[1].label}) not in search.fits
    own = search.state(chosen[1:])
    assert short.squares == pytest.approx(own.squares, rel=1e-4)
    assert short.strongest.label == own.strongest.label == chosen[0].label
    np.testing.assert_allclose(short.change, own.change, atol=0.1)


def test_the_same_effect_in_other_words_is_exactly_as_good() -> None:
    """Beside a base offset a base that moves after a time or before it: rounding must not choose."""
    search, _ = searched()
    state = search.state(())
    change = {h.label: float(c) for h, c in zip(state.members, state.change, strict=True)}
    after = [label for label in change if label.startswith("base_step") and "side=1" in label]
    assert len(after) > 10
    before = [label.replace("side=1", "side=-1") for label in after]
    assert [change[label] for label in after] == [change[label] for label in before]


def test_what_shows_through_an_effect_of_gravity_is_tested_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the base fit a wrong payload moves nothing; beside a compliance it does, also where columns are the base's."""
    monkeypatch.setattr("identification.gap.selection.search.SAME_COLUMNS", 40)
    gravity = Gravity([0.0, -9.81], [8.0, 5.0], [0.5, 0.5], 6.0)
    arm, generator = Arm([400.0, 300.0], gravity=gravity), np.random.default_rng(3)
    soft = EffectSpec("joint_compliance", 1), EffectSpec("payload_error")
    model = Model(arm.with_effects(*soft))
    truth = model.parameters.vector({"joint_compliance:1.c": 1e-4, "payload_error.d": 4.0})
    q = generator.uniform(-2.5, 2.5, (60, 2))
    data = Measurements(q, model.position(q, truth) + 0.01 * generator.standard_normal((60, 2)))
    search = HypothesisSearch(hypotheses(arm, frozenset()), Rows.of(data))
    (stiffness,) = (h for h in search.hypotheses.members if h.key == "joint_compliance:1")
    assert "payload_error" not in {h.key for h in search.state(()).members}
    beside = search.state((stiffness,))
    (k,) = (k for k, h in enumerate(beside.members) if h.key == "payload_error")
    both = search.fit((stiffness, beside.members[k]))
    assert beside.squares - beside.reductions[k] == pytest.approx(both.squares, rel=0.2)
    assert both.by_name["payload_error.d"] == pytest.approx(4.0, rel=0.3)


def test_beside_gravity_only_what_it_changes_is_evaluated_again() -> None:
    """An arm in space with a compliant joint: all columns once, at the base fit; those of gravity at each set's fit.

    Oracle: all columns at the set's fit, projected off its own Jacobian. Parameters move by 1e-3, and so do columns.
    """
    rng = np.random.default_rng(8)
    truth = small_arm(rng, ("encoder_eccentricity", 3, {"a": 4e-4, "b": 2e-4}), ("payload_error", None, {"d": 0.5}))
    search = HypothesisSearch(
        hypotheses(drawn_arm(), frozenset()), Rows.of(measured(truth, random_postures(40, rng), rng))
    )
    names = ("joint_compliance", "encoder_eccentricity:3")
    chosen = tuple(h for h in search.hypotheses.members if h.label in names)
    found = search.fit(chosen)
    columns = search.hypotheses.matrix(search.rows, found.by_name, search.slopes, found.model)
    exact = search._state(chosen, found.residual, found.basis, columns)
    with patch.object(HypothesisSet, "matrix", autospec=True, side_effect=HypothesisSet.matrix) as evaluated:
        state = search.state(chosen)
        short = search.state_without(chosen, chosen[1])
    assert evaluated.call_count == 1
    linear, full = ({h.label: float(r) for h, r in zip(s.members, s.reductions, strict=True)} for s in (state, exact))
    both = [label for label in full if label in linear]
    assert len(both) >= len(full) - 2  # what the set explains all but wholly
    values = np.array([[linear[label], full[label]] for label in both])
    variance = exact.squares / len(exact.residual)  # a column turned by 1 % changes its score by a tenth of sigma
    np.testing.assert_allclose(values[:, 0], values[:, 1], rtol=0.02, atol=0.5 * variance)
    assert {"payload_error", "gravity_tilt"} <= {*both}
    own = HypothesisSearch(search.hypotheses, search.rows).state(chosen[:1])
    assert short.squares == pytest.approx(own.squares, rel=1e-3)
    assert short.strongest.label == own.strongest.label == names[1]


@pytest.mark.parametrize("apart", [1.0, 1e-3, 1e-6, 0.0])
def test_orthonormal_combinations(apart: float) -> None:
    """Of columns that differ from each other by so little, off a basis; as many as differ by more than rounding."""
    rng = np.random.default_rng(3)
    known = np.linalg.qr(rng.normal(size=(80, 4)))[0]
    first, other, third = rng.normal(size=(3, 80))
    columns = np.column_stack([first, 50.0 * (first + apart * other), third])
    own = known.T @ columns
    turn = _turn(columns.T @ columns, own, lambda: columns - known @ own)
    basis = np.column_stack([known, columns @ turn - known @ (own @ turn)])
    assert basis.shape[1] == (6 if apart == 0.0 else 7)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-13 / max(apart, 1e-5))


def test_change_of_bic_is_that_of_refits() -> None:
    """To second order in effects of 1e-3 rad."""
    search, chosen = searched()
    state = search.state(chosen[:1])
    k = next(i for i, h in enumerate(state.members) if h.label == chosen[1].label)
    assert state.change[k] == pytest.approx(search.bic(chosen) - search.bic(chosen[:1]), rel=0.01)


def test_fits_do_not_keep_their_jacobian() -> None:
    search, chosen = searched()
    found = search.fit(chosen)
    jacobian = found.jacobian
    assert jacobian.shape == (240, len(found.values))
    np.testing.assert_allclose(found.triangle.T @ found.triangle, jacobian.T @ jacobian, rtol=1e-9, atol=1e-9)
    assert found.rank == found.basis.shape[1]
