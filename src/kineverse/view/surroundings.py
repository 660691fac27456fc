"""What makes a picture readable beside light: outlines around parts, and a floor to stand on."""

from __future__ import annotations

import numpy as np

from kineverse.view.light import Lamp
from kineverse.view.raster import Projection
from kineverse.view.triangles import Floats, Integers, Singles, dot

OUTLINE, CREASE = 0.42, 0.25
"""How much darker the border of a part, and a sharp edge inside of it, is drawn."""

SHARP = 0.75
"""Cosine of the angle from which on an edge is drawn."""


STEP = 0.02
"""How far, as a part of the distance, a surface has to lie behind another to be set off by a line."""


def outlines(
    group: Integers, normals: Singles, near: Singles, covered: Integers, projection: Projection
) -> Singles:
    """Return (N,) factors that darken the outlines of parts and their sharp edges.

    Parameters
    ----------
    group
        (N,) what is seen at each covered pixel: shapes of one frame and colour are one thing.
    normals
        (N, 3) the normal there.
    near
        (height·width,) the nearness of all pixels.
    covered
        (N,) the pixels, as y·width + x.
    projection
        The grid of pixels.
    """
    size = projection.width * projection.height
    part = np.full(size, -1, dtype=np.int32)
    part[covered] = group
    limit = np.float32(STEP)
    facing = np.zeros((size, 3), dtype=np.float32)
    facing[covered] = normals
    darker = np.zeros(size, dtype=np.float32)
    for step in (1, projection.width):
        # The last pixel of a row is compared with the first of the next: a speck at the rim nobody sees.
        other = part[:-step] != part[step:]
        with np.errstate(invalid="ignore"):  # Where nothing is seen, the nearness is infinitely small.
            gap = np.abs(near[:-step] - near[step:])
            other |= gap > limit * np.maximum(near[:-step], near[step:])
        crease = ~other & (dot(facing[:-step], facing[step:]) < SHARP) & (part[:-step] >= 0)
        np.maximum(darker[:-step], np.float32(OUTLINE) * other, out=darker[:-step])
        np.maximum(darker[:-step], np.float32(CREASE) * crease, out=darker[:-step])
    return np.asarray(np.float32(1.0) - darker[covered])


def draw_ground(image: Singles, empty: Integers, corners: Floats, projection: Projection, lamp: Lamp) -> None:
    """Draw the floor under a scene: its shadow, and a grid that fades into the background.

    Parameters
    ----------
    image
        (height·width, 3) display values, changed in place.
    empty
        The pixels where nothing of the scene is seen.
    corners
        (T, 3, 3) triangles of the scene [m]; the floor lies under the lowest of them.
    projection, lamp
        Camera and light. The lines of the grid are 1 m apart, 0.1 m under things smaller than that.
    """
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    drop = np.float32(low[2] - projection.origin[2])
    rays = projection.rays(empty)
    down = np.flatnonzero(rays[:, 2] < -1e-6)
    if drop >= 0 or not len(down):
        return
    rays, pixel = rays[down], empty[down]
    floor = rays * (drop / rays[:, 2])[:, None]
    radius = 0.5 * float(np.linalg.norm((high - low)[:2])) + 0.3
    middle = ((low + high) / 2 - projection.origin).astype(np.float32)
    away = np.hypot(floor[:, 0] - middle[0], floor[:, 1] - middle[1]) / np.float32(radius)
    near = np.flatnonzero(away < 1.9)
    floor, pixel = floor[near], pixel[near]
    fade = np.clip(np.float32(1.9) - away[near], 0.0, 1.0)
    fade *= fade * (np.float32(3.0) - np.float32(2.0) * fade)
    depth = np.sqrt(dot(floor, floor))
    floor += projection.origin.astype(np.float32)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=np.float32), floor.shape)
    lit = lamp.reaches(floor, up, pixel)
    cell = np.float32(1.0 if radius > 0.8 else 0.1)
    u, v = (np.abs((floor[:, k] / cell + np.float32(0.5)) % 1.0 - np.float32(0.5)) for k in (0, 1))
    line = np.clip(1.5 - np.minimum(u, v) * cell * np.float32(projection.focal) / depth, 0.0, 1.0)
    tone = (1.0 - 0.30 * (1.0 - lit) * fade) * (1.0 - 0.09 * line * fade) * (1.0 + 0.02 * fade)
    image[pixel] = np.clip(image[pixel] * tone.astype(np.float32)[:, None], 0.0, 1.0)
