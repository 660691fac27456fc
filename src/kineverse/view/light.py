"""Light on surfaces: one lamp that casts a shadow, a bright sky, a dim ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from kineverse.view.raster import Projection, visible
from kineverse.view.triangles import Floats, Integers, Singles

SHADOW_PIXELS = 1024

KEY = np.array([1.0, 0.965, 0.91]) * 1.6
SKY = np.array([0.86, 0.92, 1.0]) * 0.80
GROUND = np.array([0.84, 0.80, 0.75]) * 0.50

WHITE = 1.75
"""The light that is shown as pure white."""


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp infinitely far away, and what it sees: its depth picture is the shadow.

    Attributes
    ----------
    toward
        (3,) unit vector to the lamp, in the world.
    """

    toward: Floats
    projection: Projection
    depth: npt.NDArray[np.float32]
    bias: float

    @staticmethod
    def over(corners: Floats, azimuth: float, elevation: float) -> Lamp:
        """Return the lamp that stands in a direction [rad] over (T, 3, 3) triangles [m]."""
        toward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axes = np.array([right, np.cross(toward, right), -toward])
        points = corners.reshape(-1, 3)
        low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
        spread = max(float((high - low)[:2].max()), 1e-3)
        focal = 0.98 * SHADOW_PIXELS / spread
        origin = ((low + high) / 2) @ axes
        projection = Projection(origin, axes, SHADOW_PIXELS, SHADOW_PIXELS, focal, parallel=True)
        _, depth = visible(projection, corners)
        return Lamp(toward, projection, depth, bias=2.5 * spread / SHADOW_PIXELS)

    def reaches(self, points: Singles, normals: Singles, pixel: Integers) -> Singles:
        """Return (N,) how much of the lamp is seen from points, in [0, 1].

        Each pixel of the picture looks at slightly different places of the shadow, so that the pixels that
        make up one of the final picture average to a soft border.
        """
        steep = np.clip(1.0 - normals @ self.toward.astype(np.float32), 0.0, 1.0)
        offset = (np.float32(self.bias) * (np.float32(0.5) + np.float32(2.0) * steep))[:, None]
        xy, near = self.projection.pixels(self.projection.local(points + normals * offset))
        lit = np.zeros(len(points), dtype=np.float32)
        for dx, dy in _scatter():
            x = (xy[:, 0] + dx[pixel % _SCATTER]).astype(np.int32)
            y = (xy[:, 1] + dy[pixel % _SCATTER]).astype(np.int32)
            # The outermost pixels of the map are empty by construction: outside is as lit as they are.
            index = np.clip(y, 0, SHADOW_PIXELS - 1) * SHADOW_PIXELS + np.clip(x, 0, SHADOW_PIXELS - 1)
            lit += self.depth[index] <= near
        return np.asarray(lit / np.float32(3.0))


_SCATTER = 61
"""Number of different scatters: prime, so that no line of pixels repeats them in step."""


@lru_cache(maxsize=1)
def _scatter() -> list[tuple[Singles, Singles]]:
    """Return three rings of places around a pixel of the shadow, by golden angles: no pattern shows."""
    angle = 2.399963 * np.arange(_SCATTER)
    return [
        ((ring * np.cos(angle + turn)).astype(np.float32), (ring * np.sin(angle + turn)).astype(np.float32))
        for ring, turn in ((0.7, 0.0), (1.9, 2.1), (2.9, 4.2))
    ]


def shade(colors: Singles, normals: Singles, lamp: Lamp, lit: Singles) -> Singles:
    """Return the light (N, 3) that comes from matt surfaces, linear.

    Parameters
    ----------
    colors
        (N, 3) reflectance, linear.
    normals
        (N, 3) unit normals toward the camera.
    lamp
        The lamp.
    lit
        (N,) how much of the lamp reaches the surface.

    Notes
    -----
    Lambert's law for the lamp; between sky and ground by the height of the normal (a hemisphere light).
    """
    facing = np.clip(normals @ lamp.toward.astype(np.float32), 0.0, None) * lit
    up = np.float32(0.5) + np.float32(0.5) * normals[:, 2]
    light = np.empty_like(colors)
    for k in range(3):
        key, sky, ground = np.float32(KEY[k]), np.float32(SKY[k]), np.float32(GROUND[k])
        light[:, k] = colors[:, k] * (facing * key + (ground + (sky - ground) * up))
    return light


def to_linear(srgb: Floats) -> Floats:
    """Return light from display values in [0, 1]."""
    return np.asarray(np.clip(srgb, 0.0, 1.0) ** 2.2)


def to_display(light: Singles) -> Singles:
    """Return display values in [0, 1], with a soft shoulder so that bright white keeps its shape."""
    curved = light * (1.0 + light / WHITE**2) / (1.0 + light)
    return np.asarray(_GAMMA[np.clip(curved * 4095.0, 0.0, 4095.0).astype(np.int16)])


_GAMMA = ((np.arange(4096) / 4095.0) ** (1 / 2.2)).astype(np.float32)
