"""Convert a URDF into a document and back into a URDF, and compare two models."""

from pathlib import Path

import kineverse as kv

here = Path(__file__).parent
door = kv.load(here / "door.urdf")
print(door, door.limits("hinge"))

door.save("door.kv.json")  # operations and expressions, to the last bit
print(kv.load("door.kv.json").snapshot() == door.snapshot())
door.save("door_copy.urdf")  # or .xml: MJCF
copy = kv.load("door_copy.urdf")
print("differs in", kv.model.compare_models(door, copy).paths)  # the path of its mesh

diff = kv.model.compare_models(door, kv.load(here / "door_new.urdf"))
print("changed:", diff.paths)
