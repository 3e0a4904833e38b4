"""What a plan can show, before data."""

import numpy as np
import pytest
from scipy import stats

from identification import Arm, EffectSpec, Gravity, InputError, Measurements, Model
from identification.gap.blocks import hypotheses, linearized
from identification.gap.detectability import assess, detectability, detectable_lambda
from identification.gap.fit import Fitted, Rows, fit

ARM = Arm(
    [260.0, 180.0, 120.0],
    sigma=0.1,
    gravity=Gravity(np.array([0.0, -9.81]), np.array([8.0, 5.0, 3.0]), np.full(3, 0.5), 5.0),
)
POSTURES = np.random.default_rng(1).uniform(-np.pi, np.pi, (30, 3))


@pytest.mark.parametrize(("size", "freedom", "level"), [(1, 20, 0.01), (2, 50, 0.001), (4, 12, 0.05), (1, 2, 1e-5)])
def test_detectable_size_has_ninety_per_cent_power(size: int, freedom: int, level: float) -> None:
    """One-sided, too; and below rounding, where with two parameters the tail of F is (1 + 2 f / dof)^(-dof / 2)."""
    needed, limit = detectable_lambda(size, freedom, level), stats.f.isf(level, size, freedom)
    assert stats.ncf.sf(limit, size, freedom, needed**2) == pytest.approx(0.9, abs=1e-6)
    needed = detectable_lambda(1, freedom, level, one_sided=True)
    assert stats.nct.sf(stats.t.isf(level, freedom), freedom, needed) == pytest.approx(0.9, abs=1e-6)
    needed, limit = detectable_lambda(2, 20_000, 1e-20), 10_000 * (1e-20 ** (-1.0 / 10_000) - 1.0)
    assert stats.ncf.sf(limit, 2, 20_000, needed**2) == pytest.approx(0.9, abs=1e-6)


def test_share_size_and_likeness() -> None:
    """Of one effect from its own model; likeness is one for the effect itself and for a part of a family."""
    result, model = detectability(ARM, POSTURES), Model(ARM.with_effects(EffectSpec("gear_ratio", 2)))
    columns = model.jacobian(POSTURES).reshape(60, -1)
    added = columns[:, -1]
    left = added - columns[:, :-1] @ np.linalg.lstsq(columns[:, :-1], added, rcond=None)[0]
    k, size = result.names.index("gear_ratio:2"), result.detectable["gear_ratio:2"]
    assert result.norm_fractions[k] == pytest.approx(np.linalg.norm(left) / np.linalg.norm(added), rel=1e-8)
    assert size.unit == "1"
    # the size is a length lambda between 3.5 and 6 standard deviations: 90 % power at 0.05 / (about 30 effects)
    assert 3.5 < size.value * np.linalg.norm(left) / 0.1 < 6.0
    assert size.tip_mm == pytest.approx(size.value * np.sqrt(np.mean(np.sum(added.reshape(30, 2) ** 2, axis=1))))
    np.testing.assert_allclose(np.diag(result.likeness), 1.0)
    part, whole = result.names.index("joint_compliance:2"), result.names.index("joint_compliance")
    assert result.likeness[part, whole] == pytest.approx(1.0)
    assert result.likeness[whole, part] < 0.9
    assert ("joint_compliance:2", "joint_compliance") in [(a, b) for a, b, _ in result.pairs()]
    assert detectability(ARM, POSTURES[:5]).freedom == 4
    with pytest.raises(InputError, match="4 rows leave 2 residual degrees of freedom for tests, allowed: at least 4"):
        detectability(ARM, POSTURES[:4])


def test_no_size_listed_moves_the_tip_out_of_linear_theory() -> None:
    """On two angles a joint's cosine is a constant, but for rounding: its size would be thousands of degrees."""
    rng = np.random.default_rng(2)
    postures = rng.uniform(-np.pi, np.pi, (30, 3))
    postures[:, 2] = np.radians(80.0) * rng.choice([-1.0, 1.0], 30) + np.radians(1e-3) * rng.normal(size=30)
    sizes = detectability(ARM, postures).detectable
    assert sizes["encoder_eccentricity:3"].value is None
    size = sizes["gear_ratio:2"].value
    assert size is not None
    column = Model(ARM.with_effects(EffectSpec("gear_ratio", 2))).jacobian(postures)[:, :, 6] * size
    assert np.sqrt(np.mean(np.sum(column**2, axis=1))) <= 0.1 * 560.0 * 1.01


@pytest.mark.parametrize("effects", [("encoder_eccentricity:1",), ("gear_ratio:2", "backlash:3")])
def test_effects_beside_rows_that_are_left_out(effects: tuple[str, ...]) -> None:
    """Least squares of the other rows, by numpy alone."""
    rng, out = np.random.default_rng(6), [3, 17]
    exact = Model(ARM.with_effects(EffectSpec("gear_ratio", 2))).position(POSTURES, np.r_[np.zeros(6), 4e-4])
    noisy = exact + 0.1 * rng.standard_normal(exact.shape)
    noisy[out] += 5.0
    rows, kept = Rows.of(Measurements(POSTURES, noisy)), np.setdiff1d(np.arange(30), out)
    library = hypotheses(ARM, frozenset(), rows)
    at = fit(library.base, rows.pick(kept))
    problem = linearized(library, Fitted(at.model, at.values, rows), [(k,) for k in out])
    problem = problem.beside([problem.numbers[f"row:({k},)"] for k in out])
    blocks = [problem.numbers[label] for label in effects]
    base = library.base.jacobian(POSTURES, at.values, rows.conditions)[kept].reshape(56, -1)
    own = np.concatenate([problem.columns[k] @ problem.roots[k] for k in blocks], axis=2)[kept].reshape(56, -1)

    def left(y: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]

    projected = left(own, base)
    beside, places = problem.products, problem.products.columns_of(blocks)
    np.testing.assert_allclose(beside.gram[np.ix_(places, places)], projected.T @ projected, atol=1e-6)
    y = (noisy - library.base.position(POSTURES, at.values, rows.conditions))[kept].ravel()
    without, there = (np.sum(left(y, columns) ** 2) for columns in (base, np.hstack([base, own])))
    gain = beside.right[places] @ np.linalg.solve(beside.gram[np.ix_(places, places)], beside.right[places])
    assert (beside.freedom, beside.squares, gain) == pytest.approx((50, without, without - there), rel=1e-4)
    sees = assess(library, problem, rows, 0.1)
    assert sees.freedom == 50
    size = sees.detectable["gear_ratio:2"].value
    column = problem.columns[problem.numbers["gear_ratio:2"]][kept].reshape(56, 1)
    least = 0.1 * detectable_lambda(1, 49, 0.05 / sum(h.weight for h in library.members) / np.sqrt(3.0))
    assert size == pytest.approx(least / np.linalg.norm(left(column, base)), rel=1e-6)
