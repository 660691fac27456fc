"""Meshes made here, and a CoACD that does what a test wants."""

import numpy as np
import shapely
import trimesh

ELL = [(0, 0), (0.2, 0), (0.2, 0.05), (0.05, 0.05), (0.05, 0.2), (0, 0.2)]
FINGER = [(0, 0), (20, 0), (25, 30), (20, 60), (8, 70), (5, 70), (12, 55), (12, 30), (6, 10), (0, 10)]


def ell():
    """Two legs 20 cm long, 5 cm wide and high."""
    return trimesh.creation.extrude_polygon(shapely.Polygon(ELL), 0.05)


def finger():
    """A bent finger of a gripper, 7 cm long."""
    return trimesh.creation.extrude_polygon(shapely.Polygon(np.array(FINGER) / 1000), 0.015)


def tray():
    """A box without lid: 30 x 20 x 10 cm, with walls of 2 cm."""
    inside = cube((0.26, 0.16, 0.1), (0, 0, 0.02))
    return trimesh.boolean.difference([cube((0.3, 0.2, 0.1)), inside], engine="manifold")


def overlapping():
    """Two cubes, each a closed surface, that run through each other."""
    return trimesh.util.concatenate([cube(), cube(at=(0.05, 0.05, 0.05))])


def cube(size=(0.1, 0.1, 0.1), at=(0, 0, 0)):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


# The beginning of a module that is found before the real one; what it does with a mesh follows.
FAKE = """
class Mesh:
    def __init__(self, vertices, faces): self.vertices, self.faces = vertices, faces
def set_log_level(level): print("a word of the library's own", flush=True)
def run_coacd(mesh, **settings):
"""


def fake_coacd(folder, monkeypatch, body):
    """Let processes find a CoACD of these lines."""
    folder.mkdir(exist_ok=True)
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    (folder / "coacd.py").write_text(FAKE + lines)
    monkeypatch.setenv("PYTHONPATH", str(folder))
