"""Run in a fresh process: a file to its first pose and Jacobian, with Kineverse.

``load_with_kineverse.py FILE FRAME [wait]``; with ``wait`` it also waits until it is compiled and kept.
"""

import json
import sys
from time import perf_counter

import kineverse as kv


def main(file: str, frame: str, *options: str) -> None:
    """Load twice, and print how long each took [s], and what came out at zero."""
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
    print(json.dumps({"first": seconds[0], "again": seconds[1], "pose": pose.tolist(), "columns": columns}))


if __name__ == "__main__":
    main(*sys.argv[1:])
