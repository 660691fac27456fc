"""Move the gripper of a TIAGo, in the end without its base; mink's ``mobile_tidybot.py``."""

import numpy as np

import kineverse as kv
from kineverse.articulations import OmniBase
from kineverse.control import Controller, Goal, same_pose

model = kv.load("tiago_description/robots/tiago_no_hand.urdf")
with model.edit() as edit:
    edit.apply(OmniBase(name="base", parent="world", child="platform"))
    edit.attach("base_footprint", "platform", kv.translation(0, 0, 0))
arm = dict(enumerate((1.3, 0.2, -1.2, 1.6, -0.5, 0.4, 0.3), start=1))
start = model.default_state() | {"torso_lift_joint": 0.15} | {f"arm_{k}_joint": a for k, a in arm.items()}
time = kv.parameter("time", 0.0)

gripper = model.fk("wrist_ft_tool_link")
away = kv.translation(1 - np.cos(0.5 * time), 0.5 * np.sin(time), 0)
base = kv.array([model.symbol(f"base/{axis}").derivative() for axis in ("x", "y", "angle")])
goals = [
    Goal(same_pose(away @ gripper(start), gripper), name="gripper", gain=200),
    Goal(base, 0, name="rest of the base", weight=kv.where(time > 4, 1e4, 0)),
]
weights = {"base/x": 0.01, "base/y": 0.01}  # while it is free, the base goes first
controller = Controller(model, goals, dt=0.005, smooth=0, weights=weights)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(f"gripper: {command.residuals['gripper']:.2g} from the target")
