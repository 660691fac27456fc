"""Run in a fresh process: the memory that a loaded robot takes, over the imports.

``memory_of_robot.py LIBRARY FILE FRAME``
"""

import importlib
import json
import os
import sys
from typing import Any


def main(library: str, file: str, frame: str) -> None:
    """Load, and print how much memory that took [MB], before and after the first pose and Jacobian."""
    module = importlib.import_module(library)
    before = resident()
    kept = LOADERS[library](module, file)
    loaded = resident() - before
    print(json.dumps({"loaded": loaded, "evaluated": evaluated(library, module, kept, frame, before)}))


def resident() -> float:
    """Return the memory of this process that is in use [MB]."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def evaluated(library: str, module: Any, kept: tuple[Any, ...], frame: str, before: float) -> float | None:
    """Return the memory [MB] after a pose and a Jacobian, of Kineverse, as it compiles them; else None."""
    if library != "kineverse":
        return None
    (model,) = kept
    function = module.compile([model.fk(frame), model.jacobian(frame)])
    function([0.0] * len(function.inputs))
    return resident() - before


def _kineverse(module: Any, file: str) -> tuple[Any, ...]:
    return (module.load(file, prefix=""),)


def _pinocchio(module: Any, file: str) -> tuple[Any, ...]:
    model = module.buildModelFromUrdf(file)
    return model, model.createData()


def _mujoco(module: Any, file: str) -> tuple[Any, ...]:
    # It would leave warnings in a file in the current folder.
    module.set_mju_user_warning(lambda warning: None)
    model = module.MjModel.from_xml_path(file)
    return model, module.MjData(model)


LOADERS = {"kineverse": _kineverse, "pinocchio": _pinocchio, "mujoco": _mujoco}

if __name__ == "__main__":
    main(*sys.argv[1:])
