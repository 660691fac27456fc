"""How often a law is tried: as often as `make test` has time for, or 22 times as often with --hypothesis-profile=thorough."""

from __future__ import annotations

from hypothesis import settings

USUAL = 100


def attempts(count: int) -> int:
    """Return how many examples a test takes that usually takes so many."""
    return count * settings.default.max_examples // USUAL
