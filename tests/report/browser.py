"""A headless Chromium for tests of report pages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    """The browser that the machine has, driven by Playwright."""
    api = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    with api.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


def opened(browser: object, path: Path, width: int = 1280, **options: object) -> tuple[object, list[str]]:
    """A tab that shows a file, and the list to which its errors and console messages are added."""
    context = browser.new_context(viewport={"width": width, "height": 900}, **options)  # type: ignore[attr-defined]
    tab, said = context.new_page(), []
    tab.on("console", lambda message: said.append(message.text))
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: said.extend([request.url] * (not request.url.startswith("file:"))))
    tab.goto(path.as_uri())
    return tab, said


def draw_all(tab: object) -> None:
    """Scroll through the page, so that every chart is drawn."""
    tab.evaluate(  # type: ignore[attr-defined]
        """async () => {
            for (let y = 0; y < document.documentElement.scrollHeight; y += 500) {
                scrollTo(0, y);
                await new Promise(done => requestAnimationFrame(() => setTimeout(done, 30)));
            }
            scrollTo(0, 0);
        }"""
    )
