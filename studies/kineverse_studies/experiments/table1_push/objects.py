"""Objects of the pushing experiment: twelve of a kitchen, and a folding cupboard door."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from kineverse.articulations.mechanisms import FoldingDoor
from kineverse.errors import UnknownNameError, suggest
from kineverse.geometry.exclusions import remove_unusable_shapes
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import rotation_z, translation
from kineverse.state import State

OPENED = 0.4
"""Value from which objects are pushed shut [m], [rad]."""
FOLDING_DOOR = "folding door"
SHIPPED_KITCHEN, AUTHORS_KITCHEN = "shipped kitchen", "authors' kitchen"

_FILES = {SHIPPED_KITCHEN: "kitchen", AUTHORS_KITCHEN: "iai_kitchen/iai_kitchen/urdf_obj/IAI_kitchen.urdf"}
_PLACE = Pose.from_matrix(translation(1.0, 0.0, 0.7) @ rotation_z(0.57))

# Name of each object: coordinate in the shipped kitchen, and in the authors'.
_COORDINATES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "fridge door": ("fridge_door", "iai_fridge_door_joint"),
        "oven door": ("oven_door", "oven_area_oven_door_joint"),
        "dishwasher door": ("dishwasher_door", "sink_area_dish_washer_door_joint"),
        "fridge lower drawer": ("fridge_lower_drawer", "fridge_area_lower_drawer_main_joint"),
        "oven left drawer": ("oven_left_drawer", "oven_area_area_left_drawer_main_joint"),
        "oven middle lower drawer": (
            "oven_middle_lower_drawer",
            "oven_area_area_middle_lower_drawer_main_joint",
        ),
        "oven middle upper drawer": (
            "oven_middle_upper_drawer",
            "oven_area_area_middle_upper_drawer_main_joint",
        ),
        "oven right drawer": ("oven_right_drawer", "oven_area_area_right_drawer_main_joint"),
        "sink left bottom drawer": ("sink_left_bottom_drawer", "sink_area_left_bottom_drawer_main_joint"),
        "sink left middle drawer": ("sink_left_middle_drawer", "sink_area_left_middle_drawer_main_joint"),
        "sink left upper drawer": ("sink_left_upper_drawer", "sink_area_left_upper_drawer_main_joint"),
        "sink trash drawer": ("sink_trash_drawer", "sink_area_trash_drawer_main_joint"),
    }
)
OBJECTS = (*_COORDINATES, FOLDING_DOOR)
"""Names of the objects."""


@dataclass(frozen=True, eq=False)
class PushSetup:
    """Robot before an open object."""

    kitchen: str
    model: Model  # model of robot and furniture
    what: str
    start: State  # state with the robot at the papers' start, its base at the origin, and the object open


def find_kitchens(data: Path | None) -> Mapping[str, tuple[str, ...]]:
    """Return the objects by kitchen: the shipped one, and the authors' if it is in the folder.

    The folding door stands alone, so it is an object of both.
    """
    found = {SHIPPED_KITCHEN: OBJECTS}
    if data is not None and (data / _FILES[AUTHORS_KITCHEN]).is_file():
        found[AUTHORS_KITCHEN] = OBJECTS
    return found


def make_push_setup(robot: RobotSource, kitchen: str, thing: str, data: Path | None = None) -> PushSetup:
    """Return a robot before an open object."""
    if thing not in OBJECTS:
        raise UnknownNameError(f"There is no object {thing!r}. {suggest(thing, OBJECTS, 'object')}")
    model = robot.load()
    if thing == FOLDING_DOOR:
        what = "cupboard"
        with model.edit() as edit:
            edit.apply(FoldingDoor(name=what, parent=WORLD, origin=_PLACE))
    else:
        file = _FILES[kitchen]
        source = str(data / file) if data is not None and kitchen == AUTHORS_KITCHEN else file
        model.include(source, "kitchen")
        if source != file:
            remove_unusable_shapes(model)
        what = f"kitchen/{_COORDINATES[thing][kitchen == AUTHORS_KITCHEN]}"
    opened = min(OPENED, float(model.limits(what)[1]))
    return PushSetup(kitchen, model, what, robot.start_state(model).updated({what: opened}))
