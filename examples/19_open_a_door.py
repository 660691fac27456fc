"""A robot opens a fridge: inverse kinematics for the grasp, then a controller holds it (extra ``control``).

The page in the browser shows it; with ``--headless`` the picture open.png is written instead.
``python examples/19_open_a_door.py fetch`` lets another robot do it.
"""

import sys
import time

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, inverse_kinematics, same_pose
from kineverse.view import save_picture

HANDS = {"pr2": "r_gripper_tool_frame", "fetch": "gripper_link", "hsr": "hand_palm_link"}
robot = next((name for name in sys.argv[1:] if name in HANDS), "pr2")
model = kv.load(robot)
model.include("kitchen")
door = model.symbol("kitchen/fridge_door")

hand = model.fk(f"{robot}/{HANDS[robot]}")
handle = model.fk("kitchen/fridge_door_handle") @ kv.rpy(np.pi / 2, 0, np.pi)
grasp = Hold(same_pose(hand, handle), name="grasp")
found = inverse_kinematics(model, [grasp], fixed=[door])
if not found.solved:
    sys.exit(found.why)
state = found.best

controller = Controller(model, [grasp, Goal(door, 1.4)], dt=0.02)
show = None if "--headless" in sys.argv else kv.show(model, state, block=False)
worst = 0.0
for _ in range(500):
    command = controller.step(state)
    state = model.integrate(state, command.speeds, controller.dt)
    worst = max(worst, command.residuals["grasp"])
    if state[door] > 1.39:
        break
    if show:
        show.move(state)
        time.sleep(controller.dt)
print(f"{robot} moves {len(controller.speeds)} joints, wheels and doors at once")
print(f"open by {state[door]:.2f} rad, grasp within {1000 * worst:.1f} mm, {model.violations(state)}")
if show:
    show.wait()
else:
    save_picture("open.png", model, state)
