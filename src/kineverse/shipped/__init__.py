"""Models that ship with the package."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""Folder of the descriptions, one ``.urdf`` each."""
