"""Clips of the mechanisms of the gallery whose point is how they move."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from configurations import TAKES, values
from scene_cameras import fit_scene_camera

import kineverse as kv
from kineverse.view.clips import ClipMoment, draw_clip
from kineverse.view.poses import complete

SIZE = (480, 300)


@dataclass(frozen=True)
class Film:
    """Motion of a scene that ends where it begins.

    ``keys`` are values by name below the scene's own, reached one after the other, each with what it does not
    name as before. A ``steady`` motion does not rest at them. ``count`` is the number of pictures.
    """

    keys: tuple[dict[str, float], ...]
    count: int = 24
    steady: bool = False

    def states(self) -> Iterator[dict[str, float]]:
        """Yield the values of each picture."""
        held: dict[str, float] = {}
        keys = [held := held | key for key in self.keys]
        parts = len(keys) - 1
        for number in range(self.count):
            part, share = divmod(number * parts / self.count, 1.0)
            weight = share if self.steady else share * share * (3.0 - 2.0 * share)
            before, after = keys[int(part)], keys[int(part) + 1]
            yield {name: (1 - weight) * before.get(name, 0.0) + weight * after[name] for name in after}


def there_and_back(name: str, low: float, high: float, count: int = 24) -> Film:
    """Return the motion of one coordinate from one value to another and back."""
    return Film(({name: low}, {name: high}, {name: low}), count)


def turn(name: str, count: int = 24) -> Film:
    """Return a full turn of a crank."""
    return Film(({name: 0.0}, {name: 2 * math.pi}), count, steady=True)


FILMS = {
    "screw": there_and_back("bolt", 0.0, 22.0),
    "rack_and_pinion": there_and_back("pinion", -1.8, 1.8),
    "cam": turn("cam"),
    "garage_door": Film(
        (
            {"garage/door": 0.0, "garage/bolt": 0.0},
            {"garage/bolt": 0.5},
            {"garage/door": 1.45},
            {"garage/door": 0.0},
            {"garage/bolt": 0.0},
        ),
        36,
    ),
    "folding_door": there_and_back("door", 0.0, 1.84, 30),
    "door_with_handle": Film(
        (
            {"room/door": 0.0, "room/handle": 0.0},
            {"room/handle": 0.8},
            {"room/door": 1.1},
            {"room/handle": 0.0},
            {"room/door": 0.0},
        ),
        36,
    ),
    "microwave": Film(
        (
            {"oven/door": 0.0, "oven/button": 0.0},
            {"oven/button": 0.006},
            {"oven/door": 1.5},
            {"oven/button": 0.0},
            {"oven/door": 0.0},
        ),
        36,
    ),
    "piston": turn("engine"),
    "pedal_bin": there_and_back("bin", 0.0, 0.17),
    "scissor_lift": there_and_back("lift", 0.15, 1.1),
    "desk_lamp": Film(
        (
            {"lamp/lower": -0.3, "lamp/upper": -0.2},
            {"lamp/lower": 0.3, "lamp/upper": 0.4},
            {"lamp/lower": 0.6, "lamp/upper": -0.4},
            {"lamp/lower": -0.3, "lamp/upper": -0.2},
        ),
        33,
    ),
    "ratchet": Film(
        (
            {"winch/wheel": 0.0, "winch/pawl": 0.0},
            {"winch/wheel": 1.6},
            {"winch/pawl": 0.4},
            {"winch/wheel": 0.0},
            {"winch/pawl": 0.0},
        ),
        36,
    ),
    "four_bar": turn("crank"),
    "slider_crank": turn("crank"),
    "spatial_four_bar": turn("drive"),
    "parallel_gripper": there_and_back("left_inner", 0.15, 1.1),
    "delta_robot": Film(
        (
            {"motor_0": 0.2, "motor_1": 0.2, "motor_2": 0.2},
            {"motor_0": 0.7, "motor_1": 0.0, "motor_2": 0.2},
            {"motor_0": 0.2, "motor_1": 0.7, "motor_2": 0.0},
            {"motor_0": 0.0, "motor_1": 0.2, "motor_2": 0.7},
            {"motor_0": 0.2, "motor_1": 0.2, "motor_2": 0.2},
        ),
        36,
    ),
    "jansen_leg": turn("crank", 36),
}
"""Motions by name of the scene; the camera is that of its still."""


def draw_film(name: str) -> list[np.ndarray]:
    """Return the pictures of the clip of a scene."""
    film, take = FILMS[name], TAKES[name]
    model = kv.Model()
    model.include(f"articulations/{name}")
    states = [complete(model, values(name, state)) for state in film.states()]
    for state in states:
        violated = model.violations(kv.State(state))
        if violated:
            raise ValueError(f"{name} at {state}: {violated}")
    eye = fit_scene_camera(model, states, take.azimuth, take.elevation, SIZE[0] / SIZE[1])
    return list(draw_clip(model, [ClipMoment(state) for state in states], SIZE, eye))
