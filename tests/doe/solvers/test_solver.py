"""The budget of a search."""

from __future__ import annotations

from time import perf_counter

import pytest

from doe.solvers.solver import Budget


def test_without_a_deadline_there_is_all_the_time() -> None:
    assert Budget(3).remaining == float("inf")
    assert not Budget(3).out_of_time
    assert Budget(3, perf_counter() - 1.0).out_of_time
    assert 9.0 < Budget(3, perf_counter() + 10.0).remaining <= 10.0


def test_what_is_used_up_is_the_time_where_it_ends_the_search_first() -> None:
    now = perf_counter()
    assert Budget(10).used(3) == 3
    assert Budget(10, now + 1000.0, began=now - 1000.0).used(3) == pytest.approx(5.0, abs=0.1)  # half of the time
    assert Budget(10, now + 1000.0, began=now - 1000.0).used(8) == 8
    assert Budget(10, now - 1.0, began=now - 2.0).used(8) == 10


def test_a_part_of_the_budget_is_one_of_what_is_left() -> None:
    assert Budget(3).part(0.5).deadline is None
    assert 4.0 < Budget(3, perf_counter() + 10.0).part(0.5).remaining <= 5.0
    assert Budget(3, perf_counter() - 1.0).part(0.5).ended()
