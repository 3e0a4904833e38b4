"""The verdict follows from the probabilities, whatever they are."""

from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind.study import contradictions
from identification import EffectSpec
from identification.document import Section, Sheet
from identification.documents.diagnosis import diagnosis_document, missing_parts
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.result import Candidate, Diagnosis, Probabilities
from identification.gap.search import CREDIBLE, MOST
from tests.identification.gap.test_diagnose import diagnosed


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
    return Probabilities({(): float(shares[0]), **sets, None: float(shares[1] + shares[2])}, places)


def test_verdict_and_probabilities_never_contradict_each_other() -> None:
    rng, seen = np.random.default_rng(1), set()
    for _ in range(1000):
        found = drawn(rng)
        totals = {"none": found.of(()), "unknown": found.of(None), "library": sum(found.sets.values())}
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
            assert all(found.of(names) >= best * LEVEL for names in rivals[2:])
            assert len(rivals) <= MOST
        else:
            assert found.rivals == []
        if verdict == "unknown":
            assert found.places[found.place or ""] == max(found.places.values())
            assert replace(found, explanations={None: 2.1 * max(found.places.values())}).place is None
        p = float(rng.choice([1e-3, 1e-9, 0.0]))  # that noise leaves so much
        guarded = found.not_none(p)
        assert (guarded.of(()), sum(guarded.explanations.values())) == pytest.approx((p * found.of(()), 1.0))
        assert guarded.verdict != "none"
        shares = list(found.credible.values())
        assert shares == sorted(shares, reverse=True)
        assert sum(shares) + 0.5 * max(shares) >= min(CREDIBLE, 1.0 - 1e-9)
    assert seen == {"none", "named", "ambiguous", "unknown"}


def diagnosis_with(found: Diagnosis, likely: Probabilities) -> Diagnosis:
    """A diagnosis with other probabilities, and the candidates that follow from them."""

    def candidate(names: tuple[str, ...]) -> Candidate:
        specs = tuple(EffectSpec(key.partition(":")[0], int(key.partition(":")[2])) for key in names)
        p = likely.of(names) if likely.verdict != "unknown" else None
        return replace(found.named, effects=names, specs=specs, probability=p, parameters=())

    candidates = tuple(candidate(names) for names in likely.rivals)
    named = candidates[0] if candidates else candidate(())
    return replace(found, probabilities=likely, candidates=candidates, named=named, predicting=named, curves=())


def test_nothing_that_a_diagnosis_says_contradicts_its_probabilities() -> None:
    """The JSON keys by the rules of the blind study; the sentences by the words of the verdicts."""
    rng, plain = np.random.default_rng(3), diagnosed(None)
    opening = {"none": "Nothing", "named": "Missing", "ambiguous": "", "unknown": "Something outside"}
    for _ in range(1000):
        likely = drawn(rng)
        likely = likely.not_none(1e-6) if rng.random() < 0.2 else likely
        found = diagnosis_with(plain, likely)
        said = found.to_json()
        assert contradictions(said) == []
        told = said["sentence"].removeprefix("Not confirmed on held-out rows. ")
        assert told.startswith(opening[found.verdict])
        assert set(said["credible_set"]) <= {"none", "unknown", *(" + ".join(n) for n in likely.sets)}
        shown = [c for c in found.candidates if c.probability is not None]
        assert all(said["probabilities"][c.title] == c.probability for c in shown)
        if found.verdict == "ambiguous":
            count = len(found.candidates)
            assert count >= 2 or "below one half" in told
            assert count == 1 or f"{count} likeliest explanations" in told
        if found.verdict == "unknown":  # a fit without what is unknown gives them no honest intervals
            assert not any(isinstance(part, Sheet) for part in missing_parts(said))
        line = next(part for part in missing_parts(said) if str(part).startswith("Probability"))
        for title, p in found.probability.items():
            assert p < 0.005 or f"{title} {p:.2f}" in str(line)


def test_corrected_values_of_several_explanations_are_those_that_are_written() -> None:
    """Of one that is named, its own; where two explain the data, of the model that predicts: the geometry here."""
    clear, plain = diagnosed("backlash"), diagnosed(None)
    rival = replace(clear.named, effects=("encoder_eccentricity:2",), probability=0.4)
    several = Probabilities({clear.named.effects: 0.45, rival.effects: 0.4, (): 0.1, None: 0.05}, {})
    for sets, likely in (((clear.named,), clear.probabilities), ((clear.named, rival), several)):
        found = replace(clear, probabilities=likely, candidates=sets, predicting=plain.named, curves=())
        sections = [part for part in diagnosis_document(found).parts if isinstance(part, Section)]
        table = next(section for section in sections if section.title == "Corrected values").parts[0]
        assert isinstance(table, Sheet)
        assert found.verdict == ("named" if len(sets) == 1 else "ambiguous")
        assert any("backlash" in row[0] for row in table.rows) == (len(sets) == 1)
