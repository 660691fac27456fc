"""The pictures in the docs: one of every scene, small, none that no page shows, and a gallery of all."""

from __future__ import annotations

import re
import runpy
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import mechanisms

from kineverse import gallery
from kineverse_studies.experiments import EXPERIMENTS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PICTURES = DOCS / "pictures"
GALLERY = DOCS / "gallery.md"
SKILLS = ("open", "close", "push", "unlock", "reach", "plan", "fit", "calibrate", "validate", "view", "live")
OF_STUDIES = ("push_fridge.png", "push_vectors.png")  # which `kineverse reproduce table1-push` draws

PICTURE = r"!\[([^\]]+)\]\(pictures/([\w.-]+)\)"


def shown_in(*pages: Path) -> list[str]:
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    return sorted(name for _, name in re.findall(PICTURE, text))


def gallery_cells() -> list[tuple[str, str]]:
    """Return the picture and the text below it of each cell of the gallery."""
    lines = GALLERY.read_text(encoding="utf-8").splitlines()
    return [
        (picture, text)
        for above, below in pairwise(lines)
        if above.startswith("| ![")
        for picture, text in zip(above.split("|")[1:-1], below.split("|")[1:-1], strict=True)
        if picture.strip()
    ]


def test_every_scene_has_a_picture_in_the_docs():
    stills = [f"{name}.png" for name in sorted(gallery.names())]
    assert shown_in(DOCS / "articulations.md", DOCS / "mechanisms.md") == stills


def test_every_picture_is_shown():
    assert set(shown_in(*DOCS.glob("*.md"))) == {path.name for path in PICTURES.iterdir()}


def test_every_picture_is_drawn_by_a_command():
    tool = runpy.run_path(str(ROOT / "tools" / "pictures"), run_name="pictures")
    assert {*tool["list_pictures"](), *OF_STUDIES} == {path.name for path in PICTURES.iterdir()}


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


def wanted_in_gallery() -> list[str]:
    scripts = [path for path in (ROOT / "examples").rglob("*.py") if "living_kitchen" not in path.parts]
    return [
        *(f"(../{path.relative_to(ROOT).as_posix()})" for path in scripts),
        "(../examples/living_kitchen)",
        *(f": `{name}`" for name in gallery.names()),
        *(f"`kineverse {skill}" for skill in SKILLS),
    ]


def test_the_gallery_names_every_experiment():
    page = " ".join(GALLERY.read_text(encoding="utf-8").split())
    assert [name for name in EXPERIMENTS if f"`kineverse reproduce {name}`" not in page] == []


@pytest.mark.parametrize("entry", sorted(wanted_in_gallery()))
def test_the_gallery_has_a_picture_of(entry):
    cells = [picture for picture, text in gallery_cells() if entry in text]
    assert cells, f"docs/gallery.md has no cell for {entry}; CONTRIBUTING.md says how pictures are drawn"
    for picture in cells:
        alt, name = re.findall(PICTURE, picture)[0]
        assert len(alt.split()) > 2
        assert (PICTURES / name).is_file()


def test_pictures_are_small_together_and_clips_move():
    files = sorted(PICTURES.iterdir())
    assert sum(path.stat().st_size for path in files) < 7_000_000
    for path in files:
        with Image.open(path) as image:
            if path.suffix == ".png":
                assert image.width <= 1440
                continue
            assert path.stat().st_size <= (1_500_000 if path.stem == "open_close" else 300_000), path.name
            first = np.asarray(image.convert("RGB"), dtype=int)
            image.seek(image.n_frames // 2)
            assert np.abs(np.asarray(image.convert("RGB"), dtype=int) - first).max() > 30, path.name
            assert image.info["loop"] == 0
