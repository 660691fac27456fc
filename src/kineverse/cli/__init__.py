"""The ``kineverse`` command."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .command_line import main as main

lazy_face(__name__)
