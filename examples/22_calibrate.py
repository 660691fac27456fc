"""Calibrate an arm and a camera by what the camera saw, and correct the numbers in the robot's URDF.

With the path of a file, the looks are written to it, as a table for ``kineverse calibrate``.
"""

import csv
import sys
import tempfile
from pathlib import Path

import numpy as np

import kineverse as kv
from kineverse import lie
from kineverse.estimation import calibrate

ARM = (
    "shoulder_pan",
    "shoulder_lift",
    "upper_arm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
JOINTS = (*(f"pr2/r_{name}_joint" for name in ARM), "pr2/head_pan_joint", "pr2/head_tilt_joint")
LOWER = [-1.5, -0.4, -2.0, -2.0, -2.0, -1.8, -2.0, -0.6, 0.1]
UPPER = [0.4, 0.8, 0.5, -0.3, 2.0, -0.2, 2.0, 0.6, 0.9]
TRUE = [0.020, -0.015, 0.010, 0.030, -0.020, 0.010, 0.005, 0, 0]  # offsets of the joints [rad]

model = kv.load("pr2")
with model.edit() as edit:
    mount = kv.translation(0.07, 0, 0.1) @ kv.rpy(-np.pi / 2, 0, -np.pi / 2)
    edit.add_frame("camera", parent="pr2/head_tilt_link", transform=mount)
gripper = "pr2/r_gripper_tool_frame"
seen = model.fk(gripper, relative_to="camera")
error = kv.translation(0.01, -0.02, 0.005) @ kv.rotation_z(0.03)  # of the mount
back = np.linalg.inv(error())

rng = np.random.default_rng(0)
looks = []
for joints in rng.uniform(LOWER, UPPER, (30, len(JOINTS))):
    true = dict(zip(JOINTS, joints + TRUE, strict=True))
    pose = back @ seen({symbol: true[str(symbol)] for symbol in seen.symbols})
    pose[:3, 3] += rng.normal(0, 0.003, 3)
    pose[:3, :3] = lie.exp_so3(rng.normal(0, np.radians(0.5), 3)) @ pose[:3, :3]
    looks.append((dict(zip(JOINTS, joints, strict=True)), {(gripper, "camera"): pose}))
looks[7][1][gripper, "camera"][0, 3] += 0.4  # a gross error

found = calibrate(model, looks, ["offsets pr2/r_[sufew]*_joint", "mount camera"])
print(found)
with tempfile.TemporaryDirectory() as folder:
    saved = found.save(Path(folder, "pr2.urdf"))
    print(*saved.remarks, sep="\n")
    before, after = (path.read_text("utf-8").splitlines() for path in (model.sources[0].path, saved.path))
    print(len(set(after) - set(before)), "lines of the URDF are new")

if len(sys.argv) > 1:
    with open(sys.argv[1], "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow([*(name.removeprefix("pr2/") for name in JOINTS), *"xyz", "qx", "qy", "qz", "qw"])
        for state, poses in looks:
            (pose,) = poses.values()
            numbers = [*state.values(), *pose[:3, 3], *lie.to_quaternion(pose[:3, :3])]
            table.writerow([f"{number:.5f}" for number in numbers])
