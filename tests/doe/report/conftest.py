"""A browser for the tests of pages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.doe.report.browser import browser


@pytest.fixture(scope="session")
def opened() -> Iterator[Any]:
    with browser() as started:
        yield started
