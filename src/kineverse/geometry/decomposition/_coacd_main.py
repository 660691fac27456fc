"""Entry point of the CoACD process, which may crash, hang, or exhaust its memory.

    python -P _coacd_main.py IN OUT ERROR MEMORY

IN and OUT are archives of numpy; ERROR is in metres, MEMORY in bytes. The process ends when its standard
input ends, so it does not outlive its parent.
"""

import os
import sys
import threading
from pathlib import Path

import numpy as np

# The search is shorter than CoACD's default, which takes three times as long for as many hulls. CoACD's bound
# on the number of hulls is not used, because some values crash it. An open surface is wrapped with a grid of
# preprocess_resolution cells; the default of 50 takes minutes for an open box.
COACD_OPTIONS = {
    "real_metric": True,
    "mcts_nodes": 15,
    "mcts_iterations": 60,
    "mcts_max_depth": 2,
    "preprocess_resolution": 30,
    "seed": 0,
}


def main(source: str, target: str, error: str, memory: str) -> None:
    """Read a mesh and write the hulls of its decomposition."""
    threading.Thread(target=_end_with_standard_input, daemon=True).start()
    sys.path.insert(0, str(Path(__file__).parents[3]))  # the package of this file, installed or not
    from kineverse._runtime import limit_resources

    del sys.path[0]
    limit_resources(int(memory))

    import coacd

    coacd.set_log_level("error")
    with np.load(source) as mesh:
        vertices, faces, parts = mesh["vertices"], mesh["faces"].astype(np.int32), mesh["parts"]
    hulls = []
    for part in range(int(parts.max()) + 1):
        used, inside = np.unique(faces[parts == part], return_inverse=True)
        mesh_part = coacd.Mesh(vertices[used], inside.reshape(-1, 3))
        hulls += coacd.run_coacd(mesh_part, threshold=float(error), **COACD_OPTIONS)
    points = [corners for corners, _ in hulls]
    np.savez(target, points=np.concatenate(points), sizes=np.array([len(some) for some in points]))


def _end_with_standard_input() -> None:
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
