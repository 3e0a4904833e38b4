"""The library as a prior: what is in it, under which names, and with which standard deviations."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from identification import Arm, Calibration, EffectSpec, Gravity, InputError, Measurements, Model, estimate
from identification.effects import Effect, Parameter
from identification.effects.base import _LIBRARY
from identification.gap.library_prior import library_prior

ARM = Arm([300.0, 200.0])
ORDERS = range(3, 65)


def ripples(deviations: dict[str, float], joint: int) -> dict[int, float]:
    """Order -> deviation of the cosine of one joint's ripples."""
    names = {f"transmission_ripple:{joint}[k={order}].a": order for order in ORDERS}
    return {order: deviations[name] for name, order in names.items() if name in deviations}


def test_sizes_are_typical_and_shared_by_settings_and_by_rare_effects() -> None:
    """One ripple whose order is drawn at random has the covariance of all orders with a share of its variance each. An
    effect that is present in one arm of five with the deviation d, absent else, has the mean square d^2 / 5."""
    deviations = dict(library_prior(ARM, names=["transmission_ripple"]).prior.deviations)
    assert ripples(deviations, 1) == pytest.approx(dict.fromkeys(ORDERS, 1e-4 / np.sqrt(62.0)))
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, 2)
    drawn = np.mean([1e-8 * np.cos(k * (q[0] - q[1])) for k in ORDERS])  # one of 62 orders, a and b of variance 1e-8
    all_at_once = sum(size**2 * np.cos(k * (q[0] - q[1])) for k, size in ripples(deviations, 1).items())
    assert all_at_once == pytest.approx(drawn, rel=1e-12)
    rare = library_prior(ARM, names=["axis_tilt"])
    typical = Model(rare.arm).effects[-1].parameters[0].typical or 0.0
    assert rare.prior.deviations["axis_tilt:2.a"] == pytest.approx(typical / np.sqrt(5.0))


def test_joints_have_error_curves_beside_ripples() -> None:
    """Draws of a random walk over one turn, its first two waves and its mean taken out, with a ripple of one order: the
    covariance over angles is that of the waves together. A walk of variance v a turn has waves a, b of v / (2 pi^2 k^2)
    about its bridge (the Karhunen-Loeve series on a circle), so that 1e-3 at k = 1 is v = 2 pi^2 1e-6."""
    library = library_prior(ARM)
    assert library.prior.deviations["encoder_eccentricity:2.a"] == 5e-4
    sizes, count, turns = ripples(dict(library.prior.deviations), 2), 4000, 2048
    steps = np.random.default_rng(0).standard_normal((count, turns)) * np.sqrt(2.0 * np.pi**2 * 1e-6 / turns)
    walk = np.cumsum(steps, axis=1)
    bridge = walk - walk[:, -1:] * np.arange(1, turns + 1) / turns
    spectrum = np.fft.rfft(bridge, axis=1) * 2.0 / turns
    for order in (3, 5, 12):
        curve = np.mean(np.abs(spectrum[:, order]) ** 2) / 2.0  # of cosine and sine each
        expected = np.sqrt(curve + 1e-8 / 62.0)
        assert sizes[order] == pytest.approx(expected, rel=4.0 / np.sqrt(count))  # chi-square: 4 standard errors
    # waves too fast to be added are counted
    slow = library_prior(ARM, fastest=24.0)
    assert ripples(dict(slow.prior.deviations), 2) == {k: size for k, size in sizes.items() if k <= 24}
    assert slow.faster == pytest.approx([sum(size**2 for k, size in sizes.items() if k > 24)] * 2)
    assert not library.faster.any()
    arm = replace(ARM, effects=(EffectSpec("base_offset"),))
    alone = library_prior(arm, names=["transmission_ripple"], fastest=2.0)
    assert (alone.added, dict(alone.prior.deviations)) == ((), {})  # the arm's own effect is none of them


def test_what_the_rows_cannot_show_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unsized(Effect):
        name = "unsized"
        summary = "a size that nobody knows"

        def define(self) -> tuple[Parameter, ...]:
            return (self.parameter("x", "mm", scale=1.0),)

        def tool(self, chain: object, values: ca.SX) -> ca.SX:
            return ca.vertcat(values[0], 0.0)

    monkeypatch.setitem(_LIBRARY, "unsized", Unsized)
    library = library_prior(ARM)
    reasons = {"backlash:1": "needs directions", "base_drift": "needs time", "link_bending": "needs gravity"}
    assert (reasons | {"unsized": "no typical size"}).items() <= library.left_out.items()
    assert not any(name.startswith(("backlash", "base_drift")) for name in library.prior.deviations)
    given = library_prior(ARM, Measurements(np.zeros((2, 2)), np.zeros((2, 2)), temperature=np.array([20.0, 21.0])))
    assert {"backlash:1.b", "base_drift.vx", "thermal_growth.a"} <= set(given.prior.deviations)
    assert set(given.prior.deviations) < set(Model(given.arm).names)
    # an effect of all joints stands for those of each
    heavy = library_prior(replace(ARM, gravity=Gravity([0.0, -9.81], [5.0, 3.0], [0.5, 0.5])))
    names = [name for name in heavy.prior.deviations if name.startswith("joint_compliance")]
    assert names == ["joint_compliance.c1", "joint_compliance.c2"]
    assert [heavy.prior.deviations[name] for name in names] == [1e-5, 1e-5]
    # where links carry more than 1,000 N m, gears are as much stiffer as that is more
    heavy = library_prior(replace(ARM, gravity=Gravity([0.0, -9.81], [500.0, 3000.0], [0.5, 0.5], 100.0)))
    expected = 0.01 / (9.81 * np.array([3600.0 * 0.3, 3100.0 * 0.2]))
    assert [heavy.prior.deviations[name] for name in names] == pytest.approx(expected)


def test_own_effects_have_no_prior_and_keep_their_values() -> None:
    """A ripple of the arm's own gets a longer name beside others; its calibrated value goes with it."""
    arm = replace(ARM, effects=(EffectSpec("base_offset"), EffectSpec("transmission_ripple", 1, {"k": 17.0})))
    arm = replace(arm, calibration=Calibration.of([1.0, 2.0], [0.0, 0.1], {Model(arm).names[-1]: 3e-4}))
    library = library_prior(arm)
    model, longer = Model(library.arm), "transmission_ripple:1[k=17].b"
    assert model.values[model.parameters.index(longer)] == 3e-4
    assert not {longer, "base_offset.x0"} & set(library.prior.deviations)
    assert model.values[1] == 2.0


@pytest.mark.parametrize("share", [2.0, 0.25])
def test_the_error_expected_at_the_tip_is_that_of_arms_of_the_prior(share: float) -> None:
    """12 arms with twice of everything drawn from it, or a quarter, an error of its own at every posture included,
    measured at 40 postures and judged at others. The mean squares of the arms scatter by a fifth, their mean by 6 %:
    three of them."""
    library, generator = library_prior(replace(ARM, sigma=0.02)), np.random.default_rng(12)
    model, own, expected, reached = Model(library.arm), library.prior.own_error, [], []
    sizes = model.parameters.vector(library.prior.deviations, default=0.0)
    for _ in range(12):
        postures = generator.uniform(-np.pi, np.pi, (240, 2))
        real = model.position(postures, share * sizes * generator.standard_normal(len(sizes)))
        real = real + share * own * generator.standard_normal((240, 2))
        data = Measurements(postures[:40], real[:40] + 0.02 * generator.standard_normal((40, 2)))
        fit = estimate(model, data, prior=library.prior)
        assert fit.expected_tip is not None
        missed = real[40:] - fit.model.position(postures[40:], fit.parameters)
        expected.append(fit.expected_tip**2)
        reached.append(np.mean(np.sum(missed**2, axis=1)))
    assert np.mean(expected) == pytest.approx(np.mean(reached), rel=0.2)
    bare, own = replace(fit, prior=replace(library.prior, own_error=0.0)), fit.prior.own_error
    assert expected[-1] == pytest.approx(bare.expected_tip**2 + 2.0 * own**2, rel=1e-9)


def test_only_what_is_named_may_be_missing_and_unknown_names_are_refused() -> None:
    """No error curve, and no posture has an error of its own; else this is in proportion to the arm."""
    named = library_prior(ARM, names=["gear_ratio"])
    assert (named.prior.own_error, named.faster.any(), dict(named.left_out)) == (0.0, False, {})
    assert list(named.prior.deviations) == ["gear_ratio:1.e", "gear_ratio:2.e"]
    assert library_prior(ARM).prior.own_error == pytest.approx(0.03)
    assert library_prior(Arm([600.0, 400.0])).prior.own_error == pytest.approx(0.06)
    for name, complaint in (("gear", "unknown name 'gear'"), ("backlash", r"left for the prior \(backlash:1 needs")):
        with pytest.raises(InputError, match=complaint):
            library_prior(ARM, names=[name])
