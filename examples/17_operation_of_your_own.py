"""Write an operation: a class that adds frames and constraints, and is re-run when what it reads changes."""

from dataclasses import dataclass

import kineverse as kv


@dataclass(frozen=True)
class CentredHandle(kv.Operation):
    """A handle in the middle of the leaf of a door."""

    door: str

    def apply(self, model):
        """Read the width of the door, and write the frame."""
        middle = kv.translation(model.data["width"] / 2, 0, 0)
        return kv.model.Writes(frames={f"{self.door}/handle": (self.door, middle)})


model = kv.Model()
with model.edit() as edit:
    edit.apply(kv.Revolute(name="hinge", parent="world", child="door", axis=(0, 0, 1)))
    edit.write("width", 0.8)
    edit.apply(CentredHandle("door"), tag="handle")
model.save("door.kv.json")

# A document carries what an operation computes, so that a reader can run it without its class.
read = kv.load("door.kv.json")
with read.edit() as edit:
    edit.replace("data width", kv.model.SetData("width", 1.0))
print(model.fk("door/handle", "door")()[:3, 3], read.fk("door/handle", "door")()[:3, 3])
print(model.history.readers("data/width"), model.history.writers("frames/door/handle"))
