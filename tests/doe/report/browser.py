"""A browser that opens pages as a reader does: Debian's Chromium, driven by Playwright; skipped where there is none."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
QUIET = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run", "--disable-sync")
QUIET += ("--disable-background-networking", "--disable-component-update")


@contextmanager
def browser() -> Iterator[Any]:
    """A headless browser without network, which draws without a graphics card."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright to drive a browser with")
    if path() is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    with playwright.sync_playwright() as started:
        try:
            opened = started.chromium.launch(executable_path=path(), args=QUIET)
        except playwright.Error as error:
            pytest.skip(f"{path()} does not start: {str(error).splitlines()[0]}")
        yield opened
        opened.close()


def path() -> str | None:
    """Of the browser that is installed."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Watched:
    """A page whose messages, errors and requests are kept."""

    def __init__(self, opened: Any, address: str, first: str = "", **context: Any) -> None:
        """first : a script that runs before those of the page"""
        self.said: list[str] = []
        self.requests: list[str] = []
        self.context = opened.new_context(offline=True, **context)
        self.page = self.context.new_page()
        self.page.add_init_script(first)
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)

    def close(self, address: str) -> None:
        """Nothing was said, and nothing but the file itself was asked for (a saved plan is a blob of the page)."""
        self.context.close()
        assert self.said == []
        assert [url for url in self.requests if not url.startswith("blob:")] == [address]

    def facts(self) -> dict[str, str]:
        """The figures beside the plan."""
        texts = self.page.locator(".plan dl > *").all_inner_texts()
        return dict(zip(texts[::2], texts[1::2], strict=True))
