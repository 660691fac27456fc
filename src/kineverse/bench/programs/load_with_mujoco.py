"""Run in a fresh process: a file to its first pose and Jacobian, with MuJoCo.

``load_with_mujoco.py FILE FRAME``
"""

import json
import sys
from time import perf_counter

import mujoco
import numpy as np


def main(file: str, frame: str) -> None:
    """Load, and print how long it took [s], and what came out at zero."""
    # It would leave warnings in a file in the current folder.
    mujoco.set_mju_user_warning(lambda warning: None)
    start = perf_counter()
    model = mujoco.MjModel.from_xml_path(file)
    data = mujoco.MjData(model)
    body = model.body(frame).id
    jacobian, pose = np.zeros((6, model.nv)), np.eye(4)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], body)
    pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    seconds = perf_counter() - start
    columns = {model.joint(k).name: jacobian[:, model.jnt_dofadr[k]].tolist() for k in range(model.njnt)}
    print(json.dumps({"first": seconds, "pose": pose.tolist(), "columns": columns}))


if __name__ == "__main__":
    main(*sys.argv[1:])
