from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, sync_playwright

from tests.client.viewer.browser import launch


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium. Playwright keeps the event loop of the thread meanwhile, so no longer than for one file of tests."""
    with sync_playwright() as playwright:
        running = launch(playwright)
        yield running
        running.close()
