"""A bound says what it is a bound of, and whether it is a theorem."""

from __future__ import annotations

import pytest

from doe.bounds.certificate import Bound


@pytest.mark.parametrize(
    ("bound", "scope", "proof", "words"),
    [
        (Bound(-0.25, "closed_form", rigorous=True), "all postures", "proven", "closed form, all postures, proven"),
        (Bound(-0.25, "continuous", rigorous=True), "all postures", "proven", "all postures, proven"),
        (Bound(-0.25, "continuous"), "all postures", "numerical", "all postures, numerical"),
        (Bound(-0.25, "grid", rigorous=True), "list", "proven", "the postures of the list, proven"),
        (
            Bound(-0.25, "grid", True, True, 2000),
            "list",
            "proven",
            "the list of 2,000 postures, proven, its search was cut",
        ),
    ],
)
def test_json_and_text(bound: Bound, scope: str, proof: str, words: str) -> None:
    data = bound.as_dict()
    assert (data["value"], data["source"], data["rigorous"]) == (-0.25, bound.source, bound.rigorous)
    assert (data["scope"], data["proof"]) == (scope, proof)
    assert data.get("candidates") == bound.candidates
    assert data.get("cut", False) == bound.cut
    assert str(bound).startswith(f"-0.25 ({words}")
