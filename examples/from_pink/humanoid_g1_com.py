"""Squat with a G1: centre of mass and hands move, the feet stand; pink's example ``humanoid_g1_com.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, same_orientation, same_pose

model = kv.load("g1_description/urdf/g1_29dof_rev_1_0.urdf")
with model.edit() as edit:
    edit.apply(kv.Floating(name="root_joint", parent="world", child="free"))
    edit.attach("pelvis", "free", kv.translation(0, 0, 0))
start = model.default_state() | {"root_joint/z": 0.72}
time = kv.parameter("time", 0.0)

centre = model.center_of_mass()
tasks = [
    Goal(centre, [0, 0, 0.55 + 0.05 * np.sin(np.pi * time)], name="centre of mass", gain=200, weight=2500),
    Goal(same_orientation(np.eye(4), model.fk("pelvis")), name="pelvis", gain=200, weight=6),
]
for side in ("left", "right"):
    foot, hand = model.fk(f"{side}_ankle_roll_link"), model.fk(f"{side}_rubber_hand")[:3, 3]
    tasks.append(Hold(same_pose(foot(start), foot), name=f"{side} foot"))
    tasks.append(Goal(hand, hand(start) - [0.1, 0, 0.2], name=f"{side} hand", gain=200))
controller = Controller(model, tasks, dt=0.005)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(", ".join(f"{name}: {error:.2g}" for name, error in command.residuals.items()))
