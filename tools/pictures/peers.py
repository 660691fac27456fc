"""Pictures of the published examples of pink and mink, solved with Kineverse: their controllers run."""

from __future__ import annotations

import runpy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.view import picture
from kineverse.view.drawables import TRACE, Drawable, build_spheres, collect_drawables, draw_ghosts
from kineverse.view.poses import FramePoses, complete
from kineverse.view.rendering.auto_camera import find_extreme_points
from kineverse.view.rendering.camera import fit_camera

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SIZE = (480, 320)


@dataclass(frozen=True)
class Peer:
    """Three times of a motion [s], of which the second is drawn in full, and the camera's direction [rad]."""

    times: tuple[float, float, float]
    azimuth: float = 0.7
    elevation: float = 0.3


PEERS = {
    "from_pink/arm_ur3_velocity_smoothing": Peer((0.0, 0.8, 2.4), azimuth=0.9),
    "from_pink/arm_ur5": Peer((0.0, 0.8, 2.4), azimuth=0.9),
    "from_pink/flying_dual_arm_ur3": Peer((0.0, 0.8, 2.4), azimuth=1.2),
    "from_pink/go2_squat": Peer((1.0, 3.0, 5.0), azimuth=1.0, elevation=0.25),
    "from_pink/humanoid_g1_com": Peer((0.0, 0.75, 1.5), azimuth=0.6, elevation=0.15),
    "from_mink/arm_hand_xarm": Peer((0.8, 2.4, 3.9), azimuth=0.9),
    "from_mink/arm_panda_dof_freezing": Peer((0.0, 1.25, 2.5), azimuth=0.6),
    "from_mink/arm_ur5_wrist_cam_lookat": Peer((0.8, 2.4, 3.9), azimuth=1.0),
    "from_mink/biped_cassie": Peer((0.0, 0.8, 2.4), azimuth=0.7, elevation=0.15),
    "from_mink/humanoid_g1_teleop": Peer((0.0, 2.5, 3.1), azimuth=0.7, elevation=0.25),
    "from_mink/mobile_tiago": Peer((0.0, 2.0, 4.0), azimuth=-0.9),
}


def follow(found: dict[str, Any], peer: Peer) -> list[kv.State]:
    """Run the controller of an example, and return the states at its times."""
    model, controller, time, state = (found[name] for name in ("model", "controller", "time", "start"))
    states: list[kv.State] = []
    for now in np.arange(0.0, peer.times[-1] + controller.dt, controller.dt):
        if len(states) < len(peer.times) and now >= peer.times[len(states)] - 1e-9:
            states.append(state)
        controller.set(time, float(now))
        state = model.integrate(state, controller.step(state).speeds, controller.dt)
    return states


def draw_peer(name: str) -> np.ndarray:
    """Return an example at a time of its motion, and as ghosts at two others."""
    peer = PEERS[name]
    found = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    model, states = found["model"], follow(found, peer)
    parts, poses = collect_drawables(model), FramePoses(model)
    points = []
    for state in states:
        placed = dict(zip(poses.names, poses.evaluate(complete(model, state)), strict=True))
        points += [
            find_extreme_points(part.surface.vertices) @ placed[part.frame][:3, :3].T
            + placed[part.frame][:3, 3]
            for part in parts
        ]
    eye = fit_camera(
        np.concatenate(points), peer.azimuth, peer.elevation, SIZE[0] / SIZE[1], 0.5, margin=0.04
    )
    bodies = [body for body in model.bodies if model.fk(body).symbols]
    return picture(model, states[1], SIZE, eye, overlay=draw_ghosts(model, bodies, [states[0], states[2]]))


def draw_targets() -> np.ndarray:
    """Return a UR10 at some of the poses that its inverse kinematics has reached."""
    found = runpy.run_path(str(EXAMPLES / "from_pink/inverse_kinematics_ur10.py"), run_name="__main__")
    model = found["model"]
    solved = [result.best for result in found["found"] if result.solved][:6]
    bodies = [name for name in model.bodies if model.fk(name).symbols]
    hands = np.array([found["hand"]({s: state[s] for s in found["hand"].symbols})[:3, 3] for state in solved])
    marks = Drawable("world", build_spheres(hands, np.full(len(hands), 0.03)), TRACE, "visual")
    ghosts = draw_ghosts(model, bodies, solved[1:])
    return picture(model, solved[0], SIZE, overlay=[*ghosts, marks])
