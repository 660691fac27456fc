"""Run in a fresh process: a file to its first pose and Jacobian, with pinocchio.

``load_with_pinocchio.py FILE FRAME``
"""

import json
import sys
from time import perf_counter

import pinocchio as pin


def main(file: str, frame: str) -> None:
    """Load, and print how long it took [s], and what came out at zero."""
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
    print(json.dumps({"first": seconds, "pose": pose.tolist(), "columns": columns}))


if __name__ == "__main__":
    main(*sys.argv[1:])
