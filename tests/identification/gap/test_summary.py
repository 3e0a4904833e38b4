"""A diagnosis in words: what is short, and what does not contradict the tables below it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from identification.gap.result import Diagnosis
from identification.gap.summary import among, headline, of_joints


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ([2], "joint 2"),
        ([1, 2], "joints 1 and 2"),
        ([1, 3], "joints 1 and 3"),
        ([1, 2, 3], "joints 1 to 3"),
        ([1, 2, 4], "joints 1, 2 and 4"),
    ],
)
def test_joints(joints: list[int], words: str) -> None:
    assert of_joints(joints) == words


@pytest.mark.parametrize(
    ("joints", "others", "words"),
    [
        ((1, 2, 3), (), "error curves of joints 1 to 3 describe the errors"),
        ((1,), ("backlash:2",), "error curves of joint 1 + backlash:2 describe the errors"),
    ],
)
def test_curves_describe_what_has_no_name(joints: tuple[int, ...], others: tuple[str, ...], words: str) -> None:
    curves = [SimpleNamespace(joint=j, shape=f"waves of joint {j}") for j in joints]
    given = {"verdict": "unknown", "where": "joint:1", "shape": "waves of joint 1", "candidates": ()}
    found = cast(Diagnosis, SimpleNamespace(effects=others, curves=curves, confirmed=False, offered=None, **given))
    assert headline(found) == f"not confirmed: cause unknown (joint 1 first): no effect in the library fits; {words}"


def test_a_probability_says_what_it_is_among() -> None:
    def said(effects: tuple[str, ...], shapes: tuple[str, ...], *confirmed: bool | None) -> str:
        tests = [SimpleNamespace(confirmed=one) for one in confirmed]
        return among(cast(Diagnosis, SimpleNamespace(effects=effects, shapes=shapes, curves=(), tests=tests)))

    assert said(("ripple",), (), True) == said(("ripple",), (), None, True) == said((), (), None) == ""
    assert said(("ripple",), ("k",), True) == " (among the library's shapes, whatever makes them)"
    assert said(("ripple",), (), None, None) == " (too few rows to confirm it on others)"
