"""Track the coordinates of a model from noisy poses of its frames, within the joint limits."""

import numpy as np

import kineverse as kv

rng = np.random.default_rng(0)
model = kv.load("kitchen")
frames = ["kitchen/fridge_door", "kitchen/fridge_door_handle", "kitchen/oven_left_drawer"]
tracker = kv.estimation.Tracker(model, frames)
print(tracker)

truth = {"kitchen/fridge_door": 0.9, "kitchen/oven_left_drawer": 0.2}
poses = {frame: model.fk(frame)({s: truth[str(s)] for s in model.fk(frame).symbols}) for frame in frames}
for _ in range(25):
    seen = {}
    for frame, pose in poses.items():
        if rng.random() < 0.8:  # not each frame is seen each time
            seen[frame] = pose.copy()
            seen[frame][:3, 3] += rng.normal(0, 0.01, 3)  # [m]
    estimate = tracker.update(seen)

for name, value in truth.items():
    print(f"{name}: {estimate.state[name]:.2f} ± {estimate.deviation[name]:.3f}, true value {value}")
