"""Draw the workspace of a robot's gripper from above and from the side (extra ``figures``).

``python examples/18_reach.py fetch`` draws that of another robot. The picture is reach.png.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import kineverse as kv

GRIPPERS = {"pr2": "pr2/r_gripper_tool_frame", "fetch": "fetch/gripper_link", "hsr": "hsr/hand_palm_link"}
robot = next((name for name in sys.argv[1:] if name in GRIPPERS), "pr2")
model = kv.load(robot)
position = model.fk(GRIPPERS[robot], f"{robot}/base_link")[:3, 3]
joints = position.symbols
low, high = np.array([model.limits(joint) for joint in joints]).T
low, high = np.maximum(low, -np.pi), np.minimum(high, np.pi)  # continuous joints have no limits
states = np.random.default_rng(0).uniform(low, high, (200_000, len(joints)))
x, y, z = kv.compile(position, joints).batch(states).T

canvas = Figure(figsize=(11, 5), layout="constrained")
for axes, (a, b), names in zip(canvas.subplots(1, 2), ((x, y), (x, z)), ("xy", "xz"), strict=True):
    density = axes.hexbin(a, b, gridsize=80, bins="log", mincnt=1)
    axes.plot(0, 0, "r+", markersize=12)  # the base
    axes.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", aspect="equal")
    canvas.colorbar(density, ax=axes, label="samples")
canvas.suptitle(f"{GRIPPERS[robot]} at {len(states)} random states within the joint limits")
canvas.savefig("reach.png", dpi=120)
print(f"{GRIPPERS[robot]} reaches {np.hypot(x, y).max():.2f} m far, {z.min():.2f} to {z.max():.2f} m high")
