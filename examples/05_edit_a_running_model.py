"""Change a model while it is in use: edits are whole or refused, and listeners hear what changed."""

import kineverse as kv

model = kv.Model()
with model.edit() as edit:
    edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5))
    edit.add_frame("handle", parent="door", transform=kv.translation(0.4, 0, 0))
before = model.snapshot()

with model.listen(lambda diff: print("changed:", diff.paths)):
    with model.edit() as edit:  # the hinge moves, and what depends on it follows
        moved = kv.translation(0, 1, 0)
        edit.replace(
            "joint door",
            kv.Revolute(name="door", parent="world", child="door", origin=moved, axis=(0, 0, 1), upper=1.2),
        )
    try:
        with model.edit() as edit:
            edit.remove("joint door")  # but the handle hangs on it
    except kv.errors.EditError as error:
        print(error)

print(before.fk("handle")({"door": 0})[:3, 3], model.fk("handle")({"door": 0})[:3, 3])
print(model.history.tags, "version", model.version)
