"""Measurements in a fresh process without other modules; run as a file, not imported.

``fresh_process.py FUNCTION ARGUMENT...`` prints the JSON object of a function of this module. Each function
imports what it needs, because imports are part of what is measured.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any


def import_time(module: str) -> dict[str, Any]:
    start = perf_counter()
    importlib.import_module(module)
    return {"seconds": perf_counter() - start}


def load_with_kineverse(file: str, frame: str, *options: str) -> dict[str, Any]:
    """Load a file twice up to the first pose and Jacobian; return both times [s], and the values at zero."""
    import kineverse as kv

    seconds = []
    for _ in range(2):
        start = perf_counter()
        model = kv.load(file, prefix="")
        function = kv.compile([model.fk(frame), model.jacobian(frame)])
        pose, jacobian = function([0.0] * len(function.inputs))
        seconds.append(perf_counter() - start)
    if "wait" in options:
        function.wait()
    joints = [symbol.path for symbol in model.speeds_of(frame)]
    columns = dict(zip(joints, jacobian.T.tolist(), strict=True))
    return {"first": seconds[0], "again": seconds[1], "pose": pose.tolist(), "columns": columns}


def load_with_mujoco(file: str, frame: str) -> dict[str, Any]:
    """Load a file with MuJoCo up to its first pose and Jacobian; return time [s] and values at zero."""
    import mujoco
    import numpy as np

    # By default MuJoCo writes warnings to a file in the current folder.
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
    return {"first": seconds, "pose": pose.tolist(), "columns": columns}


def load_with_pinocchio(file: str, frame: str) -> dict[str, Any]:
    """Load a file with pinocchio up to its first pose and Jacobian; return time [s] and values at zero."""
    import pinocchio as pin

    start = perf_counter()
    model = pin.buildModelFromUrdf(file)
    data = model.createData()
    number = model.getFrameId(frame, pin.FrameType.BODY)
    jacobian = pin.computeFrameJacobian(
        model, data, pin.neutral(model), number, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    )
    pose = data.oMf[number].homogeneous
    seconds = perf_counter() - start
    moving = list(zip(model.names, model.joints, strict=True))[1:]
    columns = {name: jacobian[:, joint.idx_v].tolist() for name, joint in moving}
    return {"first": seconds, "pose": pose.tolist(), "columns": columns}


def build_controller(robot: str) -> dict[str, Any]:
    """Return the time of building a controller [s], and from there the time until C runs [s]."""
    from .control import make_opening

    opening = make_opening(robot)
    start = perf_counter()
    controller = opening.controller()
    built = perf_counter()
    controller.wait()
    return {"build": built - start, "ready": perf_counter() - built}


def build_planner(robot: str) -> dict[str, Any]:
    """Return the time from a robot's file to its planner in the shipped kitchen [s]."""
    from kineverse.planning import Planner

    from .kitchen_queries import make_kitchen_arm

    arm = make_kitchen_arm(robot, "kitchen (shipped)", except_touching=False)
    start = perf_counter()
    planner = Planner(arm.model, move=arm.symbols)
    planner.valid([[0.0] * len(planner.symbols)])
    return {"seconds": perf_counter() - start}


def memory_of_robot(library: str, file: str, frame: str) -> dict[str, Any]:
    """Return the memory of a robot beyond that of the imports [MB], loaded and evaluated."""
    module = importlib.import_module(library)
    before = _resident_memory()
    objects = _LOADERS[library](module, file)
    loaded = _resident_memory() - before
    evaluated = None
    if library == "kineverse":
        (model,) = objects
        function = module.compile([model.fk(frame), model.jacobian(frame)])
        function([0.0] * len(function.inputs))
        evaluated = _resident_memory() - before
    return {"loaded": loaded, "evaluated": evaluated}


def _resident_memory() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _load_mujoco(module: Any, file: str) -> tuple[Any, ...]:
    # By default MuJoCo writes warnings to a file in the current folder.
    module.set_mju_user_warning(lambda warning: None)
    model = module.MjModel.from_xml_path(file)
    return model, module.MjData(model)


def _load_pinocchio(module: Any, file: str) -> tuple[Any, ...]:
    model = module.buildModelFromUrdf(file)
    return model, model.createData()


_LOADERS: dict[str, Callable[[Any, str], tuple[Any, ...]]] = {
    "kineverse": lambda module, file: (module.load(file, prefix=""),),
    "pinocchio": _load_pinocchio,
    "mujoco": _load_mujoco,
}

if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]](*sys.argv[2:])))
