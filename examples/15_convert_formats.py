"""Convert a URDF into a document, a URDF and an SDF, have drake check it, and compare two models."""

from pathlib import Path

import kineverse as kv

here = Path(__file__).parent
door = kv.load(here / "door.urdf")
print(door, door.limits("hinge"))

door.save("door.kv.json")  # operations and expressions, to the last bit
print(kv.load("door.kv.json").snapshot() == door.snapshot())
door.save("door_copy.urdf")  # or .xml: MJCF; names of materials and elements like <transmission> are kept
copy = kv.load("door_copy.urdf")
print("differs in", kv.model.compare_models(door, copy).paths)  # the path of its mesh

door.save("door.sdf")
try:
    check = kv.formats.check_conversion(door, "door.sdf")  # drake reads the file on its own
    print(check.engine, "computes equal poses" if check.ok else f"differs at {check.cause}")
except kv.errors.MissingDependencyError as error:
    print(error)

diff = kv.model.compare_models(door, kv.load(here / "door_new.urdf"))
print("changed:", diff.paths)
