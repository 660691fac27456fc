"""What a model stands on and in on the page: light, background, floor."""

from __future__ import annotations

from typing import Any

import numpy as np

BELOW, ABOVE = (240, 243, 246), (196, 207, 219)
"""The background, from the lower to the upper edge."""


def set_up(server: Any) -> None:
    """Light the page: a lamp with a shadow from above the left shoulder, and a sky without one.

    viser's own lights wash out white furniture; these are those of :mod:`kineverse.view.light`. There is no
    picture of surroundings to light the scene by, because a computer without a graphics card takes many
    seconds to prepare one.
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
    gradient = np.array(ABOVE) + (np.array(BELOW) - np.array(ABOVE)) * rows
    scene.set_background_image(np.repeat(gradient, 8, axis=1).astype(np.uint8), format="png")


def set_lamp(server: Any, azimuth: float) -> None:
    """Put the lamp a little to the side of a camera that looks from a direction around z [rad]."""
    angle = azimuth + 0.6
    server.scene.add_light_directional(
        "/light/key",
        color=(255, 247, 236),
        intensity=2.3,
        cast_shadow=True,
        position=(4.0 * np.cos(angle), 4.0 * np.sin(angle), 6.0),
    )


def set_floor(server: Any, height: float, extent: float, shown: bool) -> None:
    """Put a floor with lines 1 m apart at a height under a scene of an extent [m]; it takes shadows."""
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
