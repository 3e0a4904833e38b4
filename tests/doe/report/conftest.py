"""A browser that opens pages as a reader does: Debian's Chromium, driven by Playwright; skipped where there is none."""

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
QUIET = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run", "--disable-sync")
QUIET += ("--disable-background-networking", "--disable-component-update")
# in software, pages are drawn faster without OpenGL; a canvas keeps it
QUIET += ("--disable-gpu-compositing",)


@pytest.fixture(scope="session")
def opened() -> Iterator[Any]:
    """A headless browser without network, which draws without a graphics card, with one context."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright to drive a browser with")
    if (path := next(filter(None, map(shutil.which, NAMES)), None)) is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    with playwright.sync_playwright() as started:
        try:
            launched = started.chromium.launch(executable_path=path, args=QUIET)
        except playwright.Error as error:
            pytest.skip(f"{path} does not start: {str(error).splitlines()[0]}")
        launched.new_context(offline=True)
        yield launched
        launched.close()


class Watched:
    """A small page whose messages, errors and requests are kept; in a context of its own if that is another."""

    def __init__(self, opened: Any, address: str, first: str = "", **context: Any) -> None:
        """first : a script that runs before those of the page"""
        self.said: list[str] = []
        self.requests: list[str] = []
        self.context = opened.new_context(offline=True, **context) if context else opened.contexts[0]
        self.page = self.context.new_page()
        self.page.set_viewport_size({"width": 400, "height": 600})  # pixels that software draws
        self.page.add_init_script(first)
        driver = "GL Driver Message"  # of what draws in software, which the page cannot help
        self.page.on("console", lambda message: driver in message.text or self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)

    def close(self, address: str) -> None:
        """Nothing was said, and nothing but the file itself was asked for (a saved plan is a blob of the page)."""
        self.page.close()
        assert self.said == []
        assert [url for url in self.requests if not url.startswith("blob:")] == [address]

    def facts(self) -> dict[str, str]:
        """The figures beside the plan."""
        texts = self.page.locator(".plan dl > *").all_inner_texts()
        return dict(zip(texts[::2], texts[1::2], strict=True))
