"""How often a law is tried: as often as `make test` has time for, or 28 times as often with --hypothesis-profile=thorough."""

from __future__ import annotations

from hypothesis import settings

USUAL = 100
is_long = False
"""True with --long, which is known before tests are imported."""


def attempts(count: int, *, long: int = 0) -> int:
    """Return how many examples a test takes that usually takes so many, and with --long at least ``long``."""
    return (max(count, long) if is_long else count) * settings.default.max_examples // USUAL
