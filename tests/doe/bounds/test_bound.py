"""A bound says what it is a bound of, and whether it is a theorem."""

from __future__ import annotations

from doe.bounds.bound import Bound


def test_json_and_text() -> None:
    assert Bound(-0.25, "grid").as_dict() == {"value": -0.25, "source": "grid", "rigorous": False}
    assert "numerical" in str(Bound(-0.25, "continuous"))
    assert "rigorous" in str(Bound(-0.25, "closed_form", rigorous=True))
