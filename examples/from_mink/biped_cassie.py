"""Shift the weight of a Cassie, whose legs have closed loops; mink's ``biped_cassie.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, same_orientation

model = kv.load("cassie_description/robots/cassie_v2.sdf")
with model.edit() as edit:
    edit.apply(kv.Floating(name="root_joint", parent="world", child="free"))
    edit.attach("pelvis", "free", kv.translation(0, 0, 0))
start = model.project(model.default_state() | {"root_joint/z": 1.0}, tolerance=1e-6)
time = kv.parameter("time", 0.0)

centre, pelvis = model.center_of_mass(), model.fk("pelvis")
shift = [0, 0.03 * np.sin(2 * time), -0.05 * (1 - np.cos(time))]
tasks = [
    Goal(centre, centre(start) + kv.array(shift), name="centre of mass", gain=200, weight=400),
    Goal(same_orientation(pelvis(start), pelvis), name="pelvis", gain=200),
]
for side in ("left", "right"):
    foot = model.fk(f"{side}-foot")
    tasks.append(Hold(foot[:3, 3], foot(start)[:3, 3], name=f"{side} foot"))
    tasks.append(Goal(same_orientation(foot(start), foot), name=f"{side} foot, flat", gain=200))
controller = Controller(model, tasks, dt=0.005)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(", ".join(f"{task.name}: {command.residuals[task.name]:.2g}" for task in tasks))
