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
from kineverse.view import picture
from kineverse.view.pictures import join_pictures

SIZE = (480, 320)


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


def draw_fetch() -> np.ndarray:
    """Return a Fetch that has opened a fridge by the controller of an example."""
    found = run_example("19_open_a_door", "--headless", "fetch")
    return picture(found["model"], found["state"], SIZE, OPEN_FRIDGE)


SKILL_PICTURES: dict[str, Callable[[], np.ndarray]] = {
    "open_fetch": draw_fetch,
    "reach": lambda: draw_command(
        "reach fetch fetch/gripper_link --pose 0.7 0.2 0.9 0 1.57 0 --still fetch/base"
    ),
    "fit": lambda: draw_command("fit examples/poses.csv --parent cupboard --child door", 720),
    "kitchens": draw_kitchens,
    "shapes": draw_shapes,
}
