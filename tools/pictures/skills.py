"""Pictures of skills: what commands draw, generated kitchens, and collision shapes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from example_pictures import OPEN_FRIDGE, run_example
from PIL import Image

import kineverse as kv
from kineverse.cli.command_line import main
from kineverse.manipulation.pushing.push_skill import push
from kineverse.manipulation.session import Session
from kineverse.view import picture
from kineverse.view.clips import ClipMoment, draw_clip
from kineverse.view.pictures import join_pictures
from kineverse.worlds import KinematicWorld

SIZE = (480, 320)
COUNT, REST = 24, 8  # of the pictures of a clip, and of its last one
BEFORE = 50  # steps of the controller that are shown before a pushed door moves


def run_command(words: str) -> None:
    """Run a command of ``kineverse`` without its output to the terminal, and raise if it fails."""
    status = main(words.split())
    if status:
        raise RuntimeError(f"kineverse {words}: status {status}")


def draw_command(words: str, width: int = SIZE[0]) -> np.ndarray:
    """Return the picture that a command writes with ``--picture``, at a width [pixels]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drawn.png")
        run_command(f"{words} --picture {path}")
        image = Image.open(path).convert("RGB")
    return np.asarray(
        image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    )


def draw_kitchens() -> np.ndarray:
    """Return generated kitchens, with something open."""
    panels = []
    for seed in (17, 4, 11):
        model = kv.load(f"kitchens/{seed}")
        first, last = model.degrees_of_freedom[0], model.degrees_of_freedom[-1]
        panels.append(picture(model, {s: 0.7 * model.limits(s)[1] for s in (first, last)}, (240, 200)))
    return join_pictures([panels])


def draw_shapes() -> np.ndarray:
    """Return a robot, and the shapes to which its distances are computed."""
    model = kv.load("fetch")
    return join_pictures([[picture(model, None, (238, 260), collisions=c) for c in (False, True)]])


def draw_fetch() -> list[np.ndarray]:
    """Return a clip of a Fetch that opens a fridge by the controller of an example."""
    found = run_example("19_open_a_door", "--headless", "fetch")
    model, controller, door = (found[name] for name in ("model", "controller", "door"))
    states = [found["found"].best]
    while states[-1][door] < found["state"][door]:
        states.append(model.integrate(states[-1], controller.step(states[-1]).speeds, controller.dt))
    return draw_run(model, states)


def draw_push() -> list[np.ndarray]:
    """Return a clip of an HSR that pushes the door of a fridge shut, from a little before it moves."""
    model = kv.load("hsr")
    model.include("kitchen", prefix="kitchen")
    door, opened = model.symbol("kitchen/fridge_door"), 1.2
    world, states = KinematicWorld(model, "hsr"), []
    place = {"hsr/base/x": -0.7, "hsr/base/y": -0.9, "hsr/arm_lift_joint": 0.4}
    world.reset(model.default_state().updated(place | {door: opened}))
    outcome = push(Session(world, on_step=lambda _: states.append(world.state)), door)
    if not outcome.done:
        raise RuntimeError(outcome.reason)
    start = next(number for number, state in enumerate(states) if state[door] < opened - 0.01)
    return draw_run(model, states[max(start - BEFORE, 0) :])


def draw_run(model: kv.Model, states: list[kv.State]) -> list[np.ndarray]:
    """Return the pictures of a motion at the open fridge, with a rest at its end."""
    chosen = [states[k] for k in np.linspace(0, len(states) - 1, COUNT).astype(int)]
    pictures = list(draw_clip(model, [ClipMoment(state) for state in chosen], SIZE, OPEN_FRIDGE))
    return pictures + [pictures[-1]] * REST


SKILL_PICTURES: dict[str, Callable[[], np.ndarray]] = {
    "reach": lambda: draw_command(
        "reach fetch fetch/gripper_link --pose 0.7 0.2 0.9 0 1.57 0 --still fetch/base"
    ),
    "kitchens": draw_kitchens,
    "shapes": draw_shapes,
}
