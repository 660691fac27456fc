"""A real Chromium, and what it shows of a page."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from kineverse.view.rendering import lighting

PATIENCE = 60_000
"""Longest wait for anything on the page [ms]: software rendering on a busy machine is slow."""

_ARGUMENTS = ("--no-sandbox", "--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def launched(chromium: str, *arguments: str) -> Iterator[Any]:
    """Start a browser with further arguments, and end it.

    Pages are drawn without shadows meanwhile, for which software takes as long as for all the rest.
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="driving a browser needs playwright")
    with playwright.sync_playwright() as driver, pytest.MonkeyPatch.context() as patch:
        patch.setattr(lighting, "LAMP_SHADOW", False)
        browser = driver.chromium.launch(
            executable_path=chromium, args=[*_ARGUMENTS, *arguments], timeout=PATIENCE
        )
        yield browser
        browser.close()


def until(page: Any, condition: Callable[[], object]) -> None:
    """Wait for a condition on what is seen, frame by frame of the browser."""
    for _ in range(1000):
        if condition():
            return
        page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    pytest.fail(f"waited in vain for the page:\n{page.evaluate('() => document.body.textContent')[-3000:]}")


def shot(page: Any, width: int, height: int) -> np.ndarray:
    """Return the left of a page as a picture (height, width, 3), where nothing but the scene is drawn."""
    imaging = pytest.importorskip("PIL.Image")
    data = page.screenshot(clip={"x": 0, "y": 0, "width": width, "height": height})
    return np.asarray(imaging.open(io.BytesIO(data)).convert("RGB")).astype(int)
