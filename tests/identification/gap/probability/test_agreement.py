"""What is named agrees with what is said to be likely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.outside.unmodelled import Unknown
from identification.gap.probability.agreement import agreeing, overruled
from identification.gap.probability.probabilities import Probabilities
from identification.gap.workflow import Findings, Workflow
from identification.measurements import Measurements

ARM = Arm(np.array([400.0, 300.0, 200.0]), sigma=0.1)


def findings(error: Callable[[np.ndarray], np.ndarray]) -> Findings:
    """Of an arm whose joint 2 has an error [rad] by its angle."""
    generator = np.random.default_rng(31)
    q = generator.uniform(-2.5, 2.5, (40, 3))
    moved = q + np.outer(error(q[:, 1]), [0.0, 1.0, 0.0])
    z = np.exp(1j * np.cumsum(moved, axis=1)) @ ARM.lengths
    z += 0.1 * (generator.standard_normal(40) + 1j * generator.standard_normal(40))
    rows = Rows.of(Measurements(q, np.column_stack([z.real, z.imag])))
    return Workflow(hypotheses(ARM, frozenset(), rows), 399, generator).findings(rows)


@pytest.fixture(scope="module")
def eccentric() -> Findings:
    """An eccentric encoder 2, found."""
    found = findings(lambda q: 2e-3 * np.cos(q))
    assert [h.key for h in found.unknown.chosen] == ["encoder_eccentricity:2"]
    return found


def likely(none: float, named: float, outside: float) -> Probabilities:
    return Probabilities(none, {("encoder_eccentricity:2",): named}, outside)


def test_a_likely_name_stays(eccentric: Findings) -> None:
    for said in (likely(0.0, 1.0, 0.0), likely(0.7, 0.3, 0.0), likely(0.0, 0.3, 0.7)):
        assert agreeing(eccentric, said) is eccentric
        assert overruled(eccentric, said) == []


def test_a_name_that_nothing_at_all_beats_is_taken_back_and_the_test_is_told(eccentric: Findings) -> None:
    said = likely(0.95, 0.05, 0.0)
    found = agreeing(eccentric, said)
    assert found.selection.chosen == found.unknown.chosen == ()
    assert found.unknown.bic == found.search.bic(())
    (note,) = overruled(found, said)
    assert note.startswith("encoder_eccentricity:2: p = 0.0")
    assert note.endswith("yet nothing missing is likelier (probability 0.95)")


def test_an_effect_without_which_the_others_are_likelier_is_taken_back(eccentric: Findings) -> None:
    """By odds of 20 to 1; of three as many as these odds say."""
    members = {h.label: h for h in eccentric.search.hypotheses.members}
    three = tuple(members[label] for label in ("encoder_eccentricity:2", "gear_ratio:1", "backlash:3"))
    both = replace(eccentric, unknown=replace(eccentric.unknown, chosen=three[:2]))

    def said(one: float, two: float, all_three: float = 0.0) -> Probabilities:
        keys = [tuple(sorted(h.key for h in three[:count])) for count in (1, 2, 3)]
        rest = {("axes_skew",): 1.0 - one - two - all_three}
        return Probabilities(0.0, rest | dict(zip(keys, (one, two, all_three), strict=True)), 0.0)

    assert agreeing(both, said(0.9, 0.046)) is both
    assert agreeing(both, said(0.0, 0.0)) is both
    found = agreeing(both, said(0.9, 0.044))
    assert [h.key for h in found.unknown.chosen] == ["encoder_eccentricity:2"]
    assert found.selection.chosen == found.selection.path[-1] == found.unknown.chosen
    assert found.selection.path[:-1] == both.selection.path
    assert found.selection.rivals[0] == (found.unknown.chosen, 0.0)
    assert found.unknown.bic == found.search.bic(found.unknown.chosen)
    every = replace(eccentric, unknown=replace(eccentric.unknown, chosen=three))
    assert [h.key for h in agreeing(every, said(0.9, 0.04, 0.0019)).unknown.chosen] == ["encoder_eccentricity:2"]
    assert len(agreeing(every, said(0.8, 0.1, 0.004)).unknown.chosen) == 2


def test_a_name_that_something_outside_the_library_beats_gives_way_to_its_place(eccentric: Findings) -> None:
    """A bump of joint 2, which is taken for an eccentric encoder."""
    bump = findings(lambda q: 4e-3 * np.exp(-(((q - 0.4) / 0.5) ** 2)))
    (name,) = (h for h in bump.search.hypotheses.members if h.key == "encoder_eccentricity:2")
    wrong = Unknown(1.0, None, None, (name.free,), bump.search.bic((name.free,)))
    found = agreeing(replace(bump, unknown=wrong), likely(0.0, 0.02, 0.98))
    assert found.unknown.place == "joint:2"
    assert found.unknown.bic < wrong.bic
    assert agreeing(found, likely(0.0, 0.02, 0.98)) is found  # a place stays as it is
