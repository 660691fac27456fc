"""Models that come with the package, written for it."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""Where the descriptions lie, one ``.urdf`` each."""
