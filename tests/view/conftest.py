"""The browser that tests of pages share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from browsers import launched
from small_models import cabinet

from kineverse.view import view


@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Any]:
    """A real Chromium."""
    with launched(chromium) as browser:
        yield browser


@pytest.fixture
def page() -> Iterator[Any]:
    with view(cabinet(), port=0) as viewer:
        yield viewer
