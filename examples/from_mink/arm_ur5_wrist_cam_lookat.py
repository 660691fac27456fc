"""Look at a moving point with a camera at a UR5's wrist; mink's ``arm_ur5e_wrist_cam_lookat.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, look_at

model = kv.load("ur_description/urdf/ur5_robot.urdf")
camera = model.fk("tool0") @ kv.translation(0, 0, 0.06)
start = model.default_state() | {
    "shoulder_pan_joint": 0.3,
    "shoulder_lift_joint": -1.6,
    "elbow_joint": 1.8,
    "wrist_1_joint": -0.4,
    "wrist_2_joint": 1.3,
}
time = kv.parameter("time", 0.0)

point = [0.95 + 0.3 * np.cos(time), 0.6 * np.sin(time), 0.55 + 0.25 * np.sin(2 * time)]
gaze = look_at(camera, kv.array(point), axis=(0, 0, 1))
controller = Controller(model, [Goal(gaze, name="gaze", gain=200)], dt=0.005, smooth=0)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(f"gaze: {command.residuals['gaze']:.2g} rad off the point")
