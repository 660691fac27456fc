"""The ``kineverse`` command."""

from __future__ import annotations

from kineverse.cli.main import main

__all__ = ["main"]
