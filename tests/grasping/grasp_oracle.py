"""Judge of grasps: the furniture is moved to a robot's hand, and the scene of both models measures."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse import lie
from kineverse.geometry import Scene
from kineverse.grasping import Grasp

_PLACE = [kv.position(f"furniture/{name}") for name in ("x", "y", "z", "roll", "pitch", "yaw")]


class GraspJudge:
    """Distances of the hand of a robot to furniture that is placed so that a grasp holds.

    Parameters
    ----------
    model
        Model of a robot and furniture.
    top
        The frame of the furniture on which everything else of it stands.
    """

    def __init__(self, model: kv.Model, top: str) -> None:
        self._top, self._resting = top, model
        self.model = model.copy()
        with self.model.edit() as edit:
            edit.attach(top, "world", kv.translation(*_PLACE[:3]) @ kv.rpy(*_PLACE[3:]))
        self.scene = Scene(self.model)
        self._furniture = [b for b in self.scene.bodies if self._below(b)]
        self._state = self.model.default_state()

    def place(self, grasp: Grasp, frame_T_hand: np.ndarray, gap: float | None = None) -> None:
        """Place the furniture so that the hand is at a pose, the fingers open or with a gap of the pads [m]."""
        gripper, handle = grasp.gripper, grasp.handle
        values = gripper.opened if gap is None else gripper.values_at(gap)
        state = self._state.updated(values)
        top_T_frame = self._resting.fk(handle.frame, self._top)(self._resting.default_state())
        world_T_hand = self.model.fk(gripper.hand)(state)
        world_T_top = world_T_hand @ lie.inverse(frame_T_hand) @ lie.inverse(np.asarray(top_T_frame))
        place = [*world_T_top[:3, 3], *lie.to_rpy(world_T_top[:3, :3])]
        self.scene.update(state.updated(dict(zip(_PLACE, place, strict=True))))

    def distance(self, grasp: Grasp) -> float:
        """Return the least distance of the hand and all that is fixed to it from the furniture [m]."""
        hand = [b for b in self.scene.bodies if b in grasp.gripper.bodies or self._is_rigid(b, grasp)]
        pairs = self.scene.watch(hand, self._furniture, 0.3)()
        return float(pairs.distances[0]) if len(pairs) else 0.3

    def finger_distances(self, grasp: Grasp) -> list[float]:
        """Return the distance of the bar's body from each of both fingers [m]."""
        return [
            min(self.scene.distance(body, grasp.handle.frame).distance for body in finger)
            for finger in grasp.gripper.fingers
        ]

    def _is_rigid(self, body: str, grasp: Grasp) -> bool:
        return body not in self._furniture and not self.model.speeds_of(body, grasp.gripper.hand)

    def _below(self, frame: str) -> bool:
        while frame not in (self._top, "world"):
            frame = self.model.frames[frame].parent
        return frame == self._top
