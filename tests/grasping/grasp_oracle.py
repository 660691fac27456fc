"""Judge of grasps: the furniture is moved to a robot's hand, and the scene of both models measures."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse import lie
from kineverse.geometry import Scene
from kineverse.grasping import Grasp, Gripper

_PLACE = [kv.position(f"furniture/{name}") for name in ("x", "y", "z", "roll", "pitch", "yaw")]


class GraspJudge:
    """Distances of the hand of a robot to furniture that is placed so that a grasp holds.

    Parameters
    ----------
    model
        Model of a robot and furniture.
    top
        The frame of the furniture on which everything else of it stands.
    gripper
        The gripper.
    """

    def __init__(self, model: kv.Model, top: str, gripper: Gripper) -> None:
        self._top, self._resting, self._gripper = top, model, gripper
        self.model = model.copy()
        with self.model.edit() as edit:
            edit.attach(top, "world", kv.translation(*_PLACE[:3]) @ kv.rpy(*_PLACE[3:]))
        self.scene = Scene(self.model)
        self._state = self.model.default_state()
        furniture = [b for b in self.scene.bodies if self._is_below(b)]
        hand = [b for b in self.scene.bodies if not self.model.speeds_of(b, gripper.hand)]
        self._near = self.scene.watch({*hand, *gripper.bodies}, furniture, 0.3)

    def place(self, grasp: Grasp, frame_T_hand: np.ndarray, gap: float | None = None) -> None:
        """Place the furniture so that the hand is at a pose, the fingers open or with a gap of the pads [m]."""
        values = self._gripper.opened if gap is None else self._gripper.values_at(gap)
        state = self._state.updated(values)
        top_T_frame = self._resting.fk(grasp.handle.frame, self._top)(self._resting.default_state())
        world_T_hand = self.model.fk(self._gripper.hand)(state)
        world_T_top = world_T_hand @ lie.inverse(frame_T_hand) @ lie.inverse(np.asarray(top_T_frame))
        place = [*world_T_top[:3, 3], *lie.to_rpy(world_T_top[:3, :3])]
        self.scene.update(state.updated(dict(zip(_PLACE, place, strict=True))))

    def distance(self) -> float:
        """Return the least distance of the hand and all that is fixed to it from the furniture [m]."""
        pairs = self._near()
        return float(pairs.distances[0]) if len(pairs) else 0.3

    def finger_distances(self, frame: str) -> list[float]:
        """Return the distance of a body from each of both fingers [m]."""
        fingers = self._gripper.fingers
        return [min(self.scene.distance(body, frame).distance for body in finger) for finger in fingers]

    def _is_below(self, frame: str) -> bool:
        while frame not in (self._top, "world"):
            frame = self.model.frames[frame].parent
        return frame == self._top
