"""Custom SDF attributes for what SDF has no place for, read and written.

Other readers ignore attributes with a prefix of their own (http://sdformat.org/tutorials?tut=custom_elements_attributes_proposal).

======================  =====================================================================================
``kineverse:name``      name in the model of a link, frame, joint or shape that SDF does not allow, or has
                        for something else: a link and a joint of SDF may not share a name
``kineverse:home``      default values of a joint's coordinates [m], [rad]
``kineverse:zero``      values of a joint's coordinates at the poses of the file, where a loop is closed
``kineverse:free``      name of the free motion of a link; ``kineverse:home`` are its coordinates at the pose
``kineverse:loop``      loop that a joint closes, as JSON: its name and its dependent coordinates
``kineverse:inertia``   mass and moments of inertia, where SDF requires others; empty for none
======================  =====================================================================================
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.formats.names import NameMap, drop_empty_parts
from kineverse.formats.poses import pose_from_quaternion
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.xml_reader import Element, ElementError
from kineverse.formats.xml_values import parse_numbers
from kineverse.lie import axis_angle, transform
from kineverse.model.body import Pose, Vector3

NAMESPACE = "http://kineverse.org/sdf"
PREFIX = "kineverse"
NAME, HOME, ZERO = f"{PREFIX}:name", f"{PREFIX}:home", f"{PREFIX}:zero"
FREE, LOOP, INERTIA = f"{PREFIX}:free", f"{PREFIX}:loop", f"{PREFIX}:inertia"


@dataclass(frozen=True, slots=True)
class SdfLoop:
    """Loop that one or several joints close.

    ``dependent`` are its dependent coordinates; None for the last possible ones.
    """

    name: str
    dependent: tuple[str, ...] | None = None

    def as_text(self) -> str:
        """Return the record as the value of an attribute."""
        dependent = None if self.dependent is None else list(self.dependent)
        return json.dumps({"name": self.name, "dependent": dependent}, ensure_ascii=False)


def read_given_name(element: Element, key: str, remarks: ReaderWarnings) -> str:
    """Return the name in the model that an element states; empty if it states none, or no valid one."""
    given = element[1].get(key, "")
    name = drop_empty_parts(given)
    if given and (not name or not name.isprintable()):
        remarks.add(element, f"has {key}, which is no name; it is ignored.")
        return ""
    return name


def read_values(element: Element, key: str, count: int, remarks: ReaderWarnings) -> tuple[float, ...]:
    """Return the values of coordinates that a joint or a link states; empty if it states none."""
    text = element[1].get(key)
    if text is None:
        return ()
    try:
        values = parse_numbers(text, count)
        if key != INERTIA and count in (4, 7) and not any(values[-4:]):
            raise ValueError("has the quaternion 0 0 0 0, which is no orientation")
        return values
    except ValueError as error:
        remarks.repair(ElementError(element, f"has {key}, which {error}."), "it is ignored")
        return ()


def read_loop(element: Element, remarks: ReaderWarnings, model_name: NameMap) -> SdfLoop | None:
    """Return the loop that a joint states to close, with names below that of its scope."""
    text = element[1].get(LOOP)
    if text is None:
        return None
    try:
        known = json.loads(text)
        name, dependent = drop_empty_parts(known["name"]), known["dependent"]
        if name and (dependent is None or all(isinstance(one, str) and one for one in dependent)):
            return SdfLoop(model_name(name), None if dependent is None else tuple(map(model_name, dependent)))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass
    remarks.add(element, f"has {LOOP}, which is no record of a loop; it is ignored.")
    return None


def joint_motion(axis: Vector3, is_rotation: bool, values: Sequence[float], pitch: float = 0.0) -> Pose:
    """Return the motion of a joint by the values of its coordinates, in its own frame.

    Four values are those of a quaternion; a screw slides by its pitch [m per revolution].
    """
    if len(values) == 4:
        a, b, c, d = values
        return pose_from_quaternion((0.0, 0.0, 0.0), (a, b, c, d))
    (q,) = values
    slide = q * pitch / math.tau if is_rotation else q
    rotation = axis_angle(np.array(axis), np.array(q)) if is_rotation else np.eye(3)
    return Pose.from_matrix(transform(rotation, np.multiply(axis, slide)))


def allowed_name(name: str) -> str:
    """Return a name that SDF allows: not reserved, without scopes, and without blanks that readers drop."""
    result = "".join(c if c.isprintable() else "_" for c in name).replace("::", "_")
    result = " ".join(result.split()) or "_"
    if result == "world" or (result.startswith("__") and result.endswith("__")):
        result = result.rstrip("_") + "_"
    return result
