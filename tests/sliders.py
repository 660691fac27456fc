"""Three sliders with locks, and the goals of lockboxes."""

import kineverse as kv

A, B, C = map(kv.position, "abc")


def three_sliders(**locks):
    model = kv.Model()
    with model.edit() as edit:
        for q in (A, B, C):
            edit.constrain(f"{q} range", 0, q, 1)
        for name, open_if in locks.items():
            edit.constrain(f"lock {name}", -1, kv.position(name).derivative(), open_if)
    return model


def goal_of(box):
    return {f"lockbox/{name}": value for name, value in box.goal.items()}
