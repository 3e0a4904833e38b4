"""What error curves leave of another session, beside plain geometry: every figure of simulated arms that
identification/README.md, "Error curves" quotes. Run it with -s; some minutes of one core.

The simulator has rotation vectors of its own. Sessions have other ranges of angles, in half of the cases ranges of
joint 1 that do not meet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.estimation import estimate, estimate_with_prior
from identification.files.arm import load_arm
from identification.gap.curves.curves import curve_candidate, find_curves
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.library.library_prior import given_by, library_prior
from identification.gap.outside.unmodelled import Unknown
from identification.gap.selection.search import HypothesisSearch
from identification.gap.workflow import Findings
from identification.measurements import Measurements
from identification.model import Model
from identification.model.minimal import placed_calibration, practical
from identification.validate import validate

pytestmark = pytest.mark.benchmark
LENGTHS, ROWS, NOISE = np.array([600.0, 500.0, 120.0]), 300, 0.05
SPACE = Path(__file__).parents[1] / "data/ur10/ur10.toml"
TABLE = ((0, 90, 127.3), (-612, 0, 0), (-572.3, 0, 0), (0, 90, 163.941), (0, -90, 115.7), (0, 0, 92.2))
SLOW = ([1, 2, 3], [3e-4, 2e-4, 1e-4])  # orders and sizes [rad] of errors of joints
FAST = 1.5e-4  # of two ripples more, of an order from 5 to 29
Measure = Callable[[Array], Measurements]


def functions(rng: np.random.Generator, joints: int, fast: bool) -> list[Callable[[Array], Array]]:
    """Errors of the joints [rad] as functions of their angles."""

    def made(orders: Array, sizes: Array) -> Callable[[Array], Array]:
        a, b = (rng.normal(size=(len(orders), 2)) * sizes[:, None]).T
        return lambda q: np.cos(np.multiply.outer(q, orders)) @ a + np.sin(np.multiply.outer(q, orders)) @ b

    found = []
    for _ in range(joints):
        more = [int(rng.integers(5, 30)), int(rng.integers(5, 30))] if fast else []
        found.append(made(np.array(SLOW[0] + more), np.array(SLOW[1] + [FAST] * len(more))))
    return found


def ranges(rng: np.random.Generator, joints: int) -> tuple[Array, Array]:
    """(2, n) limits of each of two sessions."""
    width, center = np.radians(rng.uniform(100, 300, joints)), rng.uniform(-np.pi, np.pi, joints)
    other, moved = np.radians(rng.uniform(60, 200, joints)), center + rng.normal(size=joints) * np.radians(50)
    if rng.random() < 0.5:
        moved[0], other[0] = center[0] + np.pi, min(other[0], 2.0 * np.pi - width[0] - 0.02)
    return np.stack([center - width / 2, center + width / 2]), np.stack([moved - other / 2, moved + other / 2])


def planar(rng: np.random.Generator, fast: bool, sag: float) -> tuple[Arm, Measure, tuple[Array, Array]]:
    errors, limits = functions(rng, 3, fast), ranges(rng, 3)
    lengths, offsets = LENGTHS + 0.5 * rng.normal(size=3), 2e-3 * rng.normal(size=3)

    def measure(q: Array) -> Measurements:
        turned = np.cumsum(q + np.stack([f(q[:, j]) for j, f in enumerate(errors)], axis=1) + offsets, axis=1)
        turned = turned + sag * np.cos(q[:, :1] + q[:, 1:2]) * [0, 1, 1]
        tip = np.stack([(lengths * np.cos(turned)).sum(axis=1), (lengths * np.sin(turned)).sum(axis=1)], axis=1)
        return Measurements(q, tip + 5.0 * rng.normal(size=2) + NOISE * rng.normal(size=tip.shape))

    return Arm(LENGTHS, effects=(EffectSpec("base_offset"),)), measure, limits


def spatial(rng: np.random.Generator, fast: bool, sag: float) -> tuple[Arm, Measure, tuple[Array, Array]]:
    errors, limits = functions(rng, 6, fast), ranges(rng, 6)
    links, tool = np.c_[rng.normal(size=(6, 3)) * 0.5, rng.normal(size=(6, 3)) * 1e-3], rng.uniform(20, 80, 3)

    def measure(q: Array) -> Measurements:
        turned = q + np.stack([f(q[:, j]) for j, f in enumerate(errors)], axis=1)
        forearm = 0.5 * np.cos(q[:, 1] + q[:, 2])
        turned[:, 1] += sag * (np.cos(q[:, 1]) + forearm)
        turned[:, 2] += sag * forearm
        places = np.tile(tool, (len(q), 1))
        for j in range(5, -1, -1):
            a, alpha, d = TABLE[j]
            places = Rotation.from_rotvec([np.radians(alpha), 0, 0]).apply(places) + np.array([a, 0, d])
            places = Rotation.from_rotvec(links[j, 3:]).apply(places) + links[j, :3]
            places = Rotation.from_rotvec(np.outer(turned[:, j], [0, 0, 1])).apply(places)
        shift, turn = rng.normal(size=3) * 1000.0, rng.normal(size=3) * 0.5
        return Measurements(q, Rotation.from_rotvec(turn).apply(places) + shift + NOISE * rng.normal(size=places.shape))

    return load_arm(SPACE), measure, limits


def left(arm: Arm, here: Measurements, there: Measurements) -> tuple[float, float] | None:
    """RMS that the curves of one session leave of another, as a share of what plain geometry leaves: with the geometry
    as it was fitted, and as armcal writes it; None without curves."""
    base = practical(arm, here)
    search = HypothesisSearch(hypotheses(base, frozenset()), Rows.of(here))
    outlier = np.zeros(len(here), dtype=bool)
    found = find_curves(Findings(search, None, Unknown(1e-3, "joint:1", None, (), 0.0), (), outlier), here)  # type: ignore[arg-type]
    if found is None:
        return None
    candidate = curve_candidate(found)
    calibration = placed_calibration(base, candidate.calibration)
    together = replace(base, effects=(*base.effects, *candidate.specs), calibration=calibration)
    bare = (replace(s, curve=replace(s.curve, geometry={})) if s.curve else s for s in together.effects)
    plain = validate(estimate(Model(arm), here).calibrated_arm(), there).model.rms
    return tuple(validate(each, there).model.rms / plain for each in (together.with_effects(*bare), together))  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("made", "count", "sags"), [(planar, 12, [0.0, 3e-4]), (planar, 12, [1.5e-3]), (spatial, 8, [1.5e-3])]
)
def test_another_session(
    made: Callable[..., tuple[Arm, Measure, tuple[Array, Array]]], count: int, sags: list[float]
) -> None:
    ratios = []
    for seed in range(count):
        for fast in (False, True):
            for sag in sags:
                rng = np.random.default_rng([41, seed, int(fast), made is spatial])
                arm, measure, limits = made(rng, fast, sag)
                here, there = (measure(rng.uniform(*pair, (ROWS, len(pair[0])))) for pair in limits)
                if (found := left(arm, here, there)) is not None:
                    ratios.append(found)
    mean, worst = np.exp(np.mean(np.log(ratios), axis=0)), np.max(ratios, axis=0)
    print(f"\n{made.__name__}, sag {sags} rad, {len(ratios)} arms with curves: as fitted {mean[0]:.2f}", end="")
    print(f", worst {worst[0]:.2f}; together with their geometry {mean[1]:.2f}, worst {worst[1]:.2f}")
    assert mean[1] < 1.0


def test_the_library_as_a_prior() -> None:
    """Arms in space: what it leaves of another session, as a share of what plain geometry leaves."""
    ratios = []
    for seed in range(3):
        for fast in (False, True):
            for sag in (0.0, 1.5e-3):
                rng = np.random.default_rng([41, seed, int(fast), 1])
                arm, measure, limits = spatial(rng, fast, sag)
                here, there = (measure(rng.uniform(*pair, (ROWS, 6))) for pair in limits)
                library = library_prior(arm, given_by(here))
                fits = estimate(Model(arm), here), estimate_with_prior(library.model, here, library.prior)
                plain, prior = (validate(fit.calibrated_arm(), there).model.rms for fit in fits)
                ratios.append(prior / plain)
                print(f"\n{seed} {fast} {sag:g}: {plain:.3f} mm, library as a prior {prior:.3f} mm", end="")
    print(f"\n{len(ratios)} arms: geometric mean {np.exp(np.mean(np.log(ratios))):.2f}, worst {max(ratios):.2f}")
    assert np.mean(np.log(ratios)) < 0.0
