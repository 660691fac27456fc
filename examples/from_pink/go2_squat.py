"""Move the trunk of a Go2 within bounds while its feet stand; pink's example ``barriers/go2_squat.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, Keep, same_pose

model = kv.load("go2_description/urdf/go2.urdf")
with model.edit() as edit:
    edit.apply(kv.Floating(name="root_joint", parent="world", child="free"))
    edit.attach("base", "free", kv.translation(0, 0, 0))
legs = ("FL", "FR", "RL", "RR")
bent = {f"{leg}_{joint}_joint": a for leg in legs for joint, a in (("thigh", 0.8), ("calf", -1.57))}
start = model.default_state() | {"root_joint/z": 0.3} | bent
time = kv.parameter("time", 0.0)

trunk, wave = model.fk("base"), np.sin(np.pi / 2 * time)
sideways = np.floor(time / 4) % 2 < 1
target = kv.translation(0, 0.1 * sideways * wave, 0.3 + 0.2 * (1 - sideways) * wave)
tasks = [
    Goal(same_pose(target, trunk), name="trunk", gain=200, weight=[1, 1, 1, 4e-4, 4e-4, 4e-4]),
    Keep(-np.inf, trunk[1, 3], 0, name="right of the line"),
    Keep(-np.inf, trunk[2, 3], 0.35, name="below the ceiling"),
]
for leg in legs:
    foot = model.fk(f"{leg}_foot")[:3, 3]
    tasks.append(Hold(foot, foot(start), name=f"foot {leg}"))
controller = Controller(model, tasks, dt=0.005)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 8, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(", ".join(f"{name}: {error:.2g}" for name, error in command.residuals.items()))
