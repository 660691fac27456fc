"""Compute the pose of an end effector and its Jacobian, as expressions and as numbers."""

import numpy as np

import kineverse as kv

model = kv.load("pr2")
pose = model.fk("pr2/r_gripper_tool_frame", relative_to="pr2/torso_lift_link")  # a 4×4 expression
joints = pose.symbols
print(len(joints), "joints move the gripper against the torso")

state = model.default_state().updated({"pr2/r_elbow_flex_joint": -1.0, "pr2/r_shoulder_pan_joint": -0.3})
print("position", pose(state)[:3, 3].round(3), "[m]")

# 6×n: three linear rows, then three angular rows; columns are the joints of the whole chain to the world.
jacobian = model.jacobian("pr2/r_gripper_tool_frame", relative_to="pr2/torso_lift_link", symbols=joints)
print("Jacobian", jacobian(state).shape)

# Each entry is the derivative of the position.
elbow, h = joints.index(model.symbol("pr2/r_elbow_flex_joint")), 1e-6
ahead, behind = (state.updated({joints[elbow]: -1.0 + d}) for d in (h, -h))
difference = (pose(ahead) - pose(behind))[:3, 3] / (2 * h)
print("equal to finite differences:", np.allclose(jacobian(state)[:3, elbow], difference))
