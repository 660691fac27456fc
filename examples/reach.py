"""Where a robot's gripper reaches: draws reach.png, seen from above and from the side.

Run it as ``.venv/bin/python examples/reach.py``; ``--robot fetch`` or ``--frame pr2/l_gripper_tool_frame``
asks for another one.
"""

from __future__ import annotations

import argparse

import numpy as np
from matplotlib.figure import Figure

import kineverse as kv

SAMPLES = 200_000
GRIPPERS = {"pr2": "pr2/r_gripper_tool_frame", "fetch": "fetch/gripper_link", "hsr": "hsr/hand_palm_link"}


def reached(model: kv.Model, frame: str, base: str, samples: int) -> np.ndarray:
    """Return places of a frame in the base's axes [m], (samples, 3), at random states within the limits."""
    place = model.fk(frame, base)[:3, 3]
    joints = place.symbols
    low, high = np.array([model.limits(joint) for joint in joints]).T
    # What turns for ever goes all around.
    low, high = np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
    states = np.random.default_rng(0).uniform(low, high, (samples, len(joints)))
    return kv.compile(place, joints).batch(states)


def main() -> None:
    """Sample, draw, and say how far it goes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robot", choices=GRIPPERS, default="pr2")
    parser.add_argument("--frame", help="whose places (the gripper's)")
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--picture", default="reach.png")
    arguments = parser.parse_args()
    model = kv.load(arguments.robot)
    frame = arguments.frame or GRIPPERS[arguments.robot]
    x, y, z = reached(model, frame, f"{arguments.robot}/base_link", arguments.samples).T
    canvas = Figure(figsize=(11, 5), layout="constrained")
    for axes, (a, b), names in zip(canvas.subplots(1, 2), ((x, y), (x, z)), ("xy", "xz"), strict=True):
        drawn = axes.hexbin(a, b, gridsize=80, bins="log", mincnt=1)
        axes.plot(0, 0, "r+", markersize=12)
        axes.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", aspect="equal")
        canvas.colorbar(drawn, ax=axes, label="samples")
    canvas.suptitle(f"{frame} at {arguments.samples} random states; + is the robot's base")
    canvas.savefig(arguments.picture, dpi=120)
    print(f"{frame} reaches {np.hypot(x, y).max():.2f} m far and from {z.min():.2f} to {z.max():.2f} m high")
    print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
