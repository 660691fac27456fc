"""Identify the joint between two parts from noisy poses of both, and add it to a model."""

import numpy as np

import kineverse as kv
from kineverse.estimation import identify, pose_covariance

rng = np.random.default_rng(1)
hinge = kv.translation(0.3, 0, 0.9) @ kv.rotation_z(kv.position("q")) @ kv.translation(0.6, 0, 0)


def observe(pose):
    """Return a pose with noise of 5 mm and 1° along and about each axis."""
    v = rng.normal(0, np.radians(1), 3)
    noisy = kv.axis_angle(v, np.linalg.norm(v))() @ pose
    noisy[:3, 3] = pose[:3, 3] + rng.normal(0, 0.005, 3)
    return noisy


angles = np.linspace(0.1, 1.2, 25)
walls = np.stack([observe(np.eye(4)) for _ in angles])
doors = np.stack([observe(hinge({"q": q})) for q in angles])
best = identify(walls, doors, noise=pose_covariance(0.005, np.radians(1))).best
print(best.family, f"with probability {best.probability:.2f}")
print("axis", best.parameters["axis"].round(1) + 0.0, "through", best.parameters["point"][:2].round(1) + 0.0)

model = kv.Model()
with model.edit() as edit:
    edit.add_frame("wall", parent="world", transform=kv.translation(1, 2, 0))
    edit.apply(best.operation("door", parent="wall", child="door"))
print(model.articulations["door"].kind, model.fk("door").symbols)
