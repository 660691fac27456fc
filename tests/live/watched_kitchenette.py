"""A small kitchenette whose markers a simulated camera sees: a cupboard with a door, and a shelf."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.articulations import Fixed, Floating
from kineverse.lie import retract
from kineverse.live.model_estimator import ModelEstimator
from kineverse.model.body import Pose

CUPBOARD, DOOR, SHELF, BOX, HANDLE = "room/cupboard", "room/door", "room/shelf", "room/box", "room/handle"
HINGE, RAIL = "joint room/door", "joint room/box"
RATE = 15.0  # of the camera [Hz]
NOISE = np.repeat([0.003, 0.006], 3)  # of its poses [m], [rad]


def make_truth(door: str = "revolute", aside: float = 0.0) -> kv.Model:
    """Return the model of what is there: the door turns or slides, mounted aside [m]; the box slides."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Fixed(name="room/place", parent="world", child=CUPBOARD, origin=_place(1.0, 0.4, 0.8)))
        edit.apply(Fixed(name="room/wall", parent="world", child=SHELF, origin=_place(1.0, -0.5, 0.6)))
        ends = {"parent": CUPBOARD, "child": DOOR, "lower": 0, "upper": 1.5}
        origin = _place(-0.2, 0.3 + aside, 0.0)
        if door == "revolute":
            edit.apply(kv.Revolute(name=DOOR, origin=origin, axis=(0, 0, -1), **ends))
        else:
            edit.apply(kv.Prismatic(name=DOOR, origin=origin, axis=(-1, 0, 0), **ends))
        rail = {"parent": SHELF, "child": BOX, "lower": 0, "upper": 0.5}
        edit.apply(kv.Prismatic(name=BOX, origin=_place(-0.1, 0.0, 0.0), axis=(-1, 0, 0), **rail))
        edit.add_frame(HANDLE, DOOR, kv.translation(-0.05, -0.5, 0))
    return model


def make_served(attached: str) -> kv.Model:
    """Return the model without the joint of the door, which is attached in some other way."""
    model, origin = make_truth(), _place(-0.2, 0.3, 0.0)
    with model.edit() as edit:
        if attached == "joint":
            edit.replace(HINGE, Fixed(name=DOOR, parent=CUPBOARD, child=DOOR, origin=origin))
        elif attached == "floating":
            edit.replace(HINGE, Floating(name=DOOR, parent=CUPBOARD, child=DOOR, origin=origin))
        else:
            edit.remove(f"frame {HANDLE}")
            edit.remove(HINGE)
            edit.add_frame(DOOR, CUPBOARD, origin)
            edit.add_frame(HANDLE, DOOR, kv.translation(-0.05, -0.5, 0))
    return model


def _place(x: float, y: float, z: float) -> Pose:
    return Pose.from_matrix(kv.translation(x, y, z)())


class Camera:
    """Camera that sees the markers of a truth with noise, and some outliers."""

    def __init__(self, truth: kv.Model, outliers: float = 0.05, seed: int = 0) -> None:
        self.frames = [CUPBOARD, DOOR, SHELF, BOX]
        self._fk = [kv.compile(truth.fk(frame)) for frame in self.frames]
        self._random, self._outliers = np.random.default_rng(seed), outliers
        self.time, self.moved, self.hidden = 100.0, {}, set()

    def look(self, door: float = 0.0, box: float = 0.0) -> dict[str, np.ndarray]:
        """Return the poses of the next picture, at values of the joints [rad], [m]."""
        self.time += 1.0 / RATE
        values, poses = {DOOR: door, BOX: box}, {}
        for frame, fk in zip(self.frames, self._fk, strict=True):
            pose = self.moved.get(frame, np.eye(4)) @ fk({s: values[str(s)] for s in fk.inputs})
            pose = retract(pose, NOISE * self._random.standard_normal(6))
            if self._random.random() < self._outliers:
                pose = retract(pose, self._random.uniform(-1.0, 1.0, 6))
            if frame not in self.hidden:
                poses[frame] = pose
        return poses


class Watch:
    """Estimator that owns its model: what is due is written at once."""

    def __init__(self, truth: kv.Model, served: kv.Model, **options: object) -> None:
        self.camera, self.model = Camera(truth), served
        self.estimator = ModelEstimator(served, **options)
        self.written = []

    def look(self, seconds: float, door=lambda t: 0.0, box=lambda t: 0.0, write: bool = True) -> None:
        """Watch for a time [s], in which the joints are at functions of the time."""
        for k in range(round(seconds * RATE)):
            poses = self.camera.look(door(k / RATE), box(k / RATE))
            self.estimator.add(poses, self.camera.time)
            if k % 3 == 2:
                self.estimator.think()
                if write:
                    self.write()

    def write(self) -> None:
        """Write what is due."""
        for proposal in self.estimator.find_due():
            with self.model.edit() as edit:
                assert proposal.write(edit, self.model)
            self.estimator.confirm(proposal)
            self.written.append((self.camera.time, proposal))

    @property
    def note(self):
        """What is thought now."""
        return self.estimator.note()
