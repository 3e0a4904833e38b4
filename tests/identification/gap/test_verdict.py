"""The verdict follows from the probabilities, whatever they are."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.verdict import CREDIBLE, MOST, RIVAL, Probabilities


def drawn(rng: np.random.Generator) -> Probabilities:
    """Random probabilities of up to 30 explanations, of any sharpness."""
    count = int(rng.integers(0, 12))
    shares = rng.dirichlet(np.full(count + 3, 10.0 ** rng.uniform(-2.0, 1.0)))
    names = [
        tuple(sorted(f"effect:{j}" for j in rng.choice(9, rng.integers(1, 4), replace=False))) for _ in range(count)
    ]
    sets: dict[tuple[str, ...], float] = {}
    for name, p in zip(names, shares[3:], strict=True):
        sets[name] = sets.get(name, 0.0) + float(p)
    places = {"joint:1": float(shares[1]), "time": float(shares[2])}
    return Probabilities(float(shares[0]), sets, places, {}, float(shares[1] + shares[2]))


def test_verdict_and_probabilities_never_contradict_each_other() -> None:
    rng, seen = np.random.default_rng(1), set()
    for _ in range(5000):
        found = drawn(rng)
        library = sum(found.sets.values())
        totals = {"none": found.none, "unknown": found.outside, "library": library}
        verdict = found.verdict
        seen.add(verdict)
        said = {"named": "library", "ambiguous": "library"}.get(verdict, verdict)
        assert totals[said] >= max(totals.values()) - 1e-9  # wrong least often
        if said == "library":
            best = found.of(found.best)
            assert (verdict == "named") == (best >= 0.5)
            assert best == max(found.sets.values())
            rivals = found.rivals
            assert rivals[0] == found.best
            assert verdict == "named" or len(rivals) >= 2 or len(found.sets) == 1
            assert all(found.of(names) >= best / RIVAL for names in rivals[2:])
            assert len(rivals) <= MOST
        else:
            assert found.rivals == []
        if verdict == "unknown":
            assert found.places[found.place or ""] == max(found.places.values())
        shares = list(found.credible.values())
        assert shares == sorted(shares, reverse=True)
        assert sum(shares) + 0.5 * max(shares) >= min(CREDIBLE, 1.0 - 1e-9)
    assert seen == {"none", "named", "ambiguous", "unknown"}


@pytest.mark.parametrize("p", [1e-3, 1e-9, 0.0])
def test_where_the_noise_cannot_be_all_nothing_missing_is_not_said(p: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(500):
        found = drawn(rng)
        guarded = found.not_none(p)
        assert guarded.none == pytest.approx(p * found.none)
        assert guarded.none + guarded.outside + sum(guarded.sets.values()) == pytest.approx(1.0)
        assert guarded.verdict != "none" or found.none == 0.0
