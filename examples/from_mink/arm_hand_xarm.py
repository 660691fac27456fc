"""Move an xArm and close the fingers of its hand; mink's ``arm_hand_xarm_leap.py``, with an Allegro hand."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, same_pose

model = kv.load("xarm_description/urdf/xarm7.urdf")
with model.edit() as edit:
    edit.include("allegro_hand_description/urdf/allegro_left_hand.urdf", "hand")
    edit.attach("hand/palm_link", "link_eef", kv.translation(0, 0, 0.095))
start = model.default_state() | {"joint2": -0.247, "joint4": 0.909, "joint6": 1.15644}
start |= {f"hand/joint_{k}.0": 0.5 for k in (1, 2, 3, 5, 6, 7, 9, 10, 11, 15)}
start |= {"hand/joint_12.0": 0.8, "hand/joint_13.0": 0.4, "hand/joint_14.0": 0.4}
time = kv.parameter("time", 0.0)

hand = model.fk("link_eef")
eight = kv.translation(0.1 * np.sin(2 * time), 0.2 * np.sin(time), 0.05 * np.sin(time))
goals = [Goal(same_pose(eight @ hand(start), hand), name="hand", gain=200)]
for k in (3, 7, 11, 15):
    tip = model.fk(f"hand/link_{k}.0_tip", "hand/palm_link")[:3, 3]
    closed = tip(start) * (1 - 0.05 * (1 - np.cos(2 * time)))
    goals.append(Goal(tip, closed, name=f"finger {k // 4 + 1}", gain=200))
controller = Controller(model, goals, dt=0.005, smooth=0)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(", ".join(f"{name}: {error:.2g}" for name, error in command.residuals.items()))
