"""A model with mistakes: a cupboard whose door and drawer are wrong is checked, and mended as it is told.

Each joint is moved over its range. Findings are certainly wrong; suspects are worth a look.
"""

from dataclasses import replace

import numpy as np

import kineverse as kv
from kineverse.model.body import Body, Box, Pose, Shape


def board(size: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Shape:
    """Return a box with its middle at a point."""
    pose = np.eye(4)
    pose[:3, 3] = at
    return Shape(Box(size), Pose.from_matrix(pose))


carcass = Body(
    collisions=(
        board((0.5, 0.02, 0.8), (0.25, 0.0, 0.4)),
        board((0.5, 0.02, 0.8), (0.25, 0.6, 0.4)),
        board((0.5, 0.6, 0.02), (0.25, 0.3, 0.0)),
        board((0.5, 0.6, 0.02), (0.25, 0.3, 0.4)),
        board((0.5, 0.6, 0.02), (0.25, 0.3, 0.8)),
        board((0.02, 0.6, 0.8), (0.5, 0.3, 0.4)),
    )
)
door = Body(collisions=(board((0.02, 0.6, 0.36), (-0.012, -0.3, 0.0)),))
drawer = Body(collisions=(board((0.4, 0.54, 0.34)),))

# The angle of the door is in degrees, and the drawer moves inwards.
hinge = kv.Revolute(
    name="door",
    parent="cupboard",
    child="door",
    origin=kv.translation(0.0, 0.6, 0.2),
    axis=(0, 0, -1),
    lower=0.0,
    upper=90.0,
)
slide = kv.Prismatic(
    name="drawer",
    parent="cupboard",
    child="drawer",
    origin=kv.translation(0.22, 0.3, 0.6),
    axis=(1, 0, 0),
    lower=0.0,
    upper=0.35,
)

model = kv.Model()
with model.edit() as edit:
    edit.add_frame("cupboard", "world", body=carcass)
    edit.apply(hinge, tag="hinge")
    edit.apply(kv.model.basic_operations.SetBody("door", door))
    edit.apply(slide, tag="slide")
    edit.apply(kv.model.basic_operations.SetBody("drawer", drawer))

report = kv.geometry.check_motion(model)
for one in report.coordinates:
    for entry in (*one.findings, *one.suspects):
        print(f"{one.name}: {entry.kind}: {entry.text}. {entry.advice}")
assert [entry.kind for entry in report["door"].findings] == ["degrees_for_radians"]
assert [entry.kind for entry in report["drawer"].suspects] == ["flipped_axis"]

with model.edit() as edit:
    edit.replace("hinge", replace(hinge, upper=np.deg2rad(90.0)))
    edit.replace("slide", replace(slide, axis=(-1, 0, 0)))

report = kv.geometry.check_motion(model)
assert report.ok
assert not report.suspects
print("mended: nothing is wrong")
