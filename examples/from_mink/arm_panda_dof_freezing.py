"""Follow a target with a Panda, first without three of its joints; mink's ``arm_panda_dof_freezing.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Keep, same_pose

model = kv.load("panda_description/urdf/panda.urdf")
home = {"panda_joint4": -1.5708, "panda_joint6": 1.5708, "panda_joint7": -0.7854}
start = model.default_state() | home
hand = model.fk("panda_link8")
time = kv.parameter("time", 0.0)

around = kv.rotation_z(-np.deg2rad(60) * abs(np.sin(0.2 * np.pi * time)))
target = kv.transform(hand(start)[:3, :3], (around @ hand(start))[:3, 3])
tasks: list = [Goal(same_pose(target, hand), name="hand", gain=200)]
free = np.floor(time / 5) % 2 * 100  # rad/s
for k in (1, 2, 3):
    speed = model.symbol(f"panda_joint{k}").derivative()
    tasks.append(Keep(-free, speed, free, name=f"freeze {k}"))
controller = Controller(model, tasks, dt=0.005, smooth=0)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 10, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(f"hand: {command.residuals['hand']:.2g} from the target")
