"""Picture of the lockbox of the thesis, shut, on the way, and open."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.view import picture
from kineverse.view.rendering.camera import fit_camera

AZIMUTH, ELEVATION = 0.35, 0.75
SIZE = (157, 110)
CORNERS = np.array([[x, y, z] for x in (-0.1, 0.6) for y in (-0.15, 1.4) for z in (0.0, 0.05)])


def draw_thesis_box() -> np.ndarray:
    """Return the picture, (height, width, 3) bytes."""
    model = kv.load("lockboxes/thesis")
    plan = kv.reasoning.plan_unlocking(model, {"lockbox/a": 1.2})
    states = [{str(s): value for s, value in model.default_state().items()}]
    for step in plan.steps:
        states.append({**states[-1], str(step.coordinate): step.target})
    eye = fit_camera(CORNERS, AZIMUTH, ELEVATION, SIZE[0] / SIZE[1], 0.3, margin=0.02)
    panels = [picture(model, states[k], SIZE, eye) for k in (0, 3, -1)]
    gap = np.full((SIZE[1], 4, 3), 255, dtype=np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)
