"""The dictionary: its effects and their weights; and columns, a user's own effects among them, against differences of
models that have the effect."""

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar
from unittest.mock import patch

import casadi as ca
import numpy as np
import pytest

from identification import Array, InputError, Measurements, Model, diagnose, load_arm, planar_chain, with_effects
from identification.arm import Arm, EffectSpec, Gravity
from identification.effects import ArmState, Effect, Parameter, Setting, base, build
from identification.gap.blocks import Block, Library, _roots, hypotheses
from identification.gap.fit import Fitted, Rows
from identification.kinematics.chain import DHRow, chain_of
from identification.kinematics.parameters import PRISMATIC


class Breathing(Effect):
    """All links grow and shrink with a period of the session: a whole-arm effect with a setting that is not whole."""

    name, summary, needs = "breathing", "links breathe", frozenset({"time"})
    settings: ClassVar = {"rate": Setting(0.1, 40.0, values=(1.5, 3.5, 7.25))}

    def define(self) -> tuple[Parameter, ...]:
        return tuple(self.parameter(short, "1", scale=self.reach) for short in "ab")

    def extensions(self, chain: ArmState, values: ca.SX, lengths: ca.SX) -> ca.SX:
        angle = self.chosen["rate"] * chain.time
        return lengths * (values[0] * ca.cos(angle) + values[1] * ca.sin(angle))


class Settling(Effect):
    """The base settles with a time constant that is estimated, which cannot be zero."""

    name, summary, needs = "settling", "base settles", frozenset({"time"})

    def define(self) -> tuple[Parameter, ...]:
        tau = self.parameter("tau", "1", scale=1.0, lower=0.05, upper=5.0)
        return (self.parameter("x", "mm", scale=1.0), tau)

    def base_translation(self, chain: ArmState, values: ca.SX) -> ca.SX:
        return ca.vertcat(values[0] * ca.exp(-(chain.time + 0.5) / values[1]), 0)


class Series(Effect):
    """A series whose number of terms is its setting, which is no place for a symbol."""

    name, summary, per_joint = "series", "a series", "required"
    settings: ClassVar = {"terms": Setting(2, 3, whole=True, symbolic=False)}

    def define(self) -> tuple[Parameter, ...]:
        return (self.parameter("a", "rad", scale=self.link_length),)

    def joint_angles(self, chain: ArmState, values: ca.SX) -> ca.SX:
        q = chain.q[self.joint_index]
        return values[0] * sum(ca.cos(k * q) for k in range(1, self.chosen["terms"] + 1))


class Lag(Effect):
    """The joint stays behind a part of its last motion: a formula of the posture before."""

    name, summary, per_joint, needs = "lag", "stays behind", "required", frozenset({"past"})

    def define(self) -> tuple[Parameter, ...]:
        return (self.parameter("c", "1", scale=self.link_length),)

    def joint_angles(self, chain: ArmState, values: ca.SX) -> ca.SX:
        j = self.joint_index
        return values[0] * (chain.previous[j] - chain.q[j])


NAMES = {"lag": Lag, "breathing": Breathing, "settling": Settling, "series": Series}
ARM = Arm(
    [300.0, 200.0, 150.0],
    gravity=Gravity([0.0, -9.81], [4.0, 3.0, 1.0], [0.5, 0.5, 0.5], 2.0),
    effects=(EffectSpec("encoder_eccentricity", 1),),
)
POSTURES = np.random.default_rng(3).uniform(-2.0, 2.0, (40, 3))
BASE = {"length_error:2": 1.0, "joint_offset:1": 0.02, "joint_offset:3": -0.01, "encoder_eccentricity:1.a": 0.003}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """The user's own effects, forgotten afterwards."""
    with patch.dict(base._LIBRARY):
        for effect in NAMES.values():
            base.register(effect)
        yield


def rows() -> Rows:
    return Rows.of(Measurements(POSTURES, np.zeros((40, 2)), temperature=np.linspace(15.0, 25.0, 40)))


def known() -> Library:
    return hypotheses(ARM, frozenset({"temperature"}), rows())


def test_columns_of_every_effect_are_derivatives_by_its_parameters() -> None:
    """At joint 3 or of the whole arm, of settings the first and the last: central differences of models with the
    effect, at the base model's values and, of a parameter that cannot be zero, at its neutral value; steps that move
    the tip by a hundredth of a mm err by 1e-9 of the column."""
    library = known()
    blocks = [*library.members, *library.unlisted]
    found = library.columns(Fitted(library.base, library.base.parameters.vector(BASE), rows()), blocks)
    of_name: dict[str, list[tuple[EffectSpec, Array]]] = {}
    for block, columns in zip(blocks, found, strict=True):
        if block.effect is not None and block.effect.joint in (None, 3):
            of_name.setdefault(block.key, []).append((block.effect.spec, columns))
    assert {"transmission_ripple:3", "joint_compliance", "joint_compliance:3", "axes_skew", "lag:3"} < set(of_name)
    for spec, columns in (each[k] for each in of_name.values() for k in {0, len(each) - 1}):
        model = Model(ARM.with_effects(*ARM.effects, spec))
        start = model.parameters.vector(BASE)
        for k, parameter in enumerate(model.effects[-1].parameters):
            step = 0.01 / parameter.scale * np.eye(len(start))[model.parameters.index(parameter.name)]
            up, down = (model.position(POSTURES, start + s * step, rows().conditions) for s in (1.0, -1.0))
            expected = (up - down) / (0.02 / parameter.scale)
            np.testing.assert_allclose(columns[:, :, k], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_every_effect_at_every_joint_with_values_of_settings_and_their_weights() -> None:
    """But those of the arm, and joints that cannot have it; together they weigh as one effect of the whole arm, or as
    one at each of three joints."""
    of: dict[str, list[Block]] = {}
    for block in known().members:
        of.setdefault(block.label.partition("[")[0].partition(":")[0], []).append(block)
    labels = [b.label for b in known().members]
    assert len(set(labels)) == len(labels)
    assert not {"encoder_eccentricity:1", "joint_coupling:1"} & set(labels)  # there is no joint before the first
    assert known().skipped["encoder_eccentricity:1"] == "already in the arm's model"
    assert {"encoder_eccentricity:2", "encoder_eccentricity:3"} < set(labels)
    assert set(NAMES) < set(of)
    assert set(known().aliases) == {"measurement_scale", "tool_offset", "base_rotation"}
    bare = hypotheses(Arm([300.0, 200.0, 150.0]), frozenset(), rows())
    assert (bare.skipped["thermal_growth"], bare.skipped["link_bending"]) == ("needs temperature", "needs gravity")
    assert "length_offset" not in bare.skipped  # nothing that these data lack: they are of another instrument
    values = {name: [dict(b.effect.spec.values) for b in blocks if b.effect] for name, blocks in of.items()}
    assert [each["rate"] for each in values["breathing"]] == [1.5, 3.5, 7.25]
    assert [each["terms"] for each in values["series"]] == [2, 3] * 3
    assert len(of["transmission_ripple"]) == 3 * (64 - 3 + 1)
    for name, weight in (("breathing", 1.0), ("base_drift", 1.0), ("transmission_ripple", 3.0)):
        assert sum(block.weight for block in of[name]) == pytest.approx(np.sqrt(weight))


def test_a_users_own_effect_is_named() -> None:
    spec, rng = EffectSpec("lag", 2, {"c": 4e-4}), np.random.default_rng(5)
    conditions = Measurements(POSTURES, np.zeros((40, 2))).conditions
    exact = Model(ARM.with_effects(spec)).position(POSTURES, conditions=conditions)
    found = diagnose(ARM.with_effects(), Measurements(POSTURES, exact + 0.02 * rng.normal(size=(40, 2))))
    assert (spec.key,) in {tuple(s.key for s in c.specs) for c in found.candidates}
    assert "LinAlgError" not in str(found)


def test_settings_in_files(tmp_path: Path) -> None:
    spec = EffectSpec("breathing", None, {"rate": 7.25})
    text = with_effects("links_mm = [300, 200]\n", [spec, EffectSpec("series", 2, {"terms": 3.0})])
    assert "rate = 7.25" in text
    assert "terms = 3\n" in text
    (tmp_path / "arm.toml").write_text(text)
    assert load_arm(tmp_path / "arm.toml").effects[0] == spec
    for value, allowed in ((50.0, "a number 0.1 to 40"), (None, "a number 0.1 to 40")):
        with pytest.raises(InputError, match=f"breathing: rate .*, allowed: {allowed}"):
            build(EffectSpec("breathing", None, {} if value is None else {"rate": value}), planar_chain(np.ones(2)))
    with pytest.raises(InputError, match=r"series:1: terms = 2.5, allowed: a whole number 2 to 3"):
        build(EffectSpec("series", 1, {"terms": 2.5}), planar_chain(np.ones(2)))


def test_a_column_of_which_nothing_is_left_has_no_share() -> None:
    """In line with another beside the base model it would move that without bounds."""
    left = np.array([1.0, 1e-7])
    root = _roots(np.outer(left, left)[None], np.ones((1, 2)), 10, [Block.of(ARM, EffectSpec("base_drift"), 1.0)])[0]
    assert np.abs(root).max() == pytest.approx(1.0)


def test_compliances_of_a_slide_and_a_joint_are_alike_in_typical_ones() -> None:
    """In mm/N and rad/(N m), with a common value and a scatter of 0.3, whatever the rows show of either."""
    chain = chain_of([DHRow(50.0, np.pi / 2, 300.0), DHRow(0.0, 0.0, 0.0, type=PRISMATIC, limits=(100.0, 500.0))])
    family = Block.of(
        Arm(chain, gravity=Gravity([0, 0, -9.8], [5, 5], [0.5, 0.5])), EffectSpec("joint_compliance"), 1.0
    )
    root = _roots(np.diag([1.0, 1e4])[None], np.array([[1.0, 1e4]]), 10, [family])[0]
    deviations = root / np.array([[p.typical] for p in family.effect.parameters])
    covariance = deviations @ deviations.T
    np.testing.assert_allclose(covariance / covariance[0, 0], [[1.0, 1 / 1.09], [1 / 1.09, 1.0]])
