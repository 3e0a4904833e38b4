"""Rounds of naming."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.selection.rounds import rounds_of
from tests.identification.gap.selection.test_search import NAMES, searched


def test_rounds_say_what_was_added_taken_back_and_left() -> None:
    search, (one, two) = searched()
    first, second, third = rounds_of(search, ((), (one,), (one,), (one, two)), search.fit((two,)), (NAMES[1],))
    assert (first.added, first.removed) == ((NAMES[0],), ())
    assert (second.added, second.removed) == ((NAMES[1],), ())
    assert (third.added, third.removed) == ((), (NAMES[0],))
    # rows without a noise model: the whitened residuals are those in mm, two coordinates each
    assert second.rms == pytest.approx(np.sqrt(search.fit((one, two)).squares / 120))
    assert str(third).startswith(f"- {NAMES[0]}: ")
    assert first.to_json() == {"added": [NAMES[0]], "removed": [], "rms_mm": first.rms}
