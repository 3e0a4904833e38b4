"""Parts of a spatial arm, compiled once: an effect against its formula, the geometry against products of matrices."""

from __future__ import annotations

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.conditions import Conditions
from identification.effects import Effect
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.model import Model
from identification.model.compiled_parts import compiled_arm

ROWS = [DHRow(0.0, np.pi / 2.0, 300.0), DHRow(400.0, 0.1, 20.0), DHRow(350.0, -1.0, 10.0)]
CHAIN = chain_of(ROWS)
POSTURES = np.random.default_rng(0).uniform(-2.0, 2.0, (6, 3))
SHARED = compiled_arm(CHAIN, None, False, ())


def effect_of(spec: EffectSpec) -> Effect:
    (effect,) = Model(Arm(CHAIN, effects=(spec,))).effects
    return effect


def conditions() -> np.ndarray:
    return Model(Arm(CHAIN)).condition_table(POSTURES, Conditions())


def test_a_wave_adds_to_its_joint_alone() -> None:
    """a cos 5 q_2 + b sin 5 q_2, linear in a and b: slopes of postures that cannot change are kept."""
    ripple = SHARED.of(effect_of(EffectSpec("transmission_ripple", 2, {"k": 5.0})))
    assert ripple.rows.tolist() == [SHARED.places["joint_angles"].start + 1]
    assert [ripple.loads, ripple.measures, ripple.reads] == [False] * 3
    state = np.zeros((len(POSTURES), SHARED.at.state.numel()))
    held = POSTURES.copy()
    held.setflags(write=False)
    for q in (held, held + 0.3, held, POSTURES.copy()):
        for a, b in ((1e-3, 2e-3), (-4e-3, 1e-3)):
            added, slopes, by_state = ripple.added(q, conditions(), np.array([a, b]), state)
            expected = np.column_stack([np.cos(5.0 * q[:, 1]), np.sin(5.0 * q[:, 1])])
            np.testing.assert_allclose(slopes[:, 0], expected, atol=1e-14)
            np.testing.assert_allclose(added[:, 0, 0], expected @ [a, b], atol=1e-16)
            assert not np.any(by_state)


def test_an_effect_of_the_instrument_reads_the_tip() -> None:
    """A scale e measures (1 + e) of the tip, which stands in the state."""
    scale = SHARED.of(effect_of(EffectSpec("measurement_scale")))
    assert scale.measures
    assert scale.reads
    assert not scale.loads
    state = np.zeros((len(POSTURES), SHARED.at.state.numel()))
    state[:, SHARED.of_tip] = tips = np.random.default_rng(1).uniform(-500.0, 500.0, (len(POSTURES), 3))
    added, slopes, by_state = scale.added(POSTURES, conditions(), np.array([2e-3]), state)
    np.testing.assert_allclose(added[..., 0], 2e-3 * tips, rtol=1e-12)
    np.testing.assert_allclose(slopes[..., 0], tips, rtol=1e-12)
    tip_of_state = np.broadcast_to(2e-3 * np.eye(3), (len(POSTURES), 3, 3))
    np.testing.assert_allclose(by_state[..., SHARED.of_tip], tip_of_state, atol=1e-15)


def frame(row: DHRow, angle: float) -> np.ndarray:
    """(4, 4) a Denavit-Hartenberg transform, written out."""
    c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(row.alpha), np.sin(row.alpha)
    turned = [[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0.0, sa, ca]]
    return np.block([[np.array(turned), np.array([[row.a * c], [row.a * s], [row.d]])], [0.0, 0.0, 0.0, 1.0]])


def test_the_geometry_takes_what_is_added_to_angles() -> None:
    """Of known values, with an angle added at each joint: products of matrices, and their differences as levers."""
    model = Model(Arm(CHAIN))
    geometry = SHARED.geometry((0.0,) * len(model.names), ("joint_angles",), True)
    added = np.array([1e-3, -2e-3, 3e-3])
    tip, by_geometry, levers = geometry(POSTURES, conditions(), np.zeros(0), added)

    def positions(angles: np.ndarray) -> np.ndarray:
        return np.array(
            [np.linalg.multi_dot([frame(r, x) for r, x in zip(ROWS, q, strict=True)])[:3, 3] for q in angles]
        )

    np.testing.assert_allclose(tip[..., 0], positions(POSTURES + added), atol=1e-9)
    assert by_geometry.shape[-1] == 0
    for j, step in enumerate(1e-5 * np.eye(3)):
        slope = (positions(POSTURES + added + step) - positions(POSTURES + added - step)) / 2e-5
        np.testing.assert_allclose(levers[..., j], slope, atol=1e-5)


def test_parts_are_compiled_once() -> None:
    """For equal arms, effects and places."""
    assert compiled_arm(chain_of(ROWS), None, False, ()) is compiled_arm(CHAIN, None, False, ())
    eccentric = EffectSpec("encoder_eccentricity", 1)
    assert SHARED.of(effect_of(eccentric)) is SHARED.of(effect_of(eccentric))
    known = (0.0,) * len(Model(Arm(CHAIN)).names)
    assert SHARED.geometry(known, ("joint_angles",), True) is SHARED.geometry(known, ("joint_angles",), True)
