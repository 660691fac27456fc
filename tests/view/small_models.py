"""Small models of which every number is known."""

from __future__ import annotations

import kineverse as kv
from kineverse.model.body import Body, Box, Cylinder, Mesh, Pose, Shape, Sphere

RED, BLUE, GREY = (0.9, 0.1, 0.1, 1.0), (0.1, 0.2, 0.9, 1.0), (0.7, 0.7, 0.7, 1.0)


def cabinet() -> kv.Model:
    """A drawer (along -x, 0 to 0.4 m), a door (about z, 0 to 1.5 rad) and a knob on it, without limits."""
    drawer, door, knob = (kv.position(f"cabinet/{name}") for name in ("drawer", "door", "knob"))
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame(
            "cabinet/corpus",
            parent="world",
            transform=kv.translation(0, 0, 0.5),
            body=Body(visuals=(Shape(Box((0.4, 0.6, 1.0)), color=GREY),)),
        )
        edit.add_frame(
            "cabinet/drawer",
            parent="cabinet/corpus",
            transform=kv.translation(-drawer, 0, 0.2),
            body=Body(
                visuals=(
                    Shape(Box((0.4, 0.5, 0.2)), Pose.from_matrix(kv_translation(-0.02, 0, 0)), color=RED),
                ),
                collisions=(Shape(Box((0.4, 0.5, 0.2))),),
            ),
        )
        edit.add_frame(
            "cabinet/door",
            parent="cabinet/corpus",
            transform=kv.translation(-0.2, 0.3, -0.2) @ kv.rotation_z(-door),
            body=Body(
                visuals=(
                    Shape(Box((0.02, 0.6, 0.5)), Pose.from_matrix(kv_translation(0, -0.3, 0)), color=BLUE),
                )
            ),
        )
        edit.add_frame(
            "cabinet/knob",
            parent="cabinet/door",
            transform=kv.translation(-0.03, -0.5, 0) @ kv.rotation_x(knob),
            body=Body(visuals=(Shape(Sphere(0.03)), Shape(Cylinder(0.01, 0.05)))),
        )
        edit.constrain("cabinet/drawer/range", 0, drawer, 0.4)
        edit.constrain("cabinet/door/range", 0, door, 1.5)
        # Both open at once would collide.
        edit.constrain("cabinet/no_clash", -1, drawer + door, 1.6)
    return model


def kv_translation(x: float, y: float, z: float) -> list[list[float]]:
    return [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]]


def dependent() -> kv.Model:
    """A drawer that opens only as far as the door beside it: its bounds depend on the state."""
    model = kv.Model()
    drawer, door = kv.position("drawer"), kv.position("door")
    with model.edit() as edit:
        edit.add_frame("door", parent="world", transform=kv.rotation_z(door))
        edit.add_frame("drawer", parent="world", transform=kv.translation(drawer, 0, 0))
        edit.constrain("door/range", 0, door, 1.0)
        edit.constrain("drawer/range", 0, drawer, 0.5 * door)
    return model


def with_mesh(uri: str, folder: str, **options: object) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        body = Body(visuals=(Shape(Mesh(uri, folder=folder, **options)),))  # type: ignore[arg-type]
        edit.add_frame("part", parent="world", transform=kv.translation(0, 0, 0), body=body)
    return model


def held_door() -> kv.Model:
    """A door that opens as far as its bolt lets it, and a lid that is locked until the door is open."""
    model = kv.Model()
    door, bolt, lid = (kv.position(name) for name in ("door", "bolt", "lid"))
    with model.edit() as edit:
        edit.add_frame("door", parent="world", transform=kv.rotation_z(door))
        edit.add_frame("bolt", parent="world", transform=kv.translation(bolt, 0, 0))
        edit.add_frame("lid", parent="world", transform=kv.rotation_x(lid))
        edit.constrain("bolt/range", 0, bolt, 0.1)
        edit.constrain("door/range", 0, door, kv.where(bolt > 0.05, 1.5, 0.001))
        edit.constrain("lid/lock", -(door > 1), lid.derivative(), door > 1)
    return model
