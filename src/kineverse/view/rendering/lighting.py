"""Light, shadow, floor and background of pictures and of the page."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from .camera import unit_direction
from .rasterizer import Projection, rasterize
from .triangle_mesh import Floats, Integers, Singles, dot_rows

SHADOW_PIXELS = 1024

LAMP_SHADOW = True  # the lamp of the page casts a shadow: half of the time if software draws it

KEY_LIGHT = np.array([1.0, 0.965, 0.91]) * 1.6
SKY_LIGHT = np.array([0.86, 0.92, 1.0]) * 0.80
GROUND_LIGHT = np.array([0.84, 0.80, 0.75]) * 0.50

WHITE_LEVEL = 1.75  # the radiance that is displayed as pure white

PICTURE_BACKGROUND = (np.array([0.93, 0.945, 0.96]), np.array([0.70, 0.745, 0.80]))
"""Display colours of the background of pictures, at the lower and the upper edge, in [0, 1]."""

PAGE_BACKGROUND = ((240, 243, 246), (196, 207, 219))
"""Colours of the background of the page, at the lower and the upper edge, in [0, 255]."""


@dataclass(frozen=True, slots=True)
class DirectionalLight:
    """Infinitely distant lamp with a shadow map: a depth picture from the direction of the lamp."""

    toward: Floats  # (3,) unit vector to the lamp, in the world
    projection: Projection
    depth: npt.NDArray[np.float32]
    bias: float

    @staticmethod
    def from_direction(
        corners: Floats, azimuth: float, elevation: float, around: Floats | None = None
    ) -> DirectionalLight:
        """Return the lamp in a direction [rad] above (T, 3, 3) triangles [m].

        The shadow map covers the points ``around`` (N, 3) [m], so that those of one film are alike; None for
        the triangles alone.
        """
        toward = unit_direction(azimuth, elevation)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axes = np.array([right, np.cross(toward, right), -toward])
        points = corners.reshape(-1, 3) if around is None else around
        low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
        spread = max(float((high - low)[:2].max()), 1e-3)
        focal = 0.98 * SHADOW_PIXELS / spread
        origin = ((low + high) / 2) @ axes
        projection = Projection(origin, axes, SHADOW_PIXELS, SHADOW_PIXELS, focal, parallel=True)
        _, depth = rasterize(projection, corners)
        return DirectionalLight(toward, projection, depth, bias=2.5 * spread / SHADOW_PIXELS)

    def lit_fraction(self, points: Singles, normals: Singles, pixel: Integers) -> Singles:
        """Return the (N,) fraction of the lamp that is visible from points, in [0, 1].

        Each pixel samples slightly different places of the shadow map, so that the pixels that are averaged
        into one of the final picture make a soft border.
        """
        steep = np.clip(1.0 - normals @ self.toward.astype(np.float32), 0.0, 1.0)
        offset = (np.float32(self.bias) * (np.float32(0.5) + np.float32(2.0) * steep))[:, None]
        xy, near = self.projection.to_pixels(self.projection.to_camera(points + normals * offset))
        lit = np.zeros(len(points), dtype=np.float32)
        for dx, dy in _shadow_samples():
            x = (xy[:, 0] + dx[pixel % _SHADOW_SAMPLES]).astype(np.int32)
            y = (xy[:, 1] + dy[pixel % _SHADOW_SAMPLES]).astype(np.int32)
            # The outermost pixels of the map are empty by construction: points outside are lit like them.
            index = np.clip(y, 0, SHADOW_PIXELS - 1) * SHADOW_PIXELS + np.clip(x, 0, SHADOW_PIXELS - 1)
            lit += self.depth[index] <= near
        return np.asarray(lit / np.float32(3.0))


_SHADOW_SAMPLES = 61  # number of sampling patterns: prime, so that no line of pixels repeats them in step


@lru_cache(maxsize=1)
def _shadow_samples() -> list[tuple[Singles, Singles]]:
    """Return sampling patterns of three rings around a pixel of the shadow map, rotated by golden angles."""
    angle = 2.399963 * np.arange(_SHADOW_SAMPLES)
    return [
        ((ring * np.cos(angle + turn)).astype(np.float32), (ring * np.sin(angle + turn)).astype(np.float32))
        for ring, turn in ((0.7, 0.0), (1.9, 2.1), (2.9, 4.2))
    ]


def shade(colors: Singles, normals: Singles, lamp: DirectionalLight, lit: Singles) -> Singles:
    """Return the light (N, 3) reflected by matt surfaces, linear.

    Notes
    -----
    Lambert's law for the lamp; between sky and ground by the height of the normal (a hemisphere light).
    """
    facing = np.clip(normals @ lamp.toward.astype(np.float32), 0.0, None) * lit
    up = np.float32(0.5) + np.float32(0.5) * normals[:, 2]
    light = np.empty_like(colors)
    for k in range(3):
        key, sky, ground = np.float32(KEY_LIGHT[k]), np.float32(SKY_LIGHT[k]), np.float32(GROUND_LIGHT[k])
        light[:, k] = colors[:, k] * (facing * key + (ground + (sky - ground) * up))
    return light


def to_linear(srgb: Floats) -> Floats:
    """Convert display values in [0, 1] to linear light."""
    return np.asarray(np.clip(srgb, 0.0, 1.0) ** 2.2)


def to_display(light: Singles) -> Singles:
    """Convert linear light to display values in [0, 1], with a soft shoulder that keeps white shaded."""
    curved = light * (1.0 + light / WHITE_LEVEL**2) / (1.0 + light)
    return np.asarray(_GAMMA[np.clip(curved * 4095.0, 0.0, 4095.0).astype(np.int16)])


_GAMMA = ((np.arange(4096) / 4095.0) ** (1 / 2.2)).astype(np.float32)

OUTLINE, CREASE = 0.42, 0.25  # darkening of the border of a part, and of a sharp edge inside of it
CREASE_COSINE = 0.75  # cosine of the smallest angle at which an edge is drawn

DEPTH_STEP = 0.02  # smallest step of depth that is outlined, as a fraction of the distance


def compute_outlines(
    group: Integers, normals: Singles, near: Singles, covered: Integers, projection: Projection
) -> Singles:
    """Return (N,) factors that darken the outlines of parts and their sharp edges."""
    size = projection.width * projection.height
    part = np.full(size, -1, dtype=np.int32)
    part[covered] = group
    limit = np.float32(DEPTH_STEP)
    facing = np.zeros((size, 3), dtype=np.float32)
    facing[covered] = normals
    darker = np.zeros(size, dtype=np.float32)
    for step in (1, projection.width):
        # The last pixel of a row is compared with the first of the next: an invisible speck at the rim.
        other = part[:-step] != part[step:]
        with np.errstate(invalid="ignore"):  # The nearness of the background is infinitely small.
            gap = np.abs(near[:-step] - near[step:])
            other |= gap > limit * np.maximum(near[:-step], near[step:])
        crease = ~other & (dot_rows(facing[:-step], facing[step:]) < CREASE_COSINE) & (part[:-step] >= 0)
        np.maximum(darker[:-step], np.float32(OUTLINE) * other, out=darker[:-step])
        np.maximum(darker[:-step], np.float32(CREASE) * crease, out=darker[:-step])
    return np.asarray(np.float32(1.0) - darker[covered])


def draw_background(projection: Projection) -> Singles:
    """Return display values (height·width, 3) of the background of a picture."""
    rows = np.linspace(1.0, 0.0, projection.height)[:, None]
    below, above = PICTURE_BACKGROUND
    column = (below + (above - below) * rows**1.5).astype(np.float32)
    return np.repeat(column, projection.width, axis=0)


def draw_ground(
    image: Singles, empty: Integers, points: Floats, projection: Projection, lamp: DirectionalLight
) -> None:
    """Draw the floor under the points (N, 3) of a scene: its shadow, and a grid that fades at a distance."""
    low, high = points.min(axis=0), points.max(axis=0)
    drop = np.float32(low[2] - projection.origin[2])
    rays = projection.pixel_rays(empty)
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
    depth = np.sqrt(dot_rows(floor, floor))
    floor += projection.origin.astype(np.float32)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=np.float32), floor.shape)
    lit = lamp.lit_fraction(floor, up, pixel)
    cell = np.float32(1.0 if radius > 0.8 else 0.1)
    u, v = (np.abs((floor[:, k] / cell + np.float32(0.5)) % 1.0 - np.float32(0.5)) for k in (0, 1))
    line = np.clip(1.5 - np.minimum(u, v) * cell * np.float32(projection.focal) / depth, 0.0, 1.0)
    tone = (1.0 - 0.30 * (1.0 - lit) * fade) * (1.0 - 0.09 * line * fade) * (1.0 + 0.02 * fade)
    image[pixel] = np.clip(image[pixel] * tone.astype(np.float32)[:, None], 0.0, 1.0)


def set_up(server: Any) -> None:
    """Light the page: a lamp with a shadow from above the left shoulder, and a sky without one.

    viser's own lights wash out white furniture; these are the lights of the pictures. There is no environment
    map, because a computer without a graphics card takes many seconds to prepare one.
    """
    scene = server.scene
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(226, 236, 255), ground_color=(206, 196, 184), intensity=2.1
    )
    scene.add_light_directional(
        "/light/fill", color=(235, 240, 255), intensity=0.35, position=(-4.0, -3.0, 5.0)
    )
    rows = np.linspace(0.0, 1.0, 128)[:, None, None] ** 0.7
    below, above = map(np.array, PAGE_BACKGROUND)
    gradient = above + (below - above) * rows
    scene.set_background_image(np.repeat(gradient, 8, axis=1).astype(np.uint8), format="png")


def set_lamp(server: Any, azimuth: float) -> None:
    """Place the lamp a little to the side of a camera that looks from a direction around z [rad]."""
    angle = azimuth + 0.6
    server.scene.add_light_directional(
        "/light/key",
        color=(255, 247, 236),
        intensity=2.3,
        cast_shadow=LAMP_SHADOW,
        position=(4.0 * np.cos(angle), 4.0 * np.sin(angle), 6.0),
    )


def set_floor(server: Any, height: float, extent: float, shown: bool) -> None:
    """Place a floor with lines 1 m apart at a height under a scene of an extent [m]; it receives shadows."""
    server.scene.add_grid(
        "/floor",
        infinite_grid=True,
        cell_size=0.25,
        cell_thickness=0.5,
        cell_color=(214, 220, 227),
        section_size=1.0,
        section_thickness=0.8,
        section_color=(187, 195, 205),
        fade_distance=max(6.0 * extent, 6.0),
        fade_strength=2.5,
        shadow_opacity=0.2,
        position=(0.0, 0.0, height),
        visible=shown,
    )
