"""The pictures in the docs: one of every scene, small, and none that no page shows."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest
from scenes import mechanisms

from kineverse import gallery

DOCS = Path(__file__).parents[2] / "docs"
PICTURES = DOCS / "pictures"


def shown_in(*pages: Path) -> list[str]:
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    return sorted(re.findall(r"!\[[^\]]+\]\(pictures/(\w+)\.png\)", text))


def test_every_scene_has_a_picture_in_the_docs():
    assert shown_in(DOCS / "articulations.md", DOCS / "mechanisms.md") == sorted(gallery.names())


def test_every_picture_is_shown_once():
    assert shown_in(*DOCS.glob("*.md")) == sorted(path.stem for path in PICTURES.iterdir())


@pytest.mark.parametrize("name", gallery.names())
def test_a_picture_is_small(name):
    data = (PICTURES / f"{name}.png").read_bytes()
    width, _, _, kind = struct.unpack(">IIBB", data[16:26])
    assert width <= 480
    assert kind == 3  # with a palette
    assert len(data) < 25_000


def test_mechanisms_are_shown_where_their_equations_are():
    """In the column under a name are its picture and, below that, its equations."""
    page = (DOCS / "mechanisms.md").read_text(encoding="utf-8")
    for build in mechanisms.SCENES:
        (row,) = (line for line in page.splitlines() if f"(pictures/{build.__name__}.png)" in line)
        column = [f"/{build.__name__}.png" in cell for cell in row.split("|")].index(True)
        assert len(page[page.index(row) :].splitlines()[1].split("|")[column].strip()) > 5
