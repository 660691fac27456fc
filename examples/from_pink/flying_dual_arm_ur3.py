"""Move two UR3 on a flying base, each to a target of its own; pink's example ``flying_dual_arm_ur3.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, same_pose

model = kv.Model()
with model.edit() as edit:
    edit.apply(kv.Floating(name="flight", parent="world", child="base"))
    for side, x in (("left", 0.3), ("right", -0.3)):
        edit.include("ur_description/urdf/ur3_robot.urdf", side)
        edit.attach(f"{side}/world", "base", kv.translation(x, 0, 0))
bent = {"shoulder_lift_joint": 1.0, "shoulder_pan_joint": 1.0, "elbow_joint": 1.0}
start = model.default_state() | {f"{s}/{joint}": a for s in ("left", "right") for joint, a in bent.items()}
time = kv.parameter("time", 0.0)

goals = []
for side in ("left", "right"):
    hand = model.fk(f"{side}/ee_link")
    target = kv.transform(hand(start)[:3, :3], [hand(start)[0, 3], 0.5 + 0.1 * np.sin(2 * time), 0.2])
    goals.append(Goal(same_pose(target, hand), name=side, gain=200))
base = kv.translation(0, 0, 0.3 * np.sin(2 * time))
goals.append(Goal(same_pose(base, model.fk("base")), name="base", gain=200))
controller = Controller(model, goals, dt=0.005, smooth=0)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(", ".join(f"{name}: {error:.2g}" for name, error in command.residuals.items()))
