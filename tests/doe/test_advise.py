"""How many runs: without joint limits every number of them has an orthogonal plan, so the answer is known."""

from __future__ import annotations

import json

import numpy as np
import pytest

from doe.advise import advise
from identification.arm import Arm
from identification.errors import InputError
from tests.doe.arms import problem

FREE = problem(Arm([260.0, 180.0, 120.0], sigma=0.1))


def test_lengths_are_known_to_sigma_over_the_root_of_the_runs() -> None:
    """M' = I (doe/README.md, "Planar theorem"): a length has the deviation 0.1 mm / sqrt(m), 7 runs for 0.04 mm."""
    found = advise(FREE, range(4, 10), target=0.04)
    assert found.runs == (4, 5, 6, 7, 8, 9)
    for design in found.designs:
        assert found.accuracy(design) == pytest.approx(0.1 / np.sqrt(len(design.plan)), rel=1e-6)
    assert found.smallest is not None
    assert len(found.smallest.plan) == 7
    assert found.efficient_runs() == found.runs
    data = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert data["smallest_runs"] == 7
    assert [row["runs"] for row in data["rows"]] == list(found.runs)


def test_a_target_out_of_reach_has_no_number() -> None:
    assert advise(FREE, [4, 5], target=1e-3).smallest is None


def test_bad_input() -> None:
    with pytest.raises(InputError, match="sigma"):
        advise(problem(Arm([260.0, 180.0, 120.0])), [4], target=0.04)
    with pytest.raises(InputError, match="runs: 2"):
        advise(FREE, [2, 3])
