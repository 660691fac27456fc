"""Files of pictures and clips, as small as they have to be."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from configurations import TAKES
from PIL import Image

from kineverse.view.clips import RATE, encode_clip

LARGEST_SCENE, LARGEST = 24_000, 120_000  # [bytes]
LARGEST_CLIP, LARGEST_TOUR = 300_000, 1_500_000
QUALITIES = (75, 60, 45, 30)  # of clips; the first that is small enough is taken


def encode_small_picture(name: str, pixels: np.ndarray) -> bytes:
    """Return a PNG with a palette, with as many colours as fit."""
    image = Image.fromarray(pixels)
    largest = LARGEST_SCENE if Path(name).stem in TAKES else LARGEST
    for colors in (256, 192, 128, 96, 64):
        file = io.BytesIO()
        # A mark has few pixels; refined by k-means, its colour is kept.
        image.quantize(colors, kmeans=4, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
        if file.tell() <= largest:
            break
    return file.getvalue()


def encode_small_clip(name: str, pictures: list[np.ndarray]) -> bytes:
    """Return a clip of as high a quality as fits."""
    largest = LARGEST_TOUR if name == "open_close.webp" else LARGEST_CLIP
    for quality in QUALITIES:
        data = encode_clip(pictures, ".webp", RATE, quality=quality, method=4, minimize_size=True)
        if len(data) <= largest:
            break
    return data
