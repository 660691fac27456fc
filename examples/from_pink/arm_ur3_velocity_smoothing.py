"""Follow a swinging target with a UR3, smoothly; pink's example ``arm_ur3_velocity_smoothing.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, same_pose

model = kv.load("ur_description/urdf/ur3_robot.urdf")
start = model.default_state() | {"shoulder_lift_joint": 1.0, "shoulder_pan_joint": 1.0, "elbow_joint": 1.0}
gripper = model.fk("ee_link")
time = kv.parameter("time", 0.0)

target = kv.transform(gripper(start)[:3, :3], [gripper(start)[0, 3], 0.5 + 0.1 * np.sin(2 * time), 0.2])
goal = Goal(same_pose(target, gripper), name="gripper", gain=200)
controller = Controller(model, [goal], dt=0.005, smooth=0.01)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(f"gripper: {command.residuals['gripper']:.2g} from the target")
