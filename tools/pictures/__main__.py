"""Draw the pictures of the docs: the gallery, proximity, and the demo. With names, some of them."""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import living
import lockbox
import near
import numpy as np
from configurations import TAKES, Take, values
from PIL import Image

import kineverse as kv
from kineverse import gallery
from kineverse.view import picture
from kineverse.view.camera import Camera, fit_camera
from kineverse.view.drawables import collect_drawables
from kineverse.view.poses import FramePoses, complete
from kineverse.view.rasterizer import TriangleSoup

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
WIDTH, GAP = 480, 4
LARGEST = 24_000
OTHERS = {
    "near": near.draw_proximity,
    "living": living.draw_living_kitchen,
    "lockbox": lockbox.draw_thesis_box,
}


def main() -> int:
    """Draw what was asked for; return how many scenes nobody says how to draw."""
    parser = argparse.ArgumentParser(prog="python tools/pictures", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="scenes (all)")
    missing = 0
    for name in parser.parse_args().names or (*gallery.names(), *OTHERS):
        if name in OTHERS:
            write(name, OTHERS[name]())
            continue
        if name not in TAKES:
            missing += 1
            sys.stderr.write(f"configurations.py does not say how '{name}' is drawn\n")
            continue
        write(name, draw_gallery_scene(name, TAKES[name]))
    return missing


def write(name: str, pixels: np.ndarray) -> None:
    """Write a picture to the folder of pictures, and say how large it is."""
    data = encoded(pixels)
    (FOLDER / f"{name}.png").write_bytes(data)
    sys.stdout.write(f"{name}.png: {len(data)} bytes\n")


def draw_gallery_scene(name: str, take: Take) -> np.ndarray:
    """Return the panels of a scene side by side, or all in one."""
    model = kv.Model()
    if take.together:
        state = {}
        for k, part in enumerate(take.states):
            model.include(f"articulations/{name}", prefix=f"{k}")
            state |= values(f"{k}", part)
            if k:  # One floor is enough.
                with model.edit() as edit:
                    edit.remove(f"frame {k}/floor")
        states = [complete(model, state)]
    else:
        model.include(f"articulations/{name}")
        states = [complete(model, values(name, state)) for state in take.states]
    count = len(states)
    alone = WIDTH if take.together else WIDTH // 2
    size = ((WIDTH - GAP * (count - 1)) // count if count > 1 else alone, take.height)
    for state in states:
        violated = model.violations(kv.State(state))
        if violated:
            raise ValueError(f"{name} at {state}: {violated}")
    eye = camera(model, states, take, size[0] / size[1])
    panels = [picture(model, state, size, eye) for state in states]
    gap = np.full((take.height, GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)


def camera(model: kv.Model, states: list[dict[str, float]], take: Take, aspect: float) -> Camera:
    """Return a camera that has the scene in all its states in the picture."""
    poses, items = FramePoses(model), collect_drawables(model)
    corners = [
        TriangleSoup.from_drawables(
            items, dict(zip(poses.names, poses.evaluate(state), strict=True))
        ).corners.reshape(-1, 3)
        for state in states
    ]
    return fit_camera(np.concatenate(corners), take.azimuth, take.elevation, aspect, 0.4, margin=0.04)


def encoded(pixels: np.ndarray) -> bytes:
    """Return a PNG with a palette, with as many colours as fit."""
    image = Image.fromarray(pixels)
    for colors in (256, 192, 128, 96, 64):
        file = io.BytesIO()
        # A mark has few pixels; refined by k-means, its colour is kept.
        image.quantize(colors, kmeans=4, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
        if file.tell() <= LARGEST:
            break
    return file.getvalue()


if __name__ == "__main__":
    sys.exit(main())
